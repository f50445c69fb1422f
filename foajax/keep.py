"""Copies what others need to judge and repeat a run into `results/runs/<game>/`: `foajax keep run=<dir>`.

It copies the resolved configuration, `metrics.jsonl` thinned to 500 rows, the result of
`evaluate json=<run>/score.json`, and the heat map in `<run>/render`. `run.json` states command, commits, seed, machine
and hours. Then it makes anew: the table of kept runs, docs/results.md with its figures, the README's block, and the
table of measurements in `results/bench/`. Without `run=` it does only that.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

from pydantic import Field

from foajax import cli
from foajax.config.parse import ConfigError, Section, refuse
from foajax.reporting import bench, kept, results, search
from foajax.reporting.curves import read_run


class Options(Section):
    run: str | None = Field(None, description="A run's directory; null to make the tables and figures anew only.")
    name: str | None = Field(None, description="Directory to keep it in; null for <experiment>-s<seed>.")

    def check(self) -> None:
        if self.name is not None and self.run is None:
            raise refuse("name", self.name, "null, or a name beside run=<dir>")


def keep(arguments: Sequence[str]) -> None:
    """Keeps a run, if one is named, and writes all tables and pages anew; prints where the run is kept."""
    options = cli.parse(Options, arguments)
    if not kept.KEPT.is_dir():
        raise refuse(str(kept.KEPT), accepted="a checkout of foajax, which has this directory", why="is missing")
    if options.run is not None:
        print(_add(Path(options.run), options.name))
    runs = kept.runs()
    kept.write_table(runs)
    results.write(runs)
    bench.write_table()


def _add(path: Path, name: str | None) -> Path:
    """Keeps a run; takes it away again and raises `ConfigError` if the pages refuse it beside those that are kept."""
    before = kept.runs()
    new = kept.keep(path, name)
    others = [run for run in before if run.path != new]
    together = [*others, read_run(new)]  # the new one last, so that an error names it
    try:
        results.by_game(together)
        search.grouped(together)
    except ConfigError:
        if len(others) == len(before):
            shutil.rmtree(new)
        raise
    return new


if __name__ == "__main__":
    sys.exit(cli.run(keep))
