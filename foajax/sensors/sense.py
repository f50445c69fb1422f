"""Turns one frame and a focal point into what a sensor sees, for every kind of sensor.

It is for one frame; the caller vmaps and jits. The cost depends on the sensor, not on the frame, except
where every pixel of the frame matters: a canvas, a peripheral grid of means.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Num

from foajax.config.schema import SensorConfig
from foajax.sensors.base import Sensor
from foajax.sensors.geometry import Shape, check_look, move_inside
from foajax.sensors.registry import make_sensor
from foajax.types import HostArray


def sense(
    frame: Num[HostArray, "H W *C"],
    focal_point: Int[HostArray, "2"],
    *,
    sensor: SensorConfig | Sensor,
    bounds: str = "point",
) -> tuple[Float[Array, "_ _ _"], ...]:
    """What the sensor sees of a frame: float32 images [h, w, c], one a part; a gray frame has one channel.

    Args:
      frame: uint8 or finite float, in any range and of any size.
      focal_point: (y, x), frame pixels.
      sensor: static; see `foajax.sensors.rings`, `foajax.sensors.logpolar` and, for one's own, `foajax.sensors.base`.
      bounds: static, as in `foajax.sensors.gaze`. With 'point' the area may overhang the frame; with 'window' it is
        moved inside where it would, and then sensing takes about two thirds of the time.

    Raises:
      ConfigError: a frame or a focal point of another rank; a focal point of fractions; a peripheral grid finer than
        the frame; other bounds, or 'window' and an area larger than the frame.
    """
    sensor = make_sensor(sensor)
    frame, point = jnp.asarray(frame), jnp.asarray(focal_point)
    check_look(frame, point, sensor.window, bounds)
    if bounds == "window":
        point = move_inside(point, sensor.window, (frame.shape[0], frame.shape[1]))
    if frame.ndim == 2:
        return tuple(image[..., None] for image in sensor.sense(frame, point, bounds))
    return jax.vmap(lambda channel: sensor.sense(channel, point, bounds), in_axes=2, out_axes=2)(frame)


def picture(
    images: tuple[Float[Array, "_ _ C"], ...],
    focal_point: Int[Array, "2"],
    *,
    sensor: SensorConfig | Sensor,
    frame_shape: Shape,
) -> Float[Array, "H W C"]:
    """What `sense` gave, put back in the frame's place; 0 where nothing was seen.

    `focal_point` is where the area lay: with bounds 'window', the point after it was moved inside.
    """
    gray = functools.partial(make_sensor(sensor).picture, focal_point=focal_point, frame_shape=frame_shape)
    return jax.vmap(gray, in_axes=2, out_axes=2)(images)
