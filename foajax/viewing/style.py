"""Defines what pictures of the gaze share: colours, fonts, scales, and the outlines of the focal areas."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from foajax.sensors.base import Sensor, boxes

RINGS = ("#ffb000", "#2fb8ff", "#ff5c9a")  # inner to outer; the colour-blind can tell them apart
NATURAL, VISION = "#58d68d", "#b794ff"  # the two heads
HALO = "#000000"  # under a line that has to show on any screen
PAPER, PANEL, INK, FAINT = "#12161b", "#1b2128", "#e8edf2", "#8b98a5"  # of dark pictures

Number = int | float

STYLE: Any = {  # of figures: Matplotlib's keys
    "font.size": 10,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#777777",
    "axes.labelcolor": "#222222",
    "xtick.color": "#777777",
    "ytick.color": "#777777",
    "xtick.labelcolor": "#222222",
    "ytick.labelcolor": "#222222",
    "legend.frameon": False,
}


def draw_gaze(
    image: Image.Image,
    sensor: Sensor,
    point: np.ndarray | tuple[int, int],
    *,
    scale: tuple[Number, Number],
    top: Number = 0,
    halo: bool = False,
) -> None:
    """Draws the focal areas and a cross at the focal point.

    Args:
      image: changed in place.
      sensor: whose areas.
      point: (y, x) in frame pixels.
      scale: image pixels per frame pixel, (down, across).
      top: row of the image at which the frame begins.
      halo: whether lines have a dark rim.
    """
    pen = ImageDraw.Draw(image)
    down, across = scale
    shape = pen.ellipse if sensor.is_round else pen.rectangle
    for i, (y, x, height, width) in reversed(list(enumerate(boxes(sensor, point)))):
        left, upper = round(across * x), round(top + down * y)
        right = max(left, round(across * (x + width)) - 1)  # one pixel, where an area is narrower than that
        lower = max(upper, round(top + down * (y + height)) - 1)
        if halo:
            shape([left - 1, upper - 1, right + 1, lower + 1], outline=HALO, width=4)
        shape([left, upper, right, lower], outline=RINGS[i % len(RINGS)], width=2)
    y, x = round(top + down * point[0]), round(across * point[1])
    for reach, width, colour in ((6, 4, HALO), (5, 2, RINGS[0])) if halo else ((5, 2, RINGS[0]),):
        pen.line([x - reach, y, x + reach, y], fill=colour, width=width)
        pen.line([x, y - reach, x, y + reach], fill=colour, width=width)


@functools.cache
def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Returns Pillow's own font at a size in pixels."""
    return ImageFont.load_default(size)


def fit(shape: tuple[int, ...], room: tuple[int, int]) -> float:
    """Returns the scale at which a picture fits: a whole number, unless it has to shrink."""
    scale = min(limit / size for limit, size in zip(room, shape, strict=True))
    return float(int(scale)) if scale >= 1 else scale


def enlarge(image: Image.Image, scale: float) -> Image.Image:
    """Scales an image: pixels become squares, or are averaged if it shrinks."""
    how = Image.Resampling.NEAREST if scale >= 1 else Image.Resampling.BOX
    return image.resize((round(scale * image.width), round(scale * image.height)), how)


def brighten(values: UInt8[np.ndarray, "h w *C"], white: int) -> Image.Image:
    """Draws values [h, w] or [h, w, 3] as an RGB image, with the value `white` as white."""
    return Image.fromarray((values.astype(np.uint16) * 255 // white).astype(np.uint8)).convert("RGB")
