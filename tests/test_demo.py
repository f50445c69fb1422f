"""The demo: which shipped agent it takes, and a game from its files alone."""

from __future__ import annotations

import json
import re

import jax
import numpy as np
import pytest

from foajax import cli, demo, evaluate, store
from foajax.config.parse import ConfigError
from foajax.runs import agents
from foajax.viewing import games

EVALUATED = {"mean": 9.0, "stderr": 0.5, "episodes": 30, "policy": "sampled"}


@pytest.fixture
def shipped(breakout_agent, tmp_path, monkeypatch):
    """Two agents for Breakout, and one that is said to play Pong and has no score."""
    directory = tmp_path / "agents"
    agents.save_agent(breakout_agent, directory / "poor", EVALUATED | {"mean": 2.0})
    agents.save_agent(breakout_agent, directory / "good", EVALUATED)
    agents.save_agent(breakout_agent, directory / "untold")
    config = directory / "untold" / "config.yaml"
    config.write_text(config.read_text().replace("game: breakout", "game: pong"))
    monkeypatch.setattr(demo, "agents", lambda: directory)
    return directory


def test_the_best_agent_of_a_game_is_taken(shipped):
    assert demo.choose(shipped, None).name == demo.choose(shipped, "breakout").name == "good"
    assert demo.choose(shipped, "pong").name == "untold"


@pytest.mark.parametrize("name", ["Breakout", "ALE/Breakout-v5"])
def test_a_game_may_have_its_name_in_gymnasium(shipped, name, tmp_path, capsys):
    assert cli.run(demo.demo, ["steps=2", f"game={name}", f"out={tmp_path / 'out'}"]) == 0
    assert capsys.readouterr().out.startswith("good plays breakout.")


def test_one_that_moves_its_gaze_comes_first(shipped, breakout_agent):
    config = shipped / "good" / "config.yaml"
    config.write_text(config.read_text().replace("mode: learned", "mode: frozen"))
    assert demo.choose(shipped, "breakout").name == "poor"


def test_it_plays_and_says_what_to_look_at(shipped, tmp_path, capsys, monkeypatch):
    opened = []
    monkeypatch.setattr(demo.webbrowser, "open", opened.append)
    assert cli.run(demo.demo, ["steps=40", f"out={tmp_path / 'out'}", "open=true"]) == 0
    page = tmp_path / "out" / "index.html"
    said = capsys.readouterr().out
    assert said.startswith("good plays breakout. It sees 1,466 values of a frame of 6,400 pixels, and chooses where to")
    assert "The demo stopped after 40 decisions. Score: " in said and "Its mean over 30 games: 9.0." in said
    assert f"Watch it: {page.as_uri()}\nWhat to look at:\n" in said and page.stat().st_size > 50_000
    assert opened == [page.as_uri()]


def test_a_search_is_told_by_the_decisions_that_had_an_effect(tmp_path, capsys):
    assert cli.run(demo.demo, ["game=search", f"out={tmp_path / 'out'}"]) == 0
    said, bars = capsys.readouterr()
    decisions, score = re.search(r"was over after (\d+) decisions. Score: (\S+)\.\n", said).groups()
    assert float(score) == pytest.approx(1 - 0.01 * int(decisions))  # a right answer earns 1, each decision costs 0.01
    assert "game 0" in bars and "game 0" not in said


def test_an_agent_is_played_by_its_name(shipped, tmp_path, capsys):
    assert cli.run(demo.demo, ["steps=2", f"agent={shipped / 'poor'}", f"out={tmp_path / 'out'}"]) == 0
    assert capsys.readouterr().out.startswith("poor plays breakout.")
    assert cli.run(demo.demo, ["game=pong", f"agent={shipped / 'poor'}", f"out={tmp_path / 'out'}"]) == 2
    assert "poor plays another; accepted is null or breakout" in capsys.readouterr().err
    assert cli.run(demo.demo, ["agent=rich"]) == 2
    said = "agent=rich: does not exist; accepted is the directory of a run or an agent, or one of "
    assert capsys.readouterr().err.startswith(f"foajax: error: {said}")


@pytest.mark.parametrize(("answer", "wanted"), [("y", True), ("Yes", True), ("", False), ("n", False)])
def test_on_a_terminal_it_asks(answer, wanted, monkeypatch):
    monkeypatch.setattr(demo.sys, "stdin", Terminal())
    monkeypatch.setattr(demo.sys, "stdout", Terminal())
    monkeypatch.setattr("builtins.input", lambda question: answer)
    assert demo._wants(None) is wanted


class Terminal:
    def isatty(self):
        return True


@pytest.mark.parametrize(
    "words, message",
    [
        (["game=chess"], "game=chess: no agent is shipped for it; accepted is one of breakout, pong"),
        (["steps=0"], "steps=0: accepted is an integer >= 1"),
    ],
)
def test_a_mistake_is_one_line(shipped, words, message, capsys):
    assert cli.run(demo.demo, words) == 2
    assert capsys.readouterr().err == f"foajax: error: {message}\n"


