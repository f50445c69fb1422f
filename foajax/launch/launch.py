"""Starts the run, or the runs of a sweep, that a command line describes."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

from foajax import cli
from foajax.config import table
from foajax.config.compose import checked, choices, compose, from_node, register
from foajax.config.parse import one_line, refuse, suggest
from foajax.config.schema import RENAMED, Config
from foajax.config.shipped import experiments
from foajax.launch import sweep
from foajax.launch.signals import interrupt_ends
from foajax.runs.directory import failure, is_run, note_failure
from foajax.runs.lock import is_held
from foajax.runs.status import is_finished

Task = Callable[[Config], int | None]  # returns an exit code, None for 0
_HELP = """Trains one agent, or goes on training it: foajax train [key=value ...]

Groups (group=choice), with more of your own from --config-dir=DIR:
{groups}

Keys (key=value), with their defaults:
{keys}

Flags: --multirun runs every combination of key=a,b,c, with --jobs=N so many at a time; --cfg job prints the keys of a
run."""
_MULTIRUN = {"-m", "--multirun"}
_FLAGS = (
    *_MULTIRUN,
    "--jobs",
    "-c",
    "--cfg",
    "-p",
    "--package",
    "--resolve",
    "-i",
    "--info",
    "--hydra-help",
    "--version",
)


def run(task: Task, arguments: Sequence[str], *, check: Callable[[Config], None] = lambda config: None) -> int:
    """Runs `task` on the config that the command line describes; returns the exit code.

    A single run is composed and started directly. `--multirun` runs a sweep on this machine, a process of
    `foajax.train` per run, `--jobs=N` of them at a time, else one. With a `hydra/launcher`, Hydra starts `task` for
    each run: `submitit_slurm` on a cluster, `basic` one after another in this process. Other flags, such as `--cfg`,
    are Hydra's. Every run of a sweep is composed and passed to `check` before the first one starts. A run that fails
    does not end the sweep. A `ConfigError`, also from `task`, becomes one line on stderr and exit code 2.
    """
    if not {"-h", "--help"}.isdisjoint(arguments):
        return cli.run(lambda words: print(_help(cli.take_directory(words)[0])), arguments)
    return cli.run(functools.partial(_run, task, check), arguments)


def _run(task: Task, check: Callable[[Config], None], arguments: Sequence[str]) -> int | None:
    directory, arguments = cli.take_directory(arguments)
    _check_flags(arguments)
    _name_new_words(arguments)
    if not any(word.startswith("-") for word in arguments):
        with interrupt_ends():
            return task(compose(arguments, directory))
    ours = [word for word in arguments if "=" in word and not word.startswith(("-", "hydra.", "hydra/"))]
    runs = sweep.expand(ours, directory)
    rest = [word for word in arguments if word not in ours]
    is_sweep = not _MULTIRUN.isdisjoint(rest)
    jobs = [word for word in rest if word.startswith("--jobs")]
    at_a_time = _jobs(*jobs)
    if is_sweep:
        if strays := [word for word in rest if not word.startswith(("-", "hydra.", "hydra/"))]:
            raise refuse(one_line(strays[0]))
        with interrupt_ends():  # this imports JAX, and nothing has begun
            for each in runs:
                check(each.config)
    flag = [] if directory is None else [f"--config-dir={directory}"]
    if is_sweep and not set(rest) - {*_MULTIRUN, *jobs}:
        return sweep.run_all(runs, jobs=at_a_time, command=(*sweep.COMMAND, *flag))
    if jobs:
        raise refuse(jobs[0], accepted=f"{jobs[0]} --multirun, without other flags and without hydra/launcher")
    failures: dict[str, str] = {}
    swept = sweep.swept_by(ours) if is_sweep else None
    theirs = [word for word in rest if word.startswith(("hydra.", "hydra/"))]  # Hydra's parser wants them after flags
    words = [*theirs, *(checked(word, sweep=True, config_dir=directory) for word in ours)]
    flags = [word for word in rest if word not in theirs]
    code = _run_hydra(lambda node: _job(task, swept, failures, node), [*flags, *flag, *words])
    return sweep.summarise([run.config for run in runs], failures) or code if is_sweep else code


def _check_flags(arguments: Sequence[str]) -> None:
    """Raises `ConfigError` for a word with a dash that is neither a flag of ours nor a flag of Hydra's for a run."""
    for i, word in enumerate(arguments):
        flag, is_joined, value = word.partition("=")
        if flag.startswith("-") and flag not in _FLAGS:
            is_key = is_joined and flag.strip("-").partition(".")[0] in (*choices(), *Config.model_fields)
            why = suggest("is no flag", *([word.lstrip("-")] if is_key else ()))
            accepted = "key=value, --multirun, --jobs=N, --config-dir=DIR or --cfg job"
            raise refuse(one_line(word), accepted=accepted, why=why)
        if flag in ("-c", "--cfg"):
            what = value if is_joined else "".join(arguments[i + 1 : i + 2])
            if what not in ("job", "hydra", "all"):
                raise refuse(flag, what, ("job", "hydra", "all"))
        if flag in _MULTIRUN and is_joined:
            raise refuse(one_line(word), accepted=f"{flag} alone")


