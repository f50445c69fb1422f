"""`python -m foajax.status runs/`: what every run below some directories is doing, drawn again every few seconds.

It reads what the runs write and holds nothing, so it may run anywhere that sees their files. The states:

    starting   held by a process, nothing logged yet
    running    held by a process, and a row of metrics is not old
    stalled    held by a process that has logged nothing for long
    finished   a checkpoint at or beyond `train.env_steps`
    failed     the last start ended with an error, which is shown
    stopped    everything else: interrupted or killed; the same command goes on from the newest checkpoint
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import functools
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from foajax import cli
from foajax.config.schema import Config, ConfigError
from foajax.runs import directory as rundir

State = Literal["starting", "running", "stalled", "finished", "failed", "stopped"]

_TAIL = 2**16  # bytes of metrics.jsonl read: some hundred rows
_SPEED_ROWS = 10  # rows that the shown speed is averaged over
_STALLED_AFTER = 120.0  # seconds without a row, or ten times `train.log_every` where that is more
_COLOURS = {"running": "green", "finished": "blue", "failed": "red", "stalled": "yellow"}


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
        """Until the end at the speed of late; None where nothing moves."""
        if self.state != "running" or not self.speed:
            return None
        return max(self.total - self.env_steps, 0) / self.speed


def newest_checkpoint(path: Path) -> int:
    """`env_steps` of the newest checkpoint of the run in `path`; 0 where there is none."""
    with contextlib.suppress(OSError):
        return max((int(name) for name in os.listdir(path / "checkpoints") if name.isdecimal()), default=0)
    return 0


def is_finished(config: Config) -> bool:
    """Whether `config`'s run has been trained to its end already, and means the same as what is asked for."""
    path = Path(config.run_dir)
    if newest_checkpoint(path) < config.train.env_steps:
        return False
    try:
        rundir.check_same_run(path, config)
    except ConfigError:
        return False  # starting it tells what differs
    return True


def find_runs(directories: Sequence[str | os.PathLike[str]]) -> list[Path]:
    """The runs in and below `directories`, each once, sorted; `ConfigError` where one is no directory."""
    found: set[Path] = set()
    for directory in directories:
        if not os.path.isdir(directory):
            raise ConfigError(f"{directory}: accepted is a directory with runs")
        for parent, below, _ in os.walk(directory):
            if rundir.is_run(Path(parent)):
                found.add(Path(parent))
                below.clear()
    return sorted(found)


def inspect(path: Path) -> RunStatus:
    """The run in `path`, as its files tell it."""
    try:
        stored = _stored(path, os.stat(path / "config.yaml").st_mtime_ns)
    except (ConfigError, OSError) as error:
        return RunStatus(str(path), "failed", 0, 0, None, None, rundir.describe_error(error))
    total, log_every = stored.train.env_steps, stored.train.log_every
    rows, saved = _last_rows(path / "metrics.jsonl"), newest_checkpoint(path)
    env_steps = max(int(rows[-1]["env_steps"]) if rows else 0, saved)
    state, reason = _state(path, bool(rows), saved >= total, max(_STALLED_AFTER, 10 * log_every))
    score = rows[-1].get("score") if rows else None
    return RunStatus(str(path), state, env_steps, total, _speed(rows), score, reason)


def _state(path: Path, has_rows: bool, finished: bool, patience: float) -> tuple[State, str]:
    if rundir.is_held(path):
        newest = max(_changed(path / name) for name in ("metrics.jsonl", "run.json"))
        if time.time() - newest > patience:
            return "stalled", ""
        # Rows from before this start say nothing about it.
        fresh = has_rows and _changed(path / "metrics.jsonl") >= _changed(path / "run.json")
        return ("running" if fresh else "starting"), ""
    reason = rundir.failure(path)
    if reason is not None:
        return "failed", reason
    return ("finished" if finished else "stopped"), ""


@functools.lru_cache(maxsize=10_000)
def _stored(path: Path, changed: int) -> Config:
    """A run's configuration, read again when the file's time changes."""
    return rundir.load_config(path)


def _changed(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


def _last_rows(path: Path) -> list[dict[str, Any]]:
    """The newest rows of metrics, oldest first; a torn one is left out."""
    try:
        with path.open("rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - _TAIL))
            lines = file.read().splitlines()
    except OSError:
        return []
    return [row for line in lines if (row := rundir.parse_row(line))]


def _speed(rows: list[dict[str, Any]]) -> float | None:
    first, last = (rows[-_SPEED_ROWS - 1 :][0], rows[-1]) if len(rows) > 1 else (None, None)
    if first is None or last is None or last["time"] <= first["time"]:
        return None
    return (last["env_steps"] - first["env_steps"]) / (last["time"] - first["time"])


def table(runs: Sequence[RunStatus]) -> Table:
    """All runs, a row each, and how many are in which state."""
    counts = [f"{sum(r.state == state for r in runs)} {state}" for state in dict.fromkeys(r.state for r in runs)]
    drawn = Table(title=f"{len(runs)} runs: {', '.join(counts)}" if runs else "no runs yet")
    drawn.add_column("run", overflow="fold")
    drawn.add_column("state", overflow="fold")
    for column in ("env_steps", "of", "steps/s", "return", "left"):
        drawn.add_column(column, justify="right")
    for run in runs:
        left = run.seconds_left
        drawn.add_row(
            Text(run.run),
            Text(f"{run.state}: {run.reason}" if run.reason else run.state, style=_COLOURS.get(run.state, "")),
            f"{run.env_steps:,}",
            f"{100 * run.env_steps / run.total:.0f} %" if run.total else "-",
            "-" if run.speed is None or run.state not in ("running", "finished") else f"{run.speed:,.0f}",
            "-" if run.score is None else f"{run.score:,.2f}",
            "-" if left is None else str(datetime.timedelta(seconds=round(left))),
        )
    return drawn


@dataclasses.dataclass(frozen=True)
class Options:
    """What the command takes after its directories."""

    every: float = 2.0  # seconds between two pictures
    once: bool = False  # print one picture and end, as where the output is no terminal

    def __post_init__(self) -> None:
        if not 0 < self.every <= 86_400:
            raise ConfigError(f"every={self.every}: accepted is seconds > 0, at most 86400")


def status(arguments: Sequence[str]) -> None:
    """The command."""
    directories = [word for word in arguments if "=" not in word or os.path.isdir(word)] or ["runs"]
    options = cli.parse(Options, [word for word in arguments if word not in directories])
    console = Console(highlight=False)

    def picture() -> Table:
        return table([inspect(path) for path in find_runs(directories)])

    if options.once or not console.is_terminal:
        console.print(picture())
        return
    with contextlib.suppress(KeyboardInterrupt), Live(picture(), console=console, auto_refresh=False) as live:
        while True:
            time.sleep(options.every)
            live.update(picture(), refresh=True)


if __name__ == "__main__":
    sys.exit(cli.run(status))
