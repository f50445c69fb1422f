"""Reads the rows of ``metrics.jsonl``."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

_TAIL = 2**16  # bytes of metrics.jsonl read: some hundred rows
SPEED_ROWS = 10  # rows that the shown speed is averaged over


def parse_row(line: bytes, *more: str) -> dict[str, Any] | None:
    """Parses a row of ``metrics.jsonl`` with finite ``env_steps``, ``time`` and `more`; None for any other line."""
    try:
        row = json.loads(line)
        return row if all(math.isfinite(row[key]) for key in ("env_steps", "time", *more)) else None
    except (ValueError, RecursionError, LookupError, TypeError, OverflowError):
        return None


def last_rows(path: Path) -> list[dict[str, Any]]:
    """Reads the newest rows of metrics, oldest first, without torn ones."""
    try:
        with path.open("rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - _TAIL))
            lines = file.read().splitlines()
    except OSError:
        return []
    return [row for line in lines if (row := parse_row(line))]


def speed_of(rows: list[dict[str, Any]]) -> float | None:
    """Returns env_steps per second over the newest rows; None if they cover no time."""
    rows = rows[-SPEED_ROWS - 1 :]
    seconds = rows[-1]["time"] - rows[0]["time"] if rows else 0.0
    return (rows[-1]["env_steps"] - rows[0]["env_steps"]) / seconds if seconds > 0 else None
