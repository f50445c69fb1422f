"""Trained agents on disk: `agent.json` and `config.yaml` beside either checkpoints or one safetensors file.

A run directory and a shipped agent are read alike.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import yaml
from jaxtyping import Int
from pydantic import Field
from safetensors import SafetensorError
from safetensors.numpy import load_file, save

from foajax.config.parse import ConfigError, Section, flatten, refuse, replace, to_mapping
from foajax.config.schema import Config
from foajax.config.shipped import agents
from foajax.learning.agent import Agent
from foajax.learning.programs import make_state
from foajax.runs import durable
from foajax.runs.checkpoints import Checkpoints, named_leaves
from foajax.runs.directory import PARAMETERS, is_run, load_config
from foajax.runtime import refuse_fork
from foajax.types import FrameStatistics, Params, TimeStep, TrainState

FACTS = "agent.json"  # what the parameters' shapes depend on besides the configuration
CHECKPOINTS = "checkpoints"


class Actions(NamedTuple):
    """What B actors decided.

    Attributes:
      natural: what to do: the environment's actions, counted from 0. Hold each for `env.frame_skip` frames.
      vision: where to look next, as the gaze counts its actions; 0 if the gaze is not learned.
      focal_point: where they looked to decide: (y, x) in frame pixels.
    """

    natural: Int[np.ndarray, "B"]
    vision: Int[np.ndarray, "B"]
    focal_point: Int[np.ndarray, "B 2"]


@dataclasses.dataclass
class TrainedAgent:
    """An agent read from disk. `decide` keeps its memory, gaze and random numbers from one frame to the next.

    Attributes:
      agent: the agent's pure functions.
      params: the network's parameters.
      statistics: the frames' mean and deviation, for their normalisation.
      env_steps: how many decisions the agent was trained for.
    """

    agent: Agent
    params: Params
    statistics: FrameStatistics
    env_steps: int

    def with_config(self, config: Config) -> TrainedAgent:
        """Returns the same agent with another configuration, such as other rules of the game, but the same network."""
        return dataclasses.replace(self, agent=dataclasses.replace(self.agent, config=config))

    @functools.cached_property
    def act(self) -> Callable[..., Any]:
        """`agent.act`, compiled; it keeps nothing."""
        return jax.jit(self.agent.act, static_argnames="greedy")

    def reset(self, batch: int = 1, *, seed: int = 0, greedy: bool = False) -> None:
        """Begins an episode for each of `batch` actors.

        Args:
          batch: how many decide in one call.
          seed: of the actions, which are sampled.
          greedy: whether the likeliest actions are taken instead.
        """
        self._greedy = greedy
        self._state, self._starts = self.agent.initial_state(batch), np.ones(batch, bool)
        self._keys = iter(map(functools.partial(jax.random.fold_in, jax.random.key(seed)), itertools.count()))

    def decide(
        self, frames: np.ndarray, rewards: np.ndarray | None = None, *, starts: np.ndarray | None = None
    ) -> Actions:
        """Decides what to do and where to look next. The first call begins the episodes, with or without `reset`.

        Args:
          frames: uint8 [B, H, W], gray; with `env.color` RGB, [B, H, W, 3]. They are Atari screens of 210x160 pixels if
            the agent was trained with `env.crop`, and else of the size `env.frame_shape`.
          rewards: float [B], what the last actions earned, clipped as in training; None for 0.
          starts: bool [B], true where an episode begins with this frame; None if none does.

        Returns:
          An `Actions`: `natural`, `vision` and `focal_point`.

        Raises:
          ValueError: the frames have another type, shape or number; rewards or starts another shape.
          RuntimeError: the process was forked from one that had started JAX.
        """
        refuse_fork()
        if not hasattr(self, "_state"):
            self.reset(len(frames))
        batch = len(self._starts)
        if len(frames) != batch:
            raise ValueError(f"frames={list(frames.shape)}: accepted is [{batch}, ...], as reset({batch}) was told")
        reward = np.zeros(batch, np.float32) if rewards is None else np.asarray(rewards, np.float32)
        begin = np.zeros(batch, bool) if starts is None else np.asarray(starts, bool)
        for name, given in (("rewards", reward), ("starts", begin)):
            if given.shape != (batch,):
                raise ValueError(f"{name}={list(given.shape)}: accepted is [{batch}], one for each frame")
        timestep = TimeStep(
            frame=np.asarray(frames),
            reward=reward,
            is_first=self._starts | begin,
            is_terminal=np.zeros(batch, bool),
        )
        said = self.params, self.statistics, self._state, timestep, next(self._keys)
        output, _, self._state = self.act(*said, greedy=self._greedy)
        self._starts = np.zeros(batch, bool)
        return Actions(*map(np.asarray, (output.natural_action, output.vision_action, output.focal_point)))


def save_facts(agent: Agent, directory: Path, **more: Any) -> None:
    """Writes agent.json: what `load_agent` needs beside `config.yaml`, and `more` facts."""
    facts = {"num_actions": agent.num_actions, "crop_top": agent.crop_top}
    durable.replace(directory / FACTS, (json.dumps(facts | more) + "\n").encode())


def load_score(path: str | Path) -> dict[str, Any] | None:
    """Reads what `evaluate` found of a shipped agent: mean, stderr, episodes, policy; None if nothing is stored."""
    try:
        return json.loads((find(path) / FACTS).read_text()).get("score")
    except (OSError, ValueError, AttributeError):
        return None


def find(path: str | Path) -> Path:
    """Returns the directory that `run=` names: a path or, if that is no run or agent, a shipped agent's name."""
    path, shipped = Path(path), agents() / path
    return shipped if not (path / "config.yaml").exists() and (shipped / "config.yaml").exists() else path


