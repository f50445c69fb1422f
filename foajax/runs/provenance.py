"""Records in ``run.json`` with what command, code and machine each start of a run was made."""

from __future__ import annotations

import datetime
import importlib.metadata
import json
import os
import platform
import socket
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from foajax.config.parse import refuse
from foajax.runs import durable
from foajax.runs.lock import RunError

RECORD = "run.json"
_PACKAGES = ("foajax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy", "envpool", "ale-py", "gymnasium")


def record_start(path: Path, command: Sequence[str], devices: Sequence[str]) -> None:
    """Adds an entry for this start of the run in `path`."""
    file = path / RECORD
    try:
        record = json.loads(file.read_text(encoding="utf-8")) if os.path.lexists(file) else {"starts": []}
        record["starts"].append(_describe_start(command, devices))
    except (ValueError, RecursionError, LookupError, TypeError, AttributeError):
        raise refuse(str(file), accepted="", why="is not the record of a run; move it away", kind=RunError) from None
    durable.replace(file, (json.dumps(record, indent=1) + "\n").encode())


def _describe_start(command: Sequence[str], devices: Sequence[str]) -> dict[str, Any]:
    return {
        "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": list(command),
        "directory": os.getcwd(),
        "commit": commit(),
        "host": socket.gethostname(),
        "process": os.getpid(),
        **machine(),
        "devices": list(devices),
    }


def machine() -> dict[str, Any]:
    """Describes what decides how fast a program runs here, and how it rounds."""
    return {
        "python": platform.python_version(),
        "packages": {name: version(name) for name in _PACKAGES},
        "system": platform.platform(),
        "cpu": _cpu(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
    }


def version(package: str) -> str | None:
    """Returns the version of an installed package; None if it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def commit() -> str | None:
    """Returns the commit of this package's checkout, with "-dirty" after changes; None outside of a checkout."""
    package = Path(__file__).resolve().parents[1]
    # An installed package may lie inside the checkout of something else.
    if not (package.parent / ".git").exists():
        return None
    words = ["git", "-C", str(package), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        result = subprocess.run(words, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return result.stdout.strip() or None


def last_commit(path: Path) -> str | None:
    """Returns the commit that the run in `path` was last started with; None if it is unknown."""
    try:
        return json.loads((path / RECORD).read_text(encoding="utf-8"))["starts"][-1]["commit"]
    except (OSError, ValueError, LookupError, TypeError):
        return None


def _cpu() -> str:
    """Returns the processor's model where the system tells it, else its architecture."""
    try:
        lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.machine()
