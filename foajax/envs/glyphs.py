"""Letters for search tasks: small bitmaps that can be told apart only at full resolution.

A letter is a glyph of DejaVu Sans Bold, 11 pixels high, filled with a checkerboard of single pixels, on a plate of even
gray. The mean over a block of even sides is the plate's gray, except at the corners of strokes. There it is off by an
eighth of the checkerboard's depth at most (a 32nd in blocks of 4x4), as the masks are smoothed, and with a random sign
for each letter. So low resolution tells where a letter is, not which one or how it is turned.
"""

from __future__ import annotations

import functools

import numpy as np
from jaxtyping import Bool, Float

LETTERS = "TLUE"
PLATE = 14  # pixels of a plate's side; a letter fits whichever way it is turned
_FONT_SIZE = 15  # gives capitals of 11 pixels


@functools.cache
def masks() -> Float[np.ndarray, "letters 4 p p"]:
    """Returns how much of each pixel of its plate a letter covers, 0 to 1, turned left by 0, 90, 180 and 270 degrees.

    The foot of a letter points down, right, up, left in this order.
    """
    upright = [_mask(letter) for letter in LETTERS]
    return np.stack([[np.rot90(mask, turns) for turns in range(4)] for mask in upright])


def checkerboard() -> Float[np.ndarray, "p p"]:
    """Returns 1 and -1 in turn along rows and columns."""
    place = np.arange(PLATE)
    return np.where((place[:, None] + place) % 2 == 0, 1.0, -1.0).astype(np.float32)


def _mask(letter: str) -> Float[np.ndarray, "p p"]:
    import matplotlib  # ships the font; here, because importing it takes a while
    from PIL import Image, ImageDraw, ImageFont

    font = ImageFont.truetype(f"{matplotlib.get_data_path()}/fonts/ttf/DejaVuSans-Bold.ttf", _FONT_SIZE)
    left, top, right, bottom = font.getbbox(letter)
    image = Image.new("L", (int(right - left), int(bottom - top)), 0)
    ImageDraw.Draw(image).text((-left, -top), letter, fill=255, font=font)
    inked: Bool[np.ndarray, "h w"] = np.asarray(image) > 127
    inked = inked[inked.any(1)][:, inked.any(0)]
    height, width = inked.shape
    plate = np.zeros((PLATE, PLATE), np.float32)
    first = (PLATE - height) // 2, (PLATE - width) // 2
    plate[first[0] : first[0] + height, first[1] : first[1] + width] = inked
    for _ in range(2):  # rows, then columns
        plate[1:-1] = (plate[:-2] + 2 * plate[1:-1] + plate[2:]) / 4
        plate = plate.T
    return plate
