"""One picture of a recorded step: the game with the gaze on it, what is seen, both heads. A video's frame."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from foajax.sensors.gaze import names
from foajax.sensors.reconstruct import paint, tables
from foajax.sensors.registry import make_sensor
from foajax.viewing.recording import Recording
from foajax.viewing.style import NATURAL, VISION, draw_gaze

_SIZE = (960, 628)  # even, as video codecs want it
_MARGIN = 16
_TOP = 80  # of the pictures
_TALL = 420  # of the screen
_VIEW = 320  # of the sensor's view
_HEADS = _TALL - 60  # of all their actions' rows
_THINNEST = 9  # such a row
_MOST_VISUAL = 25  # of the vision head's
_CHART = (960 - 2 * _MARGIN, 84)
_PAPER, _PANEL, _INK, _FAINT = "#12161b", "#1b2128", "#e8edf2", "#8b98a5"
_LOST, _REWARD = "#ff6b6b", "#ffd166"


class Scene:
    """Draws the steps of one recording."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._sensor = make_sensor(recording.config.sensor).packed
        self._painting = tables(self._sensor, recording.config.env.frame_shape)
        self._values = recording.values
        self._white = max(int(self._values.max()), 1)  # of the whole game, so that nothing flickers
        self._scale = _fit(recording.screens.shape[:2], (_TALL, _VIEW))
        self._chart = _chart(recording)
        self._still = self._background()
        probs = recording.vision_probs
        self._visual = np.arange(0) if probs is None else _likeliest(probs, _MOST_VISUAL)
        self._natural = _likeliest(recording.natural_probs, _HEADS // _THINNEST - len(self._visual))
        self._row = min(24, _HEADS // (len(self._natural) + len(self._visual)))

    def draw(self, step: int) -> Image.Image:
        """The picture of a step, RGB."""
        image = self._still.copy()
        self._draw_screen(image, step)
        self._draw_view(image, step)
        self._draw_heads(image, step)
        self._draw_numbers(image, step)
        left, top = _MARGIN, _SIZE[1] - _MARGIN - _CHART[1]
        x = round(step / max(len(self._recording.score) - 1, 1) * (_CHART[0] - 1))
        image.paste(self._chart.crop((0, 0, x + 1, _CHART[1])), (left, top))
        ImageDraw.Draw(image).line([left + x, top, left + x, top + _CHART[1]], fill=_INK)
        return image

    def _background(self) -> Image.Image:
        """All that does not change."""
        recording, config = self._recording, self._recording.config
        image = Image.new("RGB", _SIZE, _PAPER)
        pen = ImageDraw.Draw(image)
        policy = "likeliest actions" if recording.greedy else "sampled actions"
        pen.text((_MARGIN, 12), f"{config.name} on {config.game}", fill=_INK, font=_font(16))
        note = f"{recording.env_steps:,} env_steps of training, {policy}, game {recording.seed}"
        pen.text((_MARGIN, 36), note, fill=_FAINT, font=_font(12))
        for left, caption in ((_MARGIN, "game"), (self._view_left, "what the sensor sees")):
            pen.text((left, _TOP - 16), caption, fill=_FAINT, font=_font(12))
        faint = Image.blend(self._chart, Image.new("RGB", _CHART, _PANEL), 0.7)
        image.paste(faint, (_MARGIN, _SIZE[1] - _MARGIN - _CHART[1]))
        return image

    @property
    def _view_left(self) -> int:
        return 2 * _MARGIN + _VIEW

    @property
    def _heads_left(self) -> int:
        return 3 * _MARGIN + 2 * _VIEW

    def _draw_screen(self, image: Image.Image, step: int) -> None:
        recording, scale = self._recording, self._scale
        screen = _enlarge(Image.fromarray(recording.screens[step]), scale)
        top, down, across = recording.frame_origin
        point = (int(recording.focal_point[step][0]), int(recording.focal_point[step][1]))
        draw_gaze(screen, self._sensor, point, scale=(scale * down, scale * across), top=scale * top, halo=True)
        image.paste(screen, (_MARGIN, _TOP))

    def _draw_view(self, image: Image.Image, step: int) -> None:
        """The values put back in the frame's place, and below them the images as the network gets them."""
        recording = self._recording
        picture = paint(self._values[step], recording.focal_point[step], self._painting)
        view = _enlarge(self._bright(picture), _fit(picture.shape[:2], (_VIEW, _VIEW)))
        image.paste(view, (self._view_left, _TOP))
        if len(recording.images) == 1 and recording.images[0].shape[1:3] == recording.config.env.frame_shape:
            return  # the whole frame: the same picture once more
        pen, left, top = ImageDraw.Draw(image), self._view_left, _TOP + view.height + 6
        pen.text((left, top), "the same values, each once", fill=_FAINT, font=_font(12))
        for part in recording.images:
            small = _enlarge(self._bright(part[step]), _fit(part.shape[1:3], (_TALL - _VIEW - 26, 110)))
            image.paste(small, (left, top + 20))
            left += small.width + 8

    def _bright(self, values: np.ndarray) -> Image.Image:
        return Image.fromarray((values.astype(np.uint16) * 255 // self._white).astype(np.uint8)).convert("RGB")

    def _draw_heads(self, image: Image.Image, step: int) -> None:
        recording, some, top = self._recording, self._natural, _TOP - 16
        called, probs = [recording.actions[i] for i in some], recording.natural_probs[step, some]
        chosen = some == recording.natural_action[step]
        caption = _caption("natural action", len(some), len(recording.actions))
        top = self._draw_bars(image, top, caption, NATURAL, called, probs, chosen)
        if recording.vision_probs is not None:
            all_names, some = names(recording.config.gaze), self._visual
            called, probs = [all_names[i] for i in some], recording.vision_probs[step, some]
            chosen = some == recording.vision_action[step]
            caption = _caption("visual action", len(some), len(all_names))
            self._draw_bars(image, top, caption, VISION, called, probs, chosen)
        else:
            note = f"gaze is not learned: {recording.config.gaze.mode}"
            ImageDraw.Draw(image).text((self._heads_left, top), note, fill=_FAINT, font=_font(12))

    def _draw_bars(
        self,
        image: Image.Image,
        top: int,
        caption: str,
        colour: str,
        names: Sequence[str],
        probs: np.ndarray,
        chosen: np.ndarray,
    ) -> int:
        """One head's policy, the chosen action (bool, by action) bright. Returns where the next one may begin."""
        pen, height = ImageDraw.Draw(image), self._row
        left, right = self._heads_left, _SIZE[0] - _MARGIN
        pen.text((left, top), caption, fill=colour, font=_font(12))
        top += 18
        font = _font(max(8, min(12, height - 4)))
        start = left + 92
        for name, share, bright in zip(names, probs, chosen, strict=True):
            middle = top + height // 2
            ink = _INK if bright else _FAINT
            pen.text((start - 8, middle), name, fill=ink, font=font, anchor="rm")
            pen.rectangle([start, top + 2, right - 34, top + height - 3], fill=_PANEL)
            end = start + round(float(share) * (right - 34 - start))
            if end > start:
                pen.rectangle([start, top + 2, end, top + height - 3], fill=colour if bright else _dim(colour))
            pen.text((right, middle), f"{100 * share:.0f}%", fill=ink, font=font, anchor="rm")
            top += height
        return top + 12

    def _draw_numbers(self, image: Image.Image, step: int) -> None:
        recording, pen = self._recording, ImageDraw.Draw(image)
        words = [f"score {recording.score[step]:g}"]
        if recording.lives is not None:
            words.append(f"lives {recording.lives[step]}")
        right = _SIZE[0] - _MARGIN
        pen.text((right, 12), "    ".join(words), fill=_INK, font=_font(16), anchor="ra")
        y, x = recording.focal_point[step]
        pen.text((right, 36), f"step {step:,}    focal point {y}, {x}", fill=_FAINT, font=_font(12), anchor="ra")
        legend = [(f"value of the natural head {recording.natural_value[step]:.2f}", NATURAL)]
        if recording.vision_value is not None:
            legend.append((f"of the vision head {recording.vision_value[step]:.2f}", VISION))
        legend.append(("points", _REWARD))
        if recording.lives is not None:
            legend.append(("a life lost", _LOST))
        left = _MARGIN
        for text, colour in legend:
            pen.text((left, _SIZE[1] - _MARGIN - _CHART[1] - 20), text, fill=colour, font=_font(12))
            left += round(_font(12).getlength(text)) + 18


def _chart(recording: Recording) -> Image.Image:
    """Both values over the whole game; points made as ticks, lost lives as lines."""
    width, height = _CHART
    image = Image.new("RGB", _CHART, _PANEL)
    pen = ImageDraw.Draw(image)
    steps = len(recording.score)
    x = np.arange(steps) / max(steps - 1, 1) * (width - 1)
    for i in np.flatnonzero(recording.life_lost):
        pen.line([x[i], 0, x[i], height], fill=_LOST)
    for i in np.flatnonzero(np.diff(recording.score)) + 1:
        pen.line([x[i], height - 5, x[i], height], fill=_REWARD)
    curves = [(recording.natural_value, NATURAL), (recording.vision_value, VISION)]
    shown = [values for values, _ in curves if values is not None]
    low, high = min(values.min() for values in shown), max(values.max() for values in shown)
    for values, colour in curves:
        if values is not None:
            y = height - 9 - (values - low) / max(high - low, 1e-6) * (height - 14)
            pen.line(list(zip(x.tolist(), y.tolist(), strict=True)), fill=colour)
    return image


def _likeliest(probs: np.ndarray, most: int) -> np.ndarray:
    """At most so many actions of the policies [N, n]: the likeliest over the game, in their own order."""
    return np.sort(np.argsort(-probs.mean(axis=0), kind="stable")[:most])


def _caption(what: str, shown: int, of: int) -> str:
    return what if shown == of else f"{what}, the {shown} likeliest of {of}"


def _fit(shape: tuple[int, ...], room: tuple[int, int]) -> float:
    """The scale at which a picture fits: a whole number, unless it has to shrink."""
    scale = min(limit / size for limit, size in zip(room, shape, strict=True))
    return float(int(scale)) if scale >= 1 else scale


def _enlarge(image: Image.Image, scale: float) -> Image.Image:
    how = Image.Resampling.NEAREST if scale >= 1 else Image.Resampling.BOX
    return image.resize((round(scale * image.width), round(scale * image.height)), how)


def _dim(colour: str) -> str:
    """The same hue, darker."""
    return "#" + "".join(f"{int(colour[i : i + 2], 16) * 55 // 100:02x}" for i in (1, 3, 5))


@functools.cache
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)
