"""What the soak calls a leak or a slowdown; the soak itself is the slowest of the slow tests."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

from foajax.config.parse import ConfigError

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "soak.py"
spec = importlib.util.spec_from_file_location("soak", SCRIPT)
soak = importlib.util.module_from_spec(spec)
sys.modules["soak"] = soak
spec.loader.exec_module(soak)


def judged(*, growth=0.0, fall=0.0, leaks=0, noise=True):
    """Thirty minutes whose memory, speed and files change evenly after the fifth minute, by so much in all."""
    samples, rows, env_steps = [], [], 0.0
    for second in range(1800):
        share = max(0.0, (second - 300) / 1500)
        memory = 1e9 * (1 + growth * share) * (0.5 if second < 60 else 1)
        busy = 1 if noise and second % 60 < 2 else 0  # a checkpoint is being written
        samples.append(soak.Sample(float(second), int(memory), 20 + busy + int(leaks * share), 30 + busy))
        env_steps += 1000 * (1 - fall * share)
        if second % 10 == 0:
            rows.append({"time": float(second), "env_steps": int(env_steps)})
    return soak.complaints(soak.verdict(samples, rows, 1800.0))


def test_what_stays_as_it_began_is_no_complaint():
    assert judged() == judged(growth=0.01) == judged(growth=-0.2) == judged(fall=0.03) == judged(fall=-0.5) == []


@pytest.mark.parametrize(
    ("change", "said"),
    [({"growth": 0.03}, "memory has grown by 2."), ({"fall": 0.1}, "speed has fallen by 8."), ({"leaks": 5}, "files ")],
)
def test_what_does_not_is_named(change, said):
    (complaint,) = judged(**change)
    assert complaint.startswith(said)


def test_a_look_sees_this_process(tmp_path):
    before = soak.sample(os.getpid(), 0.0)
    with (tmp_path / "a").open("w"), (tmp_path / "b").open("w"):
        ballast = bytearray(os.urandom(2**20) * 200)  # much more than other threads may free meanwhile
        after = soak.sample(os.getpid(), 0.0)
    assert after.files == before.files + 2 and after.memory - before.memory > 0.8 * len(ballast)
    assert after.threads >= 1


@pytest.mark.parametrize("times", [[], [300.0], [0.0, 10.0, 1790.0, 1800.0], [0.0, 300.0, 310.0, 1200.0]])
def test_too_few_rows_for_a_speed_are_named(times):
    samples = [soak.Sample(float(second), 10**9, 20, 30) for second in range(1800)]
    with pytest.raises(ConfigError, match=rf"^minutes=30: accepted is .*there are {len(times)} rows in all\)$"):
        soak.verdict(samples, [{"time": time, "env_steps": int(1000 * time)} for time in times], 1800.0)


@pytest.mark.parametrize("run", ["soak", "nowhere/soak"])
def test_a_training_that_fails_is_shown_and_no_file_of_others_is_touched(tmp_path, monkeypatch, capsys, run):
    (tmp_path / "python").write_text("#!/bin/sh\necho why\nexit 3\n")
    (tmp_path / "python").chmod(0o755)
    (tmp_path / "log").write_text("the user's")
    monkeypatch.setattr(soak.sys, "executable", str(tmp_path / "python"))
    monkeypatch.setattr(soak, "_EVERY", 0.1)
    monkeypatch.setattr(soak, "sample", lambda process, begin: soak.Sample(0.0, 1, 1, 1))
    assert soak.main([f"run={tmp_path / run}"]) == 3
    assert capsys.readouterr().err == "why\n" and (tmp_path / "log").read_text() == "the user's"


@pytest.mark.long
@pytest.mark.slow
def test_thirty_minutes_end_as_they_began():
    subprocess.run([sys.executable, SCRIPT, "minutes=30"], cwd=SCRIPT.parents[1], check=True)
