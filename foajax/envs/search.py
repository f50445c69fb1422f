"""Search: a scene of letters, one of which has to be found, because what is asked shows only from close up.

A scene is static. It has a number of letters on plates (`foajax.envs.glyphs`), one to a cell of 20 pixels, cells drawn
without replacement, and each somewhere in its cell. One of them is the target: with `search.target=letter`, the one T
among Ls. The task `search` asks which way its foot points. The task `detect` asks where it
is: the answer "here" is right if the target lies inside the finest ring around the focal point, so this task reads the
gaze.

Who cannot read letters yet is best off guessing at once, and who guesses never learns to read. So training may begin
with scenes full of targets, all turned alike, in half of which one lies in the middle (`search.staircase`): after a
right answer an environment's next scene has one target fewer, after a wrong one two more. This is a weighted up-down
staircase (Kaernbach 1991), which settles where two of three answers are right, or at one target.

Action 0 waits. Each decision costs `search.price`. An answer ends the episode: 1 if it is right, -1 if not; so does
the `search.max_fixations`-th decision, which counts as a wrong answer where it only waits. Full sight earns
`optimal_return`. One answer at once, whichever, is right a quarter of the time and earns -0.5 on average; with two
classes, or where half of the scenes have no target, nobody who sees nothing can earn more than 0.
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
from foajax.envs import glyphs
from foajax.envs.tasks import Task

CELL = 20  # pixels of a cell's side
WAIT = 0
BACKGROUND = 32  # gray level
DIRECTIONS = ("left", "right", "up", "down")  # what the classes are called
_TURNS = np.array([3, 1, 2, 0])  # turns to the left by 90 degrees that make a foot point there
_PLAIN = (88.0, 128.0)  # gray levels of plates
_BRIGHT = (184.0, 208.0)
_CLUTTER = (4, 10)  # pixels of a bar's sides
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
    """The rules of `game=search`."""
    return _task(config, here=False)


def detect(config: Config) -> Task:
    """The rules of `game=detect`."""
    return _task(config, here=True)


def _task(config: Config, *, here: bool) -> Task:
    search, frame_shape = config.search, config.env.frame_shape
    cells = (frame_shape[0] // CELL) * (frame_shape[1] // CELL)
    needed = max(search.set_sizes) + search.clutter
    if needed > cells:
        accepted = f"at most {cells} letters and search.clutter together in env.frame_shape={list(frame_shape)}"
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
    """The natural actions, in order."""
    answers = ("here",) if config.game == "detect" else DIRECTIONS[: config.search.classes]
    return ("wait", *answers, "absent") if config.search.absent else ("wait", *answers)


def optimal_return(search: SearchConfig) -> float:
    """The expected return of who sees the whole scene at full resolution, and in `detect` looks at the target."""
    shown = 1 if search.target == "cued" else 0  # steps before the scene
    return 1.0 - search.price * (1 + shown)


def facts(state: SearchState) -> dict[str, Array]:
    """What there is to know about an episode when it has ended."""
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
    count = max(search.set_sizes)
    most = count if search.staircase else 1
    step = jnp.int32(most) if step is None else step
    place_key, scene_key, letter_key, noise_key = jax.random.split(key, 4)
    # One draw for all that is uniform: many small ones would take most of an episode's time.
    size, presence, asked, middle = jax.random.uniform(scene_key, (4,))
    set_size = jnp.asarray(search.set_sizes, jnp.int32)[_whole(size, len(search.set_sizes))]
    targets = jnp.minimum(step, set_size)
    targets = jnp.where(presence < 0.5, 0, targets) if search.absent else targets
    asked = _whole(asked, search.classes)
    corners = _places(place_key, frame_shape, count + search.clutter, (targets > 1) & (middle < 0.5))
    is_target = jnp.arange(count) < targets
    draws = Draws(*jax.random.uniform(letter_key, (len(Draws._fields), count)))
    patches, cue = _letters(search, draws, asked, is_target)
    scene = jnp.full(frame_shape, BACKGROUND, jnp.uint8)
    scene = _paste(scene, patches, corners[:count], jnp.arange(count) < set_size)
    if search.clutter:
        bars = _bars(jax.random.fold_in(scene_key, 1), search.clutter)
        scene = _paste(scene, bars, corners[count:], jnp.ones(search.clutter, bool))
    answers = 1 if here else search.classes
    boxes = jnp.concatenate([corners, jnp.full_like(corners, glyphs.PLATE)], axis=-1)[:most]
    zero = jnp.int32(0)
    return SearchState(
        scene=_noisy(noise_key, scene, search.noise),
        cue=cue,
        answer=jnp.where(targets > 0, 1 if here else 1 + asked, 1 + answers).astype(jnp.int32),
        set_size=set_size,
        targets=targets,
        step=step,
        boxes=jnp.where(jnp.arange(len(boxes))[:, None] < targets, boxes, 0),
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
    """The episode after `before`, one step further on the staircase."""
    step = jnp.clip(before.step + jnp.where(before.right, -1, 2), 1, max(search.set_sizes))
    return _start(search, frame_shape, here, key, step)


def _whole(share: Float[Array, "*n"], number: int) -> Int[Array, "*n"]:
    """0 .. number - 1, equally likely where `share` is uniform in [0, 1)."""
    return jnp.minimum((share * number).astype(jnp.int32), number - 1)


def _places(
    key: Key[Array, ""], frame_shape: tuple[int, int], count: int, in_the_middle: Bool[Array, ""]
) -> Int[Array, "n 2"]:
    """Upper left pixels of plates, one to a cell; the cells lie in the middle of the frame, and maybe the first one
    in the middle of the cells."""
    cell_key, jitter_key = jax.random.split(key)
    rows, columns = frame_shape[0] // CELL, frame_shape[1] // CELL
    middle = (rows - 1) // 2 * columns + (columns - 1) // 2
    order = jax.random.uniform(cell_key, (rows * columns,))
    cells = jax.lax.top_k(order.at[middle].add(in_the_middle), count)[1]
    margin = jnp.array([frame_shape[0] % CELL, frame_shape[1] % CELL], jnp.int32) // 2
    jitter = jax.random.randint(jitter_key, (count, 2), 0, CELL - glyphs.PLATE + 1)
    return margin[None] + CELL * jnp.stack([cells // columns, cells % columns], -1) + jitter


class Draws(NamedTuple):
    """What is random about each letter: numbers in [0, 1)."""

    letter: Float[Array, "n"]
    dim: Float[Array, "n"]
    turn: Float[Array, "n"]
    gray: Float[Array, "n"]
    contrast: Float[Array, "n"]
    sign: Float[Array, "n"]


def _letters(
    search: SearchConfig, each: Draws, asked: Int[Array, ""], is_target: Bool[Array, "n"]
) -> tuple[UInt8[Array, "n p p"], UInt8[Array, "p p"]]:
    """The plates of a scene, and the cue."""
    target, letters, is_bright = _what(search, each, is_target)
    # A letter that is the target's, too, is turned as the target may be.
    among = jnp.asarray(_TURNS[: search.classes])[_whole(each.turn, search.classes)]
    turns = jnp.where(letters == target, among, _whole(each.turn, 4))
    turns = jnp.where(is_target, jnp.asarray(_TURNS)[asked], turns)
    masks = jnp.asarray(glyphs.masks())
    patches = _plates(search, each, masks[letters, turns], is_bright)
    return patches, (255.0 * masks[target, 0]).astype(jnp.uint8)


def _what(
    search: SearchConfig, each: Draws, is_target: Bool[Array, "n"]
) -> tuple[Int[Array, ""], Int[Array, "n"], Bool[Array, "n"]]:
    """The target's letter, each letter, and which plates are bright."""
    target, others = jnp.int32(0), jnp.ones_like(is_target, jnp.int32)  # a T among Ls
    if search.target == "cued":
        kinds = len(glyphs.LETTERS)
        target = _whole(each.letter[0], kinds)  # the first letter's own draw is not needed
        others = (target + 1 + _whole(each.dim, kinds - 1)) % kinds
    is_bright = is_target & (search.target == "feature")
    if search.target == "conjunction":  # a bright T among bright Ls and dim Ts
        is_dim = ~is_target & (each.dim < 0.5)
        others, is_bright = jnp.where(is_dim, target, others), ~is_dim
    return target, jnp.where(is_target, target, others), is_bright


