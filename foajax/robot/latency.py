"""Measures what a decision costs on a robot: times the exported folder of each experiment, and JAX beside it.

A decision goes from a screen (210x160) or a camera's image (1080x1920, colour) to the next focal point, one at a time,
on one thread. Calls take turns, so that other load on the machine slows all of them alike.
"""

from __future__ import annotations

import functools
import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import onnx.utils
import onnxruntime

from foajax.config.parse import refuse
from foajax.config.schema import Config
from foajax.learning.agent import Agent
from foajax.reporting.cost import REFERENCE, Calls, compose_each, count, take_turns
from foajax.robot import folder
from foajax.robot.agent import Agent as Exported
from foajax.runs.agents import TrainedAgent
from foajax.types import SCREEN_SHAPE, FrameStatistics, TimeStep

PARTS = ("frame", "sense", "torso", "network", "screen", "camera", "jax_screen")
_ACTIONS, _CROP_TOP, _IMAGE = 4, 34, (1080, 1920, 3)
# Horowitz (ISSCC 2014), 45 nm: a 32-bit multiplication and addition, per operation; DRAM, per byte. For comparisons
# only: today's processors differ, and caches hold a part of what is read.
_JOULES_PER_FLOP, _JOULES_PER_BYTE = 2.3e-12, 160e-12
_PROCESS = """
import sys, time, json
begin = time.perf_counter()
sys.path.insert(0, sys.argv[1])
import numpy as np
from agent import Agent
Agent(sys.argv[1], source="camera").decide(np.zeros((1080, 1920, 3), np.uint8))
seconds = time.perf_counter() - begin
if sys.platform == "darwin":
    import resource
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
else:  # there it begins with the peak of the process that this one was forked from
    peak = int(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1])
print(json.dumps({"start_s": seconds, "memory_mb": peak / 1024}))
"""


def measure(
    experiments: Sequence[str], *, torso: str | None, color: bool = False, dtype: str, repeats: int
) -> list[dict[str, Any]]:
    """Measures each experiment and `nonfoa`: times of `PARTS`, file size, memory, start, and estimates of energy.

    Times are medians and 99th percentiles in microseconds. `frame` makes a frame of a screen, `sense` looks at it,
    `torso` is a part of `network`; `screen` and `camera` are whole decisions, and `jax_screen` is JAX's.

    Raises:
      ConfigError: an unknown name, or an experiment that does not look at Atari's 80x80 frames.
    """
    configs = compose_each(experiments, torso=torso, color=color)
    records = _measure(list(configs.values()), dtype, repeats)
    reference = records[list(configs).index(REFERENCE)]
    for (name, config), record in zip(configs.items(), records, strict=True):
        flops = count(config)["decision_flops"]
        record |= {"experiment": name, "dtype": dtype, "decision_flops": flops}
        for source, size in (
            ("screen", math.prod((*SCREEN_SHAPE, *config.env.pixel_shape))),
            ("camera", math.prod(_IMAGE)),
        ):
            record[f"{source}_ratio"] = record[f"{source}_us"] / reference[f"{source}_us"]
            record[f"{source}_energy_estimate_uj"] = 1e6 * energy(flops, record["bytes"], size)
    return records


def _measure(configs: Sequence[Config], dtype: str, repeats: int) -> list[dict[str, Any]]:
    with tempfile.TemporaryDirectory() as made:
        stored = [_untrained(config) for config in configs]
        paths = [Path(made) / str(i) for i in range(len(stored))]
        for path, agent in zip(paths, stored, strict=True):
            folder.fill(path, agent, {}, {}, dtype)
        calls = [_calls(path, agent) for path, agent in zip(paths, stored, strict=True)]
        records: list[dict[str, Any]] = [_process(path) for path in paths]
        for path, record, times in zip(paths, records, take_turns(calls, repeats), strict=True):
            record["bytes"] = (path / "policy.onnx").stat().st_size
            for part, taken in times.items():
                record[f"{part}_us"], record[f"{part}_us_p99"] = np.percentile(taken, [50, 99]).tolist()
    return records


def energy(flops: int, weight_bytes: int, image_bytes: int) -> float:
    """Estimates joules: every operation counts, and every byte of weights and image, read from memory once."""
    return flops * _JOULES_PER_FLOP + (weight_bytes + image_bytes) * _JOULES_PER_BYTE


def _untrained(config: Config) -> TrainedAgent:
    agent = Agent(config, _ACTIONS, _CROP_TOP)
    if config.env.frame_shape != (80, 80):
        raise refuse("experiments", config.name, "experiments with env.frame_shape=[80,80] where target=onnx")
    random, shapes = np.random.default_rng(0), jax.eval_shape(agent.initial_params, jax.random.key(0))
    params = jax.tree.map(lambda shape: jnp.asarray(random.normal(0, 0.05, shape.shape), jnp.float32), shapes)
    empty = agent.initial_statistics()
    statistics = FrameStatistics(mean=empty.mean + 0.3, std=jnp.float32(0.2), weight=jnp.float32(1))
    return TrainedAgent(agent, params, statistics, 0)


def _process(path: Path) -> dict[str, float]:
    """Measures a process of its own: seconds from the first import to the first decision, and megabytes of memory."""
    ended = subprocess.run([sys.executable, "-c", _PROCESS, str(path)], capture_output=True, text=True, check=True)
    return json.loads(ended.stdout)


def _calls(path: Path, stored: TrainedAgent) -> Calls:
    random = np.random.default_rng(0)
    screen, image = (random.integers(0, 256, shape, np.uint8) for shape in (stored.agent.screen_shape, _IMAGE))
    player, watcher = Exported(path), Exported(path, source="camera", order="bgr")
    frame = player.frame(screen)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = 1, 3
    calls: Calls = {
        "frame": lambda: player.frame(screen),
        "sense": lambda: [sensor.look(frame, player.focal_point) for sensor in player._sensors],
    }
    model = onnx.load(path / "policy.onnx")
    images = [value.name for value in model.graph.input if value.name.startswith("image_")]
    features = "features" if len(images) > 1 else "features_0"
    for part, network in {
        "torso": onnx.utils.Extractor(model).extract_model(images, [features]),
        "network": model,
    }.items():
        session = onnxruntime.InferenceSession(network.SerializeToString(), options, ["CPUExecutionProvider"])
        feed = {value.name: np.zeros((1, *value.shape[1:]), np.float32) for value in session.get_inputs()}
        calls[part] = functools.partial(session.run, None, feed)
    calls |= {"screen": lambda: player.decide(screen), "camera": lambda: watcher.decide(image)}
    return calls | {"jax_screen": _jax(stored, screen)}


def _jax(stored: TrainedAgent, screen: np.ndarray) -> Callable[[], Any]:
    state = stored.agent.initial_state(1)
    false = np.zeros(1, bool)
    timestep = TimeStep(screen[None], np.zeros(1, np.float32), is_first=false, is_terminal=false)
    inputs = stored.params, stored.statistics, state, timestep, jax.random.key(0)
    return lambda: jax.block_until_ready(stored.act(*inputs)[0].natural_action)
