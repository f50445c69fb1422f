"""Keeps in `results/runs/` what others need to judge and repeat a run; makes the table of kept runs."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from foajax.config import shipped
from foajax.config.parse import refuse, replace, to_mapping
from foajax.config.schema import Config
from foajax.reporting.curves import RunData, read_run
from foajax.reporting.markdown import table
from foajax.runs.directory import FREE, compared, differing, load_config
from foajax.runs.rows import parse_row
from foajax.runs.status import newest_checkpoint
from foajax.sensors.registry import make_sensor
from foajax.viewing import heatmap

KEPT = shipped.kept_runs()
_ROWS = 500
_MACHINE = ("cpu", "cores", "devices", "system", "python", "packages")


def keep(path: Path, name: str | None) -> Path:
    """Copies what others need of a run; returns where to.

    Raises:
      ConfigError: the run is not finished, or its evaluation or heat map is missing; `name` is that of another run.
    """
    run = read_run(path)
    newest = newest_checkpoint(path) or int(run.env_steps[-1])  # a killed run's rows may go on beyond it
    if newest < run.config.train.env_steps:
        why = f"has {newest:,} of its {run.config.train.env_steps:,} env_steps"
        raise refuse("run", path, "a finished run, or one that is given fewer train.env_steps", why=why)
    wanted, watched = wanted_score(run.config, newest), wanted_games(run.config)
    found = {key: (run.evaluation or {}).get(key) for key in wanted}
    if found != wanted:
        command = f"foajax evaluate run={path} episodes={wanted['episodes']} json={path}/score.json"
        why = f"its score.json has {found}, not {wanted}" if run.evaluation else "has no score.json"
        raise refuse("run", path, f"what {command} writes", why=why)
    heat = heatmap.of_run(path, newest, games=watched)
    if heat is None and watched:
        command = f"foajax render run={path} episodes={watched} video=false"
        why = f"has no heat map of {watched} games of its final policy in render/"
        raise refuse("run", path, f"what {command} writes", why=why)
    config = replace(run.config, run=None)
    game = Path(config.run_dir).name.removesuffix(f"-{config.name}-s{config.seed}")
    out = KEPT / game / (name or f"{config.name}-s{config.seed}")
    may_differ = FREE - {"name", "train.env_steps"}
    if out.exists() and not may_differ.issuperset(differing(compared(load_config(out)), compared(config))):
        raise refuse("name", out.name, "another name=<name>-s<seed>", why="holds another run")
    out.mkdir(parents=True, exist_ok=True)
    (out / "config.yaml").write_text(yaml.safe_dump(to_mapping(config), sort_keys=False))
    lines = (path / "metrics.jsonl").read_bytes().splitlines()
    rows = [row for line in lines if (row := parse_row(line)) and row["env_steps"] <= newest]
    chosen = np.unique(np.linspace(0, len(rows) - 1, _ROWS).round().astype(int))
    (out / "metrics.jsonl").write_text("".join(json.dumps(_rounded(rows[i])) + "\n" for i in chosen))
    if heat is not None:
        (out / "render").mkdir(exist_ok=True)
        (out / "render" / heatmap.FILE).write_text(json.dumps(heat.to_json()) + "\n")
    (out / "score.json").write_text(json.dumps({**(run.evaluation or {}), "run": out.name}, indent=1) + "\n")
    (out / "run.json").write_text(json.dumps(_facts(run, newest), indent=1) + "\n")
    return out


def wanted_score(config: Config, env_steps: int) -> dict[str, Any]:
    """Returns what `score.json` of a run to be kept has to say about its games."""
    episodes = 2000 if config.searches else 100  # scenes are short
    return {"env_steps": env_steps, "policy": "sampled", "episodes": episodes, "protocol": []}


def wanted_games(config: Config) -> int:
    """Returns the number of games that the heat map of a run to be kept counts; 0 where none is needed."""
    # Where targets may be anywhere, a heat map says little.
    return 10 if config.gaze.mode == "learned" and not config.searches else 0


def _rounded(row: dict[str, Any]) -> dict[str, Any]:
    return {key: float(f"{value:.5g}") if isinstance(value, float) else value for key, value in row.items()}


def _facts(run: RunData, newest: int) -> dict[str, Any]:
    starts = json.loads((run.path / "run.json").read_text())["starts"]
    # The last start's words, as it may have changed keys such as train.env_steps.
    words = [word for word in starts[-1]["command"] if "=" in word and not word.startswith("run=")]
    return {
        "command": f"python -m foajax.train {shlex.join(words)}",
        "starts": [{"time": start["time"], "commit": start["commit"]} for start in starts],
        "seed": run.config.seed,
        "env_steps": newest,
        "hours": round(float(run.time[run.env_steps <= newest][-1]) / 3600, 2),
        **{key: starts[-1][key] for key in _MACHINE if key in starts[-1]},  # older runs do not name their devices
    }


def runs(directory: Path = KEPT) -> list[RunData]:
    return [read_run(path) for path in sorted(directory.glob("*/*")) if path.is_dir()]


def record(run: RunData) -> dict[str, Any]:
    """Reads command, commits, seed, machine and hours of a kept run."""
    return json.loads((run.path / "run.json").read_text())


def row(run: RunData) -> list[str]:
    """Makes a run's row of the table."""
    facts, score = record(run), run.evaluation or {}
    values = make_sensor(run.config.sensor).count(run.config.env.frame_shape).nominal
    return [
        run.config.game,
        f"`{run.config.name}`",
        str(run.config.seed),
        str(values),
        run.config.gaze.mode,
        f"{facts['env_steps'] / 1e6:.1f} M",
        f"{facts['hours']:.1f}",
        written(score),
        f"[{run.path.parent.name}/{run.path.name}]({run.path.parent.name}/{run.path.name})",
    ]


def written(score: Mapping[str, Any]) -> str:
    """Writes a score's mean and standard error."""
    if score["stderr"] is None:  # of a single game
        return str(score["mean"])
    digits = 1 if score["stderr"] >= 0.05 else 3  # a scene of search earns 1 at most
    return f"{score['mean']:.{digits}f} ± {score['stderr']:.{digits}f}"


def write_table(runs: Sequence[RunData], directory: Path = KEPT) -> None:
    """Writes the table of kept runs."""
    head = ["game", "experiment", "seed", "values", "gaze", "env_steps", "hours", "score", "kept in"]
    intro = (
        "Score: mean and standard error over 100 whole games, unclipped, or over 2,000 scenes of search; sampled\n"
        "policy of the last checkpoint. Each `run.json` has the command, the commit and the machine.\n"
        "[What they say](../../docs/results.md). Made by `python -m foajax.keep`."
    )
    (directory / "README.md").write_text(f"# Kept runs\n{intro}\n\n{table(head, map(row, runs))}\n")
