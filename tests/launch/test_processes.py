"""Several devices, several processes: the same run, and its end when one of them is lost. Real processes, gloo."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import time
from pathlib import Path

import chex
import jax
import numpy as np
import processes
import pytest

from foajax.config.compose import compose
from foajax.config.parse import ConfigError
from foajax.launch import coordinator
from foajax.launch import processes as distributed
from foajax.runs.agents import load_agent

# 32 environments, 4 updates of 8 of them a rollout of 128 env_steps. So small an image has no torso: only the first
# of several processes finds compiled programs again, and what a torso does with its share is tested elsewhere.
WORDS = [
    "game=seek",
    "experiment=constant50_sub2_packed",
    "sensor=rings",
    "sensor.rings=[[14,14,2]]",
    "sensor.layout=packed",
    "network.dense=16",
    "network.lstm=16",
    "env.num_envs=32",
    "learner.num_minibatches=4",
    "learner.rollout_length=4",
    "learner.schedule=constant",  # so that a run may be made longer
    "train.log_every=1e-6",
]
TWENTY_UPDATES = 640  # env_steps


def start(*words, **variables):
    return processes.start(*WORDS, *words, env=os.environ | variables)


def start_job(count, *words, last=None, others=()):
    """`count` processes on this machine that find each other at a free port.

    The last one has variables of its own; all but the first have `others`, words of their own.
    """
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    where = [f"distributed.coordinator=127.0.0.1:{port}", f"distributed.processes={count}"]
    variables = [{}] * (count - 1) + [last or {}]
    own = [(), *[others] * (count - 1)]
    return [start(*words, *own[i], *where, f"distributed.process={i}", **variables[i]) for i in range(count)]


def finish(*started):
    """Their output; all have to end well."""
    outputs = [process.communicate(timeout=900) for process in started]
    for process, (_, err) in zip(started, outputs, strict=True):
        assert process.returncode == 0, err
    return [out for out, _ in outputs]


def rows(run):
    return [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]


def assert_same(run, other):
    a, b = load_agent(run), load_agent(other)
    assert a.env_steps == b.env_steps
    learned = [(stored.params, stored.statistics) for stored in (a, b)]
    chex.assert_trees_all_close(*learned, rtol=2e-4, atol=2e-6)
    # Scores and games are counted over all processes, in the same order.
    for row, expected in zip(rows(run), rows(other), strict=True):
        for name in ("env_steps", "games", "score", "length"):
            assert row[name] == expected[name]
        np.testing.assert_allclose(row["loss"], expected["loss"], rtol=1e-3, atol=1e-5)


@pytest.fixture(scope="module")
def one(tmp_path_factory):
    """The run that the others are compared with: one process, one device."""
    run = tmp_path_factory.mktemp("one") / "run"
    finish(start(f"run={run}", f"train.env_steps={TWENTY_UPDATES}"))
    return run


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """Two processes with 16 environments each."""
    run = tmp_path_factory.mktemp("two") / "run"
    first, second = finish(*start_job(2, f"run={run}", f"train.env_steps={TWENTY_UPDATES}"))
    assert "done: 640 env_steps" in first
    assert "env_steps" not in second  # only the first speaks
    return run


@pytest.mark.slow
def test_four_devices_and_then_two_learn_what_one_learns(one, tmp_path):
    for devices, env_steps in ((4, TWENTY_UPDATES // 2), (2, TWENTY_UPDATES)):
        words = [f"run={tmp_path}", f"train.env_steps={env_steps}", f"train.devices={devices}"]
        (out,) = finish(start(*words, JAX_NUM_CPU_DEVICES="4"))
    assert "resumed at 384 env_steps (episodes go on)" in out
    assert_same(tmp_path, one)


@pytest.mark.slow
def test_two_processes_learn_what_one_learns(one, two):
    assert_same(two, one)


@pytest.mark.slow
def test_two_processes_of_two_devices_learn_what_one_learns(one, tmp_path, monkeypatch):
    monkeypatch.setenv("JAX_NUM_CPU_DEVICES", "2")
    finish(*start_job(2, f"run={tmp_path}", f"train.env_steps={TWENTY_UPDATES}", "train.devices=2"))
    assert_same(tmp_path, one)


def test_processes_of_different_configurations_are_refused(tmp_path):
    """All of them and at once: an orderly end would wait for the other one."""
    begin = time.monotonic()
    words = [f"run={tmp_path / 'run'}", "train.env_steps=640"]
    started = start_job(2, *words, others=["learner.learning_rate=0.5", "env.threads=2"])
    errors = [process.communicate(timeout=120)[1] for process in started]
    assert [process.returncode for process in started] == [2, 2], errors
    first, second = (error.splitlines()[-1] for error in errors)
    assert first == "foajax: error: process 1: has another configuration; accepted is that of process 0"
    assert second == "foajax: error: learner.learning_rate=0.5: accepted is 0.001, as in process 0"
    assert time.monotonic() - begin < 90 and not (tmp_path / "run").exists()


@pytest.mark.slow
def test_what_two_processes_saved_one_goes_on_with_and_the_reverse(one, two):
    """Episodes of seek are 96 steps long: they go on, and end, with other processes than they began with."""
    (out,) = finish(start(f"run={two}", "train.env_steps=3840"))
    assert "resumed at 640 env_steps (episodes go on)" in out
    first, _ = finish(*start_job(2, f"run={one}", "train.env_steps=3840"))
    assert "resumed at 640 env_steps (episodes go on)" in first
    assert rows(one)[-1]["games"] == 32
    assert_same(one, two)


def lose_one(tmp_path, number, *, which):
    """Two endless processes, one of which gets a signal; the other's exit code and last words."""
    words = ["train.env_steps=100000000", "train.checkpoint_every=1000", "distributed.timeout=15"]
    started = start_job(2, f"run={tmp_path}", *words)
    lost, left = started[which], started[1 - which]
    try:
        end = time.monotonic() + 900
        while not (tmp_path / "metrics.jsonl").exists() or len((tmp_path / "metrics.jsonl").read_text()) < 2000:
            assert time.monotonic() < end and left.poll() is None, left.communicate()
            assert lost.poll() is None, lost.communicate()
            time.sleep(0.1)
        lost.send_signal(number)
        begin = time.monotonic()
        _, err = left.communicate(timeout=60)
        assert time.monotonic() - begin < 45
    finally:
        for process in started:
            process.kill()
        lost.communicate()
    return left.returncode, [line for line in err.splitlines() if line.startswith("foajax: error: ")]


