"""The sensor against an oracle that walks over pixels, and against what must hold whatever the pixels are."""

from __future__ import annotations

import functools

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings

from foajax.config.parse import ConfigError
from foajax.config.schema import LogPolarSensor, RingSensor
from foajax.sensors.base import boxes
from foajax.sensors.geometry import PixelCount
from foajax.sensors.registry import make_sensor
from foajax.sensors.sense import picture, sense

DECREASING = ((30, 30, 1), (50, 50, 2), (70, 70, 4))
# Table II: rings, peripheral grid, pixel-values there, and values shown by count of blocks and cells.
# 70 by 4 makes 18 x 18 blocks, of which 50 x 50 covers 12 x 12: 180 for the paper's nominal 150.
TABLE_II = {
    "nonfoa": (((80, 80, 1),), None, 6400, 6400),
    "constant50": (((50, 50, 1),), None, 2500, 2500),
    "constant50_sub2": (((50, 50, 2),), None, 625, 625),
    "constant70": (((70, 70, 2),), None, 1225, 1225),
    "decreasing": (DECREASING, None, 1450, 900 + 400 + 180),
    "constant70_p": (((70, 70, 2),), (5, 5), 1241, 1225 + 16),
    "decreasing_p": (DECREASING, (5, 5), 1466, 900 + 400 + 180 + 16),
}
SENSORS = {
    f"{name}-{layout}-{pooling}": RingSensor(rings=rings, peripheral=grid, layout=layout, pooling=pooling)
    for name, (rings, grid, *_) in TABLE_II.items()
    for layout in ("canvas", "packed")
    for pooling in ("mean", "stride")
}
# Inside at the centre, each border of bounds 'window', overhanging a side and a corner, hardly in sight.
POINTS = np.array([(40, 40), (35, 45), (45, 35), (37, 42), (12, 44), (79, 0), (0, 79), (-30, 40), (41, 121)])


