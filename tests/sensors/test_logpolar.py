"""The log-polar retina: its geometry by hand, its tables against loops, its pictures against OpenCV."""

from __future__ import annotations

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from foajax.config.schema import LogPolarSensor
from foajax.sensors import logpolar
from foajax.sensors.base import boxes
from foajax.sensors.geometry import ring_edges
from foajax.sensors.registry import make_sensor
from foajax.sensors.sense import picture, sense

SENSORS = {
    f"{name}-{sampling}": LogPolarSensor(**fields, sampling=sampling)
    for name, fields in {
        "default": {},
        "small": {"rings": 6, "wedges": 8, "fovea": 2.0, "radius": 9.5},
        "coarse": {"rings": 5, "wedges": 7, "fovea": 3.0, "radius": 14.0},
        "fine": {"rings": 40, "wedges": 64, "fovea": 1.0, "radius": 12.0},
    }.items()
    for sampling in ("area", "bilinear")
}


@functools.cache
def batched(sensor):
    return jax.jit(jax.vmap(functools.partial(sense, sensor=sensor)))


def frames_and_points():
    """Noise, seen from the centre, from near a border and from two corners."""
    frames = np.random.default_rng(0).normal(size=(4, 80, 80)).astype(np.float32)
    return jnp.asarray(frames), jnp.array([(40, 40), (50, 3), (0, 79), (79, 0)])


