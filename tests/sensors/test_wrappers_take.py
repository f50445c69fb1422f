"""What the wrappers take: images and actions of any form, every way to restart, other libraries' vectors, processes."""

from __future__ import annotations

import dataclasses
import multiprocessing
import pickle

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import FrameStackObservation
from noise import Noise

import foajax
from foajax.config.compose import compose
from foajax.config.parse import ConfigError
from foajax.config.schema import GazeConfig, RingSensor
from foajax.learning.agent import _pay
from foajax.training import start

SENSOR = RingSensor(rings=((6, 6, 1), (12, 12, 2)), layout="packed")
FULL = RingSensor(rings=((6, 6, 1),), layout="packed")
GAZE = GazeConfig(step=2)
STAY, UP, DOWN, LEFT, RIGHT = range(5)
LENGTHS = (2, 4)


def wrapped(space=None, sensor=FULL, gaze=GAZE, action_space=None, length=99, **options):
    return foajax.FoveatedObservation(Noise(space, action_space, length), sensor, gaze, **options)


def crop(image, y, x, size=6):
    return image[y - size // 2 : y + size // 2, x - size // 2 : x + size // 2]


LAYOUTS = {
    "gray": ((16, 20), lambda x: x[..., None]),
    "channels last": ((16, 20, 3), lambda x: x),
    "with alpha": ((16, 20, 4), lambda x: x),
    "channels first": ((3, 16, 20), lambda x: np.moveaxis(x, 0, 2)),
    "one channel first": ((1, 16, 20), lambda x: np.moveaxis(x, 0, 2)),
    "stack": ((4, 16, 20), lambda x: np.moveaxis(x, 0, 2)),
    "stack of colours": ((2, 16, 20, 3), lambda x: np.concatenate([x[0], x[1]], axis=2)),
    "stack of colours first": ((2, 3, 16, 20), lambda x: np.moveaxis(x.reshape(6, 16, 20), 0, 2)),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_an_image_of_any_layout_is_seen_channels_last(layout):
    shape, channels_last = LAYOUTS[layout]
    env = wrapped(spaces.Box(0, 255, shape, np.uint8))
    observation, _ = env.reset(seed=0)
    assert observation in env.observation_space
    np.testing.assert_allclose(observation["image"], crop(channels_last(env.unwrapped.drawn), 8, 10) / 255, rtol=1e-6)


@pytest.mark.parametrize(
    "low, high, kind, dtype, scale",
    [
        (0, 255, np.uint8, np.float32, 1 / 255),
        (0, 65535, np.uint16, np.float32, 1 / 65535),
        (0, 255, np.uint8, np.uint8, 1),
        (0, 65535, np.uint16, "uint8", 1 / 257),
        (0, 1, np.float32, np.uint8, 255),
        (0, 51, np.float64, np.uint8, 5),
        (-3, 5, np.float16, np.float32, 1),
    ],
)
def test_numbers_of_any_type_are_scaled(low, high, kind, dtype, scale):
    env = wrapped(spaces.Box(low, high, (16, 20), kind), dtype=dtype)
    observation, _ = env.reset(seed=0)
    assert observation in env.observation_space and observation["image"].dtype == dtype
    wanted = crop(env.unwrapped.drawn.astype(np.float32), 8, 10) * scale
    if np.dtype(dtype) == np.uint8:
        wanted = wanted.round()
    np.testing.assert_allclose(observation["image"][..., 0], wanted, rtol=1e-5)


BOTH = {"camera": spaces.Box(0, 255, (16, 20, 3), np.uint8), "joints": spaces.Box(-1, 1, (7,)), "task": spaces.Text(5)}


@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version")
def test_what_is_no_image_of_a_dict_is_passed_on():
    env = wrapped(spaces.Dict(BOTH), image_key="camera")
    check_env(env, skip_render_check=True)
    observation, _ = env.reset(seed=0)
    assert list(observation) == ["joints", "task", "image", "focal_point"]
    np.testing.assert_array_equal(observation["joints"], env.unwrapped.drawn["joints"])
    assert observation["task"] == env.unwrapped.drawn["task"]
    np.testing.assert_allclose(observation["image"], crop(env.unwrapped.drawn["camera"], 8, 10) / 255, rtol=1e-6)


def test_a_vector_of_dicts_is_seen_too():
    space = spaces.Dict({name: BOTH[name] for name in ("camera", "joints")})
    env = foajax.FoveatedVectorObservation(SyncVectorEnv([lambda: Noise(space)] * 2), FULL, image_key="camera")
    observation, _ = env.reset(seed=0)
    assert observation in env.observation_space and observation["joints"].shape == (2, 7)


@pytest.mark.parametrize(
    "space, options, message",
    [
        (spaces.Dict(BOTH), {}, r"^image_key=None: accepted is one of camera, joints, task$"),
        (spaces.Dict(BOTH), {"image_key": "camra"}, r"^image_key=camra: did you mean camera\? accepted is one of "),
        (spaces.Dict(BOTH), {"image_key": "joints"}, r"^observation_space=.*accepted is a Box of"),
        (None, {"image_key": "camera"}, "^image_key=camera: accepted is None, because the observation is"),
        (spaces.Dict({"x": BOTH["camera"], "image": BOTH["joints"]}), {"image_key": "x"}, "^observation_space=image: "),
        (None, {"dtype": np.float64}, r"^dtype=float64: did you mean float32\? accepted is one of float32, uint8"),
        (spaces.Box(-1, 1, (16, 20)), {"dtype": np.uint8}, r"^dtype=uint8: accepted is numpy.float32 where"),
        (None, {"actions": "multidiscrete", "action_space": spaces.Box(-1, 1, (2,))}, "^actions=.*dict or tuple where"),
    ],
)
def test_what_does_not_fit_is_one_line(space, options, message):
    with pytest.raises(ConfigError, match=message) as error:
        wrapped(space, **options)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "form, own, space, action, natural",
    [
        ("dict", spaces.Discrete(3), spaces.Dict, {"natural": 2, "vision": UP}, 2),
        ("tuple", spaces.Box(-1, 1, (2,)), spaces.Tuple, (np.array([0.5, 1]), UP), [0.5, 1]),
        ("multidiscrete", spaces.Discrete(3, start=4), spaces.MultiDiscrete, np.array([6, UP]), 6),
        ("multidiscrete", spaces.MultiDiscrete([3, 4]), spaces.MultiDiscrete, np.array([2, 3, UP]), [2, 3]),
    ],
)
def test_actions_in_the_form_that_a_library_takes(form, own, space, action, natural):
    env = wrapped(action_space=own, actions=form)
    env.reset(seed=0)
    assert isinstance(env.action_space, space) and env.action_space.contains(env.action_space.sample())
    env.step(action)
    np.testing.assert_array_equal(env.unwrapped.action, natural)
    assert env.focal_point.tolist() == [6, 10]


def test_a_vector_of_multidiscrete_actions():
    env = foajax.FoveatedVectorObservation(SyncVectorEnv([Noise] * 2), FULL, GAZE, actions="multidiscrete")
    env.reset(seed=0)
    env.step(np.array([[2, UP], [1, LEFT]]))
    assert [one.action for one in env.env.envs] == [2, 1]
    assert env.focal_point.tolist() == [[6, 10], [8, 8]]


@pytest.mark.parametrize(
    "form, action, message",
    [
        ("dict", (0, 1), r'^action=.*: accepted is \{"natural": ..., "vision": ...\}$'),
        ("dict", {"natural": 0}, r"^action=.*: accepted is"),
        ("tuple", [0, 1], r"^action=\[0, 1\]: accepted is \(natural, vision\)$"),
        ("multidiscrete", np.array([0.0, 1.0]), r"^action=.*: accepted is integers \[2\], natural before vision$"),
        ("multidiscrete", np.array([0, 5]), r"^vision=5: accepted is an integer from 0 to 4$"),
    ],
)
def test_what_is_no_action_is_one_line(form, action, message):
    env = wrapped(actions=form)
    env.reset(seed=0)
    with pytest.raises(ConfigError, match=message):
        env.step(action)
    assert env.unwrapped.time == 0


def test_an_absolute_gaze_looks_at_cells():
    env = wrapped(gaze=GazeConfig(moves="absolute", grid=(2, 2)))
    env.reset(seed=0)
    assert env.action_space["vision"] == spaces.Discrete(4)
    places = []
    for cell in range(4):
        _, _, _, _, info = env.step({"natural": 0, "vision": cell})
        places.append(info["focal_point"].tolist())
    assert places == [[4, 5], [4, 15], [12, 5], [12, 15]]
    assert info["saccade"] == 10


def test_the_info_has_where_how_far_and_how_much():
    env = wrapped(spaces.Box(0, 255, (16, 20, 3), np.uint8), SENSOR)
    _, info = env.reset(seed=0)
    assert (info["focal_point"].tolist(), info["saccade"], info["values"]) == ([8, 10], 0, 3 * (36 + 36 - 4))
    _, _, _, _, info = env.step({"natural": 0, "vision": UP})
    assert (info["focal_point"].tolist(), info["saccade"], info["time"]) == ([6, 10], 2, 1)


@pytest.mark.parametrize("per", ["pixel", "saccade"])
def test_saccades_cost_what_they_cost_in_training(per):
    gaze, moves = GazeConfig(step=2, cost=0.25, cost_per=per), [UP, STAY, RIGHT, RIGHT, DOWN, LEFT, UP]
    prices = [0.0 if move == STAY else 0.25 * (2 if per == "pixel" else 1) for move in moves]
    env = foajax.FoveatedVectorObservation(SyncVectorEnv([lambda: Noise(length=4)]), FULL, gaze)
    single = wrapped(gaze=gaze, length=4)
    env.reset(seed=0), single.reset(seed=0)
    owed, first, alone = jnp.zeros((1, 2)), True, []
    for move, price in zip(moves, prices, strict=True):
        _, owed = _pay(jnp.zeros(1), owed, jnp.array([first]))  # the decision that chose the move
        owed = jnp.stack([owed, jnp.array([price])], -1)
        raw = 0.0 if env._ended[0] else 1.0
        first = bool(env._ended[0])
        reward = env.step({"natural": np.zeros(1, int), "vision": np.array([move])})[1]
        wanted, _ = _pay(jnp.array([raw]), owed, jnp.array([first]))
        np.testing.assert_allclose(reward, wanted, rtol=1e-6)
        if len(alone) < 4:
            alone.append((single.step({"natural": 0, "vision": move})[1], reward[0]))
    assert all(a == b for a, b in alone) and len({a for a, _ in alone}) > 1


def vector(mode, make=SyncVectorEnv, **options):
    makers = [lambda n=n: Noise(length=n) for n in LENGTHS]
    return foajax.FoveatedVectorObservation(make(makers, autoreset_mode=mode, **options), FULL, GAZE)


def test_a_restart_on_the_last_step_senses_both_frames():
    env = vector(AutoresetMode.SAME_STEP)
    env.reset(seed=0)
    path = []
    for _ in range(4):
        before = [one.unwrapped.drawn for one in env.env.envs]
        action = {"natural": np.zeros(2, int), "vision": np.array([UP, RIGHT])}
        observation, _, terminated, _, info = env.step(action)
        path.append(env.focal_point.tolist())
        for i, one in enumerate(env.env.envs):
            np.testing.assert_allclose(observation["image"][i, ..., 0], crop(one.drawn, *path[-1][i]) / 255, rtol=1e-6)
        for i in np.flatnonzero(terminated):
            final = info["final_obs"][i]
            assert final in env.single_observation_space and not np.array_equal(before[i], env.env.envs[i].drawn)
            assert info["final_info"]["focal_point"][i].tolist() == [[4, 10], [8, 17]][i]
            np.testing.assert_allclose(final["focal_point"], [[-0.5, 0], [0, 0.7]][i], atol=1e-6)
        assert ("final_obs" in info) == terminated.any()
    assert [first for first, _ in path] == [[6, 10], [8, 10], [6, 10], [8, 10]]
    assert [second for _, second in path] == [[8, 12], [8, 14], [8, 16], [8, 10]]


def test_the_final_frame_is_seen_where_the_gaze_had_moved():
    class Last(Noise):
        """The last frame of an episode is white, all others black."""

        def draw(self):
            return np.full((16, 20), 255 * (self.time == self.length), np.uint8)

    env = SyncVectorEnv([lambda: Last(length=1)], autoreset_mode=AutoresetMode.SAME_STEP)
    env = foajax.FoveatedVectorObservation(env, FULL, GAZE)
    env.reset(seed=0)
    observation, _, _, _, info = env.step({"natural": np.zeros(1, int), "vision": np.array([LEFT])})
    assert observation["image"].max() == 0 and info["final_obs"][0]["image"].min() == 1


def test_a_vector_that_does_not_say_how_it_restarts_is_refused():
    env = SyncVectorEnv([Noise])
    env.metadata = {}
    with pytest.raises(ConfigError, match="^metadata.*autoreset_mode.*=None: accepted is .*SAME_STEP"):
        foajax.FoveatedVectorObservation(env, FULL)


def test_one_and_many_are_not_mixed_up():
    with pytest.raises(ConfigError, match="^env=.*FoveatedVectorObservation takes many"):
        foajax.FoveatedObservation(SyncVectorEnv([Noise]), FULL)
    with pytest.raises(ConfigError, match="^env=.*FoveatedObservation takes one"):
        foajax.FoveatedVectorObservation(Noise(), FULL)


def test_a_wrapped_environment_can_be_pickled():
    env = wrapped(gaze=GazeConfig(start="random"))
    env.reset(seed=3)
    copy = pickle.loads(pickle.dumps(env))
    action = {"natural": 1, "vision": RIGHT}
    for ours, theirs in zip(jax.tree.leaves(env.step(action)), jax.tree.leaves(copy.step(action)), strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.fixture
def registered():
    gymnasium.register("FoajaxNoise-v0", Noise, max_episode_steps=7)
    yield "FoajaxNoise-v0"
    gymnasium.registry.pop("FoajaxNoise-v0")


@pytest.mark.parametrize("sensor", [SENSOR, "constant70_packed"])
def test_an_environment_can_be_made_again_from_its_spec(registered, sensor):
    space = spaces.Box(0, 255, (84, 84), np.uint8)
    made = gymnasium.make(registered, space=space, disable_env_checker=True)
    env = foajax.FoveatedObservation(made, sensor, actions="tuple", dtype=np.uint8)
    again = gymnasium.make(env.spec)
    assert again.observation_space == env.observation_space and again.action_space == env.action_space
    with_wrapper = gymnasium.make(dataclasses.replace(made.spec, additional_wrappers=env.spec.additional_wrappers))
    assert with_wrapper.observation_space == env.observation_space


@pytest.mark.filterwarnings("ignore")  # JAX warns of any fork
def test_a_vector_of_processes_after_jax_was_used():
    jax.block_until_ready(jnp.ones(3) + 1)
    makers = [lambda n=n: wrapped(length=n) for n in LENGTHS]
    env = AsyncVectorEnv(makers, context="fork")
    alone = SyncVectorEnv(makers)
    try:
        env.reset(seed=0), alone.reset(seed=0)
        for _ in range(4):
            action = {"natural": np.zeros(2, int), "vision": np.array([UP, LEFT])}
            ours, theirs = env.step(action), alone.step(action)
            np.testing.assert_array_equal(ours[0]["image"], theirs[0]["image"])
    finally:
        env.close(terminate=True)


class Corner(foajax.Sensor):
    """A sensor of one's own: the four pixels around the focal point."""

    window = (2, 2)

    def sense(self, frame, focal_point, bounds):
        return (jax.lax.dynamic_slice(frame, focal_point - 1, (2, 2)).astype(jnp.float32),)

    def image_shapes(self, frame_shape):
        return ((2, 2),)

    def picture(self, images, focal_point, frame_shape):
        raise NotImplementedError


def test_a_sensor_of_ones_own_is_run_by_jax():
    env = foajax.FoveatedVectorObservation(SyncVectorEnv([Noise] * 2), Corner(), GAZE)
    env.reset(seed=0)
    observation, *_ = env.step({"natural": np.zeros(2, int), "vision": np.array([UP, RIGHT])})
    for i, (y, x) in enumerate(((6, 10), (8, 12))):
        frame = env.env.envs[i].drawn
        np.testing.assert_allclose(observation["image"][i, ..., 0], crop(frame, y, x, size=2) / 255, rtol=1e-6)


@pytest.mark.parametrize("shapes", [((3, 3),), ((2, 2), (2, 2)), None])
def test_a_sensor_of_ones_own_that_gives_other_images_than_it_says_is_refused(shapes):
    sensor = Corner()
    sensor.image_shapes = lambda frame_shape: shapes
    message = r"^sensor=Corner: its sense gives float32\[2, 2\] of a frame .*; accepted is what its image_shapes says"
    with pytest.raises(ConfigError, match=message):
        foajax.FoveatedObservation(Noise(), sensor, GAZE)
    with pytest.raises(ConfigError, match="sensor=Liar: its sense gives"):
        start.check(compose(["sensor=own", f"sensor.kind={__name__}:Liar"]))


class Liar(Corner):
    """Says that it gives larger images."""

    def image_shapes(self, frame_shape):
        return ((9, 9),)


def _sense_with_jax(results):
    try:
        foajax.sense(np.zeros((16, 20), np.uint8), np.array([8, 10]), sensor=FULL)
    except RuntimeError as error:
        results.put(str(error))


@pytest.mark.filterwarnings("ignore")  # JAX warns of any fork
def test_jax_in_a_forked_process_is_refused_in_one_line():
    jax.block_until_ready(jnp.ones(3) + 1)
    context = multiprocessing.get_context("fork")
    results = context.Queue()
    child = context.Process(target=_sense_with_jax, args=(results,), daemon=True)
    child.start()
    message = results.get(timeout=30)
    child.join(timeout=30)
    assert "forked process" in message and "spawn" in message and "\n" not in message


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("mode", ["next_step", "same_step"])
def test_the_vector_environment_of_ale_py(mode):
    """Its final observations are one array, and there is no `final_info`: Arcade-Learning-Environment pull 614."""
    vector_env = pytest.importorskip("ale_py.vector_env")
    options = {"stack_num": 2, "max_num_frames_per_episode": 40, "autoreset_mode": AutoresetMode[mode.upper()]}
    env = foajax.FoveatedVectorObservation(vector_env.AtariVectorEnv("breakout", 2, **options), "constant70_packed")
    observation, _ = env.reset(seed=0)
    assert observation["image"].shape == (2, 35, 35, 2)
    env.action_space.seed(0)
    ended = False
    for _ in range(12):
        observation, _, terminated, truncated, info = env.step(env.action_space.sample())
        assert observation in env.observation_space
        over = terminated | truncated
        ended |= over.any()
        if over.any() and mode == "same_step":
            assert all((info["final_obs"][i] is not None) == over[i] == info["_final_obs"][i] for i in range(2))
    assert ended
    env.close()


@pytest.mark.filterwarnings("ignore")
def test_a_pool_of_envpool():
    envpool = pytest.importorskip("envpool")
    pool = envpool.make_gymnasium("Breakout-v5", num_envs=2, stack_num=1, max_episode_steps=8, seed=3)
    env = foajax.FoveatedVectorObservation(pool, "constant70_packed", actions="multidiscrete")
    observation, _ = env.reset()
    path = []
    for _ in range(12):
        assert observation in env.observation_space
        observation, _, terminated, truncated, info = env.step(np.array([[1, LEFT], [0, RIGHT]]))
        path.append(env.focal_point.tolist())
        assert info["lives"].shape == (2,)
    assert path.count([[42, 42], [42, 42]]) == 1  # both restart once, in the step after their eighth
    env.close()


def test_a_pool_that_hands_out_parts_of_its_environments_is_refused():
    envpool = pytest.importorskip("envpool")
    pool = envpool.make_gymnasium("Pong-v5", num_envs=3, batch_size=2, stack_num=1)
    env = foajax.FoveatedVectorObservation(pool, "constant70_packed")
    with pytest.raises(ConfigError, match="^observation=. environments: accepted is all 3 .*batch_size=num_envs"):
        env.reset()
        env.step(env.action_space.sample())
    env.close()


def test_frames_stacked_by_gymnasium():
    env = foajax.FoveatedObservation(FrameStackObservation(Noise(), 3), FULL, GAZE)
    env.reset(seed=0)
    frames = []
    for _ in range(3):
        observation, *_ = env.step({"natural": 0, "vision": UP})
        frames.append(env.unwrapped.drawn)
    np.testing.assert_allclose(observation["image"], crop(np.stack(frames, -1), 3, 10) / 255, rtol=1e-6)
