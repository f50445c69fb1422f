"""Finds the parts that a configuration names: one of the package's own, or `package.module:Name` of the user's."""

from __future__ import annotations

import functools
import importlib
import inspect
from collections.abc import Callable, Mapping
from typing import Any

from foajax.config.parse import one_line, refuse


def is_code(name: str) -> bool:
    """Whether a name is that of code, `package.module:Name`."""
    return ":" in name


def bind_part(key: str, name: str, ours: Mapping[str, Callable[..., Any]], /, **arguments: Any) -> functools.partial:
    """What makes the part that `key=name` asks for, with these arguments, once it is called.

    A name of code imports its module: only what the user trusts.

    Raises:
      ConfigError: there is no such word, module or name in the module, or it takes other arguments than these.
    """
    if not is_code(name) and name not in ours:
        raise refuse(key, name, (*ours, "package.module:Name"))
    make = _import(key, name) if is_code(name) else ours[name]
    try:
        inspect.signature(make).bind(**arguments)
    except TypeError as error:
        names = [word for word in inspect.signature(make).parameters if word not in ("parent", "name")]  # Flax's own
        raise refuse(key, name, f"arguments {', '.join(names) or 'none'}", why=one_line(error)) from None
    return functools.partial(make, **arguments)


def make_part(key: str, name: str, ours: Mapping[str, Callable[..., Any]], /, **arguments: Any) -> Any:
    """The part itself; `ConfigError` as of `bind_part`."""
    return bind_part(key, name, ours, **arguments)()


def _import(key: str, name: str) -> Callable[..., Any]:
    module, _, path = name.partition(":")
    try:
        found: Any = functools.reduce(getattr, path.split("."), importlib.import_module(module))
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise refuse(key, name, f"package.module:Name ({one_line(error)})") from None
    if not callable(found):
        raise refuse(key, name, "package.module:Name of something to call")
    return found