@pytest.mark.slow
@pytest.mark.parametrize(("which", "number"), [(1, signal.SIGKILL), (0, signal.SIGKILL), (1, signal.SIGSTOP)])
def test_a_process_that_is_lost_ends_the_others_with_a_checkpoint(tmp_path, which, number):
    """Process 0 as well, which has the run's directory and starts JAX's coordination service."""
    code, lines = lose_one(tmp_path, number, which=which)
    assert code == 75
    (line,) = lines
    saved = max(int(path.name) for path in (tmp_path / "checkpoints").iterdir())
    assert f"process {1 - which} of 2: another process died or hangs" in line
    assert f"saved at {saved:,} env_steps; the same command goes on from here" in line
    assert saved > 0
    assert load_agent(tmp_path).env_steps == saved
    (out,) = finish(start(f"run={tmp_path}", f"train.env_steps={saved + 128}"))  # one goes on where two were
    assert f"resumed at {saved:,} env_steps (episodes go on)" in out and f"done: {saved + 128:,} env_steps" in out


class Ended(BaseException):
    """In place of a process's end."""


@pytest.mark.parametrize(
    ("error", "count", "ends"),
    [
        (jax.errors.JaxRuntimeError("INTERNAL: Gloo all-reduce failed: closed"), 2, True),
        (ValueError("UNKNOWN: Gloo AllGather failed: Connection closed by peer"), 2, True),
        (ValueError("a mistake of this process's own"), 2, False),
        (jax.errors.JaxRuntimeError("INTERNAL: a fault of the device"), 1, False),
    ],
)
def test_a_collective_that_fails_ends_a_process_whatever_it_raises(monkeypatch, capsys, error, count, ends):
    def end(code):
        raise Ended(code)

    monkeypatch.setattr(distributed.os, "_exit", end)
    job = object.__new__(distributed.Job)
    job.index, job.count = 0, count
    watch = distributed.PeerWatch(job, 1000.0, lambda: "saved")
    with pytest.raises(Ended if ends else type(error)) as caught, watch.expecting_others():
        raise error
    assert caught.value.args == (75,) if ends else caught.value is error
    said = f"foajax: error: process 0 of 2: another process died or hangs ({error}); saved\n"
    assert capsys.readouterr().err == (said if ends else "")


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["raise:make", "raise:step", "hang:step"])
def test_a_process_whose_environment_fails_says_so_and_the_others_save(tmp_path, monkeypatch, fault):
    """Soon: an orderly end would wait for the others, as they for it."""
    tests = Path(__file__).parents[1]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tests.parent), str(tests)]))
    words = ["game=gymnasium:faulty:Faulty-v0", "env.timeout=5", "train.env_steps=1000", f"run={tmp_path / 'run'}"]
    started = start_job(2, *words, last={"FAULTY": fault})
    try:
        errors = [process.communicate(timeout=90)[1] for process in started]
    finally:
        for process in started:
            process.kill()
    assert [process.returncode for process in started] == [75, 3], errors
    (line,) = errors[0].splitlines()
    saved = load_agent(tmp_path / "run", trust=True).env_steps
    assert "foajax: error: process 0 of 2: another process died or hangs (" in line
    assert f"; saved at {saved:,} env_steps; the same command goes on from here" in line
    assert 0 <= saved <= 384  # the thirteenth step is in the fourth rollout of four
    assert "; the first process saves what it can; details in " in errors[1]