def test_nothing_shipped_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(demo, "agents", lambda: tmp_path)
    assert cli.run(demo.demo, []) == 2
    assert capsys.readouterr().err.startswith("foajax: error: demo: no agent is shipped yet")


def test_an_agent_is_stored_with_its_evaluation(shipped, tmp_path, capsys):
    stored = agents.load_agent(shipped / "untold")
    config = stored.agent.config
    facts = {"game": config.game, "experiment": config.name, "env_steps": stored.env_steps, "returns": [9.0], "seed": 0}
    (tmp_path / "score.json").write_text(json.dumps(EVALUATED | facts))
    words = [f"run={shipped / 'untold'}", f"out={tmp_path / 'again'}"]
    assert cli.run(store.store, [*words, f"score={tmp_path / 'score.json'}"]) == 0
    assert agents.load_score(tmp_path / "again") == EVALUATED and agents.load_score(shipped / "untold") is None
    assert cli.run(store.store, [f"run={tmp_path / 'again'}", f"out={tmp_path / 'third'}"]) == 0
    assert agents.load_score(tmp_path / "third") == EVALUATED
    modes = {file.name: file.stat().st_mode for file in (tmp_path / "third").iterdir()}
    assert modes["agent.safetensors"] == modes["config.yaml"]  # who can read the one can read the other
    (tmp_path / "score.json").write_text(json.dumps(EVALUATED | facts | {"game": "chess"}))
    assert cli.run(store.store, [*words, f"score={tmp_path / 'score.json'}"]) == 2
    assert "is of {'game': 'chess'" in capsys.readouterr().err
    (tmp_path / "score.json").write_text("{}")
    assert cli.run(store.store, [*words, f"score={tmp_path / 'score.json'}"]) == 2
    assert "accepted is a file that foajax evaluate json=<file> has written" in capsys.readouterr().err


def test_a_run_is_not_overwritten_by_an_agent(breakout_agent, tmp_path):
    agents.save_agent(breakout_agent, tmp_path / "run")
    (tmp_path / "run" / "run.json").write_text('{"starts": []}')
    before = (tmp_path / "run" / "config.yaml").stat().st_mtime_ns
    with pytest.raises(ConfigError, match=r"out=.*/run: is a run; accepted is another directory"):
        agents.save_agent(breakout_agent, tmp_path / "run")
    assert (tmp_path / "run" / "config.yaml").stat().st_mtime_ns == before
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"out=.*/file: accepted is a directory that can be written"):
        agents.save_agent(breakout_agent, tmp_path / "file")


SHIPPED = sorted(file.parent for file in demo.agents().glob("*/config.yaml"))


@pytest.mark.parametrize("path", SHIPPED, ids=[path.name for path in SHIPPED])
def test_a_shipped_agent_can_be_read_and_has_its_score(path):
    stored = agents.load_agent(path)
    assert stored.agent.config.game in path.name and stored.env_steps > 1e6
    assert agents.load_score(path)["episodes"] >= 30
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((stored.params, stored.statistics)))


@pytest.mark.slow
def test_a_shipped_agent_plays_as_well_as_it_says():
    stored = agents.load_agent(demo.agents() / "pong-constant70_p_packed")
    played = games.play(stored, episodes=2, num_envs=2, seed=0, greedy=False)
    assert played.returns.mean() > 10


def test_parameters_are_on_the_device(shipped):
    stored = agents.load_agent(shipped / "good")
    assert all(isinstance(x, jax.Array) for x in jax.tree.leaves((stored.params, stored.statistics)))


def test_agents_are_beside_a_checkout():
    assert demo.agents().name == "agents" and len(SHIPPED) >= 4


@pytest.mark.parametrize(
    ("word", "said"),
    [
        (
            "json=nowhere/score.json",
            "json=nowhere/score.json: accepted is a file that can be written, in a directory that",
        ),
        ("seed=2147483648", "seed=2147483648: accepted is an integer from 0 to"),
        ("seed=-1", "seed=-1: accepted is an integer from 0 to"),
        ("checkpoint=last", "checkpoint=last: accepted is one of newest, best"),
        ("run=2026-13-01", "run=2026-13-01: does not exist"),  # text, though it looks like a date
    ],
)
def test_an_evaluation_that_cannot_be_is_refused_before_it_plays(shipped, capsys, word, said):
    assert cli.run(evaluate.evaluate, [f"run={shipped / 'good'}", word]) == 2
    assert capsys.readouterr().err.startswith(f"foajax: error: {said}")


def test_help_names_every_key(capsys):
    assert cli.run(demo.demo, ["--help"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("Lets a shipped agent play one game")
    assert "\n  steps=6000  Decisions at most; " in out and "Accepted: an integer >= 1.\n" in out
