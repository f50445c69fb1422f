"""Trained agents on disk: `agent.json` and `config.yaml` beside either checkpoints or one safetensors file.

A run directory and a shipped agent are read alike.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import yaml
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from foajax.config.parse import ConfigError, flatten, refuse, replace, to_mapping
from foajax.config.schema import Config
from foajax.learning.agent import Agent
from foajax.learning.programs import make_state
from foajax.runs import durable
from foajax.runs.checkpoints import Checkpoints
from foajax.runs.directory import PARAMETERS, is_run, load_config
from foajax.types import FrameStatistics, Params, TrainState

FACTS = "agent.json"  # what the parameters' shapes depend on besides the configuration
CHECKPOINTS = "checkpoints"


class Stored(NamedTuple):
    """An agent read from disk."""

    agent: Agent
    params: Params
    statistics: FrameStatistics
    env_steps: int  # it has been trained for


def save_facts(agent: Agent, directory: Path, **more: Any) -> None:
    """Writes what `load_agent` needs beside `config.yaml`, and more facts if there are."""
    facts = {"num_actions": agent.num_actions, "crop_top": agent.crop_top}
    durable.replace(directory / FACTS, (json.dumps(facts | more) + "\n").encode())


def load_score(path: str | Path) -> dict[str, Any] | None:
    """What `evaluate` found of a shipped agent: mean, stderr, episodes, policy; None where nobody has said."""
    try:
        return json.loads((Path(path) / FACTS).read_text()).get("score")
    except (OSError, ValueError, AttributeError):
        return None


def load_agent(path: str | Path, *, best: bool = False) -> Stored:
    """Reads a shipped agent or, of a run, the newest good checkpoint, or the `best` kept by its score in training.

    Raises:
      ConfigError: there is neither, or it cannot be read.
    """
    path = Path(path)
    config = load_config(path)
    try:
        facts = json.loads((path / FACTS).read_text())
        agent = Agent(config, facts["num_actions"], facts["crop_top"])
    except (OSError, ValueError, KeyError, TypeError):
        raise refuse("run", path, "a run or an agent", why=f"{FACTS} is missing or not readable") from None
    if not isinstance(agent.num_actions, int) or agent.num_actions < 1:
        raise refuse("run", path, "an integer >= 1", why=f"{FACTS} has num_actions={agent.num_actions}")
    if (path / PARAMETERS).exists():
        return _load_shipped(agent, path / PARAMETERS, facts.get("env_steps", 0))
    template = jax.eval_shape(lambda: make_state(agent, 0))
    checkpoints = Checkpoints(path / CHECKPOINTS, keep=None)
    restored = checkpoints.restore_part({"train": template}, best=best)
    if restored is None:
        raise refuse("run", path, "", why="has no checkpoint yet")
    env_steps, state, _ = restored
    return Stored(agent, state["train"].params, state["train"].statistics, env_steps)


def check_source(path: str) -> None:
    """`ConfigError`, about `train.init_from`, where `path` is neither a run nor an agent."""
    try:
        load_config(path)
    except ConfigError as error:
        raise refuse("train.init_from", path, "", why=str(error)) from None


def begin_from(path: str, state: TrainState, config: Config) -> TrainState:
    """The state at the start of a run, with a stored agent's parameters and frame statistics.

    Raises:
      ConfigError: there is no such agent, or it has another network or other images.
    """
    key = f"train.init_from={path}"
    try:
        stored = load_agent(path)
    except ConfigError as error:
        raise refuse(key, accepted="", why=str(error)) from None
    there, wanted = (named((s.params, s.statistics)) for s in (stored, state))
    for name in [*wanted, *there]:
        have, want = (arrays[name].shape if name in arrays else None for arrays in (there, wanted))
        if have != want:
            accepted = (
                f"an agent with this run's sensor, network, gaze and number of actions; {_differences(stored, config)}"
            )
            raise refuse(key, accepted=accepted, why=f"{name} has the shape {have}, here it is {want}")
    params, statistics = jax.tree.map(jnp.asarray, (stored.params, stored.statistics))
    return state._replace(params=params, statistics=statistics)


def _differences(stored: Stored, config: Config) -> str:
    """What of another configuration may be why an agent's parameters do not fit it."""
    there, here = (dict(flatten(to_mapping(c))) for c in (stored.agent.config, config))
    groups = ("sensor", "network", "gaze")
    differ = [key for key in there if key.startswith(groups) and here.get(key) != there[key]]
    return "that one has " + (", ".join(f"{key}={there[key]}" for key in differ) or "other actions")


def save_agent(stored: Stored, directory: Path, score: Mapping[str, Any] | None = None) -> None:
    """Writes a shipped agent: float32 arrays by name, the configuration and the facts, its score among them.

    Raises:
      ConfigError: `directory` is a run's, or cannot be written.
    """
    if is_run(directory):
        raise refuse("out", directory, "another directory", why="is a run")
    config = to_mapping(replace(stored.agent.config, run=None))  # where it was trained does not matter
    known = {} if score is None else {"score": dict(score)}
    try:
        directory.mkdir(parents=True, exist_ok=True)
        save_file(named((stored.params, stored.statistics)), directory / PARAMETERS)
        (directory / "config.yaml").write_text(yaml.safe_dump(config, sort_keys=False))
        save_facts(stored.agent, directory, env_steps=stored.env_steps, **known)
    except (OSError, SafetensorError) as error:
        raise refuse("out", directory, f"a directory that can be written ({error})") from None


def _load_shipped(agent: Agent, file: Path, env_steps: int) -> Stored:
    template = jax.eval_shape(lambda: make_state(agent, 0))
    wanted = (template.params, template.statistics)
    try:
        arrays = load_file(file)
    except (OSError, SafetensorError) as error:
        raise refuse("run", file.parent, "", why=f"{file.name} is not readable: {str(error).splitlines()[0]}") from None
    names = named(wanted)
    if {n: a.shape for n, a in arrays.items()} != {n: s.shape for n, s in names.items()}:
        why = f"{file.name} does not hold the parameters that config.yaml describes"
        raise refuse("run", file.parent, "", why=why)
    leaves = [jnp.asarray(arrays[name]) for name in names]  # once: NumPy's would be handed over at each decision
    params, statistics = jax.tree.unflatten(jax.tree.structure(wanted), leaves)
    return Stored(agent, params, statistics, env_steps)


def named(tree) -> dict:
    """Leaves by their path, e.g. `0/params/dense/kernel`."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    named = {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}
    return {n: np.asarray(x) if isinstance(x, jax.Array) else x for n, x in named.items()}
