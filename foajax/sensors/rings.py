"""Nested areas of blocks, and the coarse grid around them: the geometry of a `RingSensor`."""

from __future__ import annotations

import functools
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, Num

from foajax.config.parse import refuse
from foajax.config.schema import RingSensor
from foajax.sensors.window import Shape, place


def block_sums(x: Float[Array, "_ _"], factor: int, axis: int) -> Float[Array, "_ _"]:
    """Sums over consecutive `factor` rows or columns; the last block may have fewer.

    Added up as strided slices: on a CPU many times faster than to reduce a reshaped axis.
    """
    size = x.shape[axis]
    whole = size - size % factor
    slices = [lax.slice_in_dim(x, first, whole, factor, axis) for first in range(factor)]
    sums = functools.reduce(jnp.add, slices)
    if whole == size:
        return sums
    rest = lax.slice_in_dim(x, whole, size, axis=axis).sum(axis, keepdims=True)
    return jnp.concatenate([sums, rest], axis)


def sense_cells(frame: Num[Array, "H W"], sensor: RingSensor) -> Float[Array, "rows columns"]:
    """The peripheral grid: the whole frame, coarse, nothing hidden yet."""
    height, width = frame.shape
    rows, columns = cell_edges(sensor, (height, width))
    if not (np.diff(rows).all() and np.diff(columns).all()):
        accepted = f"a grid no finer than the frame, {height}x{width}"
        raise refuse("sensor.peripheral", sensor.peripheral, accepted)
    if sensor.pooling == "stride":
        return frame[rows[:-1]][:, columns[:-1]].astype(jnp.float32)
    # Whole columns of the product are contiguous sums; 'highest' keeps accelerators from rounding.
    means = jnp.einsum("hw,vw->hv", frame.astype(jnp.float32), _averages(columns), precision="highest")
    return jnp.einsum("hv,uh->uv", means, _averages(rows), precision="highest")


def _averages(edges: np.ndarray) -> np.ndarray:
    """A matrix [n, size] that takes the means over the n intervals between `edges`."""
    position = np.arange(edges[-1])
    inside = (position >= edges[:-1, None]) & (position < edges[1:, None])
    return (inside / np.diff(edges)[:, None]).astype(np.float32)


def canvas(
    parts: tuple[Float[Array, "_ _"], ...],
    cells: Float[Array, "_ _"] | None,
    corner: Int[Array, "2"],
    sensor: RingSensor,
    frame_shape: Shape,
) -> Float[Array, "H W"]:
    """Paints every value over the pixels that it stands for, coarse to fine."""
    area = jnp.zeros(sensor.window, jnp.float32)
    for part, (height, width, factor), (top, left) in reversed(
        [*zip(parts, sensor.rings, offsets(sensor), strict=True)]
    ):
        blocks = jnp.repeat(jnp.repeat(part, factor, 1), factor, 0)[:height, :width]
        area = area.at[top : top + height, left : left + width].set(blocks)
    frame = place(area, corner, frame_shape)
    if cells is None:
        return frame
    for axis, edges in enumerate(cell_edges(sensor, frame_shape)):
        cells = _repeat(cells, np.diff(edges), axis)
    rows, columns = (
        (np.arange(size) >= first) & (np.arange(size) < first + length)
        for size, first, length in zip(frame_shape, corner, sensor.window, strict=True)
    )
    return jnp.where(rows[:, None] & columns[None], frame, cells)


def _repeat(x: Float[Array, "_ _"], counts: np.ndarray, axis: int) -> Float[Array, "_ _"]:
    """Each row or column as often as `counts` says; equal counts need no gather."""
    if (counts == counts[0]).all():
        return jnp.repeat(x, int(counts[0]), axis)
    return jnp.take(x, np.repeat(np.arange(len(counts)), counts), axis)


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
