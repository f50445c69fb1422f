"""`python -m foajax.cost experiments=constant70_packed,nonfoa`: what a decision costs, sensor by sensor.

A decision is sense, torso, LSTM, heads and sampling, from a frame that is preprocessed and normalised
already; no game is started. FLOPs are XLA's count of the program *before* it is compiled for a device:
2 for a multiply-add of a convolution or matrix product, 1 for any other elementwise operation. So they
depend on neither the device nor what XLA fuses; but a loop counts as one turn, and thus the sensor's
repair of an area that overhangs the frame counts even where none does. Times are medians of repeats
that take turns, so that whatever else the machine does slows all experiments alike.

`target=onnx` times the folders that `foajax.export` writes, from a screen and from a camera's image to the next focal
point, on one thread (extra `robot`).
"""

from __future__ import annotations

import dataclasses
import functools
import math
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray
from rich import box
from rich.console import Console
from rich.table import Table

from foajax import cli, networks
from foajax.agent import Agent
from foajax.compose import compose, list_experiments
from foajax.config import Config, ConfigError
from foajax.foveation import pixel_count
from foajax.types import CoreState, Params

_BATCHES = (1, 32)
_NUM_ACTIONS = 4  # Breakout's
_REFERENCE = "nonfoa"
_PARTS = ("sense", "network", "decision")


@dataclasses.dataclass(frozen=True)
class Options:
    """What the command takes."""

    experiments: str | None = None  # names with commas between them; null for all
    torso: Literal["nature", "a3c"] = "nature"  # the group network/
    json: str | None = None  # file for the result
    repeats: int = 50
    target: Literal["jax", "onnx"] = "jax"
    dtype: Literal["float32", "float16", "int8"] = "float32"  # of the weights, where target=onnx

    def __post_init__(self) -> None:
        if self.repeats < 1:
            raise ConfigError(f"repeats={self.repeats}: accepted is an integer >= 1")
        cli.check_file("json", self.json)


class Subject(NamedTuple):
    """An experiment to be measured."""

    exact: dict[str, Any]  # what is counted
    calls: dict[str, Callable[[], Any]]  # what is timed, by the name of the result


def measure(experiments: Sequence[str], *, torso: str, repeats: int) -> list[dict[str, Any]]:
    """One record an experiment: what is counted, times in microseconds, ratios to `nonfoa`.

    `nonfoa` is measured in any case, for the ratios.

    Raises:
      ConfigError: an unknown name.
    """
    names = list(dict.fromkeys([*experiments, _REFERENCE]))
    subjects = [_subject(compose([f"experiment={name}", f"network={torso}"])) for name in names]
    times = _time([subject.calls for subject in subjects], repeats)
    records = [{**subject.exact, **taken} for subject, taken in zip(subjects, times, strict=True)]
    reference = records[names.index(_REFERENCE)]
    for record in records:
        for key in ("torso_flops", "decision_flops", *(f"decision_us_batch{batch}" for batch in _BATCHES)):
            record[f"{key}_ratio"] = record[key] / reference[key]
    return records


def measure_decisions(configs: Sequence[Config], *, repeats: int) -> list[dict[str, Any]]:
    """For each run what is counted and, timed on this machine, `decision_us_batch1`."""
    subjects, key = [_subject(config) for config in configs], "decision_us_batch1"
    times = _time([{key: subject.calls[key]} for subject in subjects], repeats)
    return [{**subject.exact, **taken} for subject, taken in zip(subjects, times, strict=True)]


def measure_exported(experiments: Sequence[str], *, torso: str, dtype: str, repeats: int) -> list[dict[str, Any]]:
    """One record an experiment, and `nonfoa`: what `robot.latency.measure` finds, and estimates of energy.

    Raises:
      ConfigError: an unknown name; the extra `robot` is not installed.
    """
    try:
        from foajax.robot import latency
    except ImportError as error:
        raise ConfigError(f"target=onnx: {error.name} is missing; accepted is foajax[robot]") from None
    names = list(dict.fromkeys([*experiments, _REFERENCE]))
    configs = [compose([f"experiment={name}", f"network={torso}"]) for name in names]
    records = latency.measure(configs, dtype=dtype, repeats=repeats)
    reference = records[names.index(_REFERENCE)]
    for name, config, record in zip(names, configs, records, strict=True):
        record["experiment"], record["dtype"] = name, dtype
        record["decision_flops"] = count = _subject(config).exact["decision_flops"]
        for source, size in (("screen", 210 * 160), ("camera", 1080 * 1920 * 3)):
            record[f"{source}_ratio"] = record[f"{source}_us"] / reference[f"{source}_us"]
            record[f"{source}_energy_estimate_uj"] = 1e6 * latency.energy(count, record["bytes"], size)
    return records


