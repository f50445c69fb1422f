"""The watchdog in small processes of its own, and the command with environments that raise and hang."""

from __future__ import annotations

import functools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import chex
import pytest
from processes import TINY, finish, newest, rows

from foajax import train
from foajax.config import compose
from foajax.envs.tasks import JaxEnvironment
from foajax.runs.agents import load_agent
from foajax.runs.directory import failure
from foajax.training.watchdog import FAULT, EnvironmentFault, Watchdog

TESTS = Path(__file__).parents[1]

_SCRIPT = """
import signal, time
from foajax.training import watchdog as module

module.GRACE = 1.0  # of 5

def tell(why, code):
    print(f"abandoned: {why} ({code})")
    return code

signal.signal(signal.SIGTERM, lambda *_: print("heard", flush=True))
with module.Watchdog(TIMEOUT, abandon=tell, is_saved=lambda: SAVED, alone=ALONE) as watchdog:
    sleep = watchdog.watched("the emulator: recv", time.sleep)
    print("ready", flush=True)
    BODY
print("alive")
"""


def script(body, *, timeout=1.0, saved=False, alone=True):
    """A process that runs `body` under a watchdog; returns once it is there."""
    values = {"TIMEOUT": timeout, "SAVED": saved, "ALONE": alone, "BODY": body}
    code = functools.reduce(lambda text, name: text.replace(name, str(values[name])), values, _SCRIPT)
    process = subprocess.Popen([sys.executable, "-c", code], cwd=TESTS.parent, text=True, stdout=subprocess.PIPE)
    assert process.stdout.readline() == "ready\n"
    return process


def test_a_call_that_does_not_return_ends_the_process():
    process = script("sleep(1000)")
    out, _ = process.communicate(timeout=20)
    assert process.returncode == FAULT == 3
    assert out == "abandoned: the emulator: recv has not returned for 1 s (env.timeout) (3)\n"


def test_many_short_calls_are_none_too_long():
    out, _ = script("for _ in range(20): sleep(0.1)").communicate(timeout=20)
    assert out == "alive\n"


def test_work_outside_of_the_environments_may_take_its_time():
    out, _ = script("time.sleep(2)").communicate(timeout=20)
    assert out == "alive\n"


def test_a_paused_process_is_not_taken_for_hung():
    process = script("sleep(4)", timeout=3.0)  # of which 3.5 s are paused
    time.sleep(0.3)  # until it waits
    process.send_signal(signal.SIGSTOP)
    time.sleep(3.5)
    process.send_signal(signal.SIGCONT)
    out, _ = process.communicate(timeout=20)
    assert out == "alive\n"


@pytest.mark.parametrize(
    ("body", "saved", "ended"),
    [
        ("sleep(1000)", False, True),  # stuck in an emulator
        ("while True: sleep(0.001)", False, True),  # deaf, but it comes to an emulator
        ("time.sleep(1000)", True, True),  # stuck elsewhere, with nothing to lose
        ("time.sleep(3)", False, False),  # stuck elsewhere with what is not saved: waited for
    ],
)
def test_a_request_to_stop_is_answered_by_whoever_can(body, saved, ended):
    process = script(body, timeout=1000.0, saved=saved)
    process.send_signal(signal.SIGTERM)
    out, _ = process.communicate(timeout=20)
    assert process.returncode == 0
    assert out == ("heard\nabandoned: SIGTERM (0)\n" if ended else "heard\nalive\n")


def test_what_cannot_be_saved_does_not_end_as_if_it_were():
    deaf = "signal.signal(signal.SIGTERM, lambda *_: None); __import__('sys').stdout.close()"
    process = script(f"{deaf}; sleep(1000)", timeout=1000.0)
    time.sleep(1)
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=20)
    assert process.returncode == 1  # as `tell` raises


def test_one_of_several_processes_leaves_a_request_to_stop_to_all_of_them():
    """Also where there is nothing to lose here, and where the next call of an environment comes late."""
    process = script("time.sleep(3); sleep(0.1)", saved=True, alone=False)
    process.send_signal(signal.SIGTERM)
    out, _ = process.communicate(timeout=20)
    assert process.returncode == 0 and out == "heard\nalive\n"


