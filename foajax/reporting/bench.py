"""Writes measurements, and the table of those that are kept in `results/bench/`."""

from __future__ import annotations

import datetime
import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import Field

from foajax import cli
from foajax.config import shipped
from foajax.config.parse import Section
from foajax.reporting.markdown import table
from foajax.runs.provenance import commit, machine

BENCH = shipped.kept_runs().parent / "bench"
_INTRO = """# Measurements
Each file has its command, commit, machine and date, and under `results` what the command found. Made by `foajax keep`.
"""


class Options(Section):
    """The keys of every benchmark."""

    out: str | None = Field(None, description="File for the result.")

    def check(self) -> None:
        cli.check_file("out", self.out)


def write(key: str, path: str, results: Any, command: Sequence[str]) -> None:
    """Writes what `command` has found, with the command, commit, date and machine."""
    found = {
        "command": shlex.join(command),
        "commit": commit(),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "machine": machine(),
        "results": results,
    }
    cli.write_json(key, path, found)


def write_table(directory: Path = BENCH) -> None:
    """Writes the table of all kept measurements."""
    rows = []
    for file in sorted(directory.glob("*.json")):
        found = json.loads(file.read_text())
        where = found["machine"]
        note = f", {where['note']}" if "note" in where else ""
        cores = f"{where['cores']} cores, {where['cpu']}{note}"
        rows.append([f"[{file.stem}]({file.name})", found["date"], found["commit"][:7], cores, f"`{found['command']}`"])
    head = ["file", "date", "commit", "machine", "command"]
    (directory / "README.md").write_text(f"{_INTRO}\n{table(head, rows)}\n")