def wait_in_place() -> None:
    """Has programs on the CPU run on the thread that calls them; without effect once anything was computed.

    JAX hands them to another thread and back, which takes 40 to 60 us. A robot that waits for each decision does not.
    """
    jax.config.update("jax_cpu_enable_async_dispatch", False)


def sense(agent: Agent, frame: Float[Array, "B H W"], focal_point: Int[Array, "B 2"]) -> tuple[Array, ...]:
    """The sensor's part of a decision."""
    return agent.sense(frame, focal_point)


def decide(
    agent: Agent,
    params: Params,
    roi: tuple[Float[Array, "B _ _ 1"], ...],
    focal_point: Int[Array, "B 2"],
    core_state: CoreState,
    key: PRNGKeyArray,
) -> tuple[Array, Array, CoreState]:
    """The network's part: torso to sampling, and the gaze's move."""
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
    frame: Float[Array, "B H W"],
    focal_point: Int[Array, "B 2"],
    core_state: CoreState,
    key: PRNGKeyArray,
) -> tuple[Array, Array, CoreState]:
    """Both parts as one program."""
    return decide(agent, params, sense(agent, frame, focal_point), focal_point, core_state, key)


def torso(agent: Agent, params: Params, roi: tuple[Float[Array, "B _ _ 1"], ...]) -> list[Array]:
    """The convolutions alone, of every image that is large enough for them."""
    module: Any = networks.make_torso(agent.config.network)
    weights = {i: params["params"].get(f"torso_{i}") for i in range(len(roi))}
    return [module.apply({"params": own}, roi[i]) for i, own in weights.items() if own is not None]


def flops(function: Callable[..., Any], *arguments: Any) -> int:
    """Floating-point operations of a call, as XLA counts them before it compiles."""
    analysis: Any = jax.jit(function).lower(*arguments).cost_analysis()
    return int(analysis["flops"])


def _subject(config: Config) -> Subject:
    agent = Agent(config, num_actions=_NUM_ACTIONS, crop_top=None)
    shapes = jax.eval_shape(agent.initial_params, jax.random.key(0))
    random = np.random.default_rng(0)
    # The values matter to neither count nor time; initialisation as in training is slow to compile.
    params = jax.tree.map(lambda s: jnp.asarray(random.normal(0, 0.05, s.shape), s.dtype), shapes)
    calls = {}
    for batch in _BATCHES:
        for part, call in zip(_PARTS, _calls(agent, params, batch), strict=True):
            calls[f"{part}_us_batch{batch}"] = call
    return Subject(exact=_count(agent, params), calls=calls)


def _count(agent: Agent, params: Params) -> dict[str, Any]:
    """What is the same on every machine, at batch 1."""
    config = agent.config
    frame, focal_point, core_state, key = _inputs(agent, 1)
    roi = jax.eval_shape(functools.partial(sense, agent), frame, focal_point)
    count = pixel_count(config.sensor, config.env.frame_shape)
    return {
        "experiment": config.name,
        "torso": config.network.torso,
        "pixels_nominal": count.nominal,
        "pixels_actual": count.actual,
        "pixels_ratio": count.actual / math.prod(config.env.frame_shape),
        "torso_flops": flops(functools.partial(torso, agent), params, roi),
        "decision_flops": flops(functools.partial(decision, agent), params, frame, focal_point, core_state, key),
        "params": sum(leaf.size for leaf in jax.tree.leaves(params)),
    }


