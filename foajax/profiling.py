"""`profile=true`: where the time of a few steady rollouts goes, as a trace and as a table."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import jax
from rich.console import Console
from rich.table import Table

from foajax.agent import Agent
from foajax.config import Config
from foajax.envs import Environment
from foajax.programs import Programs, make_programs, make_state
from foajax.rollout import Collector, update_on

_WARM_UP, _ROLLOUTS = 3, 5


class Stopwatch:
    """Sums up wall-clock seconds by part. A timed call is waited for, so parts do not overlap."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.calls: dict[str, int] = defaultdict(int)

    def timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """`function`, timed as `part`."""

        def run(*arguments: Any) -> Any:
            begin = time.perf_counter()
            result = jax.block_until_ready(function(*arguments))
            self.seconds[part] += time.perf_counter() - begin
            self.calls[part] += 1
            return result

        return run


def profile(config: Config, environments: list[Environment], directory: str) -> None:
    """Runs a few rollouts and updates; writes a `jax.profiler` trace to `directory` and prints the table."""
    agent = Agent(config, environments[0].num_actions, environments[0].crop_top)
    programs, state = make_programs(agent), make_state(agent, config.seed)
    stopwatch = Stopwatch()
    timed = Programs(act=stopwatch.timed("act", programs.act), update=stopwatch.timed("update", programs.update))
    for environment in environments:
        for name in ("send", "recv"):
            setattr(environment, name, stopwatch.timed("env", getattr(environment, name)))
    collector = Collector(agent, timed, environments, seed=config.seed)

    def run(count: int, first: int) -> None:
        nonlocal state
        for i in range(first, first + count):
            rollouts, _ = collector.collect(state, i * config.learner.rollout_length)
            state, _ = update_on(rollouts, state, timed, config.learner)

    run(_WARM_UP, 0)
    stopwatch.seconds.clear()
    stopwatch.calls.clear()
    with jax.profiler.trace(directory):
        begin = time.perf_counter()
        run(_ROLLOUTS, _WARM_UP)
        total = time.perf_counter() - begin
    _print(config, stopwatch, total)
    print(f"trace: {directory} (TensorBoard's profiler or Perfetto show it)")


def _print(config: Config, stopwatch: Stopwatch, total: float) -> None:
    env_steps = _ROLLOUTS * config.learner.rollout_length * config.env.num_envs
    table = Table("part", "share", "us a step", "calls", title=f"{config.name} on {config.game}, {jax.devices()[0]}")
    parts = {part: stopwatch.seconds[part] for part in ("env", "act", "update")}
    for part, seconds in (parts | {"host": total - sum(parts.values())}).items():
        calls = str(stopwatch.calls[part]) if part in stopwatch.calls else ""
        table.add_row(part, f"{100 * seconds / total:.1f} %", f"{1e6 * seconds / env_steps:.1f}", calls)
    table.add_row("all", "100 %", f"{1e6 * total / env_steps:.1f}", "", end_section=True)
    console = Console(width=100)
    console.print(table)
    console.print(f"{env_steps / total:.0f} steps/s with every part waited for; training overlaps them and is faster")
