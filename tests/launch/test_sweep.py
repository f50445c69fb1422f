"""Sweeps: a process a run, some at a time; finished ones skipped, unfinished ones resumed, failed ones listed."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from foajax.config.compose import compose
from foajax.config.parse import to_mapping
from foajax.launch import sweep
from foajax.runs.agents import load_agent

# Stands in for the training command: notes when it began and ended, and does what its last word says.
STAND_IN = """
import os, pathlib, signal, sys, time
directory, what = pathlib.Path(sys.argv[-2]), sys.argv[-1]
directory.mkdir(exist_ok=True)
times = directory / "times"
times.write_text(str(time.time()))
(directory / "cores").write_text(",".join(map(str, sorted(os.sched_getaffinity(0)))))
if what in ("wait", "interrupt"):
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(130 if what == "interrupt" else 0))
    (directory / "ready").touch()
    time.sleep(60)
time.sleep(1)  # longer than a start takes beside another
times.write_text(times.read_text() + " " + str(time.time()))
if what == "finish":
    (directory / "checkpoints" / "100").mkdir(parents=True)
if what == "kill":
    os.kill(os.getpid(), signal.SIGKILL)
if what == "fail":
    (directory / "failure.txt").write_text("game=x: accepted is a game")
sys.exit({"fail": 3, "refuse": 2}.get(what, 0))
"""
COMMAND = (sys.executable, "-c", STAND_IN)


@pytest.fixture
def make(tmp_path):
    """A run of 100 env_steps whose process does `what`."""
    import yaml

    def one(name, what):
        path = tmp_path / name
        path.mkdir()
        config = compose([f"run={path}", "train.env_steps=100", "game=seek"])
        (path / "config.yaml").write_text(yaml.safe_dump(to_mapping(config)))
        return sweep.PlannedRun((str(path), what), config)

    return one


def times(run):
    return [float(word) for word in (Path(run.config.run_dir) / "times").read_text().split()]


def test_one_after_another_or_some_at_a_time(make):
    for jobs in (1, 2):
        runs = [make(f"{jobs}-{i}", "finish") for i in range(3)]
        assert sweep.run_all(runs, jobs=jobs, command=COMMAND) == 0
        moments = sorted((moment, step) for run in runs for moment, step in zip(times(run), (1, -1), strict=True))
        running = [sum(step for _, step in moments[: i + 1]) for i in range(len(moments))]
        assert max(running) == jobs


def test_a_run_that_cannot_be_started_does_not_end_the_sweep(make, tmp_path, capsys):
    (tmp_path / "file").touch()
    lost = sweep.PlannedRun(
        (str(tmp_path), "finish"), compose([f"run={tmp_path / 'file' / 'run'}", "train.env_steps=100"])
    )
    good = make("good", "finish")
    assert sweep.run_all([lost, good], jobs=2, command=COMMAND) == 1
    assert len(times(good)) == 2
    assert f"failed: {lost.config.run_dir}: cannot be started (" in capsys.readouterr().err


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="this system cannot say where a process runs")
def test_runs_beside_one_another_share_the_cores(make):
    def cores_of(run):
        return {int(core) for core in (Path(run.config.run_dir) / "cores").read_text().split(",")}

    mine = os.sched_getaffinity(0)
    for jobs in (1, 2):
        runs = [make(f"{jobs}-{i}", "finish") for i in range(2)]
        assert sweep.run_all(runs, jobs=jobs, command=COMMAND) == 0
        first, second = map(cores_of, runs)
        assert first | second == mine == os.sched_getaffinity(0)
        if len(mine) > 1:
            assert (first & second == set()) == (jobs == 2)
    assert sweep.run_all([*runs, last := make("last", "finish")], jobs=4, command=COMMAND) == 0
    assert cores_of(last) == mine  # nothing else is left to run beside it


def test_more_runs_than_cores_share_them_too():
    shares = sweep.shares_of_cores(1000)
    assert len(shares) == 1000 and all(shares)


def test_what_is_finished_is_not_started(make, capfd):
    run = make("a", "finish")
    assert sweep.run_all([run], jobs=1, command=COMMAND) == 0
    began = times(run)
    assert sweep.run_all([run], jobs=1, command=COMMAND) == 0
    assert times(run) == began
    assert "a: finished already" in capfd.readouterr().err


def test_a_failure_is_listed_in_the_end_and_the_others_run(make, capfd):
    runs = [make("a", "fail"), make("b", "kill"), make("c", "finish"), make("d", "end")]
    assert sweep.run_all(runs, jobs=1, command=COMMAND) == 1
    *_, counts, first, second, third = capfd.readouterr().err.splitlines()
    assert counts.startswith("sweep of 4 runs: 1 finished, 1 unfinished, 2 failed")
    assert first.endswith("a: exit 3: game=x: accepted is a game") and first.startswith("  failed: ")
    assert second.endswith("b: killed by SIGKILL")
    assert third.startswith("  unfinished: ") and third.endswith("/d")


def test_what_a_run_failed_of_before_is_not_why_it_is_refused(make, capfd):
    run = make("a", "refuse")
    (Path(run.config.run_dir) / "failure.txt").write_text("game=x: accepted is a game\n")
    for jobs, said in ((1, "a: exit 2"), (2, "a: exit 2 (see output.txt there)")):
        assert sweep.run_all([run], jobs=jobs, command=COMMAND) == 1
        assert capfd.readouterr().err.endswith(said + "\n")


def test_a_signal_reaches_the_run_that_is_being_started(make, monkeypatch):
    def start(*arguments, **options):
        os.kill(os.getpid(), signal.SIGTERM)  # before the sweep knows of the process
        return begin(*arguments, **options)

    begin = sweep._start
    monkeypatch.setattr(sweep, "_start", start)
    begun = time.monotonic()
    assert sweep.run_all([make("a", "wait"), make("b", "finish")], jobs=1, command=COMMAND) == 0
    assert time.monotonic() - begun < 30


def test_a_run_of_another_meaning_is_not_taken_for_finished(make, tmp_path):
    run = make("a", "finish")
    sweep.run_all([run], jobs=1, command=COMMAND)
    other = compose([f"run={tmp_path / 'a'}", "train.env_steps=100", "game=seek", "learner.learning_rate=1e-4"])
    assert not sweep.skip_if_finished(other) and sweep.skip_if_finished(run.config)


@pytest.mark.parametrize("what", ["wait", "interrupt"])
def test_a_signal_goes_on_to_the_running_and_nothing_else_starts(make, tmp_path, capfd, what):
    runs, stop = [make("a", what), make("b", "finish")], sweep.Stop()

    def interrupt():
        while not (tmp_path / "a" / "ready").exists():
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGTERM)

    thread = threading.Thread(target=interrupt)
    thread.start()
    begin = time.monotonic()
    assert sweep.run_all(runs, jobs=1, command=COMMAND, stop=stop) == 0
    assert stop.requested == signal.SIGTERM
    thread.join()
    assert time.monotonic() - begin < 20
    assert not (tmp_path / "b" / "times").exists()
    assert "0 finished, 2 unfinished, 0 failed" in capfd.readouterr().err


TINY = [
    "game=seek",
    "sensor=rings",
    "sensor.rings=[[14,14,2]]",
    "sensor.layout=packed",
    "network.dense=16",
    "network.lstm=16",
    "env.num_envs=8",
    "learner.num_minibatches=2",
    "learner.rollout_length=5",
]


def train(directory, *words):
    command = [sys.executable, "-m", "foajax.train", *words]
    done = subprocess.run(command, cwd=directory, text=True, capture_output=True, timeout=500)
    return done.returncode, done.stdout, done.stderr


@pytest.mark.slow
def test_two_experiments_and_two_seeds(tmp_path):
    (tmp_path / "sweep").mkdir()
    tiny = [*TINY, "gaze=learned", "learner.schedule=constant"]
    words = ["experiment=nonfoa,constant50_sub2_packed", "seed=1,2", *tiny, "train.env_steps=2000"]
    single = ["experiment=nonfoa", "seed=1", *tiny, "train.env_steps=1000"]
    assert train(tmp_path / "sweep", *single)[0] == 0
    code, _, err = train(tmp_path / "sweep", "--multirun", "--jobs=2", *words)
    assert code == 0, err
    assert "sweep of 4 runs: 4 finished, 0 unfinished, 0 failed" in err
    runs = tmp_path / "sweep" / "runs"
    names = [f"seek-{name}-s{seed}" for name in ("constant50_sub2_packed", "nonfoa") for seed in (1, 2)]
    assert sorted(path.name for path in runs.iterdir()) == names
    for name in names:
        stored = load_agent(runs / name)
        assert stored.env_steps == 2000
        assert f"seek-{stored.agent.config.name}-s{stored.agent.config.seed}" == name
    assert "resumed at 1,000 env_steps" in (runs / "seek-nonfoa-s1" / "output.txt").read_text()
    assert "new run of nonfoa" in (runs / "seek-nonfoa-s2" / "output.txt").read_text()

    starts = {name: len(json.loads((runs / name / "run.json").read_text())["starts"]) for name in names}
    code, _, err = train(tmp_path / "sweep", "-m", *words)
    assert code == 0 and err.count("finished already") == 4
    assert starts == {name: len(json.loads((runs / name / "run.json").read_text())["starts"]) for name in names}


@pytest.mark.slow
def test_submitit_starts_each_run_in_a_job_of_its_own(tmp_path):
    pytest.importorskip("submitit")
    (tmp_path / "sweep").mkdir()
    launcher = ["hydra/launcher=submitit_local", "hydra.launcher.timeout_min=5"]
    words = ["experiment=nonfoa", "learner.learning_rate=1e-3,1e-4", *TINY, "gaze=learned", "train.env_steps=1000"]
    for _ in range(2):
        code, _, err = train(tmp_path / "sweep", "--multirun", *launcher, *words)
        assert code == 0, err
        assert "sweep of 2 runs: 2 finished, 0 unfinished, 0 failed" in err
    lost = ["experiment=nonfoa", "train.devices=1,4", *TINY, "gaze=learned", "train.env_steps=1000"]
    code, _, err = train(tmp_path / "sweep", "--multirun", *launcher, *lost)
    assert code == 1 and "1 finished, 0 unfinished, 1 failed" in err and "train.devices=4-s0: " in err
    for rate in ("0.001", "0.0001"):
        run = tmp_path / "sweep" / "runs" / f"seek-nonfoa-learner.learning_rate={rate}-s0"
        assert load_agent(run).env_steps == 1000
        assert len(json.loads((run / "run.json").read_text())["starts"]) == 1  # the second time nothing was left
