"""The table of runs: every state told from files alone."""

import fcntl
import json
import os
import time

import pytest
from rich.console import Console

from foajax import status as command
from foajax.config.compose import compose
from foajax.config.parse import ConfigError
from foajax.runs import status
from foajax.runs.directory import open_run
from foajax.runs.lock import is_held


@pytest.fixture
def start(tmp_path):
    """Opens a run of 1000 env_steps."""

    def one(name, *words):
        config = compose(["game=seek", f"run={tmp_path / name}", "train.env_steps=1000", *words])
        return open_run(config, command=["x"])

    return one


def log(run, *rows):
    text = "".join(json.dumps({"env_steps": n, "time": t, "score": score}) + "\n" for n, t, score in rows)
    (run.path / "metrics.jsonl").write_text(text)


def age(path, seconds):
    moment = time.time() - seconds
    os.utime(path, (moment, moment))


def test_a_run_that_is_held_is_starting_running_or_stalled(start):
    with start("a") as run:
        assert status.inspect(run.path).state == "starting"
        age(run.path / "run.json", 10)
        log(run, (100, 1.0, None), (300, 3.0, -0.5))
        seen = status.inspect(run.path)
        assert (seen.state, seen.env_steps, seen.total, seen.speed, seen.score) == ("running", 300, 1000, 100.0, -0.5)
        assert seen.seconds_left == 7.0
        age(run.path / "run.json", 500), age(run.path / "metrics.jsonl", 400)
        assert status.inspect(run.path).state == "stalled"
    with start("a") as run:  # the rows are those of the start before
        assert status.inspect(run.path).state == "starting"


def test_what_logs_seldom_is_not_stalled_soon(start):
    with start("a", "train.log_every=60") as run:
        log(run, (100, 1.0, None))
        age(run.path / "run.json", 600), age(run.path / "metrics.jsonl", 500)
        assert status.inspect(run.path).state == "running"


def test_a_run_that_is_not_held_is_finished_failed_or_stopped(start):
    with start("a") as run:
        log(run, (900, 9.0, 2.0))
    assert status.inspect(run.path).state == "stopped"
    (run.path / "checkpoints" / "1000").mkdir(parents=True)
    (run.path / "checkpoints" / "2000.unusable").mkdir()
    (run.path / "checkpoints" / ".3000.new").mkdir()
    seen = status.inspect(run.path)
    assert (seen.state, seen.env_steps, seen.seconds_left) == ("finished", 1000, None)


@pytest.mark.parametrize(
    "error, told", [(ConfigError("game=x: accepted is y"), "game=x: accepted is y"), (KeyError("k"), "KeyError: 'k'")]
)
def test_why_a_start_failed_is_kept_until_the_next(start, error, told):
    with pytest.raises(type(error)), start("a") as run:
        raise error
    seen = status.inspect(run.path)
    assert (seen.state, seen.reason) == ("failed", told)
    with start("a"):
        assert status.inspect(run.path).state == "starting"
    assert status.inspect(run.path).state == "stopped"


def test_an_interrupted_start_has_not_failed(start):
    with pytest.raises(KeyboardInterrupt), start("a") as run:
        raise KeyboardInterrupt
    assert status.inspect(run.path).state == "stopped"


def test_looking_does_not_keep_a_run_from_starting(start):
    with start("a") as run:
        pass
    lock = (run.path / "lock").open("rb")
    fcntl.flock(lock, fcntl.LOCK_SH)
    with pytest.raises(ConfigError, match="in use"):
        start("a")
    lock.close()
    for _ in range(3):
        with start("a") as run:
            assert is_held(run.path)
        assert not is_held(run.path)


def test_torn_rows_and_damaged_files_are_survived(start):
    with start("a") as run:
        log(run, (100, 1.0, None))
        with (run.path / "metrics.jsonl").open("a") as file:
            file.write('{"env_steps": 2')
    assert status.inspect(run.path).env_steps == 100
    (run.path / "config.yaml").write_text("[")
    seen = status.inspect(run.path)
    assert seen.state == "failed" and "config.yaml" in seen.reason


def test_the_command_finds_runs_and_prints_one_table(start, tmp_path, capsys, monkeypatch):
    for name in ("a", "deep/b"):
        (tmp_path / name).mkdir(parents=True)
        with start(name) as run:
            log(run, (500, 1.0, 3.0))
    assert status.find_runs([tmp_path, tmp_path / "deep"]) == [tmp_path / "a", tmp_path / "deep" / "b"]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "120")
    command.status(["."])
    out = capsys.readouterr().out
    assert "2 runs: 2 stopped" in out and "deep/b" in out and "50 %" in out and "score" in out and "3.00" in out
    with pytest.raises(ConfigError, match="nowhere: is no directory; accepted is a directory with runs"):
        command.status(["nowhere"])
    with pytest.raises(ConfigError, match="run=a: accepted is a, without run="):
        command.status(["run=a"])
    with pytest.raises(ConfigError, match="every=0.0: accepted is"):
        command.status([".", "every=0"])
    with pytest.raises(ConfigError, match="evry=1: unknown key"):
        command.status([".", "evry=1"])


def test_an_empty_table_says_so():
    console = Console(width=100)
    with console.capture() as shown:
        console.print(command.table([]))
    assert "no runs yet" in shown.get()
