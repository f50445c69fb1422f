"""Tells what is installed, which devices there are, and what each extra would add: `foajax doctor`.

The exit code is 1 where a package that foajax needs is missing or has another version.
"""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from rich.console import Console
from rich.table import Table

from foajax import cli
from foajax.config.parse import Section, one_line
from foajax.runs.provenance import machine, version

EXTRAS = {
    "cuda": "trains on an NVIDIA GPU",
    "video": "writes videos as mp4; without it they are GIFs",
    "robot": "exports agents that run without JAX",
    "slurm": "sweeps on a SLURM cluster",
    "docs": "builds the site",
    "dev": "runs the tests",
}


class Options(Section):
    """The command takes no keys."""


def doctor(arguments: Sequence[str]) -> int:
    """Prints versions, devices, free space and extras; returns 1 if a package that foajax needs is missing, else 0."""
    cli.parse(Options, arguments)
    table, missing = Table.grid(padding=(0, 2)), list(_missing("foajax"))
    rows = {
        "foajax": f"{version('foajax')}, Python {platform.python_version()}, {platform.platform()}",
        "packages": ", ".join(f"{name} {version(name)}" for name in ("jax", "flax", "envpool", "ale-py", "gymnasium")),
        "missing": ", ".join(missing) or "nothing",
        "devices": _devices(),
        "cores": f"{machine()['cores']}",
        "memory": _memory(),
        "disk": f"{shutil.disk_usage('.').free / 1e9:.0f} GB free here",
    }
    for extra, use in EXTRAS.items():
        added = ", ".join(_missing("foajax", extra))
        remedy = f"pip install 'foajax[{extra}]' would add {added}"
        rows[f"extra {extra}"] = f"{use}: {remedy if added else 'installed'}"
    for name, text in rows.items():
        table.add_row(name, text)
    Console(highlight=False, markup=False).print(table)
    return 1 if missing else 0


def _missing(package: str, extra: str = "") -> Iterator[str]:
    """Lists what a package needs, or what its extra adds, and is not installed or has a version that does not fit."""
    needed = importlib.metadata.requires(package) or [] if version(package) else [package]
    for requirement in map(Requirement, needed):
        if _applies(requirement, extra) and not (extra and _applies(requirement, "")):
            found = version(requirement.name)
            if found is None:
                yield requirement.name
            elif not requirement.specifier.contains(found, prereleases=True):
                yield f"{requirement.name}{requirement.specifier} ({found} is installed)"
            else:
                for inner in requirement.extras:
                    yield from _missing(requirement.name, inner)


def _applies(requirement: Requirement, extra: str) -> bool:
    return requirement.marker is None or requirement.marker.evaluate({"extra": extra})


def _devices() -> str:
    try:
        import jax

        devices = jax.devices()
    except Exception as error:  # whatever a driver raises is what the user wants to know
        return f"none: {one_line(error)}"
    words = [f"{device.device_kind}{_free(device)}" for device in devices]
    if devices[0].platform == "cpu" and shutil.which("nvidia-smi"):
        words.append("the NVIDIA GPU is not used: pip install 'foajax[cuda]'")
    return ", ".join(words)


def _free(device: Any) -> str:
    stats = device.memory_stats() or {}
    if "bytes_limit" not in stats:
        return ""
    return f" ({(stats['bytes_limit'] - stats['bytes_in_use']) / 1e9:.1f} GB free)"


def _memory() -> str:
    try:
        lines = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        return f"{int(lines['MemAvailable'].split()[0]) / 1e6:.1f} GB free"
    except (OSError, LookupError, ValueError):
        return f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 1e9:.1f} GB in all"


if __name__ == "__main__":
    sys.exit(cli.run(doctor))
