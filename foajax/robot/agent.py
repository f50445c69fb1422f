"""Runs a trained agent, which sees, decides and moves its gaze. It needs only NumPy and ONNX Runtime.

    agent = Agent("robot/")
    natural, vision = agent.decide(frame)  # once per frame: memory and focal point go on from call to call
    agent.reset()  # where an episode begins

`python agent.py --check` replays the decisions that were recorded in `golden.npz`.
"""

from __future__ import annotations

import functools
import hashlib
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

try:
    import cv2  # adds up a large camera image in a third of NumPy's time; nothing else needs it
except ImportError:
    cv2 = None  # type: ignore[assignment]

LUMA = np.array([0.299, 0.587, 0.114], np.float32)  # of red, green and blue in gray (ITU-R BT.601)
SCREEN = (210, 160)  # an Atari screen's rows and columns
WHOLE = slice(None), slice(None)  # all rows and columns of a frame


class AgentError(Exception):
    """A mistake that the caller can correct. The message is one line."""


class Agent:
    """An exported agent that looks through one camera or at one game's screen.

    Args:
      folder: what `foajax export` wrote.
      greedy: take the likeliest actions; else draw them, as in training.
      seed: of drawn actions and of a random gaze.
      source: 'screen' for Atari screens to crop, uint8 [210, 160]; 'camera' for uint8 [h, w] or [h, w, 3] of any size;
        by default what the agent was trained with. One that sees colours takes [210, 160, 3] or [h, w, 3].
      order: of a colour image's channels: 'rgb', or 'bgr' as OpenCV has it.
    """

    def __init__(
        self, folder: str | Path = ".", *, greedy: bool = False, seed: int = 0, source: str = "", order: str = "rgb"
    ) -> None:
        self.folder = Path(folder)
        self.facts = read_facts(self.folder)
        self.greedy, self.source, self.order = greedy, source or self.facts["source"], order
        if self.source not in ("screen", "camera") or (self.source == "screen" and self.facts["crop_top"] is None):
            raise AgentError(f"source={self.source}: accepted is camera, or screen for an agent of Atari screens")
        self._random = np.random.default_rng(seed)
        self._limits = np.array(self.facts["gaze"]["limits"])  # smallest and largest focal point
        with np.load(self.folder / "arrays.npz") as arrays:
            self._sensors = [Sensor(self.facts, dict(arrays), channel) for channel in range(len(arrays["mean"]))]
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads, options.log_severity_level = 1, 1, 3
        network = str(self.folder / "policy.onnx")
        self._session = onnxruntime.InferenceSession(network, options, providers=["CPUExecutionProvider"])
        self._outputs = {output.name: output.shape for output in self._session.get_outputs()}
        self.reset()

    def reset(self) -> None:
        """Begins an episode: clears memory and last actions, moves the gaze to its start."""
        states = {name[5:]: shape[1:] for name, shape in self._outputs.items() if name.startswith("next_")}
        self.core = {name: np.zeros((1, *shape), np.float32) for name, shape in states.items()}
        self.age = 0  # decisions since the episode began
        self.last_actions: tuple[int, int] | None = None  # change it where the robot did something else
        self._due = 0.0  # price of the last saccade, taken from the next reward as in training
        start, low, high = self.facts["gaze"]["start"], *self._limits
        self.focal_point = self._random.integers(low, high + 1) if start == "random" else np.array(start)
        self.looked_at = self.focal_point  # the last focal point, where focal_point is the next: (y, x), frame pixels
        self.outputs: dict[str, np.ndarray] = {}  # of the network at the last decision

    def decide(self, frame: np.ndarray, reward: float = 0.0) -> tuple[int, int]:
        """Decides upon a frame; returns the natural and the visual action. `reward` is what the last action earned.

        Raises:
          AgentError: the frame or the reward is not accepted. The agent's state stays as it was.
        """
        frame = self.frame(frame, self._sensors[0].reads(self.focal_point))
        seen = [sensor.look(frame, self.focal_point) for sensor in self._sensors]
        feed = {f"image_{i}": np.stack(x)[None] for i, x in enumerate(zip(*seen, strict=True))} | self._side(reward)
        outputs = dict(zip(self._outputs, self._session.run([*self._outputs], feed | self.core), strict=True))
        natural, vision, gaze = self._choose(outputs["natural_logits"]), 0, self.facts["gaze"]
        if gaze["mode"] in ("learned", "random"):
            drawn = gaze["mode"] == "random"
            vision = int(self._random.integers(len(gaze["moves"]))) if drawn else self._choose(outputs["vision_logits"])
        self.core = {name: outputs[f"next_{name}"] for name in self.core}
        moved = (self.focal_point - self.looked_at) * (self.age > 0)  # a start that is set from outside is free
        self._due = gaze["cost"] * (np.hypot(*moved) if gaze["cost_per"] == "pixel" else moved.any())
        self.outputs, self.looked_at, self.last_actions = outputs, self.focal_point, (natural, vision)
        self.age, self.focal_point = self.age + 1, self._move(vision)
        return natural, vision

    def frame(self, image: np.ndarray, area: tuple = WHOLE) -> np.ndarray:
        """Makes the frame, float32 [H, W] or [H, W, 3] in [0, 1], of a screen or, inside `area`, a camera's image."""
        shape, kind = getattr(image, "shape", ()), str(getattr(image, "dtype", type(image).__name__))
        is_camera, color = self.source == "camera", self.facts["color"]
        size = ("h", "w") if is_camera else SCREEN
        pixels = ((3,),) if color else ((), (3,)) if is_camera else ((),)
        is_image = kind == "uint8" and len(shape) > 1 and 0 not in shape and shape[2:] in pixels
        if not is_image or (shape[:2] != SCREEN and not is_camera):
            accepted = " or ".join(f"[{', '.join(map(str, size + pixel))}]" for pixel in pixels)
            gray, hint = ", gray" * (pixels == ((),)), "" if is_camera else "; source='camera' takes any size"
            raise AgentError(f"frame={kind} {list(shape)}: accepted is uint8 {accepted}{gray}{hint}")
        if shape[2:] and self.order not in ("rgb", "bgr"):
            raise AgentError(f"order={self.order}: accepted is rgb or bgr")
        if is_camera and shape != (*self.facts["frame_shape"], *pixels[0]):
            luma = None if color else LUMA if self.order == "rgb" else LUMA[::-1]
            image = shrink(image, self.facts["frame_shape"], luma, area)
        image = image[..., ::-1] if color and self.order == "bgr" else image
        return image.astype(np.float32) * np.float32(1 / 255) if is_camera else halve(image, self.facts["crop_top"])

    def _side(self, reward: float) -> dict[str, np.ndarray]:
        """Makes the input `side`, float32 [1, S]: what the network is told beside the images, if anything."""
        told, parts = self.facts["side"], []
        if told["focal_point"] == "frame":
            parts.append(self.focal_point / np.array(self.facts["frame_shape"]) * 2.0 - 1.0)
        elif told["focal_point"] == "reach":
            parts.append((2 * self.focal_point - self._limits.sum(0)) / np.maximum(np.ptp(self._limits, 0), 1))
        for place, count in enumerate(told["last_actions"] or ()):
            last = -1 if self.last_actions is None else self.last_actions[place]
            parts.append(np.arange(count) == last)
        if not np.isfinite(reward):
            raise AgentError(f"reward={reward}: accepted is a finite number")
        if told["last_reward"]:
            earned = np.sign(reward) if told["clip_reward"] else reward
            parts.append([0.0 if self.last_actions is None else earned - self._due])
        return {"side": np.concatenate(parts).astype(np.float32)[None]} if parts else {}

    def _choose(self, logits: np.ndarray) -> int:
        # The largest of logits with Gumbel noise is a draw from their softmax.
        return int(np.argmax(logits[0] if self.greedy else logits[0] + self._random.gumbel(size=logits.shape[1])))

    def _move(self, vision: int) -> np.ndarray:
        gaze, path = self.facts["gaze"], self.facts["gaze"]["path"]
        to = self.focal_point * gaze["relative"] + gaze["moves"][vision]
        return np.array(path[(self.age + 1) % len(path)]) if gaze["mode"] == "scripted" else np.clip(to, *self._limits)


