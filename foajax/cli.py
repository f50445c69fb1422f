"""Reads command lines of `key=value` words and checks them against a section of keys."""

from __future__ import annotations

import difflib
import errno
import inspect
import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from foajax.config.parse import ConfigError, Section, SectionT, build, refuse, replace, schema_of, suggest
from foajax.config.table import listed

INTERRUPTED = 130  # exit code after Ctrl-C, as a shell has it
_CANNOT_WRITE = (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EROFS, errno.EISDIR, errno.ENOTDIR, errno.EEXIST)


def parse(options: type[SectionT], arguments: Sequence[str]) -> SectionT:
    """Builds `options` from `key=value` words, values read as YAML; raises `ConfigError`."""
    return build(options, _values(arguments, options, ""))


def override(config: SectionT, arguments: Sequence[str], prefix: str, keys: Sequence[str]) -> SectionT:
    """Returns a section of a run's configuration, changed by `<prefix>.key=value` words.

    Raises:
      ConfigError: a key that is not one of `keys`, or a value that is not accepted.
    """
    values = _values([word.removeprefix(f"{prefix}.") for word in arguments], type(config), f"{prefix}.")
    for key, value in values.items():
        if key not in keys:
            near = [f"{prefix}.{each}" for each in difflib.get_close_matches(key, keys, n=1)]
            is_known = key in type(config).model_fields
            why = "cannot be changed" if is_known else suggest("unknown key", *near)
            raise refuse(f"{prefix}.{key}", value, f"one of {', '.join(f'{prefix}.{each}' for each in keys)}", why=why)
    return replace(config, **values)


def split(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Separates directories, whose names may hold a "=", from the other words."""
    directories = [word for word in arguments if "=" not in word or os.path.isdir(word)]
    others = [word for word in arguments if word not in directories]
    for word in others:
        if word.startswith("run="):
            raise refuse(word, accepted=f"{word.removeprefix('run=')}, without run=")
    return directories, others


def take_directory(arguments: Sequence[str]) -> tuple[Path | None, list[str]]:
    """Separates the directory of `--config-dir`, which holds the user's own choices, from the other words."""
    words = list(arguments)
    for i, word in enumerate(words):
        flag, is_joined, value = word.partition("=")
        if flag in ("--config-dir", "-cd"):
            end = i + (1 if is_joined else 2)
            given = value if is_joined else "".join(words[i + 1 : end])
            directory = Path(given).absolute()
            if not directory.is_dir() or end > len(words):
                raise refuse(flag, given, "a directory with experiment/, sensor/, network/ or learner/")
            return directory, words[:i] + words[end:]
    return None, words


def _values(arguments: Sequence[str], cls: type[Section], prefix: str) -> dict[str, Any]:
    values: dict[str, Any] = {}
    keys = schema_of(cls)["properties"]
    for word in arguments:
        key, separator, text = word.partition("=")
        if not separator:
            names = ", ".join(prefix + key for key in keys)
            raise refuse(
                f"{prefix}{word}",
                accepted=names and f"key=value with one of {names}",
                why="" if names else "the command takes no words",
            )
        values[key] = _value(prefix + key, text, keys.get(key, {}))
    return values


def _value(key: str, text: str, node: Mapping[str, Any]) -> Any:
    """Reads a value as YAML, but numbers as Python does: YAML takes 010 for 8, 1:30 for 90 and 1e1 for text."""
    kinds = {each.get("type") for each in node.get("anyOf", [node])} - {"null"}
    if text not in ("", "null"):
        for name, kind in {"string": str, "integer": int, "number": float}.items():
            if kinds == {name}:
                try:
                    return kind(text)
                except ValueError:
                    return text  # `build` refuses it
    try:
        return yaml.safe_load(text or "null")
    except (yaml.YAMLError, ValueError):  # the latter from what looks like a date
        raise refuse(key, text, "a YAML value") from None


def check_file(key: str, path: str | None) -> None:
    """Raises `ConfigError` if a file could not be written to `path`; call it before anything long starts."""
    if path is None:
        return
    file = Path(path).absolute()
    if file.is_dir() or not file.parent.is_dir() or not os.access(file if file.exists() else file.parent, os.W_OK):
        raise refuse(key, path, "a file that can be written, in a directory that exists")


def write_json(key: str, path: str, found: Any) -> None:
    """Writes what a command has found. If that fails, prints it, so that it is not lost, and raises `ConfigError`."""
    text = json.dumps(found, indent=1) + "\n"
    try:
        Path(path).write_text(text, encoding="utf-8")
    except OSError as error:
        print(text)
        raise refuse(key, path, "", why=f"cannot be written ({error.strerror}); it is printed above") from None


def run(command: Callable[[Sequence[str]], int | None], arguments: Sequence[str] | None = None) -> int:
    """Runs a command; returns its exit code. A mistake of the user becomes one line on stderr and exit code 2.

    `--help` prints the docstring of the command's module and the keys of its `Options`.
    """
    words = sys.argv[1:] if arguments is None else arguments
    module = sys.modules[command.__module__]
    if not {"-h", "--help"}.isdisjoint(words) and hasattr(module, "Options"):
        print(f"{inspect.cleandoc(module.__doc__ or '')}\n\n{listed(module.Options)}")
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


def make_directory(out: str | Path, key: str = "out") -> Path:
    """Creates the directory for results that `key` names; raises `ConfigError` if it cannot be written."""
    try:
        Path(out).mkdir(parents=True, exist_ok=True)
        if not os.access(out, os.W_OK | os.X_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except OSError as error:
        raise refuse(key, out, f"a directory that can be written ({error.strerror})") from None
    return Path(out)
