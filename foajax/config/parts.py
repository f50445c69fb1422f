"""Finds the parts that a configuration names: foajax's own by a word, the user's by `package.module:Name`."""

from __future__ import annotations

import functools
import importlib
import inspect
from collections.abc import Callable, Mapping
from typing import Any

from foajax.config.parse import one_line, refuse


def is_code(name: str) -> bool:
    """Whether a name is that of the user's code, `package.module:Name`."""
    return ":" in name


def bind_part(key: str, name: str, ours: Mapping[str, Callable[..., Any]], /, **arguments: Any) -> functools.partial:
    """Returns a function of no arguments that makes the part `key=name`.

    A name of code imports its module, which runs it: pass only what the user trusts.

    Raises:
      ConfigError: the part cannot be found, or it does not take these arguments.
    """
    if not is_code(name) and name not in ours:
        raise refuse(key, name, (*ours, "package.module:Name"))
    make = _import(key, name) if is_code(name) else ours[name]
    try:
        inspect.signature(make).bind(**arguments)
    except TypeError as error:
        names = [word for word in inspect.signature(make).parameters if word not in ("parent", "name")]  # Flax's own
        accepted = f"arguments {', '.join(names)}" if names else "no argument"
        raise refuse(key, name, accepted, why=one_line(error)) from None
    return functools.partial(make, **arguments)


def make_part(key: str, name: str, ours: Mapping[str, Callable[..., Any]], /, **arguments: Any) -> Any:
    """Makes the part `key=name`; raises `ConfigError` as `bind_part` does."""
    return bind_part(key, name, ours, **arguments)()


def _import(key: str, name: str) -> Callable[..., Any]:
    module, _, path = name.partition(":")
    try:
        found: Any = functools.reduce(getattr, path.split("."), importlib.import_module(module))
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise refuse(key, name, "package.module:Name", why=one_line(error)) from None
    if not callable(found):
        raise refuse(key, name, "package.module:Name of a class or a function")
    return found
