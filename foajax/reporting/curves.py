"""Draws learning curves and final scores of runs."""

from __future__ import annotations

import io
import itertools
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.figure import Figure
from PIL import Image
from scipy.optimize import isotonic_regression

from foajax.config.parse import refuse
from foajax.config.schema import Config
from foajax.reporting.scores import CONFIDENCE, QUANTILES, Interval, resampled
from foajax.runs.agents import check_trust
from foajax.runs.directory import load_config
from foajax.runs.rows import parse_row
from foajax.viewing.style import STYLE

SENSORS = {  # colours, the same in every figure; a sensor with and without a periphery has one hue
    "nonfoa": "#444444",
    "constant50_sub1": "#009e73",
    "constant50_sub2": "#cc79a7",
    "constant70": "#56b4e9",
    "decreasing": "#e69f00",
    "constant70_p": "#0072b2",
    "decreasing_p": "#d55e00",
    "logpolar": "#8c6d31",
}
PAPER_NAMES = {
    "nonfoa": "Non-FoA, sub1",
    "constant50_sub1": "Constant 50x50, sub1",
    "constant50_sub2": "Constant 50x50, sub2",
    "constant70": "Constant 70x70, sub2",
    "decreasing": "Decreasing 30-50-70",
    "constant70_p": "Constant(P) 70x70, sub2",
    "decreasing_p": "Decreasing(P) 30-50-70",
}
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#444444", "#8c6d31")
_LINES = ("-", "--", ":", "-.", (0, (6, 1, 1, 1, 1, 1)), (0, (8, 3)))  # tell lines of one colour apart
_POINTS = 300  # of a curve
AXES = {"env_steps": (1e6, "million agent steps"), "time": (3600.0, "hours of training")}
_LABEL_GAP = 0.085  # between labels at the lines' ends, of the axis's height


class RunData(NamedTuple):
    """What a run's directory says about the run."""

    path: Path
    config: Config
    env_steps: Float[np.ndarray, "n"]
    time: Float[np.ndarray, "n"]  # seconds of training
    score: Float[np.ndarray, "n"]  # mean of the last 100 whole games, unclipped
    evaluation: dict[str, Any] | None  # `score.json`, where `evaluate` has written it there

    @property
    def final_score(self) -> float:
        """The evaluated score or, without an evaluation, that of the last games of training."""
        return float(self.evaluation["mean"] if self.evaluation else self.score[-1])


class Band(NamedTuple):
    """The mean over seeds along an axis, and its interval."""

    x: Float[np.ndarray, "m"]
    mean: Float[np.ndarray, "m"]
    low: Float[np.ndarray, "m"]
    high: Float[np.ndarray, "m"]


def read_run(path: str | Path, *, trust: bool = False) -> RunData:
    """Reads a run's directory.

    Raises:
      ConfigError: it is no run's directory, no game has ended yet, or it names code and `trust` is false.
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
        raise refuse("run", path, "the directory of a run", why=f"its {file.name} is missing or damaged") from None
    if not rows:
        raise refuse("run", path, "a run with scores", why="no game has ended in it yet")
    env_steps, time, score = (np.array([row[key] for row in rows], float) for key in ("env_steps", "time", "score"))
    return RunData(path, config, env_steps, time, score, evaluation)


def on_common_axis(
    runs: Sequence[RunData], axis: str
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "n m"]] | None:
    """Interpolates the runs' scores at the same places of an axis, where all have scores; None if they share none."""
    xs = [getattr(run, axis) for run in runs]
    first, last = max(each[0] for each in xs), min(each[-1] for each in xs)
    if first >= last:
        return None
    x = np.linspace(first, last, _POINTS)
    return x, np.stack([np.interp(x, each, run.score) for each, run in zip(xs, runs, strict=True)])


def band(runs: Sequence[RunData], axis: str) -> Band | None:
    """Averages curves over seeds where all have scores, with a bootstrap interval; None if they share no place."""
    common = on_common_axis(runs, axis)
    if common is None:
        return None
    x, curves = common
    means = resampled(curves, np.random.default_rng(0)).mean(axis=1)
    low, high = np.quantile(means, QUANTILES, axis=0)
    return Band(x, curves.mean(axis=0), low, high)


