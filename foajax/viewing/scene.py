"""Draws a recorded step as a frame of a video: the game with the gaze on it, what is seen, both heads."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw

from foajax.sensors.gaze import names
from foajax.sensors.reconstruct import paint, tables
from foajax.sensors.registry import make_sensor
from foajax.viewing.recording import Recording
from foajax.viewing.style import FAINT, INK, NATURAL, PANEL, PAPER, VISION, brighten, draw_gaze, enlarge, fit, font

_SIZE = (960, 628)  # even, as video codecs want it
_MARGIN = 16
_TOP = 80  # of the pictures
_TALL = 420  # of the screen
_VIEW = 320  # of the sensor's view
_HEADS = _TALL - 60  # of all their actions' rows
_THINNEST = 9  # such a row
_MOST_VISUAL = 25  # of the vision head's
_VIEW_LEFT, _HEADS_LEFT = 2 * _MARGIN + _VIEW, 3 * _MARGIN + 2 * _VIEW
_CHART = (960 - 2 * _MARGIN, 84)
_LOST, _REWARD = "#ff6b6b", "#ffd166"


class Scene:
    """Draws the steps of one recording."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._sensor = make_sensor(recording.config.sensor).packed
        self._painting = tables(self._sensor, recording.config.env.frame_shape)
        self._values = recording.values
        self._white = recording.white
        self._scale = fit(recording.screens.shape[:2], (_TALL, _VIEW))
        self._chart = _chart(recording)
        self._still = self._background()
        probs = recording.vision_probs
        self._visual = np.arange(0) if probs is None else _likeliest(probs, _MOST_VISUAL)
        self._natural = _likeliest(recording.natural_probs, _HEADS // _THINNEST - len(self._visual))
        self._row = min(24, _HEADS // (len(self._natural) + len(self._visual)))

    def draw(self, step: int) -> Image.Image:
        """Returns the picture of a step, RGB."""
        image = self._still.copy()
        self._draw_screen(image, step)
        self._draw_view(image, step)
        self._draw_heads(image, step)
        self._draw_numbers(image, step)
        left, top = _MARGIN, _SIZE[1] - _MARGIN - _CHART[1]
        x = round(step / max(len(self._recording.score) - 1, 1) * (_CHART[0] - 1))
        image.paste(self._chart.crop((0, 0, x + 1, _CHART[1])), (left, top))
        ImageDraw.Draw(image).line([left + x, top, left + x, top + _CHART[1]], fill=INK)
        return image

    def _background(self) -> Image.Image:
        """Draws all that does not change from step to step."""
        recording = self._recording
        image = Image.new("RGB", _SIZE, PAPER)
        pen = ImageDraw.Draw(image)
        pen.text((_MARGIN, 12), recording.title, fill=INK, font=font(16))
        pen.text((_MARGIN, 36), recording.about, fill=FAINT, font=font(12))
        for left, caption in ((_MARGIN, "game"), (_VIEW_LEFT, "what the sensor sees")):
            pen.text((left, _TOP - 16), caption, fill=FAINT, font=font(12))
        faint = Image.blend(self._chart, Image.new("RGB", _CHART, PANEL), 0.7)
        image.paste(faint, (_MARGIN, _SIZE[1] - _MARGIN - _CHART[1]))
        return image

    def _draw_screen(self, image: Image.Image, step: int) -> None:
        recording, scale = self._recording, self._scale
        screen = enlarge(Image.fromarray(recording.screens[step]), scale)
        top, down, across = recording.frame_origin
        point, pixel = recording.focal_point[step], (scale * down, scale * across)
        draw_gaze(screen, self._sensor, point, scale=pixel, top=scale * top, halo=True)
        image.paste(screen, (_MARGIN, _TOP))

    def _draw_view(self, image: Image.Image, step: int) -> None:
        """Draws the values at their place in the frame, and below them the images as the network gets them."""
        recording = self._recording
        picture = paint(self._values[step], recording.focal_point[step], self._painting)
        view = enlarge(brighten(picture, self._white), fit(picture.shape[:2], (_VIEW, _VIEW)))
        image.paste(view, (_VIEW_LEFT, _TOP))
        if len(recording.images) == 1 and recording.images[0].shape[1:3] == recording.config.env.frame_shape:
            return  # the whole frame: the same picture once more
        pen, left, top = ImageDraw.Draw(image), _VIEW_LEFT, _TOP + view.height + 6
        pen.text((left, top), "the same values, each once", fill=FAINT, font=font(12))
        for part in recording.images:
            small = enlarge(brighten(part[step], self._white), fit(part.shape[1:3], (_TALL - _VIEW - 26, 110)))
            image.paste(small, (left, top + 20))
            left += small.width + 8

    def _draw_heads(self, image: Image.Image, step: int) -> None:
        recording = self._recording
        probs, chosen = recording.natural_probs[step], int(recording.natural_action[step])
        called, some = recording.actions, self._natural
        top = self._draw_head(image, _TOP - 16, "natural action", NATURAL, called, some, probs, chosen)
        if recording.vision_probs is not None:
            probs, chosen = recording.vision_probs[step], int(recording.vision_action[step])
            called, some = names(recording.config.gaze), self._visual
            self._draw_head(image, top, "visual action", VISION, called, some, probs, chosen)
        else:
            note = f"gaze is not learned: {recording.config.gaze.mode}"
            ImageDraw.Draw(image).text((_HEADS_LEFT, top), note, fill=FAINT, font=font(12))

    def _draw_head(
        self,
        image: Image.Image,
        top: int,
        what: str,
        colour: str,
        called: Sequence[str],
        some: np.ndarray,
        probs: np.ndarray,
        chosen: int,
    ) -> int:
        """Draws the probabilities of `some` of a head's actions, the chosen one bright; returns the next head's top."""
        pen, height = ImageDraw.Draw(image), self._row
        left, right = _HEADS_LEFT, _SIZE[0] - _MARGIN
        caption = what if len(some) == len(called) else f"{what}, the {len(some)} likeliest of {len(called)}"
        pen.text((left, top), caption, fill=colour, font=font(12))
        top += 18
        small = font(max(8, min(12, height - 4)))
        start = left + 92
        for i in some:
            share, middle = float(probs[i]), top + height // 2
            ink, bar = (INK, colour) if i == chosen else (FAINT, _dim(colour))
            pen.text((start - 8, middle), called[i], fill=ink, font=small, anchor="rm")
            pen.rectangle([start, top + 2, right - 34, top + height - 3], fill=PANEL)
            end = start + round(share * (right - 34 - start))
            if end > start:
                pen.rectangle([start, top + 2, end, top + height - 3], fill=bar)
            pen.text((right, middle), f"{100 * share:.0f}%", fill=ink, font=small, anchor="rm")
            top += height
        return top + 12

    def _draw_numbers(self, image: Image.Image, step: int) -> None:
        recording, pen = self._recording, ImageDraw.Draw(image)
        words = [f"score {recording.score[step]:g}"]
        if recording.lives is not None:
            words.append(f"lives {recording.lives[step]}")
        right = _SIZE[0] - _MARGIN
        pen.text((right, 12), "    ".join(words), fill=INK, font=font(16), anchor="ra")
        y, x = recording.focal_point[step]
        pen.text((right, 36), f"step {step:,}    focal point {y}, {x}", fill=FAINT, font=font(12), anchor="ra")
        legend = [(f"value of the natural head {recording.natural_value[step]:.2f}", NATURAL)]
        if recording.vision_value is not None:
            legend.append((f"of the vision head {recording.vision_value[step]:.2f}", VISION))
        legend.append(("points", _REWARD))
        if recording.lives is not None:
            legend.append(("a life lost", _LOST))
        left = _MARGIN
        for text, colour in legend:
            pen.text((left, _SIZE[1] - _MARGIN - _CHART[1] - 20), text, fill=colour, font=font(12))
            left += round(font(12).getlength(text)) + 18


def _chart(recording: Recording) -> Image.Image:
    """Draws both heads' values over the whole game, points as ticks and lost lives as lines."""
    width, height = _CHART
    image = Image.new("RGB", _CHART, PANEL)
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
    """Returns the `most` actions that are likeliest over the game, in their own order; `probs` is [N, n]."""
    return np.sort(np.argsort(-probs.mean(axis=0), kind="stable")[:most])


def _dim(colour: str) -> str:
    """Darkens a colour."""
    return "#" + "".join(f"{int(colour[i : i + 2], 16) * 55 // 100:02x}" for i in (1, 3, 5))
