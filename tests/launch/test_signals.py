"""Requests to stop at random moments of a real run, compilation included."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time

import pytest
from processes import TINY, newest, start

from foajax.runs.agents import load_agent

IN_A_CALLBACK = """
import gc, os, runpy, signal, sys

class Interrupt:
    def find_spec(self, name, *_):
        if name == "jax":
            gc.callbacks.append(lambda phase, info: os.kill(os.getpid(), signal.SIGINT))
            gc.collect()

sys.meta_path.insert(0, Interrupt())
runpy.run_module("foajax.train", run_name="__main__", alter_sys=True)
"""


@pytest.mark.parametrize("words", [[], ["seed=0,1", "--multirun"]])
def test_an_interrupt_while_jax_is_imported_is_heard(tmp_path, words):
    """In a callback, where Python would print a KeyboardInterrupt, forget it and go on."""
    command = [sys.executable, "-c", IN_A_CALLBACK, "game=seek", *words]
    process = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert (process.returncode, process.stdout, process.stderr) == (-signal.SIGINT, "", "")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_request_to_stop_is_heard_at_any_moment(tmp_path):
    """Before the command has taken the signals over, it ends by them, and nothing has begun."""
    chance, run, codes = random.Random(0), tmp_path / "run", []
    words = ["game=seek", *TINY, f"run={run}", "train.env_steps=100000000"]
    for _ in range(20):
        process = start(*words)
        time.sleep(chance.uniform(0, 8))
        process.send_signal(sent := chance.choice([signal.SIGTERM, signal.SIGINT, signal.SIGUSR1]))
        begin = time.monotonic()
        before = newest(run)
        out, err = process.communicate(timeout=60)
        assert time.monotonic() - begin < 10
        started = "resumed at" in out or "new run" in out
        assert process.returncode == 0 or not started, err
        if process.returncode == 0:
            ended = f"saved at {newest(run):,} env_steps" if newest(run) else "stopped before anything was learned"
            assert f"{sent.name}: {ended}" in out and newest(run) >= before
        codes.append(process.returncode)
    assert codes.count(0) >= 8 and load_agent(run).env_steps == newest(run)


@pytest.mark.slow
def test_a_request_to_stop_does_not_wait_for_a_compilation(tmp_path, monkeypatch):
    """A network that takes long to compile, with nothing kept from before: there is nothing to lose yet."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "cache"))
    process = start("game=seek", "experiment=decreasing_p_packed", f"run={tmp_path / 'run'}")
    while "new run" not in process.stdout.readline():
        assert process.poll() is None
    process.send_signal(signal.SIGTERM)
    begin = time.monotonic()
    out, _ = process.communicate(timeout=60)
    assert process.returncode == 0 and time.monotonic() - begin < 10
    assert "SIGTERM: stopped before anything was learned" in out and not list(tmp_path.glob("run/checkpoints/*"))
