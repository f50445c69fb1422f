"""The report: which runs belong together, what the curves say, and a page that needs nothing else."""

from __future__ import annotations

import dataclasses
import json
import re

import numpy as np
import pytest
import yaml
from browser import browser_needed, opened_page
from PIL import Image

from foajax import cli, report
from foajax.config.compose import compose
from foajax.config.parse import ConfigError, to_mapping
from foajax.reporting import curves, groups, report_page
from foajax.viewing import heatmap
from foajax.viewing.heatmap import HeatMap

SMALL = ["network.dense=8", "network.lstm=8"]


def make_run(directory, name, *, words, scores, step=1000, seconds=60.0):
    """A run's directory with a row every `step` env_steps, and none of the rest."""
    run = directory / name
    run.mkdir()
    (run / "config.yaml").write_text(yaml.safe_dump(to_mapping(compose([*words, *SMALL]))))
    rows = [{"env_steps": 0, "time": 0.0, "score": None}]
    rows += [{"env_steps": step * i, "time": seconds * i, "score": s} for i, s in enumerate(scores, 1)]
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return run


CURRENT = HeatMap(
    *(np.eye(80, dtype=int), np.zeros((80, 80)), np.array([0, 0]), np.array([79, 79])),
    **{"games": 4, "env_steps": 3000, "policy": "sampled", "whole_games": True},
)


def store_map(run, heat):
    """As `render` does, without the picture."""
    (run / "render").mkdir()
    (run / "render" / heatmap.FILE).write_text(json.dumps(heat.to_json()))


@pytest.fixture
def runs(tmp_path):
    """Two experiments with two seeds each on seek, one of them evaluated."""
    for seed in (0, 1):
        words = ["game=seek", f"seed={seed}"]
        plain = [*words, "experiment=constant50_sub2_packed"]
        make_run(tmp_path, f"plain-{seed}", words=plain, scores=[0.0, 1.0 + seed, 2.0 + 2 * seed])
        periphery = [*words, "experiment=constant70_p_packed", "learner.learning_rate=2e-3"]
        make_run(tmp_path, f"periphery-{seed}", words=periphery, scores=[1.0, 5.0, 6.0 + seed])
    (tmp_path / "plain-0" / "score.json").write_text(json.dumps({"mean": 11.0, "episodes": 30}))
    return sorted(tmp_path.iterdir())


def test_a_band_is_the_mean_where_all_seeds_have_scores(tmp_path):
    one = make_run(tmp_path, "a", words=["game=seek"], scores=[0.0, 10.0, 20.0])
    two = make_run(tmp_path, "b", words=["game=seek", "seed=1"], scores=[30.0, 30.0])
    band = curves.band([curves.read_run(one), curves.read_run(two)], "env_steps")
    assert (band.x[0], band.x[-1]) == (1000, 2000)
    np.testing.assert_allclose([band.mean[0], band.mean[-1]], [15, 20])
    np.testing.assert_allclose([band.low[0], band.high[0]], [0, 30])  # either seed twice, each in 1 of 4 resamples
    assert curves.band([curves.read_run(one), curves.read_run(two)], "time").x[-1] == 120
    late = make_run(tmp_path, "c", words=["game=seek", "seed=2"], scores=[None, None, None, 1.0])
    assert curves.band([curves.read_run(two), curves.read_run(late)], "time") is None  # none in common


def test_seeds_are_grouped_and_final_scores_are_the_evaluated_ones(runs):
    games = groups.games_of(map(curves.read_run, runs), None)
    assert {game: {name: len(seeds) for name, seeds in groups.items()} for game, groups in games.items()} == {
        "seek": {"constant70_p_packed": 2, "constant50_sub2_packed": 2}
    }
    scores = groups.final_scores(games["seek"])
    assert scores["constant50_sub2_packed"].value == pytest.approx((11.0 + 4.0) / 2)
    assert scores["constant70_p_packed"].value == pytest.approx(6.5)
    assert groups.all_games(games) == {}  # one game needs no normalising


