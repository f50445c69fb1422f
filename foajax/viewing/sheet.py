"""Draws what sensors see of one frame, side by side; the brightest pixel of the frame is drawn white."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from PIL import Image, ImageDraw, ImageOps

from foajax.config.parse import refuse
from foajax.sensors.base import Sensor
from foajax.sensors.sense import picture, sense
from foajax.viewing.style import draw_gaze, font

PAPER = (
    "nonfoa",
    "constant50_sub1",
    "constant50_sub2",
    "constant70",
    "decreasing",
    "constant70_p",
    "decreasing_p",
)  # in the order of Table II
ALL = (*PAPER, "logpolar")

_SIDE = 240  # of a panel, pixels: about three for each of an 80x80 frame
_GAP = 12
_LINE = 18  # of text
_ACROSS, _DOWN = 0, 1  # axes of an image's size
_INK, _FAINT, _PAPER = "#222222", "#777777", "#ffffff"

Panel = tuple[str, Image.Image]  # caption and picture


def draw(frame: np.ndarray, sensor: Sensor, points: Sequence[tuple[int, int]], *, name: str) -> Image.Image:
    """Draws one sensor on one frame: a heading and a row for each focal point.

    Args:
      frame: float32 [H, W] or [H, W, 3] in [0, 1].
      sensor: what to look through.
      points: (y, x) in frame pixels, inside the frame.
      name: of the sensor, for the heading.
    """
    rows = [_row(_panels(frame, sensor, point)) for point in points]
    return _headed(_join(rows, _DOWN), *_heading(frame, sensor, name))


def contact_sheet(frame: np.ndarray, sensors: dict[str, Sensor], points: Sequence[tuple[int, int]]) -> Image.Image:
    """Draws several sensors on one frame, two in a row, each with a pair of panels for every focal point."""
    blocks = [
        _headed(
            _join([_row(_panels(frame, sensor, point)[:2]) for point in points], _DOWN),
            *_heading(frame, sensor, name),
        )
        for name, sensor in sensors.items()
    ]
    return _join([_join(blocks[i : i + 2], _ACROSS) for i in range(0, len(blocks), 2)], _DOWN)


def _panels(frame: np.ndarray, sensor: Sensor, point: tuple[int, int]) -> list[Panel]:
    """Draws the frame, what is seen of it, and the packed images."""
    images, seen = _look(jnp.asarray(frame), jnp.asarray(point, jnp.int32), sensor)
    white = float(frame.max()) or 1.0
    panels = [
        (f"frame, gaze at y {point[0]}, x {point[1]}", _marked(frame / white, sensor, point)),
        ("what the sensor shows", _image(np.asarray(seen) / white)),
    ]
    if sensor.in_place:
        return panels
    for i, image in enumerate(images):
        caption = f"image {i}: {image.shape[0]} x {image.shape[1]}"
        panels.append((caption, _image(np.asarray(image) / white)))
    return panels


@functools.partial(jax.jit, static_argnums=2)
def _look(
    frame: Float[Array, "H W *C"], focal_point: Int[Array, "2"], sensor: Sensor
) -> tuple[tuple[Float[Array, "_ _ _"], ...], Float[Array, "H W _"]]:
    """Returns what the sensor gives, and the same at its place in a frame."""
    images = sense(frame, focal_point, sensor=sensor)
    shape = (frame.shape[0], frame.shape[1])
    return images, picture(images, focal_point, sensor=sensor, frame_shape=shape)


def _marked(frame: np.ndarray, sensor: Sensor, point: tuple[int, int]) -> Image.Image:
    """Draws the frame with the focal areas and the focal point on it."""
    image = _image(frame)
    scale = image.width // frame.shape[1]
    draw_gaze(image, sensor, point, scale=(scale, scale))
    return image


def _image(values: np.ndarray) -> Image.Image:
    """Draws values [h, w], [h, w, 1] or [h, w, 3] in [0, 1], each as a square of pixels."""
    height, width = values.shape[:2]
    scale = max(1, _SIDE // max(height, width))
    levels = np.round(255 * np.clip(values, 0, 1)).astype(np.uint8).reshape(height, width, -1)
    image = Image.fromarray(np.ascontiguousarray(np.broadcast_to(levels, (height, width, 3))))
    return image.resize((scale * image.width, scale * image.height), Image.Resampling.NEAREST)


def _row(panels: Sequence[Panel]) -> Image.Image:
    """Puts panels side by side, each under its caption."""
    blocks = []
    for caption, image in panels:
        width = max(image.width + 2, round(font(12).getlength(caption)))
        block = Image.new("RGB", (width, image.height + 2 + _LINE), _PAPER)
        ImageDraw.Draw(block).text((0, 0), caption, fill=_FAINT, font=font(12))
        # The border shows where white pixels end on a white page.
        block.paste(ImageOps.expand(image, 1, _FAINT), (0, _LINE))
        blocks.append(block)
    return _join(blocks, _ACROSS)


def _heading(frame: np.ndarray, sensor: Sensor, name: str) -> tuple[str, str]:
    """Returns the sensor's name and its pixel budget, counted as in Table II."""
    count = sensor.count((frame.shape[0], frame.shape[1]))
    shown = "" if count.actual == count.nominal else f" ({count.actual:,} shown)"
    return name, f"{count.nominal:,} values{shown}, {100 * count.nominal / np.prod(frame.shape[:2]):.0f}% of the frame"


def _headed(image: Image.Image, title: str, note: str) -> Image.Image:
    """Puts a heading above an image."""
    large, small = font(16), font(12)
    start = round(large.getlength(title)) + _GAP
    width = max(image.width, start + round(small.getlength(note)))
    headed = Image.new("RGB", (width, image.height + _LINE + _GAP // 2), _PAPER)
    pen = ImageDraw.Draw(headed)
    pen.text((0, 14), title, fill=_INK, font=large, anchor="ls")
    pen.text((start, 14), note, fill=_FAINT, font=small, anchor="ls")
    headed.paste(image, (0, _LINE + _GAP // 2))
    return headed


def _join(images: Sequence[Image.Image], axis: int) -> Image.Image:
    """Joins images from left to right with their tops aligned, or from top to bottom."""
    size = [max(sides) for sides in zip(*(image.size for image in images), strict=True)]
    size[axis] = sum(image.size[axis] for image in images) + _GAP * (len(images) - 1)
    joined, place = Image.new("RGB", (size[0], size[1]), _PAPER), [0, 0]
    for image in images:
        joined.paste(image, (place[0], place[1]))
        place[axis] += image.size[axis] + _GAP
    return joined


def save(image: Image.Image, out: str) -> None:
    """Writes a PNG with a margin, of 64 colours to keep it small."""
    page = Image.new("RGB", (image.width + 2 * _GAP, image.height + 2 * _GAP), _PAPER)
    page.paste(image, (_GAP, _GAP))
    try:
        page.quantize(64, dither=Image.Dither.NONE).save(out, optimize=True)
    except OSError as error:
        raise refuse("out", out, f"a file that can be written ({error.strerror})") from None
