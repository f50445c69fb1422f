"""Makes what a run says while it trains: rows of metrics, pictures of its gaze, warnings."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from foajax.config.parse import refuse
from foajax.learning.learner import Metrics, explained_variance
from foajax.runs.logger import Logger
from foajax.training.episodes import EpisodeTracker
from foajax.types import Rollout
from foajax.viewing.previews import snapshots

_BLIND_ROWS = 5  # in a row, before a policy that does not look is warned of


class Journal:
    """Prints to stderr until it has a logger. Of several processes only the first says anything after its start."""

    def __init__(self) -> None:
        self._logger: Logger | None = None
        self._silent = False
        self._blind_rows = 0

    def write_to(self, logger: Logger | None) -> None:
        """Sends everything to `logger` from now on, or nowhere if that is None."""
        self._logger, self._silent = logger, logger is None

    def say(self, text: str) -> None:
        """Prints one line for the user."""
        if self._logger is not None:
            self._logger.message(text)
        elif not self._silent:
            print(text, file=sys.stderr, flush=True)

    def warn(self, text: str) -> None:
        """Prints one line that begins with "warning:"."""
        self.say(f"warning: {text}")

    def row(
        self,
        env_steps: int,
        metrics: Sequence[Metrics],
        tracker: EpisodeTracker,
        measures: Mapping[str, float],
        num_actions: int,
    ) -> None:
        """Logs a row of the updates' mean metrics, the last games' scores and a task's own `measures`."""
        if self._logger is None:
            return
        rows = jax.device_get(metrics)
        means = {name: finite_mean([row[name] for row in rows]) for name in rows[0] if name != "skipped_in_a_row"}
        self._blind_rows = self._blind_rows + 1 if is_blind(means, num_actions) else 0
        if self._blind_rows == _BLIND_ROWS:
            self.warn(
                f"at {env_steps:,} env_steps the policy prefers some actions and hardly depends on what is seen "
                f"(natural_information {means['natural_information']:.3f} nats); the score may stand still for "
                "100,000 env_steps; if it does, try another seed"
            )
        games: dict[str, Any] = {
            "games": tracker.games,
            "score": tracker.mean_score,
            "length": tracker.mean_length,
            "best_score": tracker.best_score,
        }
        skipped = {"skipped_updates": rows[-1]["skipped_updates"]}
        self._logger.write({"env_steps": env_steps} | games | dict(measures) | explained_variance(means) | skipped)

    def picture(self, rollout: Rollout, frame_shape: tuple[int, int]) -> None:
        """Logs images of what the gaze saw."""
        if self._logger is not None:
            for tag, image in snapshots(rollout, frame_shape).items():
                self._logger.image(tag, image)

    def leave_terminal(self) -> None:
        """Gives back the terminal's cursor, before a process ends that closes nothing."""
        if self._logger is not None:
            self._logger.leave_terminal()


def check_finite(metrics: Sequence[Metrics], max_skipped: int, env_steps: int) -> None:
    """Raises `ConfigError` if the updates of a run were not finite `max_skipped` times in a row."""
    last = max(metrics, key=lambda each: int(each["skipped_in_a_row"]))
    if int(last["skipped_in_a_row"]) < max_skipped:
        return
    values = ", ".join(f"{name} {float(last[name]):.4g}" for name in ("loss", "grad_norm", "param_norm"))
    saved = f"the last good parameters are saved at {env_steps:,} env_steps"
    why = f"{max_skipped} updates in a row were not finite ({values}); {saved}"
    accepted = "another run=<dir>, with a smaller learner.learning_rate or learner.max_grad_norm"
    raise refuse("train.max_skipped", max_skipped, accepted, why=why)


def is_blind(means: Mapping[str, float], num_actions: int) -> bool:
    """Whether a policy prefers some actions without looking, by the metrics of one row.

    It is surer than chance by log A less its entropy, in nats. Part of this is a preference for some actions whatever
    is seen, part is `natural_information`. In runs that learn, the second part is two fifths or more.
    """
    gained = math.log(num_actions) - means["natural_entropy"]
    return gained > 0.15 and means["natural_information"] < 0.2 * gained


def finite_mean(values: Sequence[np.ndarray]) -> float:
    """Averages what is finite, so that one skipped update does not hide the others; NaN where nothing is."""
    finite = [float(value) for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else math.nan
