"""Runs that are kept: what is copied of a run, and what the tables say of it."""

from __future__ import annotations

import json
import re
import shlex

import numpy as np
import pytest

from foajax import cli, keep
from foajax.config.compose import compose
from foajax.config.parse import ConfigError, flatten, to_mapping
from foajax.reporting import kept, results
from foajax.reporting.curves import read_run
from foajax.runs.directory import FREE, load_config
from foajax.viewing import heatmap
from foajax.viewing.heatmap import HeatMap

RUNS = [path for path in sorted(kept.KEPT.glob("*/*")) if path.is_dir()]


@pytest.mark.parametrize("path", RUNS, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_the_command_of_a_kept_run_makes_it(path):
    facts = json.loads((path / "run.json").read_text())
    words = shlex.split(facts["command"].removeprefix("python -m foajax.train "))
    asked, made = (dict(flatten(to_mapping(config))) for config in (compose(words), load_config(path)))
    assert {key for key in asked | made if asked.get(key) != made.get(key)} <= FREE
    assert facts["starts"][-1]["commit"] and facts["hours"] > 0


@pytest.mark.parametrize("path", RUNS, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_a_kept_run_is_in_the_table_with_its_score(path):
    score = json.loads((path / "score.json").read_text())
    assert len(score["returns"]) == score["episodes"] >= 100
    row = next(
        line
        for line in (kept.KEPT / "README.md").read_text().splitlines()
        if f"({path.parent.name}/{path.name})" in line
    )
    shown = [float(number) for number in re.search(r"(\S+) ± (\S+)", row).groups()]
    assert shown == pytest.approx([score["mean"], score["stderr"]], abs=0.051 if score["stderr"] >= 0.05 else 0.00051)


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A finished run of seek, evaluated; `kept.KEPT` is elsewhere."""
    monkeypatch.setattr(kept, "KEPT", tmp_path / "kept")
    path = tmp_path / "seek-seek-s3"
    (path / "checkpoints" / "2000").mkdir(parents=True)
    config = compose(["experiment=seek", "seed=3", "train.env_steps=2000"])
    import yaml

    (path / "config.yaml").write_text(yaml.safe_dump(to_mapping(config)))
    start = {"time": "2026-11-27T21:00:00+00:00", "commit": "abc", "command": ["python", "experiment=seek", "seed=3"]}
    (path / "run.json").write_text(json.dumps({"starts": [start | {"cpu": "a processor", "cores": 2}]}))
    rows = [{"env_steps": step, "time": step / 100, "score": step / 200} for step in range(2, 2002, 2)]
    (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    score = {
        "env_steps": 2000,
        "policy": "sampled",
        "episodes": 100,
        "protocol": [],
        "mean": 9.0,
        "stderr": 0.5,
        "returns": [9.0] * 100,
    }
    (path / "score.json").write_text(json.dumps(score))
    watch(path, env_steps=2000)
    return path


def watch(path, env_steps, games=10):
    """Leaves a heat map, as `render` does."""
    bounds = np.array([0, 0]), np.array([4, 4])
    whose = {"env_steps": env_steps, "policy": "sampled", "whole_games": True}
    (path / "render").mkdir(exist_ok=True)
    heatmap.save(HeatMap(np.eye(5, dtype=int), np.zeros((5, 5)), *bounds, games, **whose), path / "render", "seek")


def test_a_run_is_kept_by_game_experiment_and_seed(run):
    out = kept.keep(run, None)
    assert out == kept.KEPT / "seek" / "seek-s3"
    assert len((out / "metrics.jsonl").read_text().splitlines()) == 500
    assert json.loads((out / "run.json").read_text())["command"] == "python -m foajax.train experiment=seek seed=3"
    assert heatmap.of_run(out, 2000).games == 10
    kept.write_table(kept.runs(kept.KEPT), kept.KEPT)
    table = (kept.KEPT / "README.md").read_text()
    assert "| seek | `seek` | 3 | 281 | learned | 0.0 M | 0.0 | 9.0 ± 0.5 | [seek/seek-s3](seek/seek-s3) |" in table


@pytest.mark.parametrize("other", [{"env_steps": 1000}, {"env_steps": 2000, "games": 1}])
def test_a_gaze_without_a_heat_map_of_the_final_policy_is_refused(run, other):
    watch(run, **other)
    why = "has no heat map of 10 games of its final policy in render/"
    with pytest.raises(ConfigError, match=f"{why}; .* what foajax render run=.* episodes=10"):
        kept.keep(run, None)


def test_a_name_without_a_run_is_refused_before_tables_are_made(run, capsys):
    assert cli.run(keep.keep, ["name=mine"]) == 2
    assert capsys.readouterr().err.startswith("foajax: error: name=mine: accepted is null, or a name beside run=<dir>")


def test_numbers_are_kept_to_five_digits(run):
    row = {"env_steps": 123_456_789, "time": 1.23456789, "score": 0.5, "note": None}
    assert kept._rounded(row) == row | {"time": 1.2346}


def test_a_run_that_is_not_finished_is_refused(run):
    (run / "checkpoints" / "2000").rename(run / "checkpoints" / "1000")
    with pytest.raises(ConfigError, match="has 1,000 of its 2,000 env_steps; accepted is a finished run"):
        kept.keep(run, None)


def test_a_score_of_fewer_games_is_refused(run):
    score = json.loads((run / "score.json").read_text())
    (run / "score.json").write_text(json.dumps(score | {"episodes": 30}))
    with pytest.raises(ConfigError, match="score.json has .*30.*accepted is what foajax evaluate .*episodes=100"):
        kept.keep(run, None)
    (run / "score.json").write_text(json.dumps(score | {"protocol": ["env.sticky_actions=0.25"]}))
    with pytest.raises(ConfigError, match="score.json has .*sticky"):
        kept.keep(run, None)
    (run / "score.json").unlink()
    with pytest.raises(ConfigError, match="has no score.json; accepted is what foajax evaluate"):
        kept.keep(run, None)


def test_a_run_may_be_kept_again_but_not_over_another(run):
    out = kept.keep(run, None)
    (out / "config.yaml").write_text("# as an older schema wrote it\n" + (out / "config.yaml").read_text())
    assert kept.keep(run, None) == out
    text = (out / "config.yaml").read_text()
    (out / "config.yaml").write_text(text.replace("env_steps: 2000", "env_steps: 1000"))
    with pytest.raises(ConfigError, match="seek-s3: holds another run; accepted is another name"):
        kept.keep(run, None)


def test_a_run_that_the_page_refuses_is_not_kept(run, monkeypatch, capsys):
    kept.KEPT.mkdir()
    first = kept.keep(run, "zebra")
    monkeypatch.setattr(kept, "runs", lambda: [read_run(path) for path in sorted(kept.KEPT.glob("*/*"))])
    monkeypatch.setattr(results, "GAMES", {"seek": "Seek"})
    assert cli.run(keep.keep, [f"run={run}"]) == 2
    error = capsys.readouterr().err
    assert f"{kept.KEPT}/seek/seek-s3: repeats it; accepted is another seed than that of {first}" in error
    assert kept.runs()[0].path == first and len(kept.runs()) == 1
