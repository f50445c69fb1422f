"""Files that come with the package: inside it when installed from a wheel, beside it in a checkout."""

from __future__ import annotations

import functools
from pathlib import Path

from foajax.config.parse import refuse

_PACKAGE = Path(__file__).resolve().parents[1]


def agents() -> Path:
    """The trained agents, a directory each."""
    return _find("agents")


@functools.cache
def experiments() -> Path:
    """The base of every configuration, and its groups."""
    directory = _find("experiments")
    if not (directory / "base.yaml").is_file():
        raise refuse(str(_PACKAGE), accepted="a checkout or a wheel", why="experiments/base.yaml is missing")
    return directory


def kept_runs() -> Path:
    """What is kept of runs; in a checkout only."""
    return _PACKAGE.parent / "results" / "runs"


def _find(name: str) -> Path:
    inside = _PACKAGE / name
    return inside if inside.is_dir() else _PACKAGE.parent / name
