"""Shows a run on the terminal: all metrics drawn in place or, where it is no terminal, a short line per row."""

from __future__ import annotations

import contextlib
import datetime
import sys
from collections import deque
from collections.abc import Mapping

from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from foajax.runs.rows import SPEED_ROWS, speed_of

Record = Mapping[str, int | float | None]

_IN_A_LINE = {"score": "score", "best_score": "best"}  # the rest is in metrics.jsonl
_COLUMNS = 3  # of values, side by side


class Display:
    """Shows progress and the newest row. Output that fails is dropped: there is nowhere left to say so.

    Args:
      total_env_steps: where the run ends.
      start: ``env_steps`` and seconds at which this process takes the run up.
      live: whether to draw in place; None does so where stdout is a terminal.
    """

    def __init__(self, *, total_env_steps: int, start: tuple[int, float], live: bool | None) -> None:
        self._total = total_env_steps
        self._past = deque([{"env_steps": start[0], "time": start[1]}], maxlen=SPEED_ROWS + 1)
        console = Console(force_terminal=live, highlight=False)
        wanted = sys.stdout.isatty() and not console.is_dumb_terminal if live is None else live
        self._live = Live(console=console, auto_refresh=False) if wanted else None

    def show(self, record: Record) -> None:
        """Shows a row: ``env_steps``, ``time`` in seconds, and any further values."""
        progress = self._progress(record)
        if self._live is None:
            scores = [f"{word} {_number(record[name])}" for name, word in _IN_A_LINE.items() if name in record]
            self.message(", ".join([progress, *scores]))
            return
        values = {name: _number(value) for name, value in record.items() if name not in ("env_steps", "time")}
        done = min(int(record["env_steps"] or 0), self._total)
        bar = Table.grid(expand=True)  # a bar alone does not end its line
        bar.add_row(ProgressBar(total=self._total, completed=done))
        with contextlib.suppress(OSError):
            self._live.start()
            self._live.update(Group(Text(progress), bar, _grid(values)), refresh=True)

    def message(self, text: str) -> None:
        """Prints a line that stays; may be called from any thread."""
        with contextlib.suppress(OSError):
            if self._live is None:
                print(text, flush=True)
            else:
                self._live.console.print(Text(text))

    def close(self) -> None:
        """Leaves the last picture on the terminal."""
        if self._live is not None:
            with contextlib.suppress(OSError):
                self._live.stop()

    def _progress(self, record: Record) -> str:
        env_steps, seconds = int(record["env_steps"] or 0), float(record["time"] or 0)
        self._past.append({"env_steps": env_steps, "time": seconds})
        speed = speed_of(list(self._past)) or 0.0
        share = 100 * env_steps / self._total
        words = [f"env_steps {env_steps:,} of {self._total:,} ({share:.1f}%)", f"{speed:,.0f} steps/s"]
        if speed > 0:
            left = datetime.timedelta(seconds=round(max(self._total - env_steps, 0) / speed))
            words.append(f"{left} left")
        return ", ".join(words)


def _number(value: int | float | None) -> str:
    if value is None:
        return "-"
    return f"{value:,}" if isinstance(value, int) else f"{value:.4g}"


def _grid(values: Mapping[str, str]) -> Table:
    """Lays names and numbers out in a few columns, row by row."""
    grid = Table.grid(padding=(0, 2))
    cells = [[Text(name, style="dim"), Text(value, justify="right")] for name, value in values.items()]
    for i in range(0, len(cells), _COLUMNS):
        grid.add_row(*(text for cell in cells[i : i + _COLUMNS] for text in cell))
    return grid
