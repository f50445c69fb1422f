"""What a run says while it trains: ``metrics.jsonl``, TensorBoard, the terminal.

``metrics.jsonl`` in the run directory is the source of truth, one JSON object a row:

    {"env_steps": 64000, "time": 51.2, "score": 1.5, ...}

``time`` is seconds of training over all starts of the run, without the work that a resumed run repeats.
What is not finite becomes null, so that every row is valid JSON. No output that fails ends a run.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import socket
import struct
import time
from collections import deque
from collections.abc import Iterator, Mapping
from numbers import Integral
from pathlib import Path
from typing import Any, SupportsFloat

import numpy as np
from jaxtyping import UInt8

from foajax.runs import durable
from foajax.runs.directory import parse_row
from foajax.runs.display import Display
from foajax.types import Outcome

_WARN_EVERY = 60.0  # seconds between two warnings about the same output


class Logger:
    """All outputs of one start of a run.

    Args:
      run_dir: where ``metrics.jsonl`` and ``tensorboard/`` are.
      total_env_steps: where the run ends.
      start_env_steps: where this start takes it up. Rows beyond it belong to work that will be done again
        and are removed, as are torn ones.
      frame_skip: emulator frames an agent step, for the terminal.
      live: whether to draw in place; None does so where stdout is a terminal.

    Raises:
      OSError: ``metrics.jsonl`` cannot be read or written now. Later such errors are only reported.
    """

    def __init__(
        self,
        run_dir: str | os.PathLike[str],
        *,
        total_env_steps: int,
        start_env_steps: int,
        frame_skip: int = 4,
        live: bool | None = None,
    ) -> None:
        directory = Path(run_dir)
        self._metrics = _MetricsFile(directory / "metrics.jsonl", start_env_steps)
        self._events = _EventFile(directory / "tensorboard", start_env_steps)
        self._env_steps = start_env_steps
        self._seconds = self._metrics.seconds - time.monotonic()
        self._warned: dict[str, float] = {}
        self._display = Display(
            total_env_steps=total_env_steps,
            start=(start_env_steps, self._metrics.seconds),
            frame_skip=frame_skip,
            live=live,
        )

    def write(self, row: Mapping[str, SupportsFloat]) -> None:
        """One row of scalars; ``env_steps`` is required, ``time`` is added unless it is there."""
        env_steps, seconds = int(float(row["env_steps"])), round(time.monotonic() + self._seconds, 3)
        scalars = {name: _plain(value) for name, value in row.items()}
        record = {"env_steps": env_steps, "time": seconds} | scalars | {"env_steps": env_steps}
        self._env_steps = env_steps
        with self._survive("metrics.jsonl"):
            self._metrics.append(record)
        with self._survive("tensorboard"):
            self._events.scalars(record)
        self._display.show(record)

    def image(self, tag: str, array: UInt8[np.ndarray, "H W"] | UInt8[np.ndarray, "H W 3"]) -> None:
        """An image, gray or colour, 0..255, for TensorBoard; belongs to the last row's ``env_steps``."""
        with self._survive("tensorboard"):
            self._events.image(tag, array, self._env_steps)

    def message(self, text: str) -> None:
        """A line for the reader of the terminal; may come from any thread."""
        self._display.message(text)

    def close(self) -> None:
        """Ends the display and the files."""
        for output, close in (("metrics.jsonl", self._metrics.close), ("tensorboard", self._events.close)):
            with self._survive(output):
                close()
        self._display.close()

    def __enter__(self) -> Logger:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @contextlib.contextmanager
    def _survive(self, output: str) -> Iterator[None]:
        """Turns an error into a message, at most one a minute for each output."""
        try:
            yield
        except Exception as error:
            now = time.monotonic()
            if now - self._warned.get(output, -math.inf) >= _WARN_EVERY:
                self._warned[output] = now
                reason = " ".join(str(error).split()) or type(error).__name__
                self.message(f"warning: {output} cannot be written ({reason}); training goes on")


def _plain(value: SupportsFloat) -> int | float | None:
    """A number that JSON has."""
    if isinstance(value, Integral):
        return int(value)
    number = float(value)
    return number if math.isfinite(number) else None


class _WholeFile:
    """A file to which content is added whole or, with an OSError, not at all."""

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)

    def append(self, content: bytes) -> None:
        size = os.fstat(self._file).st_size
        try:
            rest = memoryview(content)
            while rest:
                rest = rest[os.write(self._file, rest) :]
        except OSError:
            os.ftruncate(self._file, size)
            raise

    def close(self) -> None:
        os.close(self._file)


