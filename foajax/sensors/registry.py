"""The sensor that a configuration asks for."""

from __future__ import annotations

import functools
import json
from typing import Any

from foajax.config.parse import refuse
from foajax.config.parts import make_part
from foajax.config.schema import OwnSensor, SensorConfig
from foajax.sensors.base import Sensor
from foajax.sensors.logpolar import LogPolar
from foajax.sensors.rings import Rings

SENSORS = {"rings": Rings, "logpolar": LogPolar}  # by `sensor.kind`


def make_sensor(sensor: SensorConfig | Sensor) -> Sensor:
    """The sensor itself, the same one each time; one that is made already is given back.

    Raises:
      ConfigError: `sensor.kind` names code that cannot be found, takes other arguments or is no sensor.
    """
    if isinstance(sensor, OwnSensor):
        return _make_own(sensor.kind, json.dumps(sensor.kwargs, sort_keys=True))
    return sensor if isinstance(sensor, Sensor) else _make(sensor)


@functools.cache
def _make(config: Any) -> Sensor:
    return SENSORS[config.kind](config)


@functools.cache
def _make_own(kind: str, kwargs: str) -> Sensor:
    made = make_part("sensor.kind", kind, {}, **json.loads(kwargs))
    if not isinstance(made, Sensor):
        raise refuse("sensor.kind", kind, "a class that has all of foajax.sensors.base.Sensor")
    return made