def _plates(
    search: SearchConfig, each: Draws, masks: Float[Array, "n p p"], is_bright: Bool[Array, "n"]
) -> UInt8[Array, "n p p"]:
    """Letters on their plates, in random gray, contrast and sign."""
    low, high = (jnp.where(is_bright, bright, plain) for plain, bright in zip(_PLAIN, _BRIGHT, strict=True))
    gray = jnp.round(low + (high - low) * each.gray)
    contrast = search.contrast[0] + (search.contrast[1] - search.contrast[0]) * each.contrast
    # As much darker as brighter, so that the mean stays the plate's.
    depth = jnp.where(each.sign < 0.5, -1, 1) * jnp.round(contrast * jnp.minimum(gray, 255.0 - gray))
    letters = masks * jnp.asarray(glyphs.checkerboard())[None]
    return jnp.round(gray[:, None, None] + depth[:, None, None] * letters).astype(jnp.uint8)


def _bars(key: Key[Array, ""], count: int) -> UInt8[Array, "n p p"]:
    """Clutter: a bar each, upright or lying, in random gray."""
    low, high = _PLAIN
    share, turn = jax.random.uniform(key, (2, count, 1, 1))
    place = np.abs(np.arange(glyphs.PLATE) - (glyphs.PLATE - 1) / 2)
    thick, long = (place < side / 2 for side in _CLUTTER)
    inside = jnp.where(turn < 0.5, np.outer(thick, long)[None], np.outer(long, thick)[None])
    return jnp.where(inside, low + (high - low) * share, BACKGROUND).astype(jnp.uint8)


