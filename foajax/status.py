"""Shows what every run below some directories is doing, as a live table: `foajax status runs/`.

It only reads the runs' files, so it works on any machine that sees them. The states:

    starting   held by a process, nothing logged yet
    running    held by a process, and a row of metrics is not old
    stalled    held by a process that has logged nothing for long
    finished   a checkpoint at or beyond `train.env_steps`
    failed     the last start ended with an error, which is shown
    stopped    interrupted or killed; the same command goes on from the newest checkpoint
"""

from __future__ import annotations

import contextlib
import datetime
import sys
import time
from collections.abc import Sequence

from pydantic import Field
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from foajax import cli
from foajax.config.parse import Section
from foajax.runs.status import RunStatus, find_runs, inspect

_COLOURS = {"running": "green", "finished": "blue", "failed": "red", "stalled": "yellow"}


def table(runs: Sequence[RunStatus]) -> Table:
    """Lists all runs, a row each, and counts them by state."""
    counts = [f"{sum(r.state == state for r in runs)} {state}" for state in dict.fromkeys(r.state for r in runs)]
    drawn = Table(title=f"{len(runs)} run{'s' * (len(runs) != 1)}: {', '.join(counts)}" if runs else "no runs yet")
    drawn.add_column("run", overflow="fold")
    drawn.add_column("state", overflow="fold")
    for column in ("env_steps", "of", "steps/s", "score", "left"):
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


class Options(Section):
    every: float = Field(2.0, gt=0, le=86_400, description="Seconds between two updates of the table.")
    once: bool = Field(False, description="Print the table once and end, as always where the output is no terminal.")


def status(arguments: Sequence[str]) -> None:
    """Prints the table of runs; on a terminal keeps it live until Ctrl-C."""
    directories, others = cli.split(arguments)
    options, directories = cli.parse(Options, others), directories or ["runs"]
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
