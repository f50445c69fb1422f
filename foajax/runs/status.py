"""Finds runs, and tells from its files what a run is doing."""

from __future__ import annotations

import contextlib
import functools
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from foajax.config.parse import ConfigError, refuse
from foajax.config.schema import Config
from foajax.runs.directory import check_same_run, describe_error, failure, is_run, load_config
from foajax.runs.lock import is_held
from foajax.runs.rows import last_rows, speed_of

State = Literal["starting", "running", "stalled", "finished", "failed", "stopped"]
_STALLED_AFTER = 120.0  # seconds without a row, or ten times `train.log_every` where that is more


class RunStatus(NamedTuple):
    """What one run is doing."""

    run: str  # its directory
    state: State
    env_steps: int  # logged, or saved where that is further
    total: int  # where the run ends
    speed: float | None  # env_steps a second, lately
    score: float | None  # mean return of the last games, unclipped
    reason: str = ""  # of a failure

    @property
    def seconds_left(self) -> float | None:
        """Seconds until the end at the speed of late; None unless it is running."""
        if self.state != "running" or not self.speed:
            return None
        return max(self.total - self.env_steps, 0) / self.speed


def newest_checkpoint(path: Path) -> int:
    """Returns `env_steps` of the newest checkpoint of the run in `path`; 0 where there is none."""
    with contextlib.suppress(OSError):
        return max((int(name) for name in os.listdir(path / "checkpoints") if name.isdecimal()), default=0)
    return 0


def is_finished(config: Config) -> bool:
    """Whether the run of `config` has been trained to its end, by a configuration that learns the same."""
    path = Path(config.run_dir)
    if newest_checkpoint(path) < config.train.env_steps:
        return False
    try:
        check_same_run(path, config)
    except ConfigError:
        return False  # starting it tells what differs
    return True


def find_runs(directories: Sequence[str | os.PathLike[str]]) -> list[Path]:
    """Finds the runs in and below `directories`, each once, sorted; `ConfigError` where one is no directory."""
    found: set[Path] = set()
    for directory in directories:
        if not os.path.isdir(directory):
            raise refuse(str(directory), accepted="a directory with runs", why="is no directory")
        for parent, below, _ in os.walk(directory):
            if is_run(Path(parent)):
                found.add(Path(parent))
                below.clear()
    return sorted(found)


def inspect(path: Path) -> RunStatus:
    """Reads the status of the run in `path` from its files."""
    try:
        stored = _stored(path, os.stat(path / "config.yaml").st_mtime_ns)
    except (ConfigError, OSError) as error:
        return RunStatus(str(path), "failed", 0, 0, None, None, describe_error(error))
    total, log_every = stored.train.env_steps, stored.train.log_every
    rows, saved = last_rows(path / "metrics.jsonl"), newest_checkpoint(path)
    env_steps = max(int(rows[-1]["env_steps"]) if rows else 0, saved)
    state, reason = _state(path, bool(rows), saved >= total, max(_STALLED_AFTER, 10 * log_every))
    score = rows[-1].get("score") if rows else None
    return RunStatus(str(path), state, env_steps, total, speed_of(rows), score, reason)


def _state(path: Path, has_rows: bool, finished: bool, patience: float) -> tuple[State, str]:
    if is_held(path):
        newest = max(_changed(path / name) for name in ("metrics.jsonl", "run.json"))
        if time.time() - newest > patience:
            return "stalled", ""
        # Rows from before this start say nothing about it.
        fresh = has_rows and _changed(path / "metrics.jsonl") >= _changed(path / "run.json")
        return ("running" if fresh else "starting"), ""
    reason = failure(path)
    if reason is not None:
        return "failed", reason
    return ("finished" if finished else "stopped"), ""


@functools.lru_cache(maxsize=10_000)
def _stored(path: Path, changed: int) -> Config:
    """Reads a run's configuration, once for each time at which the file was changed."""
    return load_config(path)


def _changed(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0
