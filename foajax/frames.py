"""From a screen to a normalised frame: crop, 2x2 mean, running statistics.

Pure functions on one frame; the caller vmaps. A frame is float32 [H, W] in [0, 1]: a screen's
0..255 divided by 255. Where the crop and the statistics come from: paper-notes, "Preprocessing".
"""

from __future__ import annotations

import math
from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt8

from foajax.types import FrameStatistics

DECAY = 0.9999  # of the running statistics, per frame
EPSILON = 1e-8  # added to a deviation before dividing by it
CROPPED = 160  # rows, and columns, kept of an Atari screen


def to_frame(screen: UInt8[Array, "h w"], crop_top: int | None) -> Float[Array, "H W"]:
    """The frame that a sensor looks at.

    Args:
      screen: gray, 0..255.
      crop_top: first screen row kept of a 210x160 Atari screen (`crop_and_halve`), or None where
        the screen has the frame's size already.

    Returns:
      The frame, in [0, 1]: [80, 80] where cropped, else [h, w].
    """
    if crop_top is None:
        return screen.astype(jnp.float32) * jnp.float32(1 / 255)
    return crop_and_halve(screen, crop_top)


def crop_and_halve(screen: UInt8[Array, "210 160"], crop_top: int) -> Float[Array, "80 80"]:
    """Mean of each 2x2 block of the screen rows crop_top .. crop_top + 159.

    The sum of four pixels is exact, so a value is `sum / 1020` with one rounding and
    `round(1020 * frame)` gives the sum back.

    Args:
      screen: gray, 0..255.
      crop_top: first row kept, 0..50.

    Returns:
      The frame, in [0, 1].

    Raises:
      ValueError: if the crop leaves the screen.
    """
    if not 0 <= crop_top <= screen.shape[0] - CROPPED:
        raise ValueError(f"crop_top={crop_top}: accepted is a row from 0 to {screen.shape[0] - CROPPED}")
    # Strided slices of 16-bit integers: XLA on the CPU turns a reshape with a sum, reduce_window or
    # a product with a pooling matrix into code that is 5 to 40 times slower.
    kept = screen[crop_top : crop_top + CROPPED].astype(jnp.uint16)
    rows = kept[0::2] + kept[1::2]
    return (rows[:, 0::2] + rows[:, 1::2]).astype(jnp.float32) * jnp.float32(1 / 1020)


def frame_statistics(frame: Float[Array, "H W"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Mean and (population) standard deviation of one frame's pixels."""
    mean = jnp.mean(frame)
    return mean, jnp.sqrt(jnp.mean(jnp.square(frame - mean)))


def initial_statistics() -> FrameStatistics:
    """Running statistics that have seen nothing: all zeros."""
    zero = jnp.zeros((), jnp.float32)
    return FrameStatistics(mean=zero, std=zero, weight=zero)


def update_statistics(
    statistics: FrameStatistics,
    frame_mean: Float[Array, "N"],
    frame_std: Float[Array, "N"],
    valid: Bool[Array, "N"] | Float[Array, "N"] | None = None,
) -> FrameStatistics:
    """Takes N frames into the running statistics at once.

    One frame at a time, `mean <- DECAY mean + (1 - DECAY) frame_mean`. The n valid frames of a
    batch count as n times their average, so that their order has no influence:
    `mean <- DECAY^n mean + (1 - DECAY^n) average`; the same for `std` and, with 1 as the average,
    for `weight`.

    Args:
      statistics: what has been seen so far.
      frame_mean, frame_std: of each frame, from `frame_statistics`.
      valid: 1 or True where a frame counts; None for all.

    Returns:
      The new statistics; the old ones if no frame is valid.
    """
    counted = jnp.ones_like(frame_mean) if valid is None else valid.astype(frame_mean.dtype)
    count = jnp.sum(counted)
    log_decay = count * math.log(DECAY)
    # expm1, because 1 - DECAY^n loses half of float32's digits for small n.
    old, new = jnp.exp(log_decay), -jnp.expm1(log_decay)

    def average(values: Float[Array, "N"]) -> Float[Array, ""]:
        # A frame that does not count may hold anything, NaN included.
        return jnp.sum(jnp.where(counted > 0, values, 0.0)) / jnp.maximum(count, 1.0)

    return FrameStatistics(
        mean=old * statistics.mean + new * average(frame_mean),
        std=old * statistics.std + new * average(frame_std),
        weight=old * statistics.weight + new,
    )


def normalise(
    frame: Float[Array, "H W"],
    statistics: FrameStatistics,
    *,
    mode: Literal["running", "frame", "none"],
) -> Float[Array, "H W"]:
    """(frame - mean) / (std + EPSILON).

    Args:
      frame: in [0, 1].
      statistics: the running statistics, not yet bias-corrected; read by `running` only.
      mode: whose mean and deviation. `running`: those of `statistics`, bias-corrected, or the
        frame's own while nothing has been seen; `frame`: the frame's own; `none`: the frame is
        returned as it is.

    Returns:
      The normalised frame, without bounds unless `none`.
    """
    if mode == "none":
        return frame
    mean, std = frame_statistics(frame)
    if mode == "running":
        seen = statistics.weight > 0
        weight = jnp.where(seen, statistics.weight, 1.0)
        mean = jnp.where(seen, statistics.mean / weight, mean)
        std = jnp.where(seen, statistics.std / weight, std)
    return (frame - mean) / (std + EPSILON)