@pytest.mark.parametrize("address", ["", "localhost", "localhost:", ":1234", "1234", "localhost:ssh"])
def test_an_address_without_a_port_is_refused(monkeypatch, address):
    monkeypatch.setenv("JAX_COORDINATOR_ADDRESS", address)
    monkeypatch.setenv("JAX_NUM_PROCESSES", "2")
    monkeypatch.setenv("JAX_PROCESS_ID", "0")
    with pytest.raises(
        ConfigError, match=f"^JAX_COORDINATOR_ADDRESS={address or repr('')}: accepted is host:port of process 0$"
    ):
        distributed.where(compose([]))


def test_a_port_that_stays_taken_is_named(monkeypatch):
    monkeypatch.setattr(coordinator, "_LINGER", -5.0)
    with socket.create_server(("", 0)) as server:
        port = server.getsockname()[1]
        with pytest.raises(OSError, match=rf"^port {port}: Address already in use$"):
            coordinator._wait_for(port)
    coordinator._wait_for(port)


def test_the_service_knows_whether_anyone_is_connected():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        assert not coordinator._connected(port)
        with socket.create_connection(("127.0.0.1", port)):
            assert coordinator._connected(port)


@pytest.mark.slow
def test_when_the_first_process_hangs_the_others_end(tmp_path):
    """It may wake up again and write, so that nobody else does."""
    code, (line,) = lose_one(tmp_path, signal.SIGSTOP, which=0)
    assert code == 75 and "the first process saves what it can" in line


@pytest.mark.slow
def test_a_signal_to_any_process_stops_all_and_saves(tmp_path):
    first, second = start_job(2, f"run={tmp_path}", "train.env_steps=100000000")
    end = time.monotonic() + 900
    metrics = tmp_path / "metrics.jsonl"
    while not (metrics.exists() and metrics.stat().st_size):  # something has been learned, and so there is what to save
        assert time.monotonic() < end and first.poll() is None, first.communicate()
        time.sleep(0.1)
    second.send_signal(signal.SIGTERM)
    out, _ = finish(first, second)
    saved = max(int(path.name) for path in (tmp_path / "checkpoints").iterdir())
    assert f"saved at {saved:,} env_steps" in out and rows(tmp_path)[-1]["env_steps"] == saved


@pytest.mark.slow
def test_a_directory_that_cannot_be_used_ends_all_in_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    started = start_job(2, f"run={tmp_path / 'file'}")
    for process in started:
        _, err = process.communicate(timeout=100)
        assert process.returncode == 2, err
        assert "is a file; accepted is a directory" in err


@pytest.mark.slow
def test_unusable_checkpoints_end_all_in_one_line(one, tmp_path):
    run = shutil.copytree(one, tmp_path / "run")
    for sums in run.glob("checkpoints/*/SHA256SUMS"):
        sums.unlink()
    for process in start_job(2, f"run={run}", "train.env_steps=1280"):
        _, err = process.communicate(timeout=100)
        assert process.returncode == 2, err
        assert "no usable checkpoint in" in err


def test_devices_have_to_share_a_minibatch_evenly():
    with pytest.raises(ConfigError, match=r"train.devices=3: accepted is a divisor of the 2 environments of a minib"):
        compose(["train.devices=3"])


@pytest.mark.slow
def test_more_devices_than_there_are_is_one_line(tmp_path):
    process = start(f"run={tmp_path}", "train.devices=4", JAX_NUM_CPU_DEVICES="2")
    _, err = process.communicate(timeout=100)
    assert process.returncode == 2 and len(err.splitlines()) == 1
    assert "train.devices=4: accepted is up to 2 here, cpu" in err


@pytest.mark.parametrize(
    "words, said",
    [
        (["distributed.coordinator=127.0.0.1:1"], "accepted is a value for all three or for none"),
        (["distributed.coordinator=a", "distributed.processes=2", "distributed.process=0"], "host:port"),
        (["distributed.coordinator=a:1", "distributed.processes=2", "distributed.process=2"], "from 0 to 1"),
        (["distributed.coordinator=a:1", "distributed.processes=0", "distributed.process=0"], "an integer >= 1"),
        (["distributed.timeout=0"], "a number > 0"),
    ],
)
def test_what_cannot_be_a_job_is_refused(words, said):
    with pytest.raises(ConfigError, match=said):
        compose(words)
