"""The log-polar retina: its geometry by hand, its tables against loops, its pictures against OpenCV."""

from __future__ import annotations

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from foajax import logpolar
from foajax.config import LogPolarSensor
from foajax.foveation import picture, ring_boxes, sense

SENSORS = {
    f"{name}-{sampling}": LogPolarSensor(**fields, sampling=sampling)
    for name, fields in {
        "default": {},
        "small": {"rings": 6, "wedges": 8, "fovea": 2.0, "radius": 9.5},
        "fine": {"rings": 40, "wedges": 64, "fovea": 1.0, "radius": 12.0},
    }.items()
    for sampling in ("area", "bilinear")
}


@functools.cache
def batched(sensor):
    return jax.jit(jax.vmap(functools.partial(sense, sensor=sensor)))


def frames_and_points(count=4, shape=(80, 80)):
    """Noise, seen from the centre, from near a border and from two corners."""
    frames = np.random.default_rng(0).normal(size=(count, *shape)).astype(np.float32)
    return jnp.asarray(frames), jnp.array([(40, 40), (50, 3), (0, 79), (79, 0)][:count])


def smooth_frame(shape=(80, 80)):
    """Waves of 25 pixels and more, values within [-1, 1]: close to linear between two pixels."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    return (np.sin(y / 4 + x / 9) * np.cos(x / 5 - 1)).astype(np.float32)


def cell_at(sensor, dy, dx):
    """(ring, wedge) of a place relative to the focal point, None outside."""
    radius, angle = math.hypot(dy, dx), math.atan2(dy, dx) % (2 * math.pi)
    edges = logpolar.ring_edges(sensor)
    inside = [ring for ring in range(sensor.rings) if edges[ring] <= radius < edges[ring + 1]]
    return (inside[0], int(angle / (2 * math.pi) * sensor.wedges)) if inside else None


def test_the_geometry_by_hand():
    sensor = LogPolarSensor(rings=4, wedges=8, fovea=1.0, radius=8.0)
    np.testing.assert_allclose(logpolar.ring_edges(sensor), [0, 1, 2, 4, 8])
    assert ring_boxes((40, 40), sensor) == [(32, 32, 16, 16)]
    # One bright pixel, its centre at (0.5, 3.5) right of the focal point: the third ring's first wedge,
    # which begins at the x axis and turns downwards.
    frame = jnp.zeros((80, 80)).at[40, 43].set(1.0)
    (image,) = sense(frame, jnp.array([40, 40]), sensor=sensor)
    assert np.unravel_index(np.argmax(image), image.shape) == (2, 0, 0)
    frame = jnp.zeros((80, 80)).at[43, 39].set(1.0)  # below, a little to the left
    (image,) = sense(frame, jnp.array([40, 40]), sensor=sensor)
    assert np.unravel_index(np.argmax(image), image.shape) == (2, 2, 0)


@pytest.mark.parametrize("name", SENSORS)
def test_a_uniform_frame_looks_uniform(name):
    (image,) = batched(SENSORS[name])(jnp.full((1, 80, 80), 3.5), jnp.array([(40, 40)]))
    assert image.shape == (1, SENSORS[name].rings, SENSORS[name].wedges, 1)
    np.testing.assert_allclose(image, 3.5, rtol=1e-5)


@pytest.mark.parametrize("name", ["default-area", "small-area"])
def test_area_is_the_mean_over_the_cell(name):
    """Against a fine Cartesian grid of points, sorted into cells one by one."""
    sensor, fine = SENSORS[name], 6
    frames, points = frames_and_points(1 if name == "default-area" else 3)
    (images,) = batched(sensor)(frames, points)
    reach = math.ceil(sensor.radius)
    offsets = (np.arange(-reach * fine, reach * fine) + 0.5) / fine
    for frame, point, image in zip(np.asarray(frames), np.asarray(points), images, strict=True):
        total, count = np.zeros(image.shape[:2]), np.zeros(image.shape[:2])
        for dy in offsets:
            for dx in offsets:
                cell = cell_at(sensor, dy, dx)
                if cell is not None:
                    y, x = math.floor(point[0] + dy), math.floor(point[1] + dx)
                    total[cell] += frame[y, x] if 0 <= y < 80 and 0 <= x < 80 else 0.0
                    count[cell] += 1
        large = count > 8 * fine**2  # cells of eight pixels and more, which the grid measures well
        assert large.sum() > 8
        np.testing.assert_allclose(image[..., 0][large], (total / np.maximum(count, 1))[large], atol=0.06)


@pytest.mark.parametrize("name", [name for name in SENSORS if name.endswith("bilinear")])
def test_bilinear_matches_a_loop(name):
    sensor = SENSORS[name]
    frames, points = frames_and_points()
    (images,) = batched(sensor)(frames, points)
    edges, half = logpolar.ring_edges(sensor), sensor.window[0] // 2
    for frame, point, image in zip(np.asarray(frames), np.asarray(points), images, strict=True):

        def pixel(y, x, frame=frame, point=point):
            # The window's last pixels stand in for those half a pixel beyond.
            y, x = (min(max(p, c - half), c + half - 1) for p, c in zip((y, x), point, strict=True))
            return frame[y, x] if 0 <= y < 80 and 0 <= x < 80 else 0.0

        for ring, wedge in np.ndindex(image.shape[:2]):
            radius = math.sqrt(edges[ring] * edges[ring + 1]) if ring else edges[1] / 2
            angle = 2 * math.pi * (wedge + 0.5) / sensor.wedges
            y, x = point[0] - 0.5 + radius * math.sin(angle), point[1] - 0.5 + radius * math.cos(angle)
            top, left = math.floor(y), math.floor(x)
            a, b = y - top, x - left
            wanted = (1 - a) * ((1 - b) * pixel(top, left) + b * pixel(top, left + 1))
            wanted += a * ((1 - b) * pixel(top + 1, left) + b * pixel(top + 1, left + 1))
            assert image[ring, wedge, 0] == pytest.approx(wanted, abs=1e-4)


@pytest.mark.parametrize("sampling", ["area", "bilinear"])
def test_warp_matches_opencv(sampling):
    """`cv2.warpPolar(..., WARP_POLAR_LOG)`, whose column c is the radius R^(c / columns), row r the angle 2 pi r / rows.

    With fovea = 1 and two columns a ring, the centre of ring i falls on column 2i - 1; with two rows a
    wedge, the centre of wedge j falls on row 2j + 1. The innermost ring has no counterpart: OpenCV has a
    blind spot there. OpenCV rounds positions to 1/32 pixel: on waves with slopes up to 0.5 a pixel, values
    are within 0.02. An area's mean differs from its centre's value by curvature, up to 0.12 where cells
    are 3 pixels wide.
    """
    cv2 = pytest.importorskip("cv2")
    sensor = LogPolarSensor(rings=41, wedges=60, fovea=1.0, radius=30.0, sampling=sampling)
    frame = smooth_frame()
    for y, x in ((40, 40), (45, 33)):
        (image,) = sense(jnp.asarray(frame), jnp.array([y, x]), sensor=sensor)
        size = (2 * (sensor.rings - 1), 2 * sensor.wedges)
        flags = cv2.WARP_POLAR_LOG | cv2.INTER_LINEAR
        polar = cv2.warpPolar(frame, size, (x - 0.5, y - 0.5), sensor.radius, flags)
        wanted = polar[1::2, 1::2].T  # [rings - 1, wedges]
        error = np.abs(image[1:, :, 0] - wanted)
        assert error.max() < (0.02 if sampling == "bilinear" else 0.12)
        assert error.mean() < (0.005 if sampling == "bilinear" else 0.02)


def test_unwarp_matches_opencv():
    """OpenCV's inverse interpolates between cells, ours shows the nearest: within a cell's width of a smooth image."""
    cv2 = pytest.importorskip("cv2")
    sensor = LogPolarSensor(rings=121, wedges=240, fovea=1.0, radius=30.0)
    ring, wedge = np.mgrid[:120, :240]
    polar = (np.sin(ring / 20) * np.cos(2 * np.pi * wedge / 240)).astype(np.float32)
    flags = cv2.WARP_POLAR_LOG | cv2.WARP_INVERSE_MAP | cv2.INTER_LINEAR
    theirs = cv2.warpPolar(np.ascontiguousarray(polar.T), (60, 60), (29.5, 29.5), sensor.radius, flags)
    ours = logpolar.unwarp(jnp.concatenate([jnp.zeros((1, 240)), jnp.asarray(polar)]), sensor=sensor)
    y, x = np.mgrid[:60, :60] - 29.5
    radius = np.hypot(y, x)
    compared = (radius > 2) & (radius < 29)
    np.testing.assert_allclose(ours[compared], theirs[compared], atol=0.1)
    np.testing.assert_array_equal(ours[radius > 30], 0)


def test_unwarp_matches_a_loop():
    sensor = SENSORS["small-area"]
    image = jnp.arange(1.0, 49.0).reshape(6, 8)
    window = logpolar.unwarp(image, sensor=sensor)
    assert window.shape == sensor.window
    for y, x in np.ndindex(window.shape):
        cell = cell_at(sensor, y + 0.5 - 10, x + 0.5 - 10)
        assert window[y, x] == (0.0 if cell is None else image[cell])


def test_a_picture_puts_the_retina_back_in_its_place():
    sensor, frame = SENSORS["fine-area"], jnp.asarray(smooth_frame((60, 70)))
    for y, x in ((30, 30), (2, 68)):
        images = sense(frame, jnp.array([y, x]), sensor=sensor)
        shown = picture(images, jnp.array([y, x]), sensor=sensor, frame_shape=(60, 70))
        assert shown.shape == (60, 70, 1)
        rows, columns = np.mgrid[:60, :70] + 0.5
        radius = np.hypot(rows - y, columns - x)
        np.testing.assert_array_equal(shown[..., 0][radius >= 12], 0)
        # Near the frame's border a cell takes in zeros from outside; well inside it shows the frame.
        inside = (radius < 11) & (rows > 2) & (columns < 68)
        np.testing.assert_allclose(shown[..., 0][inside], frame[inside], atol=0.25)


def test_area_does_not_alias_where_bilinear_does():
    """A fine checkerboard is gray from afar: large cells must not see single squares."""
    board = jnp.asarray(np.indices((80, 80)).sum(0) % 2 * 2.0 - 1.0, jnp.float32)
    outer = {}
    for sampling in ("area", "bilinear"):
        (image,) = batched(SENSORS[f"default-{sampling}"])(board[None], jnp.array([(40, 40)]))
        outer[sampling] = np.abs(image[0, 25:]).mean()
    assert outer["area"] < 0.05 < 0.2 < outer["bilinear"]


def test_jit_vmap_and_neither_agree_and_colour_is_channel_by_channel():
    sensor = SENSORS["small-area"]
    frames, points = frames_and_points(3)
    (together,) = batched(sensor)(frames, points)
    for index in (0, 2):
        (alone,) = sense(frames[index], points[index], sensor=sensor)
        np.testing.assert_allclose(alone, together[index], atol=1e-6)
    (colour,) = sense(jnp.moveaxis(frames, 0, -1), points[1], sensor=sensor)
    for channel in range(3):
        (gray,) = batched(sensor)(frames[channel][None], points[1][None])
        np.testing.assert_allclose(colour[..., channel], gray[0, ..., 0], atol=1e-6)
    (bytes_seen,) = sense(jnp.full((80, 80), 200, jnp.uint8), points[0], sensor=sensor)
    np.testing.assert_allclose(bytes_seen, 200.0, rtol=1e-6)
