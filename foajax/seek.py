"""Seek: a task of our own in which the gaze has to move.

One object at a time, 8x8 pixels on black, lies somewhere in the frame for 16 steps; then the next
one appears elsewhere; six of them make an episode. An object is to be *taken* if it is striped
horizontally and *left* if it is striped vertically. The stripes are one pixel wide, so that a mean
over any block of even sides shows where the object is and never what it is: that takes full
resolution, a fovea on the object. Objects lie at multiples of 4 pixels; a gaze that moves by 4 or
8 keeps the blocks of a ring aligned with them.

The eye gets time to travel: only in an object's last 8 steps is the natural action scored, with
1/8 if it suits the object and -1/8 if not.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, UInt8

from foajax.jax_envs import Task

LEAVE, TAKE = 0, 1  # the natural actions, and the kinds of objects that they suit
OBJECTS = 6  # an episode
LIFETIME = 16  # steps that an object stays
SCORED = 8  # of them, the last, are scored
SIZE = 8  # pixels of an object's side
GRID = 4  # pixels between the places where an object may lie


class SeekState(NamedTuple):
    """One episode: the objects, drawn when it begins, and the time."""

    corner: Int[Array, "objects 2"]  # (y, x) of the upper left pixel
    kind: Int[Array, "objects"]  # LEAVE or TAKE
    time: Int[Array, ""]  # steps taken, 0 .. OBJECTS * LIFETIME


def task(frame_shape: tuple[int, int]) -> Task:
    """The rules, on frames of `frame_shape` (height, width)."""
    return Task(
        num_actions=2,
        frame_shape=frame_shape,
        start=partial(_start, frame_shape),
        advance=_advance,
        draw=partial(_draw, frame_shape),
    )


def optimal_return() -> float:
    """The return of who sees every object's stripes from its 8th step on: one point an object."""
    return float(OBJECTS)


def random_return() -> float:
    """The expected return of who does not see the stripes, whatever the policy: right half of the time."""
    return 0.0


def current(state: SeekState) -> Int[Array, ""]:
    """Index of the object in the frame."""
    return jnp.minimum(state.time // LIFETIME, OBJECTS - 1)


def draw_object(frame_shape: tuple[int, int], corner: Int[Array, "2"], kind: Int[Array, ""]) -> UInt8[Array, "H W"]:
    """A black frame with one object: 255 and 0 in stripes, horizontal for TAKE, vertical for LEAVE."""
    y = jnp.arange(frame_shape[0])[:, None] - corner[0]
    x = jnp.arange(frame_shape[1])[None, :] - corner[1]
    inside = (y >= 0) & (y < SIZE) & (x >= 0) & (x < SIZE)
    bright = jnp.where(kind == TAKE, y, x) % 2 == 0
    return jnp.where(inside & bright, 255, 0).astype(jnp.uint8)


def _start(frame_shape: tuple[int, int], key: Key[Array, ""]) -> SeekState:
    key_corner, key_kind = jax.random.split(key)
    places = jnp.asarray([(side - SIZE) // GRID + 1 for side in frame_shape])
    return SeekState(
        corner=GRID * jax.random.randint(key_corner, (OBJECTS, 2), 0, places),
        kind=jax.random.randint(key_kind, (OBJECTS,), 0, 2),
        time=jnp.int32(0),
    )


def _advance(state: SeekState, action: Int[Array, ""]) -> tuple[SeekState, Float[Array, ""], Bool[Array, ""]]:
    right = action == state.kind[current(state)]
    scored = state.time % LIFETIME >= LIFETIME - SCORED
    reward = jnp.where(scored, jnp.where(right, 1 / SCORED, -1 / SCORED), 0.0)
    time = state.time + 1
    return state._replace(time=time), reward, time >= OBJECTS * LIFETIME


def _draw(frame_shape: tuple[int, int], state: SeekState) -> UInt8[Array, "H W"]:
    index = current(state)
    return draw_object(frame_shape, state.corner[index], state.kind[index])
