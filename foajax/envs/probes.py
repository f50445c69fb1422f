"""Probe environments: tiny tasks with exactly known values, each of which tests one part of the agent.

An agent that cannot learn `constant` has a broken value loss; `observation`, broken inputs; `delay`,
broken discounting; `action`, a broken policy gradient; `match`, inputs and policy gradient together;
`memory`, a broken recurrent core; `gaze`, a broken vision head. The game is called `probe:<name>`.

A cue is a white half of the frame, left or right of the centre, for cue 0 or 1: it survives any
normalisation, and a window around the centre shows it. Rewards lie in [-1, 1].
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, UInt8

from foajax.envs.seek import SIZE, draw_object
from foajax.envs.tasks import Task

MEMORY_LENGTH = 4
GAZE_LENGTH = 16


class ProbeState(NamedTuple):
    """The state of every probe."""

    cue: Int[Array, ""]  # 0 or 1, drawn when the episode begins
    time: Int[Array, ""]  # steps taken


Reward = Callable[[ProbeState, Int[Array, ""]], Float[Array, ""]]
Draw = Callable[[tuple[int, int], ProbeState], UInt8[Array, "H W"]]


def constant(frame_shape: tuple[int, int]) -> Task:
    """One action, one step, reward 1. Value 1."""
    return _task(frame_shape, num_actions=1, length=1, reward=lambda s, a: jnp.float32(1), draw=_black)


def observation(frame_shape: tuple[int, int]) -> Task:
    """One action, one step; reward, and value, -1 where the left half is white, 1 where the right is."""
    return _task(frame_shape, num_actions=1, length=1, reward=lambda s, a: 2.0 * s.cue - 1, draw=_cue)


def delay(frame_shape: tuple[int, int]) -> Task:
    """One action, two steps: left half white and reward 0, right half white and reward 1. Values gamma, 1."""

    def draw(shape: tuple[int, int], state: ProbeState) -> UInt8[Array, "H W"]:
        return _half(shape, state.time)

    return _task(frame_shape, num_actions=1, length=2, reward=lambda s, a: 1.0 * (s.time == 1), draw=draw)


def action(frame_shape: tuple[int, int]) -> Task:
    """Two actions, one step; action 1 earns 1, action 0 costs 1. Optimal value 1."""
    return _task(frame_shape, num_actions=2, length=1, reward=lambda s, a: 2.0 * a - 1, draw=_black)


def match(frame_shape: tuple[int, int]) -> Task:
    """Two actions, one step; 1 for the action that equals the cue, else -1. Optimal value 1, blind 0."""
    return _task(frame_shape, num_actions=2, length=1, reward=_matches, draw=_cue)


def memory(frame_shape: tuple[int, int]) -> Task:
    """`match`, but the cue shows at time 0 alone, and the action at time 3 alone is scored.

    Optimal value gamma^(3 - time), return 1; without memory both are 0. A core that is told the last action needs
    none: actions can carry the cue on (`network.last_actions=false`).
    """

    def reward(state: ProbeState, chosen: Int[Array, ""]) -> Float[Array, ""]:
        return jnp.where(state.time == MEMORY_LENGTH - 1, _matches(state, chosen), 0.0)

    def draw(shape: tuple[int, int], state: ProbeState) -> UInt8[Array, "H W"]:
        return jnp.where(state.time == 0, _cue(shape, state), _black(shape, state))

    return _task(frame_shape, num_actions=2, length=MEMORY_LENGTH, reward=reward, draw=draw)


def gaze(frame_shape: tuple[int, int]) -> Task:
    """`match` at each of 16 steps, but the cue is a striped 8x8 patch well to the left of the centre.

    Its kind (`seek.draw_object`) is lost in any mean over an even block. With the patch in view from
    the start the optimal return is 16, the value at time t the sum of gamma^k over k < 16 - t. A gaze
    that needs n moves to bring it into view can earn 16 - n on average, one that never does 0. A core that is
    told the last reward needs no look: a guess tells it the cue (`network.last_reward=false`). In an 80x80
    frame the patch covers rows 36-43 and columns 10-17.
    """

    def draw(shape: tuple[int, int], state: ProbeState) -> UInt8[Array, "H W"]:
        return draw_object(shape, jnp.asarray([(shape[0] - SIZE) // 2, shape[1] // 8]), state.cue)

    return _task(frame_shape, num_actions=2, length=GAZE_LENGTH, reward=_matches, draw=draw)


PROBES: dict[str, Callable[[tuple[int, int]], Task]] = {
    probe.__name__: probe for probe in (constant, observation, delay, action, match, memory, gaze)
}


def _task(frame_shape: tuple[int, int], *, num_actions: int, length: int, reward: Reward, draw: Draw) -> Task:
    def start(key: Key[Array, ""]) -> ProbeState:
        return ProbeState(cue=jax.random.randint(key, (), 0, 2), time=jnp.int32(0))

    def advance(state: ProbeState, chosen: Int[Array, ""]) -> tuple[ProbeState, Float[Array, ""], Bool[Array, ""]]:
        after = state._replace(time=state.time + 1)
        return after, reward(state, chosen), after.time >= length

    return Task(
        num_actions=num_actions,
        frame_shape=frame_shape,
        start=start,
        advance=advance,
        draw=partial(draw, frame_shape),
    )


def _matches(state: ProbeState, chosen: Int[Array, ""]) -> Float[Array, ""]:
    return jnp.where(chosen == state.cue, 1.0, -1.0)


def _half(frame_shape: tuple[int, int], right: Int[Array, ""]) -> UInt8[Array, "H W"]:
    is_right = jnp.arange(frame_shape[1]) >= frame_shape[1] // 2
    row = jnp.where(is_right == (right > 0), 255, 0).astype(jnp.uint8)
    return jnp.broadcast_to(row, frame_shape)


def _cue(frame_shape: tuple[int, int], state: ProbeState) -> UInt8[Array, "H W"]:
    return _half(frame_shape, state.cue)


def _black(frame_shape: tuple[int, int], state: ProbeState) -> UInt8[Array, "H W"]:
    return jnp.zeros(frame_shape, jnp.uint8)
