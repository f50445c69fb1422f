"""The command itself, in real processes: runs, resumes, survives being killed, refuses in one line."""

import contextlib
import json
import os
import shutil
import signal
import time

import chex
import jax
import numpy as np
import pytest
from processes import TINY, finish, has_rows, rows, start, wait_for

from foajax.config.compose import compose
from foajax.config.parse import ConfigError
from foajax.launch.processes import Job
from foajax.launch.signals import StopRequest
from foajax.runs.agents import load_agent, save_agent
from foajax.runs.checkpoints import Checkpoints
from foajax.runs.directory import load_config, open_run
from foajax.train import train
from foajax.training.run import Run
from foajax.training.start import check


def same(one, other):
    chex.assert_trees_all_equal((one.params, one.statistics), (other.params, other.statistics))


@pytest.fixture(scope="module")
def breakout(tmp_path_factory):
    """A short run on the real game."""
    run = tmp_path_factory.mktemp("runs") / "breakout"
    code, out, err = finish("experiment=constant50_sub2_packed", *TINY, f"run={run}", "train.env_steps=1000")
    assert code == 0, err
    return run, out


def test_a_run_leaves_everything_that_it_promises(breakout):
    run, out = breakout
    assert "new run of constant50_sub2_packed on breakout" in out and "done: 1,000 env_steps" in out
    assert rows(run)[-1]["env_steps"] == 1000
    for name in ("natural_entropy", "vision_entropy", "loss", "grad_norm", "score", "time"):
        assert name in rows(run)[-1]
    assert (run / "config.yaml").exists()
    events = b"".join(file.read_bytes() for file in (run / "tensorboard").iterdir())
    assert events.count(b"gaze/heat_map") == events.count(b"gaze/views") == 1  # the first one; the next is due later
    assert sorted(int(p.name) for p in (run / "checkpoints").iterdir())[-1] == 1000
    (start,) = json.loads((run / "run.json").read_text())["starts"]
    assert start["packages"]["envpool"] and start["devices"] == ["cpu"]


def test_the_same_seed_gives_the_same_hundred_updates_on_the_emulators_too(breakout, tmp_path):
    """Two minibatches, twice, of 40 steps a rollout; the engine may use as many threads as it likes."""
    run, _ = breakout
    words = ["experiment=constant50_sub2_packed", *TINY, f"run={tmp_path}", "train.env_steps=1000", "env.threads=1"]
    code, out, err = finish(*words)
    assert code == 0, err
    one, other = load_agent(run), load_agent(tmp_path)
    assert one.env_steps == other.env_steps == 1000
    same(one, other)
    last, again = rows(run)[-1], rows(tmp_path)[-1]
    assert {k: v for k, v in last.items() if k != "time"} == {k: v for k, v in again.items() if k != "time"}


LOGGER = """
class Log:
    def __init__(self, config, fails_at):
        self.file, self.fails_at = open(f"{config.run_dir}/log.txt", "w"), fails_at

    def log(self, row, env_steps):
        if env_steps >= self.fails_at:
            raise ConnectionError("no network")
        print(env_steps, row["loss"], file=self.file)

    def close(self):
        self.file.close()
"""


@pytest.fixture(scope="module")
def longer(breakout, tmp_path_factory):
    """The same run, of which more was asked, with a logger of one's own that fails."""
    directory = tmp_path_factory.mktemp("longer")
    run = shutil.copytree(breakout[0], directory / "run")
    (directory / "mine.py").write_text(LOGGER)
    words = ["train.env_steps=1200", "train.logger=mine:Log", "train.logger_kwargs.fails_at=1120"]
    code, out, err = finish("experiment=constant50_sub2_packed", *TINY, f"run={run}", *words, cwd=directory)
    assert code == 0, err
    return run, out


def test_a_finished_run_goes_on_when_more_is_asked_for(longer):
    run, out = longer
    assert "resumed at 1,000 env_steps (episodes start anew, emulators cannot be saved)" in out
    steps = [row["env_steps"] for row in rows(run)]
    assert steps == sorted(set(steps)) and steps[-1] == 1200


def test_a_logger_of_ones_own_gets_each_row_and_ends_no_run(longer):
    run, out = longer
    assert out.count("warning: train.logger fails (no network); training goes on") == 1
    logged = [(row["env_steps"], row["loss"]) for row in rows(run) if 1000 < row["env_steps"] < 1120]
    assert [tuple(map(float, line.split())) for line in (run / "log.txt").read_text().splitlines()] == logged != []


