"""Other libraries' view of the sensors: spaces, timing of the gaze, restarts, and errors in one line."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import Autoreset

from foajax.config.parse import ConfigError
from foajax.config.schema import GazeConfig, LogPolarSensor, RingSensor
from foajax.sensors.wrappers import FoveatedObservation, FoveatedVectorObservation

FULL = RingSensor(rings=((6, 6, 1),), layout="packed")
NESTED = RingSensor(rings=((4, 4, 1), (8, 8, 2)), layout="packed")
GAZE = GazeConfig(step=2)
STAY, UP, DOWN, LEFT, RIGHT = range(5)


class Noise(gymnasium.Env):
    """Frames of noise, drawn anew each step; an episode lasts `length` steps."""

    metadata = {"render_modes": []}

    def __init__(self, shape=(16, 20), dtype=np.uint8, length=3):
        high = 255 if dtype == np.uint8 else 1
        self.observation_space = spaces.Box(0, high, shape, dtype)
        self.action_space = spaces.Discrete(3)
        self.length = length

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        return self.draw(), {}

    def step(self, action):
        self.time += 1
        return self.draw(), float(action), self.time >= self.length, False, {}

    def draw(self):
        noise = self.np_random.random(self.observation_space.shape)
        self.frame = (noise * self.observation_space.high).astype(self.observation_space.dtype)
        return self.frame


class OneKind(gymnasium.Env):
    """An environment of which only the spaces are looked at."""

    def __init__(self, observation_space):
        self.observation_space = observation_space
        self.action_space = spaces.Discrete(2)


def window(frame, y, x, size=6):
    """The oracle: a NumPy slice of a frame in [0, 1]."""
    return frame[y - size // 2 : y + size // 2, x - size // 2 : x + size // 2] / 255


@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version")
@pytest.mark.parametrize("start", ["centre", "random", (6, 7)])
@pytest.mark.parametrize("shape, dtype", [((16, 20), np.uint8), ((12, 9, 3), np.float32), ((9, 9, 1), np.float64)])
def test_gymnasium_accepts_it(shape, dtype, start):
    gaze = GazeConfig(actions=9, step=1, start=start)
    check_env(FoveatedObservation(Noise(shape, dtype), NESTED, gaze), skip_render_check=True)


def test_the_spaces():
    env = FoveatedObservation(Noise((16, 20, 3)), NESTED, GazeConfig(actions=9))
    assert env.action_space == spaces.Dict({"natural": spaces.Discrete(3), "vision": spaces.Discrete(9)})
    assert set(env.observation_space) == {"image_0", "image_1", "focal_point"}
    assert env.observation_space["image_0"] == spaces.Box(0.0, 1.0, (4, 4, 3), np.float32)
    assert env.observation_space["image_1"] == spaces.Box(0.0, 1.0, (4, 4, 3), np.float32)
    assert env.observation_space["focal_point"] == spaces.Box(-1.0, 1.0, (2,), np.float32)
    assert set(FoveatedObservation(Noise(), FULL).observation_space) == {"image", "focal_point"}


def test_the_gaze_moves_before_the_next_frame_is_sensed():
    env = FoveatedObservation(Noise(length=99), FULL, GAZE)
    observation, _ = env.reset(seed=3)
    y, x = 8, 10
    np.testing.assert_allclose(observation["image"][..., 0], window(env.unwrapped.frame, y, x), rtol=1e-6)
    np.testing.assert_allclose(observation["focal_point"], [0, 0], atol=1e-6)
    for vision, (dy, dx) in ((UP, (-2, 0)), (RIGHT, (0, 2)), (STAY, (0, 0)), (DOWN, (2, 0)), (LEFT, (0, -2))):
        observation, reward, *_ = env.step({"natural": 2, "vision": vision})
        y, x = y + dy, x + dx
        assert env.focal_point.tolist() == [y, x]
        assert reward == 2.0
        np.testing.assert_allclose(observation["image"][..., 0], window(env.unwrapped.frame, y, x), rtol=1e-6)
        np.testing.assert_allclose(observation["focal_point"], [y / 8 - 1, x / 10 - 1], atol=1e-6)


def test_colours_are_kept_apart():
    env = FoveatedObservation(Noise((16, 20, 3)), FULL)
    observation, _ = env.reset(seed=0)
    np.testing.assert_allclose(observation["image"], window(env.unwrapped.frame, 8, 10), rtol=1e-6)


def test_an_episode_starts_where_the_gaze_says():
    env = FoveatedObservation(Noise(), FULL, GazeConfig(start=(5, 6)))
    env.reset(seed=0)
    env.step({"natural": 0, "vision": DOWN})
    assert env.focal_point.tolist() == [9, 6]
    env.reset()
    assert env.focal_point.tolist() == [5, 6]


def test_random_starts_come_from_the_seed():
    env = FoveatedObservation(Noise(), FULL, GazeConfig(start="random"))

    def starts(seed):
        env.reset(seed=seed)
        points = [env.focal_point.tolist()]
        for _ in range(5):
            env.reset()
            points.append(env.focal_point.tolist())
        return points

    first = starts(1)
    assert first == starts(1) != starts(2)
    assert len({tuple(point) for point in first}) > 2
    assert all(3 <= y <= 13 and 3 <= x <= 17 for y, x in first)


def test_a_sensor_by_the_name_of_its_experiment():
    env = FoveatedObservation(Noise((84, 96)), "constant70_packed")
    assert env.observation_space["image"].shape == (35, 35, 1)
    assert FoveatedObservation(Noise((80, 80)), "nonfoa").observation_space["image"].shape == (80, 80, 1)


def test_what_a_uint8_grid_rounds_to_stays_in_the_space():
    env = FoveatedObservation(Noise((15, 15)), RingSensor(rings=((6, 6, 1),), peripheral=(5, 5), layout="packed"))
    env.unwrapped.draw = lambda: np.full((15, 15), 255, np.uint8)
    observation, _ = env.reset()
    assert observation in env.observation_space
    assert observation["image_1"].max() == pytest.approx(1)


@pytest.mark.parametrize(
    "space",
    [
        spaces.Discrete(5),
        spaces.Box(0, 1, (4,)),
        spaces.Box(0, 255, (84, 84, 84), np.uint8),
        spaces.Box(0, 9, (7, 7, 3)),
    ],
)
def test_what_shows_no_pixels_is_refused(space):
    with pytest.raises(ConfigError, match="^observation_space=.*accepted is a Box of unsigned integers or floats, .*$"):
        FoveatedObservation(OneKind(space), FULL)


@pytest.mark.parametrize(
    "sensor, gaze, message",
    [
        (RingSensor(rings=((18, 18, 2),)), None, r"sensor\.rings=\[18, 18\].*16x20"),
        (RingSensor(rings=((18, 18, 2),), peripheral=(5, 5)), None, r"sensor\.rings=\[18, 18\].*16x20"),
        ("constant70", None, r"sensor\.rings=\[70, 70\].*16x20"),
        ("constant71", None, "experiment=constant71.*constant70"),
        (FULL, GazeConfig(start=(16, 3)), r"gaze\.start.*\[16, 3\].*16x20"),
        (LogPolarSensor(fovea=9, radius=20), GazeConfig(bounds="fovea"), r"gaze\.bounds=fovea.*\[18, 18\].*16x20"),
        (FULL, GazeConfig(mode="frozen"), "gaze.mode=frozen.*learned"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(sensor, gaze, message):
    with pytest.raises(ConfigError, match=message) as error:
        FoveatedObservation(Noise(), sensor, gaze)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("action", [5, -1, 3.0, [3]])
def test_what_is_no_visual_action_is_refused_before_the_step(action):
    single, vector = FoveatedObservation(Noise(), FULL, GAZE), make_vector()
    single.reset(seed=0)
    vector.reset(seed=0)
    with pytest.raises(ValueError, match=r"^vision=.*: accepted is an integer from 0 to 4$"):
        single.step({"natural": 0, "vision": action})
    with pytest.raises(ValueError, match=r"^vision=.*: accepted is integers \[2\] from 0 to 4$"):
        vector.step({"natural": np.zeros(2, int), "vision": [action, action]})
    assert single.unwrapped.time == 0


def test_an_environment_that_restarts_by_itself_restarts_the_gaze():
    env = FoveatedObservation(Autoreset(Noise(length=2)), FULL, GAZE)
    env.reset(seed=0)
    places = [env.focal_point]
    for _ in range(4):
        env.step({"natural": 0, "vision": RIGHT})
        places.append(env.focal_point)
    np.testing.assert_array_equal(np.stack(places) - [8, 10], [[0, 0], [0, 2], [0, 4], [0, 0], [0, 2]])


def make_vector(lengths=(3, 5), gaze=GAZE, **options):
    makers = [lambda n=n: Noise(length=n) for n in lengths]
    return FoveatedVectorObservation(SyncVectorEnv(makers, **options), FULL, gaze)


def test_the_vector_restarts_each_gaze_with_its_episode():
    env = make_vector()
    observation, _ = env.reset(seed=0)
    assert observation in env.observation_space
    path = []
    for _ in range(6):
        action = {"natural": np.array([0, 1]), "vision": np.array([UP, RIGHT])}
        assert action in env.action_space
        observation, reward, *_ = env.step(action)
        path.append(env.focal_point.tolist())
        for i, inner in enumerate(env.env.envs):
            expected = window(inner.frame, *path[-1][i])
            np.testing.assert_allclose(observation["image"][i, ..., 0], expected, rtol=1e-6)
    # The first episode ends at step 3 and the second at 5: the step after is a restart and moves nothing.
    # Columns end at 17, where the 6x6 window meets the border.
    assert [first for first, _ in path] == [[6, 10], [4, 10], [3, 10], [8, 10], [6, 10], [4, 10]]
    assert [second for _, second in path] == [[8, 12], [8, 14], [8, 16], [8, 17], [8, 17], [8, 10]]


def test_the_vector_does_what_single_environments_do():
    vector, singles = (
        make_vector((9, 9)),
        [FoveatedObservation(Noise(length=9), FULL, GAZE) for _ in range(2)],
    )
    together = vector.reset(seed=[4, 7])[0]
    alone = [single.reset(seed=seed)[0] for single, seed in zip(singles, (4, 7), strict=True)]
    for vision in ((UP, LEFT), (DOWN, DOWN), (RIGHT, STAY)):
        for name in together:
            np.testing.assert_array_equal(together[name], np.stack([one[name] for one in alone]))
        together = vector.step({"natural": np.zeros(2, int), "vision": np.array(vision)})[0]
        alone = [single.step({"natural": 0, "vision": v})[0] for single, v in zip(singles, vision, strict=True)]


def test_the_vector_restarts_only_what_is_asked_for():
    env = make_vector((2, 9), autoreset_mode=AutoresetMode.DISABLED)
    env.reset(seed=0)
    for _ in range(2):
        env.step({"natural": np.zeros(2, int), "vision": np.array([UP, LEFT])})
    env.reset(options={"reset_mask": np.array([True, False])})
    assert env.focal_point.tolist() == [[8, 10], [8, 6]]
    env.step({"natural": np.zeros(2, int), "vision": np.array([UP, LEFT])})
    assert env.focal_point.tolist() == [[6, 10], [8, 4]]


def test_random_starts_of_the_vector_differ_and_come_from_the_seed():
    env = make_vector((3, 3, 3), GazeConfig(start="random"))
    env.reset(seed=5)
    first = env.focal_point.tolist()
    env.reset(seed=6)
    other = env.focal_point.tolist()
    env.reset(seed=5)
    assert env.focal_point.tolist() == first != other
    assert len({tuple(point) for point in first}) > 1


def test_a_list_of_no_seeds_leaves_the_random_starts_as_they_go_on():
    env, starts = make_vector((3, 3), GazeConfig(start="random")), []
    for seed in (None, [None, None]):
        env.reset(seed=5)
        env.reset(seed=seed)
        starts.append(env.focal_point.tolist())
    assert starts[0] == starts[1]


def test_a_policy_of_another_library_can_find_what_is_off_the_window():
    """A tabular learner finds the gaze's way to a bright corner, from focal point and image alone."""

    class Corner(Noise):
        def draw(self):
            self.frame = np.zeros((16, 20), np.uint8)
            self.frame[:, 14:] = 255
            return self.frame

    env = FoveatedObservation(Corner(length=5), FULL, GazeConfig(step=4))
    random = np.random.default_rng(0)
    value = np.zeros(5)
    for _ in range(60):
        env.reset(seed=0)
        vision = int(random.integers(5)) if random.random() < 0.5 else int(value.argmax())
        total, over = 0.0, False
        while not over:
            observation, _, terminated, truncated, _ = env.step({"natural": 0, "vision": vision})
            total += float(observation["image"].mean())
            over = terminated or truncated
        value[vision] += 0.2 * (total - value[vision])
    assert value.argmax() == RIGHT


@pytest.mark.filterwarnings("ignore")
def test_an_atari_game():
    ale_py = pytest.importorskip("ale_py")
    gymnasium.register_envs(ale_py)
    env = FoveatedObservation(gymnasium.make("ALE/Breakout-v5", obs_type="rgb"), "constant70_packed")
    check_env(env, skip_render_check=True)
    observation, _ = env.reset(seed=0)
    assert observation["image"].shape == (35, 35, 3)
    env.close()
