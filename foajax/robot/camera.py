"""Lets the agent look through a camera, at a video file or at a stream: `python camera.py --source 0`.

For each image the agent decides. `--drive my_robot:drive` names a function that gets the natural and the visual action
and moves the robot; it returns the reward, None for 0. `--draw seen.mp4` films where the agent looks. Every
`--log-every` seconds a line says how long each stage takes. SIGTERM and Ctrl-C end the loop after the current frame.
A lost camera is opened again, up to `--retries` times in a row, and the agent keeps its memory. A file ends the loop.
"""

from __future__ import annotations

import argparse
import collections
import importlib
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy: threads for small sums only wait for each other

import cv2
import numpy as np
from agent import Agent, AgentError

Drive = Callable[[int, int], float | None]
STAGES = ("read", "decide", "drive", "draw")
KEPT = 1000  # newest latencies of a stage, for its percentiles
COLOUR = (0, 255, 255)  # of the drawn areas, BGR


class Camera:
    """Reads BGR images from an OpenCV source and opens it again when they stop.

    Args:
      source: a camera's number, a file or a stream's address.
      rate: decisions per second that the agent is used to; images in between are skipped.
      retries: how often in a row the source is opened again.
      wait: seconds before each attempt.
    """

    def __init__(self, source: str, *, rate: float, retries: int = 5, wait: float = 1.0) -> None:
        self._source: int | str = int(source) if source.isdecimal() else source
        self._is_file, self._retries, self._wait = Path(source).is_file(), retries, wait
        self._capture = cv2.VideoCapture(self._source)
        if not self._capture.isOpened():
            accepted = "a camera's number, a video file or a stream's address"
            raise AgentError(f"source={source}: cannot be opened; accepted is {accepted}")
        fps = self._capture.get(cv2.CAP_PROP_FPS)
        fps = fps if 0 < fps < 1000 else rate  # some drivers say 0, or nonsense
        self.every = max(1, round(fps / rate))  # one image in so many is decided upon
        self.period = self.every / fps  # seconds between two decisions

    def images(self, stopped: Callable[[], bool]) -> Iterator[np.ndarray]:
        """Yields images until a file ends or `stopped()`; `AgentError` if a lost camera does not come back."""
        while not stopped():
            image = self._read()
            if image is not None:
                yield image
            elif self._is_file or not self._reopen(stopped):
                return

    def close(self) -> None:
        self._capture.release()

    def _read(self) -> np.ndarray | None:
        for _ in range(self.every - 1):
            if not self._capture.grab():
                return None
        found, image = self._capture.read()
        return image if found else None

    def _reopen(self, stopped: Callable[[], bool]) -> bool:
        """Opens a lost camera again; returns False if `stopped()` meanwhile."""
        for attempt in range(1, self._retries + 1):
            say(f"camera lost; attempt {attempt} of {self._retries} in {self._wait:g} s")
            self._capture.release()
            time.sleep(self._wait)
            if stopped():
                return False
            self._capture.open(self._source)
            if self._capture.isOpened() and self._capture.grab():
                say("camera is back; the agent goes on with the memory that it had")
                return True
        raise AgentError(f"source={self._source}: is lost; {self._retries} attempts to open it again have failed")


class Latencies:
    """Collects how long each stage takes, in seconds."""

    def __init__(self) -> None:
        self._kept = {stage: collections.deque[float](maxlen=KEPT) for stage in STAGES}
        self.frames = self.late = 0  # so far

    def add(self, seconds: dict[str, float], period: float) -> None:
        """Adds one frame; warns if the stages after reading take longer than `period`, in seconds."""
        self.frames += 1
        for stage, value in seconds.items():
            self._kept[stage].append(value)
        work = sum(value for stage, value in seconds.items() if stage != "read")
        if work > period:
            self.late += 1
            say(f"frame {self.frames} took {1e3 * work:.1f} ms, longer than its period of {1e3 * period:.1f} ms")

    def __str__(self) -> str:
        parts = []
        for stage, kept in self._kept.items():
            if kept:
                median, late = 1e3 * np.percentile(kept, [50, 99])
                parts.append(f"{stage} {median:.2f} ms (99%: {late:.2f})")
        return f"{self.frames} frames, {self.late} late; " + ", ".join(parts)