class _MetricsFile:
    """Rows that could not be written are kept and come first the next time."""

    def __init__(self, path: Path, start_env_steps: int) -> None:
        self.seconds = _trim(path, start_env_steps)  # of training up to the last row
        self._pending = b""
        self._file = _WholeFile(path)

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
    """Removes rows beyond `start_env_steps` and what is no row; the last row's ``time`` is returned.

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
        durable.replace(path, b"".join(kept))
    return seconds


class _EventFile:
    """TensorBoard's file of one start, opened by the first event; what cannot be written is left out.

    tensorboardX encodes. Its writer is not used: that has a thread, which a full disk ends, and a queue of
    ten events, which then blocks the caller for good.
    """

    def __init__(self, directory: Path, start_env_steps: int) -> None:
        self._path = directory / f"events.out.tfevents.{int(time.time())}.{socket.gethostname()}.{os.getpid()}"
        self._start = start_env_steps
        self._begun = False
        self._file: _WholeFile | None = None

    def scalars(self, record: Mapping[str, Any]) -> None:
        from tensorboardX import summary  # a fifth of a second; seconds where PyTorch is installed too

        values = [(name, value) for name, value in record.items() if name != "env_steps" and value is not None]
        self._append([{"step": record["env_steps"], "summary": summary.scalar(*value)} for value in values])

    def image(self, tag: str, array: np.ndarray, env_steps: int) -> None:
        from tensorboardX import summary

        layout = "HW" if array.ndim == 2 else "HWC"
        self._append([{"step": env_steps, "summary": summary.image(tag, array, dataformats=layout)}])

    def close(self) -> None:
        if self._file is not None:
            self._file.close()

    def _append(self, events: list[dict[str, Any]]) -> None:
        from tensorboardX.proto.event_pb2 import SessionLog

        if self._file is None:
            self._path.parent.mkdir(exist_ok=True)
            self._file = _WholeFile(self._path)
        if not self._begun:
            restart = SessionLog(status=SessionLog.START)  # hides what earlier starts logged from this step on
            events = [
                {"file_version": "brain.Event:2"},
                {"step": self._start + 1, "session_log": restart},
                *events,
            ]
        self._file.append(b"".join(map(_record, events)))
        self._begun = True


def _record(event: dict[str, Any]) -> bytes:
    """An event as TensorBoard's files have it: length, its checksum, content, its checksum."""
    from tensorboardX.proto.event_pb2 import Event
    from tensorboardX.record_writer import masked_crc32c

    content = Event(wall_time=time.time(), **event).SerializeToString()
    length = struct.pack("<Q", len(content))
    return b"".join(
        (length, struct.pack("<I", masked_crc32c(length)), content, struct.pack("<I", masked_crc32c(content)))
    )


class EpisodeTracker:
    """Scores and lengths of whole games, and their means over the last ones finished.

    A game's length is the number of steps since the one before ended; the step in which an environment
    resets itself after a game does not count.
    """

    def __init__(self, num_envs: int, *, window: int = 100) -> None:
        self.games = 0  # finished so far
        self.best_score = math.nan  # highest `mean_score` of a full window; NaN before the first
        self._recent: deque[tuple[float, int]] = deque(maxlen=window)
        self._scores = np.zeros(num_envs)
        self._lengths = np.zeros(num_envs, int)

    def add(self, outcome: Outcome) -> list[tuple[float, int]]:
        """Takes in one step of all environments; returns (score, length) of the games it ended."""
        self._scores += np.asarray(outcome.score)
        self._lengths += 1
        over = np.flatnonzero(np.asarray(outcome.is_over))
        finished = [(float(self._scores[i]), int(self._lengths[i])) for i in over]
        self._scores[over] = 0
        self._lengths[over] = -1  # the reset comes next
        self.games += len(finished)
        self._recent.extend(finished)
        if finished and len(self._recent) == self._recent.maxlen:
            self.best_score = float(np.fmax(self.best_score, self.mean_score))
        return finished

    @property
    def mean_score(self) -> float:
        """Of the last finished games; NaN before the first."""
        return float(np.mean([score for score, _ in self._recent])) if self._recent else math.nan

    @property
    def mean_length(self) -> float:
        """Of the last finished games, agent steps; NaN before the first."""
        return float(np.mean([length for _, length in self._recent])) if self._recent else math.nan

    def get_state(self) -> dict[str, Any]:
        """All of it, as JSON has it."""
        return {
            "games": self.games,
            "best_score": None if math.isnan(self.best_score) else self.best_score,
            "recent": [list(game) for game in self._recent],
            "scores": self._scores.tolist(),
            "lengths": self._lengths.tolist(),
        }

    def set_state(self, state: Mapping[str, Any], *, same_games: bool) -> None:
        """Takes over a saved state; the unfinished games only where the environments go on with them."""
        self.games = int(state["games"])
        best = state.get("best_score")
        self.best_score = math.nan if best is None else float(best)
        self._recent.clear()
        self._recent.extend((float(score), int(length)) for score, length in state["recent"])
        if same_games:
            self._scores[:] = state["scores"]
            self._lengths[:] = state["lengths"]
