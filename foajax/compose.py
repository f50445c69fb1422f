"""From `key=value` words to a checked `Config`, by way of experiments/.

The only file that imports Hydra and OmegaConf. They take a third of a second to import, so that is
left to the functions that need them.
"""

from __future__ import annotations

import difflib
import functools
import itertools
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, cast

from foajax import cli
from foajax.config import Config, ConfigError, from_mapping

Task = Callable[[Config], int | None]  # returns an exit code, None for 0


def compose(overrides: Sequence[str] = ()) -> Config:
    """The run that `overrides` describe, e.g. `["experiment=nonfoa", "game=pong"]`, from any directory.

    Raises:
      ConfigError: an unknown key or choice, a malformed override, or a value of the wrong type or range.
    """
    import hydra
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    words = [_checked(word, sweep=False) for word in overrides]
    try:
        with hydra.initialize_config_dir(str(_directory()), version_base="1.3"):
            node = hydra.compose("base", words)
    except (HydraException, OmegaConfBaseException, ValueError, LookupError) as error:
        raise ConfigError(f"{_one_line(*overrides)}: {_first_line(error)}; accepted is key=value") from None
    return _config(node)


def list_experiments() -> list[str]:
    """What `experiment=` accepts, sorted."""
    return list(_choices()["experiment"])


def run(task: Task, arguments: Sequence[str]) -> int:
    """Runs `task` on the config that the command line describes; returns the exit code.

    A single run is composed and started directly. Flags (`--multirun`, `--help`, `--cfg`) are Hydra's; every
    run of a sweep is checked before the first one starts, and the first one that fails ends the sweep. A
    `ConfigError`, one that `task` raises included, becomes one line on stderr and exit code 2.
    """
    if any(word.startswith("-") for word in arguments):
        return cli.run(functools.partial(_run_hydra, task), arguments)
    return cli.run(lambda words: task(compose(words)), arguments)


def _run_hydra(task: Task, arguments: Sequence[str]) -> int:
    import hydra

    ours = [word for word in arguments if "=" in word and not word.startswith(("-", "hydra.", "hydra/"))]
    _check_sweep(ours)

    def job(node: Any) -> None:
        if code := cli.run(lambda _: task(_config(node)), ()):
            raise SystemExit(code)  # Hydra drops what a job returns

    words = [_checked(word, sweep=True) if word in ours else word for word in arguments]
    before = sys.argv
    sys.argv = [before[0], *words]  # hydra.main takes its arguments from nowhere else
    try:
        hydra.main(config_path=str(_directory()), config_name="base", version_base="1.3")(job)()
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 1
    finally:
        sys.argv = before
    return 0


def _check_sweep(words: Sequence[str]) -> None:
    """Composes every run of a sweep, so that a mistake in the last one does not show hours later."""
    taken: set[str] = set()
    for overrides in itertools.product(*map(_values, words)):
        config = compose(overrides)
        if config.run_dir in taken:
            accepted = "a directory for each, as with 'name=constant70-${gaze.mode}'"
            raise ConfigError(f"run={config.run_dir}: two runs would share it; accepted is {accepted}")
        taken.add(config.run_dir)


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
        return [f"{key}={choice}" for choice in value.filter(list(_choices().get(key, ())))]
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
    package = Path(__file__).resolve().parent
    for directory in (package / "experiments", package.parent / "experiments"):
        if (directory / "base.yaml").is_file():
            return directory
    raise ConfigError(f"{package}: experiments/base.yaml is missing; accepted is a checkout or a wheel")