def _inputs(agent: Agent, batch: int) -> tuple[Array, Array, CoreState, Array]:
    """A batch of frames of noise, the focal points at their centres."""
    shape = agent.config.env.frame_shape
    frame = jnp.asarray(np.random.default_rng(0).normal(size=(batch, *shape)), jnp.float32)
    focal_point = jnp.tile(jnp.array(shape, jnp.int32) // 2, (batch, 1))
    return frame, focal_point, agent.initial_state(batch).core_state, jax.random.key(0)


def _calls(agent: Agent, params: Params, batch: int) -> list[Callable[[], Any]]:
    """What is timed: sensor, network, and both as one program."""
    frame, focal_point, core_state, key = _inputs(agent, batch)
    look, think, both = (jax.jit(functools.partial(part, agent)) for part in (sense, decide, decision))
    roi = look(frame, focal_point)
    return [
        functools.partial(look, frame, focal_point),
        functools.partial(think, params, roi, focal_point, core_state, key),
        functools.partial(both, params, frame, focal_point, core_state, key),
    ]


def _time(calls: Sequence[dict[str, Callable[[], Any]]], repeats: int) -> list[dict[str, float]]:
    """Medians in microseconds; the calls take turns, each after one of its own that is not timed.

    A robot's loop decides again and again: the caches then hold the parameters and the threads are awake.
    """
    for call in [call for group in calls for call in group.values()]:
        jax.block_until_ready(call())  # compiles
    taken: list[dict[str, list[float]]] = [{name: [] for name in group} for group in calls]
    for _ in range(repeats):
        for group, times in zip(calls, taken, strict=True):
            for name, call in group.items():
                jax.block_until_ready(call())
                begin = time.perf_counter()
                jax.block_until_ready(call())
                times[name].append(1e6 * (time.perf_counter() - begin))
    return [{name: statistics.median(values) for name, values in times.items()} for times in taken]


def cost(arguments: Sequence[str]) -> None:
    """The command."""
    options = cli.parse(Options, arguments)
    wait_in_place()
    names = list_experiments() if options.experiments is None else options.experiments.split(",")
    if options.target == "onnx":
        records = measure_exported(names, torso=options.torso, dtype=options.dtype, repeats=options.repeats)
        _print_exported(records)
    else:
        records = measure(names, torso=options.torso, repeats=options.repeats)
        _print(records)
    if options.json:
        cli.write_json("json", options.json, records)


def _print(records: Sequence[dict[str, Any]]) -> None:
    table = Table(box=box.SIMPLE, title=f"{records[0]['torso']} torso; batches of 1 | 32")
    table.add_column("experiment", no_wrap=True)
    for heading in ("values\nnominal", "values\nshown", "torso\nkFLOP", "decision\nkFLOP", "ratio", "params"):
        table.add_column(heading)
    for heading in ("sense us", "network us", "decision us", "ratio"):
        table.add_column(f"{heading}\n1 | 32", no_wrap=True)
    for column in table.columns[1:]:
        column.justify = "right"
    for record in records:
        pairs = [" | ".join(f"{record[f'{part}_us_batch{batch}']:,.0f}" for batch in _BATCHES) for part in _PARTS]
        ratios = " | ".join(f"{record[f'decision_us_batch{batch}_ratio']:.2f}" for batch in _BATCHES)
        table.add_row(
            record["experiment"],
            f"{record['pixels_nominal']:,}",
            f"{record['pixels_actual']:,}",
            f"{record['torso_flops'] / 1e3:,.0f}",
            f"{record['decision_flops'] / 1e3:,.0f}",
            f"{record['decision_flops_ratio']:.3f}",
            f"{record['params']:,}",
            *pairs,
            ratios,
        )
    console = Console(width=150, highlight=False)
    console.print(table)
    device = f"{jax.devices()[0].device_kind}, host {platform.machine()} with {os.cpu_count()} cores"
    console.print(f"Ratios are to {_REFERENCE}. {device}, jax {jax.__version__}.")


def _print_exported(records: Sequence[dict[str, Any]]) -> None:
    table = Table(box=box.SIMPLE, title=f"ONNX Runtime, {records[0]['dtype']}; us, median | 99%")
    headings = ("frame", "sense", "torso", "network", "screen", "camera", "JAX, screen")
    for heading in ("experiment", *headings, "ratio", "MB", "memory MB", "start s", "energy est. uJ"):
        table.add_column(heading, no_wrap=True, justify="left" if heading == "experiment" else "right")
    for record in records:
        parts = ("frame", "sense", "torso", "network", "screen", "camera", "jax_screen")
        table.add_row(
            record["experiment"],
            *(f"{record[f'{part}_us']:,.0f} | {record[f'{part}_us_p99']:,.0f}" for part in parts),
            f"{record['screen_ratio']:.2f}",
            f"{record['bytes'] / 1e6:.1f}",
            f"{record['memory_mb']:.0f}",
            f"{record['start_s']:.2f}",
            f"{record['screen_energy_estimate_uj']:.0f}",
        )
    console = Console(width=170, highlight=False)
    console.print(table)
    console.print(
        "frame, sense and network make up screen, a whole decision; torso is a part of network. Energy is an estimate "
        "from operations and bytes read."
    )


if __name__ == "__main__":
    sys.exit(cli.run(cost))
