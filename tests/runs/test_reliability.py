"""What may happen to a run, as it happens to a real one: damage, foreign files, a full disk, numbers that overflow."""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import re
import shutil
import signal
import subprocess
import time

import jax
import numpy as np
import pytest
from processes import TINY, finish, newest, rows, start, wait_for
from safetensors.numpy import load_file
from test_checkpoints import Trap, damage_last_byte

from foajax import cli, store
from foajax.runs import durable
from foajax.runs.agents import load_agent
from foajax.runs.checkpoints import Checkpoints

SEEK = ["game=seek", *TINY, "train.checkpoint_every=0.3"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run that has several checkpoints, and scores to tell the best of them."""
    run = tmp_path_factory.mktemp("runs") / "seek"
    code, out, err = finish(*SEEK, f"run={run}", "train.env_steps=12000")
    assert code == 0, err
    return run


@pytest.fixture
def run(finished, tmp_path):
    """A copy of it to damage."""
    return shutil.copytree(finished, tmp_path / "run")


def score(run, env_steps):
    return json.loads((run / "checkpoints" / str(env_steps) / "meta.json").read_text())["meta"].get("score")


def test_a_damaged_newest_and_foreign_files_cost_one_checkpoint(run):
    checkpoints = run / "checkpoints"
    steps = Checkpoints(checkpoints, keep=None).steps()
    trap = pickle.dumps(Trap(run / "sprung"))
    (checkpoints / "20000").write_bytes(trap)
    (checkpoints / "20001").mkdir()
    np.savez(checkpoints / "20001" / "state.npz", bomb=np.array([Trap(run / "sprung")], dtype=object))
    (checkpoints / "20002").write_bytes(os.urandom(10_000))
    damage_last_byte(next(path for path in (checkpoints / str(steps[-1]) / "state" / "d").iterdir()))
    code, out, err = finish(*SEEK, f"run={run}", "train.env_steps=12400")
    assert code == 0, err
    warned = [line for line in err.splitlines() if line.startswith("warning: ")]
    assert len(warned) == 4 == len(err.splitlines())
    for line, step in zip(sorted(warned), [steps[-1], 20000, 20001, 20002], strict=True):
        assert f"checkpoint {checkpoints}/{step} cannot be used" in line and f"using {steps[-2]} instead" in line
    assert f"resumed at {steps[-2]:,} env_steps" in out and "done: 12,400 env_steps" in out
    assert newest(run) == 12400 and not (run / "sprung").exists()


def test_no_usable_checkpoint_is_one_line_and_starts_nothing(run, command):
    for path in (run / "checkpoints").iterdir():
        (path / "SHA256SUMS").unlink()
    before = sorted((run / "checkpoints").rglob("*"))
    code, out, err = command(*SEEK, f"run={run}", "train.env_steps=20000")
    assert code == 2 and len(err.splitlines()) == 1 and "no usable checkpoint in" in err
    assert sorted((run / "checkpoints").rglob("*")) == before


@pytest.mark.parametrize("name", ["agent.json", pytest.param("metrics.jsonl", marks=pytest.mark.slow)])
def test_a_file_that_cannot_be_written_at_the_start_is_one_line(tmp_path, command, name):
    (tmp_path / name).mkdir()
    code, out, err = command(*SEEK, f"run={tmp_path}")
    assert code == 2 and out == "" and len(err.splitlines()) == 1
    assert err.startswith(f"foajax: error: run={tmp_path}: cannot be used (") and name in err


@pytest.mark.slow
def test_the_best_so_far_is_kept_over_starts(run):
    steps = Checkpoints(run / "checkpoints", keep=None).steps()
    best = run / "checkpoints" / str(steps[0])  # made so: nothing that comes will be better
    meta = json.loads((best / "meta.json").read_text())
    meta["meta"]["score"] = 999.0
    (best / "meta.json").write_text(json.dumps(meta))
    durable.seal(best)
    before = rows(run)[-1]
    code, out, err = finish(*SEEK, f"run={run}", "train.env_steps=16000", "train.keep_checkpoints=1")
    assert code == 0, err
    after = rows(run)[-1]
    assert after["games"] > before["games"] and after["best_score"] >= before["best_score"]
    left = Checkpoints(run / "checkpoints", keep=None).steps()
    assert left == [steps[0], 16000] and score(run, steps[0]) == 999.0
    assert load_agent(run).env_steps == 16000 and load_agent(run, best=True).env_steps == steps[0]
    assert cli.run(store.store, [f"run={run}", f"out={run}-best", "checkpoint=best"]) == 0
    assert load_agent(f"{run}-best").env_steps == steps[0]


def test_numbers_that_overflow_end_a_run_with_a_diagnosis_and_good_parameters(tmp_path):
    words = ["learner.learning_rate=1e38", "train.max_skipped=3", "train.dump_skipped=true"]
    code, out, err = finish(*SEEK, *words, f"run={tmp_path}")
    assert code == 2 and len(err.splitlines()) == 1
    assert err.startswith("foajax: error: train.max_skipped=3: 3 updates in a row were not finite (loss ")
    assert "param_norm inf" in err or "param_norm nan" in err
    stored = load_agent(tmp_path)
    assert f"saved at {stored.env_steps:,} env_steps" in err
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(stored.params))
    (dumped,) = (tmp_path / "skipped").iterdir()
    assert dumped.name == "0-0.safetensors" and load_file(dumped)["rollout/steps/reward"].shape == (6, 8)
    assert rows(tmp_path)[-1]["skipped_updates"] >= 1


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 32 MB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=32m", "tmpfs", str(disk)]
    if os.geteuid() != 0 or shutil.which("mount") is None or subprocess.run(mount).returncode != 0:
        pytest.skip("a file system can be mounted by root only")
    yield disk
    subprocess.run(["umount", "--lazy", str(disk)], check=True)


def test_a_full_disk_stops_nothing(small_disk, tmp_path):
    run, log = small_disk / "run", tmp_path / "log"
    words = ["train.env_steps=100000000", "train.log_every=0.2"]
    with log.open("w") as out:
        process = start(*SEEK, f"run={run}", *words, stdout=out, stderr=out)
        wait_for(lambda: newest(run), process)
        stop(process)
        while any((run / "checkpoints").glob(".*.new")):  # one that is being written would run out of room half-way
            process.send_signal(signal.SIGCONT)
            time.sleep(0.1)
            stop(process)
        with (small_disk / "ballast").open("wb", buffering=0) as ballast, contextlib.suppress(OSError):
            while True:  # until there is no room at all
                ballast.write(bytes(4096))
        process.send_signal(signal.SIGCONT)
        wait_for(lambda: "was not written: [Errno 28] No space left on device" in log.read_text(), process)
        kept, steps = newest(run), len(log.read_text())
        wait_for(lambda: len(log.read_text()) > steps + 1000, process)  # it goes on
        assert newest(run) == kept
        (small_disk / "ballast").unlink()
        wait_for(lambda: newest(run) > kept, process)
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=60)
    assert process.returncode == 0
    assert "Traceback" not in log.read_text()
    assert load_agent(run).env_steps == newest(run) == rows(run)[-1]["env_steps"]


def stop(process):
    process.send_signal(signal.SIGSTOP)
    os.waitid(os.P_PID, process.pid, os.WSTOPPED)


@pytest.mark.slow
def test_a_run_whose_end_is_not_saved_says_so(run):
    """Something is in the way of the last checkpoint."""
    (run / "checkpoints" / ".12800.new").touch()
    code, out, err = finish(*SEEK, f"run={run}", "train.env_steps=12800")
    assert code == 2 and "done" not in out, out
    said = r"run=.*: it was trained to 12,800 env_steps, but 12,\d{3} are saved; accepted is a directory"
    assert re.search(said, err), err
