"""Scores and lengths of the games that a run plays."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from foajax.types import Outcome


class EpisodeTracker:
    """Scores and lengths of whole games, and their means over the last ones finished.

    A game's length is the number of steps since the one before ended; the step in which an environment
    resets itself after a game does not count.
    """

    def __init__(self, num_envs: int, *, window: int = 100) -> None:
        self.games = 0  # finished so far
        self.best_score = math.nan  # highest `mean_score` of a full window; NaN before the first
        self._recent: deque[tuple[float, int]] = deque(maxlen=window)
        self._scores = np.zeros(num_envs)
        self._lengths = np.zeros(num_envs, int)

    def add(self, outcome: Outcome) -> list[tuple[float, int]]:
        """Takes in one step of all environments; returns (score, length) of the games it ended."""
        self._scores += np.asarray(outcome.score)
        self._lengths += 1
        over = np.flatnonzero(np.asarray(outcome.is_over))
        finished = [(float(self._scores[i]), int(self._lengths[i])) for i in over]
        self._scores[over] = 0
        self._lengths[over] = -1  # the reset comes next
        self.games += len(finished)
        self._recent.extend(finished)
        if finished and len(self._recent) == self._recent.maxlen:
            self.best_score = float(np.fmax(self.best_score, self.mean_score))
        return finished

    @property
    def mean_score(self) -> float:
        """The mean score of the last finished games; NaN before the first."""
        return float(np.mean([score for score, _ in self._recent])) if self._recent else math.nan

    @property
    def mean_length(self) -> float:
        """The mean length of the last finished games, agent steps; NaN before the first."""
        return float(np.mean([length for _, length in self._recent])) if self._recent else math.nan

    def get_state(self) -> dict[str, Any]:
        """Returns all of it, as JSON has it."""
        return {
            "games": self.games,
            "best_score": None if math.isnan(self.best_score) else self.best_score,
            "recent": [list(game) for game in self._recent],
            "scores": self._scores.tolist(),
            "lengths": self._lengths.tolist(),
        }

    def set_state(self, state: Mapping[str, Any], *, same_games: bool) -> None:
        """Takes over a saved state; the unfinished games only where the environments go on with them."""
        self.games = int(state["games"])
        best = state.get("best_score")
        self.best_score = math.nan if best is None else float(best)
        self._recent.clear()
        self._recent.extend((float(score), int(length)) for score, length in state["recent"])
        if same_games:
            self._scores[:] = state["scores"]
            self._lengths[:] = state["lengths"]
