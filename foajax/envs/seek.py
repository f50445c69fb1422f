"""Seek: a task of our own in which the gaze has to move.

One object, 8x8 pixels on black, starts at the centre and wanders over the frame, 2 pixels a step.
It is striped horizontally where it should be *taken* and vertically where it should be *left*;
every 8 steps a coin decides anew which, and the object takes a new heading. Each step the natural
action earns 1/8 if it suits the stripes and -1/8 if not; after 96 steps the episode ends.

The stripes are one pixel wide and lie on even pixels, so that the mean of a block of even sides,
on even pixels too, shows where the object is and never what it is: that takes full resolution, a
fovea on the object. (A gaze that moves by an even number of pixels keeps a ring's blocks there.)
A greedy 16x16 fovea that moves 4 or 8 pixels a step never loses the object, and can earn the 12
points of an agent that sees the whole frame. Frozen at the centre it sees the stripes 16% of the
time, which with a memory of the last steps is worth 2.5 points; moving at random is worth about 3.
All this holds without the last reward (`network.last_reward=false`, as in `experiment=seek`): it
tells what the object was a step ago, which is worth 10.5 points to an agent that sees nothing.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, UInt8

from foajax.envs.tasks import Task

LEAVE, TAKE = 0, 1  # the natural actions, and the kinds of stripes that they suit
LEGS = 12  # an episode
LEG = 8  # steps between two draws of kind and heading
SIZE = 8  # pixels of the object's side
SPEED = 2  # pixels a step, along an axis or, diagonally, along both
HEADINGS = ((-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1))


class SeekState(NamedTuple):
    """One episode, drawn as a whole when it begins, and the time in it."""

    path: Int[Array, "steps+1 2"]  # (y, x) of the object's upper left pixel at each time
    kind: Int[Array, "legs"]  # LEAVE or TAKE
    time: Int[Array, ""]  # steps taken, 0 .. LEGS * LEG


def task(frame_shape: tuple[int, int]) -> Task:
    """Makes the rules, on frames of `frame_shape` (height, width)."""
    return Task(
        num_actions=2,
        frame_shape=frame_shape,
        start=partial(_start, frame_shape),
        advance=_advance,
        draw=lambda state: draw_object(frame_shape, state.path[state.time], current_kind(state)),
    )


def current_kind(state: SeekState) -> Int[Array, ""]:
    """Returns the kind of the stripes, which is the right action: LEAVE or TAKE."""
    return state.kind[jnp.minimum(state.time // LEG, LEGS - 1)]


def draw_object(frame_shape: tuple[int, int], corner: Int[Array, "2"], kind: Int[Array, ""]) -> UInt8[Array, "H W"]:
    """Draws one object on black: 255 and 0 in stripes, horizontal for TAKE, vertical for LEAVE."""
    y = jnp.arange(frame_shape[0])[:, None] - corner[0]
    x = jnp.arange(frame_shape[1])[None, :] - corner[1]
    inside = (y >= 0) & (y < SIZE) & (x >= 0) & (x < SIZE)
    bright = jnp.where(kind == TAKE, y, x) % 2 == 0
    return jnp.where(inside & bright, 255, 0).astype(jnp.uint8)


def _start(frame_shape: tuple[int, int], key: Key[Array, ""]) -> SeekState:
    key_heading, key_kind = jax.random.split(key)
    heading = jnp.asarray(HEADINGS)[jax.random.randint(key_heading, (LEGS,), 0, len(HEADINGS))]
    moves = jnp.repeat(SPEED * heading, LEG, axis=0)
    moved = jnp.concatenate([jnp.zeros((1, 2), jnp.int32), jnp.cumsum(moves, axis=0)])
    # The path of a ball that bounces is that of one that does not, folded at the borders; all even.
    last = 2 * ((jnp.asarray([frame_shape]) - SIZE) // 2)
    unfolded = last // 4 * 2 + moved
    return SeekState(
        path=last - jnp.abs(unfolded % jnp.maximum(2 * last, 1) - last),
        kind=jax.random.randint(key_kind, (LEGS,), 0, 2),
        time=jnp.int32(0),
    )


def _advance(state: SeekState, action: Int[Array, ""]) -> tuple[SeekState, Float[Array, ""], Bool[Array, ""]]:
    reward = jnp.where(action == current_kind(state), 1 / LEG, -1 / LEG)
    time = state.time + 1
    return state._replace(time=time), reward, time >= LEGS * LEG
