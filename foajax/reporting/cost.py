"""Measures what a decision costs: FLOPs as XLA counts them, and times, taken in turns; see `foajax.cost`."""

from __future__ import annotations

import functools
import math
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from foajax.config.compose import compose
from foajax.config.schema import Config
from foajax.learning.agent import Agent
from foajax.networks.cores import Carry
from foajax.networks.torsos import make_torso
from foajax.types import Params

BATCHES = (1, 32)
_NUM_ACTIONS = 4  # Breakout's
REFERENCE = "nonfoa"
PARTS = ("sense", "network", "decision")
Calls = dict[str, Callable[[], Any]]  # by the name of the result; each returns when it is done


class Subject(NamedTuple):
    """An experiment to be measured."""

    exact: dict[str, Any]  # what is counted
    calls: Calls  # what is timed


def compose_each(experiments: Sequence[str], *, torso: str | None, color: bool) -> dict[str, Config]:
    """Composes each experiment, and `nonfoa` for the ratios, with its own network or with that of `torso`.

    Raises:
      ConfigError: an unknown name.
    """
    words = [f"env.color={color}", *([f"network={torso}"] if torso else [])]
    return {name: compose([f"experiment={name}", *words]) for name in dict.fromkeys([*experiments, REFERENCE])}


def measure(
    experiments: Sequence[str], *, torso: str | None, color: bool = False, repeats: int
) -> list[dict[str, Any]]:
    """Measures each experiment, and `nonfoa` for the ratios: counts, times in microseconds, ratios to `nonfoa`.

    Raises:
      ConfigError: an unknown name.
    """
    configs = compose_each(experiments, torso=torso, color=color)
    subjects = list(map(_subject, configs.values()))
    times = medians([subject.calls for subject in subjects], repeats)
    records = [{**subject.exact, **taken} for subject, taken in zip(subjects, times, strict=True)]
    reference = records[list(configs).index(REFERENCE)]
    for record in records:
        for key in ("torso_flops", "decision_flops", *(f"decision_us_batch{batch}" for batch in BATCHES)):
            record[f"{key}_ratio"] = record[key] / reference[key]
    return records


def measure_decisions(configs: Sequence[Config], *, repeats: int) -> list[dict[str, Any]]:
    """Counts each run's decision, and times it on this machine as `decision_us_batch1`."""
    subjects, key = [_subject(config) for config in configs], "decision_us_batch1"
    times = medians([{key: subject.calls[key]} for subject in subjects], repeats)
    return [{**subject.exact, **taken} for subject, taken in zip(subjects, times, strict=True)]


def decide(
    agent: Agent,
    params: Params,
    roi: tuple[Float[Array, "B _ _ _"], ...],
    focal_point: Int[Array, "B 2"],
    core_state: Carry,
    key: PRNGKeyArray,
) -> tuple[Array, Array, Carry]:
    """Makes the network's part of a decision: torso to sampling, and the gaze's move."""
    batch = focal_point.shape[0]
    natural_key, vision_key = jax.random.split(key, (2, batch))
    images, is_first = [image[None] for image in roi], jnp.zeros(batch, bool)
    side = agent.side(focal_point, jnp.zeros((batch, 2), jnp.int32), jnp.zeros(batch), is_first)
    output, core_state = agent.forward(params, images, side[None], is_first[None], core_state)
    output = jax.tree.map(lambda x: x[0], output)
    natural_action = jax.vmap(jax.random.categorical)(natural_key, output.natural_logits)
    vision_action, _ = agent.choose_vision(vision_key, output, False)
    age = jnp.zeros(batch, jnp.int32)
    return natural_action, agent.move(focal_point, vision_action, age), core_state


def decision(
    agent: Agent,
    params: Params,
    frame: Float[Array, "B H W *C"],
    focal_point: Int[Array, "B 2"],
    core_state: Carry,
    key: PRNGKeyArray,
) -> tuple[Array, Array, Carry]:
    """Makes a decision: senses, then does the network's part."""
    return decide(agent, params, agent.sense(frame, focal_point), focal_point, core_state, key)


def torso(agent: Agent, params: Params, roi: tuple[Float[Array, "B _ _ _"], ...]) -> list[Array]:
    """Runs only the torso, on every image that is large enough for it."""
    module: Any = make_torso(agent.config.network)
    weights = {i: params["params"].get(f"torso_{i}") for i in range(len(roi))}
    return [module.apply({"params": own}, roi[i]) for i, own in weights.items() if own is not None]


