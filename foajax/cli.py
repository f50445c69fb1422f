"""Command lines of the form `key=value`, checked against a dataclass. Standard library and YAML only."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Sequence
from typing import Any, TypeVar, cast

import yaml

from foajax.config import ConfigError, build

Options = TypeVar("Options")


def parse(options: type[Options], arguments: Sequence[str]) -> Options:
    """Builds `options` from `key=value` words, values read as YAML; raises `ConfigError`."""
    values: dict[str, Any] = {}
    for word in arguments:
        key, separator, text = word.partition("=")
        if not separator:
            names = ", ".join(field.name for field in dataclasses.fields(cast(Any, options)))
            raise ConfigError(f"{word}: accepted is key=value with one of {names}")
        try:
            values[key] = yaml.safe_load(text) if text else None
        except yaml.YAMLError:
            raise ConfigError(f"{key}={text}: accepted is a YAML value") from None
    return build(options, values, "")


def run(command: Callable[[Sequence[str]], int | None], arguments: Sequence[str] | None = None) -> int:
    """Runs a command; what the user can mend is one line on stderr and exit code 2."""
    try:
        return command(sys.argv[1:] if arguments is None else arguments) or 0
    except ConfigError as error:
        print(f"foajax: error: {error}", file=sys.stderr)
        return 2
