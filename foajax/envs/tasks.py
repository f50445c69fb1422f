"""Environments that are pure JAX functions: the `Task`, its auto-reset, and the host's adapter.

`reset` and `step` are pure and serve one environment: vmap them over environments, scan them over time, and a whole
loop runs on the device. `JaxEnvironment` puts them behind the host's interface.
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
    """The rules of one environment, as pure JAX functions without a batch. A state is any pytree of arrays.

    Attributes:
      num_actions: how many actions there are, counted from 0.
      frame_shape: (H, W) of a frame.
      start: `start(key)` returns the first state of an episode.
      advance: `advance(state, action)` returns the next state, the reward in [-1, 1], and whether the episode ends
        there. With `reads_gaze` it is `advance(state, action, focal_point)`.
      draw: `draw(state)` returns the frame, uint8, gray [H, W] or RGB [H, W, 3].
      reads_gaze: whether the rules depend on where the agent looked to decide, (y, x) in frame pixels.
      facts: `facts(state)` returns named numbers about the episode, for measures of your own; None if there are none.
      follow: `follow(last_state, key)` returns the first state of the episode after another, in place of `start`; None
        if episodes do not depend on each other.
    """

    num_actions: int
    frame_shape: tuple[int, int]
    start: Callable[[Key[Array, ""]], TaskState]
    advance: Callable[..., tuple[TaskState, Float[Array, ""], Bool[Array, ""]]]
    draw: Callable[[TaskState], UInt8[Array, "H W *C"]]
    reads_gaze: bool = False
    facts: Callable[[TaskState], dict[str, Array]] | None = None
    follow: Callable[[TaskState, Key[Array, ""]], TaskState] | None = None


class EnvState(NamedTuple):
    """The whole state of one environment. A run that restores it goes on bit for bit."""

    task: TaskState
    key: Key[Array, ""]  # where the next episode's randomness comes from
    reward: Float[Array, ""]  # of the last step
    is_first: Bool[Array, ""]
    is_terminal: Bool[Array, ""]


def observe(task: Task, state: EnvState) -> TimeStep:
    """Returns the `TimeStep` that `state` shows, without the batch."""
    return TimeStep(
        frame=task.draw(state.task),
        reward=state.reward,
        is_first=state.is_first,
        is_terminal=state.is_terminal,
    )


def reset(task: Task, key: Key[Array, ""], before: TaskState | None = None) -> tuple[EnvState, TimeStep]:
    """Begins the first episode, or the one that follows `before`, the last state of another."""
    next_key, start_key = jax.random.split(key)
    start = task.start if task.follow is None or before is None else partial(task.follow, before)
    state = EnvState(
        task=start(start_key),
        key=next_key,
        reward=jnp.float32(0),
        is_first=jnp.bool_(True),
        is_terminal=jnp.bool_(False),
    )
    return state, observe(task, state)


def step(
    task: Task, state: EnvState, action: Int[Array, ""], focal_point: Int[Array, "2"] | None = None
) -> tuple[EnvState, TimeStep]:
    """Takes `action` or, after a terminal, ignores it and begins the next episode with reward 0."""
    fresh, _ = reset(task, state.key, state.task)
    taken = _take(task, state, action, focal_point)
    after = jax.tree.map(lambda a, b: jnp.where(state.is_terminal, a, b), fresh, taken)
    return after, observe(task, after)


def step_all(
    task: Task, state: EnvState, action: Int[Array, "B"], focal_point: Int[Array, "B 2"]
) -> tuple[EnvState, TimeStep]:
    """Steps B environments as `step` does, but makes a start only for those that begin an episode."""
    over = state.is_terminal
    order = jnp.argsort(~over, stable=True)  # those that are over come first

    def begin(i: Int[Array, ""], after: EnvState) -> EnvState:
        last = jax.tree.map(lambda every: every[order[i]], state)
        fresh, _ = reset(task, last.key, last.task)
        return jax.tree.map(lambda every, one: every.at[order[i]].set(one), after, fresh)

    taken = jax.vmap(partial(_take, task))(state, action, focal_point)
    after = jax.lax.fori_loop(0, jnp.sum(over), begin, taken)
    return after, jax.vmap(partial(observe, task))(after)


def _take(task: Task, state: EnvState, action: Int[Array, ""], focal_point: Int[Array, "2"] | None) -> EnvState:
    inner, reward, is_terminal = task.advance(state.task, action, *([focal_point] if task.reads_gaze else []))
    return EnvState(
        task=inner,
        key=state.key,
        reward=reward.astype(jnp.float32),
        is_first=jnp.bool_(False),
        is_terminal=is_terminal,
    )


class JaxEnvironment:
    """Makes an `Environment` of `num_envs` copies of a `Task`, which step on the device.

    Copy i is seeded with `seed + i`. Rewards are not clipped: a task gives them in [-1, 1]. Only the task ends an
    episode: `env.max_episode_steps` does not apply.
    """

    crop_top: int | None = None
    lives: np.ndarray | None = None

    def __init__(self, task: Task, *, num_envs: int, seed: int) -> None:
        self.num_envs = num_envs
        self.num_actions = task.num_actions
        self.reads_gaze = task.reads_gaze
        self._centre = np.tile(np.array(task.frame_shape, np.int32) // 2, (num_envs, 1))
        self._keys = jax.vmap(jax.random.key)(seed + np.arange(num_envs))
        self._reset = jax.jit(jax.vmap(partial(reset, task)))
        self._step = jax.jit(partial(step_all, task))
        self._observe = jax.jit(jax.vmap(partial(observe, task)))
        self._facts = None if task.facts is None else jax.jit(jax.vmap(task.facts))

    def reset(self) -> tuple[TimeStep, Outcome]:
        """Begins every environment again from the seed."""
        self._state, self._timestep = self._reset(self._keys)
        return self.recv()

    def send(self, action: np.ndarray, focal_point: np.ndarray | None = None) -> None:
        """Starts a step with the actions, int32 [B]. For a task that reads the gaze, `focal_point`, int32 [B, 2], tells
        where the last screens were sensed, (y, x) in pixels; None for the centre.
        """
        point = self._centre if focal_point is None else focal_point
        self._state, self._timestep = self._step(self._state, jnp.asarray(action, jnp.int32), jnp.asarray(point))

    def recv(self) -> tuple[TimeStep, Outcome]:
        """Waits for the step that `send` started."""
        timestep = TimeStep(*map(np.asarray, self._timestep))
        return timestep, Outcome(score=timestep.reward, is_over=timestep.is_terminal)

    def facts(self) -> dict[str, np.ndarray] | None:
        """Returns the task's facts about the current episodes by name, each [B, ...]; None if it has none."""
        return None if self._facts is None else jax.tree.map(np.asarray, self._facts(self._state.task))

    def get_state(self) -> EnvState:
        """Returns every environment's state, each field [B, ...]. Call it between `recv` and `send`."""
        return self._state

    def set_state(self, state: EnvState) -> tuple[TimeStep, Outcome]:
        """Goes on from `state`, in place of `reset`; returns the time step at which it was saved."""
        self._state, self._timestep = state, self._observe(state)
        return self.recv()

    def render(self) -> np.ndarray:
        """Returns the screens, uint8 [B, H, W, 3]."""
        frame = np.asarray(self._timestep.frame)
        return frame if frame.ndim == 4 else np.repeat(frame[..., None], 3, axis=-1)

    def close(self) -> None:
        """Does nothing: there is nothing to free."""
