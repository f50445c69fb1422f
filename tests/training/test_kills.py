"""SIGKILL at random moments, also inside the writing of a checkpoint: every start goes on from the last whole one."""

from __future__ import annotations

import os
import random
import re
import signal
import time

import pytest
from processes import TINY, finish, newest, rows, start, wait_for

from foajax.runs.agents import load_agent

WORDS = [
    "game=seek",
    *TINY,
    "train.env_steps=100000000",
    "train.checkpoint_every=0.001",  # the next write begins when the one before is through
]


def kill_again_and_again(run, times, seed):
    """Kills as many starts of one run; returns (env_steps resumed at, env_steps of the newest checkpoint, torn)."""
    chance = random.Random(seed)
    told = []
    for number in range(times):
        before, log = newest(run), run.parent / f"{number}.log"
        with log.open("w") as out:
            process = start(*WORDS, f"run={run}", stdout=out, stderr=out)
            if number % 4 == 3:  # anywhere: imports, restoring, compiling
                time.sleep(chance.uniform(0, 8))
            else:  # between checkpoints and inside them
                wait_for(lambda before=before: newest(run) > before, process)
                time.sleep(chance.uniform(0, 0.5))
            process.send_signal(signal.SIGKILL)
            process.communicate()
        said = log.read_text()
        assert "Traceback" not in said and "warning" not in said, said
        resumed = re.search(r"(?:resumed at ([\d,]+) env_steps|new run)", said)
        if resumed:
            assert int((resumed[1] or "0").replace(",", "")) == before
        torn = any(name.endswith(".new") for name in os.listdir(run / "checkpoints"))
        told.append((resumed is not None, newest(run), torn))
    return told


def check(run, told):
    """Nothing that a kill left is in the way: no step is lost that a checkpoint had, and every file is whole."""
    reached = [env_steps for _, env_steps, _ in told]
    assert reached == sorted(reached)
    assert load_agent(run).env_steps == reached[-1]
    code, out, err = finish(*WORDS, f"run={run}", f"train.env_steps={reached[-1] + 400}")
    assert code == 0, err
    assert f"resumed at {reached[-1]:,} env_steps" in out and f"done: {reached[-1] + 400:,} env_steps" in out
    steps = [row["env_steps"] for row in rows(run)]
    assert steps == sorted(set(steps)) and steps[-1] == reached[-1] + 400
    assert not [name for name in os.listdir(run / "checkpoints") if name.startswith(".")]


@pytest.mark.slow
def test_five_kills_cost_what_came_after_the_last_checkpoint(tmp_path):
    told = kill_again_and_again(tmp_path / "run", times=5, seed=0)
    check(tmp_path / "run", told)
    assert told[-1][1] > told[0][1] > 0


@pytest.mark.long
@pytest.mark.slow
def test_a_hundred_kills_are_resumed_from_a_hundred_times(tmp_path):
    told = kill_again_and_again(tmp_path / "run", times=100, seed=1)
    check(tmp_path / "run", told)
    assert sum(torn for *_, torn in told) >= 10  # hit inside a write
    assert sum(started for started, *_ in told) >= 75
