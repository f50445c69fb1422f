"""Learning curves and final scores of runs, as figures."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.figure import Figure

from foajax.config.parse import ConfigError, refuse
from foajax.config.schema import Config
from foajax.reporting.scores import CONFIDENCE, RESAMPLES, Interval
from foajax.runs.agents import check_trust
from foajax.runs.directory import load_config
from foajax.runs.rows import parse_row
from foajax.viewing.style import STYLE

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#444444", "#8c6d31")
_LINES = ("-", "--", ":")  # once all colours are used
_POINTS = 300  # of a curve
AXES = {"env_steps": (1e6, "million agent steps"), "time": (3600.0, "hours of training")}


class RunData(NamedTuple):
    """What a run's directory says about it."""

    path: Path
    config: Config
    env_steps: Float[np.ndarray, "n"]
    time: Float[np.ndarray, "n"]  # seconds of training
    score: Float[np.ndarray, "n"]  # mean of the last 100 whole games, unclipped
    evaluation: dict[str, Any] | None  # `score.json`, where `evaluate` has written it there

    @property
    def final_score(self) -> float:
        """Evaluated where it was, else of the last games of training."""
        return float(self.evaluation["mean"] if self.evaluation else self.score[-1])


class Band(NamedTuple):
    """A mean over seeds along an axis, with its interval."""

    x: Float[np.ndarray, "m"]
    mean: Float[np.ndarray, "m"]
    low: Float[np.ndarray, "m"]
    high: Float[np.ndarray, "m"]


def read_run(path: str | Path, *, trust: bool = False) -> RunData:
    """Reads a run's directory.

    Raises:
      ConfigError: it is none, no game has ended in it yet, or it names code and `trust` is not given.
    """
    path = Path(path)
    config = load_config(path)
    check_trust(path, config, trust)
    file = path / "metrics.jsonl"
    try:
        rows = [row for line in file.read_bytes().splitlines() if (row := parse_row(line, "score"))]
        file = path / "score.json"
        evaluation = json.loads(file.read_text()) if file.exists() else None
        if evaluation is not None:
            float(evaluation["mean"])
    except (OSError, ValueError, KeyError, TypeError):
        raise ConfigError(f"run={path}: its {file.name} is not readable") from None
    if not rows:
        raise refuse("run", path, "a run with scores", why="no game has ended in it yet")
    env_steps, time, score = (np.array([row[key] for row in rows], float) for key in ("env_steps", "time", "score"))
    return RunData(path, config, env_steps, time, score, evaluation)


def band(runs: Sequence[RunData], axis: str) -> Band | None:
    """The mean curve over seeds where all have scores, with a bootstrap interval; None where that is nowhere."""
    xs = [getattr(run, axis) for run in runs]
    first, last = max(each[0] for each in xs), min(each[-1] for each in xs)
    if first >= last:
        return None
    x = np.linspace(first, last, _POINTS)
    curves = np.stack([np.interp(x, each, run.score) for each, run in zip(xs, runs, strict=True)])
    drawn = np.random.default_rng(0).integers(0, len(runs), (RESAMPLES, len(runs)))
    means = curves[drawn].mean(axis=1)
    low, high = np.quantile(means, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], axis=0)
    return Band(x, curves.mean(axis=0), low, high)


def colours_of(names: Iterable[str]) -> dict[str, str]:
    """A colour for each name, the same in all figures of a report."""
    return {name: COLOURS[i % len(COLOURS)] for i, name in enumerate(dict.fromkeys(names))}


def draw_curves(groups: Mapping[str, Sequence[RunData]], title: str, colours: Mapping[str, str]) -> Figure:
    """Score against steps and against time; a colour for each group of seeds, every seed thin."""
    with rc_context(STYLE):
        figure = Figure(figsize=(10.4, 4.1), layout="constrained")
        plots = figure.subplots(1, 2, sharey=True)
        lines = {name: _LINES[i // len(COLOURS) % len(_LINES)] for i, name in enumerate(colours)}
        for plot, (axis, (unit, label)) in zip(plots, AXES.items(), strict=True):
            for name, runs in groups.items():
                _draw_group(plot, runs, axis, unit, {"color": colours[name], "linestyle": lines[name]}, name)
            plot.set_xlabel(label)
            plot.set_xlim(left=0)
            plot.grid(axis="y", color="#e6e6e6", linewidth=0.8)
            plot.set_axisbelow(True)
        plots[0].set_ylabel("score of a game, mean of the last 100")
        plots[0].set_title(title, loc="left", fontweight="bold")
        handles, labels = plots[0].get_legend_handles_labels()
        columns = max(1, min(4, 140 // (max(map(len, labels)) + 6)))  # as many as the figure's width has room for
        figure.legend(handles, labels, loc="outside lower center", ncols=columns)
    return figure


def _draw_group(plot: Any, runs: Sequence[RunData], axis: str, unit: float, line: dict[str, str], name: str) -> None:
    if len(runs) > 1:
        for run in runs:
            plot.plot(getattr(run, axis) / unit, run.score, **line, linewidth=0.6, alpha=0.45)
        mean, label = band(runs, axis), f"{name} ({len(runs)} seeds)"
        if mean is None:
            plot.plot([], [], **line, linewidth=2, label=label)
        else:
            plot.fill_between(mean.x / unit, mean.low, mean.high, color=line["color"], alpha=0.16, linewidth=0)
            plot.plot(mean.x / unit, mean.mean, **line, linewidth=2, label=label)
    else:
        plot.plot(getattr(runs[0], axis) / unit, runs[0].score, **line, linewidth=1.8, label=name)


def draw_scores(intervals: Mapping[str, Mapping[str, Interval]], colours: Mapping[str, str]) -> Figure:
    """Interquartile means with their intervals: a panel for each game, a row for each group.

    Args:
      intervals: of each group, by the panel's title.
      colours: of the groups.
    """
    names = list(dict.fromkeys(name for panel in intervals.values() for name in panel))
    with rc_context(STYLE):
        width = min(3.2 * len(intervals) + 2.0, 12.0)
        figure = Figure(figsize=(width, 1.1 + 0.34 * len(names)), layout="constrained")
        plots = figure.subplots(1, len(intervals), sharey=True, squeeze=False)[0]
        for plot, (title, panel) in zip(plots, intervals.items(), strict=True):
            for row, name in enumerate(names):
                if name in panel:
                    score, colour = panel[name], colours[name]
                    plot.barh(row, score.high - score.low, left=score.low, height=0.6, color=colour, alpha=0.3)
                    plot.plot([score.value] * 2, [row - 0.3, row + 0.3], color=colour, linewidth=2.5)
            plot.set_title(title, loc="left", fontweight="bold")
            plot.grid(axis="x", color="#e6e6e6", linewidth=0.8)
            plot.set_axisbelow(True)
            plot.tick_params(axis="y", length=0)
        plots[0].set_yticks(range(len(names)), names)
        plots[0].invert_yaxis()
        for plot in plots:
            plot.spines["left"].set_visible(False)
        figure.supxlabel(f"interquartile mean of the runs' scores, {100 * CONFIDENCE:.0f} % interval", fontsize=10)
    return figure