def test_a_resumed_run_has_all_of_the_learners_state_where_games_start_anew(breakout, tmp_path):
    path = shutil.copytree(breakout[0], tmp_path / "run")
    config = load_config(path)
    with contextlib.ExitStack() as resources:
        run_dir = resources.enter_context(open_run(config, command=[]))
        run = Run(config, Job(config), run_dir, resources)
        state, tracker, env_steps = run.progress.state, run.progress.tracker.get_state(), run.progress.env_steps
    template = jax.eval_shape(lambda: state)
    saved = Checkpoints(path / "checkpoints", keep=None).restore({"train": template, "collector": []})
    chex.assert_trees_all_equal(state, saved.state["train"])  # optimiser and counters too
    assert state.updates == env_steps / 40 * 2 * 2 and state.opt_state.count == state.updates
    assert env_steps == saved.env_steps == rows(path)[-1]["env_steps"] >= 1000
    assert tracker == saved.meta["tracker"] | {name: [0] * 8 for name in ("scores", "lengths")}


def test_a_run_whose_environments_are_slow_to_close_says_its_end_once(breakout, tmp_path, capsys):
    config = load_config(shutil.copytree(breakout[0], tmp_path / "run"))
    with contextlib.ExitStack() as resources:
        run = Run(config, Job(config), resources.enter_context(open_run(config, command=[])), resources)
        run.loop(StopRequest())
        assert run._abandon("SIGTERM", 0) == 0  # as the watchdog does
    said = "".join(capsys.readouterr())
    assert said.count("done: 1,000 env_steps") == 1 and "SIGTERM" not in said


def test_evaluation_plays_whole_games(breakout, tmp_path):
    run, _ = breakout
    code, out, err = finish(f"run={run}", "episodes=3", f"json={tmp_path / 'score.json'}", module="evaluate")
    assert code == 0, err
    result = json.loads((tmp_path / "score.json").read_text())
    assert len(result["returns"]) == len(result["lengths"]) == 3 and result["policy"] == "sampled"
    assert result["mean"] == pytest.approx(np.mean(result["returns"]))
    assert result["stderr"] == pytest.approx(np.std(result["returns"], ddof=1) / np.sqrt(3))
    # Five lives of doing next to nothing take well over a hundred steps, and no game is without an end.
    assert all(100 < length <= 27_000 for length in result["lengths"])
    assert "constant50_sub2_packed" in out


def test_a_shipped_agent_is_the_runs(breakout, tmp_path):
    run, _ = breakout
    stored = load_agent(run)
    save_agent(stored, tmp_path / "agent")
    shipped = load_agent(tmp_path / "agent")
    same(stored, shipped)
    assert shipped.env_steps == stored.env_steps and shipped.agent.config.sensor == stored.agent.config.sensor


def test_a_run_begins_with_the_parameters_of_another(breakout, tmp_path, command):
    run, _ = breakout
    words = ["experiment=constant50_sub2_packed", *TINY, f"run={tmp_path}", f"train.init_from={run}"]
    # A step so small that it changes nothing in float32.
    code, out, err = command(*words, "train.env_steps=40", "learner.learning_rate=1e-30")
    assert code == 0, err
    assert f"new run of constant50_sub2_packed on breakout, from the parameters of {run}" in out
    chex.assert_trees_all_equal(load_agent(tmp_path).params, load_agent(run).params)


@pytest.mark.parametrize(
    ("source", "word", "said"),
    [
        (
            "nowhere",
            "seed=1",
            "train.init_from=nowhere: does not exist; accepted is the directory of a run or an agent, or",
        ),
        (
            "breakout",
            "network.lstm=8",
            "this run's sensor, network, gaze and number of actions; that one has network.lstm=16\n",
        ),
    ],
)
def test_parameters_that_do_not_fit_are_refused_in_one_line(breakout, tmp_path, command, source, word, said):
    words = ["experiment=constant50_sub2_packed", *TINY, f"run={tmp_path / 'new'}", word]
    code, _, err = command(*words, f"train.init_from={breakout[0] if source == 'breakout' else source}")
    assert code == 2 and len(err.splitlines()) == 1 and err.startswith("foajax: error: train.init_from="), err
    assert said in err


def test_of_several_processes_only_the_first_one_looks_for_the_parameters():
    words = ["experiment=seek", "train.init_from=nowhere"]
    with pytest.raises(ConfigError, match="train.init_from=nowhere: does not exist"):
        check(compose(words))
    check(
        compose([*words, "distributed.coordinator=localhost:1234", "distributed.processes=2", "distributed.process=1"])
    )


