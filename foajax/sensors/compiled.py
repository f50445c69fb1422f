"""`sense` and `picture` for other programs: compiled once per sensor and frame shape, then milliseconds."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Num

from foajax.config.schema import SensorConfig
from foajax.runtime import refuse_fork
from foajax.sensors import sense as pure
from foajax.sensors.base import Sensor
from foajax.sensors.geometry import Shape
from foajax.sensors.registry import make_sensor
from foajax.types import HostArray

_sense = jax.jit(pure.sense, static_argnames=("sensor", "bounds"))
_picture = jax.jit(pure.picture, static_argnames=("sensor", "frame_shape"))


def sense(
    frame: Num[HostArray, "H W *C"],
    focal_point: Int[HostArray, "2"],
    *,
    sensor: SensorConfig | Sensor,
    bounds: str = "point",
) -> tuple[Float[Array, "_ _ _"], ...]:
    """Returns what a sensor sees of one frame. You may call it inside `jax.jit`, `jax.vmap` and `jax.grad`.

    Args:
      frame: a NumPy or JAX array [H, W] or [H, W, C] of any size, uint8 or finite floats of any range.
      focal_point: (y, x) in frame pixels, integers.
      sensor: a `RingSensor`, a `LogPolarSensor`, or an object of your own `Sensor` class.
      bounds: with 'point' the focal area may overhang the frame and sees 0 there; with 'window' it is moved inside
        first, which is faster.

    Returns:
      A tuple of float32 images [h, w, C] in the frame's range of values; C is 1 for a gray frame. The layout 'canvas'
      gives one image of the frame's size, with 0 where nothing is seen. The layout 'packed' gives an image per ring,
      inner to outer, then one of the periphery if there is one. A `LogPolarSensor` gives one image [rings, wedges, C].

    Raises:
      ConfigError: the frame or the focal point has another rank; the focal point is not of integers; the peripheral
        grid is finer than the frame; `bounds` is unknown, or 'window' with an area larger than the frame.
      RuntimeError: the process was forked from one that had started JAX.
    """
    refuse_fork()
    return _sense(frame, focal_point, sensor=make_sensor(sensor), bounds=bounds)


def sense_many(
    frames: Num[HostArray, "B H W C"], focal_points: Int[HostArray, "B 2"], *, sensor: Sensor, bounds: str
) -> tuple[Float[Array, "B _ _ C"], ...]:
    """`sense` for a batch of frames, each with a focal point of its own."""
    refuse_fork()
    return jax.vmap(functools.partial(_sense, sensor=sensor, bounds=bounds))(frames, focal_points)


def picture(
    images: tuple[Float[HostArray, "_ _ C"], ...],
    focal_point: Int[HostArray, "2"],
    *,
    sensor: SensorConfig | Sensor,
    frame_shape: Shape,
) -> Float[Array, "H W C"]:
    """Draws what `sense` returned at its place in a frame of zeros.

    Args:
      images: what `sense` returned.
      focal_point: (y, x) in frame pixels, where they were sensed. With bounds 'window' that is the point after the area
        was moved inside.
      sensor: the sensor that sensed them.
      frame_shape: (H, W) of the frame.

    Returns:
      A frame, float32 [H, W, C], in the images' range of values.
    """
    refuse_fork()
    images, focal_point = jax.tree.map(jnp.asarray, (tuple(images), focal_point))
    return _picture(images, focal_point, sensor=make_sensor(sensor), frame_shape=frame_shape)
