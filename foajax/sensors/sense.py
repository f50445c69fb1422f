"""The sensor: one frame and a focal point in, what is seen out.

Conventions, for every sensor. A frame is [H, W] or [H, W, C], of any size; a gray frame has one
channel on the way out. The focal point is (y, x) in frame pixels. An area of h x w pixels around it
covers rows y - h//2 .. y - h//2 + h - 1 (70 at y = 40: rows 5..74), columns likewise; an even area
is thus centred on the corner between four pixels. What lies outside the frame counts as 0 and what
is hidden is 0: frames are normalised before they are sensed. Values are not rescaled.

All functions are for one frame; the caller vmaps and jits. The cost depends on the sensor, not on
the frame, except where every pixel of the frame matters: a canvas, a peripheral grid of means.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, Num

from foajax.config.parse import refuse, replace
from foajax.config.schema import LogPolarSensor, RingSensor, Sensor
from foajax.sensors import logpolar
from foajax.sensors.rings import (
    block_edges,
    block_sums,
    canvas,
    cell_edges,
    covered,
    hidden_blocks,
    offsets,
    sense_cells,
)
from foajax.sensors.window import Shape, apart, gather_window
from foajax.types import HostArray


class PixelCount(NamedTuple):
    """How many values a sensor gives of a gray frame."""

    nominal: int  # as Table II counts: area over factor squared, ring by ring
    actual: int  # values really shown with the gaze at the frame's centre


def sense(
    frame: Num[HostArray, "H W *C"],
    focal_point: Int[HostArray, "2"],
    *,
    sensor: Sensor,
    bounds: str = "point",
) -> tuple[Float[Array, "_ _ _"], ...]:
    """What the sensor sees of a frame: float32 images [h, w, c], one a part (see `image_shapes`).

    A `RingSensor` shows nested areas pooled in blocks (the RoI layers of the paper, Table II). The
    blocks of a ring are aligned to its own top-left corner; where they do not divide it, the last
    ones are smaller. A block's value is its mean, zeros outside the frame included ('mean'), or its
    top-left pixel ('stride'). A finer ring hides what lies under it; a block that it covers in part
    is pooled whole and shown where it is not covered. The peripheral grid is the whole frame, cut
    at rows i * H // rows and columns likewise, pooled and hidden by the focal area in the same way.

    - layout 'canvas': one image of the frame's size, each value painted over the pixels that it
      stands for.
    - layout 'packed': one image a ring, one value a block, then the grid; hidden ones are 0. The
      canvas's values, each once.

    A `LogPolarSensor` gives one image [rings, wedges, c]; see `foajax.sensors.logpolar`.

    Args:
      frame: uint8 or finite float, in any range.
      focal_point: (y, x), frame pixels.
      sensor: static.
      bounds: static, as in `foajax.sensors.gaze`. With 'point' the area may overhang the frame; with 'window' it is
        moved inside where it would, and then sensing takes about two thirds of the time.

    Raises:
      ConfigError: a frame or a focal point of another rank; a focal point of fractions; a peripheral grid finer than
        the frame; other bounds, or 'window' and an area larger than the frame.
    """
    if bounds not in ("window", "point"):
        raise refuse("bounds", bounds, "'window' or 'point'")
    frame, focal_point = jnp.asarray(frame), jnp.asarray(focal_point)
    if not jnp.issubdtype(focal_point.dtype, jnp.integer):
        raise refuse("focal_point", focal_point.dtype, "integers, which foajax.sensors.gaze.from_unit makes")
    if focal_point.shape != (2,):
        raise refuse("focal_point", list(focal_point.shape), "(y, x), jax.vmap for more")
    if frame.ndim not in (2, 3):
        raise refuse("frame", list(frame.shape), "[H, W] or [H, W, C], jax.vmap for more")
    corner = focal_point - np.array(sensor.window) // 2
    if bounds == "window":
        room = np.array(frame.shape[:2]) - sensor.window
        if (room < 0).any():
            accepted = f"'point' where the focal area {sensor.window} exceeds {frame.shape[:2]}"
            raise refuse("bounds", "window", accepted)
        corner = jnp.clip(corner, 0, room)
    gray = functools.partial(_sense_gray, corner=corner, sensor=sensor, inside=bounds == "window")
    if frame.ndim == 2:
        return tuple(image[..., None] for image in gray(frame))
    return jax.vmap(gray, in_axes=2, out_axes=2)(frame)


def image_shapes(sensor: Sensor, frame_shape: Shape) -> tuple[tuple[int, int, int], ...]:
    """Shapes (h, w, 1) of what `sense` gives for a gray frame of `frame_shape`, part by part."""
    if isinstance(sensor, LogPolarSensor):
        return ((sensor.rings, sensor.wedges, 1),)
    if sensor.layout == "canvas":
        return ((*frame_shape, 1),)
    shapes = [(-(-height // factor), -(-width // factor), 1) for height, width, factor in sensor.rings]
    return (*shapes, (*sensor.peripheral, 1)) if sensor.peripheral else tuple(shapes)


def pixel_count(sensor: Sensor, frame_shape: Shape) -> PixelCount:
    """The pixel budget as Table II counts it, and what is really shown; the focal area must fit the frame.

    Nominal: each ring's area less that of the next finer one, over its factor squared, rounded; a
    peripheral grid adds the largest number of cells that an area inside the frame leaves visible
    (16 for 70x70 in 5x5). Actual differs where blocks do not divide an area (70 by 4) or straddle
    a finer ring.
    """
    if isinstance(sensor, LogPolarSensor):
        return PixelCount(sensor.rings * sensor.wedges, sensor.rings * sensor.wedges)
    nominal, inner = 0.0, 0
    for height, width, factor in sensor.rings:
        nominal += (height * width - inner) / factor**2
        inner = height * width
    shapes = image_shapes(replace(sensor, layout="packed"), frame_shape)
    actual = sum(math.prod(shape) for shape in shapes) - sum(int(h.sum()) for h in hidden_blocks(sensor))
    if sensor.peripheral is not None:
        least = centred = 1  # cells hidden along one axis, times those along the other
        for edges, size, length in zip(cell_edges(sensor, frame_shape), frame_shape, sensor.window, strict=True):
            hidden = [int(covered(edges, first, length).sum()) for first in range(size - length + 1)]
            least, centred = least * min(hidden), centred * hidden[size // 2 - length // 2]
        nominal, actual = nominal + math.prod(sensor.peripheral) - least, actual - centred
    return PixelCount(round(nominal), actual)


def ring_boxes(focal_point: Int[Array, "2"] | np.ndarray | Shape, sensor: Sensor) -> list[tuple[int, int, int, int]]:
    """The areas' rectangles (top, left, height, width) in frame pixels, inner to outer, for drawing.

    They may overhang the frame. A `LogPolarSensor` has one, the square around its outer circle.
    """
    areas = [ring[:2] for ring in sensor.rings] if isinstance(sensor, RingSensor) else [sensor.window]
    y, x = (int(coordinate) for coordinate in focal_point)
    return [(y - height // 2, x - width // 2, height, width) for height, width in areas]


def _sense_gray(
    frame: Num[Array, "H W"], corner: Int[Array, "2"], sensor: Sensor, inside: bool
) -> tuple[Float[Array, "_ _"], ...]:
    """`sense` for one channel; `corner` is the focal area's top-left pixel, `inside` that none of it overhangs."""
    parts = _pool(lax.dynamic_slice(frame, corner, sensor.window), sensor) if inside else _look(frame, corner, sensor)
    if isinstance(sensor, LogPolarSensor):
        return parts
    height, width = frame.shape
    cells = None if sensor.peripheral is None else sense_cells(frame, sensor)
    if sensor.layout == "canvas":
        return (canvas(parts, cells, corner, sensor, (height, width)),)
    hidden = hidden_blocks(sensor)
    images = [parts[0], *(jnp.where(h, 0.0, part) for h, part in zip(hidden, parts[1:], strict=True))]
    if cells is not None:
        edges = cell_edges(sensor, (height, width))
        rows, columns = (covered(edges[axis], corner[axis], sensor.window[axis]) for axis in (0, 1))
        images.append(jnp.where(rows[:, None] & columns[None], 0.0, cells))
    return tuple(images)


