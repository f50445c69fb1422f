"""`python -m foajax.keep run=<dir>`: keeps of a run what others need to judge and repeat it, in `results/runs/<game>/`.

Into a directory of the run's own go its resolved configuration, `metrics.jsonl` thinned to 500 rows, what `evaluate
json=<run>/score.json` has found, and `run.json`: command, commits, seed, machine, hours. Then the tables and the
learning curves of all kept runs are made anew. Without `run=`, only that.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

from foajax import cli
from foajax.config.parse import ConfigError
from foajax.reporting import kept


@dataclasses.dataclass(frozen=True)
class Options:
    """What the command takes."""

    run: str | None = None  # a run's directory
    name: str | None = None  # of the directory that it is kept in; null for <experiment>-s<seed>


def keep(arguments: Sequence[str]) -> None:
    """The command; prints where a run is kept."""
    options = cli.parse(Options, arguments)
    if not kept.KEPT.is_dir():
        raise ConfigError(f"{kept.KEPT}: is missing; accepted is a checkout, which has kept runs")
    if options.run is not None:
        print(kept.keep(Path(options.run), options.name))
    kept.write_tables()


if __name__ == "__main__":
    sys.exit(cli.run(keep))
