"""The outputs of a run that trains: ``metrics.jsonl``, TensorBoard, the terminal, and what `train.logger` names.

``metrics.jsonl`` in the run directory is the source of truth, one JSON object per row:

    {"env_steps": 64000, "time": 51.2, "score": 1.5, ...}

``time`` is seconds of training over all starts of the run, without the work that a resumed run repeats.
Numbers that are not finite become null, so that every row is valid JSON. An output that fails does not end the run.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping
from numbers import Integral
from pathlib import Path
from typing import Any, SupportsFloat

import numpy as np
from jaxtyping import UInt8

from foajax.config.parse import one_line
from foajax.runs import durable
from foajax.runs.display import Display
from foajax.runs.durable import WholeFile
from foajax.runs.row_logger import RowLogger
from foajax.runs.rows import parse_row
from foajax.runs.tensorboard import EventFile

_WARN_EVERY = 60.0  # seconds between two warnings about the same output
_OTHER = "train.logger"


class Logger:
    """All outputs of one start of a run.

    Args:
      run_dir: where ``metrics.jsonl`` and ``tensorboard/`` are.
      total_env_steps: where the run ends.
      start_env_steps: where this start takes it up. Rows beyond it belong to work that will be done again
        and are removed, as are torn ones.
      live: whether to draw in place; None does so where stdout is a terminal.
      other: makes one more logger, which gets each row too.

    Raises:
      OSError: ``metrics.jsonl`` cannot be read or written now. Later such errors are only reported.
    """

    def __init__(
        self,
        run_dir: str | os.PathLike[str],
        *,
        total_env_steps: int,
        start_env_steps: int,
        live: bool | None = None,
        other: Callable[[], RowLogger] | None = None,
    ) -> None:
        directory = Path(run_dir)
        self._metrics = _MetricsFile(directory / "metrics.jsonl", start_env_steps)
        self._events = EventFile(directory / "tensorboard", start_env_steps)
        self._env_steps = start_env_steps
        self._seconds = self._metrics.seconds - time.monotonic()
        self._warned: dict[str, float] = {}
        self._display = Display(
            total_env_steps=total_env_steps,
            start=(start_env_steps, self._metrics.seconds),
            live=live,
        )
        self._other: RowLogger | None = None
        if other is not None:
            with self._survive(_OTHER):
                self._other = other()

    def write(self, row: Mapping[str, SupportsFloat]) -> None:
        """Writes a row of scalars; ``env_steps`` is required, ``time`` is added unless it is there."""
        env_steps, seconds = int(float(row["env_steps"])), round(time.monotonic() + self._seconds, 3)
        scalars = {name: _plain(value) for name, value in row.items()}
        record = {"env_steps": env_steps, "time": seconds} | scalars | {"env_steps": env_steps}
        self._env_steps = env_steps
        with self._survive("metrics.jsonl"):
            self._metrics.append(record)
        with self._survive("tensorboard"):
            self._events.scalars(record)
        self._display.show(record)
        if self._other is not None:
            with self._survive(_OTHER):
                finite = {name: x for name, x in record.items() if x is not None and name != "env_steps"}
                self._other.log(finite, env_steps)

    def image(self, tag: str, array: UInt8[np.ndarray, "H W *C"]) -> None:
        """Writes an image, gray or in colour, 0..255, to TensorBoard, at the last row's ``env_steps``."""
        with self._survive("tensorboard"):
            self._events.image(tag, array, self._env_steps)

    def message(self, text: str) -> None:
        """Prints a line on the terminal; may be called from any thread."""
        self._display.message(text)

    def leave_terminal(self) -> None:
        """Ends what is drawn in place on the terminal."""
        self._display.close()

    def close(self) -> None:
        """Closes the display and the files."""
        for output, close in (("metrics.jsonl", self._metrics.close), ("tensorboard", self._events.close)):
            with self._survive(output):
                close()
        if self._other is not None:
            with self._survive(_OTHER):
                self._other.close()
        self.leave_terminal()

    def __enter__(self) -> Logger:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @contextlib.contextmanager
    def _survive(self, output: str) -> Iterator[None]:
        """Turns an error into a warning, at most one per minute for each output."""
        try:
            yield
        except Exception as error:
            now = time.monotonic()
            if now - self._warned.get(output, -math.inf) >= _WARN_EVERY:
                self._warned[output] = now
                reason = one_line(error) or type(error).__name__
                failed = "fails" if output == _OTHER else "cannot be written"
                self.message(f"warning: {output} {failed} ({reason}); training goes on")


def _plain(value: SupportsFloat) -> int | float | None:
    """Converts a number to one that JSON has; None if it is not finite."""
    if isinstance(value, Integral):
        return int(value)
    number = float(value)
    return number if math.isfinite(number) else None


class _MetricsFile:
    """The file ``metrics.jsonl``. Rows that could not be written are kept and come first the next time."""

    def __init__(self, path: Path, start_env_steps: int) -> None:
        self.seconds = _trim(path, start_env_steps)  # of training up to the last row
        self._pending = b""
        self._file = WholeFile(path)

    def append(self, record: Mapping[str, Any]) -> None:
        self._pending += json.dumps(record, allow_nan=False).encode() + b"\n"
        self._flush()

    def close(self) -> None:
        try:
            self._flush()
        finally:
            self._file.close()

    def _flush(self) -> None:
        self._file.append(self._pending)
        self._pending = b""


def _trim(path: Path, start_env_steps: int) -> float:
    """Removes rows beyond `start_env_steps` and torn ones; returns the ``time`` of the last row that stays.

    Where nothing stays (a run whose checkpoints are gone starts anew), the rows are kept as ``metrics.old.jsonl``.
    """
    content = path.read_bytes() if path.exists() else b""
    kept, seconds = [], 0.0
    for line in content.splitlines(keepends=True):
        row = parse_row(line) if line.endswith(b"\n") else None
        if row is not None and row["env_steps"] <= start_env_steps:
            kept.append(line)
            seconds = float(row["time"])
    if content and not kept:
        old = path.with_name("metrics.old.jsonl")
        durable.replace(old, (old.read_bytes() if old.exists() else b"") + content)
        path.unlink()
    elif b"".join(kept) != content:
        then = path.stat()
        durable.replace(path, b"".join(kept))
        os.utime(path, ns=(then.st_atime_ns, then.st_mtime_ns))  # newer, `status` would take the rows for this start's
    return seconds
