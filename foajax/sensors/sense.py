"""Turns one frame and a focal point into what a sensor sees, for every kind of sensor.

The caller vmaps and jits. The cost depends on the sensor, not on the frame, except where every pixel of the frame
matters: for a canvas and a peripheral grid of means.
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
    """Returns what a sensor sees of one frame; arguments, results and errors are those of `foajax.sense`.

    `sensor` and `bounds` are static.
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
    """Draws what `sense` returned at its place in the frame, as `foajax.picture` does."""
    gray = functools.partial(make_sensor(sensor).picture, focal_point=focal_point, frame_shape=frame_shape)
    return jax.vmap(gray, in_axes=2, out_axes=2)(images)
