"""Collects facts about episodes that have ended, and computes the measures of visual search from them.

A fact is an array with one value per episode: see `foajax.envs.search.facts`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping

import numpy as np
from jaxtyping import Bool

Facts = dict[str, np.ndarray]  # by name, each [n, ...] of n episodes


class FactsTracker:
    """The facts of the last episodes to end."""

    def __init__(self, *, window: int = 2000) -> None:
        self._episodes: deque[Facts] = deque(maxlen=window)

    def add(self, facts: Mapping[str, np.ndarray], is_over: Bool[np.ndarray, "B"]) -> None:
        """Adds the facts, each [B, ...], of those of B episodes that are over."""
        for i in np.flatnonzero(is_over):
            self._episodes.append({name: np.array(values[i]) for name, values in facts.items()})

    def table(self) -> Facts:
        """Returns all facts in the order in which the episodes ended; empty before the first."""
        names = self._episodes[0] if self._episodes else ()
        return {name: np.array([facts[name] for facts in self._episodes]) for name in names}


def pooled(tables: Iterable[Facts]) -> Facts:
    """Joins tables of the same facts into one."""
    tables = [table for table in tables if table]
    return {name: np.concatenate([table[name] for table in tables]) for name in tables[0]} if tables else {}


def summarise(facts: Facts) -> dict[str, float]:
    """Computes the measures of visual search over some episodes, by name; empty for facts of other tasks.

    If any episode has several targets (`search.staircase`), `targets` is their mean number. The other measures then
    leave such episodes out, unless there are no others.

    - `accuracy`: share of right answers. `decisions`, `fixations`: how many an episode takes, until the answer.
    - `on_target`: share of the fixations that land on the target, where there is one.
    - `accuracy_8`, `fixations_8`, ...: the same at a set size.
    - `fixations_present_8`, `fixations_absent_8`: of the episodes that were answered right, with and without a target.
      `slope_present`, `slope_absent`: fixations per item of the set, by least squares over them. Only where set sizes
      differ.
    - `hit_rate`, `distance` (pixels), `overlap` (intersection over union): of the answers "here" (`game=detect`)
      in scenes with a target.
    """
    if "set_size" not in facts or not len(facts["set_size"]):
        return {}
    row = {}
    if (facts["targets"] > 1).any():
        row["targets"] = float(facts["targets"].mean())
    if (alone := facts["targets"] <= 1).any():
        facts = {name: values[alone] for name, values in facts.items()}
    right, present, sizes = facts["right"], facts["targets"] > 0, facts["set_size"]
    row |= {name: float(facts[key].mean()) for name, key in _MEANS.items()}
    if present.any():
        row["on_target"] = float(facts["on_target"][present].sum() / facts["fixations"][present].sum())
    known = np.unique(sizes)
    if len(known) > 1:
        for size in known:
            row |= {f"{name}_{size}": float(facts[key][sizes == size].mean()) for name, key in _MEANS.items()}
        for name, part in (("present", right & present), ("absent", right & ~present)):
            there = np.unique(sizes[part])
            row |= {f"fixations_{name}_{n}": float(facts["fixations"][part & (sizes == n)].mean()) for n in there}
            if len(there) > 1:
                row[f"slope_{name}"] = float(np.polyfit(sizes[part], facts["fixations"][part], 1)[0])
    pointed = facts["distance"] >= 0
    if pointed.any():
        row["hit_rate"] = float(right[pointed].mean())
        row |= {name: float(facts[name][pointed].mean()) for name in ("distance", "overlap")}
    return row


_MEANS = {"accuracy": "right", "decisions": "decisions", "fixations": "fixations"}