def sensor_of(name: str) -> str:
    """Returns the sensor that an experiment is named after: `constant70_p` for `constant70_p_packed-frozen`."""
    papers = {paper: sensor for sensor, paper in PAPER_NAMES.items()}
    return papers.get(name.removesuffix(", packed")) or re.split(r"\W", name)[0].removesuffix("_packed")


def colours_of(names: Iterable[str]) -> dict[str, str]:
    """Chooses a colour per name: its sensor's or, if that has none, one that no other sensor here has."""
    colours = {name: SENSORS.get(sensor_of(name)) for name in names}
    free = itertools.cycle([colour for colour in _COLOURS if colour not in colours.values()] or _COLOURS)
    return {name: colour or next(free) for name, colour in colours.items()}


def draw_curves(
    groups: Mapping[str, Sequence[RunData]],
    title: str,
    colours: Mapping[str, str],
    axes: Mapping[str, tuple[float, str]] = AXES,
) -> Figure:
    """Draws scores against steps and against time: a line per group, named at its end, and a thin line per seed."""
    shared = list(colours.values())
    lines = {name: _LINES[shared[:i].count(colours[name]) % len(_LINES)] for i, name in enumerate(colours)}
    with rc_context(STYLE | {"font.size": 12, "axes.titlesize": 12}):
        figure = Figure(figsize=(6.8, 0.3 + 3.1 * len(axes)), layout="constrained")
        plots = figure.subplots(len(axes), 1, sharey=True, squeeze=False)[:, 0]
        for plot, (axis, (unit, label)) in zip(plots, axes.items(), strict=True):
            ends = {}
            for name, runs in groups.items():
                style = {"color": colours[name], "linestyle": lines[name]}
                ends[name] = _draw_group(plot, runs, axis, unit, style)
            plot.set_xlabel(label)
            plot.margins(x=0)
            plot.set_xlim(left=0)
            plot.grid(axis="y", color="#e6e6e6", linewidth=0.8)
            plot.set_axisbelow(True)
            _name_lines(plot, ends, colours)
            plot.set_ylabel("score of a game")
        plots[0].set_title(title, loc="left", fontweight="bold")
    return figure


def _draw_group(plot: Any, runs: Sequence[RunData], axis: str, unit: float, line: dict[str, Any]) -> float:
    """Draws a group; returns where its line ends."""
    mean = band(runs, axis) if len(runs) > 1 else None
    for run in runs:
        thin = {"linewidth": 0.6, "alpha": 0.45} if len(runs) > 1 else {"linewidth": 1.8}
        plot.plot(getattr(run, axis) / unit, run.score, **line, **thin)
    if mean is None:
        return float(np.mean([run.score[-1] for run in runs]))
    plot.fill_between(mean.x / unit, mean.low, mean.high, color=line["color"], alpha=0.16, linewidth=0)
    plot.plot(mean.x / unit, mean.mean, **line, linewidth=2)
    return float(mean.mean[-1])


def _name_lines(plot: Any, ends: Mapping[str, float], colours: Mapping[str, str]) -> None:
    """Writes each line's name to the right of the plot, as near to the height of its end as there is room."""
    low, high = plot.get_ylim()
    for name, height in zip(ends, spread(list(ends.values()), _LABEL_GAP * (high - low)), strict=True):
        place = {"xytext": (4, 0), "textcoords": "offset points", "va": "center", "annotation_clip": False}
        plot.annotate(name, (1, height), xycoords=plot.get_yaxis_transform(), color=colours[name], **place)


def spread(wanted: Sequence[float], gap: float) -> list[float]:
    """Moves places at least `gap` apart, as near to those `wanted` as possible and in the same order."""
    order, gaps = np.argsort(wanted, kind="stable"), gap * np.arange(len(wanted))
    placed = np.empty(len(order))
    placed[order] = isotonic_regression(np.asarray(wanted, float)[order] - gaps).x + gaps
    return placed.tolist()


def draw_scores(intervals: Mapping[str, Mapping[str, Interval]], colours: Mapping[str, str]) -> Figure:
    """Draws interquartile means and their intervals: a panel per game, a row per group.

    Args:
      intervals: by the panel's title and the group's name.
      colours: by the group's name.
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


def save(figure: Figure, file: Path) -> None:
    """Writes a figure as a PNG of 128 colours, which takes a third of the size."""
    content = io.BytesIO()
    figure.savefig(content, dpi=120)
    Image.open(content).convert("RGB").quantize(128, dither=Image.Dither.NONE).save(file, optimize=True)
