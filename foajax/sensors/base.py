"""What a sensor is: the protocol, which one a configuration asks for, and what all of them share.

`docs/extending.md` has a complete example of one's own.
"""

from __future__ import annotations

import math
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Float, Int, Num

from foajax.sensors.geometry import PixelCount, Shape


@runtime_checkable
class Sensor(Protocol):
    """A frame and a focal point in, one image or several out. A class of one's own inherits what it does not define.

    Conventions. The focal point is (y, x) in frame pixels, int32. An area of h x w pixels around it covers rows
    y - h//2 .. y - h//2 + h - 1 (70 at y = 40: rows 5..74), columns likewise; an even area is thus centred on the
    corner between four pixels. What lies outside the frame counts as 0 and what is hidden is 0: frames are normalised
    before they are sensed. Values are not rescaled.

    `sense` and `picture` are pure functions of one gray frame, which JAX compiles and vmaps; colours are sensed one
    channel at a time.
    """

    window: Shape  # height and width of the focal area, frame pixels

    def sense(self, frame: Num[Array, "H W"], focal_point: Int[Array, "2"], bounds: str) -> tuple[Array, ...]:
        """What is seen of a frame, float32 images [h, w] of `image_shapes`.

        With bounds 'window' the focal area lies inside the frame; with 'point' it may overhang.
        """

    def image_shapes(self, frame_shape: Shape) -> tuple[Shape, ...]:
        """Heights and widths of what `sense` gives."""

    def picture(
        self, images: tuple[Float[Array, "_ _"], ...], focal_point: Int[Array, "2"], frame_shape: Shape
    ) -> Float[Array, "H W"]:
        """What `sense` gave, put back in the frame's place; 0 where nothing was seen."""

    def count(self, frame_shape: Shape) -> PixelCount:
        """The pixel budget for a frame that the focal area fits into."""
        values = sum(math.prod(shape) for shape in self.image_shapes(frame_shape))
        return PixelCount(values, values)

    @property
    def packed(self) -> Sensor:
        """The sensor that gives the same values, each once."""
        return self

    @property
    def in_place(self) -> bool:
        """Whether the image is a frame with each value at its place, so that it tells where it was taken."""
        return False

    @property
    def areas(self) -> tuple[Shape, ...]:
        """Heights and widths of the areas to be drawn around the focal point, inner to outer."""
        return (self.window,)

    @property
    def finest(self) -> Shape:
        """Height and width of the part that is seen best, frame pixels."""
        return self.areas[0]

    @property
    def is_round(self) -> bool:
        """Whether they are ellipses."""
        return False


def boxes(
    sensor: Sensor, focal_point: Int[Array, "2"] | np.ndarray | tuple[int, int]
) -> list[tuple[int, int, int, int]]:
    """The areas' rectangles (top, left, height, width) in frame pixels, inner to outer. They may overhang the frame."""
    y, x = (int(coordinate) for coordinate in focal_point)
    return [(y - height // 2, x - width // 2, height, width) for height, width in sensor.areas]