def test_an_error_is_named_and_passed_on():
    def recv(number):
        raise ValueError("no\nscreen")

    former = signal.set_wakeup_fd(-1)
    with Watchdog(1000.0, abandon=lambda why, code: code, is_saved=lambda: True) as watchdog:
        with pytest.raises(EnvironmentFault, match="^group 0: recv raised ValueError: no screen$") as caught:
            watchdog.watched("group 0: recv", recv)(1)
        assert isinstance(caught.value.__cause__, ValueError)
        assert watchdog.watched("group 0: send", lambda x: x + 1)(1) == 2
    assert signal.set_wakeup_fd(former) == -1  # as it was


def faulty(run, fault):
    path = os.pathsep.join([str(TESTS.parent), str(TESTS)])
    return finish(
        "game=gymnasium:faulty:Faulty-v0",
        *TINY,
        f"run={run}",
        "env.timeout=1",
        "train.env_steps=400",
        env=os.environ | {"FAULTY": fault, "PYTHONPATH": path},
    )


def test_a_failing_environment_costs_nothing_that_was_learned(tmp_path):
    run = tmp_path / "run"
    # Twenty steps, and three that begin episodes, are two rollouts of five that observe and two that learn.
    for fault, said, env_steps in (
        ("raise:step", "environment group 0: recv raised RuntimeError: the emulator is on fire", 80),
        ("hang:step", "environment group 0: recv has not returned for 1 s (env.timeout)", 240),
    ):
        code, _, err = faulty(run, fault)
        assert code == FAULT
        line = f"game=gymnasium:faulty:Faulty-v0: {said}; saved at {env_steps} env_steps, the same command goes on from"
        assert err == f"foajax: error: {line} there; details in {run}/fault.txt\n"
        assert newest(run) == env_steps
        assert "tests/faulty.py" in (run / "fault.txt").read_text()
        assert said in str(failure(run))
    code, out, err = faulty(run, "")
    assert code == 0, err
    assert "resumed at 240 env_steps" in out and "done: 400 env_steps" in out


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("raise:make", "making the environments raised RuntimeError: the emulator is on fire"),
        ("hang:reset", "environment group 0: reset has not returned for 1 s (env.timeout)"),
    ],
)
def test_an_environment_that_fails_at_the_start_is_one_line(tmp_path, fault, said):
    code, _, err = faulty(tmp_path, fault)
    assert code == FAULT and len(err.splitlines()) == 1
    assert f"{said}; nothing to save yet; details in {tmp_path}/fault.txt" in err


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["raise:close", "hang:close"])
def test_a_run_that_is_done_is_saved_whatever_closing_does(tmp_path, fault):
    code, out, err = faulty(tmp_path, fault)
    assert "done: 400 env_steps" in out and newest(tmp_path) == 400
    assert code == FAULT and "environment group 0: close" in err.splitlines()[-1]


@pytest.mark.slow
def test_a_fault_in_the_middle_of_a_rollout_leaves_no_trace(tmp_path, monkeypatch, capfd):
    """Where environments can be saved, they are saved as they were at the last update."""
    words = ["game=seek", *TINY, "train.env_steps=800"]
    assert train.train(compose.compose([*words, f"run={tmp_path / 'whole'}"])) == 0
    receive, calls = JaxEnvironment.recv, []

    def recv(self):
        calls.append(1)
        if len(calls) == 50:
            raise RuntimeError("gone")
        return receive(self)

    monkeypatch.setattr(JaxEnvironment, "recv", recv)
    parts = compose.compose([*words, f"run={tmp_path / 'parts'}"])
    assert train.train(parts) == FAULT
    assert 0 < newest(tmp_path / "parts") < 800
    assert train.train(parts) == 0
    a, b = (load_agent(tmp_path / name) for name in ("whole", "parts"))
    chex.assert_trees_all_equal((a.params, a.statistics), (b.params, b.statistics))
    last, resumed = (rows(tmp_path / name)[-1] for name in ("whole", "parts"))
    assert {k: v for k, v in last.items() if k != "time"} == {k: v for k, v in resumed.items() if k != "time"}
    assert "recv raised RuntimeError: gone; saved at" in capfd.readouterr().err
