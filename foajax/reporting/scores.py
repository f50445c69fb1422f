"""Scores of several runs in one number, with its uncertainty: interquartile mean and stratified bootstrap.

As in Agarwal et al., *Deep Reinforcement Learning at the Edge of the Statistical Precipice* (2021), and its library
rliable. Scores are given game by game, one number a run; games may have different numbers of runs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

RESAMPLES = 2000
CONFIDENCE = 0.95
QUANTILES = ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2)

# Scores of random play and of a human tester (Wang et al., 2016, for the Atari games; for seek what its rules say).
REFERENCE = {
    "breakout": (1.7, 30.5),
    "pong": (-20.7, 14.6),
    "beam_rider": (363.9, 16926.5),
    "seek": (0.0, 12.0),
}


class Interval(NamedTuple):
    """A number and the interval that holds it with `CONFIDENCE`; equal ends where there is one run."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        """In three digits or whole numbers."""
        value, low, high = (f"{each:,.0f}" if 1000 <= abs(each) < math.inf else f"{each:.3g}" for each in self)
        return f"{value} [{low}, {high}]" if low != high else value


def iqm(scores: Float[np.ndarray, "n"]) -> float:
    """Mean of what is left without the lowest and the highest quarter, each rounded down to whole scores."""
    cut = len(scores) // 4
    return float(np.sort(scores)[cut : len(scores) - cut].mean())


def interval(strata: Sequence[Float[np.ndarray, "_"]], statistic: Callable[[np.ndarray], float]) -> Interval:
    """A statistic of all scores together, and its percentile interval by stratified bootstrap.

    Each resample draws, game by game, as many of the game's runs as there are, with replacement.

    Args:
      strata: scores of a game's runs, one array a game.
      statistic: of an array of scores.
    """
    random = np.random.default_rng(0)
    drawn = [resampled(scores, random) for scores in strata]
    values = [statistic(resample) for resample in np.concatenate(drawn, axis=1)]
    low, high = np.quantile(values, QUANTILES)
    return Interval(statistic(np.concatenate(list(strata))), float(low), float(high))


def resampled(runs: Float[np.ndarray, "n *m"], random: np.random.Generator) -> Float[np.ndarray, "_ n *m"]:
    """`RESAMPLES` samples, each of as many runs as there are, drawn with replacement."""
    return runs[random.integers(0, len(runs), (RESAMPLES, len(runs)))]


def normalised(game: str, scores: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"] | None:
    """0 for random play, 1 for a human (who sees all, in seek); None for a game without a reference."""
    if game not in REFERENCE:
        return None
    low, high = REFERENCE[game]
    return (scores - low) / (high - low)