def smooth_frame(shape=(80, 80)):
    """Waves of 25 pixels and more, values within [-1, 1]: close to linear between two pixels."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    return (np.sin(y / 4 + x / 9) * np.cos(x / 5 - 1)).astype(np.float32)


edges_of = functools.cache(ring_edges)


def cell_at(sensor, dy, dx):
    """(ring, wedge) of a place relative to the focal point, None outside."""
    radius, angle = math.hypot(dy, dx), math.atan2(dy, dx) % (2 * math.pi)
    edges = edges_of(sensor)
    inside = [ring for ring in range(sensor.rings) if edges[ring] <= radius < edges[ring + 1]]
    return (inside[0], int(angle / (2 * math.pi) * sensor.wedges)) if inside else None


def test_the_geometry_by_hand():
    sensor = LogPolarSensor(rings=4, wedges=8, fovea=1.0, radius=8.0)
    np.testing.assert_allclose(ring_edges(sensor), [0, 1, 2, 4, 8])
    assert boxes(make_sensor(sensor), (40, 40)) == [(32, 32, 16, 16)]
    # One bright pixel, its centre at (0.5, 3.5) right of the focal point: the third ring's first wedge,
    # which begins at the x axis and turns downwards.
    frames = np.zeros((2, 80, 80), np.float32)
    frames[0, 40, 43] = 1.0
    frames[1, 43, 39] = 1.0  # below, a little to the left: the third wedge
    (images,) = batched(sensor)(jnp.asarray(frames), jnp.array([(40, 40)] * 2))
    assert np.unravel_index(np.argmax(images[0]), images.shape[1:]) == (2, 0, 0)
    assert np.unravel_index(np.argmax(images[1]), images.shape[1:]) == (2, 2, 0)


@pytest.mark.parametrize("name", SENSORS)
def test_a_uniform_frame_looks_uniform(name):
    (image,) = batched(SENSORS[name])(jnp.full((4, 80, 80), 3.5), jnp.full((4, 2), 40))
    assert image.shape == (4, SENSORS[name].rings, SENSORS[name].wedges, 1)
    np.testing.assert_allclose(image, 3.5, rtol=1e-5)


@pytest.mark.parametrize("name", ["small-area", "coarse-area"])
def test_area_is_the_mean_over_the_cell(name):
    """Against a fine Cartesian grid of points, sorted into cells one by one."""
    sensor, fine = SENSORS[name], 10
    frames, points = frames_and_points()
    (images,) = batched(sensor)(frames, points)
    points, reach = np.asarray(points), math.ceil(sensor.radius)
    offsets = (np.arange(-reach * fine, reach * fine) + 0.5) / fine
    total, count = np.zeros((len(points), *images.shape[1:3])), np.zeros(images.shape[1:3])
    padded = np.pad(frames, ((0, 0), (reach, reach), (reach, reach)))
    for dy in offsets:
        for dx in offsets:
            cell = cell_at(sensor, dy, dx)
            if cell is not None:
                y, x = (points + np.array([math.floor(dy), math.floor(dx)]) + reach).T
                total[:, *cell] += padded[np.arange(len(points)), y, x]
                count[cell] += 1
    large = count > 2 * fine**2  # cells of two pixels and more, which the grid measures well
    assert large.sum() >= 2 * sensor.wedges
    np.testing.assert_allclose(images[..., 0][:, large], (total / np.maximum(count, 1))[:, large], atol=0.03)


@pytest.mark.parametrize("name", ["small-bilinear", "fine-bilinear"])
def test_bilinear_matches_a_loop(name):
    sensor = SENSORS[name]
    frames, points = frames_and_points()
    (images,) = batched(sensor)(frames, points)
    edges, half = ring_edges(sensor), sensor.window[0] // 2
    for frame, point, image in zip(np.asarray(frames), np.asarray(points), images, strict=True):

        def pixel(y, x, frame=frame, point=point):
            # The window's last pixels stand in for those half a pixel beyond.
            y, x = (min(max(p, c - half), c + half - 1) for p, c in zip((y, x), point, strict=True))
            return frame[y, x] if 0 <= y < 80 and 0 <= x < 80 else 0.0

        wanted = np.zeros(image.shape[:2])
        for ring, wedge in np.ndindex(wanted.shape):
            radius = math.sqrt(edges[ring] * edges[ring + 1]) if ring else edges[1] / 2
            angle = 2 * math.pi * (wedge + 0.5) / sensor.wedges
            y, x = point[0] - 0.5 + radius * math.sin(angle), point[1] - 0.5 + radius * math.cos(angle)
            top, left = math.floor(y), math.floor(x)
            a, b = y - top, x - left
            wanted[ring, wedge] = (1 - a) * ((1 - b) * pixel(top, left) + b * pixel(top, left + 1))
            wanted[ring, wedge] += a * ((1 - b) * pixel(top + 1, left) + b * pixel(top + 1, left + 1))
        np.testing.assert_allclose(image[..., 0], wanted, atol=1e-4)


def opencv_radii(columns, limit):
    """Radius that `cv2.warpPolar` with WARP_POLAR_LOG gives each column: it grows almost geometrically."""
    return limit ** (np.arange(columns) / columns) - 1


@pytest.mark.parametrize(("sampling", "largest", "mean"), [("bilinear", 0.02, 0.005), ("area", 0.12, 0.02)])
def test_warp_matches_opencv(sampling, largest, mean):
    """Each cell's centre is found among OpenCV's columns, 4000 of them, and on row 2j + 1 of two rows a wedge.

    OpenCV rounds positions to 1/32 pixel, which with the nearest column and slopes up to 0.3 a pixel makes
    0.02. An area's mean differs from the value at its centre by the curvature of the waves, most where the
    cells are widest: 3 pixels.
    """
    cv2 = pytest.importorskip("cv2")
    sensor = LogPolarSensor(rings=41, wedges=60, fovea=1.0, radius=30.0, sampling=sampling)
    frame, points = smooth_frame(), [(40, 40), (45, 33)]
    (images,) = batched(sensor)(jnp.asarray([frame, frame]), jnp.array(points))
    edges = ring_edges(sensor)
    centres = np.sqrt(edges[1:-1] * edges[2:])  # all but the innermost ring's
    radii = opencv_radii(4000, limit=32.0)
    columns = np.abs(radii[:, None] - centres).argmin(0)
    for (y, x), image in zip(points, images, strict=True):
        flags = cv2.WARP_POLAR_LOG | cv2.INTER_LINEAR | cv2.WARP_FILL_OUTLIERS
        polar = cv2.warpPolar(frame, (4000, 2 * sensor.wedges), (x - 0.5, y - 0.5), 32.0, flags)
        error = np.abs(image[1:, :, 0] - polar[1::2, columns].T)
        assert error.max() < largest and error.mean() < mean


def test_unwarp_matches_opencv():
    """The same pattern, sampled on OpenCV's cells and on ours, is unwarped to the same picture.

    OpenCV interpolates between cells, ours shows the nearest: they differ by the pattern's slope over half
    a cell.
    """
    cv2 = pytest.importorskip("cv2")
    sensor = LogPolarSensor(rings=121, wedges=240, fovea=1.0, radius=30.0)

    def pattern(radius, angle):
        return (np.sin(radius / 4) * np.cos(2 * angle)).astype(np.float32)

    angle = 2 * np.pi * (np.arange(240) + 0.5) / 240
    edges = ring_edges(sensor)
    ours = logpolar.unwarp(jnp.asarray(pattern((edges[:-1, None] + edges[1:, None]) / 2, angle)), sensor=sensor)
    polar = pattern(opencv_radii(200, limit=31.0), (angle - angle[0])[:, None])
    flags = cv2.WARP_POLAR_LOG | cv2.WARP_INVERSE_MAP | cv2.INTER_LINEAR | cv2.WARP_FILL_OUTLIERS
    theirs = cv2.warpPolar(polar, (60, 60), (29.5, 29.5), 31.0, flags)
    radius = np.hypot(*np.mgrid[-29.5:30, -29.5:30])
    compared = (radius > 2) & (radius < 29)
    np.testing.assert_allclose(ours[compared], theirs[compared], atol=0.1)
    assert np.abs(ours - theirs)[compared].mean() < 0.02
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

    @jax.jit
    def look_and_show(point):
        return picture(sense(frame, point, sensor=sensor), point, sensor=sensor, frame_shape=(60, 70))

    for y, x in ((30, 30), (2, 68)):
        shown = look_and_show(jnp.array([y, x]))
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
        (image,) = batched(SENSORS[f"default-{sampling}"])(jnp.stack([board] * 4), jnp.full((4, 2), 40))
        outer[sampling] = np.abs(image[0, 25:]).mean()
    assert outer["area"] < 0.05 < 0.2 < outer["bilinear"]


def test_jit_vmap_and_neither_agree():
    sensor = SENSORS["small-area"]
    frames, points = frames_and_points()
    (together,) = batched(sensor)(frames, points)
    for index in (0, 2):
        (alone,) = sense(frames[index], points[index], sensor=sensor)
        np.testing.assert_allclose(alone, together[index], atol=1e-6)


def test_colour_is_sensed_channel_by_channel_and_bytes_as_they_are():
    sensor = SENSORS["small-area"]
    frames, points = frames_and_points()
    (colour,) = batched(sensor)(jnp.moveaxis(frames, 0, -1)[None], points[1:2])
    (gray,) = batched(sensor)(frames, jnp.broadcast_to(points[1], (4, 2)))
    np.testing.assert_allclose(jnp.moveaxis(colour[0], -1, 0), gray[..., 0], atol=1e-6)
    (bytes_seen,) = batched(sensor)(jnp.full((4, 80, 80), 200, jnp.uint8), points * 0 + 40)
    np.testing.assert_allclose(bytes_seen, 200.0, rtol=1e-6)
