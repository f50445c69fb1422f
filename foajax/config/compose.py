"""From `key=value` words to a checked `Config`, by way of experiments/.

Hydra and OmegaConf take a third of a second to import, so that is left to the functions that need them.
"""

from __future__ import annotations

import difflib
import functools
import itertools
from collections.abc import Sequence
from typing import Any, cast

from foajax.config.parse import ConfigError, one_line
from foajax.config.schema import Config, from_mapping
from foajax.config.shipped import experiments


def compose(overrides: Sequence[str] = ()) -> Config:
    """The run that `overrides` describe, e.g. `["experiment=nonfoa", "game=pong"]`, from any directory.

    Raises:
      ConfigError: an unknown key or choice, a malformed override, or a value of the wrong type or range.
    """
    import hydra
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    words = [checked(word, sweep=False) for word in overrides]
    outer = GlobalHydra.instance().hydra  # of an application that uses this package
    GlobalHydra.instance().clear()
    try:
        with hydra.initialize_config_dir(str(experiments()), version_base="1.3"):
            node = hydra.compose("base", words)
    except (HydraException, OmegaConfBaseException, ValueError, LookupError) as error:
        raise ConfigError(f"{one_line(*overrides)}: {_first_line(error)}; accepted is key=value") from None
    finally:
        GlobalHydra.instance().hydra = outer
    return from_node(node)


def list_experiments() -> list[str]:
    """What `experiment=` accepts, sorted."""
    return list(choices()["experiment"])


def checked(word: str, *, sweep: bool) -> str:
    """An override as Hydra is to read it. What is wrong with one alone is found here, to name it."""
    override = parse_override(word)
    key, value = override.key_or_group, override.value()
    if override.is_delete() or override.package is not None or not key:
        raise ConfigError(f"{one_line(word)}: accepted is key=value")
    if override.is_hydra_override():
        raise ConfigError(f"{one_line(word)}: accepted only together with --multirun")
    text = override.get_value_string()
    if override.is_sweep_override():
        if not sweep:
            raise ConfigError(f"{one_line(word)}: accepted is one value (more with --multirun)")
    elif key in choices() and value not in choices()[key]:
        near = difflib.get_close_matches(str(value), choices()[key], n=1)
        hint = f" (did you mean {near[0]}?)" if near else ""
        raise ConfigError(f"{one_line(word)}: accepted is one of {', '.join(choices()[key])}{hint}")
    # With ++ an unknown key reaches `from_mapping`, which can say which keys there are.
    return f"{key}={text}" if key in choices() else f"++{key}={text}"


def parse_override(word: str) -> Any:
    """One word as Hydra's parser understands it."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        return OverridesParser.create().parse_override(word)
    except HydraException:
        raise ConfigError(f"{one_line(word)}: accepted is key=value, or key='value' to quote it") from None


def from_node(node: Any) -> Config:
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


@functools.cache
def choices() -> dict[str, tuple[str, ...]]:
    """The names that each group of experiments/ offers."""
    files = sorted(experiments().glob("*/*.yaml"))
    return {
        group: tuple(file.stem for file in members)
        for group, members in itertools.groupby(files, key=lambda file: file.parent.name)
    }
