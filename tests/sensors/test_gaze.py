"""The focal point: moves, bounds, starts and scripts against a walk in plain Python."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from foajax.config.parse import ConfigError
from foajax.config.schema import GazeConfig, LogPolarSensor, RingSensor
from foajax.sensors import gaze
from foajax.sensors.registry import make_sensor

FRAME = (80, 90)
WINDOWS = [(70, 70), (71, 33), (80, 90), (1, 1)]
MOVES = {0: (0, 0), 1: (-1, 0), 2: (1, 0), 3: (0, -1), 4: (0, 1), 5: (-1, -1), 6: (-1, 1), 7: (1, -1), 8: (1, 1)}


def oracle_limits(bounds, window, frame_shape):
    """All coordinates, per axis, at which the area (or the point alone) lies in the frame."""
    allowed = []
    for length, size in zip(window, frame_shape, strict=True):
        span = range(size)
        if bounds == "window":
            span = [p for p in span if p - length // 2 >= 0 and p - length // 2 + length <= size]
        allowed.append((min(span), max(span)))
    return allowed


@pytest.mark.parametrize("bounds", ["window", "point"])
@pytest.mark.parametrize("window", WINDOWS)
def test_limits_are_where_the_area_fits(bounds, window):
    low, high = gaze.limits(gaze=GazeConfig(bounds=bounds), window=window, frame_shape=FRAME)
    assert list(zip(low.tolist(), high.tolist(), strict=True)) == oracle_limits(bounds, window, FRAME)


def test_limits_by_hand():
    low, high = gaze.limits(gaze=GazeConfig(), window=(70, 70), frame_shape=(80, 80))
    assert low.tolist() == [35, 35] and high.tolist() == [45, 45]


@pytest.mark.parametrize(
    "sensor", [RingSensor(((7, 9, 1), (20, 30, 2))), LogPolarSensor(rings=4, wedges=8, fovea=3.0, radius=14.0)]
)
def test_what_stays_inside_the_frame_is_the_area_or_its_finest_part(sensor):
    finest, whole = ((7, 9), (20, 30)) if isinstance(sensor, RingSensor) else ((6, 6), (28, 28))
    for each in (sensor, make_sensor(sensor)):
        assert gaze.bounded(GazeConfig(bounds="fovea"), each) == finest
        assert gaze.bounded(GazeConfig(bounds="window"), each) == whole


@pytest.mark.parametrize("bounds", ["window", "point"])
@pytest.mark.parametrize("actions", [5, 9])
def test_a_random_walk_matches_plain_python(bounds, actions):
    """Eight walks at once, from different points, until they have met all borders."""
    config, window = GazeConfig(actions=actions, step=7, bounds=bounds), (30, 20)
    rng = np.random.default_rng(actions)
    chosen = rng.integers(0, actions, (60, 8))
    points = np.stack([rng.integers(15, 66, 8), rng.integers(10, 81, 8)], 1)
    limits = oracle_limits(bounds, window, FRAME)
    move = functools.partial(gaze.move, gaze=config, window=window, frame_shape=FRAME)
    step = jax.jit(jax.vmap(move))
    now = jnp.asarray(points, jnp.int32)
    for actions_now in chosen:
        for row, action in enumerate(actions_now):
            for axis in (0, 1):
                moved = points[row, axis] + 7 * MOVES[int(action)][axis]
                points[row, axis] = min(max(moved, limits[axis][0]), limits[axis][1])
        now = step(now, jnp.asarray(actions_now))
        assert now.dtype == jnp.int32
        np.testing.assert_array_equal(now, points)
    alone = move(now[0], jnp.int32(1))
    np.testing.assert_array_equal(alone, step(now, jnp.ones(8, jnp.int32))[0])


def test_five_actions_by_hand():
    config = GazeConfig(step=4, bounds="point")
    moved = [
        gaze.move(jnp.array([40, 50]), jnp.int32(a), gaze=config, window=(70, 70), frame_shape=FRAME) for a in range(5)
    ]
    assert [p.tolist() for p in moved] == [[40, 50], [36, 50], [44, 50], [40, 46], [40, 54]]


@pytest.mark.parametrize(
    ("first", "bounds", "window", "frame_shape", "wanted"),
    [
        ("centre", "window", (70, 70), (80, 80), [40, 40]),
        ("centre", "window", (79, 81), (81, 81), [40, 40]),
        ("centre", "point", (70, 70), (31, 20), [15, 10]),
        ((3, 79), "window", (70, 70), (80, 80), [35, 45]),
        ((3, 79), "point", (70, 70), (80, 80), [3, 79]),
    ],
)
def test_a_given_start_is_kept_within_bounds(first, bounds, window, frame_shape, wanted):
    config = GazeConfig(start=first, bounds=bounds)
    point = gaze.start(jax.random.key(0), gaze=config, window=window, frame_shape=frame_shape)
    assert point.tolist() == wanted and point.dtype == jnp.int32


@pytest.mark.parametrize(("bounds", "count"), [("window", 4 * 3), ("point", 7 * 6)])
def test_a_random_start_is_uniform_within_bounds(bounds, count):
    config = GazeConfig(start="random", bounds=bounds)
    keys = jax.random.split(jax.random.key(1), 6000)
    begin = functools.partial(gaze.start, gaze=config, window=(4, 4), frame_shape=(7, 6))
    points = jax.jit(jax.vmap(begin))(keys)
    places, hits = np.unique(points, axis=0, return_counts=True)
    assert len(places) == count
    (top, bottom), (left, right) = oracle_limits(bounds, (4, 4), (7, 6))
    assert places.min(0).tolist() == [top, left] and places.max(0).tolist() == [bottom, right]
    mean = 6000 / count
    assert np.abs(hits - mean).max() < 5 * np.sqrt(mean)
    np.testing.assert_array_equal(begin(keys[3]), points[3])


def test_a_script_repeats_and_is_kept_within_bounds():
    config = GazeConfig(mode="scripted", path=((40, 40), (0, 42), (79, 79)))
    follow = functools.partial(gaze.scripted, gaze=config, window=(70, 70), frame_shape=(80, 80))
    points = jax.jit(jax.vmap(follow))(jnp.arange(7))
    wanted = [(40, 40), (35, 42), (45, 45)] * 3
    np.testing.assert_array_equal(points, wanted[:7])
    np.testing.assert_array_equal(follow(jnp.int32(4)), wanted[4])


def test_unit_coordinates_by_hand_and_back():
    units = gaze.to_unit(jnp.array([[0, 0], [40, 45], [20, 89]]), FRAME)
    np.testing.assert_allclose(units, [[-1, -1], [0, 0], [-0.5, 89 / 45 - 1]], atol=1e-6)
    np.testing.assert_array_equal(units[1], 0)
    points = jnp.asarray([(y, x) for y in range(80) for x in range(90)], jnp.int32)
    there = jax.vmap(functools.partial(gaze.to_unit, frame_shape=FRAME))(points)
    assert there.min() >= -1 and there.max() < 1
    np.testing.assert_array_equal(jax.jit(gaze.from_unit, static_argnums=1)(there, FRAME), points)
    np.testing.assert_array_equal(gaze.from_unit(jnp.array([1.0, -3.0]), FRAME), [79, 0])


def test_errors_name_the_key():
    with pytest.raises(ConfigError, match=r"gaze\.bounds=window: .*\(81, 20\)"):
        gaze.limits(gaze=GazeConfig(), window=(81, 20), frame_shape=FRAME)
    with pytest.raises(ConfigError, match=r"gaze\.path=\[\]: accepted is at least one"):
        gaze.scripted(jnp.int32(0), gaze=GazeConfig(), window=(1, 1), frame_shape=FRAME)


def test_several_step_sizes_are_every_direction_in_every_size():
    config, window = GazeConfig(step=(4, 16), actions=9, bounds="point"), (30, 20)
    assert config.num_actions == 17 and len(gaze.names(config)) == 17
    assert gaze.names(config)[:3] == ("stay", "up 4", "down 4") and gaze.names(config)[16] == "down right 16"
    for action in range(17):
        size, direction = (0, 0) if action == 0 else ((4, 16)[(action - 1) // 8], (action - 1) % 8 + 1)
        wanted = [40 + size * MOVES[direction][0], 50 + size * MOVES[direction][1]]
        moved = gaze.move(jnp.array([40, 50]), jnp.int32(action), gaze=config, window=window, frame_shape=FRAME)
        assert moved.tolist() == wanted
    assert gaze.names(GazeConfig()) == ("stay", "up", "down", "left", "right")


@pytest.mark.parametrize("bounds", ["window", "point"])
def test_an_absolute_move_looks_at_a_cells_centre_wherever_the_gaze_was(bounds):
    config, window = GazeConfig(moves="absolute", grid=(3, 7), bounds=bounds), (30, 20)
    assert config.num_actions == 21
    assert gaze.names(config)[8] == "row 2, column 2"
    limits = oracle_limits(bounds, window, FRAME)
    for action in range(21):
        row, column = action // 7, action % 7
        wanted = [int((row + 0.5) * 80 / 3), int((column + 0.5) * 90 / 7)]
        wanted = [min(max(p, low), high) for p, (low, high) in zip(wanted, limits, strict=True)]
        for point in ([0, 0], [79, 3]):
            moved = gaze.move(jnp.array(point), jnp.int32(action), gaze=config, window=window, frame_shape=FRAME)
            assert moved.tolist() == wanted and moved.dtype == jnp.int32


@pytest.mark.parametrize("cost_per", ["pixel", "saccade"])
def test_a_price_is_by_the_distance_or_by_the_move(cost_per):
    config = GazeConfig(cost=0.25, cost_per=cost_per)
    for before, after in (((3, 4), (3, 4)), ((3, 4), (0, 0)), ((10, 10), (10, 11))):
        distance = np.hypot(after[0] - before[0], after[1] - before[1])
        wanted = 0.25 * (distance if cost_per == "pixel" else float(distance > 0))
        price = jax.jit(functools.partial(gaze.price, gaze=config))(jnp.array(before), jnp.array(after))
        np.testing.assert_allclose(price, wanted, rtol=1e-6)


def test_keys_of_moves_name_what_is_accepted():
    for wrong in ({"step": ()}, {"step": (16, 4)}, {"step": (0, 4)}):
        with pytest.raises(ConfigError, match=r"gaze\.step=.*: accepted is an integer .* or a rising list"):
            GazeConfig(**wrong)
    with pytest.raises(ConfigError, match=r"gaze\.grid=\[0, 4\]: accepted is"):
        GazeConfig(grid=(0, 4))
    with pytest.raises(ConfigError, match=r"gaze\.cost=-1\.0: accepted is a number >= 0"):
        GazeConfig(cost=-1.0)
