"""From the values of a sensor to the picture of what it sees, directly or as one table of indices.

`picture` puts what a sensor gave back in the frame's place. Which value a pixel shows depends only on the
pixel's place in the focal area or, outside of it, in the frame. So a recording needs to keep the values alone, and
whoever draws them, in whatever language, needs two tables.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from foajax.config.parse import replace
from foajax.config.schema import LogPolarSensor, RingSensor, Sensor
from foajax.sensors import logpolar
from foajax.sensors.rings import canvas
from foajax.sensors.sense import image_shapes
from foajax.sensors.window import Shape, place


def picture(
    images: tuple[Float[Array, "_ _ C"], ...],
    focal_point: Int[Array, "2"],
    *,
    sensor: Sensor,
    frame_shape: Shape,
) -> Float[Array, "H W C"]:
    """What `sense` gave, put back in the frame's place; 0 where nothing was seen.

    Both layouts of a `RingSensor` give the canvas; a log-polar image is warped back. `focal_point` is where the area
    lay: with bounds 'window', the point after it was moved inside.
    """
    if isinstance(sensor, RingSensor) and sensor.layout == "canvas":
        return images[0]
    gray = functools.partial(_picture_gray, focal_point=focal_point, sensor=sensor, frame_shape=frame_shape)
    return jax.vmap(gray, in_axes=2, out_axes=2)(images)


def _picture_gray(
    images: tuple[Float[Array, "_ _"], ...], focal_point: Int[Array, "2"], sensor: Sensor, frame_shape: Shape
) -> Float[Array, "H W"]:
    """`picture` for one channel."""
    corner = focal_point - np.array(sensor.window) // 2
    if isinstance(sensor, LogPolarSensor):
        return place(logpolar.unwarp(images[0], sensor=sensor), corner, frame_shape)
    parts, cells = images[: len(sensor.rings)], images[len(sensor.rings) :]
    return canvas(parts, cells[0] if cells else None, corner, sensor, frame_shape)


class Painting(NamedTuple):
    """Indices into the values of all images of a packed sensor, laid end to end; -1 where nothing is seen."""

    window: Int[np.ndarray, "h w"]  # of the focal area's pixels
    background: Int[np.ndarray, "H W"]  # of the frame's pixels, where the focal area is elsewhere


def packed(sensor: Sensor) -> Sensor:
    """The sensor that gives the same values, each once."""
    return replace(sensor, layout="packed") if isinstance(sensor, RingSensor) else sensor


def tables(sensor: Sensor, frame_shape: tuple[int, int]) -> Painting:
    """The tables of a packed sensor: the picture of images whose values are their own numbers."""
    images, count = [], 1  # 0 is what `picture` shows where nothing was seen
    for shape in image_shapes(sensor, frame_shape):
        size = int(np.prod(shape))
        images.append(jnp.arange(count, count + size, dtype=jnp.float32).reshape(shape))
        count += size
    height, width = sensor.window
    # A frame that the focal area fills, and one that it has just left.
    inside = picture(tuple(images), jnp.array([height // 2, width // 2]), sensor=sensor, frame_shape=(height, width))
    outside = jnp.array([height // 2 - height, width // 2 - width])
    beside = picture(tuple(images), outside, sensor=sensor, frame_shape=frame_shape)
    return Painting(*(np.asarray(p[..., 0]).round().astype(np.int32) - 1 for p in (inside, beside)))


def paint(
    values: UInt8[np.ndarray, "n"], focal_point: Int[np.ndarray, "2"], painting: Painting
) -> UInt8[np.ndarray, "H W"]:
    """The picture of one step's values; 0 where nothing is seen."""
    values = np.append(values, np.uint8(0))  # what the index -1 finds
    image = values[painting.background]
    size = np.array(painting.window.shape)
    first = np.asarray(focal_point) - size // 2
    low, high = np.maximum(first, 0), np.minimum(first + size, image.shape)
    seen = painting.window[low[0] - first[0] : high[0] - first[0], low[1] - first[1] : high[1] - first[1]]
    image[low[0] : high[0], low[1] : high[1]] = values[seen]
    return image
