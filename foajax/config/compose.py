"""From `key=value` words to a checked `Config`, by way of experiments/.

The only file that imports Hydra and OmegaConf. They take a third of a second to import, so that is
left to the functions that need them.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import itertools
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, cast

from foajax import cli
from foajax.config.schema import Config, ConfigError, from_mapping
from foajax.launch import sweep
from foajax.runs.directory import is_run
from foajax.runs.status import is_finished

Task = Callable[[Config], int | None]  # returns an exit code, None for 0


def compose(overrides: Sequence[str] = ()) -> Config:
    """The run that `overrides` describe, e.g. `["experiment=nonfoa", "game=pong"]`, from any directory.

    Raises:
      ConfigError: an unknown key or choice, a malformed override, or a value of the wrong type or range.
    """
    import hydra
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    words = [_checked(word, sweep=False) for word in overrides]
    outer = GlobalHydra.instance().hydra  # of an application that uses this package
    GlobalHydra.instance().clear()
    try:
        with hydra.initialize_config_dir(str(_directory()), version_base="1.3"):
            node = hydra.compose("base", words)
    except (HydraException, OmegaConfBaseException, ValueError, LookupError) as error:
        raise ConfigError(f"{_one_line(*overrides)}: {_first_line(error)}; accepted is key=value") from None
    finally:
        GlobalHydra.instance().hydra = outer
    return _config(node)


def list_experiments() -> list[str]:
    """What `experiment=` accepts, sorted."""
    return list(_choices()["experiment"])


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
    runs = _expand(ours)
    rest = [word for word in arguments if word not in ours]
    is_sweep = not {"-m", "--multirun"}.isdisjoint(rest)
    jobs = [word for word in rest if word.startswith("--jobs")]
    at_a_time = _jobs(*jobs)
    if is_sweep:
        if strays := [word for word in rest if not word.startswith(("-", "hydra.", "hydra/"))]:
            raise ConfigError(f"{_one_line(strays[0])}: accepted is key=value")
        for each in runs:
            check(each.config)
    if is_sweep and not set(rest) - {"-m", "--multirun", *jobs}:
        return sweep.run_all(runs, jobs=at_a_time)
    if jobs:
        raise ConfigError(f"{jobs[0]}: accepted only together with --multirun, and without a hydra/launcher")
    failures: dict[str, str] = {}
    swept = {_parse(word).key_or_group for word in ours if _parse(word).is_sweep_override()} if is_sweep else None
    words = [_checked(word, sweep=True) if word in ours else word for word in arguments]
    code = _run_hydra(lambda node: _job(task, swept, failures, node), words)
    return sweep.summarise([run.config for run in runs], failures) or code if is_sweep else code


def _jobs(word: str = "--jobs=1", *more: str) -> int:
    number = word.partition("=")[2]
    if more or not number.isdecimal() or int(number) < 1:
        raise ConfigError(f"{_one_line(word, *more)}: accepted is --jobs=N, how many runs at a time")
    return int(number)


def _job(task: Task, swept: set[str] | None, failures: dict[str, str], node: Any) -> None:
    """One run that Hydra starts, maybe in another process; `swept` are the keys of a sweep."""
    from hydra.core.hydra_config import HydraConfig

    config = _config(node)
    if swept is None:
        if code := cli.run(lambda _: task(config), ()):
            raise SystemExit(code)  # Hydra drops what a job returns
        return
    config = _named(config, HydraConfig.get().overrides.task, swept)
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
        hydra.main(config_path=str(_directory()), config_name="base", version_base="1.3")(job)()
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 1
    finally:
        sys.argv = before
    return 0


def _expand(words: Sequence[str]) -> list[sweep.Run]:
    """Every run of a sweep, checked, so that a mistake in the last one does not show hours later."""
    swept = {_parse(word).key_or_group for word in words if _parse(word).is_sweep_override()}
    runs: dict[str, sweep.Run] = {}
    for overrides in itertools.product(*map(_values, words)):
        plain = compose(overrides)
        config = _named(plain, overrides, swept)
        if config.run_dir in runs:
            accepted = "a directory for each, as with 'name=constant70-${gaze.mode}'"
            raise ConfigError(f"run={config.run_dir}: two runs would share it; accepted is {accepted}")
        name = [] if config == plain else [f"name='{config.name}'"]
        runs[config.run_dir] = sweep.Run((*overrides, *name), config)
    return list(runs.values())


def _named(config: Config, overrides: Iterable[str], swept: set[str]) -> Config:
    """`config` with a name that tells what the sweep chose, unless the choices name the directory already."""
    known = {"experiment", "game", "seed", "name", "run"}
    parsed = {override.key_or_group: override for override in map(_parse, overrides)}
    if {"name", "run"} & parsed.keys():
        return config
    chosen = [f"{key}={parsed[key].get_value_string()}" for key in parsed if key in swept - known]
    return dataclasses.replace(config, name="-".join([config.name, *(re.sub(r"[^\w.=+-]+", "-", c) for c in chosen)]))


def _checked(word: str, *, sweep: bool) -> str:
    """An override as Hydra is to read it. What is wrong with one alone is found here, to name it."""
    override = _parse(word)
    key, value = override.key_or_group, override.value()
    if override.is_delete() or override.package is not None or not key:
        raise ConfigError(f"{_one_line(word)}: accepted is key=value")
    if override.is_hydra_override():
        raise ConfigError(f"{_one_line(word)}: accepted only together with --multirun")
    text = override.get_value_string()
    if override.is_sweep_override():
        if not sweep:
            raise ConfigError(f"{_one_line(word)}: accepted is one value (more with --multirun)")
    elif key in _choices() and value not in _choices()[key]:
        near = difflib.get_close_matches(str(value), _choices()[key], n=1)
        hint = f" (did you mean {near[0]}?)" if near else ""
        raise ConfigError(f"{_one_line(word)}: accepted is one of {', '.join(_choices()[key])}{hint}")
    # With ++ an unknown key reaches `from_mapping`, which can say which keys there are.
    return f"{key}={text}" if key in _choices() else f"++{key}={text}"


def _values(word: str) -> Iterable[str]:
    """The single overrides that one override of a sweep stands for."""
    from hydra.core.override_parser.types import Glob

    override = _parse(word)
    key, value = override.key_or_group, override.value()
    if not override.is_sweep_override():
        return [word]
    if isinstance(value, Glob):
        names = _choices().get(key, ())
        if not (chosen := value.filter(list(names))):
            raise ConfigError(f"{_one_line(word)}: accepted is what matches one of {', '.join(names) or 'no names'}")
        return [f"{key}={choice}" for choice in chosen]
    if not override.is_discrete_sweep():
        raise ConfigError(f"{_one_line(word)}: accepted is a list of values")
    return [f"{key}={choice}" for choice in override.sweep_string_iterator()]


def _parse(word: str) -> Any:
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        return OverridesParser.create().parse_override(word)
    except HydraException:
        raise ConfigError(f"{_one_line(word)}: accepted is key=value, or key='value' to quote it") from None


def _config(node: Any) -> Config:
    """A checked `Config` from an OmegaConf node."""
    from omegaconf import OmegaConf
    from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

    try:
        return from_mapping(cast(dict, OmegaConf.to_container(node, resolve=True, throw_on_missing=True)))
    except MissingMandatoryValue as error:
        raise ConfigError(f"{error.full_key}: missing; accepted is {error.full_key}=value") from None
    except OmegaConfBaseException as error:
        reason = f"{_first_line(error)}; accepted is a value or ${{key}} with another key's name"
        raise ConfigError(f"{error.full_key}: {reason}") from None


def _first_line(error: Exception) -> str:
    return str(error).partition("\n")[0]


def _one_line(*words: str) -> str:
    return " ".join(" ".join(words).split())


@functools.cache
def _choices() -> dict[str, tuple[str, ...]]:
    """The names that each group of experiments/ offers."""
    files = sorted(_directory().glob("*/*.yaml"))
    return {
        group: tuple(file.stem for file in members)
        for group, members in itertools.groupby(files, key=lambda file: file.parent.name)
    }


@functools.cache
def _directory() -> Path:
    """experiments/: inside the package when installed from a wheel, beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    for directory in (package / "experiments", package.parent / "experiments"):
        if (directory / "base.yaml").is_file():
            return directory
    raise ConfigError(f"{package}: experiments/base.yaml is missing; accepted is a checkout or a wheel")
