"""A log-polar retina: cells in rings around the focal point, growing with the distance from it.

The geometry is our choice. The focal point (y, x) means the corner between pixels (y - 1, x - 1) and (y, x), as
for every area of even size, so that a disc of radius 40 fits an 80 x 80 frame exactly. The outer
edges of the rings grow geometrically from `fovea` to `radius`; the innermost ring is the whole disc
of radius `fovea`, so there is no blind spot. Wedge j spans the angles 2 pi [j, j + 1) / wedges, from
the x axis towards the y axis: clockwise on the screen, as in OpenCV's `warpPolar`.

Which pixels make a cell is worked out once per sensor, in NumPy. Sensing is a gather and a weighted
sum, at the same cost wherever the focal point is. Windows are squares of side 2 * ceil(radius).
"""

from __future__ import annotations

import functools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Num

from foajax.config.schema import LogPolarSensor
from foajax.sensors.base import Sensor
from foajax.sensors.geometry import Shape, cell_of_pixel, shares
from foajax.sensors.window import look, place


class LogPolar(Sensor):
    """The retina as a sensor: one image [rings, wedges]."""

    is_round = True

    def __init__(self, config: LogPolarSensor) -> None:
        self.config, self.window = config, config.window

    @property
    def finest(self) -> Shape:
        return self.config.finest

    def sense(self, frame: Num[Array, "H W"], focal_point: Int[Array, "2"], bounds: str) -> tuple[Array, ...]:
        return look(frame, focal_point, bounds, size=self.window, pool=self._warp)

    def image_shapes(self, frame_shape: Shape) -> tuple[Shape, ...]:
        return ((self.config.rings, self.config.wedges),)

    def picture(
        self, images: tuple[Float[Array, "_ _"], ...], focal_point: Int[Array, "2"], frame_shape: Shape
    ) -> Float[Array, "H W"]:
        window = unwarp(images[0], sensor=self.config)
        return place(window, focal_point - np.array(self.window) // 2, frame_shape)

    def _warp(self, window: Num[Array, "side side"]) -> tuple[Float[Array, "rings wedges"]]:
        """Senses a window of the frame; inner rings come first, values are not rescaled.

        'bilinear' samples each cell's centre, between four pixels: sharp, but a cell larger than a few
        pixels misses what lies between the centres. 'area' takes the mean over each cell's area, at 32 x 32
        points: up to about as many pixels it does not alias. Cells smaller than a pixel show the pixels under them.
        """
        pixels = window.astype(jnp.float32).reshape(-1)
        cells = [(pixels[index] * weight).sum(1) for index, weight in _tables(self.config)]
        return (jnp.concatenate(cells).reshape(self.config.rings, self.config.wedges),)


def unwarp(image: Float[Array, "rings wedges"], *, sensor: LogPolarSensor) -> Float[Array, "side side"]:
    """Draws the image back: each pixel shows the cell that its centre lies in, 0 outside the disc."""
    cell, inside = cell_of_pixel(sensor)
    return jnp.where(inside, image.reshape(-1)[cell], 0.0)


@functools.lru_cache
def _tables(sensor: LogPolarSensor) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Returns pixel indices and weights, each [cells, k], for one group of rings after the other.

    Rows are padded to k with weight 0. Outer cells have more pixels, and one k for all would triple the work. So the
    rings are grouped by k, within a factor of 1.4.
    """
    cell, pixel, weight = shares(sensor)
    counts = np.bincount(cell, minlength=sensor.rings * sensor.wedges)
    slot = np.arange(len(cell)) - np.repeat(np.cumsum(counts) - counts, counts)
    index = np.zeros((len(counts), counts.max()), np.int32)
    index[cell, slot] = pixel
    weights = np.zeros(index.shape, np.float32)
    weights[cell, slot] = weight
    widths = counts.reshape(sensor.rings, sensor.wedges).max(1)
    starts = [0, *np.flatnonzero(np.diff(np.ceil(2 * np.log2(widths)))) + 1, sensor.rings]
    tables = []
    for first, last in zip(starts, starts[1:], strict=False):
        rows, k = slice(first * sensor.wedges, last * sensor.wedges), widths[first:last].max()
        tables.append((index[rows, :k], weights[rows, :k]))
    return tuple(tables)
