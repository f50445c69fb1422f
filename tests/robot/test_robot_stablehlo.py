"""The whole decision as a program for JAX, of any batch, run where foajax cannot be imported."""

from __future__ import annotations

import functools
import subprocess
import sys

import jax
import numpy as np
import pytest

from foajax.config.parse import ConfigError
from foajax.robot.golden import GAMES
from foajax.types import TimeStep

pytest.importorskip("flatbuffers", reason="needs the extra robot")
stablehlo = pytest.importorskip("foajax.robot.stablehlo", reason="needs the extra robot")

RUN = """
import sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("foajax", "flax", "jaxtyping"):
            raise ImportError(name + " is out of reach")
sys.meta_path.insert(0, Missing())
import jax, numpy as np
from jax import export
decide = jax.jit(export.deserialize(bytearray(open(sys.argv[1], "rb").read())).call)
inputs = dict(np.load(sys.argv[2]))
frames, rewards, results = inputs.pop("frames"), inputs.pop("rewards"), []
for step in range(len(frames)):
    now = {"frame": frames[step], "reward": rewards[step], "is_first": np.full(len(frames[0]), step in (0, 3))}
    outputs = decide(inputs | now)
    results.append(np.asarray(outputs["natural_logits"]))
    inputs |= {name: value for name, value in outputs.items() if name in inputs}
np.save(sys.argv[3], results)
"""


@pytest.fixture(
    scope="module", params=["experiment=constant70_p_packed gaze.moves=absolute gaze.cost=0.1", "experiment=nonfoa"]
)
def stored(request, make_stored):
    """A small agent, with a gaze whose moves have a price and without."""
    return make_stored(*request.param.split())


@pytest.fixture(scope="module")
def program(stored):
    """Its program."""
    return stablehlo.serialise(stored)


def play(stored, frames, rewards):
    """What the JAX agent does greedily; each entry one of the steps."""
    act = jax.jit(functools.partial(stored.agent.act, greedy=True))
    batch = frames.shape[1]
    state, rows = stored.agent.initial_state(batch), []
    for step, frame in enumerate(frames):
        timestep = TimeStep(frame, rewards[step], np.full(batch, step in (0, 3)), np.zeros(batch, bool))
        output, network, state = act(stored.params, stored.statistics, state, timestep, jax.random.key(0))
        rows.append(jax.device_get((timestep, output, network)))
    return rows


def steps(batch, number=5):
    random = np.random.default_rng(0)
    frames = random.integers(0, 256, (number, batch, 210, 160), np.uint8)
    return frames, np.sign(random.normal(size=(number, batch))).astype(np.float32)


@pytest.mark.parametrize("batch", [1, 3])
def test_jax_alone_runs_it_with_any_batch(batch, stored, program, tmp_path):
    frames, rewards = steps(batch)
    inputs = stablehlo.inputs(stored.agent, batch) | {"greedy": np.ones((), bool)}
    np.savez(tmp_path / "inputs.npz", frames=frames, rewards=rewards, **inputs)
    (tmp_path / "program").write_bytes(program)
    files = [str(tmp_path / name) for name in ("program", "inputs.npz", "results.npy")]
    subprocess.run([sys.executable, "-c", RUN, *files], check=True, timeout=300)
    wanted = [network.natural_logits for _, _, network in play(stored, frames, rewards)]
    np.testing.assert_allclose(np.load(tmp_path / "results.npy"), wanted, atol=1e-5)


def test_actions_are_drawn_by_the_seed(stored, program):
    decide = jax.jit(jax.export.deserialize(bytearray(program)).call)
    inputs = stablehlo.inputs(stored.agent, 64)
    drawn = [decide(inputs | {"seed": np.arange(64, dtype=np.uint32) + first}) for first in (0, 0, 64)]
    actions = [np.asarray(outputs["natural_action"]) for outputs in drawn]
    assert (actions[0] == actions[1]).all()
    assert (actions[0] != actions[2]).any()
    assert len(np.unique(actions[0])) == stored.agent.num_actions


def test_its_check_finds_what_differs(stored, program):
    rows = play(stored, *steps(GAMES))
    golden = {
        **{name: np.stack([getattr(r[0], name) for r in rows], 1) for name in ("frame", "reward", "is_first")},
        "focal_point": np.stack([r[1].focal_point for r in rows], 1),
        "natural_action": np.stack([r[1].natural_action for r in rows], 1),
        "vision_action": np.stack([r[1].vision_action for r in rows], 1),
        "natural_logits": np.stack([r[2].natural_logits for r in rows], 1),
    }
    golden = {name: np.concatenate(array) for name, array in golden.items()}
    assert stablehlo.check(program, golden, stored.agent) < 1e-5
    for name, message in (("natural_logits", "logits differ by"), ("natural_action", "natural_action differs at")):
        with pytest.raises(ConfigError, match=message):
            stablehlo.check(program, golden | {name: golden[name] + 1}, stored.agent)
    with pytest.raises(ConfigError, match="looked_at differs at step 0"):
        stablehlo.check(program, golden | {"focal_point": golden["focal_point"] + 1}, stored.agent)
