"""foajax.sensors.frames against loops in NumPy, hand-computed values and a recorded screen."""

from __future__ import annotations

import hashlib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from foajax.sensors import frames
from foajax.types import FrameStatistics

# Of the 2x2 sums (little-endian uint16, row by row) of tests/data/breakout_screen.npz from row 34 on.
BREAKOUT_SHA256 = "1e3ab84aad2829db58e11fd742f4eccaac1195e26e0b89b7a455f4342762b5d1"


@pytest.fixture(params=[False, True], ids=["plain", "jit"])
def maybe_jit(request):
    return jax.jit if request.param else lambda function, **_: function


def random_screens(count: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (count, 210, 160), dtype=np.uint8)


def sums_by_loop(screen: np.ndarray, crop_top: int) -> np.ndarray:
    sums = np.zeros((80, 80), np.uint16)
    for y in range(80):
        for x in range(80):
            for dy in range(2):
                for dx in range(2):
                    sums[y, x] += screen[crop_top + 2 * y + dy, 2 * x + dx]
    return sums


@pytest.mark.parametrize("crop_top", [0, 20, 34, 50])
def test_crop_and_halve_is_the_exact_mean(maybe_jit, crop_top):
    screen = random_screens(1)[0]
    frame = maybe_jit(lambda s: frames.crop_and_halve(s, crop_top))(jnp.asarray(screen))
    assert frame.shape == (80, 80) and frame.dtype == jnp.float32
    sums = sums_by_loop(screen, crop_top)
    np.testing.assert_array_equal(np.round(1020 * np.asarray(frame)), sums)
    np.testing.assert_allclose(frame, sums / 4 / 255, rtol=2e-7)


def test_crop_and_halve_spans_zero_to_one():
    assert np.all(frames.crop_and_halve(jnp.zeros((210, 160), jnp.uint8), 34) == 0)
    assert np.all(frames.crop_and_halve(jnp.full((210, 160), 255, jnp.uint8), 34) == 1)


def test_crop_and_halve_keeps_the_conventions():
    """Rows first; row 34 and column 0 fall into pixel (0, 0), row 193 and column 159 into (79, 79)."""
    screen = np.zeros((210, 160), np.uint8)
    screen[33], screen[194] = 255, 255  # just outside
    screen[34, 0], screen[36, 159], screen[193, 159] = 204, 102, 51
    frame = np.asarray(frames.crop_and_halve(jnp.asarray(screen), 34))
    expected = np.zeros((80, 80))
    expected[0, 0], expected[1, 79], expected[79, 79] = 0.2, 0.1, 0.05
    np.testing.assert_allclose(frame, expected, atol=1e-7)


def test_crop_and_halve_maps_over_a_batch():
    screens = random_screens(3)
    batch = jax.jit(jax.vmap(lambda s: frames.crop_and_halve(s, 34)))(screens)
    for screen, frame in zip(screens, batch, strict=True):
        np.testing.assert_array_equal(frame, frames.crop_and_halve(jnp.asarray(screen), 34))


@pytest.mark.parametrize("crop_top", [-1, 51])
def test_crop_outside_the_screen_is_refused(crop_top):
    with pytest.raises(ValueError, match=rf"crop_top={crop_top}: accepted is a row from 0 to 50"):
        frames.crop_and_halve(jnp.zeros((210, 160), jnp.uint8), crop_top)


def test_recorded_screen_gives_the_recorded_frame(maybe_jit):
    screen = np.load(Path(__file__).parents[1] / "data" / "breakout_screen.npz")["screen"]
    frame = maybe_jit(lambda s: frames.to_frame(s, 34))(jnp.asarray(screen))
    sums = np.round(1020 * np.asarray(frame)).astype("<u2")
    assert hashlib.sha256(sums.tobytes()).hexdigest() == BREAKOUT_SHA256


def test_to_frame_without_a_crop_only_rescales():
    screen = np.arange(256, dtype=np.uint8).reshape(8, 32)
    frame = frames.to_frame(jnp.asarray(screen), None)
    np.testing.assert_allclose(frame, screen / 255.0, rtol=2e-7)
    assert frame.min() == 0 and frame.max() == 1


def test_frame_statistics_match_a_loop_and_a_constant(maybe_jit):
    values = np.random.default_rng(1).random((5, 7), np.float32)
    mean = sum(float(v) for v in values.flat) / 35
    variance = sum((float(v) - mean) ** 2 for v in values.flat) / 35
    got = maybe_jit(frames.frame_statistics)(jnp.asarray(values))
    np.testing.assert_allclose(got, (mean, variance**0.5), rtol=1e-6)
    got = maybe_jit(frames.frame_statistics)(jnp.asarray([[0.0, 1.0], [1.0, 0.0]]))
    np.testing.assert_array_equal(got, (0.5, 0.5))


def frame_by_frame(values: np.ndarray) -> tuple[float, float]:
    """The recursion of one running value and its weight, in double precision."""
    running = weight = 0.0
    for value in values:
        running = frames.DECAY * running + (1 - frames.DECAY) * float(value)
        weight = frames.DECAY * weight + (1 - frames.DECAY)
    return running, weight


def test_single_frames_follow_the_recursion(maybe_jit):
    mean, std = np.random.default_rng(2).random((2, 50), np.float32)
    update = maybe_jit(frames.update_statistics)
    statistics = frames.initial_statistics()
    for m, s in zip(mean, std, strict=True):
        statistics = update(statistics, jnp.asarray(m), jnp.asarray(s), 1)
    np.testing.assert_allclose((statistics.mean, statistics.weight), frame_by_frame(mean), rtol=1e-5)
    np.testing.assert_allclose((statistics.std, statistics.weight), frame_by_frame(std), rtol=1e-5)


