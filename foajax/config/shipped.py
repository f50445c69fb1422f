"""Finds the files that come with foajax: inside the package in a wheel, beside it in a checkout."""

from __future__ import annotations

import functools
from pathlib import Path

from foajax.config.parse import refuse

_PACKAGE = Path(__file__).resolve().parents[1]


def agents() -> Path:
    """Returns the directory of the trained agents, which has a directory for each."""
    return _find("agents")


@functools.cache
def experiments() -> Path:
    """Returns the directory with base.yaml and the groups of choices."""
    directory = _find("experiments")
    if not (directory / "base.yaml").is_file():
        raise refuse(str(_PACKAGE), accepted="a checkout or an installed wheel", why="experiments/base.yaml is missing")
    return directory


def kept_runs() -> Path:
    """Returns the directory of the kept runs, which only a checkout has."""
    return _PACKAGE.parent / "results" / "runs"


def _find(name: str) -> Path:
    inside = _PACKAGE / name
    return inside if inside.is_dir() else _PACKAGE.parent / name
