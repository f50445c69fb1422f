"""Trains one agent, or goes on training it: `foajax train experiment=constant70 game=breakout`."""

from __future__ import annotations

import sys
import traceback

import jax

from foajax.config.parse import ConfigError
from foajax.config.schema import Config
from foajax.launch import launch, processes
from foajax.runtime import keep_memory, use_compilation_cache
from foajax.training.start import check, start
from foajax.training.watchdog import EnvironmentFault, report_fault


def train(config: Config) -> int:
    """Trains from the newest checkpoint, or from nothing, to `train.env_steps`; or profiles a short run.

    Returns the exit code: 0 if the run is done or was asked to stop, `FAULT` if an environment failed.
    """
    use_compilation_cache()
    keep_memory()
    try:
        start(config)
    except EnvironmentFault as fault:
        return processes.end_process(report_fault(config, str(fault), fault))
    except Exception as error:
        if not jax.distributed.is_initialized():
            raise
        if isinstance(error, ConfigError):
            print(f"foajax: error: {error}", file=sys.stderr, flush=True)
            return processes.end_process(2)
        traceback.print_exc()
        return processes.end_process(1)
    return 0


if __name__ == "__main__":
    sys.exit(launch.run(train, sys.argv[1:], check=check))
