"""What users of other libraries have reported about wrappers like these; each test names where."""

from __future__ import annotations

import functools

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import FlattenObservation, FrameStackObservation, TimeLimit
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics
from noise import Noise

import foajax
from foajax.config.schema import GazeConfig, RingSensor

SENSOR = RingSensor(rings=((6, 6, 1),), layout="packed")
STILL = {"natural": np.zeros(2, int), "vision": np.zeros(2, int)}


def vector(*lengths, mode=AutoresetMode.NEXT_STEP, make=Noise, **options):
    makers = [functools.partial(make, length=length) for length in lengths]
    return foajax.FoveatedVectorObservation(SyncVectorEnv(makers, autoreset_mode=mode), SENSOR, **options)


def test_stacked_frames_are_an_image_with_channels():
    """DLR-RM/stable-baselines3 issue 2090: a stack's fourth axis made it flatten images without a word."""
    preprocessing = pytest.importorskip("stable_baselines3.common.preprocessing", reason="stable-baselines3 is missing")
    stacked = FrameStackObservation(Noise(spaces.Box(0, 255, (16, 20, 3), np.uint8)), 2)
    env = foajax.FoveatedObservation(stacked, SENSOR, dtype=np.uint8)
    assert preprocessing.is_image_space(env.observation_space["image"])
    assert env.observation_space["image"].shape == (6, 6, 6)


def test_several_discrete_actions_are_one_row():
    """DLR-RM/stable-baselines3 issue 1713: a MultiDiscrete of two rows fails in its buffers."""
    env = foajax.FoveatedObservation(Noise(), SENSOR, actions="multidiscrete")
    assert env.action_space.nvec.tolist() == [3, 5] and env.action_space.shape == (2,)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_episodes_are_counted_outside_of_the_wrapper(mode):
    """Farama-Foundation/Gymnasium issue 1017 and pull 1624: lengths were off by one after the first episode."""
    env = RecordEpisodeStatistics(vector(3, 5, mode=mode))
    env.reset(seed=0)
    lengths = []
    for _ in range(13):
        _, _, _, _, info = env.step(STILL)
        if "episode" in info:
            lengths += info["episode"]["l"][info["_episode"]].tolist()
    assert env.env.metadata["autoreset_mode"] == mode
    assert lengths == ([3, 5, 3, 3, 5] if mode == AutoresetMode.NEXT_STEP else [3, 5, 3, 3, 5, 3])


def test_a_seed_decides_all_restarts_too():
    """Farama-Foundation/Gymnasium issue 1321: what is seeded when episodes restart by themselves."""

    def starts(seed):
        env = vector(2, 3, gaze=GazeConfig(start="random"))
        env.reset(seed=seed)
        return [(env.step(STILL), env.focal_point.tolist())[1] for _ in range(9)]

    assert starts(4) == starts(4) != starts(5)


def test_the_game_is_still_rendered():
    """openai/gym issue 1598, DLR-RM/stable-baselines3 pull 1525: wrappers that lose `render` or `render_mode`."""

    class Rendered(Noise):
        render_mode, metadata = "rgb_array", {"render_modes": ["rgb_array"], "render_fps": 30}

        def render(self):
            return np.repeat(self.drawn[..., None], 3, axis=2)

    env = foajax.FoveatedObservation(Rendered(), SENSOR)
    env.reset(seed=0)
    assert env.render_mode == "rgb_array" and env.metadata["render_fps"] == 30
    np.testing.assert_array_equal(env.render()[..., 0], env.unwrapped.drawn)


def test_a_time_limit_outside_of_the_wrapper():
    """Farama-Foundation/Gymnasium issue 351: a limit that is put on last."""
    env = TimeLimit(foajax.FoveatedObservation(Noise(), SENSOR, GazeConfig(step=2)), 2)
    env.reset(seed=0)
    env.step({"natural": 0, "vision": 1})
    assert env.step({"natural": 0, "vision": 1})[3] is True
    _, info = env.reset()
    assert info["focal_point"].tolist() == [8, 10]


def test_shades_of_gray_survive_in_bytes():
    """DLR-RM/stable-baselines3 issue 1162: a cast to uint8 before scaling made images black and white."""
    env = foajax.FoveatedObservation(Noise(spaces.Box(0, 1, (16, 20), np.float32)), SENSOR, dtype=np.uint8)
    observation, _ = env.reset(seed=0)
    assert len(np.unique(observation["image"])) > 20


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_a_buffer_that_is_used_again_changes_nothing_that_was_seen(mode):
    """Farama-Foundation/Gymnasium issue 1132: environments that draw into one array changed final observations."""

    class OneBuffer(Noise):
        buffer = np.zeros((16, 20), np.uint8)

        def draw(self):
            self.buffer[:] = 10 * (self.time + 1)
            return self.buffer

    env, seen = vector(3, mode=mode, make=OneBuffer, dtype=np.uint8), []
    seen.append(env.reset(seed=0)[0]["image"])
    for _ in range(3):
        observation, _, _, _, info = env.step({"natural": np.zeros(1, int), "vision": np.zeros(1, int)})
        seen.append(observation["image"])
    values = [image.max() for image in seen]
    assert values[:3] == [10, 20, 30] and values[3] == (40 if mode == AutoresetMode.NEXT_STEP else 10)


def test_frames_that_are_no_arrays_yet():
    """ray-project/ray issue 22075: lazily stacked frames have `__array__` and no `astype`."""

    class Lazy:
        def __init__(self, array):
            self.array = array

        def __array__(self, dtype=None, copy=None):
            return self.array

    class LazyNoise(Noise):
        def draw(self):
            return Lazy(super().draw())

    observation, _ = foajax.FoveatedObservation(LazyNoise(), SENSOR).reset(seed=0)
    assert observation["image"].shape == (6, 6, 1)


def test_the_wrapper_goes_around_each_environment_of_a_vector(monkeypatch):
    """Farama-Foundation/Gymnasium issue 1279: `make_vec(wrappers=...)` is where single wrappers belong."""
    spec = gymnasium.envs.registration.EnvSpec("FoajaxNoise-v1", entry_point=Noise, disable_env_checker=True)
    monkeypatch.setitem(gymnasium.registry, "FoajaxNoise-v1", spec)
    wrapper = functools.partial(foajax.FoveatedObservation, sensor=SENSOR)
    env = gymnasium.make_vec("FoajaxNoise-v1", num_envs=2, vectorization_mode="sync", wrappers=[wrapper])
    observation, info = env.reset(seed=0)
    assert observation["image"].shape == (2, 6, 6, 1) and info["focal_point"].shape == (2, 2)
    env.step(STILL)


def test_infos_of_a_vector_can_be_taken_apart():
    """openai/gym pull 2773: a vector's info is arrays, with a mask of who has each."""
    env = DictInfoToList(vector(3, 5))
    _, infos = env.reset(seed=0)
    assert [info["focal_point"].tolist() for info in infos] == [[8, 10], [8, 10]]
    assert [int(info["values"]) for info in infos] == [36, 36]


def test_an_observation_can_be_flattened():
    """HumanCompatibleAI/imitation issue 702: for learners that take one vector and a row of actions."""
    env = FlattenObservation(foajax.FoveatedObservation(Noise(), SENSOR, actions="multidiscrete"))
    observation, _ = env.reset(seed=0)
    assert observation.shape == (36 + 2,) and observation in env.observation_space