def _paste(
    scene: UInt8[Array, "H W"], patches: UInt8[Array, "n p p"], corners: Int[Array, "n 2"], shown: Bool[Array, "n"]
) -> UInt8[Array, "H W"]:
    """The scene with the patches that are shown."""

    def paste(scene: Array, item: tuple[Array, Array, Array]) -> tuple[Array, None]:
        patch, corner, is_shown = item
        under = jax.lax.dynamic_slice(scene, corner, patch.shape)
        return jax.lax.dynamic_update_slice(scene, jnp.where(is_shown, patch, under), corner), None

    return jax.lax.scan(paste, scene, (patches, corners, shown))[0]


def _noisy(key: Key[Array, ""], scene: UInt8[Array, "H W"], deviation: float) -> UInt8[Array, "H W"]:
    """The scene with uniform noise of a standard deviation in gray levels."""
    if not deviation:
        return scene
    noise = (jax.random.bits(key, scene.shape, jnp.uint8).astype(jnp.float32) / 255 - 0.5) * (12**0.5 * deviation)
    return jnp.clip(jnp.round(scene + noise), 0, 255).astype(jnp.uint8)


def _draw(search: SearchConfig, state: SearchState) -> UInt8[Array, "H W"]:
    """The scene or, at the start of a `cued` episode, the cue in the middle of an empty frame."""
    if search.target != "cued":
        return state.scene
    height, width = state.scene.shape
    corner = ((height - glyphs.PLATE) // 2, (width - glyphs.PLATE) // 2)
    empty = jnp.full_like(state.scene, BACKGROUND)
    shown = jax.lax.dynamic_update_slice(empty, jnp.maximum(state.cue, jnp.uint8(BACKGROUND)), corner)
    return jnp.where(state.time == 0, shown, state.scene)


def _advance(
    search: SearchConfig,
    fovea: tuple[int, int],
    here: bool,
    state: SearchState,
    action: Int[Array, ""],
    point: Int[Array, "2"],
) -> tuple[SearchState, Float[Array, ""], Bool[Array, ""]]:
    """An action decided upon what was seen with the focal point at `point`."""
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
    """Intersection over union of two boxes."""
    sides = jnp.minimum(a[0] + a[1], b[0] + b[1]) - jnp.maximum(a[0], b[0])
    common = jnp.prod(jnp.maximum(sides, 0), axis=-1)
    return common / (jnp.prod(a[1], axis=-1) + jnp.prod(b[1], axis=-1) - common)
