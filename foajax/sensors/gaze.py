"""The gaze: how the focal point starts, moves and stays within its bounds.

A focal point is (y, x) in frame pixels, int32 [2]. Where it may be: with bounds 'window', wherever
the whole focal area stays inside the frame, from h//2 to H - (h - h//2); with bounds 'fovea', wherever
its finest part does; with bounds 'point', anywhere in the frame. With the last two the area may overhang.
The paper says only that visual actions "move the center of attention at every time-step" (Sec. III); the
rest is ours.

A visual action is a step from where the gaze is or, with `gaze.moves=absolute`, a cell of a grid to look at. A
saccade may have a price (`price`).

The functions take arrays of NumPy or of JAX and give the like. With JAX they are for one focal point, and the caller
vmaps; NumPy's may have leading axes.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from foajax.config.parse import refuse
from foajax.config.schema import GazeConfig
from foajax.sensors.geometry import Shape

# (y, x) of stay, up, down, left, right; with nine actions, the diagonals too.
DIRECTIONS = np.array([(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (-1, 1), (1, -1), (1, 1)], np.int32)
NAMES = ("stay", "up", "down", "left", "right", "up left", "up right", "down left", "down right")


def move(
    focal_point: Int[Any, "*n 2"],
    vision_action: Int[Any, "*n"],
    *,
    gaze: GazeConfig,
    window: Shape,
    frame_shape: Shape,
) -> Int[Any, "*n 2"]:
    """The next focal point, clipped to its bounds.

    - moves 'steps': action 0 stays; then every direction by the smallest of `gaze.step`, by the next one, and so on.
    - moves 'absolute': the centre of a cell of `gaze.grid`, row by row (`targets`), wherever the gaze was.

    Args:
      focal_point: (y, x), frame pixels.
      vision_action: 0 <= action < gaze.num_actions.
      gaze: static, like the shapes.
      window: height and width of the focal area, or of its finest part (`bounded`).
      frame_shape: height and width of the frame.
    """
    library = vision_action.__array_namespace__()
    if gaze.moves == "absolute":
        return _clip(library.asarray(targets(gaze, frame_shape))[vision_action], gaze, window, frame_shape)
    return _clip(focal_point + library.asarray(steps(gaze))[vision_action], gaze, window, frame_shape)


def steps(gaze: GazeConfig) -> Int[np.ndarray, "V 2"]:
    """Returns what each visual action adds to the focal point, (y, x) in frame pixels, where moves are 'steps'."""
    directions = DIRECTIONS[1 : gaze.actions]
    return np.concatenate([DIRECTIONS[:1], *(size * directions for size in gaze.sizes)])


def targets(gaze: GazeConfig, frame_shape: Shape) -> Int[np.ndarray, "V 2"]:
    """Returns where each visual action looks, (y, x) in frame pixels and not yet clipped, where moves are 'absolute'.

    Cell i of n covers the pixels from i * size / n to (i + 1) * size / n; its centre is rounded down.
    """
    rows, columns = ((2 * np.arange(n) + 1) * size // (2 * n) for n, size in zip(gaze.grid, frame_shape, strict=True))
    return np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1).reshape(-1, 2).astype(np.int32)


def names(gaze: GazeConfig) -> tuple[str, ...]:
    """Names the visual actions: "stay", "up", ...; "up 16" with several step sizes; "row 1, column 4"."""
    if gaze.moves == "absolute":
        rows, columns = gaze.grid
        return tuple(f"row {i + 1}, column {j + 1}" for i in range(rows) for j in range(columns))
    straight = NAMES[1 : gaze.actions]
    if len(gaze.sizes) == 1:
        return (NAMES[0], *straight)
    return (NAMES[0], *(f"{name} {size}" for size in gaze.sizes for name in straight))


def price(before: Int[Any, "*n 2"], after: Int[Any, "*n 2"], *, gaze: GazeConfig) -> Float[Any, "*n"]:
    """Returns the price of moving the focal point, in units of reward: 0 for a gaze that stays.

    `gaze.cost` times the Euclidean distance in frame pixels, or once for a move of any length. A move that the bounds
    shorten costs what is left of it.
    """
    distance = saccade(before, after)
    return gaze.cost * (distance if gaze.cost_per == "pixel" else (distance > 0).astype(np.float32))


def saccade(before: Int[Any, "*n 2"], after: Int[Any, "*n 2"]) -> Float[Any, "*n"]:
    """How far the focal point moved: the Euclidean distance, frame pixels."""
    moved = (after - before).astype(np.float32)
    return moved.__array_namespace__().sqrt((moved * moved).sum(-1))


def start(random: Any, *, gaze: GazeConfig, window: Shape, frame_shape: Shape) -> Int[Any, "2"]:
    """The first focal point of an episode: the frame's centre, a given point, or any within bounds.

    A random one is drawn with `random`, a key of JAX's or a generator of NumPy's.
    """
    if gaze.start == "random":
        low, high = limits(gaze=gaze, window=window, frame_shape=frame_shape)
        if isinstance(random, np.random.Generator):
            return random.integers(low, high + 1, dtype=np.int32)
        import jax

        return jax.random.randint(random, (2,), low, high + 1)
    point = np.array(frame_shape) // 2 if gaze.start == "centre" else np.array(gaze.start)
    return _clip(point, gaze, window, frame_shape)


def scripted(age: Int[Any, ""], *, gaze: GazeConfig, window: Shape, frame_shape: Shape) -> Int[Any, "2"]:
    """The focal point `age` steps into an episode: `gaze.path` point by point, over and over, clipped.

    Raises:
      ConfigError: an empty path.
    """
    if not gaze.path:
        raise refuse("gaze.path", gaze.path, "at least one [y, x]")
    path = age.__array_namespace__().asarray(gaze.path)
    return _clip(path[age % len(gaze.path)], gaze, window, frame_shape)


def bounded(gaze: GazeConfig, sensor: Any) -> Shape:
    """Returns the size of what has to stay inside the frame: the `window` of the functions of this module.

    `sensor` is a `Sensor`, or the configuration of one.
    """
    return sensor.finest if gaze.bounds == "fovea" else sensor.window


def limits(*, gaze: GazeConfig, window: Shape, frame_shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    """The smallest and the largest focal point (y, x), both included.

    Raises:
      ConfigError: bounds other than 'point' and an area larger than the frame.
    """
    if gaze.bounds == "point":
        return np.zeros(2, np.int32), np.array(frame_shape, np.int32) - 1
    size = np.array(window, np.int32)
    low, high = size // 2, np.array(frame_shape, np.int32) - (size - size // 2)
    if (low > high).any():
        accepted = f"'point' where the focal area {window} exceeds {frame_shape}"
        raise refuse("gaze.bounds", gaze.bounds, accepted)
    return low, high


def to_unit(point: Int[Any, "*n 2"], frame_shape: Shape) -> Float[Any, "*n 2"]:
    """Focal points in [-1, 1): -1 at the first row or column, 0 at the frame's centre (H/2, W/2)."""
    return _stack(point[..., axis] / size * 2.0 - 1.0 for axis, size in enumerate(frame_shape))


