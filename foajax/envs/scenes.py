"""The scenes of visual search: letters on plates, one to a cell, and what clutters them (`foajax.envs.search`)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt8

from foajax.config.schema import SearchConfig
from foajax.envs import glyphs

CELL = 20  # pixels of a cell's side
BACKGROUND = 32  # gray level
_TURNS = np.array([3, 1, 2, 0])  # turns to the left by 90 degrees that make a foot point there
_PLAIN = (88.0, 128.0)  # gray levels of plates
_BRIGHT = (184.0, 208.0)
_CLUTTER = (4, 10)  # pixels of a bar's sides


class Scene(NamedTuple):
    """What a scene shows, and what there is to find in it."""

    image: UInt8[Array, "H W"]
    cue: UInt8[Array, "p p"]  # the target's letter, upright
    turn: Int[Array, ""]  # which way the targets point, of `search.classes`
    set_size: Int[Array, ""]  # letters in the scene
    targets: Int[Array, ""]  # how many of them are targets
    boxes: Int[Array, "k 4"]  # of the targets' plates: top, left, height, width; zeros where there are fewer


def draw_scene(
    search: SearchConfig, frame_shape: tuple[int, int], key: Key[Array, ""], targets: Int[Array, ""], most: int
) -> Scene:
    """Draws a scene with `targets` targets, at most `most`; with `search.absent` half of the scenes have none."""
    count = max(search.set_sizes)
    place_key, scene_key, letter_key, noise_key = jax.random.split(key, 4)
    # One draw for all that is uniform: many small ones would take most of an episode's time.
    size, presence, asked, middle = jax.random.uniform(scene_key, (4,))
    set_size = jnp.asarray(search.set_sizes, jnp.int32)[_whole(size, len(search.set_sizes))]
    targets = jnp.minimum(targets, set_size)
    targets = jnp.where(presence < 0.5, 0, targets) if search.absent else targets
    turn = _whole(asked, search.classes)
    corners = _places(place_key, frame_shape, count + search.clutter, (targets > 1) & (middle < 0.5))
    draws = Draws(*jax.random.uniform(letter_key, (len(Draws._fields), count)))
    patches, cue = _letters(search, draws, turn, jnp.arange(count) < targets)
    image = jnp.full(frame_shape, BACKGROUND, jnp.uint8)
    image = _paste(image, patches, corners[:count], jnp.arange(count) < set_size)
    if search.clutter:
        bars = _bars(jax.random.fold_in(scene_key, 1), search.clutter)
        image = _paste(image, bars, corners[count:], jnp.ones(search.clutter, bool))
    boxes = jnp.concatenate([corners, jnp.full_like(corners, glyphs.PLATE)], axis=-1)[:most]
    return Scene(
        image=_noisy(noise_key, image, search.noise),
        cue=cue,
        turn=turn,
        set_size=set_size,
        targets=targets,
        boxes=jnp.where(jnp.arange(len(boxes))[:, None] < targets, boxes, 0),
    )


def _whole(share: Float[Array, "*n"], number: int) -> Int[Array, "*n"]:
    """Turns uniform numbers in [0, 1) into integers 0 .. number - 1, equally likely."""
    return jnp.minimum((share * number).astype(jnp.int32), number - 1)


def _places(
    key: Key[Array, ""], frame_shape: tuple[int, int], count: int, in_the_middle: Bool[Array, ""]
) -> Int[Array, "n 2"]:
    """Draws upper left pixels of plates, one per cell. With `in_the_middle` the first lies in the middle cell."""
    cell_key, jitter_key = jax.random.split(key)
    rows, columns = frame_shape[0] // CELL, frame_shape[1] // CELL
    middle = (rows - 1) // 2 * columns + (columns - 1) // 2
    order = jax.random.uniform(cell_key, (rows * columns,))
    cells = jax.lax.top_k(order.at[middle].add(in_the_middle), count)[1]
    margin = jnp.array([frame_shape[0] % CELL, frame_shape[1] % CELL], jnp.int32) // 2
    jitter = jax.random.randint(jitter_key, (count, 2), 0, CELL - glyphs.PLATE + 1)
    return margin[None] + CELL * jnp.stack([cells // columns, cells % columns], -1) + jitter


class Draws(NamedTuple):
    """The random numbers in [0, 1) for each letter."""

    letter: Float[Array, "n"]
    dim: Float[Array, "n"]
    turn: Float[Array, "n"]
    gray: Float[Array, "n"]
    contrast: Float[Array, "n"]
    sign: Float[Array, "n"]


def _letters(
    search: SearchConfig, each: Draws, asked: Int[Array, ""], is_target: Bool[Array, "n"]
) -> tuple[UInt8[Array, "n p p"], UInt8[Array, "p p"]]:
    """Draws the plates with their letters, and the cue."""
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
    """Chooses the target's letter, each letter, and which plates are bright."""
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
    """Draws letters on plates, in random gray, contrast and sign."""
    low, high = (jnp.where(is_bright, bright, plain) for plain, bright in zip(_PLAIN, _BRIGHT, strict=True))
    gray = jnp.round(low + (high - low) * each.gray)
    contrast = search.contrast[0] + (search.contrast[1] - search.contrast[0]) * each.contrast
    # As much darker as brighter, so that the mean stays the plate's.
    depth = jnp.where(each.sign < 0.5, -1, 1) * jnp.round(contrast * jnp.minimum(gray, 255.0 - gray))
    letters = masks * jnp.asarray(glyphs.checkerboard())[None]
    return jnp.round(gray[:, None, None] + depth[:, None, None] * letters).astype(jnp.uint8)


def _bars(key: Key[Array, ""], count: int) -> UInt8[Array, "n p p"]:
    """Draws bars as clutter, upright or lying, in random gray."""
    low, high = _PLAIN
    share, turn = jax.random.uniform(key, (2, count, 1, 1))
    place = np.abs(np.arange(glyphs.PLATE) - (glyphs.PLATE - 1) / 2)
    thick, long = (place < side / 2 for side in _CLUTTER)
    inside = jnp.where(turn < 0.5, np.outer(thick, long)[None], np.outer(long, thick)[None])
    return jnp.where(inside, low + (high - low) * share, BACKGROUND).astype(jnp.uint8)


def _paste(
    scene: UInt8[Array, "H W"], patches: UInt8[Array, "n p p"], corners: Int[Array, "n 2"], shown: Bool[Array, "n"]
) -> UInt8[Array, "H W"]:
    """Pastes the patches that are shown into the scene."""

    def paste(scene: Array, item: tuple[Array, Array, Array]) -> tuple[Array, None]:
        patch, corner, is_shown = item
        under = jax.lax.dynamic_slice(scene, corner, patch.shape)
        return jax.lax.dynamic_update_slice(scene, jnp.where(is_shown, patch, under), corner), None

    return jax.lax.scan(paste, scene, (patches, corners, shown))[0]


def _noisy(key: Key[Array, ""], scene: UInt8[Array, "H W"], deviation: float) -> UInt8[Array, "H W"]:
    """Adds uniform noise of a standard deviation in gray levels."""
    if not deviation:
        return scene
    noise = (jax.random.bits(key, scene.shape, jnp.uint8).astype(jnp.float32) / 255 - 0.5) * (12**0.5 * deviation)
    return jnp.clip(jnp.round(scene + noise), 0, 255).astype(jnp.uint8)
