"""Makes the sensor that a configuration asks for."""

from __future__ import annotations

import functools
import json
from typing import Any

import jax
import numpy as np

from foajax.config.parse import refuse
from foajax.config.parts import make_part
from foajax.config.schema import LogPolarSensor, OwnSensor, RingSensor, SensorConfig
from foajax.sensors.base import Sensor
from foajax.sensors.geometry import Shape
from foajax.sensors.logpolar import LogPolar
from foajax.sensors.rings import Rings

SENSORS = {"rings": Rings, "logpolar": LogPolar}  # by `sensor.kind`


def make_sensor(sensor: SensorConfig | Sensor) -> Sensor:
    """Returns the sensor of a configuration, the same object each time, or a `Sensor` as it is.

    Raises:
      ConfigError: `sensor` is neither; or `sensor.kind` names code that cannot be found, takes other arguments or is no
        sensor.
    """
    if isinstance(sensor, OwnSensor):
        return _make_own(sensor.kind, json.dumps(sensor.kwargs, sort_keys=True))
    if isinstance(sensor, RingSensor | LogPolarSensor):
        return _make(sensor)
    if not isinstance(sensor, Sensor):
        raise refuse("sensor", sensor, "a RingSensor, LogPolarSensor or foajax.Sensor; in wrappers an experiment too")
    return sensor


def check_images(sensor: Sensor, frame_shape: Shape) -> None:
    """Raises `ConfigError` unless a sensor of one's own gives the images that it says."""
    frame, point = jax.ShapeDtypeStruct(frame_shape, np.float32), jax.ShapeDtypeStruct((2,), np.int32)
    said = [f"float32{list(shape)}" for shape in sensor.image_shapes(frame_shape) or ()]
    given = jax.eval_shape(functools.partial(sensor.sense, bounds="point"), frame, point)
    seen = [f"{image.dtype}{list(image.shape)}" for image in given] if isinstance(given, tuple) else ["no tuple"]
    if not said or seen != said:
        why = f"its sense gives {', '.join(seen)} of a frame {list(frame_shape)}"
        raise refuse("sensor", type(sensor).__name__, f"what its image_shapes says: {', '.join(said) or None}", why=why)


@functools.cache
def _make(config: Any) -> Sensor:
    return SENSORS[config.kind](config)


@functools.cache
def _make_own(kind: str, kwargs: str) -> Sensor:
    made = make_part("sensor.kind", kind, {}, **json.loads(kwargs))
    if not isinstance(made, Sensor):
        raise refuse("sensor.kind", kind, "a class with all attributes of a foajax.Sensor")
    return made
