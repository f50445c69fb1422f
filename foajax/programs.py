"""The two compiled programs of training, made in one place."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from foajax import frames, learner
from foajax.agent import Agent
from foajax.optimizer import make_optimizer
from foajax.types import ActorState, Rollout, TimeStep, TrainState


class Programs(NamedTuple):
    """Compiled once each; every call is one dispatch."""

    act: Callable[..., tuple[Array, ActorState, Rollout]]
    update: Callable[..., tuple[TrainState, learner.Metrics]]


def make_programs(agent: Agent) -> Programs:
    """`act` records a decision in the rollout's buffer (donated); `update` applies one minibatch (state donated)."""
    config = agent.config
    optimizer = make_optimizer(config.learner, total_updates(agent))
    size = config.env.num_envs // config.learner.minibatches
    return Programs(
        act=jax.jit(functools.partial(_act, agent), donate_argnames="rollout"),
        update=jax.jit(functools.partial(learner.update, agent, optimizer, size), donate_argnames="state"),
    )


def total_updates(agent: Agent) -> int:
    """Minibatch updates until `train.env_steps`, for the learning-rate schedule."""
    config = agent.config
    rollouts = max(1, config.train.env_steps // (config.env.num_envs * config.learner.rollout_length))
    return rollouts * config.learner.minibatches * config.learner.epochs


def make_state(agent: Agent, seed: int) -> TrainState:
    """The train state at the start of a run."""
    optimizer = make_optimizer(agent.config.learner, total_updates(agent))
    make = jax.jit(functools.partial(learner.initial_state, agent, optimizer))
    return make(jax.random.fold_in(jax.random.key(seed), 0))


def acting_key(seed: int, group: int) -> Array:
    """Key of a group of actors; each step folds its own number in, so that resuming needs only the count."""
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), 1), group)


def empty_rollout(agent: Agent, batch: int, timestep: TimeStep) -> Rollout:
    """The buffer that `act` writes to: T+1 rows of `batch` environments."""
    actor_state = agent.initial_state(batch)
    shapes = jax.eval_shape(
        lambda: agent.act(
            agent.initial_params(jax.random.key(0)),
            frames.initial_statistics(),
            actor_state,
            jax.tree.map(jnp.asarray, timestep),
            jax.random.key(0),
        )[0]
    )
    rows = agent.config.learner.rollout_length + 1
    return Rollout(
        steps=jax.tree.map(lambda s: jnp.zeros((rows, *s.shape), s.dtype), shapes),
        core_state=jax.tree.map(jnp.zeros_like, actor_state.core_state),
    )


def _act(
    agent: Agent,
    state: tuple,
    actor_state: ActorState,
    timestep: TimeStep,
    rollout: Rollout,
    row: Int[Array, ""],
    key: Array,
    step: Int[Array, ""],
) -> tuple[Array, ActorState, Rollout]:
    """Decides, and writes the decision into row `row`. `state` is (params, statistics)."""
    params, statistics = state
    key = jax.random.fold_in(key, step)
    output, _, next_state = agent.act(params, statistics, actor_state, timestep, key)
    steps = jax.tree.map(
        lambda buffer, x: jax.lax.dynamic_update_index_in_dim(buffer, x, row, 0), rollout.steps, output
    )
    core_state = jax.tree.map(
        lambda kept, now: jnp.where(row == 0, now, kept), rollout.core_state, actor_state.core_state
    )
    return output.natural_action, next_state, Rollout(steps=steps, core_state=core_state)


def use_compilation_cache() -> None:
    """Compiled programs are kept for the next start, in JAX_COMPILATION_CACHE_DIR or the user's cache."""
    if jax.config.values["jax_compilation_cache_dir"] is None:
        cache = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
        jax.config.update("jax_compilation_cache_dir", os.path.join(cache, "foajax"))
