"""`python -m foajax.report runs/<a> runs/<b> ... out=report`: a set of runs as one page that needs nothing else.

Learning curves, final scores, where the agents look, what they cost and how they differ. Runs of the same experiment
on the same game are seeds of one another. Each figure is written as a PNG as well. What `render`, `player
out=<run>/player` and `evaluate json=<run>/score.json` have left in a run's directory is taken up. A heat map that is
not there, or not of whole games that the newest checkpoint played with sampled actions, is made, unless `episodes=0`.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pydantic import Field

from foajax import cli
from foajax.config.parse import ConfigError, Section, refuse
from foajax.reporting.curves import read_run
from foajax.reporting.groups import games_of, runs_of
from foajax.reporting.report_page import build, find_maps, note
from foajax.runtime import wait_in_place


class Options(Section):
    """What the command takes besides the runs."""

    out: str = Field("report", description="Directory of the page.")
    preset: Literal["constant", "decreasing", "peripheral"] | None = Field(
        None, description="Only the experiments of a figure of the paper."
    )
    episodes: int = Field(3, ge=0, description="Games for a heat map that has to be made; 0 for none.")
    repeats: int = Field(50, ge=0, description="Repeats of each timing of a decision; 0 for no costs.")
    trust: bool = Field(False, description="Whether code that the run's configuration names may run.")


def report(arguments: Sequence[str]) -> None:
    """The command; prints the path of the page."""
    # A sweep's directories may have "=" in their names.
    paths = [word for word in arguments if "=" not in word or os.path.isdir(word)]
    options = cli.parse(Options, [word for word in arguments if word not in paths])
    if not paths:
        raise refuse("no runs", accepted="report runs/<a> runs/<b> ... out=report")
    wait_in_place()
    runs = [read_run(path, trust=options.trust) for path in dict.fromkeys(map(Path, paths))]
    games = games_of(runs, options.preset)
    shown = {run.path for run in runs_of(games)}
    if others := [f"{run.path} ({run.config.name})" for run in runs if run.path not in shown]:
        note(f"preset={options.preset} leaves out {', '.join(others)}")
    cli.make_directory(options.out)  # before games are played for what could not be written
    maps = find_maps(games, options.episodes)
    try:
        print(build(games, maps, out=options.out, preset=options.preset, repeats=options.repeats))
    except OSError as error:
        raise ConfigError(f"out={options.out}: cannot be written ({error.strerror})") from None


if __name__ == "__main__":
    sys.exit(cli.run(report))
