"""Sums up the scores of several runs in one number, with its uncertainty: interquartile mean, stratified bootstrap.

As in Agarwal et al., *Deep Reinforcement Learning at the Edge of the Statistical Precipice* (2021), and its library
rliable. Scores are given game by game, one number per run; games may have different numbers of runs.
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
    """A number and its interval of `CONFIDENCE`, whose ends are equal for a single run."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        """Writes three digits or, from 1,000 on, whole numbers."""
        value, low, high = (f"{each:,.0f}" if 999.5 <= abs(each) < math.inf else f"{each:.3g}" for each in self)
        return f"{value} [{low}, {high}]" if low != high else value


def iqm(scores: Float[np.ndarray, "n"]) -> float:
    """Averages the scores without their lowest and highest quarter, each rounded down to whole scores."""
    cut = len(scores) // 4
    return float(np.sort(scores)[cut : len(scores) - cut].mean())


def interval(strata: Sequence[Float[np.ndarray, "_"]], statistic: Callable[[np.ndarray], float]) -> Interval:
    """Returns a statistic of all scores together, and its percentile interval by stratified bootstrap.

    Each resample draws, game by game, as many of the game's runs as there are, with replacement.

    Args:
      strata: scores of a game's runs, one array per game.
      statistic: of an array of scores.
    """
    random = np.random.default_rng(0)
    drawn = [resampled(scores, random) for scores in strata]
    values = [statistic(resample) for resample in np.concatenate(drawn, axis=1)]
    low, high = np.quantile(values, QUANTILES)
    return Interval(statistic(np.concatenate(list(strata))), float(low), float(high))


def resampled(runs: Float[np.ndarray, "n *m"], random: np.random.Generator) -> Float[np.ndarray, "_ n *m"]:
    """Draws `RESAMPLES` samples with replacement, each of as many runs as there are."""
    return runs[random.integers(0, len(runs), (RESAMPLES, len(runs)))]


def normalised(game: str, scores: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"] | None:
    """Scales scores to 0 for random play and 1 for a human, in seek for full sight; None without a reference."""
    if game not in REFERENCE:
        return None
    low, high = REFERENCE[game]
    return (scores - low) / (high - low)
