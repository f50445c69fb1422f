"""Makes the sensor that a configuration asks for."""

from __future__ import annotations

import functools
import json
from typing import Any

from foajax.config.parse import refuse
from foajax.config.parts import make_part
from foajax.config.schema import LogPolarSensor, OwnSensor, RingSensor, SensorConfig
from foajax.sensors.base import Sensor
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


@functools.cache
def _make(config: Any) -> Sensor:
    return SENSORS[config.kind](config)


@functools.cache
def _make_own(kind: str, kwargs: str) -> Sensor:
    made = make_part("sensor.kind", kind, {}, **json.loads(kwargs))
    if not isinstance(made, Sensor):
        raise refuse("sensor.kind", kind, "a class with all attributes of a foajax.Sensor")
    return made
