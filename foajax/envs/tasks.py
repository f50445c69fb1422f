"""Environments that are pure JAX functions: the `Task`, its auto-reset, and the host's adapter.

`reset` and `step` are one environment's and pure: vmap them over environments, scan them over time,
and a whole loop runs on the device. `JaxEnvironment` puts them behind the host interface of `envs`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt8

from foajax.types import Outcome, TimeStep

TaskState = Any  # a pytree of arrays, the same structure throughout


class Task(NamedTuple):
    """The rules of one environment, as pure functions without a batch. An episode ends as a terminal."""

    num_actions: int
    frame_shape: tuple[int, int]  # (H, W)
    start: Callable[[Key[Array, ""]], TaskState]  # the first state of an episode
    # What an action leads to: the next state, the reward in [-1, 1], and whether nothing follows.
    advance: Callable[[TaskState, Int[Array, ""]], tuple[TaskState, Float[Array, ""], Bool[Array, ""]]]
    draw: Callable[[TaskState], UInt8[Array, "H W"]]  # the screen, gray, 0..255


class EnvState(NamedTuple):
    """All there is to know about one environment: what to save for a resumed run to go on bit for bit."""

    task: TaskState
    key: Key[Array, ""]  # where the next episode's randomness comes from
    reward: Float[Array, ""]  # of the last step
    is_first: Bool[Array, ""]
    is_terminal: Bool[Array, ""]


def observe(task: Task, state: EnvState) -> TimeStep:
    """What `state` shows: a `TimeStep` without the batch."""
    return TimeStep(
        frame=task.draw(state.task),
        reward=state.reward,
        is_first=state.is_first,
        is_terminal=state.is_terminal,
    )


def reset(task: Task, key: Key[Array, ""]) -> tuple[EnvState, TimeStep]:
    """Begins the first episode."""
    next_key, start_key = jax.random.split(key)
    state = EnvState(
        task=task.start(start_key),
        key=next_key,
        reward=jnp.float32(0),
        is_first=jnp.bool_(True),
        is_terminal=jnp.bool_(False),
    )
    return state, observe(task, state)


def step(task: Task, state: EnvState, action: Int[Array, ""]) -> tuple[EnvState, TimeStep]:
    """Takes `action` or, after a terminal, ignores it and begins the next episode with reward 0."""
    fresh, _ = reset(task, state.key)
    inner, reward, is_terminal = task.advance(state.task, action)
    taken = EnvState(
        task=inner,
        key=state.key,
        reward=reward.astype(jnp.float32),
        is_first=jnp.bool_(False),
        is_terminal=is_terminal,
    )
    after = jax.tree.map(lambda a, b: jnp.where(state.is_terminal, a, b), fresh, taken)
    return after, observe(task, after)


class JaxEnvironment:
    """`num_envs` copies of a `Task` as an `envs.Environment`. Rewards are never clipped: they are in [-1, 1].

    Copy i draws from the key of `seed + i`. `recv` and `reset` give read-only arrays.
    """

    crop_top: int | None = None
    lives: np.ndarray | None = None

    def __init__(self, task: Task, *, num_envs: int, seed: int) -> None:
        self.num_envs = num_envs
        self.num_actions = task.num_actions
        self._keys = jax.vmap(jax.random.key)(seed + np.arange(num_envs))
        self._reset = jax.jit(jax.vmap(partial(reset, task)))
        self._step = jax.jit(jax.vmap(partial(step, task)))
        self._observe = jax.jit(jax.vmap(partial(observe, task)))

    def reset(self) -> tuple[TimeStep, Outcome]:
        """Begins every environment again from the seed."""
        self._state, self._timestep = self._reset(self._keys)
        return self.recv()

    def send(self, action: np.ndarray) -> None:
        """Starts a step; `action` is int32 [B]."""
        self._state, self._timestep = self._step(self._state, jnp.asarray(action, jnp.int32))

    def recv(self) -> tuple[TimeStep, Outcome]:
        """The step that `send` started, once it is there."""
        timestep = TimeStep(*map(np.asarray, self._timestep))
        return timestep, Outcome(score=timestep.reward, is_over=timestep.is_terminal)

    def get_state(self) -> EnvState:
        """Every environment's state, each field [B, ...]; between `recv` and `send`."""
        return self._state

    def set_state(self, state: EnvState) -> tuple[TimeStep, Outcome]:
        """Goes on from `state`, in place of `reset`; gives the time step that it was saved at."""
        self._state, self._timestep = state, self._observe(state)
        return self.recv()

    def render(self) -> np.ndarray:
        """The screens, uint8 [B, H, W, 3]."""
        return np.repeat(np.asarray(self._timestep.frame)[..., None], 3, axis=-1)

    def close(self) -> None:
        """Nothing to close."""
