"""foajax.reproduce: the stages are what the paper compares, finished runs are skipped, the rest is listed."""

from __future__ import annotations

import json
import shlex

import pytest
import yaml

from foajax import cli, reproduce
from foajax.config.compose import compose
from foajax.config.parse import to_mapping
from foajax.launch import sweep

SENSORS = {
    *("nonfoa", "constant50_sub1_packed", "constant50_sub2_packed", "constant70_packed", "decreasing_packed"),
    *("constant70_p_packed", "decreasing_p_packed"),
}


@pytest.fixture
def short(tmp_path, monkeypatch):
    """One stage of two short runs of seek, in a directory of the test's."""
    lines = ["experiment=seek seed=0,1 train.env_steps=640 env.num_envs=4 train.log_every=0.1"]
    monkeypatch.setattr(reproduce, "stages", lambda plan: [{"about": "a short stage", "runs": lines}])
    score = {"policy": "sampled", "episodes": 2, "protocol": []}
    monkeypatch.setattr(reproduce.kept, "wanted_score", lambda config, env_steps: {"env_steps": env_steps, **score})
    monkeypatch.setattr(reproduce.kept, "wanted_games", lambda config: 1)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def planned(plan):
    return [
        run.config for stage in reproduce.stages(plan) for line in stage["runs"] for run in sweep.expand(line.split())
    ]


def test_each_game_has_the_papers_seven_sensors():
    runs = planned("paper")
    for game, steps in (("breakout", 3_000_000), ("pong", 1_500_000), ("beam_rider", 3_000_000)):
        first = [c for c in runs if c.game == game and c.seed == 0 and c.name in SENSORS]
        assert {c.name for c in first} == SENSORS and {c.train.env_steps for c in first} == {steps}
    assert len({config.run_dir for config in runs}) == len(runs)


def test_commands_of_what_is_left(capsys):
    assert cli.run(reproduce.reproduce, ["stage=2", "show=commands"]) == 0
    commands = capsys.readouterr().out.splitlines()
    configs = [compose(shlex.split(line.removeprefix("python -m foajax.train "))) for line in commands]
    assert [config.gaze.mode for config in configs] == ["frozen", "frozen", "random", "scripted", "learned", "learned"]
    assert [config.gaze.start for config in configs[:2]] == ["centre", (45, 40)]
    assert [config.sensor.layout for config in configs[-2:]] == ["canvas", "canvas"]


@pytest.mark.slow
def test_a_stage_is_trained_evaluated_and_then_left_alone(short, capsys):
    assert cli.run(reproduce.reproduce, ["jobs=2"]) == 0
    for seed in (0, 1):
        assert json.loads((short / f"runs/seek-seek-s{seed}/score.json").read_text())["episodes"] == 2
        assert json.loads((short / f"runs/seek-seek-s{seed}/render/heatmap.json").read_text())["games"] == 1
    capsys.readouterr()
    assert cli.run(reproduce.reproduce, ["jobs=2"]) == 0
    assert capsys.readouterr().err.count("finished already") == 2
    assert cli.run(reproduce.reproduce, ["show=table"]) == 0
    assert capsys.readouterr().out.count("finished") == 2


def finished(path, config, steps):
    """Makes the files of a run that was trained for so many steps."""
    (path / "checkpoints" / str(steps)).mkdir(parents=True)
    (path / "config.yaml").write_text(yaml.safe_dump(to_mapping(config)))
    (path / "run.json").write_text('{"starts": []}')


@pytest.mark.parametrize("left", ['{"env_steps": 64', '{"env_steps": 320, "policy": "sampled"}', "{}"])
def test_games_that_were_interrupted_or_of_an_older_agent_are_played_again(short, monkeypatch, left):
    called = []
    monkeypatch.setattr(reproduce.subprocess, "call", lambda command: called.append(command[2]) or 0)
    runs = sweep.expand(["experiment=seek", "seed=0", "train.env_steps=640"])
    path = short / runs[0].config.run_dir
    finished(path, runs[0].config, 640)
    (path / "score.json").write_text(left)
    (path / "render").mkdir()
    assert reproduce._play(runs, 1) == 0
    assert called == ["foajax.evaluate", "foajax.render"]


@pytest.mark.parametrize(
    ("word", "said"),
    [("stage=0", "stage=0: accepted is null or an integer from 1 to 6"), ("jobs=0", "jobs=0: accepted is")],
)
def test_what_cannot_be_is_refused(capsys, word, said):
    assert cli.run(reproduce.reproduce, [word]) == 2
    assert capsys.readouterr().err.startswith(f"foajax: error: {said}")


def test_a_request_to_stop_ends_it_before_the_next_stage(monkeypatch, capsys):
    def stopped(runs, *, jobs, stop):
        started.append(runs)
        stop.requested = 2
        return 0

    started = []
    monkeypatch.setattr(sweep, "run_all", stopped)
    monkeypatch.setattr(reproduce, "_play", None)
    assert cli.run(reproduce.reproduce, []) == 0
    assert len(started) == 1


def test_the_table_tells_a_planned_run_from_another(short, capsys):
    """Of one that is shorter than planned, one of another learner, one whose score is older than its checkpoint."""
    for seed, words, steps in ((0, [], 320), (1, ["learner.learning_rate=1e-5"], 640)):
        line = f"experiment=seek seed={seed} train.env_steps={steps} env.num_envs=4 train.log_every=0.1"
        config = compose([*line.split(), *words])
        path = short / config.run_dir
        finished(path, config, steps)
        (path / "score.json").write_text(json.dumps({"env_steps": 320, "mean": 1148.4, "stderr": 31.0}))
    assert cli.run(reproduce.reproduce, ["show=table"]) == 0
    shorter, other = (line for line in capsys.readouterr().out.splitlines() if "runs/seek" in line)
    assert "too short" in shorter and "1148.4 ± 31.0" in shorter
    assert "another run" in other and "1148" not in other


def test_commands_have_no_empty_lines(monkeypatch, capsys):
    monkeypatch.setattr(reproduce, "is_finished", lambda config: True)
    assert cli.run(reproduce.reproduce, ["show=commands"]) == 0
    assert capsys.readouterr().out == ""
