"""Finds the image in another library's observation, and scales its values."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
from gymnasium import spaces
from jaxtyping import Num

from foajax.config.parse import brief, refuse

_ACCEPTED = (
    "a Box of unsigned integers or floats, [H, W], channels last or first, or a stack of such images,"
    " of 8x8 pixels and more"
)


@dataclasses.dataclass(frozen=True)
class Pixels:
    """How to read one kind of image, and what sensors' images of it become."""

    box: spaces.Box  # of one image
    key: str | None  # of the image in a Dict observation; None where it is the observation
    axes: tuple[int, ...]  # of the image: rows, columns, and then what counts as channels
    dtype: np.dtype  # of the sensors' images

    @classmethod
    def of(cls, space: spaces.Space, key: str | None, dtype: str) -> Pixels:
        """Finds the image; raises `ConfigError` where there is none, or its values do not fit `dtype`."""
        box = space
        if isinstance(space, spaces.Dict):
            if key not in space.spaces:
                raise refuse("image_key", str(key), space.spaces.keys())
            box = space[key]
        elif key is not None:
            raise refuse("image_key", key, f"None, because the observation is no Dict but {brief(space)}")
        axes = _axes(box.shape or ())
        numbers = box.dtype is not None and (box.dtype.kind == "u" or np.issubdtype(box.dtype, np.floating))
        if not (isinstance(box, spaces.Box) and axes and numbers):
            raise refuse("observation_space", box, _ACCEPTED)
        found = cls(box=box, key=key, axes=axes, dtype=np.dtype(dtype))
        if found.dtype == np.uint8 and not (box.low.min() >= 0 and 0 < box.high.max() < math.inf):
            raise refuse("dtype", dtype, f"numpy.float32 where pixels are {brief(box)}")
        return found

    @property
    def frame_shape(self) -> tuple[int, int]:
        return self.box.shape[self.axes[0]], self.box.shape[self.axes[1]]

    @property
    def channels(self) -> int:
        """The number of colours times that of stacked images."""
        return math.prod(self.box.shape) // math.prod(self.frame_shape)

    @property
    def scale(self) -> float:
        """The factor for pixels. It brings integers to [0, 1], or any pixels to 0..255 if uint8 is asked for."""
        if self.box.dtype.kind == "u":
            whole = 256.0**self.box.dtype.itemsize - 1
        else:
            whole = float(self.box.high.max()) if self.dtype == np.uint8 else 1.0
        return (255 if self.dtype == np.uint8 else 1) / whole

    @property
    def range(self) -> tuple[float, float]:
        """The least and the greatest value of a sensor's image; what is hidden is 0."""
        if self.dtype == np.uint8:
            return 0.0, 255.0
        return min(float(self.box.low.min()) * self.scale, 0.0), max(float(self.box.high.max()) * self.scale, 0.0)

    def frames(self, images: Num[np.ndarray, "B ..."]) -> Num[np.ndarray, "B H W C"]:
        """Reshapes a batch of images: channels last, stacked images among them."""
        images = images.transpose(0, *(axis + 1 for axis in self.axes))
        return images.reshape(len(images), *self.frame_shape, self.channels)

    def finish(self, image: np.ndarray) -> np.ndarray:
        """Brings a sensor's image to the range and the type that are asked for."""
        # A mean may round to just outside the range, and then would not be of the observation space.
        image = (image * np.float32(self.scale)).clip(*self.range)
        return (image.round() if self.dtype == np.uint8 else image).astype(self.dtype)


def dtype_name(dtype: Any) -> str:
    """Returns the name of a type that images can have; raises `ConfigError` for another."""
    name = getattr(dtype, "__name__", str(dtype))
    if name not in ("float32", "uint8"):
        raise refuse("dtype", name, ("float32", "uint8"))
    return name


def _axes(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Orders an image's axes: rows, columns, then a stack, then colours; empty for a shape that is no image."""
    if len(shape) == 2:
        axes: tuple[int, ...] = (0, 1)
    elif len(shape) == 3:
        axes = (1, 2, 0) if shape[0] < shape[2] else (0, 1, 2)
    elif len(shape) == 4:
        rows, columns, colours = (axis + 1 for axis in _axes(shape[1:]) or (0, 1, 2))
        axes = (rows, columns, 0, colours)
    else:
        return ()
    sides, others = [shape[axis] for axis in axes[:2]], [shape[axis] for axis in axes[2:]]
    return axes if min(sides) >= 8 and all(1 <= n < min(sides) for n in others) else ()
