"""The tasks that come with foajax, by their names in `game=`."""

from __future__ import annotations

from collections.abc import Callable

from foajax.config.schema import Config
from foajax.envs import probes, search, seek
from foajax.envs.tasks import Task


def _by_frame(make_task: Callable[[tuple[int, int]], Task]) -> Callable[[Config], Task]:
    return lambda config: make_task(config.env.frame_shape)


OWN: dict[str, Callable[[Config], Task]] = {
    "seek": _by_frame(seek.task),
    "search": search.search,
    "detect": search.detect,
    **{f"probe:{name}": _by_frame(task) for name, task in probes.PROBES.items()},
}
