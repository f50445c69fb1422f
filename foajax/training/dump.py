"""Writes the batches whose updates were not finite (`train.dump_skipped=true`), to look for the cause.

    skipped/64000-3.safetensors   the rollout of one group that began at 64000 env_steps, and the parameters that
                                  acted in it; the metadata say which minibatch of it was skipped

`safetensors.numpy.load_file` gives the arrays by name: `rollout/steps/reward` is [T+1, B], and so on. Such a file
carries no code.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
from safetensors.numpy import save

from foajax.runs import durable
from foajax.runs.agents import named
from foajax.types import Params, Rollout

_MOST = 5  # files per start of a run: one mistake must not fill a disk


class Dump:
    """Keeps copies of one rollout until its metrics have been looked at, one rollout later.

    The copies are made on the device and not waited for.

    Args:
      directory: where the files go; created with the first one.
      minibatches: updates that one pass over all groups makes.
      warn: receives one line for each file, written or not.
    """

    def __init__(self, directory: Path, *, minibatches: int, warn: Callable[[str], None]) -> None:
        self._directory, self._minibatches, self._warn = directory, minibatches, warn
        self._left = _MOST
        self._env_steps = 0
        self._kept: tuple[Params, Sequence[Rollout]] = (None, ())

    def remember(self, env_steps: int, params: Params, rollouts: Sequence[Rollout]) -> None:
        """Copies parameters and rollouts, before the next updates and the next rollout overwrite them."""
        if self._left:
            self._env_steps = env_steps
            self._kept = jax.tree.map(lambda x: jax.device_put(x, may_alias=False), (params, tuple(rollouts)))

    def look(self, metrics: Sequence[dict[str, Any]]) -> None:
        """Writes the remembered rollouts whose update was skipped, of skipped ones in a row only the first.

        Args:
          metrics: of all updates on them, in order: passes, groups, minibatches.
        """
        if not self._left:
            return
        for row, skipped in enumerate(jax.device_get([update["skipped_in_a_row"] for update in metrics])):
            if skipped == 1 and self._left:
                self._left -= 1
                self._write(row)

    def _write(self, row: int) -> None:
        params, rollouts = self._kept
        epoch, update = divmod(row, self._minibatches)
        group, minibatch = divmod(update, self._minibatches // len(rollouts))
        facts = {"env_steps": self._env_steps, "epoch": epoch, "group": group, "minibatch": minibatch}
        path = self._directory / f"{self._env_steps}-{row}.safetensors"
        try:
            self._directory.mkdir(exist_ok=True)
            arrays = named({"params": params, "rollout": rollouts[group]})
            durable.replace(path, save(arrays, {name: str(fact) for name, fact in facts.items()}))
        except OSError as error:
            self._warn(f"{path} was not written: {error.strerror}")
            return
        self._warn(f"skipped an update that was not finite; its batch is in {path}")
