"""Writes the whole decision as one StableHLO program, from the screen to the gaze, for CPUs, CUDA and any batch.

JAX alone runs it; `data` are the bytes of `decide.stablehlo`:

    decide = jax.jit(jax.export.deserialize(bytearray(data)).call)
    outputs = decide(inputs)
    inputs |= {name: outputs[name] for name in outputs if name in inputs}  # the state goes on

Inputs and outputs are mappings of arrays, [batch, ...]; see `inputs`.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from foajax.config.parse import ConfigError, refuse
from foajax.learning.agent import Agent
from foajax.robot.golden import GAMES
from foajax.runs.agents import TrainedAgent
from foajax.types import ActorState, TimeStep

FILE = "decide.stablehlo"
PLATFORMS = ("cpu", "cuda")
TOLERANCE = 1e-4  # of logits
Arrays = dict[str, Any]


def serialise(stored: TrainedAgent) -> bytes:
    """Returns the program as bytes, with parameters and frame statistics in it.

    Its outputs are `natural_action`, `vision_action`, their logits, `looked_at`, and the next state.
    """
    batch = export.symbolic_shape("batch")
    given = {
        name: jax.ShapeDtypeStruct((*batch, *value.shape[1:]) if value.ndim else (), value.dtype)
        for name, value in inputs(stored.agent, 1).items()
    }
    params, statistics = jax.tree.map(jnp.asarray, (stored.params, stored.statistics))
    call = jax.jit(functools.partial(_decide, dataclasses.replace(stored, params=params, statistics=statistics)))
    try:
        return bytes(export.export(call, platforms=PLATFORMS)(given).serialize())
    except ImportError as error:
        raise refuse("stablehlo", True, "", why=f"{error.name} is missing (pip install 'foajax[robot]')") from None


def inputs(agent: Agent, batch: int) -> Arrays:
    """Makes the inputs of a first step, with frames of zeros.

    `frame` is what the environment shows, `reward` what the last action earned. With `is_first` an episode begins, and
    the state is not read. `seed` is for the actions drawn at this step; with `greedy` none is drawn. The other inputs
    are the state.
    """
    given: Arrays = {
        "frame": np.zeros((batch, *agent.screen_shape), np.uint8),
        "reward": np.zeros(batch, np.float32),
        "is_first": np.ones(batch, bool),
        "seed": np.arange(batch, dtype=np.uint32),
        "greedy": np.zeros((), bool),
    }
    return given | jax.tree.map(np.asarray, _named(agent.initial_state(batch)))


def check(data: bytes, golden: Arrays, agent: Agent) -> float:
    """Replays the recorded games as one batch; returns the largest difference of logits.

    Raises:
      ConfigError: logits differ by more than `TOLERANCE`, or actions or focal points differ.
    """
    decide = jax.jit(export.deserialize(bytearray(data)).call)
    steps = len(golden["frame"]) // GAMES
    given, largest = inputs(agent, GAMES) | {"greedy": np.ones((), bool)}, 0.0
    for step in range(steps):
        recorded = {name: array[step::steps] for name, array in golden.items() if len(array) == GAMES * steps}
        outputs = jax.device_get(decide(given | {name: recorded[name] for name in ("frame", "reward", "is_first")}))
        logits = [name for name in ("natural_logits", "vision_logits") if name in recorded]
        largest = max(largest, *(float(np.abs(outputs[name] - recorded[name]).max()) for name in logits))
        same = ["natural_action"]
        if agent.config.gaze.mode != "random" and agent.config.gaze.start != "random":
            same += ["vision_action", "looked_at"]
            recorded["looked_at"] = recorded["focal_point"]
        for name in same:
            if not np.array_equal(outputs[name], recorded[name]):
                raise ConfigError(f"stablehlo: {name} differs at step {step}; nothing is written")
        given |= {name: outputs[name] for name in outputs if name in given}
    if not largest <= TOLERANCE:
        raise ConfigError(f"stablehlo: logits differ by {largest:.1e}, more than {TOLERANCE}; nothing is written")
    return largest


def _decide(stored: TrainedAgent, given: Arrays) -> Arrays:
    leaves, structure = jax.tree.flatten(stored.agent.initial_state(1).core_state)
    state = ActorState(
        core_state=jax.tree.unflatten(structure, [given[f"core_{i}"] for i in range(len(leaves))]),
        focal_point=given["focal_point"],
        age=given["age"],
        last_actions=given.get("last_actions"),
        owed=given.get("owed"),
    )
    never = jnp.zeros_like(given["is_first"])
    timestep = TimeStep(given["frame"], given["reward"], is_first=given["is_first"], is_terminal=never)
    keys = jax.vmap(jax.random.key)(given["seed"])

    def act(greedy: bool) -> Arrays:
        output, network, following = stored.agent.act(
            stored.params, stored.statistics, state, timestep, keys, greedy=greedy
        )
        found = {"natural_action": output.natural_action, "vision_action": output.vision_action}
        found |= {"looked_at": output.focal_point, "natural_logits": network.natural_logits}
        if network.vision_logits is not None:
            found["vision_logits"] = network.vision_logits
        return found | _named(following)

    return jax.lax.cond(given["greedy"], lambda: act(True), lambda: act(False))


def _named(state: ActorState) -> Arrays:
    """Returns the state as a mapping of inputs."""
    core = {f"core_{i}": leaf for i, leaf in enumerate(jax.tree.leaves(state.core_state))}
    others = {name: getattr(state, name) for name in ("focal_point", "age", "last_actions", "owed")}
    return core | {name: value for name, value in others.items() if value is not None}
