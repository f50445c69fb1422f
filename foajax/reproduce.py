"""Runs the paper's comparison and evaluates each run in 100 games: `foajax reproduce stage=1 jobs=2`.

Each learned gaze plays ten more games for its heat map. `experiments/plans/paper.yaml` lists the stages. `plan=search`
takes those of visual search, with 2,000 scenes for each run and no heat map. A finished run is skipped and a stopped
one goes on, so repeat the command until nothing is left. `show=table` says how far each run is. `show=commands` prints
a command for each run that is left, for a cluster's job array. `foajax keep run=<dir>` keeps a run and updates
docs/results.md.
"""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import Field
from rich.console import Console
from rich.table import Table

from foajax import cli
from foajax.config import shipped
from foajax.config.parse import Section, refuse
from foajax.launch import sweep
from foajax.reporting import kept
from foajax.runs.directory import is_run
from foajax.runs.status import RunStatus, inspect, is_finished, newest_checkpoint
from foajax.viewing import heatmap


class Options(Section):
    plan: Literal["paper", "search"] = Field("paper", description="Which comparison, of experiments/plans/.")
    stage: int | None = Field(None, description="Which stage to run; null for all, one after another.")
    jobs: int = Field(1, ge=1, description="Runs at a time, each with its share of the cores.")
    show: Literal["table", "commands"] | None = Field(
        None, description="Print how far each run is, or a command for each that is left, and run nothing."
    )

    def check(self) -> None:
        most = len(stages(self.plan))
        if self.stage is not None and not 1 <= self.stage <= most:
            raise refuse("stage", self.stage, f"null or an integer from 1 to {most}")


def stages(plan: str) -> list[dict[str, Any]]:
    """Reads the stages of a plan of `experiments/plans/`: what each is `about`, and the words of its sweeps."""
    return yaml.safe_load((shipped.experiments() / "plans" / f"{plan}.yaml").read_text())["stages"]


def reproduce(arguments: Sequence[str]) -> int:
    """Runs the command; returns 1 if a run failed, else 0."""
    options = cli.parse(Options, arguments)
    chosen = [stage for i, stage in enumerate(stages(options.plan), 1) if options.stage in (None, i)]
    planned = [
        (stage["about"], [run for line in stage["runs"] for run in sweep.expand(line.split())]) for stage in chosen
    ]
    if options.show == "table":
        return _show(planned)
    failed, stop = 0, sweep.Stop()
    for about, runs in planned:
        if options.show == "commands":
            for run in runs:
                if not is_finished(run.config):
                    print(f"python -m foajax.train {shlex.join(run.words)}")
            continue
        print(f"{about}: {len(runs)} runs", file=sys.stderr, flush=True)
        failed |= sweep.run_all(runs, jobs=options.jobs, stop=stop)
        if stop.requested:
            break
        failed |= _play(runs, options.jobs)
    return failed


def _play(runs: Sequence[sweep.PlannedRun], jobs: int) -> int:
    """Plays finished runs for their scores, and learned gazes for heat maps too; returns 1 if that failed, else 0."""
    commands = []
    for config in (run.config for run in runs if is_finished(run.config)):
        where = Path(config.run_dir)
        newest = newest_checkpoint(where)
        wanted, watched = kept.wanted_score(config, newest), kept.wanted_games(config)
        if not wanted.items() <= (_score(where) or {}).items():
            episodes, file = wanted["episodes"], where / "score.json"
            commands.append(["foajax.evaluate", f"run={where}", f"episodes={episodes}", f"json={file}"])
        if watched and heatmap.of_run(where, newest, games=watched) is None:
            commands.append(["foajax.render", f"run={where}", f"episodes={watched}", "video=false"])
    with ThreadPoolExecutor(jobs) as pool:
        codes = pool.map(lambda command: subprocess.call([sys.executable, "-m", *command]), commands)
        return max([int(code != 0) for code in codes], default=0)


def _score(run: Path) -> dict[str, Any] | None:
    """Reads what `evaluate` wrote; None where there is nothing, or only the beginning of it."""
    try:
        return json.loads((run / "score.json").read_text())
    except (OSError, ValueError):
        return None


def _show(planned: Sequence[tuple[str, Sequence[sweep.PlannedRun]]]) -> int:
    table = Table("stage", "run", "state", "env_steps", "score")
    for about, runs in planned:
        for run in runs:
            path = Path(run.config.run_dir)
            known = inspect(path) if is_run(path) else None
            score = _score(path)
            table.add_row(
                about if run is runs[0] else "",
                run.config.run_dir,
                _state(run, known) if known else "not begun",
                f"{known.env_steps:,}" if known else "",
                kept.written(score) if known and score and score["env_steps"] == known.env_steps else "",
            )
        table.add_section()
    Console(width=140).print(table)
    return 0


def _state(run: sweep.PlannedRun, known: RunStatus) -> str:
    if known.state != "finished" or is_finished(run.config):
        return known.state
    return "too short" if known.env_steps < run.config.train.env_steps else "another run"


if __name__ == "__main__":
    sys.exit(cli.run(reproduce))
