"""From a command line to runs: one, or the runs of a sweep."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from foajax import cli
from foajax.config.compose import checked, compose, from_node, parse_override
from foajax.config.parse import ConfigError, one_line
from foajax.config.schema import Config
from foajax.config.shipped import experiments
from foajax.launch import sweep
from foajax.runs.directory import is_run
from foajax.runs.status import is_finished

Task = Callable[[Config], int | None]  # returns an exit code, None for 0


def run(task: Task, arguments: Sequence[str], *, check: Callable[[Config], None] = lambda config: None) -> int:
    """Runs `task` on the config that the command line describes; returns the exit code.

    A single run is composed and started directly. `--multirun` alone runs a sweep on this machine, a process of
    `foajax.train` each, `--jobs=N` at a time (1). With a `hydra/launcher` (`submitit_slurm`; `basic` for one after
    another in this process) Hydra starts `task` for each run, and other flags (`--help`, `--cfg`) are Hydra's. Every
    run of a sweep is checked, by `check` too, before the first one starts; one that fails does not end the sweep.

    A `ConfigError`, one that `task` raises included, becomes one line on stderr and exit code 2.
    """
    if any(word.startswith("-") for word in arguments):
        return cli.run(functools.partial(_run_flags, task, check), arguments)
    return cli.run(lambda words: task(compose(words)), arguments)


def _run_flags(task: Task, check: Callable[[Config], None], arguments: Sequence[str]) -> int:
    ours = [word for word in arguments if "=" in word and not word.startswith(("-", "hydra.", "hydra/"))]
    runs = sweep.expand(ours)
    rest = [word for word in arguments if word not in ours]
    is_sweep = not {"-m", "--multirun"}.isdisjoint(rest)
    jobs = [word for word in rest if word.startswith("--jobs")]
    at_a_time = _jobs(*jobs)
    if is_sweep:
        if strays := [word for word in rest if not word.startswith(("-", "hydra.", "hydra/"))]:
            raise ConfigError(f"{one_line(strays[0])}: accepted is key=value")
        for each in runs:
            check(each.config)
    if is_sweep and not set(rest) - {"-m", "--multirun", *jobs}:
        return sweep.run_all(runs, jobs=at_a_time)
    if jobs:
        raise ConfigError(f"{jobs[0]}: accepted only together with --multirun, and without a hydra/launcher")
    failures: dict[str, str] = {}
    swept = (
        {parse_override(word).key_or_group for word in ours if parse_override(word).is_sweep_override()}
        if is_sweep
        else None
    )
    words = [checked(word, sweep=True) if word in ours else word for word in arguments]
    code = _run_hydra(lambda node: _job(task, swept, failures, node), words)
    return sweep.summarise([run.config for run in runs], failures) or code if is_sweep else code


def _jobs(word: str = "--jobs=1", *more: str) -> int:
    number = word.partition("=")[2]
    if more or not number.isdecimal() or int(number) < 1:
        raise ConfigError(f"{one_line(word, *more)}: accepted is --jobs=N, how many runs at a time")
    return int(number)


def _job(task: Task, swept: set[str] | None, failures: dict[str, str], node: Any) -> None:
    """One run that Hydra starts, maybe in another process; `swept` are the keys of a sweep."""
    from hydra.core.hydra_config import HydraConfig

    config = from_node(node)
    if swept is None:
        if code := cli.run(lambda _: task(config), ()):
            raise SystemExit(code)  # Hydra drops what a job returns
        return
    config = sweep.named(config, HydraConfig.get().overrides.task, swept)
    if sweep.skip_if_finished(config):
        return
    try:
        code = cli.run(lambda _: task(config), ())
    except Exception as error:  # whatever it is, the next run starts
        failures[config.run_dir] = "exit 1"
        sys.excepthook(type(error), error, error.__traceback__)
        return
    in_this_process = HydraConfig.get().launcher["_target_"].endswith("BasicLauncher")
    if code == cli.INTERRUPTED or (in_this_process and not code and _is_left(config)):
        raise SystemExit(code)  # it was asked to stop, and so were the runs after it
    if code:
        failures[config.run_dir] = f"exit {code}"


def _is_left(config: Config) -> bool:
    """Whether a run has begun and is not finished."""
    return is_run(Path(config.run_dir)) and not is_finished(config)


def _run_hydra(job: Callable[[Any], None], words: Sequence[str]) -> int:
    import hydra

    before = sys.argv
    sys.argv = [before[0], *words]  # hydra.main takes its arguments from nowhere else
    try:
        hydra.main(config_path=str(experiments()), config_name="base", version_base="1.3")(job)()
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 1
    finally:
        sys.argv = before
    return 0
