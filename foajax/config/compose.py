"""Makes a checked `Config` from `key=value` words and from the files in experiments/ and in a directory of your own.

Importing Hydra and OmegaConf takes a third of a second, so only the functions that need them do it.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, cast

import yaml

from foajax.config.parse import ABSENT, Section, one_line, refuse, with_sentence
from foajax.config.schema import (
    RENAMED,
    Config,
    LogPolarSensor,
    OwnSensor,
    RingSensor,
    from_mapping,
    game_name,
    renamed,
)
from foajax.config.shipped import experiments
from foajax.config.table import defaults, groups

# The sections of `sensor`; each name is also a choice of `sensor=`.
_KINDS: dict[str, type[Section]] = {"rings": RingSensor, "logpolar": LogPolarSensor, "own": OwnSensor}
_PLANS = "plans"  # of experiments/; `foajax.reproduce` reads them, they are no group
_NAMES = ("run", "name", "train.init_from")  # sweeps name runs like runs/pong-nonfoa-gaze=frozen-s0
_WHOLE = "nonfoa"  # the whole frame, which has no packed layout


def compose(overrides: Sequence[str] = (), config_dir: str | Path | None = None) -> Config:
    """Makes the configuration of a run, as `foajax train` does.

    Args:
      overrides: words of a command line, e.g. `["experiment=nonfoa", "game=pong"]`.
      config_dir: a directory with choices of your own, in experiment/, sensor/, gaze/, network/, learner/.

    Raises:
      ConfigError: a word is not `key=value`, a key or choice is unknown, or a value has the wrong type or range; there
        is no such directory.
    """
    import hydra
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    if isinstance(overrides, str):
        raise refuse("overrides", overrides, 'a list of words, such as ["experiment=nonfoa"]')
    if config_dir is not None and not Path(config_dir).is_dir():
        raise refuse("config_dir", config_dir, "a directory")
    words = [checked(word, sweep=False, config_dir=config_dir) for word in overrides]
    place = "" if config_dir is None else str(Path(config_dir).absolute()).replace("'", "\\'")
    more = [f"hydra.searchpath=['file://{place}']"] if place else []
    register()
    outer = GlobalHydra.instance().hydra  # of an application that uses this package
    GlobalHydra.instance().clear()
    try:
        with hydra.initialize_config_dir(str(experiments()), version_base="1.3"):
            node = hydra.compose("base", [*words, *more])
    except (HydraException, OmegaConfBaseException, yaml.YAMLError, ValueError, LookupError) as error:
        raise refuse(one_line(*overrides), why=_first_line(error)) from None
    finally:
        GlobalHydra.instance().hydra = outer
    return from_node(node, words)


def register() -> None:
    """Registers with Hydra what is in no file: the defaults, packed sensors, an experiment for each ring sensor."""
    from hydra.core.config_store import ConfigStore

    store = ConfigStore.instance().store
    store("foajax_keys", defaults(Config))
    for name, cls in _KINDS.items():
        store(name, defaults(cls), group="sensor")
    for name in _packed():
        store(name, {"defaults": [name.removesuffix("_packed")], "layout": "packed"}, group="sensor")
    for name in (*_rings(), *_packed()):
        node = {"defaults": [{"override /sensor": name}], "name": name}
        store(name, node, group="experiment", package="_global_")


def list_experiments() -> list[str]:
    """Lists what `experiment=` accepts, sorted."""
    return list(choices()["experiment"])


def checked(word: str, *, sweep: bool, config_dir: str | Path | None = None) -> str:
    """Returns an override as Hydra is to read it. Refuses a word that is wrong by itself, and so can name it."""
    override = parse_override(word)
    key, value = override.key_or_group, override.value()
    if override.is_delete() or override.package is not None or not key:
        raise refuse(one_line(word))
    if override.is_hydra_override():
        raise refuse(one_line(word), accepted="", why="keys of hydra need --multirun")
    if key == _PLANS:  # Hydra takes its directory for a group
        raise refuse(one_line(word), accepted=Config.model_fields, why="unknown key")
    text = override.get_value_string()
    offered = choices(config_dir)
    if override.is_sweep_override():
        if not sweep:
            raise refuse(one_line(word), accepted="one value (more with --multirun)")
    elif key in offered and value not in offered[key]:
        raise refuse(one_line(word), accepted=offered[key], near=str(value))
    # With ++ an unknown key reaches `from_mapping`, which can say which keys there are.
    if key == "game":
        text = ",".join(game_name(name) for name in text.split(","))  # several of a sweep
    for old, new in RENAMED.items():
        text = text.replace(f"${{{old}}}", f"${{{new}}}")
    return f"{key}={text}" if key in offered else f"++{RENAMED.get(key, key)}={text}"


def parse_override(word: str) -> Any:
    """Parses a word as one of Hydra's overrides; raises `ConfigError` for any other word."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        return OverridesParser.create().parse_override(word)
    except HydraException:
        key, _, value = word.partition("=")
        if key in _NAMES and re.fullmatch(r"[\w./=+-]+", value):
            return parse_override(f"{key}='{value}'")
        raise refuse(one_line(word), accepted="key=value, or \"key='value'\" to quote it") from None


