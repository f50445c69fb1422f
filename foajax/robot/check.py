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


def check(folder: Path) -> dict[str, Any]:
    """Compares every recorded step; returns how many there were, how much differed, and milliseconds per decision.

    After each step the agent takes over the recorded decision, so that one difference does not lead to others.

    Raises:
      AgentError: more differs than agent.json allows; the message states the first difference.
    """
    agent = Agent(folder, greedy=True)
    _check_files(agent)
    with np.load(folder / "golden.npz") as arrays:
        golden = dict(arrays)
    _check_images(agent, golden)
    allowed, largest, same, seconds = agent.facts["check"], 0.0, [], []
    for step, frame in enumerate(golden["frame"]):
        if golden["is_first"][step]:
            agent.reset()
        _place_gaze(agent, golden, step)
        begin = time.perf_counter()
        actions = agent.decide(frame, float(golden["reward"][step]))
        seconds.append(time.perf_counter() - begin)
        for head in ("natural", "vision"):
            if f"{head}_logits" in golden:
                difference = np.abs(agent.outputs[f"{head}_logits"][0] - golden[f"{head}_logits"][step]).max()
                if not difference <= allowed["logits"]:
                    accepted = f"accepted is {allowed['logits']:g}"
                    raise AgentError(f"step {step}: {head} logits differ by {difference:.1e}; {accepted}")
                largest = max(largest, float(difference))
        recorded = int(golden["natural_action"][step]), int(golden["vision_action"][step])
        same.append(actions == recorded or (agent.facts["gaze"]["mode"] == "random" and actions[0] == recorded[0]))
        if not same[-1] and allowed["same"] == 1:
            raise AgentError(f"step {step}: actions are {list(actions)}; accepted is {list(recorded)}, as recorded")
        agent.last_actions = recorded
    if np.mean(same) < allowed["same"]:
        raise AgentError(f"{np.mean(same):.1%} of the actions are as recorded; accepted is >= {allowed['same']:.0%}")
    median, late = np.percentile(1e3 * np.array(seconds), [50, 99])
    found = {"steps": len(same), "logits": largest, "same": float(np.mean(same))}
    return found | {"median_ms": float(median), "p99_ms": float(late)}


def _place_gaze(agent: Agent, golden: dict[str, np.ndarray], step: int) -> None:
    """Moves the gaze to the recorded focal point; `AgentError` if it should be there by itself and is not."""
    recorded, gaze = golden["focal_point"][step], agent.facts["gaze"]
    drawn = gaze["mode"] == "random" or (gaze["start"] == "random" and agent.age == 0)
    if not drawn and agent.facts["check"]["same"] == 1 and not np.array_equal(agent.focal_point, recorded):
        wrong = f"focal point is {agent.focal_point.tolist()}"
        raise AgentError(f"step {step}: {wrong}; accepted is {recorded.tolist()}, as recorded")
    agent.focal_point = recorded


def main(words: Sequence[str]) -> int:
    """Checks the folder of this file; returns 0 if it passes, else 1 with a line on stderr."""
    try:
        if list(words) != ["--check"]:
            raise AgentError(f"{' '.join(words) or 'no words'}: accepted is --check")
        found = check(Path(__file__).parent)
    except AgentError as error:
        print(f"check: error: {error}", file=sys.stderr)
        return 1
    print(
        f"{found['steps']} steps: {found['same']:.1%} of the actions as recorded, logits within {found['logits']:.1e}; "
        f"a decision takes {found['median_ms']:.2f} ms (99th percentile {found['p99_ms']:.2f} ms)"
    )
    return 0


def _check_files(agent: Agent) -> None:
    for name, digest in agent.facts["files"].items():
        file = agent.folder / name
        if not file.exists() or hashlib.sha256(file.read_bytes()).hexdigest() != digest:
            if name.endswith(".py"):
                print(f"check: warning: {name} has been changed since the export", file=sys.stderr)
            else:
                raise AgentError(f"{name}: is not the file that was exported; export again")


def _check_images(agent: Agent, golden: dict[str, np.ndarray]) -> None:
    """Compares the frames made of recorded camera images with training's; one gray level may differ."""
    camera = Agent(agent.folder, source="camera")
    for name in [name for name in golden if name.startswith("image_")]:
        frame, wanted = 255 * camera.frame(golden[name]), golden[name.replace("image", "frame")]
        difference = np.abs(np.rint(frame) - wanted).max()
        if difference > 1:
            raise AgentError(f"{name}: its frame differs by {difference:.0f} gray levels; accepted is 1")
