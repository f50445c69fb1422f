"""Saves where a run stands, and takes it up from a checkpoint."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from foajax.config.schema import Config
from foajax.launch.processes import Job
from foajax.learning.sharding import Layout
from foajax.runs.agents import CHECKPOINTS
from foajax.runs.checkpoints import Checkpoints
from foajax.runs.directory import RunDir, take_over
from foajax.training.collector import Collector
from foajax.training.episodes import EpisodeTracker

_GAMES_FOR_A_SCORE = 100  # the mean of fewer does not tell which checkpoint is best


@dataclasses.dataclass
class Progress:
    """Where a run stands after its last update."""

    env_steps: int
    tracker: EpisodeTracker
    state: Any = None  # the `TrainState`, on all devices
    games: list[dict[str, Any]] | None = None  # all processes' environments and actors; None before the first rollout


class Saving:
    """A run's checkpoints. Where several processes share a run, the first one has them, and alone writes.

    Args:
      config: of the run.
      job: the processes.
      layout: of the arrays on several devices; None for one device.
      run_dir: the run's directory; None for a process that does not write.
      warn: is told what cannot be saved.
    """

    def __init__(
        self, config: Config, job: Job, layout: Layout | None, run_dir: RunDir | None, warn: Callable[[str], None]
    ) -> None:
        self._config, self._job, self._layout, self._warn = config, job, layout, warn
        self.checkpoints = self._open(run_dir) if run_dir is not None else None
        self._copy: tuple[int, dict[str, Any], dict[str, Any]] | None = None  # a snapshot for `rescue`
        self._copied = 0.0

    def newest(self) -> int:
        """`env_steps` of the newest checkpoint; 0 where there is none."""
        return max(self.checkpoints.steps(), default=0) if self.checkpoints is not None else 0

    def is_saved(self, progress: Progress) -> bool:
        """Whether nothing is left to save."""
        return self.checkpoints is None or not progress.env_steps or self.checkpoints.has(progress.env_steps)

    def save(self, progress: Progress) -> None:
        """Starts to write a checkpoint, and does not wait for it."""
        if self.checkpoints is not None:
            self.checkpoints.save(*self._snapshot(progress))

    def finish(self, progress: Progress) -> None:
        """Saves what the last update left and waits for it, before the process ends."""
        if progress.games is None or self.checkpoints is None or not progress.env_steps:
            return  # before the first rollout is through there is nothing to keep
        try:
            self.checkpoints.wait()
            self.save(progress)
            self.checkpoints.wait()
        except RuntimeError as error:  # a failed update has taken the arrays with it
            self._warn(f"nothing newer can be saved: {str(error).partition(chr(10))[0]}")

    def restore(self, progress: Progress, collector: Collector) -> None:
        """Takes over the newest good checkpoint, if there is one; without one the run begins at 0."""
        games = self._job.gather(collector.get_state())
        template = self._arrays(progress.state, games)
        checkpoints = self.checkpoints
        restored = self._job.run_on_first("checkpoints", lambda: checkpoints.restore(template) if checkpoints else None)
        found = json.loads(
            self._job.broadcast_text("restored", json.dumps(restored and [restored.env_steps, restored.meta]))
        )
        if found is None:
            progress.env_steps, progress.games = 0, games
            return
        env_steps, meta = found
        arrays = self._job.broadcast(restored.state if restored is not None else template)
        collector.set_state(self._job.local_part(arrays["collector"]))
        progress.tracker.set_state(meta["tracker"], same_games=collector.resumable)
        progress.state = self._layout.replicate(arrays["train"]) if self._layout else arrays["train"]
        progress.env_steps, progress.games = env_steps, arrays["collector"]

    def refresh_copy(self, progress: Progress) -> None:
        """Copies the state now and then, for `rescue` to save if one of several processes is lost."""
        now, every = time.monotonic(), self._config.distributed.timeout / 20
        if self._copy is None or now - self._copied >= every:
            self._copy, self._copied = self._snapshot(progress), now

    def rescue(self) -> str:
        """Writes that copy, from any thread, unless another process does; returns what to tell the user."""
        if self.checkpoints is None and (run_dir := take_over(Path(self._config.run_dir))):
            self.checkpoints = self._open(run_dir)
        if self.checkpoints is None:
            return "the first process saves what it can"
        if self._copy is None:
            return "nothing has been learned since the start"
        self.checkpoints.wait()
        self.checkpoints.save(*self._copy)
        self.checkpoints.wait()
        return f"saved at {self.newest():,} env_steps; the same command goes on from here"

    def _open(self, run_dir: RunDir) -> Checkpoints:
        return Checkpoints(run_dir.path / CHECKPOINTS, keep=self._config.train.keep_checkpoints, warn=self._warn)

    def _snapshot(self, progress: Progress) -> tuple[int, dict[str, Any], dict[str, Any]]:
        """Returns what `Checkpoints.save` takes: env_steps, arrays and meta."""
        tracker = progress.tracker
        meta: dict[str, Any] = {"tracker": tracker.get_state()}
        if tracker.games >= _GAMES_FOR_A_SCORE:
            meta["score"] = tracker.mean_score
        return progress.env_steps, self._arrays(progress.state, progress.games), meta

    def _arrays(self, state: Any, games: Any) -> dict[str, Any]:
        if self._layout and self._job.count > 1:
            # On the host: whoever writes it need not wait for an update that another process may leave hanging.
            state = jax.tree.map(np.array, self._layout.nearby(state))
        return {"train": state, "collector": games}
