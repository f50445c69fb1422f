"""Writes a set of runs as one page: `foajax report runs/<a> runs/<b> ... out=report`.

The page needs no other file. It shows learning curves, final scores, where the agents look, what they cost and how they
differ. Runs of the same experiment on the same game count as seeds. Each figure is written as a PNG too.

The report uses what `render`, `player out=<run>/player` and `evaluate json=<run>/score.json` left in a run's directory.
If no run of an experiment has a heat map, the first one plays for it, unless `episodes=0`. A heat map counts only if
the newest checkpoint played it, in whole games with sampled actions.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pydantic import Field

from foajax import cli
from foajax.config.parse import Section, refuse
from foajax.reporting.curves import read_run
from foajax.reporting.groups import games_of, runs_of
from foajax.reporting.report_page import build, find_maps, note
from foajax.runtime import wait_in_place


class Options(Section):
    out: str = Field("report", description="Directory of the page.")
    preset: Literal["constant", "decreasing", "peripheral"] | None = Field(
        None, description="Show only the experiments of one of the paper's figures."
    )
    episodes: int = Field(3, ge=0, description="Games for a heat map that has to be made; 0 for none.")
    repeats: int = Field(50, ge=0, description="Repeats of each timing of a decision; 0 for no costs.")
    trust: bool = Field(False, description="Let code run that the run's configuration names.")


def report(arguments: Sequence[str]) -> None:
    """Writes the page and prints its path."""
    paths, others = cli.split(arguments)
    options = cli.parse(Options, others)
    if not paths:
        raise refuse("no runs", accepted="foajax report runs/<a> runs/<b> ... out=report")
    wait_in_place()
    runs = [read_run(path, trust=options.trust) for path in dict.fromkeys(map(Path, paths))]
    games = games_of(runs, options.preset)
    shown = {run.path for run in runs_of(games)}
    if hidden := [f"{run.path} ({run.config.name})" for run in runs if run.path not in shown]:
        note(f"preset={options.preset} leaves out {', '.join(hidden)}")
    cli.make_directory(options.out)  # before games are played in vain
    maps = find_maps(games, options.episodes)
    try:
        print(build(games, maps, out=options.out, preset=options.preset, repeats=options.repeats))
    except OSError as error:
        raise refuse("out", options.out, "", why=f"cannot be written ({error.strerror})") from None


if __name__ == "__main__":
    sys.exit(cli.run(report))
