"""Draws what a sensor saw by looking its values up in tables of indices.

Which value a pixel shows depends only on the pixel's place in the focal area or, outside of it, in the frame. So a
recording keeps only the values, and any program can draw them with two tables.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Int, UInt8

from foajax.sensors.base import Sensor


class Painting(NamedTuple):
    """Indices into the values of all images of a packed sensor, laid end to end; -1 where nothing is seen."""

    window: Int[np.ndarray, "h w"]  # of the focal area's pixels
    background: Int[np.ndarray, "H W"]  # of the frame's pixels, where the focal area is elsewhere


def tables(sensor: Sensor, frame_shape: tuple[int, int]) -> Painting:
    """Makes the tables of a packed sensor: its picture of images whose values are their own numbers."""
    images, count = [], 1  # 0 is what `picture` shows where nothing was seen
    for shape in sensor.image_shapes(frame_shape):
        size = int(np.prod(shape))
        images.append(jnp.arange(count, count + size, dtype=jnp.float32).reshape(shape))
        count += size
    height, width = sensor.window
    # A peripheral grid may be finer than the focal area, so where that fits, it is cut out of a whole frame.
    shape = frame_shape if height <= frame_shape[0] and width <= frame_shape[1] else (height, width)
    top, left = shape[0] // 2 - height // 2, shape[1] // 2 - width // 2
    inside = sensor.picture(tuple(images), jnp.array(shape) // 2, shape)[top : top + height, left : left + width]
    # A frame that the focal area has just left.
    outside = jnp.array([height // 2 - height, width // 2 - width])
    beside = sensor.picture(tuple(images), outside, frame_shape)
    return Painting(*(np.asarray(p).round().astype(np.int32) - 1 for p in (inside, beside)))


def paint(
    values: UInt8[np.ndarray, "n *C"], focal_point: Int[np.ndarray, "2"], painting: Painting
) -> UInt8[np.ndarray, "H W *C"]:
    """Draws one step's values; 0 where nothing is seen."""
    values = np.concatenate([values, np.zeros_like(values[:1])])  # what the index -1 finds
    image = values[painting.background]
    size = np.array(painting.window.shape)
    first = np.asarray(focal_point) - size // 2
    low, high = np.maximum(first, 0), np.minimum(first + size, image.shape[:2])
    seen = painting.window[low[0] - first[0] : high[0] - first[0], low[1] - first[1] : high[1] - first[1]]
    image[low[0] : high[0], low[1] : high[1]] = values[seen]
    return image
