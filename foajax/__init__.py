"""foajax: agents that learn what to do and where to look, with a foveated sensor, in JAX."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"
__all__ = [
    "Agent",
    "Config",
    "ConfigError",
    "FoveatedObservation",
    "FoveatedVectorObservation",
    "LogPolarSensor",
    "RingSensor",
    "load_agent",
    "sense",
]

if TYPE_CHECKING:
    from foajax.config.parse import ConfigError
    from foajax.config.schema import Config, LogPolarSensor, RingSensor
    from foajax.learning.agent import Agent
    from foajax.runs.agents import load_agent
    from foajax.sensors.sense import sense
    from foajax.sensors.wrappers import FoveatedObservation, FoveatedVectorObservation
else:
    _HOMES = {
        "Agent": "learning.agent",
        "Config": "config.schema",
        "ConfigError": "config.parse",
        "LogPolarSensor": "config.schema",
        "RingSensor": "config.schema",
        "FoveatedObservation": "sensors.wrappers",
        "FoveatedVectorObservation": "sensors.wrappers",
        "load_agent": "runs.agents",
        "sense": "sensors.sense",
    }

    def __getattr__(name: str) -> Any:
        """Fetches a public name on first use, so that `import foajax` does not wait for JAX."""
        if name not in _HOMES:
            raise AttributeError(f"module 'foajax' has no attribute '{name}'")
        return getattr(importlib.import_module(f"foajax.{_HOMES[name]}"), name)