def _name_new_words(arguments: Sequence[str]) -> None:
    for word in arguments:
        key = word.lstrip("+").partition("=")[0]
        if key in RENAMED:
            print(f"foajax: {key} is now {RENAMED[key]}", file=sys.stderr)


def _help(directory: Path | None) -> str:
    offered = "\n".join(f"  {group}: {', '.join(names)}" for group, names in choices(directory).items())
    return _HELP.format(groups=offered, keys=table.listed(Config))


def _jobs(word: str = "--jobs=1", *more: str) -> int:
    number = word.partition("=")[2]
    if more or not number.isdecimal() or int(number) < 1:
        raise refuse(one_line(word, *more), accepted="--jobs=N, given once: N >= 1 runs at a time")
    return int(number)


def _job(task: Task, swept: Mapping[str, str] | None, failures: dict[str, str], node: Any) -> None:
    """Runs `task` for Hydra, maybe in another process. `swept`: the keys of a sweep; None for a single run."""
    from hydra.core.hydra_config import HydraConfig

    words = HydraConfig.get().overrides.task
    config = from_node(node, words)
    if swept is None:
        if code := cli.run(lambda _: task(config), ()):
            raise SystemExit(code)  # Hydra drops what a job returns
        return
    config = sweep.named(config, words, swept)
    if sweep.skip_if_finished(config):
        return
    alone = [sys.argv[0], *words, f"name={config.name}"]  # what starts this run without the others, for its run.json
    try:
        with mock.patch.object(sys, "argv", alone):
            code = cli.run(lambda _: task(config), ())
    except Exception as error:  # whatever it is, the next run starts
        code = 1
        sys.excepthook(type(error), error, error.__traceback__)
    in_this_process = HydraConfig.get().launcher["_target_"].endswith("BasicLauncher")
    if code == cli.INTERRUPTED or (in_this_process and not code and _is_left(config)):
        raise SystemExit(code)  # it was asked to stop, and so were the runs after it
    if code:
        failures[config.run_dir] = f"exit {code}"
        path = Path(config.run_dir)
        if not in_this_process and failure(path) is None and not is_held(path):  # the dict is a copy there
            path.mkdir(parents=True, exist_ok=True)
            note_failure(path, f"exit {code}")


def _is_left(config: Config) -> bool:
    """Whether a run has begun and is not finished."""
    return is_run(Path(config.run_dir)) and not is_finished(config)


def _run_hydra(job: Callable[[Any], None], words: Sequence[str]) -> int:
    import hydra

    register()
    before = sys.argv
    sys.argv = [before[0], *words]  # hydra.main takes its arguments from nowhere else
    try:
        hydra.main(config_path=str(experiments()), config_name="base", version_base="1.3")(job)()
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 1
    finally:
        sys.argv = before
    return 0
