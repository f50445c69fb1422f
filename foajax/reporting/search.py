"""Makes the figure and the tables of docs/search.md from kept runs of visual search."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from scipy import special

from foajax.config.parse import replace
from foajax.config.schema import Config, GazeConfig, RingSensor
from foajax.envs.search import optimal_return
from foajax.reporting import claims, cost
from foajax.reporting.curves import RunData, colours_of, save
from foajax.reporting.groups import check_seeds
from foajax.reporting.markdown import fill, table
from foajax.reporting.scores import CONFIDENCE, Interval
from foajax.sensors.registry import make_sensor
from foajax.viewing.style import STYLE

_BEST = "search_rings_p"
SHAPES = ((160, 160), (1080, 1920))  # of frames whose cost is compared; the first is that of all runs
SIZES = (1, 4, 8, 16)  # letters in the scenes of all runs that are compared
_SENSORS = {
    _BEST: "rings and periphery",
    "search_rings": "three nested rings",
    "search_logpolar": "log-polar retina",
    "search_window": "small window, full resolution",
    "search_wide": "wide window, 4x4 means",
    f"{_BEST}_1225": "rings and periphery",
    "search_window_1225": "small window, full resolution",
    "search_full": "whole frame, no gaze",
    f"{_BEST}-long": "rings and periphery, trained longer",
}
_GAZES = {
    _BEST: "learned",
    f"{_BEST}-no_map": "learned, without the priority map",
    f"{_BEST}-raster": "scripted: row by row",
    f"{_BEST}-random": "random",
    f"{_BEST}-frozen": "frozen",
}
_TARGETS = {
    _BEST: "letter: a T among Ls, in every scene",
    f"{_BEST}-letter": "the same, in half of the scenes",
    f"{_BEST}-conjunction": "conjunction: a bright T among bright Ls and dim Ts, in half",
    f"{_BEST}-feature": "feature: a bright T among dim Ls, in half",
}
_SMALL = list(_SENSORS)[:5]  # of about 600 values
_DETECTION = "detect_rings_p"

Groups = Mapping[str, Sequence[RunData]]


def over_seeds(values: Sequence[float]) -> Interval:
    """Averages over seeds, with Student's interval; for one run, the interval is the number itself."""
    mean = float(np.mean(values))
    if len(values) == 1:
        return Interval(mean, mean, mean)
    error = np.std(values, ddof=1) / np.sqrt(len(values))
    half = float(special.stdtrit(len(values) - 1, (1 + CONFIDENCE) / 2) * error)
    return Interval(mean, mean - half, mean + half)


def measure(runs: Sequence[RunData], name: str) -> Interval:
    """Averages a measure of the evaluations (`foajax.envs.measures.summarise`) over the runs that have it."""
    values = [_measures(run)[name] for run in runs if name in _measures(run)]
    return over_seeds(values or [math.nan])


def earned(runs: Sequence[RunData], size: int) -> Interval:
    """Averages the return in scenes of `size` letters."""
    return over_seeds(
        [
            2 * _measures(run)[f"accuracy_{size}"] - 1 - run.config.search.price * _measures(run)[f"decisions_{size}"]
            for run in runs
        ]
    )


def _measures(run: RunData) -> dict[str, float]:
    return (run.evaluation or {})["measures"]


def block(groups: Groups) -> str:
    """Makes the part of docs/search.md with the tables and the cost of an answer."""
    returns = (f"return at {size}" for size in SIZES)
    head = ["values", "trained for", "seeds", *returns, f"accuracy at {SIZES[-1]}", "decisions, all sizes"]
    slopes = ["trained for", "seeds", "with a target", "without", "accuracy"]
    parts = (
        "![Return by set size, and fixations by set size](results/search.png)",
        table(["sensor, gaze learned", *head], [_row(groups, *item) for item in _SENSORS.items()]),
        table(["gaze, rings and periphery", *head], [_row(groups, *item) for item in _GAZES.items()]),
        table(["fixations per letter", *slopes], [_slopes(groups, *item) for item in _TARGETS.items()]),
        *([_costs(groups[_BEST])] if _BEST in groups else []),
        *([_eight(groups[f"{_BEST}-eight"])] if f"{_BEST}-eight" in groups else []),
        *([_detection(groups[_DETECTION])] if _DETECTION in groups else []),
        f"Brackets: {100 * CONFIDENCE:.0f} % interval over seeds (Student's t), of 2,000 scenes a seed. With two or "
        "three seeds it is rough and may pass the largest possible value. Slopes are of scenes answered right.",
    )
    return "\n" + "\n\n".join(parts) + "\n\n"


def _row(groups: Groups, name: str, label: str) -> list[str]:
    if name not in groups:
        return [label, *[""] * (len(SIZES) + 4), claims.NOT_RUN]
    runs = groups[name]
    config = runs[0].config
    return [
        label,
        f"{make_sensor(config.sensor).count(config.env.frame_shape).nominal:,}",
        *_trained(runs),
        *(str(earned(runs, size)) for size in SIZES),
        str(measure(runs, f"accuracy_{SIZES[-1]}")),
        str(measure(runs, "decisions")),
    ]


