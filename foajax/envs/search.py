"""Visual search: the agent has to find one letter of a scene and look at it closely to answer.

A scene is static. Its letters lie on plates (`foajax.envs.glyphs`), at random places in random cells of 20 pixels, one
to a cell. One letter is the target: with `search.target=letter`, the only T among Ls. The task `search` asks which way
its foot points. The task `detect` asks where it is: the answer "here" is right if the target lies inside the finest
ring around the focal point.

An agent that cannot read letters yet earns most by guessing at once, and then never learns to read. So training may
begin with scenes full of targets, all turned alike, in half of which one lies in the middle (`search.staircase`). After
a right answer an environment's next scene has one target fewer, after a wrong one two more. This is a weighted up-down
staircase (Kaernbach 1991). It settles where two of three answers are right, or at one target. A scene without a target
leaves it where it is.

Action 0 waits. Each decision costs `search.price`. An answer ends the episode: 1 if it is right, -1 if not; so does
the `search.max_fixations`-th decision, which counts as a wrong answer where it only waits. Full sight earns
`optimal_return`. Of four directions any answer at once is right a quarter of the time and earns -0.5 on average. With
two, or where half of the scenes have no target, an agent that sees nothing earns 0 at most.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt8

from foajax.config.parse import refuse
from foajax.config.schema import Config, SearchConfig
from foajax.envs import glyphs, scenes
from foajax.envs.tasks import Task

WAIT = 0
DIRECTIONS = ("left", "right", "up", "down")  # what the classes are called
NOT_YET = -1.0


class SearchState(NamedTuple):
    """One episode: the scene, drawn once, what is asked, and what has been done."""

    scene: UInt8[Array, "H W"]
    cue: UInt8[Array, "p p"]  # the target's letter, upright, that `cued` episodes show first
    answer: Int[Array, ""]  # the right action
    set_size: Int[Array, ""]  # letters in the scene
    targets: Int[Array, ""]  # how many of them are targets
    step: Int[Array, ""]  # of the staircase: targets that a scene of this episode would have if none were absent
    boxes: Int[Array, "k 4"]  # of the targets' plates: top, left, height, width; zeros where there are fewer
    time: Int[Array, ""]  # decisions made
    point: Int[Array, "2"]  # where the last one looked
    fixations: Int[Array, ""]  # places looked at, one after another
    on_target: Int[Array, ""]  # of them, how many lie on a target's plate
    right: Bool[Array, ""]  # whether a right answer was given
    distance: Float[Array, ""]  # from the focal point to a target's centre at the answer "here"; NOT_YET before
    overlap: Float[Array, ""]  # intersection over union of the finest ring and a target's plate then


def search(config: Config) -> Task:
    """Makes the rules of `game=search`."""
    return _task(config, here=False)


def detect(config: Config) -> Task:
    """Makes the rules of `game=detect`."""
    return _task(config, here=True)


def _task(config: Config, *, here: bool) -> Task:
    search, frame_shape = config.search, config.env.frame_shape
    cells = (frame_shape[0] // scenes.CELL) * (frame_shape[1] // scenes.CELL)
    needed = max(search.set_sizes) + search.clutter
    if needed > cells:
        accepted = f"at most {cells} letters and bars (search.clutter) together in env.frame_shape={list(frame_shape)}"
        raise refuse("search.set_sizes", search.set_sizes, accepted)
    if config.sensor.finest is None:
        raise refuse("sensor.kind", config.sensor.kind, f"rings or logpolar for game={config.game}")
    rules = partial(_advance, search, config.sensor.finest, here)
    return Task(
        num_actions=len(action_names(config)),
        frame_shape=frame_shape,
        start=partial(_start, search, frame_shape, here),
        follow=partial(_follow, search, frame_shape, here) if search.staircase else None,
        advance=rules,
        draw=partial(_draw, search),
        reads_gaze=True,
        facts=facts,
    )


def action_names(config: Config) -> tuple[str, ...]:
    """Names the natural actions, in order."""
    answers = ("here",) if config.game == "detect" else DIRECTIONS[: config.search.classes]
    return ("wait", *answers, "absent") if config.search.absent else ("wait", *answers)


def optimal_return(search: SearchConfig) -> float:
    """Computes the expected return of an agent that sees all at full resolution and looks at the target of `detect`."""
    shown = 1 if search.target == "cued" else 0  # steps before the scene
    return 1.0 - search.price * (1 + shown)


def facts(state: SearchState) -> dict[str, Array]:
    """Returns the facts about an episode that has ended."""
    return {
        "set_size": state.set_size,
        "targets": state.targets,
        "right": state.right,
        "decisions": state.time,
        "fixations": state.fixations,
        "on_target": state.on_target,
        "distance": state.distance,
        "overlap": state.overlap,
        "box": state.boxes[0],
        "answer": state.answer,
    }


def _start(
    search: SearchConfig,
    frame_shape: tuple[int, int],
    here: bool,
    key: Key[Array, ""],
    step: Int[Array, ""] | None = None,
) -> SearchState:
    most = max(search.set_sizes) if search.staircase else 1
    step = jnp.int32(most) if step is None else step
    scene = scenes.draw_scene(search, frame_shape, key, step, most)
    present, absent = (1, 2) if here else (1 + scene.turn, 1 + search.classes)
    zero = jnp.int32(0)
    return SearchState(
        scene=scene.image,
        cue=scene.cue,
        answer=jnp.where(scene.targets > 0, present, absent).astype(jnp.int32),
        set_size=scene.set_size,
        targets=scene.targets,
        step=step,
        boxes=scene.boxes,
        time=zero,
        point=jnp.full(2, -1, jnp.int32),
        fixations=zero,
        on_target=zero,
        right=jnp.bool_(False),
        distance=jnp.float32(NOT_YET),
        overlap=jnp.float32(NOT_YET),
    )


def _follow(
    search: SearchConfig, frame_shape: tuple[int, int], here: bool, before: SearchState, key: Key[Array, ""]
) -> SearchState:
    """Begins the episode after `before`, one step further on the staircase."""
    step = jnp.clip(before.step + jnp.where(before.right, -1, 2), 1, max(search.set_sizes))
    step = jnp.where(before.targets > 0, step, before.step)
    return _start(search, frame_shape, here, key, step)


def _draw(search: SearchConfig, state: SearchState) -> UInt8[Array, "H W"]:
    """Draws the scene or, at the start of a `cued` episode, the cue in the middle of an empty frame."""
    if search.target != "cued":
        return state.scene
    height, width = state.scene.shape
    corner = ((height - glyphs.PLATE) // 2, (width - glyphs.PLATE) // 2)
    empty = jnp.full_like(state.scene, scenes.BACKGROUND)
    shown = jax.lax.dynamic_update_slice(empty, jnp.maximum(state.cue, jnp.uint8(scenes.BACKGROUND)), corner)
    return jnp.where(state.time == 0, shown, state.scene)


def _advance(
    search: SearchConfig,
    fovea: tuple[int, int],
    here: bool,
    state: SearchState,
    action: Int[Array, ""],
    point: Int[Array, "2"],
) -> tuple[SearchState, Float[Array, ""], Bool[Array, ""]]:
    """Takes an action that was decided while looking at `point`; returns the next state, the reward and the end."""
    area = (point - np.array(fovea) // 2)[None], jnp.asarray([fovea])
    plates = state.boxes[:, :2], state.boxes[:, 2:]
    is_there = jnp.arange(len(state.boxes)) < state.targets
    right = action == state.answer
    pointed = right & (state.targets > 0) & here
    if here:
        right &= (state.targets == 0) | jnp.any(is_there & _inside(plates, area))
    time = state.time + 1
    is_over = (action != WAIT) | (time >= search.max_fixations)
    reward = jnp.where(is_over, jnp.where(right, 1.0, -1.0), 0.0) - search.price
    moved = jnp.any(point != state.point)
    # Whether the point itself is on a plate.
    landed = moved & jnp.any(is_there & _inside((point[None], 1), plates))
    away = jnp.linalg.norm((point[None] - plates[0] - plates[1] // 2).astype(jnp.float32), axis=-1)
    after = state._replace(
        time=time,
        point=point.astype(jnp.int32),
        fixations=state.fixations + moved,
        on_target=state.on_target + landed,
        right=right,
        distance=jnp.where(pointed, jnp.min(jnp.where(is_there, away, jnp.inf)), NOT_YET),
        overlap=jnp.where(pointed, jnp.max(jnp.where(is_there, _overlap(plates, area), 0.0)), NOT_YET),
    )
    return after, reward, is_over


Box = tuple[Any, Any]  # upper left pixel and size, (y, x) each, of one box or of several


def _inside(inner: Box, outer: Box) -> Bool[Array, "*k"]:
    """Whether a box lies wholly inside another."""
    return jnp.all((inner[0] >= outer[0]) & (inner[0] + inner[1] <= outer[0] + outer[1]), axis=-1)


def _overlap(a: Box, b: Box) -> Float[Array, "*k"]:
    """Returns the intersection over union of two boxes."""
    sides = jnp.minimum(a[0] + a[1], b[0] + b[1]) - jnp.maximum(a[0], b[0])
    common = jnp.prod(jnp.maximum(sides, 0), axis=-1)
    return common / (jnp.prod(a[1], axis=-1) + jnp.prod(b[1], axis=-1) - common)
