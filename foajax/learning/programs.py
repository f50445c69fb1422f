"""The compiled programs of training, made in one place: `act` and `update`, and a small one that only observes."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, NamedSharding
from jaxtyping import Array, Int, Key

from foajax.learning import learner
from foajax.learning.agent import Agent
from foajax.learning.optimizer import make_optimizer
from foajax.learning.sharding import BATCH, DATA, EVERYWHERE, ROLLOUT, Layout
from foajax.types import ActorState, Rollout, TimeStep, TrainState


class Programs(NamedTuple):
    """The compiled programs; each call is one dispatch."""

    act: Callable[..., tuple[Array, ActorState, Rollout]]
    update: Callable[..., tuple[TrainState, learner.Metrics]]
    observe: Callable[..., TrainState]  # before the first update
    shards: int = 1  # devices of this process that share a rollout


def make_programs(agent: Agent, layout: Layout | None = None) -> Programs:
    """Compiles the programs; with a `layout`, to run on each device's share of the environments.

    `act` records a decision in the rollout's buffer (donated); `update` applies one minibatch (state donated);
    `observe` takes a rollout's frames into the statistics (state donated).
    """
    config = agent.config
    optimizer = make_optimizer(config.learner, total_updates(agent))
    size = config.env.num_envs // config.learner.num_minibatches
    act = functools.partial(_act, agent)
    if layout is None:
        update = functools.partial(learner.update, agent, optimizer, size)
        return Programs(
            act=jax.jit(act, donate_argnames="rollout"),
            update=jax.jit(update, donate_argnames="state"),
            observe=jax.jit(learner.observe, donate_argnames="state"),
        )
    update = functools.partial(learner.update, agent, optimizer, size // layout.job.size, axis=DATA)
    observe = functools.partial(learner.observe, axis=DATA)
    acting = (EVERYWHERE, BATCH, BATCH, ROLLOUT, EVERYWHERE, BATCH, EVERYWHERE)
    updating = (EVERYWHERE, ROLLOUT, EVERYWHERE, EVERYWHERE)
    return Programs(
        act=_on(layout.local, act, acting, (BATCH, BATCH, ROLLOUT), donate=3),
        update=_on(layout.job, update, updating, (EVERYWHERE, EVERYWHERE), donate=0),
        observe=_on(layout.job, observe, (EVERYWHERE, ROLLOUT), EVERYWHERE, donate=0),
        shards=layout.local.size,
    )


def _on(mesh: Mesh, program: Callable, inputs: tuple, outputs: Any, *, donate: int) -> Callable:
    """Compiles `program` for each device of a mesh. Arrays from the host go to the devices that need them."""
    spread = jax.shard_map(program, mesh=mesh, in_specs=inputs, out_specs=outputs, check_vma=False)
    shardings = jax.tree.map(lambda spec: NamedSharding(mesh, spec), inputs)
    compiled = jax.jit(spread, in_shardings=shardings, donate_argnums=donate)
    if jax.process_count() > 1 and not mesh.is_multi_process:
        # Where there are several processes, jit takes no host arrays for several devices.
        return lambda *arguments: compiled(*jax.device_put(arguments, shardings))
    return compiled


def total_updates(agent: Agent) -> int:
    """Counts the minibatch updates until `train.env_steps`, for the learning-rate schedule."""
    config = agent.config
    rollouts = -(-config.train.env_steps // (config.env.num_envs * config.learner.rollout_length))
    return rollouts * config.learner.num_minibatches * config.learner.num_epochs


def make_state(agent: Agent, seed: int) -> TrainState:
    """Makes the train state at the start of a run."""
    optimizer = make_optimizer(agent.config.learner, total_updates(agent))
    make = jax.jit(functools.partial(learner.initial_state, agent, optimizer))
    return make(jax.random.fold_in(jax.random.key(seed), 0))


def acting_keys(seed: int, group: int, first: int, batch: int) -> Key[Array, "B"]:
    """Returns the keys of a group's actors `first` .. `first + batch - 1`.

    Each step folds its own number in, so that resuming needs only the count. Each actor has its own key, so that it
    samples the same wherever the others are.
    """
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), 1), group)
    return jax.vmap(functools.partial(jax.random.fold_in, key))(first + jnp.arange(batch))


def empty_rollout(agent: Agent, batch: int, timestep: TimeStep, shards: int = 1) -> Rollout:
    """Makes the buffer that `act` writes to: T+1 rows of `batch` environments, spread over `shards` devices."""
    actor_state = agent.initial_state(batch)
    shapes = jax.eval_shape(
        lambda: agent.act(
            agent.initial_params(jax.random.key(0)),
            agent.initial_statistics(),
            actor_state,
            jax.tree.map(jnp.asarray, timestep),
            jax.random.key(0),
        )[0]
    )
    rows = agent.config.learner.rollout_length + 1
    steps = jax.tree.map(lambda s: jnp.zeros((rows, *s.shape), s.dtype), shapes)
    return Rollout(
        steps=steps._replace(frames=tuple(jnp.repeat(x, shards, axis=1) for x in steps.frames)),
        core_state=jax.tree.map(jnp.zeros_like, actor_state.core_state),
    )


def _act(
    agent: Agent,
    state: tuple,
    actor_state: ActorState,
    timestep: TimeStep,
    rollout: Rollout,
    row: Int[Array, ""],
    keys: Key[Array, "B"],
    step: Int[Array, ""],
) -> tuple[Array, ActorState, Rollout]:
    """Decides, and writes the decision into row `row`. `state` is (params, statistics)."""
    params, statistics = state
    keys = jax.vmap(jax.random.fold_in, (0, None))(keys, step)
    output, _, next_state = agent.act(params, statistics, actor_state, timestep, keys)
    steps = jax.tree.map(
        lambda buffer, x: jax.lax.dynamic_update_index_in_dim(buffer, x, row, 0), rollout.steps, output
    )
    core_state = jax.tree.map(
        lambda kept, now: jnp.where(row == 0, now, kept), rollout.core_state, actor_state.core_state
    )
    return output.natural_action, next_state, Rollout(steps=steps, core_state=core_state)