def test_all_games_are_normalised_and_only_for_who_played_all(tmp_path):
    for game, score in (("seek", 6.0), ("pong", 14.6)):
        make_run(tmp_path, game, words=[f"game={game}"], scores=[score])
    make_run(tmp_path, "other", words=["game=pong", "experiment=nonfoa"], scores=[0.0])
    games = groups.games_of(map(curves.read_run, sorted(tmp_path.iterdir())), None)
    together = groups.all_games(games)
    assert list(together) == ["constant70"]
    assert together["constant70"].value == pytest.approx((0.5 + 1) / 2)


def test_torn_rows_and_what_is_no_row_are_left_out(tmp_path):
    run = make_run(tmp_path, "killed", words=["game=seek"], scores=[1.0, 2.0])
    no_rows = [b"", b"[1]", b"7", b"\xff", b'{"env_steps": 9, "time": NaN, "score": 1}', b'{"env_steps": 3000, "ti']
    with (run / "metrics.jsonl").open("ab") as file:
        file.write(b"\n".join(no_rows))
    read = curves.read_run(run)
    assert read.env_steps.tolist() == [1000, 2000] and read.score.tolist() == [1, 2]


@pytest.mark.parametrize("name", ["metrics.jsonl", "score.json"])
def test_the_file_that_is_not_readable_is_named(tmp_path, name):
    run = make_run(tmp_path, "run", words=["game=seek"], scores=[1.0])
    (run / name).unlink(missing_ok=True)
    (run / name).mkdir()
    with pytest.raises(ConfigError, match=f"run: its {name} is missing or damaged"):
        curves.read_run(run)


def test_a_preset_has_the_papers_order_and_names(tmp_path):
    for name in ("constant70", "nonfoa", "decreasing", "constant50_sub1_packed"):
        make_run(tmp_path, name, words=["game=seek", f"experiment={name}"], scores=[1.0])
    every = [curves.read_run(run) for run in sorted(tmp_path.iterdir())]
    assert list(groups.games_of(every, "constant")["seek"]) == [
        "Non-FoA, sub1",
        "Constant 50x50, sub1, packed",
        "Constant 70x70, sub2",
    ]
    assert list(groups.games_of(every, "decreasing")["seek"]) == ["Constant 70x70, sub2", "Decreasing 30-50-70"]


def test_what_a_preset_leaves_out_is_named(tmp_path, capsys):
    names = ("constant70", "constant70-paper", "decreasing-gaze=frozen")
    runs = [str(make_run(tmp_path, name, words=["game=seek", f"name='{name}'"], scores=[1.0])) for name in names]
    words = [*runs, f"out={tmp_path / 'o'}", "preset=decreasing", "episodes=0", "repeats=0"]
    assert cli.run(report.report, words) == 0
    said = f"preset=decreasing leaves out {runs[1]} (constant70-paper), {runs[2]} (decreasing-gaze=frozen)\n"
    assert capsys.readouterr().err == said


def test_the_page(runs, tmp_path, capsys, monkeypatch):
    counted = {"pixels_actual": 625, "pixels_ratio": 0.0977, "torso_flops": 12e6, "decision_flops": 13e6}
    monkeypatch.setattr(
        report_page.cost,
        "measure_decisions",
        lambda configs, repeats: [counted | {"decision_us_batch1": 950.0}] * len(configs),
    )
    store_map(runs[0], CURRENT)
    (runs[0] / "render" / "episode-0.mp4").write_bytes(b"")
    out = tmp_path / "report"
    words = [*map(str, runs), f"out={out}", "episodes=0", "repeats=1"]
    assert cli.run(report.report, words) == 0
    assert capsys.readouterr().out.strip() == str(out / "index.html")
    for name in ("curves-seek.png", "scores.png", "heatmap-seek-constant70_p_packed-s0.png"):
        with Image.open(out / name) as image:
            assert min(image.size) > 200
    page = (out / "index.html").read_text()
    assert not re.search(r"""(src|href)=["'](?!data:|\.\./)""", page)  # nothing from elsewhere, links but to the runs
    assert page.count('src="data:image/') == 3
    assert '<a href="../periphery-0/render/episode-0.mp4">' in page
    assert "<td>constant50_sub2_packed</td>" in page and "7.5 [4, 11]" in page
    assert "<td><code>learner.learning_rate</code></td><td>0.002</td><td>0.001</td>" in page
    assert re.search(r"<td class=\"number\">625</td><td class=\"number\">10 %</td>", page)


