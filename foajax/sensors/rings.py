"""Nested areas of blocks, and the coarse grid around them: the sensor of the paper (Table II)."""

from __future__ import annotations

import functools

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, Num

from foajax.config.parse import replace
from foajax.config.schema import RingSensor
from foajax.sensors.base import Sensor
from foajax.sensors.geometry import (
    PixelCount,
    Shape,
    block_edges,
    cell_edges,
    covered,
    hidden_blocks,
    offsets,
    ring_count,
    ring_shapes,
)
from foajax.sensors.window import look, place


class Rings(Sensor):
    """Nested areas pooled in blocks (the RoI layers of the paper, Table II).

    The blocks of a ring are aligned to its own top-left corner; where they do not divide it, the last
    ones are smaller. A block's value is its mean, zeros outside the frame included ('mean'), or its
    top-left pixel ('stride'). A finer ring hides what lies under it; a block that it covers in part
    is pooled whole and shown where it is not covered. The peripheral grid is the whole frame, cut
    at rows i * H // rows and columns likewise, pooled and hidden by the focal area in the same way.

    - layout 'canvas': one image of the frame's size, each value painted over the pixels that it
      stands for.
    - layout 'packed': one image a ring, one value a block, then the grid; hidden ones are 0. The
      canvas's values, each once.
    """

    def __init__(self, config: RingSensor) -> None:
        self.config, self.window = config, config.window

    def sense(
        self, frame: Num[Array, "H W"], focal_point: Int[Array, "2"], bounds: str
    ) -> tuple[Float[Array, "_ _"], ...]:
        config, shape = self.config, (frame.shape[0], frame.shape[1])
        parts = look(frame, focal_point, bounds, size=self.window, pool=self._pool)
        cells = None if config.peripheral is None else sense_cells(frame, config)
        corner = focal_point - np.array(self.window) // 2
        if self.in_place:
            return (canvas(parts, cells, corner, config, shape),)
        hidden = hidden_blocks(config)
        images = [parts[0], *(jnp.where(h, 0.0, part) for h, part in zip(hidden, parts[1:], strict=True))]
        if cells is not None:
            edges = cell_edges(config, shape)
            rows, columns = (covered(edges[axis], corner[axis], self.window[axis]) for axis in (0, 1))
            images.append(jnp.where(rows[:, None] & columns[None], 0.0, cells))
        return tuple(images)

    def image_shapes(self, frame_shape: Shape) -> tuple[Shape, ...]:
        return (frame_shape,) if self.in_place else ring_shapes(self.config)

    def picture(
        self, images: tuple[Float[Array, "_ _"], ...], focal_point: Int[Array, "2"], frame_shape: Shape
    ) -> Float[Array, "H W"]:
        if self.in_place:
            return images[0]
        corner, number = focal_point - np.array(self.window) // 2, len(self.config.rings)
        cells = images[number] if self.config.peripheral else None
        return canvas(images[:number], cells, corner, self.config, frame_shape)

    def count(self, frame_shape: Shape) -> PixelCount:
        """Counts the pixel budget as Table II does, and the values really shown.

        Nominal: each ring's area less that of the next finer one, over its factor squared, rounded; a
        peripheral grid adds the largest number of cells that an area inside the frame leaves visible
        (16 for 70x70 in 5x5). Actual differs where blocks do not divide an area (70 by 4) or straddle
        a finer ring.
        """
        return ring_count(self.config, frame_shape)

    @functools.cached_property
    def packed(self) -> Rings:
        return Rings(replace(self.config, layout="packed")) if self.in_place else self

    @property
    def in_place(self) -> bool:
        return self.config.layout == "canvas"

    @property
    def areas(self) -> tuple[Shape, ...]:
        return tuple(ring[:2] for ring in self.config.rings)

    def _pool(self, window: Num[Array, "h w"]) -> tuple[Float[Array, "_ _"], ...]:
        """Returns each ring's blocks, before hiding: the mean of a block, or its first pixel."""
        parts, window = [], window.astype(jnp.float32)
        for (height, width, factor), (top, left) in zip(self.config.rings, offsets(self.config), strict=True):
            area = window[top : top + height, left : left + width]
            if self.config.pooling == "stride" or factor == 1:
                parts.append(area[::factor, ::factor])
                continue
            # Rows first: they are added up whole before anything is picked apart.
            sums = block_sums(block_sums(area, factor, 0), factor, 1)
            rows, columns = (np.diff(block_edges(size, factor)) for size in (height, width))
            parts.append(sums / np.outer(rows, columns).astype(np.float32))
        return tuple(parts)


def block_sums(x: Float[Array, "_ _"], factor: int, axis: int) -> Float[Array, "_ _"]:
    """Sums every `factor` consecutive rows or columns; the last block may have fewer.

    Adding strided slices is many times faster on a CPU than reducing a reshaped axis.
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
    """Returns the peripheral grid, before hiding: the whole frame, coarse."""
    height, width = frame.shape
    rows, columns = cell_edges(sensor, (height, width))
    if sensor.pooling == "stride":
        return frame[rows[:-1]][:, columns[:-1]].astype(jnp.float32)
    frame, size = frame.astype(jnp.float32), int(rows[1])
    if np.all(np.diff(rows) == size):  # an eighth of the arithmetic of the product
        means = block_sums(frame, size, 0) / size
    else:
        means = jnp.einsum("hw,uh->uw", frame, _averages(rows), precision="highest")  # keeps accelerators from rounding
    return jnp.einsum("uw,vw->uv", means, _averages(columns), precision="highest")


def _averages(edges: np.ndarray) -> np.ndarray:
    """Returns a matrix [n, size] that takes the means over the n intervals between `edges`."""
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
    """Repeats each row or column as often as `counts` says; equal counts need no gather."""
    if (counts == counts[0]).all():
        return jnp.repeat(x, int(counts[0]), axis)
    return jnp.take(x, np.repeat(np.arange(len(counts)), counts), axis)
