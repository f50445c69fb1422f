"""Mappings become checked dataclasses, and dataclasses mappings: the part that knows of no key.

Whatever is unknown, of the wrong type or out of range raises `ConfigError` with one line that names the key,
the value and what is accepted. Standard library only.
"""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal


class ConfigError(ValueError):
    """A configuration that cannot be run; the message is one line for the user."""


def check(ok: bool, key: str, value: object, accepted: str) -> None:
    """`ConfigError` about a key unless `ok`."""
    if not ok:
        raise ConfigError(f"{key}={brief(value)}: accepted is {accepted}")


def one_line(*parts: object) -> str:
    """Words, or an error, as they fit into a line."""
    return " ".join(" ".join(map(str, parts)).split())


def file_name(text: str) -> str:
    """A text as a part of a file's name."""
    return "".join(c if c.isalnum() or c in "_-." else "-" for c in text)


def brief(value: object) -> str:
    """A value in one line, of 80 characters at most."""
    text = str(list(value)) if isinstance(value, tuple) else str(value)
    text = one_line(text)
    return text if len(text) <= 80 else text[:77] + "..."


def check_types(config: Any, key: str) -> None:
    """For what is also built in Python: the types that `build` checks of a mapping."""
    hints = typing.get_type_hints(type(config))
    for field in dataclasses.fields(config):
        value = _convert(hints[field.name], getattr(config, field.name), f"{key}.{field.name}")
        object.__setattr__(config, field.name, value)


def to_mapping(config: Any) -> dict[str, Any]:
    """The inverse of `from_mapping`: plain dicts, lists and scalars."""

    def plain(value: Any) -> Any:
        if dataclasses.is_dataclass(value):
            return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
        if isinstance(value, Mapping):
            return {k: plain(v) for k, v in value.items()}
        return [plain(v) for v in value] if isinstance(value, tuple) else value

    return plain(config)


def flatten(mapping: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys and their values."""
    for key, value in mapping.items():
        if isinstance(value, Mapping):
            yield from flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def build(cls: Any, value: Any, key: str) -> Any:
    """A dataclass from a mapping, every field converted to its annotated type."""
    if not isinstance(value, Mapping):
        raise ConfigError(f"{key or 'config'}={brief(value)}: accepted is a mapping")
    hints = typing.get_type_hints(cls)
    names = [f.name for f in dataclasses.fields(cls)]
    prefix = f"{key}." if key else ""
    for name in value:
        if name not in names:
            raise ConfigError(
                f"{prefix}{brief(name)}={brief(value[name])}: unknown key; accepted are {', '.join(names)}"
            )
    for field in dataclasses.fields(cls):
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if required and field.name not in value:
            raise ConfigError(f"{prefix}{field.name}: missing; accepted is {describe(hints[field.name])}")
    kwargs = {name: _convert(hints[name], v, f"{prefix}{name}") for name, v in value.items()}
    try:
        return cls(**kwargs)
    except ConfigError as error:
        raise ConfigError(f"{prefix}{error}" if getattr(cls, "relative_keys", False) else str(error)) from None


def _convert(hint: Any, value: Any, key: str) -> Any:
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any:
        return value
    if origin in (typing.Union, types.UnionType):
        if all(map(dataclasses.is_dataclass, args)):
            return _build_kind(args, value, key)
        for option in args:
            try:
                return _convert(option, value, key)
            except ConfigError:
                continue
        raise ConfigError(f"{key}={brief(value)}: accepted is {describe(hint)}")
    if dataclasses.is_dataclass(hint):
        return build(hint, value, key)
    accepted = ConfigError(f"{key}={brief(value)}: accepted is {describe(hint)}")
    if origin is Literal:
        for option in args:
            if type(option) is type(value) and option == value:
                return value
        raise accepted
    if origin is tuple:
        if not isinstance(value, (list, tuple)):
            raise accepted
        if args[-1] is Ellipsis:
            return tuple(_convert(args[0], v, key) for v in value)
        if len(value) != len(args):
            raise accepted
        return tuple(_convert(a, v, key) for a, v in zip(args, value, strict=True))
    if origin is not None and issubclass(origin, Mapping):
        if not isinstance(value, Mapping) or not all(isinstance(k, args[0]) for k in value):
            raise accepted
        return {k: _convert(args[1], v, f"{key}.{k}") for k, v in value.items()}
    if hint is type(None):
        if value is None:
            return None
    elif hint is float:
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if is_number and (value == 0 or 1e-37 <= abs(value) <= 1e38):  # others would be 0 or infinite in float32
            return float(value)
    elif type(value) is hint:
        return value
    raise accepted


def _build_kind(classes: Sequence[Any], value: Any, key: str) -> Any:
    """One of several dataclasses, told apart by their `kind`; the first where none is named, the last for code."""
    *named, own = classes
    kinds = {each.kind: each for each in named}
    kind = value.get("kind", named[0].kind) if isinstance(value, Mapping) else named[0].kind
    if isinstance(kind, str) and ":" in kind:
        return build(own, value, key)
    if not (isinstance(kind, str) and kind in kinds):
        raise ConfigError(f"{key}.kind={brief(kind)}: accepted is one of {', '.join(kinds)} or package.module:Class")
    return build(kinds[kind], value, key)


def describe(hint: Any) -> str:
    """What a type accepts, in words."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        return "one of " + ", ".join(str(a) for a in args)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(describe(a) for a in args)
    if origin is tuple:
        if args[-1] is Ellipsis:
            return f"a list of {describe(args[0])}"
        return "[" + ", ".join(describe(a) for a in args) + "]"
    if origin is not None:
        return "a mapping" if args[1] is Any else f"a mapping to {describe(args[1])}"
    plain = {
        int: "an integer",
        float: "a number (0, or of 1e-37 to 1e38)",
        bool: "true or false",
        str: "a string",
        type(None): "null",
    }
    return plain.get(hint, "a mapping")