def flops(function: Callable[..., Any], *arguments: Any) -> int:
    """Counts the floating-point operations of a call, as XLA does before it compiles."""
    analysis: Any = jax.jit(function).lower(*arguments).cost_analysis()
    return int(analysis["flops"])


def count(config: Config) -> dict[str, Any]:
    """Counts what a run's decision takes; the same on every machine."""
    return _count(*_of_shapes(config))


def _of_shapes(config: Config) -> tuple[Agent, Params]:
    """Makes an agent, with shapes in the place of its parameters."""
    agent = Agent(config, num_actions=_NUM_ACTIONS, crop_top=None)
    return agent, jax.eval_shape(agent.initial_params, jax.random.key(0))


def _subject(config: Config) -> Subject:
    agent, shapes = _of_shapes(config)
    random = np.random.default_rng(0)
    # The values affect neither count nor time; initialisation as in training is slow to compile.
    params = jax.tree.map(lambda s: jnp.asarray(random.normal(0, 0.05, s.shape), s.dtype), shapes)
    calls = {}
    for batch in BATCHES:
        for part, call in zip(PARTS, _calls(agent, params, batch), strict=True):
            calls[f"{part}_us_batch{batch}"] = call
    return Subject(exact=_count(agent, params), calls=calls)


def _count(agent: Agent, params: Params) -> dict[str, Any]:
    """Counts what is the same on every machine, at batch 1."""
    config = agent.config
    frame, focal_point, core_state, key = _inputs(agent, 1)
    roi = jax.eval_shape(agent.sense, frame, focal_point)
    pixels = agent.sensor.count(config.env.frame_shape)
    return {
        "experiment": config.name,
        "torso": config.network.torso,
        "pixels_nominal": pixels.nominal,
        "pixels_actual": pixels.actual,
        "pixels_ratio": pixels.actual / math.prod(config.env.frame_shape),
        "torso_flops": flops(functools.partial(torso, agent), params, roi),
        "decision_flops": flops(functools.partial(decision, agent), params, frame, focal_point, core_state, key),
        "params": sum(leaf.size for leaf in jax.tree.leaves(params)),
    }


def _inputs(agent: Agent, batch: int) -> tuple[Array, Array, Carry, Array]:
    """Makes a batch of noise frames, with the focal points at their centres."""
    shape, pixel = agent.config.env.frame_shape, agent.config.env.pixel_shape
    frame = jnp.asarray(np.random.default_rng(0).normal(size=(batch, *shape, *pixel)), jnp.float32)
    focal_point = jnp.tile(jnp.array(shape, jnp.int32) // 2, (batch, 1))
    return frame, focal_point, agent.initial_state(batch).core_state, jax.random.key(0)


def _calls(agent: Agent, params: Params, batch: int) -> list[Callable[[], Any]]:
    """Compiles what is timed: sensor, network, and both as one program."""
    frame, focal_point, core_state, key = _inputs(agent, batch)
    look = jax.jit(agent.sense)
    think, both = (jax.jit(functools.partial(part, agent)) for part in (decide, decision))
    roi = look(frame, focal_point)
    return [
        lambda: jax.block_until_ready(look(frame, focal_point)),
        lambda: jax.block_until_ready(think(params, roi, focal_point, core_state, key)),
        lambda: jax.block_until_ready(both(params, frame, focal_point, core_state, key)),
    ]


def medians(calls: Sequence[Calls], repeats: int) -> list[dict[str, float]]:
    """Returns the median duration of each call, in microseconds, timed by `take_turns`."""
    taken = take_turns(calls, repeats)
    return [{name: statistics.median(values) for name, values in times.items()} for times in taken]


def take_turns(calls: Sequence[Calls], repeats: int) -> list[dict[str, list[float]]]:
    """Times calls in turns; returns microseconds. Before each timed call, the same call runs once untimed.

    So caches hold the parameters and threads are awake, as in a robot's loop, which decides again and again.
    """
    taken: list[dict[str, list[float]]] = [{name: [] for name in group} for group in calls]
    for _ in range(repeats):
        for group, times in zip(calls, taken, strict=True):
            for name, call in group.items():
                call()
                begin = time.perf_counter()
                call()
                times[name].append(1e6 * (time.perf_counter() - begin))
    return taken
