"""The examples run, some thousand steps or less, with the libraries that they are for where these are installed."""

from __future__ import annotations

import importlib.util
import json
import os
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = ROOT / "examples"


def example(name):
    """An example's module; skips the test where a library that it imports is missing."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except ModuleNotFoundError as error:
        pytest.skip(f"examples/{name}.py needs {error.name}: pip install {error.name}")
    return module


@pytest.mark.filterwarnings("ignore")
def test_stable_baselines3_trains_on_both_actions():
    ppo = example("stable_baselines3_ppo")
    model = ppo.train("ALE/Pong-v5", "constant70_packed", steps=1024, num_envs=2)
    assert model.num_timesteps >= 1024
    assert model.action_space == gymnasium.spaces.MultiDiscrete([6, 5])
    action, _ = model.predict(model.observation_space.sample())
    assert action.shape == (2,)


@pytest.mark.filterwarnings("ignore")
def test_ppo_in_one_file_learns_from_whole_rollouts():
    ppo, said = example("ppo_jax"), []
    with ppo.jax.numpy_rank_promotion("allow"):
        params, _ = ppo.train(steps=1024, num_envs=4, report=said.append)
    assert [line.split(",")[0] for line in said] == ["512 steps", "1024 steps"]
    assert all(np.isfinite(leaf).all() for leaf in ppo.jax.tree.leaves(params))


def test_ppo_in_one_file_has_the_advantages_of_its_definition():
    ppo, random = example("ppo_jax"), np.random.default_rng(0)
    reward, value = random.normal(size=(9, 1)), random.normal(size=(10, 1))
    terminated, ignored = np.zeros((2, 9, 1), bool)
    terminated[2], ignored[3], ignored[7] = True, True, True  # an end in step 2; step 6 is cut off
    found = ppo.advantages(reward, value, terminated, ignored)
    for first, last in ((0, 2), (4, 6), (8, 8)):
        for t in range(first, last + 1):
            wanted = 0.0
            for k in range(t, last + 1):
                following = 0 if terminated[k] else value[k + 1, 0]
                delta = reward[k, 0] + ppo.GAMMA * following - value[k, 0]
                wanted += (ppo.GAMMA * ppo.LAMBDA) ** (k - t) * delta
            np.testing.assert_allclose(found[t, 0], wanted)
    assert found[3] == found[7] == 0


@pytest.mark.filterwarnings("ignore")
def test_minigrid_is_seen_in_colour():
    pytest.importorskip("minigrid", reason="pip install minigrid")
    env = example("pixels").minigrid("MiniGrid-Empty-5x5-v0")
    observation, _ = env.reset(seed=0)
    assert observation.shape == (50, 50, 3) and observation in env.observation_space
    assert observation.std() > 0


@pytest.mark.filterwarnings("ignore")
def test_a_mujoco_task_is_seen_by_its_camera(monkeypatch):
    pytest.importorskip("mujoco", reason="pip install mujoco")
    pytest.importorskip("imageio", reason="pip install imageio")
    monkeypatch.setenv("MUJOCO_GL", os.environ.get("MUJOCO_GL", "egl"))
    try:
        env = example("pixels").camera()
    except (ImportError, RuntimeError, AttributeError) as error:
        pytest.skip(f"MuJoCo does not render here: {error}")
    observation, _ = env.reset(seed=0)
    assert observation.shape == (84, 84, 3) and env.action_space == gymnasium.spaces.Discrete(3)
    angles = []
    for action in (0, 2):
        env.reset(seed=0)
        angles.append(env.step(action)[0])
    assert not np.array_equal(*angles)  # the cart is pushed to the left, and to the right
    env.close()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("needs", "words", "num_actions"),
    [
        ("Box2D", ["game=gymnasium:pixels:Driving"], 5),
        ("minigrid", ["game=gymnasium:pixels:MiniGrid", "env.kwargs.task=MiniGrid-Empty-5x5-v0"], 7),
        ("imageio", ["game=gymnasium:pixels:Camera", "env.kwargs.task=InvertedPendulum-v5"], 3),
    ],
)
def test_our_learner_trains_in_other_libraries_environments(needs, words, num_actions, tmp_path, monkeypatch):
    pytest.importorskip(needs, reason=f"{needs} is missing")
    import foajax

    monkeypatch.syspath_prepend(EXAMPLES)
    monkeypatch.setenv("MUJOCO_GL", os.environ.get("MUJOCO_GL", "egl"))
    small = ["env.num_envs=2", "learner.num_minibatches=1", "learner.rollout_length=8", "train.env_steps=16"]
    words = [*words, *small, "experiment=constant50_sub2_packed", f"run={tmp_path}/run"]
    agent = foajax.train_agent(foajax.compose(words))
    assert agent.env_steps == 16 and agent.agent.num_actions == num_actions


@pytest.mark.filterwarnings("ignore")
def test_the_notebook_runs(monkeypatch):
    notebook = json.loads((EXAMPLES / "foajax.ipynb").read_text())
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert all(not cell.get("outputs") for cell in notebook["cells"]), "outputs are not kept"
    monkeypatch.setenv("MPLBACKEND", "Agg")
    names: dict = {}
    for cell in cells:
        exec(cell, names)
    assert names["path"][-1].tolist() == [105, 60]  # from the middle, where the 120 pixels' area meets the border
    assert len(names["points"]) == 150 and len({tuple(point) for point in names["points"]}) > 5
    sys.modules["matplotlib.pyplot"].close("all")