def test_a_batch_of_equal_frames_is_as_many_updates(maybe_jit):
    update = maybe_jit(frames.update_statistics)
    start = FrameStatistics(mean=jnp.float32(0.2), std=jnp.float32(0.1), weight=jnp.float32(0.5))
    at_once = update(start, *jnp.array([0.3, 0.4]), 640)
    one_by_one = start
    for _ in range(640):
        one_by_one = update(one_by_one, *jnp.array([0.3, 0.4]), 1)
    np.testing.assert_allclose(np.asarray(at_once), np.asarray(one_by_one), rtol=1e-4)
    np.testing.assert_allclose(at_once.weight, 1 - 0.5 * frames.DECAY**640, rtol=1e-6)


def test_corrected_statistics_of_the_first_batch_are_its_average(maybe_jit):
    statistics = maybe_jit(frames.update_statistics)(frames.initial_statistics(), *jnp.array([0.3, 0.2]), 3)
    np.testing.assert_allclose(statistics.mean / statistics.weight, 0.3, rtol=1e-6)
    np.testing.assert_allclose(statistics.std / statistics.weight, 0.2, rtol=1e-6)


def test_no_frames_leave_no_trace(maybe_jit):
    update = maybe_jit(frames.update_statistics)
    start = update(frames.initial_statistics(), *jnp.array([0.4, 0.2]), 1)
    np.testing.assert_array_equal(np.asarray(update(start, *jnp.array([0.1, 0.7]), 0)), np.asarray(start))


def test_by_pixel_what_never_changes_becomes_zero_and_the_rest_has_unit_deviation(maybe_jit):
    rng = np.random.default_rng(5)
    screens = np.tile(rng.random((8, 8), np.float32), (500, 1, 1))
    moving = np.zeros((8, 8), bool)
    moving[2:4, 3:7] = True
    screens[:, moving] = rng.random((500, 8), np.float32)
    see = maybe_jit(lambda s, f: frames.update_statistics(s, *frames.pixel_statistics(f, s), 1))
    statistics = frames.initial_statistics((8, 8))
    for screen in screens:
        statistics = see(statistics, jnp.asarray(screen))
    np.testing.assert_allclose(statistics.weight, 1 - frames.PIXEL_DECAY**500, rtol=1e-5)
    np.testing.assert_allclose(statistics.mean / statistics.weight, screens.mean(0), rtol=1e-2)
    got = jnp.stack([frames.normalise(jnp.asarray(s), statistics, mode="pixel") for s in screens[::10]])
    np.testing.assert_allclose(got[:, ~moving], 0.0, atol=1e-3)
    np.testing.assert_allclose(np.std(got), 1.0, atol=0.1)


def test_running_normalisation_divides_by_the_weight(maybe_jit):
    statistics = FrameStatistics(mean=jnp.float32(0.05), std=jnp.float32(0.02), weight=jnp.float32(0.1))
    frame = jnp.asarray([[0.5, 0.7], [0.1, 0.5]])
    got = maybe_jit(lambda f, s: frames.normalise(f, s, mode="running"))(frame, statistics)
    np.testing.assert_allclose(got, [[0.0, 1.0], [-2.0, 0.0]], atol=1e-5)


def test_frame_normalisation_gives_mean_zero_and_deviation_one(maybe_jit):
    frame = jnp.asarray(np.random.default_rng(3).random((80, 80), np.float32))
    statistics = FrameStatistics(mean=jnp.float32(9.0), std=jnp.float32(9.0), weight=jnp.float32(1.0))
    got = maybe_jit(lambda f, s: frames.normalise(f, s, mode="frame"))(frame, statistics)
    np.testing.assert_allclose((np.mean(got), np.std(got)), (0.0, 1.0), atol=1e-5)


@pytest.mark.parametrize(("mode", "mean_shape"), [("running", ()), ("pixel", (8, 8))])
def test_normalisation_of_the_very_first_frame_uses_its_own_statistics(maybe_jit, mode, mean_shape):
    frame = jnp.asarray(np.random.default_rng(4).random((8, 8), np.float32))
    start = frames.initial_statistics(mean_shape)
    running = maybe_jit(lambda f, s: frames.normalise(f, s, mode=mode))(frame, start)
    own = maybe_jit(lambda f, s: frames.normalise(f, s, mode="frame"))(frame, start)
    np.testing.assert_array_equal(running, own)


@pytest.mark.parametrize("mode", ["running", "frame"])
def test_a_black_frame_stays_finite(mode):
    got = frames.normalise(jnp.zeros((8, 8)), frames.initial_statistics(), mode=mode)
    np.testing.assert_array_equal(got, np.zeros((8, 8)))


@pytest.mark.parametrize("mode", ["running", "pixel", "frame"])
def test_frames_of_one_gray_are_not_blown_up_by_rounding_errors(mode):
    """The mean of equal values is off by a rounding error, and so is their deviation."""
    for gray in range(256):
        frame = frames.to_frame(jnp.full((80, 80), gray, jnp.uint8), None)
        seen = frames.update_statistics(
            frames.initial_statistics((80, 80) if mode == "pixel" else ()), *frames.frame_statistics(frame), 64
        )
        np.testing.assert_allclose(frames.normalise(frame, seen, mode=mode), 0.0, atol=1e-3)


def test_without_normalisation_the_frame_stays_as_it_is():
    frame = jnp.asarray([[0.25, 1.0]])
    np.testing.assert_array_equal(frames.normalise(frame, frames.initial_statistics(), mode="none"), frame)