class Sensor:
    """Looks at one channel of a frame. What lies outside the frame, or where a finer ring is, gives 0."""

    def __init__(self, facts: dict[str, Any], arrays: dict[str, np.ndarray], channel: int = 0) -> None:
        self._sensor, self._shape, self._window = facts["sensor"], facts["frame_shape"], np.array(facts["window"])
        self._arrays, self._channel, self._by_frame = arrays, channel, facts["normalisation"] == "frame"

    def reads(self, focal_point: np.ndarray) -> tuple:
        """Returns the rows and columns of a frame that `look` reads, as slices."""
        whole, corner = self._by_frame or self._sensor.get("peripheral"), focal_point - self._window // 2
        return WHOLE if whole else tuple(map(slice, *np.clip([corner, corner + self._window], 0, self._shape)))

    def look(self, frame: np.ndarray, focal_point: np.ndarray) -> list[np.ndarray]:
        """Returns the normalised images, float32 [h, w] each, at a focal point (y, x)."""
        frame = (frame - frame.mean()) / np.maximum(frame.std(), np.float32(1e-3)) if self._by_frame else frame
        frame, arrays, sensor = np.atleast_3d(frame)[..., self._channel], self._arrays, self._sensor
        top, left = (focal_point - self._window // 2).tolist()
        window = self._cut(frame, top, left) - self._cut(arrays["mean"][self._channel], top, left)
        if sensor["kind"] == "logpolar":
            values = np.add.reduceat(window.ravel()[arrays["pixel"]] * arrays["weight"], arrays["first"])
            return [values.reshape(sensor["rings"], sensor["wedges"])]
        # A weight divides by the number of pixels and by the deviation; it is 0 where a finer ring lies.
        images = [self._sums(window, *ring) * arrays[f"weight_{i}"] for i, ring in enumerate(sensor["rings"])]
        if sensor["peripheral"]:
            cells = (self._cells(frame) - arrays["mean_cells"][self._channel]) * arrays["cell_weight"]
            edges = (arrays["row_edges"], top), (arrays["column_edges"], left)
            rows, columns = ((e[:-1] >= at) & (e[1:] <= at + n) for (e, at), n in zip(edges, self._window, strict=True))
            images.append(cells * ~(rows[:, None] & columns))
        return [self._canvas(images, top, left)] if sensor["layout"] == "canvas" else images

    def _cut(self, image: np.ndarray, top: int, left: int) -> np.ndarray:
        y, x = max(top, 0), max(left, 0)
        part = image[y : top + self._window[0], x : left + self._window[1]]
        area = np.zeros(self._window, np.float32)
        area[y - top : y - top + part.shape[0], x - left : x - left + part.shape[1]] = part
        return area

    def _sums(self, window: np.ndarray, height: int, width: int, factor: int) -> np.ndarray:
        """Sums up each block of a ring, or takes its first pixel (`stride`); the last blocks may be smaller."""
        top, left = self._window // 2 - (height // 2, width // 2)
        area = window[top : top + height, left : left + width]
        if factor == 1 or self._sensor["pooling"] == "stride":
            return area[::factor, ::factor]
        return _block_sums(_block_sums(area, factor).T, factor).T

    def _cells(self, image: np.ndarray) -> np.ndarray:
        """Sums up each cell of the peripheral grid, which covers the frame, or takes its first pixel (`stride`)."""
        rows, columns = self._arrays["row_edges"][:-1], self._arrays["column_edges"][:-1]
        if self._sensor["pooling"] == "stride":
            return image[rows][:, columns]
        return np.add.reduceat(np.add.reduceat(image, rows, 0), columns, 1)

    def _canvas(self, images: list[np.ndarray], top: int, left: int) -> np.ndarray:
        """Paints every value over the pixels that it stands for, on an image of the frame's size."""
        values = np.concatenate([*(image.ravel() for image in images), np.zeros(1, np.float32)])
        canvas = values.take(self._arrays["paint_background"])
        y, x, area = max(top, 0), max(left, 0), values.take(self._arrays["paint_window"])
        room = canvas[y : top + len(area), x : left + area.shape[1]]
        room[:] = area[y - top : y - top + room.shape[0], x - left : x - left + room.shape[1]]
        return canvas


def shrink(image: np.ndarray, frame_shape: Sequence[int], luma: np.ndarray | None, area: tuple = WHOLE) -> np.ndarray:
    """Shrinks a camera's image to a frame by area means: uint8 [H, W] or, without luma, [H, W, 3]; 0 outside `area`.

    An image at least twice as large as the frame is averaged before its colours are mixed. Training rounds the gray of
    each pixel first, so pixels of the frame may differ by one gray level. In smaller images only exact halves may.
    """
    if image.ndim == 3 and luma is not None and np.any(np.array(image.shape[:2]) < 2 * np.array(frame_shape)):
        image = ((image @ np.rint(1000 * luma).astype(int) + 500) // 1000).astype(np.uint8)
    for axis, wanted in enumerate(frame_shape):
        if image.shape[axis] < wanted:
            image = image.repeat(-(-wanted // image.shape[axis]), axis)
    axes = zip(image.shape, frame_shape, area, strict=False)
    means = _add_up(image, [_spans(size, wanted, *part.indices(wanted)[:2]) for size, wanted, part in axes], luma)
    frame = np.zeros((*frame_shape, *means.shape[2:]), np.uint8)
    frame[area] = np.floor(means + np.float32(0.5))
    return frame


def _add_up(image: np.ndarray, spans: Sequence[tuple], luma: np.ndarray | None) -> np.ndarray:
    # Rows are summed before colours are mixed, as the first step reads every byte. No matrix products here: their
    # threads would wait for each other. `_share` needs a spare sum at the end.
    (first, shared, part, height), (left, divided, piece, width) = spans
    image = image[first[0] : first[-1] + 1, left[0] : left[-1] + 1]
    first, left, count = first - first[0], left - left[0], len(first) - 1
    sums: Any = np.empty((count + 1 + len(shared), *image.shape[1:]), np.float32)
    for i in range(count):
        rows = image[first[i] : first[i + 1]]
        if cv2:
            cv2.reduce(rows, 0, cv2.REDUCE_SUM, sums[i : i + 1], cv2.CV_32F)
        else:
            sums[i] = rows.sum(0, np.uint32)
    sums[count], sums[count + 1 :] = 0, image[first[shared]]
    if image.ndim == 3 and luma is not None:
        sums = cv2.transform(sums, luma[None]) if cv2 else sum(sums[..., i] * luma[i] for i in range(3))
    flat, colors = sums.reshape(len(sums), -1), sums.shape[2:]
    strips = _share(flat[: count + 1], flat[count + 1 :], shared, part)[:-1]
    strips = strips.reshape(count, -1, 3).transpose(2, 0, 1).reshape(3 * count, -1) if colors else strips
    sums = np.zeros((len(left), len(strips)), np.float32)
    sums[:-1] = np.add.reduceat(strips[:, : left[-1]], left[:-1], 1).T
    means = _share(sums, strips.T[left[divided]], divided, piece)[:-1].T * np.float32(height * width)
    return means.reshape(3, count, -1).transpose(1, 2, 0) if colors else means


def halve(screen: np.ndarray, crop_top: int) -> np.ndarray:
    """Averages each 2x2 block of the screen's rows crop_top .. crop_top + 159: float32 [80, 80] in [0, 1]."""
    kept = screen[crop_top : crop_top + 160].astype(np.uint16)
    rows = kept[0::2] + kept[1::2]
    return (rows[:, 0::2] + rows[:, 1::2]).astype(np.float32) * np.float32(1 / 1020)


def read_facts(folder: Path) -> dict[str, Any]:
    """Reads agent.json and checks that `policy.onnx` and `arrays.npz` are the files that were exported."""
    try:
        facts = json.loads((folder / "agent.json").read_text(encoding="utf-8"))
        if facts["format"] != 1:
            raise AgentError(f"{folder}: has format {facts['format']}; accepted by this agent.py is 1; export again")
        for name in ("policy.onnx", "arrays.npz"):
            if hashlib.sha256((folder / name).read_bytes()).hexdigest() != facts["files"][name]:
                raise AgentError(f"{folder / name}: is not the file that was exported; export again")
    except (OSError, ValueError, KeyError, TypeError) as e:
        raise AgentError(f"{folder}: accepted is a folder that foajax export wrote ({type(e).__name__}: {e})") from None
    return facts


@functools.cache
def _spans(source: int, target: int, begin: int, end: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Returns the source pixel in which each target pixel begins; which ones begin inside it; how far; the scale."""
    first, rest = np.divmod(np.arange(begin, end + 1) * source, target)
    shared = np.flatnonzero(rest)
    return first, shared, (rest[shared] / target).astype(np.float32)[:, None], target / source


def _share(sums: np.ndarray, pixels: np.ndarray, shared: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Moves `part` of each shared pixel from its sum to the one before; the spare last sum absorbs the first's."""
    moved = part * pixels
    sums[shared] -= moved
    sums[shared - 1] += moved
    return sums


def _block_sums(x: np.ndarray, factor: int) -> np.ndarray:
    sums = x[::factor].copy()
    for i in range(1, factor):
        sums[: len(x[i::factor])] += x[i::factor]
    return sums


if __name__ == "__main__":
    from check import main

    sys.exit(main(sys.argv[1:]))
