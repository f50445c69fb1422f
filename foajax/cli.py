"""Command lines of the form `key=value`, checked against a dataclass. Standard library and YAML only."""

from __future__ import annotations

import dataclasses
import errno
import inspect
import json
import os
import sys
import typing
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml

from foajax.config.parse import ConfigError, build, describe, to_mapping

Options = TypeVar("Options")
INTERRUPTED = 130  # exit code after Ctrl-C, as a shell has it
_CANNOT_WRITE = (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EROFS, errno.EISDIR, errno.ENOTDIR, errno.EEXIST)


def parse(options: type[Options], arguments: Sequence[str]) -> Options:
    """Builds `options` from `key=value` words, values read as YAML; raises `ConfigError`."""
    return build(options, _values(arguments, options, ""), "")


def override(config: Options, arguments: Sequence[str], prefix: str, keys: Sequence[str]) -> Options:
    """`config`, a part of a run's, with the values of `<prefix>.key=value` words for some of its `keys`.

    Raises:
      ConfigError: another key, or a value that it does not accept.
    """
    values = _values([word.removeprefix(f"{prefix}.") for word in arguments], type(config), f"{prefix}.")
    for key, value in values.items():
        if key not in keys:
            raise ConfigError(f"{prefix}.{key}={value}: accepted of {prefix} are {', '.join(keys)}")
    return build(type(config), to_mapping(config) | values, prefix)


def _values(arguments: Sequence[str], cls: Any, prefix: str) -> dict[str, Any]:
    values: dict[str, Any] = {}
    hints = typing.get_type_hints(cls)
    for word in arguments:
        key, separator, text = word.partition("=")
        if not separator:
            names = ", ".join(prefix + field.name for field in dataclasses.fields(cls))
            raise ConfigError(f"{prefix}{word}: accepted is key=value with one of {names}")
        values[key] = _value(prefix + key, text, hints.get(key))
    return values


def _value(key: str, text: str, hint: Any) -> Any:
    """What a word says. YAML reads 010 as 8, 1:30 as 90 and 1e1 as text, so that numbers are Python's."""
    kinds = set(typing.get_args(hint) or [hint]) - {type(None)}
    if text not in ("", "null"):
        for kind in (str, int, float):
            if kinds == {kind}:
                try:
                    return kind(text)
                except ValueError:
                    return text  # which is refused in the words of the others
    try:
        return yaml.safe_load(text or "null")
    except (yaml.YAMLError, ValueError):  # the latter from what looks like a date
        raise ConfigError(f"{key}={text}: accepted is a YAML value") from None


def check_file(key: str, path: str | None) -> None:
    """`ConfigError`, before anything long starts, where `path` is given and cannot be a file."""
    if path is None:
        return
    file = Path(path).absolute()
    if file.is_dir() or not file.parent.is_dir() or not os.access(file if file.exists() else file.parent, os.W_OK):
        raise ConfigError(f"{key}={path}: accepted is a file, to write, in a directory that exists")


def write_json(key: str, path: str, found: Any) -> None:
    """Writes what a command has found; prints it, so that it is not lost, and raises `ConfigError` where that fails."""
    text = json.dumps(found, indent=1) + "\n"
    try:
        Path(path).write_text(text, encoding="utf-8")
    except OSError as error:
        print(text)
        raise ConfigError(f"{key}={path}: cannot be written ({error.strerror}); it is printed above") from None


def run(command: Callable[[Sequence[str]], int | None], arguments: Sequence[str] | None = None) -> int:
    """Runs a command; what the user can mend is one line on stderr and exit code 2.

    `--help` prints what the command's module says of itself, and the keys of its `Options`.
    """
    words = sys.argv[1:] if arguments is None else arguments
    module = sys.modules[command.__module__]
    if not {"-h", "--help"}.isdisjoint(words) and hasattr(module, "Options"):
        print(_help(module))
        return 0
    try:
        return command(words) or 0
    except ConfigError as error:
        why = str(error)
    except KeyboardInterrupt:
        return INTERRUPTED
    except OSError as error:
        if error.errno not in _CANNOT_WRITE:
            raise
        why = f"{error.filename or 'its files'}: cannot be written ({error.strerror})"
    print(f"foajax: error: {why}", file=sys.stderr)
    return 2


def _help(module: Any) -> str:
    hints = typing.get_type_hints(module.Options)
    lines = [inspect.cleandoc(module.__doc__ or ""), ""]
    for field in dataclasses.fields(module.Options):
        value = field.default
        shown = "required" if value is dataclasses.MISSING else value if isinstance(value, str) else json.dumps(value)
        lines.append(f"  {field.name}={shown}: {describe(hints[field.name])}")
    return "\n".join(lines)


def make_directory(out: str | Path) -> Path:
    """Creates the directory for results; one line where that cannot be."""
    try:
        Path(out).mkdir(parents=True, exist_ok=True)
        if not os.access(out, os.W_OK | os.X_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except OSError as error:
        raise ConfigError(f"out={out}: accepted is a directory that can be written ({error.strerror})") from None
    return Path(out)
