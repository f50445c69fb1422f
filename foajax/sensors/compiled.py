"""`sense` and `picture` for programs of one's own: compiled once for a sensor and a frame's shape, then milliseconds.

They may be called inside of `jax.jit`, `jax.vmap` and `jax.grad` too.
"""

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
    """What a sensor sees of one frame.

    Args:
      frame: uint8 or finite float, [H, W] or [H, W, C] of any size and range, NumPy's or JAX's.
      focal_point: (y, x), frame pixels, integers.
      sensor: a `RingSensor`, a `LogPolarSensor`, or a `Sensor` of one's own.
      bounds: 'point', so that the focal area may overhang the frame, where it sees 0; or 'window', so that it is moved
        inside, which takes about two thirds of the time.

    Returns:
      float32 images [h, w, C], C 1 for a gray frame, in the frame's range: one for a canvas, one for each ring and
      for the periphery where the layout is packed, [rings, wedges, C] for a log-polar sensor.

    Raises:
      ConfigError: a frame or a focal point of another rank; a focal point of fractions; a peripheral grid finer than
        the frame; other bounds, or 'window' and an area larger than the frame.
      RuntimeError: in a process that was forked from one that had JAX.
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
    """What `sense` gave, put back in the frame's place; 0 where nothing was seen.

    Args:
      images: from `sense`.
      focal_point: (y, x), frame pixels, where the area lay: with bounds 'window', after it was moved inside.
      sensor: the same.
      frame_shape: (H, W).

    Returns:
      float32 [H, W, C], in the images' range.
    """
    refuse_fork()
    images, focal_point = jax.tree.map(jnp.asarray, (tuple(images), focal_point))
    return _picture(images, focal_point, sensor=make_sensor(sensor), frame_shape=frame_shape)
