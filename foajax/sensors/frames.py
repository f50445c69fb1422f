"""From a screen to a normalised frame: crop, 2x2 mean, running statistics.

Pure functions on one frame; the caller vmaps. A frame is float32 [H, W] or, in colour, [H, W, 3] in [0, 1]: a
screen's 0..255 divided by 255.
"""

from __future__ import annotations

import math
from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt8

from foajax.config.parse import refuse
from foajax.types import FrameStatistics

DECAY = 0.9999  # of the running statistics, per frame
PIXEL_DECAY = 0.99999  # where each pixel has a mean of its own, which takes more frames to know
SMALLEST_STD = 1e-3  # a quarter of a gray level: frames of one gray have a deviation of rounding errors alone
CROPPED = 160  # rows kept of an Atari screen


def to_frame(screen: UInt8[Array, "h w *C"], crop_top: int | None) -> Float[Array, "H W *C"]:
    """Turns a screen in 0..255, gray or in colour, into the frame that a sensor looks at, in [0, 1].

    With `crop_top` the screen is Atari's and the frame 80x80 (`crop_and_halve`); with None they have the same size.
    """
    if crop_top is None:
        return screen.astype(jnp.float32) * jnp.float32(1 / 255)
    return crop_and_halve(screen, crop_top)


def crop_and_halve(screen: UInt8[Array, "210 160 *C"], crop_top: int) -> Float[Array, "80 80 *C"]:
    """Mean of each 2x2 block of the rows crop_top .. crop_top + 159 of a screen in 0..255, as a frame in [0, 1].

    The sum of four pixels is exact: `round(1020 * frame)` gives it back.

    Raises:
      ConfigError: the crop leaves the screen; `crop_top` is from 0 to 50.
    """
    if not 0 <= crop_top <= screen.shape[0] - CROPPED:
        raise refuse("crop_top", crop_top, f"a row from 0 to {screen.shape[0] - CROPPED}")
    # Strided slices of 16-bit integers: XLA on the CPU turns a reshape with a sum, reduce_window or
    # a product with a pooling matrix into code that is 5 to 40 times slower.
    kept = screen[crop_top : crop_top + CROPPED].astype(jnp.uint16)
    rows = kept[0::2] + kept[1::2]
    return (rows[:, 0::2] + rows[:, 1::2]).astype(jnp.float32) * jnp.float32(1 / 1020)


def frame_statistics(frame: Float[Array, "H W *C"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Mean and (population) standard deviation of one frame's pixels."""
    mean = jnp.mean(frame)
    return mean, jnp.sqrt(jnp.mean(jnp.square(frame - mean)))


def pixel_statistics(
    frame: Float[Array, "H W *C"], statistics: FrameStatistics
) -> tuple[Float[Array, "H W *C"], Float[Array, ""]]:
    """Returns one frame's part in per-pixel statistics: the frame, and its deviation from the mean so far.

    While nothing has been seen, it is the deviation from the frame's own mean.
    """
    mean, _ = _corrected(statistics, frame)
    return frame, jnp.sqrt(jnp.mean(jnp.square(frame - mean)))


def initial_statistics(mean_shape: tuple[int, ...] = ()) -> FrameStatistics:
    """Running statistics that have seen nothing: all zeros."""
    zero = jnp.zeros((), jnp.float32)
    return FrameStatistics(mean=jnp.zeros(mean_shape, jnp.float32), std=zero, weight=zero)


def update_statistics(
    statistics: FrameStatistics,
    frame_mean: Float[Array, "*mean"],
    frame_std: Float[Array, ""],
    count: Int[Array, ""] | int,
) -> FrameStatistics:
    """Takes `count` frames into the running statistics at once, each as the average of all of them.

    One frame at a time, `mean <- DECAY mean + (1 - DECAY) frame_mean`; n times that is
    `mean <- DECAY^n mean + (1 - DECAY^n) average`, and the order of a batch's frames has no influence. The
    same for `std` and, with 1 as the average, for `weight`.

    Args:
      statistics: what has been seen so far.
      frame_mean, frame_std: averages of what `frame_statistics` or `pixel_statistics` give for the frames.
      count: how many frames; with 0 nothing changes.
    """
    log_decay = count * math.log(PIXEL_DECAY if statistics.mean.ndim else DECAY)
    # expm1, because 1 - DECAY^n loses half of float32's digits for small n.
    old, new = jnp.exp(log_decay), -jnp.expm1(log_decay)
    return FrameStatistics(
        mean=old * statistics.mean + new * frame_mean,
        std=old * statistics.std + new * frame_std,
        weight=old * statistics.weight + new,
    )


def normalise(
    frame: Float[Array, "H W *C"],
    statistics: FrameStatistics,
    *,
    mode: Literal["running", "pixel", "frame", "none"],
) -> Float[Array, "H W *C"]:
    """Returns (frame - mean) / max(std, SMALLEST_STD), which has no bounds; with `none` the frame as it is.

    Args:
      frame: in [0, 1].
      statistics: the running statistics, not yet bias-corrected; read by `running` and `pixel` only.
      mode: whose mean and deviation. `running` and `pixel`: those of `statistics`, bias-corrected, or
        the frame's own while nothing has been seen; with `pixel`, each pixel has a mean of its own,
        so that what never changes is 0. `frame`: the frame's own.
    """
    if mode == "none":
        return frame
    mean, std = frame_statistics(frame) if mode == "frame" else _corrected(statistics, frame)
    return (frame - mean) / jnp.maximum(std, SMALLEST_STD)


def _corrected(statistics: FrameStatistics, frame: Float[Array, "H W *C"]) -> tuple[Array, Array]:
    """Returns mean and deviation without the bias of starting at 0; the frame's own before anything was seen."""
    mean, std = frame_statistics(frame)
    seen = statistics.weight > 0
    weight = jnp.where(seen, statistics.weight, 1.0)
    return jnp.where(seen, statistics.mean / weight, mean), jnp.where(seen, statistics.std / weight, std)
