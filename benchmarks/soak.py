"""Does a long run stay as it began: memory, speed, open files?

    python benchmarks/soak.py [minutes=30] [out=soak.json] [run=<dir>] [experiment=... and other keys of a run]

Trains in a process of its own, a new run or the one in `run`, and reads /proc meanwhile. The first sixth of the time
does not count: programs are compiled and buffers fill. The next thirtieth is the beginning, the last thirtieth the end:
a minute each of 30. Speeds are taken over a sixth each. The exit code is 1 if resident memory grew by more than 2 %,
speed fell by more than 5 %, or more files are open or threads run than at the beginning. Linux only; run it on an
otherwise idle machine.
"""

from __future__ import annotations

import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from pydantic import Field

from foajax import cli
from foajax.config.parse import ConfigError
from foajax.reporting import bench

_EVERY = 1.0  # seconds between two looks


class Options(bench.Options):
    minutes: float = Field(30.0, ge=2, description="How long to watch.")
    run: str | None = Field(None, description="Directory of the run; null for a temporary one.")


class Sample(NamedTuple):
    """What one look at the process found."""

    time: float  # seconds since the process began
    memory: int  # resident, bytes
    files: int  # open
    threads: int


def sample(process: int, begin: float) -> Sample:
    """Reads memory, open files and threads of a process from /proc."""
    proc = Path(f"/proc/{process}")
    status = dict(line.split(":", 1) for line in (proc / "status").read_text().splitlines())
    return Sample(
        time=time.monotonic() - begin,
        memory=int(status["VmRSS"].split()[0]) * 1024,
        files=len(os.listdir(proc / "fd")),
        threads=int(status["Threads"]),
    )


def verdict(samples: Sequence[Sample], rows: Sequence[dict], seconds: float) -> dict[str, float]:
    """Summarises each quantity at the beginning and at the end of a run of `seconds`.

    Args:
      samples: in order of time.
      rows: of `metrics.jsonl`; their `time` is the run's own.
      seconds: how long the run was to last.

    Raises:
      ConfigError: there are too few rows to measure a speed.
    """
    settled, window = seconds / 6, seconds / 30
    times = [row["time"] for row in rows] or [0.0]
    early = [row for row in rows if times[0] + settled <= row["time"] <= times[0] + 2 * settled]
    late = [row for row in rows if row["time"] >= times[-1] - settled]
    if min(len(early), len(late)) < 2:
        accepted = f"enough minutes for two rows of metrics.jsonl in each sixth (there are {len(rows)} rows in all)"
        raise ConfigError(f"minutes={seconds / 60:g}: accepted is {accepted}")
    end = samples[-1].time
    first = [s for s in samples if settled <= s.time < settled + window]
    last = [s for s in samples if s.time >= end - window]
    result = {}
    for name in ("memory", "files", "threads"):
        # Writing a checkpoint takes files and a thread for a moment; the least number is what stays.
        pick = statistics.median if name == "memory" else min
        result[f"{name}_begin"], result[f"{name}_end"] = (
            pick(getattr(s, name) for s in part) for part in (first, last)
        )
    result["speed_begin"], result["speed_end"] = _speed(early), _speed(late)
    return result


def complaints(result: dict[str, float]) -> list[str]:
    """Lists what has become worse; empty if nothing has."""
    growth = result["memory_end"] / result["memory_begin"] - 1
    fall = 1 - result["speed_end"] / result["speed_begin"]
    found = []
    if growth > 0.02:
        found.append(f"memory has grown by {100 * growth:.2f} %")
    if fall > 0.05:
        found.append(f"speed has fallen by {100 * fall:.2f} %")
    for name in ("files", "threads"):
        if result[f"{name}_end"] > result[f"{name}_begin"]:
            found.append(f"{name} have grown from {result[f'{name}_begin']:.0f} to {result[f'{name}_end']:.0f}")
    return found


def train(words: Sequence[str], run: Path, seconds: float) -> tuple[list[Sample], list[dict], int]:
    """Trains for `seconds`; returns the samples, the rows of metrics and the exit code."""
    command = [sys.executable, "-m", "foajax.train", *words, f"run={run}", "train.env_steps=2000000000"]
    file = run / "metrics.jsonl"
    before = len(_lines(file))
    begin = time.monotonic()
    with tempfile.TemporaryFile("w+") as log, subprocess.Popen(command, stdout=log, stderr=log) as process:
        samples = []
        while time.monotonic() - begin < seconds and process.poll() is None:
            time.sleep(_EVERY)
            if process.poll() is None:
                samples.append(sample(process.pid, begin))
        process.send_signal(signal.SIGTERM)
        if code := process.wait():
            log.seek(0)
            print(log.read(), end="", file=sys.stderr)
            return samples, [], code
    return samples, [json.loads(line) for line in _lines(file)[before:]], 0


def main(words: Sequence[str]) -> int:
    keys = Options.model_fields
    ours = [word for word in words if word.partition("=")[0] in keys]
    options = cli.parse(Options, ours)
    seconds = 60 * options.minutes
    rest = [word for word in words if word not in ours]
    with tempfile.TemporaryDirectory() as directory:
        samples, rows, code = train(rest, Path(options.run or f"{directory}/run"), seconds)
    if code:
        return code
    result = verdict(samples, rows, seconds)
    for name in ("memory", "files", "threads", "speed"):
        begin, end = result[f"{name}_begin"], result[f"{name}_end"]
        print(f"{name:8} {begin:14.1f} {end:14.1f} {100 * (end / begin - 1):+7.2f} %")
    found = complaints(result)
    print("; ".join(found) or f"as it began, after {seconds / 60:g} minutes and {rows[-1]['env_steps']:,} env_steps")
    if options.out:
        report = {"seconds": seconds, "result": result, "samples": samples}
        bench.write("out", options.out, report, ["python", "benchmarks/soak.py", *words])
    return 1 if found else 0


def _lines(file: Path) -> list[str]:
    """Reads what a run has logged; empty before its first row."""
    return file.read_text().splitlines() if file.exists() else []


def _speed(rows: Sequence[dict]) -> float:
    """Returns steps per second between the first and the last row."""
    return (rows[-1]["env_steps"] - rows[0]["env_steps"]) / (rows[-1]["time"] - rows[0]["time"])


if __name__ == "__main__":
    sys.exit(cli.run(main))
