"""Starts a run: from nothing, or from its newest checkpoint."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path

from foajax import cli
from foajax.config.parse import refuse
from foajax.config.schema import Config, OwnSensor, check_window
from foajax.envs.atari import check_game
from foajax.envs.make import make_environments
from foajax.launch import processes
from foajax.launch.signals import StopRequest
from foajax.networks.cores import make_core
from foajax.networks.torsos import make_torso
from foajax.runs.agents import TrainedAgent, check_source, load_agent
from foajax.runs.directory import open_run
from foajax.runs.row_logger import find_logger
from foajax.runs.status import newest_checkpoint
from foajax.runtime import use_compilation_cache
from foajax.sensors.registry import check_images, make_sensor
from foajax.training import profiling
from foajax.training.run import Run


def check(config: Config) -> None:
    """Finds mistakes that a configuration does not show by itself. A sweep checks all runs before the first one.

    Raises:
      ConfigError: no gaze and a focal area that is not the whole frame; a sensor that gives other images than it says;
        no such game, torso, core or logger; no agent to begin with.
    """
    sensor = make_sensor(config.sensor)
    window, frame = sensor.window, config.env.frame_shape
    check_window(config, sensor)
    if isinstance(config.sensor, OwnSensor):
        check_images(sensor, frame)
    if config.gaze.mode == "none" and window != frame:
        why = f"the focal area is {window[0]}x{window[1]}, not the whole frame, {frame[0]}x{frame[1]}"
        raise refuse("gaze.mode", "none", "learned, frozen, random or scripted", why=why)
    check_game(config)
    find_logger(config)
    make_torso(config.network)
    make_core(config.network)
    source = config.train.init_from
    # A run that goes on does not need it. Of several processes only the first one reads it, and maybe no other can.
    if source is not None and not newest_checkpoint(Path(config.run_dir)) and processes.where(config) is None:
        check_source(source)


def start(config: Config) -> None:
    """Trains to `train.env_steps` or until a signal asks to stop; or profiles a short run.

    Raises:
      ConfigError: what `check` finds; the run's directory cannot be used, or is another run's.
      EnvironmentFault: an environment raised.
    """
    check(config)
    with contextlib.ExitStack() as resources:
        if config.profile:
            if config.train.devices > 1 or processes.where(config):
                raise refuse("profile", True, "train.devices=1 and a single process")
            directory = cli.make_directory(Path(config.run_dir) / "profile", "run")
            environments = make_environments(config, 0)
            for environment in environments:
                resources.callback(environment.close)
            profiling.profile(config, environments, str(directory))
            return
        job = processes.start(config)
        job.agree(config)
        if config.train.dump_skipped and len(job.devices) > 1:
            raise refuse("train.dump_skipped", True, "false where a run has several devices")
        stop = resources.enter_context(StopRequest())
        command = [sys.executable, *sys.argv]
        devices = [device.device_kind for device in job.devices]
        run_dir = job.run_on_first(
            "run", lambda: resources.enter_context(open_run(config, command=command, devices=devices))
        )
        try:
            run = Run(config, job, run_dir, resources)
        except OSError as error:  # its files: whatever an environment raises is a fault of its own
            reason = f"cannot be used ({error})"
            raise refuse("run", config.run_dir, "a directory to write to", why=reason) from None
        run.loop(stop)


def train_agent(config: Config) -> TrainedAgent:
    """Trains an agent in this process, or resumes its training, and returns it as its newest checkpoint has it.

    As `foajax train` does, it writes to `config.run_dir`, prints progress and caches compiled programs. You may call it
    from any thread. In the main thread, SIGINT, SIGTERM, SIGUSR1 and SIGHUP save the run and end the call early. An
    environment that hangs for longer than `env.timeout` seconds ends the process.

    Args:
      config: what `foajax.compose` returns.

    Raises:
      ConfigError: the configuration cannot be run, or the directory belongs to another run.
      EnvironmentFault: an environment raised; what was learned is saved.
    """
    if not isinstance(config, Config):
        raise refuse("config", config, "a Config, such as foajax.compose returns")
    use_compilation_cache()
    start(config)
    return load_agent(config.run_dir, trust=True)