def to_reach(point: Int[Any, "*n 2"], *, gaze: GazeConfig, window: Shape, frame_shape: Shape) -> Float[Any, "*n 2"]:
    """Focal points in [-1, 1]: -1 and 1 at the `limits`, 0 in an axis along which the gaze cannot move."""
    low, high = limits(gaze=gaze, window=window, frame_shape=frame_shape)
    ends = enumerate(zip(low.tolist(), high.tolist(), strict=True))
    return _stack((2 * point[..., axis] - (lo + hi)) / max(hi - lo, 1) for axis, (lo, hi) in ends)


def from_unit(coordinates: Float[Any, "*n 2"], frame_shape: Shape) -> Int[Any, "*n 2"]:
    """The nearest focal points inside the frame: the inverse of `to_unit`."""
    points = [(coordinates[..., axis] + 1.0) * (size / 2) for axis, size in enumerate(frame_shape)]
    clipped = [p.round().clip(0, size - 1) for p, size in zip(points, frame_shape, strict=True)]
    return _stack(clipped).astype(np.int32)


def _stack(coordinates: Iterable[Any]) -> Any:
    first, second = coordinates
    return first.__array_namespace__().stack([first, second], -1)


def _clip(point: Int[Any, "*n 2"], gaze: GazeConfig, window: Shape, frame_shape: Shape) -> Int[Any, "*n 2"]:
    low, high = limits(gaze=gaze, window=window, frame_shape=frame_shape)
    return point.clip(low, high).astype(np.int32)


def count(points: Int[np.ndarray, "n 2"], frame_shape: tuple[int, int]) -> Int[np.ndarray, "H W"]:
    """Counts the focal points (y, x) at each pixel."""
    counts = np.zeros(frame_shape, int)
    np.add.at(counts, tuple(points.T), 1)
    return counts
