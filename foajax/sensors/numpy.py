"""The sensors in NumPy, without JAX: for forked processes, small machines and programs of other libraries.

Tests check that the results equal those of `foajax.sense` and `foajax.picture`, up to rounding. `robot/agent.py` has a
form of its own: it is one file to be copied, for single frames, with the normalisation in the weights.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Num

from foajax.config.parse import refuse
from foajax.config.schema import LogPolarSensor, RingSensor
from foajax.sensors.geometry import (
    Shape,
    block_edges,
    cell_edges,
    cell_of_pixel,
    check_look,
    covered,
    hidden_blocks,
    move_inside,
    offsets,
    shares,
)


def sense(
    frame: Num[np.ndarray, "H W *C"],
    focal_point: Int[Any, "2"],
    *,
    sensor: Any,
    bounds: str = "point",
) -> tuple[Float[np.ndarray, "_ _ _"], ...]:
    """Returns what a sensor sees of one frame; arguments, results and errors are those of `foajax.sense`.

    It refuses a sensor of your own, which is written in JAX.
    """
    frame, focal_point = np.asarray(frame), np.asarray(focal_point)
    if not isinstance(sensor, RingSensor | LogPolarSensor):
        raise refuse("sensor", sensor, "a RingSensor or a LogPolarSensor; foajax.sense takes your own")
    check_look(frame, focal_point, sensor.window, bounds)
    frames = frame.reshape(1, *frame.shape[:2], -1)
    return tuple(image[0] for image in sense_many(frames, focal_point[None], sensor=sensor, bounds=bounds))


def picture(
    images: tuple[Float[np.ndarray, "_ _ C"], ...],
    focal_point: Int[Any, "2"],
    *,
    sensor: RingSensor | LogPolarSensor,
    frame_shape: Shape,
) -> Float[np.ndarray, "H W C"]:
    """Draws what `sense` returned at its place in the frame, as `foajax.picture` does."""
    if isinstance(sensor, RingSensor) and sensor.layout == "canvas":
        return images[0]
    channels = images[0].shape[-1]
    frame = np.zeros((*frame_shape, channels), np.float32)
    if isinstance(sensor, LogPolarSensor):
        cell, inside = cell_of_pixel(sensor)
        area = np.where(inside[..., None], images[0].reshape(-1, channels)[cell], np.float32(0))
    else:
        area = _paint(images, sensor)
        if sensor.peripheral is not None:
            rows, columns = (np.diff(edges) for edges in cell_edges(sensor, frame_shape))
            frame = images[-1].repeat(rows, 0).repeat(columns, 1)
    top, left = np.asarray(focal_point) - np.array(sensor.window) // 2
    y, x = max(top, 0), max(left, 0)
    room = frame[y : max(top + len(area), 0), x : max(left + area.shape[1], 0)]
    room[:] = area[y - top : y - top + room.shape[0], x - left : x - left + room.shape[1]]
    return frame


def sense_many(
    frames: Num[np.ndarray, "B H W C"],
    focal_points: Int[np.ndarray, "B 2"],
    *,
    sensor: RingSensor | LogPolarSensor,
    bounds: str = "point",
) -> tuple[Float[np.ndarray, "B _ _ C"], ...]:
    """Senses many frames, each at a focal point of its own: `sense` for a batch, unchecked."""
    shape = (frames.shape[1], frames.shape[2])
    if bounds == "window":
        focal_points = move_inside(focal_points, sensor.window, shape)
    corners = focal_points - np.array(sensor.window) // 2
    windows = _cut(frames, corners, sensor.window)
    if isinstance(sensor, LogPolarSensor):
        pixel, weight, first = _tables(sensor)
        cells = np.add.reduceat(windows.reshape(len(windows), -1, frames.shape[3])[:, pixel] * weight, first, axis=1)
        return (cells.reshape(len(windows), sensor.rings, sensor.wedges, -1),)
    images = _pool(windows, sensor)
    for image, hidden in zip(images[1:], hidden_blocks(sensor), strict=True):
        image[:, hidden] = 0
    if sensor.peripheral is not None:
        edges = cell_edges(sensor, shape)
        images.append(_cells(frames, edges, sensor))
        for cells, corner in zip(images[-1], corners, strict=True):
            rows, columns = (covered(edges[axis], corner[axis], sensor.window[axis]) for axis in (0, 1))
            cells[rows[:, None] & columns] = 0
    if sensor.layout == "packed":
        return tuple(images)
    packed = sensor.model_copy(update={"layout": "packed"})
    parts = zip(zip(*images, strict=True), focal_points, strict=True)
    return (np.stack([picture(part, point, sensor=packed, frame_shape=shape) for part, point in parts]),)


def _cut(frames: np.ndarray, corners: np.ndarray, size: Shape) -> np.ndarray:
    """Cuts areas of `size` with their top-left pixels at `corners`: float32 [B, h, w, C], 0 outside of the frames."""
    windows = np.zeros((len(frames), *size, frames.shape[3]), np.float32)
    for window, frame, (top, left) in zip(windows, frames, corners.tolist(), strict=True):
        y, x = max(top, 0), max(left, 0)
        part = frame[y : max(top + size[0], 0), x : max(left + size[1], 0)]
        window[y - top : y - top + part.shape[0], x - left : x - left + part.shape[1]] = part
    return windows


def _pool(windows: np.ndarray, sensor: RingSensor) -> list[np.ndarray]:
    """Returns each ring's blocks, before hiding: the mean of a block, or its first pixel."""
    parts = []
    for (height, width, factor), (top, left) in zip(sensor.rings, offsets(sensor), strict=True):
        area = windows[:, top : top + height, left : left + width]
        if sensor.pooling == "stride" or factor == 1:
            parts.append(area[:, ::factor, ::factor].copy())
            continue
        rows, columns = (np.diff(block_edges(size, factor)) for size in (height, width))
        sums = _block_sums(_block_sums(area, factor, 1), factor, 2)
        parts.append(sums / np.outer(rows, columns).astype(np.float32)[..., None])
    return parts