def oracle(frame, point, sensor):
    """(canvas, packed) of a gray frame, block by block and pixel by pixel."""
    height, width = frame.shape

    def pool(pixels):
        values = [frame[y, x] if 0 <= y < height and 0 <= x < width else 0.0 for y, x in pixels]
        return values[0] if sensor.pooling == "stride" else sum(map(float, values)) / len(values)

    def pixels_of(top, bottom, left, right):
        return [(y, x) for y in range(top, bottom) for x in range(left, right)]

    regions = []  # coarse to fine: (blocks in order, their grid, pixels of the whole region)
    if sensor.peripheral is not None:
        rows, columns = sensor.peripheral
        cells = [
            pixels_of(i * height // rows, (i + 1) * height // rows, j * width // columns, (j + 1) * width // columns)
            for i in range(rows)
            for j in range(columns)
        ]
        regions.append((cells, sensor.peripheral))
    for h, w, factor in reversed(sensor.rings):
        top, left = point[0] - h // 2, point[1] - w // 2
        bottom, right = top + h, left + w
        blocks = [
            pixels_of(y, min(y + factor, bottom), x, min(x + factor, right))
            for y in range(top, bottom, factor)
            for x in range(left, right, factor)
        ]
        regions.append((blocks, (len(range(0, h, factor)), len(range(0, w, factor)))))

    canvas, packed = np.zeros((height, width)), []
    for index, (blocks, grid) in enumerate(regions):
        finer = {pixel for block in regions[index + 1][0] for pixel in block} if index + 1 < len(regions) else set()
        values = []
        for block in blocks:
            value = pool(block)
            values.append(0.0 if finer.issuperset(block) else value)
            for y, x in block:
                if 0 <= y < height and 0 <= x < width:
                    canvas[y, x] = value
        packed.append(np.reshape(values, grid))
    if sensor.peripheral is not None:
        return canvas, [*packed[:0:-1], packed[0]]
    return canvas, packed[::-1]


def expected(frame, point, sensor):
    canvas, packed = oracle(frame, point, sensor)
    return [canvas] if sensor.layout == "canvas" else packed


@functools.cache
def batched(sensor):
    return jax.jit(jax.vmap(functools.partial(sense, sensor=sensor)))


def random_frames(shape, dtype=np.float32, seed=0):
    rng = np.random.default_rng(seed)
    return rng.integers(0, 256, shape, np.uint8) if dtype == np.uint8 else rng.normal(size=shape).astype(dtype)


@pytest.mark.parametrize("name", SENSORS)
def test_table_ii_sensors_match_the_oracle(name):
    sensor = SENSORS[name]
    frames = random_frames((len(POINTS), 80, 80), np.uint8 if sensor.pooling == "stride" else np.float32)
    images = batched(sensor)(jnp.asarray(frames), jnp.asarray(POINTS))
    assert tuple(image.shape[1:3] for image in images) == make_sensor(sensor).image_shapes((80, 80))
    for index, (frame, point) in enumerate(zip(frames, POINTS, strict=True)):
        for image, wanted in zip(images, expected(frame, point, sensor), strict=True):
            assert image.dtype == jnp.float32
            np.testing.assert_allclose(image[index, ..., 0], wanted, atol=0 if sensor.pooling == "stride" else 1e-5)


@pytest.mark.parametrize("name", [*SENSORS, "logpolar"])
def test_within_bounds_an_area_that_would_overhang_is_moved_inside(name):
    sensor = LogPolarSensor(rings=6, wedges=8, radius=20.0) if name == "logpolar" else SENSORS[name]
    frames = jnp.asarray(random_frames((len(POINTS), 80, 80)))
    low = np.array(sensor.window) // 2
    moved = np.clip(POINTS, low, 80 - np.array(sensor.window) + low)
    assert not np.array_equal(moved, POINTS)
    inside = jax.jit(jax.vmap(functools.partial(sense, sensor=sensor, bounds="window")))
    for image, wanted in zip(
        inside(frames, jnp.asarray(POINTS)), batched(sensor)(frames, jnp.asarray(moved)), strict=True
    ):
        np.testing.assert_allclose(image, wanted, atol=1e-6)


def test_bounds_that_an_area_cannot_keep_are_refused():
    with pytest.raises(ConfigError, match=r"bounds=window: accepted is 'point' where .* \(9, 4\) exceeds \(8, 8\)"):
        sense(jnp.zeros((8, 8)), jnp.array([4, 4]), sensor=RingSensor(((9, 4, 1),)), bounds="window")
    with pytest.raises(ConfigError, match="bounds=frame: accepted is 'window' or 'point'"):
        sense(jnp.zeros((8, 8)), jnp.array([4, 4]), sensor=RingSensor(((4, 4, 1),)), bounds="frame")


def test_the_convention_by_hand():
    frame = jnp.arange(80 * 80, dtype=jnp.float32).reshape(80, 80)
    see = jax.jit(sense, static_argnames="sensor")
    (canvas,) = see(frame, jnp.array([40, 30]), sensor=RingSensor(rings=((70, 60, 1),)))
    seen = np.zeros((80, 80))
    seen[5:75, 0:60] = np.arange(6400).reshape(80, 80)[5:75, 0:60]
    np.testing.assert_array_equal(canvas[..., 0], seen)
    halves = RingSensor(rings=((70, 60, 2),), layout="packed")
    (packed,) = see(frame, jnp.array([40, 30]), sensor=halves)
    assert packed.shape == (35, 30, 1)
    assert packed[0, 0, 0] == np.mean([400, 401, 480, 481])
    # Of the first block's four pixels only the frame's first lies inside the frame.
    (packed,) = see(frame + 8, jnp.array([34, 29]), sensor=halves)
    assert packed[0, 0, 0] == 8 / 4


@pytest.mark.parametrize("name", ["constant70_p-canvas-mean", "constant50_sub2-packed-mean"])
def test_jit_vmap_and_neither_agree(name):
    sensor = SENSORS[name]
    frames, points = jnp.asarray(random_frames((len(POINTS), 80, 80))), jnp.asarray(POINTS)
    together = batched(sensor)(frames, points)
    for index in (0, 5):
        alone = sense(frames[index], points[index], sensor=sensor)
        compiled = jax.jit(functools.partial(sense, sensor=sensor))(frames[index], points[index])
        for one, another, many in zip(alone, compiled, together, strict=True):
            np.testing.assert_allclose(one, many[index], atol=1e-6)
            np.testing.assert_allclose(another, many[index], atol=1e-6)


def test_one_frame_seen_from_many_points_and_many_frames_from_one():
    sensor = SENSORS["constant70-packed-mean"]
    frames, points = jnp.asarray(random_frames((len(POINTS), 80, 80))), jnp.asarray(POINTS)
    for axes in ((None, 0), (0, None)):
        some = (frames[0] if axes[0] is None else frames, points[4] if axes[1] is None else points)
        (shared,) = jax.jit(jax.vmap(functools.partial(sense, sensor=sensor), in_axes=axes))(*some)
        spread = [jnp.broadcast_to(x, (len(POINTS), *x.shape[-n:])) for x, n in zip(some, (2, 1), strict=True)]
        np.testing.assert_allclose(shared, batched(sensor)(*spread)[0], atol=1e-6)


@pytest.mark.parametrize(("layout", "dtype"), [("canvas", np.float32), ("packed", np.uint8)])
def test_colour_is_sensed_channel_by_channel(layout, dtype):
    sensor = RingSensor(((20, 15, 1), (40, 30, 3)), peripheral=(5, 4), layout=layout)
    frames, points = random_frames((2, 50, 61, 3), dtype), np.array([(25, 30), (3, 55)])
    images = batched(sensor)(jnp.asarray(frames), jnp.asarray(points))
    for index, channel in np.ndindex(2, 3):
        for image, wanted in zip(images, expected(frames[index, ..., channel], points[index], sensor), strict=True):
            np.testing.assert_allclose(image[index, ..., channel], wanted, rtol=1e-6, atol=1e-5)


@pytest.fixture(scope="module")
def distinct_frames():
    """A frame whose pixels all differ, and whose block means do too, once for each of `POINTS`."""
    frame = np.sqrt(np.random.default_rng(0).permutation(6400) + 1.0).reshape(80, 80)
    return jnp.asarray(np.stack([frame] * len(POINTS)), jnp.float32)


@pytest.mark.parametrize("name", TABLE_II)
def test_canvas_and_packed_carry_the_same_values(name, distinct_frames):
    """Where the focal area lies inside the frame: all values of the canvas, each once, and no others."""
    (canvas,) = batched(SENSORS[f"{name}-canvas-mean"])(distinct_frames, jnp.asarray(POINTS))
    packed = batched(SENSORS[f"{name}-packed-mean"])(distinct_frames, jnp.asarray(POINTS))
    for index in range(1 if name == "nonfoa" else 4):
        values = np.concatenate([np.ravel(image[index]) for image in packed])
        shown = np.unique(canvas[index])
        np.testing.assert_array_equal(np.sort(values[values != 0]), shown[shown != 0])


@pytest.mark.parametrize("name", TABLE_II)
def test_the_picture_of_packed_images_is_the_canvas(name):
    frames, points = jnp.asarray(random_frames((len(POINTS), 80, 80))), jnp.asarray(POINTS)
    canvas_sensor, packed_sensor = SENSORS[f"{name}-canvas-mean"], SENSORS[f"{name}-packed-mean"]
    (canvas,) = batched(canvas_sensor)(frames, points)
    images = batched(packed_sensor)(frames, points)
    show = functools.partial(picture, sensor=packed_sensor, frame_shape=(80, 80))
    np.testing.assert_array_equal(jax.jit(jax.vmap(show))(images, points), canvas)
    same = picture((canvas[0],), points[0], sensor=canvas_sensor, frame_shape=(80, 80))
    np.testing.assert_array_equal(same, canvas[0])


def test_what_was_sensed_far_outside_of_a_frame_is_nowhere_in_its_picture():
    sensor = RingSensor(((4, 4, 1),), layout="packed")
    for y in range(-30, 40):
        shown = picture((jnp.ones((4, 4, 1)),), jnp.array([y, 5]), sensor=sensor, frame_shape=(10, 10))
        expected = np.zeros((10, 10, 1))
        expected[max(0, y - 2) : max(0, y + 2), 3:7] = 1
        np.testing.assert_array_equal(shown, expected)


@st.composite
def scenes(draw):
    """What makes a sensor, the shape of a frame and focal points, all of them odd."""
    frame_shape = draw(st.tuples(st.integers(4, 23), st.integers(4, 23)))
    rings, height, width = [], 0, 0
    for _ in range(draw(st.integers(1, 3))):
        height, width = height + draw(st.integers(1, 9)), width + draw(st.integers(1, 9))
        rings.append((height, width, draw(st.integers(1, min(height, width, 6)))))
    sensor = {
        "rings": tuple(rings),
        "peripheral": draw(st.none() | st.tuples(*(st.integers(1, min(4, size)) for size in frame_shape))),
        "layout": draw(st.sampled_from(["canvas", "packed"])),
        "pooling": draw(st.sampled_from(["mean", "stride"])),
    }
    points = draw(st.lists(st.tuples(*(st.integers(-3, size + 3) for size in frame_shape)), min_size=3, max_size=3))
    return sensor, frame_shape, points


@settings(max_examples=12, deadline=None, derandomize=True)
@given(scenes())
def test_odd_sizes_match_the_oracle(scene):
    parts, frame_shape, points = scene
    sensor = RingSensor(**parts)
    frames = random_frames((len(points), *frame_shape))
    images = batched(sensor)(jnp.asarray(frames), jnp.array(points))
    assert tuple(image.shape[1:3] for image in images) == make_sensor(sensor).image_shapes(frame_shape)
    for index, (frame, point) in enumerate(zip(frames, points, strict=True)):
        for image, wanted in zip(images, expected(frame, point, sensor), strict=True):
            np.testing.assert_allclose(image[index, ..., 0], wanted, atol=1e-5)


@pytest.mark.parametrize("bounds", ["point", "window"])
def test_numpy_frames_are_frames_too(bounds):
    frame, sensor = random_frames((80, 80)), RingSensor(((30, 30, 2),), layout="packed")
    (actual,) = sense(frame, np.array([12, 70]), sensor=sensor, bounds=bounds)
    (expected,) = sense(jnp.asarray(frame), jnp.array([12, 70]), sensor=sensor, bounds=bounds)
    np.testing.assert_array_equal(actual, expected)


@pytest.mark.parametrize(
    "sensor",
    [
        RingSensor(((30, 30, 1), (70, 70, 4)), peripheral=(5, 5)),
        RingSensor(((30, 30, 1), (70, 70, 4)), peripheral=(5, 5), layout="packed"),
        RingSensor(((90, 70, 3),), layout="packed", pooling="stride"),
        LogPolarSensor(),
    ],
)
def test_gradients_are_those_of_a_linear_map(sensor):
    """<g, sense(f)> = <gradient, f> for any f, and the tangent of sense is sense of the tangent."""
    frames, others = (jnp.asarray(random_frames((2, 80, 80), seed=seed)) for seed in (1, 2))
    points = jnp.array([(40, 40), (7, 66)])

    @jax.jit
    def pull_and_push(frames, others, images):
        _, pull = jax.vjp(lambda f: batched(sensor)(f, points), frames)
        _, tangents = jax.jvp(lambda f: batched(sensor)(f, points), (frames,), (others,))
        return pull(images)[0], tangents

    images = batched(sensor)(frames, points)
    weights = tuple(jnp.asarray(random_frames(image.shape)) for image in images)
    gradient, tangents = pull_and_push(frames, others, weights)
    seen = batched(sensor)(others, points)
    wanted = sum(float(jnp.vdot(w, i)) for w, i in zip(weights, seen, strict=True))
    assert float(jnp.vdot(gradient, others)) == pytest.approx(wanted, rel=1e-3, abs=1e-2)
    for tangent, image in zip(tangents, seen, strict=True):
        np.testing.assert_allclose(tangent, image, atol=1e-5)


def test_hidden_and_outside_pixels_get_no_gradient():
    sensor = RingSensor(((30, 30, 1), (70, 70, 5)), layout="canvas")
    frame, point = jnp.asarray(random_frames((80, 80))), jnp.array([40, 40])
    gradient = jax.jit(jax.grad(lambda f: jnp.sum(sense(f, point, sensor=sensor)[0] ** 2)))(frame)
    np.testing.assert_array_equal(gradient[:5], 0)
    np.testing.assert_array_equal(gradient[75:], 0)
    np.testing.assert_allclose(gradient[25:55, 25:55], 2 * frame[25:55, 25:55], atol=1e-6)


@pytest.mark.parametrize("layout", ["canvas", "packed"])
def test_the_cost_does_not_grow_with_the_frame(layout):
    """Nothing of the size of the frame is made on the way, but for the canvas itself."""
    sensor = RingSensor(DECREASING, layout=layout)
    for shape in [(1080, 1920), (1080, 1920, 3)]:
        frame, point = jnp.zeros(shape, jnp.uint8), jnp.zeros(2, jnp.int32)
        for bounds in ("point", "window"):
            look = jax.jit(functools.partial(sense, sensor=sensor, bounds=bounds))
            assert look.lower(frame, point).compile().memory_analysis().temp_size_in_bytes < 2**20


@pytest.mark.parametrize("name", TABLE_II)
def test_pixel_counts_of_table_ii(name, distinct_frames):
    _, _, nominal, actual = TABLE_II[name]
    sensor = SENSORS[f"{name}-canvas-mean"]
    assert make_sensor(sensor).count((80, 80)) == PixelCount(nominal=nominal, actual=actual)
    # Independently: the number of different values on the canvas of a frame whose values all differ.
    (canvas,) = batched(sensor)(distinct_frames, jnp.asarray(POINTS))
    assert np.count_nonzero(np.unique(canvas[0])) == actual


def test_counts_and_shapes_of_other_sensors():
    assert make_sensor(LogPolarSensor(rings=20, wedges=24)).count((80, 80)) == PixelCount(480, 480)
    assert make_sensor(LogPolarSensor(rings=20, wedges=24)).image_shapes((80, 80)) == ((20, 24),)
    # 7 by 3 is 3 blocks a side, all of them seen; 49 / 9 rounds to 5. No cell of the grid is covered.
    small = RingSensor(((7, 7, 3),), peripheral=(2, 2), layout="packed")
    assert make_sensor(small).count((20, 30)) == PixelCount(5 + 4, 9 + 4)
    assert make_sensor(small).image_shapes((20, 30)) == ((3, 3), (2, 2))
    assert make_sensor(RingSensor(((7, 7, 3),))).image_shapes((20, 30)) == ((20, 30),)


def test_ring_boxes_frame_what_is_shown():
    sensor = make_sensor(RingSensor(((5, 4, 1), (9, 8, 1))))
    assert boxes(sensor, (10, 3)) == [(8, 1, 5, 4), (6, -1, 9, 8)]
    assert boxes(sensor, jnp.array([10, 3])) == boxes(sensor, np.array([10, 3]))
    assert boxes(make_sensor(LogPolarSensor(radius=39.5)), (40, 40)) == [(0, 0, 80, 80)]
    (canvas,) = jax.jit(functools.partial(sense, sensor=sensor))(jnp.ones((30, 30)), jnp.array([10, 9]))
    top, left, height, width = boxes(sensor, (10, 9))[-1]
    assert canvas.sum() == canvas[top : top + height, left : left + width].sum() == height * width


def test_a_grid_finer_than_the_frame_is_refused():
    sensor = RingSensor(((4, 4, 1),), peripheral=(5, 9))
    with pytest.raises(ConfigError, match=r"sensor\.peripheral=\[5, 9\]: accepted is a grid no finer .* 8x8"):
        sense(jnp.zeros((8, 8)), jnp.array([4, 4]), sensor=sensor)