def from_node(node: Any, words: Collection[str] = ()) -> Config:
    """Makes a checked `Config` from an OmegaConf node. A key that `words` set wins over an old name for it."""
    from omegaconf import OmegaConf
    from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

    try:
        stated = {word.lstrip("+").partition("=")[0] for word in words}
        plain = renamed(cast(dict, OmegaConf.to_container(node)), stated)  # before a key follows another
        _check_kind(plain.get("sensor"), stated)
        node = OmegaConf.create(plain)
        return from_mapping(OmegaConf.to_container(node, resolve=True, throw_on_missing=True))
    except MissingMandatoryValue as error:
        required = (key for group in groups(Config) for key in group.keys if key.default is ABSENT)
        known = {key.name: with_sentence(key.accepted, key.sentence) for key in required}
        accepted = known.get(str(error.full_key), f"{error.full_key}=value")
        raise refuse(str(error.full_key), accepted=accepted, why="missing") from None
    except OmegaConfBaseException as error:
        accepted = "a value or ${key} with another key's name"
        raise refuse(str(error.full_key), accepted=accepted, why=_first_line(error)) from None


def _check_kind(sensor: Any, stated: Collection[str]) -> None:
    """Raises `ConfigError` if a word changes `sensor.kind` but the keys of another kind are left."""
    kind = sensor.get("kind") if isinstance(sensor, dict) else None
    cls = _KINDS.get(str(kind))
    if cls is not None and "sensor.kind" in stated and sensor.keys() - cls.model_fields.keys():
        raise refuse("sensor.kind", kind, f"sensor={kind}, which brings the keys of that kind")


def _first_line(error: Exception) -> str:
    return str(error).partition("\n")[0]


@functools.cache
def _rings() -> tuple[str, ...]:
    """Lists the ring sensors of experiments/ that leave the layout open, without the whole frame."""
    files = (file for file in experiments().glob("sensor/*.yaml") if file.stem != _WHOLE)
    return tuple(
        sorted(file.stem for file in files if not {"kind", "layout"} & yaml.safe_load(file.read_text()).keys())
    )


def _packed() -> tuple[str, ...]:
    """Lists the same sensors in the packed layout."""
    return tuple(f"{name}_packed" for name in _rings())


@functools.cache
def choices(config_dir: str | Path | None = None) -> dict[str, tuple[str, ...]]:
    """Lists each group's choices: the files of experiments/ and of `config_dir`, and what `register` adds."""
    found: dict[str, set[str]] = {"sensor": {*_KINDS, *_packed()}, "experiment": {*_rings(), *_packed()}}
    for directory in [experiments()] + ([] if config_dir is None else [Path(config_dir)]):
        for file in directory.glob("*/*.yaml"):
            if file.parent.name != _PLANS:
                found.setdefault(file.parent.name, set()).add(file.stem)
    return {group: tuple(sorted(names)) for group, names in sorted(found.items())}