def run(
    agent: Agent,
    camera: Camera,
    *,
    drive: Drive | None = None,
    draw: Callable[[np.ndarray], None] | None = None,
    stopped: Callable[[], bool] = lambda: False,
    log_every: float = 10.0,
) -> Latencies:
    """Decides upon each image until they end or `stopped()`; returns the latencies of the stages."""
    latencies, logged, reward = Latencies(), time.monotonic(), 0.0
    begin = time.perf_counter()
    for image in camera.images(stopped):
        ends = {"read": time.perf_counter()}
        actions = agent.decide(image, reward)
        ends["decide"] = time.perf_counter()
        if drive is not None:
            reward = drive(*actions) or 0.0
            ends["drive"] = time.perf_counter()
        if draw is not None:
            draw(drawn(image, agent))
            ends["draw"] = time.perf_counter()
        begins = [begin, *ends.values()]
        seconds = {stage: end - start for (stage, end), start in zip(ends.items(), begins, strict=False)}
        latencies.add(seconds, camera.period)
        if time.monotonic() - logged >= log_every:
            logged = time.monotonic()
            say(str(latencies))
        begin = time.perf_counter()
    return latencies


def drawn(image: np.ndarray, agent: Agent) -> np.ndarray:
    """Draws the areas that the agent has just looked at, and the natural action, on a copy of the image."""
    image = image.copy() if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    scale = np.array(image.shape[:2]) / agent.facts["frame_shape"]
    sensor = agent.facts["sensor"]
    sizes = [ring[:2] for ring in sensor["rings"]] if sensor["kind"] == "rings" else [agent.facts["window"]]
    for size in sizes:
        corner = agent.looked_at - np.array(size) // 2
        top, left = np.rint(corner * scale).astype(int).tolist()
        bottom, right = np.rint((corner + size) * scale).astype(int).tolist()
        cv2.rectangle(image, (left, top), (right - 1, bottom - 1), COLOUR, 2)
    name = agent.facts["actions"][agent.last_actions[0]] if agent.last_actions else ""
    cv2.putText(image, name, (10, 30), cv2.FONT_HERSHEY_SIMPLEX, 1.0, COLOUR, 2)
    return image


class Film:
    """Writes images to a video file, which is opened with the first image's size."""

    def __init__(self, path: str, period: float) -> None:
        self._path, self._fps = path, 1 / period
        self._writer: Any = None

    def __call__(self, image: np.ndarray) -> None:
        if self._writer is None:
            codec = cv2.VideoWriter.fourcc(*("MJPG" if self._path.endswith(".avi") else "mp4v"))
            self._writer = cv2.VideoWriter(self._path, codec, self._fps, (image.shape[1], image.shape[0]))
            if not self._writer.isOpened():
                raise AgentError(f"draw={self._path}: cannot be written; accepted is a .mp4 or .avi file")
        self._writer.write(image)

    def close(self) -> None:
        if self._writer is not None:
            self._writer.release()


def say(text: str) -> None:
    """Prints one line on stderr."""
    print(f"camera: {text}", file=sys.stderr, flush=True)


def main(words: list[str] | None = None) -> int:
    """Runs the command; returns 0 after a file's end or a request to stop, 1 after an error."""
    options = _options().parse_args(words)
    requests: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda caught, _: requests.append(caught))
    camera = film = None
    try:
        agent = Agent(options.folder, greedy=options.greedy, seed=options.seed, source="camera", order="bgr")
        rate = options.rate or agent.facts["steps_per_second"]
        camera = Camera(options.source, rate=rate, retries=options.retries, wait=options.wait)
        film = Film(options.draw, camera.period) if options.draw else None
        drive = _function(options.drive) if options.drive else None
        found = run(agent, camera, drive=drive, draw=film, stopped=lambda: bool(requests), log_every=options.log_every)
        say(f"{'stopped' if requests else 'end'}: {found}")
        return 0
    except AgentError as error:
        say(f"error: {error}")
        return 1
    finally:
        for opened in (camera, film):
            if opened is not None:
                opened.close()


def _function(name: str) -> Drive:
    module, _, function = name.partition(":")
    sys.path.insert(0, os.getcwd())  # where the command is given; Python has put this file's directory there
    try:
        return getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError, ValueError) as error:
        raise AgentError(f"drive={name}: accepted is module:function ({error})") from None


def _options() -> argparse.ArgumentParser:
    text = (__doc__ or "").splitlines()[0]
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--source", default="0", help="a camera's number, a video file or a stream's address")
    parser.add_argument("--folder", default=str(Path(__file__).parent), help="folder that foajax export wrote")
    parser.add_argument("--rate", type=float, help="decisions per second; None: as in training")
    parser.add_argument("--greedy", action="store_true", help="take the likeliest actions")
    parser.add_argument("--seed", type=int, default=0, help="seed of drawn actions")
    parser.add_argument("--drive", help="module:function that moves the robot")
    parser.add_argument("--draw", help="video file to write, with the areas that were looked at")
    parser.add_argument("--retries", type=int, default=5, help="attempts in a row to open a lost camera")
    parser.add_argument("--wait", type=float, default=1.0, help="seconds before each attempt")
    parser.add_argument("--log-every", type=float, default=10.0, help="seconds between two lines of latencies")
    return parser


if __name__ == "__main__":
    sys.exit(main())
