"""The gaze: how the focal point starts, moves and stays within its bounds.

A focal point is (y, x) in frame pixels, int32 [2]. Where it may be: with bounds 'window', wherever
the whole focal area stays inside the frame, from h//2 to H - (h - h//2); with bounds 'fovea', wherever
its finest part does; with bounds 'point', anywhere in the frame. With the last two the area may overhang.
The paper says only that visual actions "move the center of attention at every time-step" (Sec. III); the
rest is ours.

What a visual action is, `gaze.moves` says: a step from where the gaze is, or a cell of a grid to look at wherever
the gaze was. A saccade may have a price (`price`).

All functions are for one focal point; the caller vmaps.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from foajax.config.parse import refuse
from foajax.config.schema import Config, GazeConfig
from foajax.sensors.base import Sensor
from foajax.sensors.registry import make_sensor

Shape = tuple[int, int]  # rows, columns

# (y, x) of stay, up, down, left, right; with nine actions, the diagonals too.
_STRAIGHT = [(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)]
_DIAGONAL = [(-1, -1), (-1, 1), (1, -1), (1, 1)]
DIRECTIONS = np.array(_STRAIGHT + _DIAGONAL, np.int32)
NAMES = ("stay", "up", "down", "left", "right", "up left", "up right", "down left", "down right")


def move(
    focal_point: Int[Array, "2"],
    vision_action: Int[Array, ""],
    *,
    gaze: GazeConfig,
    window: Shape,
    frame_shape: Shape,
) -> Int[Array, "2"]:
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
    if gaze.moves == "absolute":
        return _clip(jnp.asarray(targets(gaze, frame_shape))[vision_action], gaze, window, frame_shape)
    return _clip(focal_point + jnp.asarray(steps(gaze))[vision_action], gaze, window, frame_shape)


def steps(gaze: GazeConfig) -> Int[np.ndarray, "V 2"]:
    """What each visual action adds to the focal point, (y, x) in frame pixels, where moves are 'steps'."""
    directions = DIRECTIONS[1 : gaze.actions]
    return np.concatenate([DIRECTIONS[:1], *(size * directions for size in gaze.sizes)])


def targets(gaze: GazeConfig, frame_shape: Shape) -> Int[np.ndarray, "V 2"]:
    """Where each visual action looks, (y, x) in frame pixels and not yet clipped, where moves are 'absolute'.

    Cell i of n covers the pixels from i * size / n to (i + 1) * size / n; its centre is rounded down.
    """
    rows, columns = ((2 * np.arange(n) + 1) * size // (2 * n) for n, size in zip(gaze.grid, frame_shape, strict=True))
    return np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1).reshape(-1, 2).astype(np.int32)


def names(gaze: GazeConfig) -> tuple[str, ...]:
    """What the visual actions are called: "stay", "up", ...; "up 16" with several step sizes; "row 1, column 4"."""
    if gaze.moves == "absolute":
        rows, columns = gaze.grid
        return tuple(f"row {i + 1}, column {j + 1}" for i in range(rows) for j in range(columns))
    straight = NAMES[1 : gaze.actions]
    if len(gaze.sizes) == 1:
        return (NAMES[0], *straight)
    return (NAMES[0], *(f"{name} {size}" for size in gaze.sizes for name in straight))


def price(before: Int[Array, "2"], after: Int[Array, "2"], *, gaze: GazeConfig) -> Float[Array, ""]:
    """What it costs to move the focal point, in units of reward: 0 for who stays.

    `gaze.cost` times the Euclidean distance in frame pixels, or once for a move of any length. A move that the bounds
    shorten costs what is left of it.
    """
    moved = (after - before).astype(jnp.float32)
    distance = jnp.sqrt(jnp.sum(moved * moved))
    return gaze.cost * (distance if gaze.cost_per == "pixel" else (distance > 0).astype(jnp.float32))


def start(key: PRNGKeyArray, *, gaze: GazeConfig, window: Shape, frame_shape: Shape) -> Int[Array, "2"]:
    """The first focal point of an episode: the frame's centre, a given point, or any within bounds."""
    if gaze.start == "random":
        low, high = limits(gaze=gaze, window=window, frame_shape=frame_shape)
        return jax.random.randint(key, (2,), low, high + 1)
    point = np.array(frame_shape) // 2 if gaze.start == "centre" else np.array(gaze.start)
    return _clip(jnp.asarray(point), gaze, window, frame_shape)


def scripted(age: Int[Array, ""], *, gaze: GazeConfig, window: Shape, frame_shape: Shape) -> Int[Array, "2"]:
    """The focal point `age` steps into an episode: `gaze.path` point by point, over and over, clipped.

    Raises:
      ConfigError: an empty path.
    """
    if not gaze.path:
        raise refuse("gaze.path", gaze.path, "at least one [y, x]")
    return _clip(jnp.asarray(gaze.path)[age % len(gaze.path)], gaze, window, frame_shape)


def bounded(gaze: GazeConfig, sensor: Sensor) -> Shape:
    """Height and width of what has to stay inside the frame: the `window` of the functions of this module."""
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


def to_unit(point: Int[Array, "*n 2"], frame_shape: Shape) -> Float[Array, "*n 2"]:
    """Focal points in [-1, 1): -1 at the first row or column, 0 at the frame's centre (H/2, W/2)."""
    return jnp.stack([point[..., axis] / size * 2.0 - 1.0 for axis, size in enumerate(frame_shape)], -1)


def to_reach(point: Int[Array, "*n 2"], *, gaze: GazeConfig, window: Shape, frame_shape: Shape) -> Float[Array, "*n 2"]:
    """Focal points in [-1, 1]: -1 and 1 at the `limits`, 0 in an axis along which the gaze cannot move."""
    low, high = limits(gaze=gaze, window=window, frame_shape=frame_shape)
    ends = enumerate(zip(low.tolist(), high.tolist(), strict=True))
    return jnp.stack([(2 * point[..., axis] - (lo + hi)) / max(hi - lo, 1) for axis, (lo, hi) in ends], -1)


def from_unit(coordinates: Float[Array, "*n 2"], frame_shape: Shape) -> Int[Array, "*n 2"]:
    """The nearest focal points inside the frame: the inverse of `to_unit`."""
    points = [(coordinates[..., axis] + 1.0) * (size / 2) for axis, size in enumerate(frame_shape)]
    clipped = [jnp.clip(jnp.round(p), 0, size - 1) for p, size in zip(points, frame_shape, strict=True)]
    return jnp.stack(clipped, -1).astype(jnp.int32)


def _clip(point: Int[Array, "2"], gaze: GazeConfig, window: Shape, frame_shape: Shape) -> Int[Array, "2"]:
    low, high = limits(gaze=gaze, window=window, frame_shape=frame_shape)
    return jnp.clip(point, low, high).astype(jnp.int32)


def count(points: Int[np.ndarray, "n 2"], frame_shape: tuple[int, int]) -> Int[np.ndarray, "H W"]:
    """How many of the focal points (y, x) are at each pixel."""
    counts = np.zeros(frame_shape, int)
    np.add.at(counts, tuple(points.T), 1)
    return counts


def bounds(config: Config) -> tuple[np.ndarray, np.ndarray]:
    """The smallest and the largest focal point (y, x)."""
    return limits(
        gaze=config.gaze, window=bounded(config.gaze, make_sensor(config.sensor)), frame_shape=config.env.frame_shape
    )
