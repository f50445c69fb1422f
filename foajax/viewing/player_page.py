"""Writes one recorded game as a page to play, scrub and study.

The page is one file and needs no other, no network and no server. Screens are palette indices. 60 screens at a time
are compressed with zlib, which browsers can undo, each XORed with the one before. So a step of an Atari game takes some
hundred bytes, and any step can be shown within milliseconds. A video would be smaller for games in full motion, but a
browser could not jump to any of its frames at once, nor show it exactly.
"""

from __future__ import annotations

import base64
import itertools
import json
import math
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from foajax.envs.make import steps_per_second
from foajax.runs import durable
from foajax.sensors.gaze import names
from foajax.sensors.reconstruct import tables
from foajax.sensors.registry import make_sensor
from foajax.viewing.recording import Recording

PAGE = "index.html"
_PART = 60  # steps that are compressed together; to show one, all are decompressed
_MOST_PIXELS = 48_000  # of a screen; larger ones are shrunk, which spares an Atari's
_COLOURS = 256


def write_page(recording: Recording, directory: Path) -> Path:
    """Writes the page of one game; returns its path."""
    page = (Path(__file__).parent / "player.html").read_text(encoding="utf-8")
    text = json.dumps(encode(recording), separators=(",", ":")).replace("<", "\\u003c")  # no tag may end the script
    title = recording.title.replace("<", "")
    file = directory / PAGE
    durable.replace(file, page.replace("{{title}}", title).replace("{{recording}}", text).encode())
    return file


def encode(recording: Recording) -> dict[str, Any]:
    """Encodes a recording for the page's script."""
    config, sensor = recording.config, make_sensor(recording.config.sensor).packed
    palette, screens = _screens(recording)
    values = recording.values
    painting = tables(sensor, config.env.frame_shape)
    shape, origin = _shrunk(recording), recording.frame_origin
    scale = shape[0] / recording.screens.shape[0], shape[1] / recording.screens.shape[1]
    return {
        "title": recording.title,
        "about": recording.about,
        "steps": len(recording.screens),
        "steps_per_second": steps_per_second(config),
        "screen_shape": shape,
        "frame_shape": config.env.frame_shape,
        "origin": [origin[0] * scale[0], origin[1] * scale[0], origin[2] * scale[1]],
        "areas": sensor.areas,
        "round": sensor.is_round,
        "gaze": config.gaze.mode,
        "natural_names": recording.actions,
        "vision_names": names(config.gaze),
        "images": [part.shape[1:3] for part in recording.images],
        "count": values.shape[1],
        "channels": math.prod(config.env.pixel_shape),
        "white": recording.white,
        "painting": {"window": painting.window.tolist(), "background": painting.background.tolist()},
        "part": _PART,
        "palette": palette,
        "screens": list(screens),
        "values": [_pack(values[i : i + _PART]) for i in range(0, len(values), _PART)],
        "columns": _columns(recording),
    }


def _columns(recording: Recording) -> dict[str, tuple[str, str]]:
    """Packs what has a few numbers per step; returns type and content by name."""
    columns: dict[str, np.ndarray] = {
        "focal_point": recording.focal_point.astype(np.int16),
        "natural_probs": np.round(255 * recording.natural_probs).astype(np.uint8),
        "natural_value": recording.natural_value.astype(np.float32),
        "natural_action": recording.natural_action.astype(np.uint16),
        "vision_action": recording.vision_action.astype(np.uint16),
        "score": recording.score.astype(np.float32),
        "is_first": recording.is_first.astype(np.uint8),
        "life_lost": recording.life_lost.astype(np.uint8),
    }
    if recording.vision_probs is not None and recording.vision_value is not None:
        columns["vision_probs"] = np.round(255 * recording.vision_probs).astype(np.uint8)
        columns["vision_value"] = recording.vision_value.astype(np.float32)
    if recording.lives is not None:
        columns["lives"] = recording.lives.astype(np.uint8)
    return {name: (values.dtype.name, _pack(values)) for name, values in columns.items()}


def _pack(values: np.ndarray) -> str:
    return base64.b64encode(zlib.compress(np.ascontiguousarray(values).tobytes(), 9)).decode()


def _screens(recording: Recording) -> tuple[list[list[int]], Iterator[str]]:
    """Returns a palette for the whole game, and its screens part by part."""
    palette = _exact_palette(recording) if _shrunk(recording) == recording.screens.shape[:2] else None
    if palette is not None:
        index = np.zeros(1 << 24, np.uint8)
        index[palette] = np.arange(len(palette))
        colours = np.stack([palette >> 16, palette >> 8 & 255, palette & 255], axis=-1)
        return colours.tolist(), _parts(index[_codes(screen)] for screen in recording.screens)
    reference = _chosen_palette(recording)
    colours = np.array(reference.getpalette(), int).reshape(-1, 3)
    images = (_small(recording, i) for i in range(len(recording.screens)))
    quantized = (image.quantize(palette=reference, dither=Image.Dither.NONE) for image in images)
    return colours.tolist(), _parts(np.asarray(image) for image in quantized)


def _parts(screens: Iterator[np.ndarray]) -> Iterator[str]:
    """Packs screens of indices [h, w], `_PART` at a time, each XORed with the one before."""
    while some := list(itertools.islice(screens, _PART)):
        part = np.stack(some)
        part[1:] ^= part[:-1].copy()
        yield _pack(part)


def _exact_palette(recording: Recording) -> np.ndarray | None:
    """Lists the game's colours, 0xrrggbb, if a palette can hold them; an emulator has 128."""
    seen = np.zeros(1 << 24, bool)
    for screen in recording.screens:
        seen[_codes(screen)] = True
    colours = np.flatnonzero(seen)
    return colours if len(colours) <= _COLOURS else None


def _codes(screen: np.ndarray) -> np.ndarray:
    red, green, blue = np.moveaxis(screen.astype(np.int32), -1, 0)
    return red << 16 | green << 8 | blue


def _chosen_palette(recording: Recording) -> Image.Image:
    """Chooses 256 colours that suit sixteen screens of the game."""
    some = np.linspace(0, len(recording.screens) - 1, 16).astype(int)
    sheet = np.concatenate([np.asarray(_small(recording, int(i))) for i in some])
    return Image.fromarray(sheet).quantize(_COLOURS)


def _small(recording: Recording, index: int) -> Image.Image:
    height, width = _shrunk(recording)
    return Image.fromarray(recording.screens[index]).resize((width, height), Image.Resampling.BOX)


def _shrunk(recording: Recording) -> tuple[int, int]:
    """Returns rows and columns of a screen on the page."""
    height, width = recording.screens.shape[:2]
    scale = min(1.0, (_MOST_PIXELS / (height * width)) ** 0.5)
    return round(scale * height), round(scale * width)
