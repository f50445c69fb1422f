"""Real processes for the tests: commands started, watched, and read back from their run directories."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

TINY = [
    "sensor=rings",
    "sensor.rings=[[16,16,2]]",
    "sensor.layout=packed",
    "network.dense=16",
    "network.lstm=16",
    "env.num_envs=8",
    "learner.num_minibatches=2",
    "learner.rollout_length=5",
    "learner.schedule=constant",  # so that a run may be made longer
    "train.log_every=0.01",
]


STARTED: list[subprocess.Popen[str]] = []  # by the test that runs


def start(*arguments: str, module: str = "train", **options: Any) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", f"foajax.{module}", *arguments]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    STARTED.append(subprocess.Popen(command, text=True, **(pipes | options)))
    return STARTED[-1]


def finish(*arguments: str, module: str = "train", **options: Any) -> tuple[int, str, str]:
    """Exit code, stdout, stderr."""
    with start(*arguments, module=module, **options) as process:
        try:
            out, err = process.communicate(timeout=600)
        except subprocess.TimeoutExpired:
            process.kill()
            raise
    return process.returncode, out, err


def rows(run: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]


def has_rows(run: Path) -> bool:
    """Whether something has been learned and logged; never half a row."""
    file = run / "metrics.jsonl"
    return file.exists() and file.read_bytes().endswith(b"\n")


def newest(run: Path) -> int:
    """The env_steps of the newest complete checkpoint; 0 where there is none."""
    directory = run / "checkpoints"
    return max((int(n) for n in os.listdir(directory) if n.isdigit()), default=0) if directory.exists() else 0


def wait_for(condition: Callable[[], object], process: subprocess.Popen[str], timeout: float = 300) -> None:
    end = time.monotonic() + timeout
    while not condition():
        assert process.poll() is None, process.communicate()
        if time.monotonic() > end:
            process.kill()
            raise TimeoutError(process.communicate())
        time.sleep(0.02)
