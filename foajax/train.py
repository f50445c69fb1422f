"""`python -m foajax.train experiment=constant70 game=breakout`: trains one agent, or goes on training it."""

from __future__ import annotations

import contextlib
import sys
import traceback
from pathlib import Path

import jax

from foajax.config.parse import ConfigError, refuse
from foajax.config.schema import Config
from foajax.envs.atari import check_game
from foajax.envs.make import make_environments
from foajax.launch import launch, processes
from foajax.launch.signals import StopRequest
from foajax.runs.agents import check_source
from foajax.runs.directory import is_run, open_run
from foajax.runtime import keep_memory, use_compilation_cache
from foajax.training import profiling
from foajax.training.run import Run
from foajax.training.watchdog import EnvironmentFault, report_fault


def train(config: Config) -> int:
    """One run from its newest checkpoint, or from nothing, to `train.env_steps`; or a profile of it.

    Returns the exit code: 0 where the run is done or has been asked to stop, `FAULT` where an environment failed.
    """
    use_compilation_cache()
    keep_memory()
    try:
        _train(config)
    except EnvironmentFault as fault:
        return processes.leave(report_fault(config, str(fault), fault))
    except Exception as error:
        if not jax.distributed.is_initialized():
            raise
        if isinstance(error, ConfigError):
            print(f"foajax: error: {error}", file=sys.stderr, flush=True)
            return processes.leave(2)
        traceback.print_exc()
        return processes.leave(1)
    return 0


def check(config: Config) -> None:
    """Finds mistakes that a configuration does not show by itself; of a sweep, in all runs before the first one.

    Raises:
      ConfigError: no gaze and a focal area that is not the whole frame; no such game; no agent to begin with.
    """
    window, frame = config.sensor.window, config.env.frame_shape
    if config.gaze.mode == "none" and window != frame:
        sizes = f"as large as the frame, {frame[0]}x{frame[1]}, not {window[0]}x{window[1]}"
        raise refuse("gaze.mode", "none", f"a focal area {sizes}; or learned, frozen, random, scripted")
    check_game(config)
    if config.train.init_from is not None and not is_run(Path(config.run_dir)):  # one that goes on does not need it
        check_source(config.train.init_from)


def _train(config: Config) -> None:
    check(config)
    with contextlib.ExitStack() as resources:
        if config.profile:
            if config.train.devices > 1 or processes.where(config):
                raise refuse("profile", "true", "train.devices=1 and a single process")
            environments = make_environments(config, 0)
            for environment in environments:
                resources.callback(environment.close)
            profiling.profile(config, environments, f"{config.run_dir}/profile")
            return
        job = processes.start(config)
        job.agree(config)
        if config.train.dump_skipped and len(job.devices) > 1:
            raise refuse("train.dump_skipped", "true", "false where a run has several devices")
        stop = StopRequest()
        command = [sys.executable, *sys.argv]
        devices = [device.device_kind for device in job.devices]
        run_dir = job.by_first(
            "run", lambda: resources.enter_context(open_run(config, command=command, devices=devices))
        )
        try:
            run = Run(config, job, run_dir, resources)
        except OSError as error:  # its files: whatever an environment raises is a fault of its own
            reason = f"cannot be used ({error})"
            raise refuse("run", config.run_dir, "a directory to write to", why=reason) from None
        run.loop(stop)


if __name__ == "__main__":
    sys.exit(launch.run(train, sys.argv[1:], check=check))
