"""foajax: agents that learn what to do and where to look, with a foveated sensor, in JAX."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

import foajax.runtime  # noqa: F401  it notices forks

__version__ = "1.0.0"
__all__ = [
    "Agent",
    "Config",
    "ConfigError",
    "FoveatedObservation",
    "FoveatedVectorObservation",
    "GazeConfig",
    "LogPolarSensor",
    "RingSensor",
    "Sensor",
    "TrainedAgent",
    "compose",
    "load_agent",
    "picture",
    "sense",
    "train_agent",
]

if TYPE_CHECKING:
    from foajax.config.compose import compose
    from foajax.config.parse import ConfigError
    from foajax.config.schema import Config, GazeConfig, LogPolarSensor, RingSensor
    from foajax.learning.agent import Agent
    from foajax.runs.agents import TrainedAgent, load_agent
    from foajax.sensors import numpy as numpy
    from foajax.sensors.base import Sensor
    from foajax.sensors.compiled import picture, sense
    from foajax.sensors.wrappers import FoveatedObservation, FoveatedVectorObservation
    from foajax.training.start import train_agent
else:
    _HOMES = {
        "config.compose": ["compose"],
        "config.parse": ["ConfigError"],
        "config.schema": ["Config", "GazeConfig", "LogPolarSensor", "RingSensor"],
        "learning.agent": ["Agent"],
        "runs.agents": ["TrainedAgent", "load_agent"],
        "sensors.base": ["Sensor"],
        "sensors.compiled": ["picture", "sense"],
        "sensors.wrappers": ["FoveatedObservation", "FoveatedVectorObservation"],
        "training.start": ["train_agent"],
    }

    def __getattr__(name: str) -> Any:
        """Fetches a public name on first use, so that `import foajax` does not wait for JAX."""
        if name == "numpy":  # not in __all__, so that `from foajax import *` leaves NumPy alone
            return importlib.import_module("foajax.sensors.numpy")
        for home, names in _HOMES.items():
            if name in names:
                return getattr(importlib.import_module(f"foajax.{home}"), name)
        raise AttributeError(f"module 'foajax' has no attribute '{name}'")
