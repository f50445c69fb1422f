"""Tasks of our own, by the name that `game=` has for them."""

from __future__ import annotations

from collections.abc import Callable

from foajax.envs import probes, seek
from foajax.envs.tasks import Task

OWN: dict[str, Callable[[tuple[int, int]], Task]] = {
    "seek": seek.task,
    **{f"probe:{name}": task for name, task in probes.PROBES.items()},
}
