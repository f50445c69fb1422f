"""Trains one agent, or goes on training it: `foajax train experiment=constant70 game=breakout`."""

# What imports JAX is imported inside the functions. Until then the words have been read, so that a wrong one is told
# at once, and SIGINT ends the process: as a KeyboardInterrupt it could be lost in a callback of JAX's.
from __future__ import annotations

import sys
import traceback

from foajax.config.parse import ConfigError
from foajax.config.schema import Config
from foajax.launch import launch
from foajax.runtime import keep_memory, use_compilation_cache


def train(config: Config) -> int:
    """Trains from the newest checkpoint, or from nothing, to `train.env_steps`; or profiles a short run.

    Returns the exit code: 0 if the run is done or was asked to stop, `FAULT` if an environment failed.
    """
    import jax

    from foajax.launch import processes
    from foajax.training.start import start
    from foajax.training.watchdog import EnvironmentFault, report_fault

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


def _check(config: Config) -> None:
    from foajax.training.start import check

    check(config)


if __name__ == "__main__":
    sys.exit(launch.run(train, sys.argv[1:], check=_check))