def test_kept_runs_of_two_games_have_two_heat_maps(tmp_path):
    kept = []
    for game in ("pong", "breakout"):
        (tmp_path / game).mkdir()
        kept.append(make_run(tmp_path / game, "constant70-s0", words=[f"game={game}"], scores=[1.0]))
    maps = dict.fromkeys(kept, CURRENT)
    report_page._add_maps(report_page.Page(tmp_path), list(map(curves.read_run, kept)), maps, tmp_path)
    names = [f"heatmap-{game}-constant70-s0.png" for game in ("breakout", "pong")]
    assert sorted(file.name for file in tmp_path.glob("heatmap*")) == names


@browser_needed
def test_the_page_is_whole_in_a_browser(runs, tmp_path):
    assert cli.run(report.report, [*map(str, runs), f"out={tmp_path / 'r'}", "episodes=0", "repeats=0"]) == 0
    with opened_page(tmp_path / "r" / "index.html") as page:
        assert page.evaluate("[...document.images].every(image => image.complete && image.naturalWidth > 100)")
        assert page.locator("h2").all_inner_texts()[:3] == ["At a glance", "Learning curves", "Final scores"]


def test_a_sweeps_directories_are_runs_and_twice_the_same_is_one(tmp_path, capsys):
    run = make_run(tmp_path, "seek-small-learner.num_epochs=3-s0", words=["game=seek"], scores=[1.0, 2.0])
    words = [str(run), f"{run}/", f"out={tmp_path / 'out'}", "episodes=0", "repeats=0"]
    assert cli.run(report.report, words) == 0, capsys.readouterr().err
    page = (tmp_path / "out" / "index.html").read_text()
    assert "learner.num_epochs=3" in page and "2 seeds" not in page


def test_an_evaluation_of_an_earlier_checkpoint_is_named(tmp_path):
    run = make_run(tmp_path, "run", words=["game=seek"], scores=[1.0, 2.0])
    for env_steps, said in ((2000, "evaluated"), (1000, "evaluated at 1,000 env_steps")):
        (run / "score.json").write_text(json.dumps({"mean": 1.5, "env_steps": env_steps}))
        assert report_page._origin(curves.read_run(run)) == said


def test_greedy_games_are_named(tmp_path):
    run = make_run(tmp_path, "run", words=["game=seek"], scores=[1.0, 2.0])
    for env_steps, said in ((2000, "evaluated, greedy"), (1000, "evaluated at 1,000 env_steps, greedy")):
        (run / "score.json").write_text(json.dumps({"mean": 1.5, "env_steps": env_steps, "policy": "greedy"}))
        assert report_page._origin(curves.read_run(run)) == said


UNKNOWN = {"env_steps": None, "policy": None, "whole_games": None}  # from before it was kept


@pytest.mark.parametrize(
    "change, checkpoint, kept",
    [
        ({}, None, True),  # a run kept without its checkpoints
        ({}, 3000, True),
        ({"env_steps": 2500}, 2500, True),  # what is logged is further than what is saved
        ({}, 4000, False),
        ({"env_steps": 2000}, None, False),
        ({"policy": "greedy"}, None, False),
        ({"whole_games": False}, None, False),
        (UNKNOWN, None, False),
    ],
)
def test_a_heat_map_of_something_else_is_made_again(tmp_path, monkeypatch, change, checkpoint, kept):
    run = make_run(tmp_path, "run", words=["game=seek"], scores=[1.0, 2.0, 3.0])
    store_map(run, dataclasses.replace(CURRENT, **change))
    if checkpoint is not None:
        (run / "checkpoints" / str(checkpoint)).mkdir(parents=True)
    monkeypatch.setattr(report_page, "_make_map", lambda run, episodes: dataclasses.replace(CURRENT, games=episodes))
    games = groups.games_of([curves.read_run(run)], None)
    assert report_page.find_maps(games, 9)[run].games == (4 if kept else 9)
    assert (run in report_page.find_maps(games, 0)) == kept


