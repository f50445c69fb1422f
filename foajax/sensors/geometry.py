"""Computes where the sensors' values lie: blocks, cells, rings and wedges. It uses NumPy alone."""

from __future__ import annotations

import functools
import itertools
import math
from typing import Any, NamedTuple

import numpy as np

from foajax.config.parse import refuse
from foajax.config.schema import LogPolarSensor, RingSensor

Shape = tuple[int, int]  # rows, columns
_SAMPLES = 32  # sample points along each side of a cell, to measure how much of it lies in a pixel


class PixelCount(NamedTuple):
    """The number of values that a sensor gives of a gray frame, or of each channel of a frame in colour."""

    nominal: int  # as Table II counts: area over factor squared, ring by ring
    actual: int  # values really shown with the gaze at the frame's centre


def offsets(sensor: RingSensor) -> list[Shape]:
    """Top-left corners of the rings inside the focal area."""
    height, width = sensor.window
    return [(height // 2 - ring[0] // 2, width // 2 - ring[1] // 2) for ring in sensor.rings]


def block_edges(size: int, factor: int) -> np.ndarray:
    """Where the blocks of a ring begin and end along an axis; the last one may be shorter."""
    return np.append(np.arange(0, size, factor), size)


def cell_edges(sensor: RingSensor, frame_shape: Shape) -> list[np.ndarray]:
    """Where the cells of the peripheral grid begin and end, along rows and along columns."""
    assert sensor.peripheral is not None
    if any(n > size for n, size in zip(sensor.peripheral, frame_shape, strict=True)):
        accepted = f"a grid no finer than the frame, {frame_shape[0]}x{frame_shape[1]}"
        raise refuse("sensor.peripheral", sensor.peripheral, accepted)
    return [np.arange(n + 1) * size // n for n, size in zip(sensor.peripheral, frame_shape, strict=True)]


def covered(edges: np.ndarray, first: Any, length: int) -> Any:
    """Which of the intervals between `edges` lie altogether inside [first, first + length)."""
    return (edges[:-1] >= first) & (edges[1:] <= first + length)


def hidden_blocks(sensor: RingSensor) -> list[np.ndarray]:
    """Per ring but the first, which blocks [rows, columns] the next finer ring covers altogether."""
    hidden = []
    for inner, outer in zip(sensor.rings, sensor.rings[1:], strict=False):
        rows, columns = (
            covered(block_edges(size, outer[2]), size // 2 - length // 2, length)
            for size, length in zip(outer[:2], inner[:2], strict=True)
        )
        hidden.append(rows[:, None] & columns)
    return hidden


def ring_shapes(sensor: RingSensor) -> tuple[Shape, ...]:
    """Returns the shapes of the packed layout's images: the rings in blocks, then the grid."""
    shapes = [(-(-height // factor), -(-width // factor)) for height, width, factor in sensor.rings]
    return (*shapes, sensor.peripheral) if sensor.peripheral else tuple(shapes)


def ring_count(sensor: RingSensor, frame_shape: Shape) -> PixelCount:
    """Counts the pixel budget of rings as Table II does, and the values really shown; see `Rings.count`."""
    nominal, inner = 0.0, 0
    for height, width, factor in sensor.rings:
        nominal += (height * width - inner) / factor**2
        inner = height * width
    actual = sum(math.prod(shape) for shape in ring_shapes(sensor))
    actual -= sum(int(hidden.sum()) for hidden in hidden_blocks(sensor))
    if sensor.peripheral is not None:
        if any(length > size for length, size in zip(sensor.window, frame_shape, strict=True)):
            accepted = f"a focal area inside the frame, {frame_shape[0]}x{frame_shape[1]}"
            raise refuse("sensor.rings", sensor.window, accepted)
        least = centred = 1  # cells hidden along one axis, times those along the other
        for edges, size, length in zip(cell_edges(sensor, frame_shape), frame_shape, sensor.window, strict=True):
            hidden = [int(covered(edges, first, length).sum()) for first in range(size - length + 1)]
            least, centred = least * min(hidden), centred * hidden[size // 2 - length // 2]
        nominal, actual = nominal + math.prod(sensor.peripheral) - least, actual - centred
    return PixelCount(round(nominal), actual)


def check_look(frame: Any, focal_point: Any, window: Shape, bounds: str) -> None:
    """Raises `ConfigError` unless the frame can be sensed at the focal point; arrays of NumPy or of JAX."""
    if bounds not in ("window", "point"):
        raise refuse("bounds", bounds, "'window' or 'point'")
    if not np.issubdtype(focal_point.dtype, np.integer):
        raise refuse("focal_point.dtype", focal_point.dtype, "integers, which foajax.sensors.gaze.from_unit makes")
    if focal_point.shape != (2,):
        raise refuse("focal_point.shape", list(focal_point.shape), "[2], for (y, x); jax.vmap takes several")
    if frame.ndim not in (2, 3):
        raise refuse("frame.shape", list(frame.shape), "[H, W] or [H, W, C]; jax.vmap takes several")
    if bounds == "window" and (window[0] > frame.shape[0] or window[1] > frame.shape[1]):
        accepted = f"'point' where the focal area {window} exceeds {(frame.shape[0], frame.shape[1])}"
        raise refuse("bounds", "window", accepted)


def move_inside(focal_point: Any, window: Shape, frame_shape: Shape) -> Any:
    """Returns the nearest focal points [..., 2] whose areas lie inside the frame, for arrays of NumPy or of JAX."""
    half, room = np.array(window) // 2, np.array(frame_shape) - window
    return focal_point.clip(half, half + room)


def ring_edges(sensor: LogPolarSensor) -> np.ndarray:
    """Returns the radii [rings + 1] at which the rings begin and end, frame pixels: 0, fovea, ..., radius."""
    growth = sensor.radius / sensor.fovea
    return np.concatenate([[0.0], sensor.fovea * growth ** (np.arange(sensor.rings) / (sensor.rings - 1))])


def shares(sensor: LogPolarSensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns (cell, pixel of the window, weight), sorted by cell: a cell's value is the weighted sum of its pixels."""
    return _bilinear_weights(sensor) if sensor.sampling == "bilinear" else _area_weights(sensor)


def _bilinear_weights(sensor: LogPolarSensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the `shares` of the four pixels around each cell's centre.

    The centre halves the cell's angle and its logarithmic radius or, in the innermost ring, its radius.
    """
    edges = ring_edges(sensor)
    radius = np.concatenate([[edges[1] / 2], np.sqrt(edges[1:-1] * edges[2:])])[:, None]
    angle = 2 * np.pi * (np.arange(sensor.wedges) + 0.5) / sensor.wedges
    side = sensor.window[0]
    y, x = (np.ravel(side / 2 - 0.5 + radius * turn(angle)) for turn in (np.sin, np.cos))
    top, left = np.floor(y), np.floor(x)
    pixels, weights = [], []
    for row, row_weight in ((top, top + 1 - y), (top + 1, y - top)):
        for column, column_weight in ((left, left + 1 - x), (left + 1, x - left)):
            # The outermost centres may lie half a pixel beyond the last pixel's: it stands in.
            pixels.append(np.clip(row, 0, side - 1) * side + np.clip(column, 0, side - 1))
            weights.append(row_weight * column_weight)
    cell = np.repeat(np.arange(len(y)), 4)
    return cell, np.stack(pixels, 1).ravel(), np.stack(weights, 1).ravel()


def _area_weights(sensor: LogPolarSensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns `shares` whose weight is the part of the cell's area that lies in the pixel.

    It counts a grid of points in each cell, evenly spaced in area; ring by ring, to bound the memory.
    """
    fraction = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    wedge = np.arange(sensor.wedges)
    angle = 2 * np.pi * (wedge[:, None] + fraction) / sensor.wedges
    side, parts = sensor.window[0], []
    for ring, (inner, outer) in enumerate(itertools.pairwise(ring_edges(sensor))):
        radius = np.sqrt(inner**2 + (outer**2 - inner**2) * fraction)[:, None]
        y, x = (np.floor(side / 2 + radius * turn(angle)[:, None, :]).astype(int) for turn in (np.sin, np.cos))
        cell = (ring * sensor.wedges + wedge)[:, None, None]
        parts.append(np.unique((cell * side + y) * side + x, return_counts=True))
    hits, count = (np.concatenate(part) for part in zip(*parts, strict=True))
    return hits // side**2, hits % side**2, count / _SAMPLES**2


@functools.lru_cache
def cell_of_pixel(sensor: LogPolarSensor) -> tuple[np.ndarray, np.ndarray]:
    """Returns, for each pixel of the window [side, side], the cell that its centre lies in, and if it lies in any."""
    offset = np.arange(sensor.window[0]) + 0.5 - sensor.window[0] / 2
    radius = np.hypot(offset[:, None], offset)
    ring = np.searchsorted(ring_edges(sensor)[1:], radius, side="right")
    turn = np.arctan2(offset[:, None], offset) / (2 * math.pi) % 1.0
    wedge = np.minimum((turn * sensor.wedges).astype(int), sensor.wedges - 1)
    return np.minimum(ring, sensor.rings - 1) * sensor.wedges + wedge, ring < sensor.rings