@functools.partial(jax.custom_jvp, nondiff_argnums=(2,))
def _look(frame: Num[Array, "H W"], corner: Int[Array, "2"], sensor: Sensor) -> tuple[Float[Array, "_ _"], ...]:
    """The focal area with its top-left pixel at `corner`, part by part (see `_pool`).

    A slice, moved inside the frame, and a second look with care if it had to be moved. That look is
    a loop of no or one turn, not a `lax.cond`: under vmap a cond runs both branches for all frames,
    a loop runs only if some area in the batch overhangs. Where none does, this is many times faster.
    """
    size = sensor.window
    if any(length > limit for length, limit in zip(size, frame.shape, strict=True)):
        return _pool(gather_window(frame, corner, size), sensor)
    start = jnp.clip(corner, 0, np.array(frame.shape) - size)

    def look_again(state):
        # What does not depend on the state would be moved out of the loop, and always run.
        window = apart(gather_window(frame, start + state[0], size), corner)
        return jnp.zeros_like(state[0]), _pool(window, sensor)

    parts = _pool(lax.dynamic_slice(frame, start, size), sensor)
    return lax.while_loop(lambda state: jnp.any(state[0] != 0), look_again, (corner - start, parts))[1]


@_look.defjvp
def _look_jvp(sensor, primals, tangents):
    # Linear in the frame; the loops are for speed, and cannot be transposed.
    frame, corner = primals
    return _look(frame, corner, sensor), _pool(gather_window(tangents[0], corner, sensor.window), sensor)


def _pool(window: Num[Array, "h w"], sensor: Sensor) -> tuple[Float[Array, "_ _"], ...]:
    """The mean of each block, ring by ring, nothing hidden yet; or its first pixel; or log-polar cells."""
    window = window.astype(jnp.float32)
    if isinstance(sensor, LogPolarSensor):
        return (logpolar.warp(window, sensor=sensor),)
    parts = []
    for (height, width, factor), (top, left) in zip(sensor.rings, offsets(sensor), strict=True):
        area = window[top : top + height, left : left + width]
        if sensor.pooling == "stride" or factor == 1:
            parts.append(area[::factor, ::factor])
            continue
        # Rows first: they are added up whole before anything is picked apart.
        sums = block_sums(block_sums(area, factor, 0), factor, 1)
        rows, columns = (np.diff(block_edges(size, factor)) for size in (height, width))
        parts.append(sums / np.outer(rows, columns).astype(np.float32))
    return tuple(parts)
