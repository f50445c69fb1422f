"""Shows where the time of a few steady rollouts goes (`profile=true`), as a trace and as a table."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from foajax.config.schema import Config
from foajax.envs.base import Environment
from foajax.learning.agent import Agent
from foajax.learning.learner import loss
from foajax.learning.programs import empty_rollout, make_programs, make_state
from foajax.training.collector import Collector, update_on
from foajax.types import TimeStep

_WARM_UP, _ROLLOUTS = 3, 5


class Stopwatch:
    """Sums up wall-clock seconds by part. A timed call is waited for, so parts do not overlap."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.calls: dict[str, int] = defaultdict(int)

    def timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Wraps `function` so that its time counts as `part`."""

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
    timed = programs._replace(
        act=stopwatch.timed("act", programs.act), update=stopwatch.timed("update", programs.update)
    )
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
    _print(config, stopwatch, total, flops_a_step(agent))
    print(f"trace: {directory} (TensorBoard's profiler or Perfetto show it)")


def flops_a_step(agent: Agent) -> dict[str, float]:
    """Counts floating-point operations of `act` and `update` (without the optimiser) for one step, as XLA does.

    It compiles few images and scales up.
    """
    false = np.zeros(1, bool)
    timestep = TimeStep(np.zeros((1, *agent.screen_shape), np.uint8), np.zeros(1, np.float32), false, false)
    rollout = jax.eval_shape(lambda: empty_rollout(agent, 1, timestep))
    rows, counted = agent.config.learner.rollout_length + 1, 3
    short = rollout._replace(
        steps=jax.tree.map(lambda x: jax.ShapeDtypeStruct((counted, *x.shape[1:]), x.dtype), rollout.steps)
    )
    state = jax.eval_shape(lambda: make_state(agent, 0))

    def count(function: Callable[..., Any], *arguments: Any) -> float:
        analysis: Any = jax.jit(function).lower(*arguments).cost_analysis()
        return analysis["flops"]

    act = count(agent.act, state.params, state.statistics, agent.initial_state(1), timestep, jax.random.key(0))
    update = count(jax.grad(lambda params, part: loss(params, agent, part)[0]), state.params, short)
    return {"act": act * rows / (rows - 1), "update": update / counted * rows / (rows - 1)}


def matrix_product_rate() -> float:
    """Measures floating-point operations per second of a large float32 matrix product."""
    side = 2048
    x, product = jnp.ones((side, side)), jax.jit(jnp.dot)
    product(x, x).block_until_ready()
    begin = time.perf_counter()
    product(x, x).block_until_ready()
    return 2 * side**3 / (time.perf_counter() - begin)


def _print(config: Config, stopwatch: Stopwatch, total: float, flops: Mapping[str, float]) -> None:
    env_steps = _ROLLOUTS * config.learner.rollout_length * config.env.num_envs
    rate = matrix_product_rate()
    title = f"{config.name} on {config.game}, {jax.devices()[0]}"
    table = Table("part", "share", "us/step", "calls", "MFLOP/step", "GFLOP/s", "floor us", title=title)
    parts = {part: stopwatch.seconds[part] for part in ("env", "act", "update")}
    for part, seconds in (parts | {"host": total - sum(parts.values())}).items():
        calls = str(stopwatch.calls[part]) if part in stopwatch.calls else ""
        row = [part, f"{100 * seconds / total:.1f} %", f"{1e6 * seconds / env_steps:.1f}", calls]
        if part in flops:
            work = flops[part] * (config.learner.num_epochs if part == "update" else 1)
            row += [f"{work / 1e6:.1f}", f"{work * env_steps / seconds / 1e9:.0f}", f"{1e6 * work / rate:.1f}"]
        table.add_row(*row)
    table.add_row("all", "100 %", f"{1e6 * total / env_steps:.1f}", end_section=True)
    console = Console(width=100)
    console.print(table)
    console.print(f"{env_steps / total:.0f} steps/s with parts one by one; training overlaps them and is faster")
    console.print(f"floor us: the arithmetic at {rate / 1e9:.0f} GFLOP/s, as fast as a large matrix product")
