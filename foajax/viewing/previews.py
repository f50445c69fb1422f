"""Draws two small images of the gaze from one rollout, which training sends to TensorBoard."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int, UInt8

from foajax.sensors import gaze
from foajax.types import Rollout

_SCALE = 4  # pixels of an image for one of the frame
_VIEWS = 6  # of one environment, spread over the rollout
_GAP = 2


def snapshots(rollout: Rollout, frame_shape: tuple[int, int]) -> dict[str, UInt8[np.ndarray, "_ _ *C"]]:
    """Draws a heat map of all environments' focal points, and what the first one saw, by TensorBoard's names."""
    steps = rollout.steps
    return {
        "gaze/heat_map": heat_map(np.asarray(steps.focal_point).reshape(-1, 2), frame_shape),
        "gaze/views": views([np.asarray(part)[:, 0] for part in steps.roi]),
    }


def heat_map(points: Int[np.ndarray, "n 2"], frame_shape: tuple[int, int]) -> UInt8[np.ndarray, "_ _"]:
    """Draws how often the focal point was where: logarithmic, the most white, on dark gray."""
    counts = gaze.count(points, frame_shape)
    levels = np.where(counts > 0, 80 + 175 * np.log1p(counts) / np.log1p(counts.max()), 24)
    return _enlarged(levels)


def views(parts: list[Float[np.ndarray, "T _ _ C"]]) -> UInt8[np.ndarray, "_ _ C"]:
    """Draws the sensor's images at a few steps: a column per step, its parts below one another.

    Values are of normalised frames; the smallest is drawn black and the largest white.
    """
    chosen = np.linspace(0, len(parts[0]) - 1, _VIEWS).astype(int)
    low, high = (bound(np.stack([bound(part[chosen]) for part in parts])) for bound in (np.min, np.max))
    width = max(part.shape[2] for part in parts)
    rows = []
    for part in parts:
        margins = [(0, 0), (0, _GAP), (0, width - part.shape[2] + _GAP), (0, 0)]
        levels = np.pad(255 * (part[chosen] - low) / max(high - low, 1e-6), margins)
        rows.append(np.concatenate(list(levels), axis=1))
    return _enlarged(np.concatenate(rows))


def _enlarged(levels: Float[np.ndarray, "h w *C"]) -> UInt8[np.ndarray, "_ _ *C"]:
    return np.round(levels).astype(np.uint8).repeat(_SCALE, 0).repeat(_SCALE, 1)
