"""What a sensor is: the protocol, and what all sensors share.

`docs/extending.md` has a complete example of one of your own.
"""

from __future__ import annotations

import math
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Float, Int, Num

from foajax.sensors.geometry import PixelCount, Shape


@runtime_checkable
class Sensor(Protocol):
    """Makes one or more images of a frame and a focal point.

    Define `window`, `sense`, `image_shapes` and `picture` in your own class; it inherits the rest. `sense` and
    `picture` are pure functions of one gray frame, which JAX compiles and vmaps. Colours are sensed channel by channel.

    The focal point is (y, x) in frame pixels, int32. An area of h x w pixels around it covers rows y - h//2 to
    y - h//2 + h - 1, and columns likewise: 70 rows at y = 40 are rows 5 to 74. What is hidden, or outside the frame, is
    0. Training normalises frames before they are sensed, so that 0 is what never changes. Values are not rescaled.
    In other programs frames may be uint8: cast them before you subtract.

    Attributes:
      window: height and width of the focal area, frame pixels.
    """

    window: Shape

    def sense(self, frame: Num[Array, "H W"], focal_point: Int[Array, "2"], bounds: str) -> tuple[Array, ...]:
        """Returns what is seen of a frame: float32 images [h, w], whose shapes are `image_shapes`.

        With bounds 'window' the focal area is inside the frame; with 'point' it may overhang.
        """

    def image_shapes(self, frame_shape: Shape) -> tuple[Shape, ...]:
        """Returns (h, w) of each image of `sense`."""

    def picture(
        self, images: tuple[Float[Array, "_ _"], ...], focal_point: Int[Array, "2"], frame_shape: Shape
    ) -> Float[Array, "H W"]:
        """Draws the images of `sense` at their place in a frame of zeros."""

    def count(self, frame_shape: Shape) -> PixelCount:
        """Counts the values that are seen of a frame, at least as large as the focal area."""
        values = sum(math.prod(shape) for shape in self.image_shapes(frame_shape))
        return PixelCount(values, values)

    @property
    def packed(self) -> Sensor:
        """The sensor in the packed layout: it gives the same values without a canvas."""
        return self

    @property
    def in_place(self) -> bool:
        """Whether `sense` gives a canvas: an image of the frame's size with each value at its place."""
        return False

    @property
    def areas(self) -> tuple[Shape, ...]:
        """Heights and widths of the outlines that pictures draw around the focal point, inner to outer."""
        return (self.window,)

    @property
    def finest(self) -> Shape:
        """Height and width of the part that is seen best, frame pixels: what `gaze.bounds=fovea` keeps inside."""
        return self.areas[0]

    @property
    def is_round(self) -> bool:
        """Whether these outlines are ellipses; else they are rectangles."""
        return False


def boxes(
    sensor: Sensor, focal_point: Int[Array, "2"] | np.ndarray | tuple[int, int]
) -> list[tuple[int, int, int, int]]:
    """The areas' rectangles (top, left, height, width) in frame pixels, inner to outer. They may overhang the frame."""
    y, x = (int(coordinate) for coordinate in focal_point)
    return [(y - height // 2, x - width // 2, height, width) for height, width in sensor.areas]