def _block_sums(x: np.ndarray, factor: int, axis: int) -> np.ndarray:
    """Sums every `factor` rows or columns; the last block may have fewer. Faster than `np.add.reduceat`."""
    x = np.moveaxis(x, axis, 0)
    sums = x[::factor].copy()
    for i in range(1, factor):
        part = x[i::factor]
        sums[: len(part)] += part
    return np.moveaxis(sums, 0, axis)


def _cells(frames: np.ndarray, edges: list[np.ndarray], sensor: RingSensor) -> np.ndarray:
    """Returns the cells of the peripheral grid, before hiding: the mean of a cell, or its first pixel."""
    rows, columns = edges
    if sensor.pooling == "stride":
        return frames[:, rows[:-1]][:, :, columns[:-1]].astype(np.float32)
    sums = np.add.reduceat(np.add.reduceat(frames, rows[:-1], 1, np.float32), columns[:-1], 2)
    return sums / np.outer(np.diff(rows), np.diff(columns)).astype(np.float32)[..., None]


def _paint(images: tuple[np.ndarray, ...], sensor: RingSensor) -> np.ndarray:
    """Paints every ring's values over the pixels of the focal area that they stand for, coarse to fine."""
    area = np.zeros((*sensor.window, images[0].shape[-1]), np.float32)
    rings = zip(images, sensor.rings, offsets(sensor), strict=False)  # the last image may be the grid
    for image, (height, width, factor), (top, left) in reversed(list(rings)):
        blocks = image.repeat(factor, 0).repeat(factor, 1)[:height, :width]
        area[top : top + height, left : left + width] = blocks
    return area


@functools.lru_cache
def _tables(sensor: LogPolarSensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the pixels and the weights [n, 1] of all `shares`, and where each cell's begin."""
    cell, pixel, weight = shares(sensor)
    first = np.searchsorted(cell, np.arange(sensor.rings * sensor.wedges))
    return pixel.astype(int), weight.astype(np.float32)[:, None], first
