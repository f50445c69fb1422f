"""Groups runs by game and experiment; says how the groups differ and what they score."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from foajax.config.parse import refuse
from foajax.reporting.curves import PAPER_NAMES, RunData
from foajax.reporting.scores import Interval, interval, iqm, normalised
from foajax.runs.directory import FREE, compared

# Figs. 7 to 9 of the paper: experiments in the order of their legends.
PRESETS = {
    "constant": ("nonfoa", "constant50_sub1", "constant50_sub2", "constant70"),
    "decreasing": ("constant70", "decreasing"),
    "peripheral": ("constant70_p", "decreasing_p", "constant70", "decreasing"),
}
_NOT_COMPARED = FREE | {"seed", "game"}
Groups = dict[str, list[RunData]]  # seeds of the same experiment, by the experiment's name


def games_of(runs: Iterable[RunData], preset: str | None) -> dict[str, Groups]:
    """Groups runs by game and experiment; those of a preset by the paper's names and in its order.

    Raises:
      ConfigError: no run is left; runs of one game and name differ in more than their seeds.
    """
    games: dict[str, Groups] = {}
    for run in runs:
        base = run.config.name.removesuffix("_packed")
        if preset is None or base in PRESETS[preset]:
            games.setdefault(run.config.game, {}).setdefault(_label(run.config.name, preset), []).append(run)
    if not games:
        raise refuse("preset", preset, f"runs of {', '.join(PRESETS[str(preset)])}", why="leaves no run")
    for groups in games.values():
        for name, seeds in groups.items():
            if differences := differing_keys(seeds):
                key, values = next(iter(differences.items()))
                other = next(run for run, value in zip(seeds, values, strict=True) if value != values[0])
                accepted = "runs that differ in nothing but their seeds, or have different names"
                why = f"{name} differs in {key} from that of {seeds[0].path}"
                raise refuse(str(other.path), accepted=accepted, why=why)
    if preset is None:
        return games
    order = [_label(name + suffix, preset) for name in PRESETS[preset] for suffix in ("", "_packed")]
    return {game: {name: groups[name] for name in order if name in groups} for game, groups in games.items()}


def _label(name: str, preset: str | None) -> str:
    base = name.removesuffix("_packed")
    return PAPER_NAMES[base] + (", packed" if base != name else "") if preset else name


def differing_keys(runs: Sequence[RunData]) -> dict[str, list[Any]]:
    """Finds the keys that matter to what is learned and whose values differ between runs."""
    flat = [compared(run.config) for run in runs]
    keys = dict.fromkeys(key for each in flat for key in each)
    values = {key: [each.get(key) for each in flat] for key in keys if key not in _NOT_COMPARED}
    return {key: row for key, row in values.items() if any(value != row[0] for value in row)}


def check_seeds(runs: Sequence[RunData]) -> None:
    """Raises `ConfigError` if runs that are averaged have the same seed or differ in length."""
    check_lengths(runs)
    paths: dict[int, Path] = {}
    for run in runs:
        if run.config.seed in paths:
            accepted = f"another seed than that of {paths[run.config.seed]}"
            raise refuse(str(run.path), accepted=accepted, why="repeats it")
        paths[run.config.seed] = run.path


def check_lengths(runs: Sequence[RunData]) -> None:
    """Raises `ConfigError` if runs that are compared differ in `train.env_steps`."""
    lengths = {run.config.train.env_steps: run for run in runs}
    for steps, run in list(lengths.items())[1:]:
        accepted = f"{next(iter(lengths)):,}, as the runs that it is compared with"
        raise refuse(str(run.path), accepted=accepted, why=f"is of {steps:,} env_steps")


def final_scores(groups: Groups) -> dict[str, Interval]:
    """Returns the interquartile mean of each experiment's runs on one game."""
    return {name: interval([_finals(runs)], iqm) for name, runs in groups.items()}


def all_games(games: Mapping[str, Groups]) -> dict[str, Interval]:
    """Returns the same over all games, normalised, for the experiments that have played every game."""
    result = {}
    for name in experiments_of(games):
        strata = [normalised(game, _finals(groups[name])) for game, groups in games.items() if name in groups]
        known = [scores for scores in strata if scores is not None]
        if len(known) == len(games) > 1:
            result[name] = interval(known, iqm)
    return result


def runs_of(games: Mapping[str, Groups]) -> list[RunData]:
    return [run for groups in games.values() for seeds in groups.values() for run in seeds]


def experiments_of(games: Mapping[str, Groups]) -> list[str]:
    """Lists the experiments' names, each once, in their order."""
    return list(dict.fromkeys(name for groups in games.values() for name in groups))


def _finals(runs: Sequence[RunData]) -> np.ndarray:
    return np.array([run.final_score for run in runs])