def find_config(path: str | Path, key: str = "run") -> Config:
    """Reads the configuration of the run or the agent that `key` names.

    Raises:
      ConfigError: there is none (the message lists what is shipped), or it cannot be read.
    """
    shipped = sorted(file.parent.name for file in agents().glob("*/config.yaml"))
    return load_config(
        find(path), key=key, accepted=f"the directory of a run or an agent, or one of {', '.join(shipped)}"
    )


def check_trust(path: Path, config: Config, trust: bool) -> None:
    """Raises `ConfigError` if a configuration from disk names code, which would run, and `trust` is false."""
    if config.code and not trust:
        why = f"it would run the code {', '.join(config.code)}"
        raise refuse("run", path, "trust=true if you trust its author", why=why)


class StoredAgent(Section):
    """Keys of a command that reads an agent."""

    run: str = Field(description="Directory of a run or an agent, or a shipped agent's name.")
    checkpoint: Literal["newest", "best"] = Field(
        "newest", description="Which checkpoint of a run: the newest, or the one with the best score in training."
    )
    trust: bool = Field(False, description="Let code run that the agent's configuration names.")

    def load(self) -> TrainedAgent:
        """Reads the agent; raises as `load_agent`."""
        return load_agent(self.run, best=self.checkpoint == "best", trust=self.trust)


def load_agent(path: str | Path, *, best: bool = False, trust: bool = False, key: str = "run") -> TrainedAgent:
    """Reads a trained agent.

    Args:
      path: a directory of a run or an agent, or the name of a shipped agent, e.g. `pong-constant70_p_packed`.
      best: of a run, read the checkpoint with the best score in training, not the newest.
      trust: whether code that the agent's configuration names (`package.module:Name`) may run.
      key: the key that named it, for the message where there is none.

    Raises:
      ConfigError: there is no agent, it cannot be read, or it names code and `trust` is false.
    """
    config, path = find_config(path, key), find(path)
    check_trust(path, config, trust)
    try:
        facts = json.loads((path / FACTS).read_text())
        num_actions, crop_top = facts["num_actions"], facts["crop_top"]
    except (OSError, ValueError, KeyError, TypeError):
        raise refuse("run", path, "a run or an agent", why=f"{FACTS} is missing or not readable") from None
    if not isinstance(num_actions, int) or num_actions < 1:
        raise refuse("run", path, "an integer >= 1", why=f"{FACTS} has num_actions={num_actions}")
    agent = Agent(config, num_actions, crop_top)
    if (path / PARAMETERS).exists():
        return _load_shipped(agent, path / PARAMETERS, facts.get("env_steps", 0))
    template = jax.eval_shape(lambda: make_state(agent, 0))
    checkpoints = Checkpoints(path / CHECKPOINTS, keep=None)
    restored = checkpoints.restore({"train": template}, part=True, best=best)
    if restored is None:
        raise refuse("run", path, "", why="has no checkpoint yet; train it until one is saved")
    env_steps, state, _ = restored
    return TrainedAgent(agent, state["train"].params, state["train"].statistics, env_steps)