@pytest.mark.slow
def test_another_process_finds_all_compiled_programs(tmp_path):
    """Python hashes strings differently in each process: nothing that is compiled may follow a set's order."""
    cache = tmp_path / "cache"
    found = []
    for seed in (0, 7):  # two which order the metrics of the two heads differently
        variables = {"PYTHONHASHSEED": str(seed), "JAX_COMPILATION_CACHE_DIR": str(cache)}
        words = ["game=seek", *TINY, f"run={tmp_path / str(seed)}", "train.env_steps=40"]
        everything = os.environ | variables | {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
        code, _, err = finish(*words, env=everything)
        assert code == 0, err
        found.append({path.name for path in cache.glob("*-cache")})
    assert any(name.startswith("jit_update") for name in found[0])
    assert found[0] == found[1]


def test_a_resumed_run_equals_an_uninterrupted_one_bit_for_bit(tmp_path, command):
    words = ["game=seek", *TINY]
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert command(*words, f"run={whole}", "train.env_steps=1600")[0] == 0
    assert command(*words, f"run={parts}", "train.env_steps=600")[0] == 0
    code, out, err = finish(*words, f"run={parts}", "train.env_steps=1600")  # another process
    assert code == 0, err
    assert "resumed at 600 env_steps (episodes go on)" in out
    a, b = load_agent(whole), load_agent(parts)
    same(a, b)
    last, resumed = rows(whole)[-1], rows(parts)[-1]
    assert {k: v for k, v in last.items() if k != "time"} == {k: v for k, v in resumed.items() if k != "time"}


OTHERS = [pytest.param(number, marks=pytest.mark.slow) for number in (signal.SIGINT, signal.SIGUSR1, signal.SIGHUP)]


@pytest.mark.parametrize("number", [signal.SIGTERM, *OTHERS])
def test_a_signal_saves_and_ends_well(tmp_path, number):
    process = start("game=seek", *TINY, f"run={tmp_path}", "train.env_steps=100000000")
    wait_for(lambda: has_rows(tmp_path), process)
    process.send_signal(number)
    begin = time.monotonic()
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert time.monotonic() - begin < 10
    saved = max(int(p.name) for p in (tmp_path / "checkpoints").iterdir())
    assert f"{signal.Signals(number).name}: saved at {saved:,} env_steps" in out
    assert rows(tmp_path)[-1]["env_steps"] == saved


def test_two_processes_do_not_share_a_run(tmp_path, command):
    process = start("game=seek", *TINY, f"run={tmp_path}", "train.env_steps=100000000")
    wait_for(lambda: (tmp_path / "lock").exists() and (tmp_path / "lock").read_text(), process)
    code, _, err = command("game=seek", *TINY, f"run={tmp_path}")
    process.kill()
    process.communicate()
    assert code == 2 and len(err.splitlines()) == 1 and f"in use by process {process.pid}" in err


@pytest.mark.parametrize(
    "word, said",
    [
        ("learner.learning_rat=1", "learner.learning_rat=1: unknown key"),
        ("sensor.rings=[[90,90,2]]", "inside env.frame_shape=80x80"),
        ("sensor.rings=[[16,16,40]]", "1 <= factor <= height and width"),
        ("env.num_envs=many", "env.num_envs=many: accepted is an integer"),
        ("game=no_such_game", "game=no_such_game: did you mean name_this_game? accepted is"),
        ("experiment=constant71", "experiment=constant71: did you mean constant70? accepted is one of"),
        ("gaze=none", "gaze.mode=none: the focal area is 16x16, not the whole frame, 80x80; accepted is learned, "),
    ],
)
def test_what_cannot_be_run_is_refused_in_one_line(tmp_path, command, word, said):
    code, out, err = command(*TINY, word, f"run={tmp_path / 'run'}")
    assert code == 2 and out == ""
    assert len(err.splitlines()) == 1 and err.startswith("foajax: error: ") and said in err


def test_another_meaning_is_refused_by_name(breakout, command):
    run, _ = breakout
    code, _, err = command("experiment=constant50_sub2_packed", *TINY, f"run={run}", "learner.learning_rate=0.01")
    assert code == 2 and len(err.splitlines()) == 1 and "learner.learning_rate=0.01: the run in" in err


def test_a_profile_is_of_one_device(tmp_path):
    config = compose([*TINY, "profile=true", "train.devices=2", f"run={tmp_path}"])
    with pytest.raises(ConfigError, match="profile=true: accepted is train.devices=1 and a single process"):
        train(config)


def test_a_profile_that_cannot_be_written_is_refused_before_anything_is_measured(tmp_path, command):
    (tmp_path / "file").write_text("")
    code, _, err = command("game=seek", *TINY, "profile=true", f"run={tmp_path / 'file'}")
    assert code == 2 and err.startswith(f"foajax: error: run={tmp_path / 'file' / 'profile'}: accepted is a directory")


@pytest.mark.slow
def test_a_profile_is_a_trace_and_a_table(tmp_path):
    code, out, err = finish(*TINY, "profile=true", f"run={tmp_path}")
    assert code == 0, err
    assert all(part in out for part in ("env", "act", "update", "us/step"))
    assert list((tmp_path / "profile").rglob("*.xplane.pb"))
