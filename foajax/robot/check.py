"""Replays the decisions that were recorded when the agent was exported: `python agent.py --check`."""

from __future__ import annotations

import hashlib
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from agent import Agent, AgentError

TOLERANCE = 1e-4  # of logits


def check(folder: Path) -> dict[str, Any]:
    """Compares every recorded step; gives how many there were, the largest difference of logits and milliseconds.

    Raises:
      AgentError: something differs; the message says what comes first.
    """
    agent = Agent(folder, greedy=True)
    _check_files(agent)
    with np.load(folder / "golden.npz") as arrays:
        golden = dict(arrays)
    _check_images(agent, golden)
    gaze, largest, seconds = agent.facts["gaze"], 0.0, []
    for step, frame in enumerate(golden["frame"]):
        if golden["is_first"][step]:
            agent.reset()
        if gaze["mode"] == "random" or (gaze["start"] == "random" and golden["is_first"][step]):
            agent.focal_point = golden["focal_point"][step]  # what was drawn there is not drawn here
        _same("focal point", step, agent.focal_point, golden["focal_point"][step])
        begin = time.perf_counter()
        actions = agent.decide(frame, float(golden["reward"][step]))
        seconds.append(time.perf_counter() - begin)
        for head in ("natural", "vision"):
            if f"{head}_logits" in golden:
                difference = np.abs(agent.outputs[f"{head}_logits"][0] - golden[f"{head}_logits"][step]).max()
                if not difference <= TOLERANCE:
                    raise AgentError(f"step {step}: {head} logits differ by {difference:.1e}, more than {TOLERANCE}")
                largest = max(largest, float(difference))
        _same("natural action", step, actions[0], golden["natural_action"][step])
        if gaze["mode"] != "random":
            _same("visual action", step, actions[1], golden["vision_action"][step])
    median, late = np.percentile(1e3 * np.array(seconds), [50, 99])
    return {"steps": len(seconds), "logits": largest, "median_ms": float(median), "p99_ms": float(late)}


def main(words: Sequence[str]) -> int:
    """The command: 0 where the folder does what it was exported to do."""
    try:
        if list(words) != ["--check"]:
            raise AgentError(f"{' '.join(words) or 'nothing'}: accepted is --check")
        found = check(Path(__file__).parent)
    except AgentError as error:
        print(f"check: error: {error}", file=sys.stderr)
        return 1
    print(
        f"{found['steps']} steps: same actions, same focal points, logits within {found['logits']:.1e}; "
        f"a decision takes {found['median_ms']:.2f} ms (99th percentile {found['p99_ms']:.2f} ms)"
    )
    return 0


def _check_files(agent: Agent) -> None:
    for name, digest in agent.facts["files"].items():
        file = agent.folder / name
        if not file.exists() or hashlib.sha256(file.read_bytes()).hexdigest() != digest:
            if name.endswith(".py"):
                print(f"check: {name} has been changed since the export", file=sys.stderr)
            else:
                raise AgentError(f"{name}: is not the file that was exported; export again")


def _check_images(agent: Agent, golden: dict[str, np.ndarray]) -> None:
    """Camera images become frames as in training, to one gray level."""
    camera = Agent(agent.folder, source="camera")
    for name in [name for name in golden if name.startswith("image_")]:
        frame, wanted = 255 * camera.frame(golden[name]), golden[name.replace("image", "gray")]
        difference = np.abs(np.rint(frame) - wanted).max()
        if difference > 1:
            raise AgentError(f"{name}: becomes a frame that differs by {difference:.0f} gray levels, more than 1")


def _same(what: str, step: int, here: Any, wanted: Any) -> None:
    if not np.array_equal(here, wanted):
        raise AgentError(f"step {step}: {what} is {np.asarray(here).tolist()}, recorded was {wanted.tolist()}")