def _slopes(groups: Groups, name: str, label: str) -> list[str]:
    if name not in groups:
        return [label, "", "", "", "", claims.NOT_RUN]
    runs = groups[name]
    asked = ("slope_present", *(["slope_absent"] if runs[0].config.search.absent else []))
    slopes = [str(measure(runs, key)) for key in asked]
    return [label, *_trained(runs), *slopes, *[""] * (2 - len(slopes)), str(measure(runs, "accuracy"))]


def _trained(runs: Sequence[RunData]) -> tuple[str, str]:
    """Returns how long the runs were trained, in millions of decisions, and their number."""
    return f"{runs[0].config.train.env_steps / 1e6:g} M", str(len(runs))


def _eight(runs: Sequence[RunData]) -> str:
    config = runs[0].config
    earned = over_seeds([run.final_score for run in runs])
    return (
        f"Trained on scenes of eight letters alone, for {config.train.env_steps:,} decisions, rings and periphery earn "
        f"{earned} there (seeds: {len(runs)}). Full sight earns {optimal_return(config.search)}."
    )


def _detection(runs: Sequence[RunData]) -> str:
    names = ("accuracy", "hit_rate", "decisions", "distance", "overlap")
    right, hit, decisions, distance, overlap = (measure(runs, name) for name in names)
    earned = over_seeds([run.final_score for run in runs])
    return (
        f"Detection (seeds: {len(runs)}): the return is {earned}, with {decisions} decisions. The share of right "
        f"answers is {hit}, that of scenes answered right {right}. At an answer the focal point is {distance} pixels "
        f"from the target; the finest ring and the target's plate overlap by {overlap}."
    )


def _costs(runs: Sequence[RunData]) -> str:
    config = runs[0].config
    decisions = measure(runs, "decisions").value
    rows = []
    for shape in SHAPES:
        at = replace(config, env=replace(config.env, frame_shape=shape))
        looked, once = (cost.count(each)["decision_flops"] for each in (at, whole(at)))
        answer = looked * decisions
        rows.append([_size(shape), *(f"{n / 1e6:,.2f}" for n in (looked, answer, once)), f"{once / answer:,.0f}"])
    head = ["frame", "MFLOP a decision", "MFLOP an answer", "MFLOP of the whole frame, once", "ratio"]
    return (
        f"{table(head, rows)}\n\nThe same network looks or sees the whole frame. Arithmetic is calculated, for the "
        f"{decisions:.3g} decisions that an answer takes at {_size(SHAPES[0])}."
    )


def _size(shape: tuple[int, int]) -> str:
    return f"{shape[0]}x{shape[1]}"


def whole(config: Config) -> Config:
    """Returns `config` with the whole frame, without a gaze."""
    sensor = RingSensor(rings=((*config.env.frame_shape, 1),), layout="packed")
    network = replace(config.network, priority_map=False)
    return replace(config, sensor=sensor, gaze=GazeConfig(mode="none"), network=network)


def draw(groups: Groups) -> Figure:
    """Draws, by set size, the return of sensors of about 600 values (left) and the fixations (right)."""
    with rc_context(STYLE):
        figure = Figure(figsize=(11, 4.2), layout="constrained")
        left, right = figure.subplots(1, 2)
        colours = colours_of(_SMALL)
        for name in _SMALL:
            if name in groups:
                found = [earned(groups[name], size) for size in SIZES]
                _line(left, found, color=colours[name], label=_SENSORS[name])
        for name, colour in zip(list(_TARGETS)[1:], colours.values(), strict=False):
            for part, said, style in (("present", "with a target", "-"), ("absent", "without", "--")):
                if name in groups:
                    found = [measure(groups[name], f"fixations_{part}_{size}") for size in SIZES]
                    _line(right, found, color=colour, linestyle=style, label=f"{name.rpartition('-')[2]}: {said}")
        for plot, what in ((left, "return"), (right, "fixations until the right answer")):
            plot.set(xlabel="letters in the scene", ylabel=what, xticks=SIZES)
            if plot.has_data():
                plot.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False, fontsize=8)
    return figure


def _line(plot: Any, found: Sequence[Interval], **style: Any) -> None:
    mean, low, high = np.array(found).T
    plot.errorbar(SIZES, mean, [mean - low, high - mean], marker="o", markersize=4, capsize=3, **style)


def grouped(runs: Sequence[RunData]) -> dict[str, list[RunData]]:
    """Groups the runs of search and detection by name; raises `ConfigError` as `check_seeds` does."""
    groups: dict[str, list[RunData]] = {}
    for run in runs:
        if run.config.searches:
            groups.setdefault(run.config.name, []).append(run)
    for runs in groups.values():
        check_seeds(runs)
    return groups


def write(runs: Sequence[RunData], docs: Path) -> None:
    """Writes the figure and the tables of docs/search.md; does nothing if there are no runs of search."""
    if groups := grouped(runs):
        save(draw(groups), docs / "results" / "search.png")
        page = docs / "search.md"
        page.write_text(fill(page.read_text(), block(groups)))
