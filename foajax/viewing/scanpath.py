"""Draws a scanpath: a scene with the fixations of one episode, numbered, and what was seen at each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int, UInt8
from PIL import Image, ImageDraw

from foajax.sensors.reconstruct import paint, tables
from foajax.sensors.registry import make_sensor
from foajax.viewing.recording import Recording
from foajax.viewing.style import FAINT, INK, NATURAL, PAPER, RINGS, VISION, brighten, draw_gaze, enlarge, fit, font

_SIDE = 640  # of the scene, at most
_MARGIN = 16
_TOP = 44  # of the pictures
_TILE = 150  # of what was seen at one fixation
_ACROSS = 4  # such tiles in a row


def fixations(points: Int[np.ndarray, "N 2"]) -> list[tuple[int, int]]:
    """Returns each fixation, a stay of the focal point at one place: its first decision and how many decisions."""
    moved = np.flatnonzero(np.any(np.diff(points, axis=0) != 0, axis=1)) + 1
    starts = [0, *moved.tolist()]
    return [(first, last - first) for first, last in zip(starts, [*starts[1:], len(points)], strict=True)]


def draw_scanpath(recording: Recording) -> Image.Image:
    """Draws the scene of one episode with its fixations in order and, beside it, what the sensor saw at each.

    Decisions in a row at one place are one fixation. The target's box is marked if the task tells it. If the game has
    several episodes, the first one is drawn.
    """
    starts = np.flatnonzero(recording.is_first[1:]) + 1
    length = int(starts[0]) if len(starts) else len(recording.score)  # rows; the last one's decision has no effect
    points = recording.focal_point[: max(length - 1, 1)]
    stays = fixations(points)
    scene = _scene(recording, recording.screens[length - 1], points, stays)
    tiles = _tiles(recording, points, stays)
    rows = -(-len(tiles) // _ACROSS)
    width = 3 * _MARGIN + scene.width + min(_ACROSS, len(tiles)) * (_TILE + 8)
    image = Image.new("RGB", (width, _TOP + _MARGIN + max(scene.height, rows * (_TILE + 26))), PAPER)
    pen = ImageDraw.Draw(image)
    pen.text((_MARGIN, 12), _title(recording, len(stays), length), fill=INK, font=font(16))
    image.paste(scene, (_MARGIN, _TOP))
    for i, tile in enumerate(tiles):
        left = 2 * _MARGIN + scene.width + (i % _ACROSS) * (_TILE + 8)
        top = _TOP + (i // _ACROSS) * (_TILE + 26)
        again = f", {stays[i][1]} decisions" if stays[i][1] > 1 else ""
        pen.text((left, top - 2), f"{i + 1}{again}", fill=FAINT, font=font(12))
        image.paste(tile, (left, top + 16))
    return image


def _title(recording: Recording, count: int, length: int) -> str:
    action = recording.actions[int(recording.natural_action[max(length - 2, 0)])]
    places = f"{count} fixation{'s' if count > 1 else ''}"
    return f"{recording.title}: {places}, then '{action}', {recording.score[length - 1]:+.2f}"


def _scene(
    recording: Recording,
    screen: UInt8[np.ndarray, "h w 3"],
    points: Int[np.ndarray, "N 2"],
    stays: Sequence[tuple[int, int]],
) -> Image.Image:
    """Enlarges the screen; draws the path as a line, a number per fixation, and the last focal areas' outlines."""
    scale = fit(screen.shape[:2], (_SIDE, _SIDE))
    image = enlarge(Image.fromarray(screen), scale)
    top, down, across = (scale * part for part in recording.frame_origin)
    draw_gaze(image, make_sensor(recording.config.sensor), points[-1], scale=(down, across), top=top, halo=True)
    pen = ImageDraw.Draw(image)
    box = (recording.facts or {}).get("box")
    if box is not None and box[2] > 0:
        first, last = (box[0], box[1]), (box[0] + box[2], box[1] + box[3])
        upper, left, lower, right = (top + down * first[0], across * first[1], top + down * last[0], across * last[1])
        pen.rectangle([left - 3, upper - 3, right + 2, lower + 2], outline=NATURAL, width=3)
    places = [(across * float(x), top + down * float(y)) for y, x in (points[first] for first, _ in stays)]
    if len(places) > 1:
        pen.line(places, fill=VISION, width=2)
    for number, (x, y) in enumerate(places, 1):
        rim = RINGS[0] if number == len(places) else VISION
        pen.ellipse([x - 9, y - 9, x + 9, y + 9], fill=PAPER, outline=rim, width=2)
        pen.text((x, y), str(number), fill=INK, font=font(11), anchor="mm")
    return image


def _tiles(recording: Recording, points: Int[np.ndarray, "N 2"], stays: Sequence[tuple[int, int]]) -> list[Image.Image]:
    """Draws what the sensor saw at each fixation, at its place in the frame, cut to the two finest rings."""
    sensor = make_sensor(recording.config.sensor).packed
    frame_shape = recording.config.env.frame_shape
    painting = tables(sensor, frame_shape)
    values, white = recording.values, recording.white
    shown = sensor.areas[min(1, len(sensor.areas) - 1)]
    tiles = []
    for first, _ in stays:
        picture = np.pad(paint(values[first], points[first], painting), [(side // 2, side // 2) for side in shown])
        y, x = (int(p) for p in points[first])
        tile = brighten(picture[y : y + shown[0], x : x + shown[1]], white)
        tiles.append(tile.resize((_TILE, _TILE), Image.Resampling.NEAREST))
    return tiles