@pytest.mark.parametrize(
    "change, replaced",
    [({"env_steps": 2000}, True), (UNKNOWN, True), ({"policy": "greedy"}, False), ({"whole_games": False}, False)],
)
def test_a_heat_map_that_was_made_on_purpose_is_not_overwritten(tmp_path, monkeypatch, change, replaced):
    run = make_run(tmp_path, "run", words=["game=seek"], scores=[1.0, 2.0, 3.0])
    store_map(run, dataclasses.replace(CURRENT, **change))
    monkeypatch.setattr(report_page, "load_agent", lambda path, trust: None)
    monkeypatch.setattr(report_page, "watch", lambda *_, **__: iter(()))
    monkeypatch.setattr(heatmap, "heat_map", lambda recordings: CURRENT)
    before = heatmap.read(run / "render" / heatmap.FILE).to_json()
    assert report_page.find_maps(groups.games_of([curves.read_run(run)], None), 1)[run] is CURRENT
    assert heatmap.read(run / "render" / heatmap.FILE).to_json() == (CURRENT.to_json() if replaced else before)


def test_a_run_that_cannot_play_has_no_heat_map(tmp_path, capsys):
    run = make_run(tmp_path, "kept", words=["game=seek"], scores=[1.0])
    assert report_page.find_maps(groups.games_of([curves.read_run(run)], None), 1) == {}
    assert capsys.readouterr().err.startswith(f"no heat map: run={run}: agent.json is missing")


def test_no_game_is_played_for_a_page_that_cannot_be_written(tmp_path, monkeypatch, capsys):
    run = make_run(tmp_path, "run", words=["game=seek"], scores=[1.0])
    monkeypatch.setattr(report_page, "_make_map", lambda run, episodes: pytest.fail("played"))
    assert cli.run(report.report, [str(run), f"out={run / 'config.yaml'}"]) == 2
    assert "accepted is a directory that can be written" in capsys.readouterr().err


def test_seeds_may_differ_in_what_does_not_matter_only(tmp_path):
    alike = ["env.timeout=60", "train.env_steps=9000000"]
    one = make_run(tmp_path, "one", words=["game=seek"], scores=[1.0])
    two = make_run(tmp_path, "two", words=["game=seek", "seed=1", *alike], scores=[1.0])
    other = make_run(tmp_path, "other", words=["game=seek", "seed=2", "train.init_from=agents/a"], scores=[1.0])
    assert groups.games_of(map(curves.read_run, (one, two)), None)
    with pytest.raises(ConfigError, match="differs in train.init_from"):
        groups.games_of(map(curves.read_run, (one, other)), None)


def test_runs_that_differ_need_names_that_differ(tmp_path):
    one = make_run(tmp_path, "a", words=["game=seek"], scores=[1.0])
    two = make_run(tmp_path, "b", words=["game=seek", "seed=1", "learner.learning_rate=2e-3"], scores=[1.0])
    same = make_run(tmp_path, "c", words=["game=seek", "seed=2"], scores=[1.0])
    with pytest.raises(ConfigError, match=f"{two}: .* differs in learner.learning_rate from that of {one}"):
        groups.games_of(map(curves.read_run, (one, same, two)), None)


@pytest.mark.parametrize(
    "words, message",
    [
        ([], "no runs: accepted is foajax report runs/<a> "),
        (["run=runs/a"], "run=runs/a: accepted is runs/a, without run="),
        (["nowhere"], "run=nowhere: does not exist"),
        (["nowhere", "preset=all"], "preset=all: accepted is one of constant, decreasing, peripheral or null"),
        (["nowhere", "episodes=-1"], "episodes=-1: accepted is an integer >= 0"),
    ],
)
def test_a_mistake_is_one_line(words, message, capsys):
    assert cli.run(report.report, words) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"foajax: error: {message}") and error.count("\n") == 1


def test_a_run_without_scores_is_one_line(tmp_path, capsys):
    run = make_run(tmp_path, "new", words=["game=seek"], scores=[])
    assert cli.run(report.report, [str(run)]) == 2
    assert "no game has ended in it yet" in capsys.readouterr().err