def check_source(path: str) -> None:
    """Raises `ConfigError` about `train.init_from` if `path` is neither a run nor an agent."""
    find_config(path, "train.init_from")


def begin_from(path: str, state: TrainState, config: Config) -> TrainState:
    """Returns the state at the start of a run with a stored agent's parameters and frame statistics.

    Raises:
      ConfigError: there is no such agent, or it has another network or other images.
    """
    key = f"train.init_from={path}"
    try:
        there = find_config(path).code
        stored = load_agent(path, trust=set(there) <= set(config.code))  # what this run's own words name is trusted
    except ConfigError as error:
        raise refuse(key, accepted="", why=str(error)) from None
    arrays_there, wanted = (named((s.params, s.statistics)) for s in (stored, state))
    for name in [*wanted, *arrays_there]:
        have, want = (arrays[name].shape if name in arrays else None for arrays in (arrays_there, wanted))
        if have != want:
            accepted = (
                f"an agent with this run's sensor, network, gaze and number of actions; {_differences(stored, config)}"
            )
            raise refuse(key, accepted=accepted, why=f"{name} has the shape {have}, here it is {want}")
    params, statistics = jax.tree.map(jnp.asarray, (stored.params, stored.statistics))
    return state._replace(params=params, statistics=statistics)


def _differences(stored: TrainedAgent, config: Config) -> str:
    """Lists the keys of a stored agent that may be why its parameters do not fit another configuration."""
    there, here = (dict(flatten(to_mapping(c))) for c in (stored.agent.config, config))
    groups = ("sensor", "network", "gaze", "env.color")
    differ = [key for key in there if key.startswith(groups) and here.get(key) != there[key]]
    return "that one has " + (", ".join(f"{key}={there[key]}" for key in differ) or "other actions")


def save_agent(stored: TrainedAgent, directory: Path, score: Mapping[str, Any] | None = None) -> None:
    """Writes a shipped agent: float32 arrays by name, the configuration and the facts, its score among them.

    Raises:
      ConfigError: `directory` is a run's, or cannot be written.
    """
    if is_run(directory):
        raise refuse("out", directory, "another directory", why="is a run")
    train = replace(stored.agent.config.train, logger=None, logger_kwargs={})
    config = to_mapping(replace(stored.agent.config, run=None, train=train))  # where it was trained does not matter
    known = {} if score is None else {"score": dict(score)}
    try:
        directory.mkdir(parents=True, exist_ok=True)
        (directory / PARAMETERS).write_bytes(save(named((stored.params, stored.statistics))))
        (directory / "config.yaml").write_text(yaml.safe_dump(config, sort_keys=False))
        save_facts(stored.agent, directory, env_steps=stored.env_steps, **known)
    except (OSError, SafetensorError) as error:
        raise refuse("out", directory, f"a directory that can be written ({error})") from None


def _load_shipped(agent: Agent, file: Path, env_steps: int) -> TrainedAgent:
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
    return TrainedAgent(agent, params, statistics, env_steps)


def named(tree: Any) -> dict[str, Any]:
    """Returns the leaves by their path, e.g. `0/params/dense/kernel`; JAX's arrays are brought to the host."""
    return {n: np.asarray(x) if isinstance(x, jax.Array) else x for n, x in named_leaves(tree).items()}
