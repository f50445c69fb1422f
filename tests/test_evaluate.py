"""foajax.evaluate: games that seeds do not share, other protocols, games that are cut."""

from __future__ import annotations

import json

import jax
import numpy as np
import pytest

from foajax import cli, evaluate
from foajax.config import shipped
from foajax.config.compose import compose
from foajax.learning.agent import Agent
from foajax.runs.agents import TrainedAgent, load_agent
from foajax.viewing import games
from foajax.viewing.games import Games, play

PONG = shipped.agents() / "pong-constant70_p_packed"


@pytest.fixture(scope="module")
def breakout(untrained) -> TrainedAgent:
    """An agent that has not learned anything."""
    agent = Agent(compose(["experiment=constant50_sub2_packed", "network.dense=16", "network.lstm=16"]), 4, 34)
    return untrained(agent)


def test_neighbouring_seeds_share_no_game(breakout):
    """EnvPool adds an environment's number to the seed; seed 0's second game was seed 1's first."""
    seeds = []
    original = games.make

    def make(config, **how):
        seeds.append(how["seed"])
        return original(config, **how)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(games, "make", make)
        for seed in (0, 1, 2):
            games.environment(breakout, num_envs=1, seed=seed).close()
    assert np.diff(np.sort(seeds)).min() > 10_000 and max(seeds) < 2**31


def test_another_protocol_is_played_and_noted(capsys, tmp_path):
    words = [f"run={PONG}", "episodes=2", "num_envs=2", f"json={tmp_path / 'score.json'}"]
    protocol = ["env.sticky_actions=0.25", "env.max_episode_steps=100"]
    assert cli.run(evaluate.evaluate, [*words, *protocol]) == 0
    found = json.loads((tmp_path / "score.json").read_text())
    assert found["lengths"] == [100, 100] and found["cut"] == 2 and found["protocol"] == protocol
    assert "2 of the games were cut at env.max_episode_steps" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("word", "said"),
    [
        (
            "env.frame_shape=[84,84]",
            "env.frame_shape=[84, 84]: cannot be changed; accepted is one of env.engine, env.frame_skip,",
        ),
        (
            "env.stickiness=0.25",
            "env.stickiness=0.25: unknown key (did you mean env.sticky_actions?); accepted is one of env.e",
        ),
        ("env.sticky_actions=2", "env.sticky_actions=2.0: accepted is a number in [0, 1)"),
    ],
)
def test_what_a_protocol_cannot_change_is_refused(capsys, word, said):
    assert cli.run(evaluate.evaluate, [f"run={PONG}", word]) == 2
    assert capsys.readouterr().err.startswith(f"foajax: error: {said}")


@pytest.mark.parametrize(
    ("run", "word"),
    [(PONG, "search.noise=5"), ("agents/search-rings_p", "env.max_episode_steps=3")],
)
def test_a_rule_that_changes_nothing_is_refused(capsys, run, word):
    assert cli.run(evaluate.evaluate, [f"run={run}", word]) == 2
    assert f"foajax: error: {word}: changes nothing in game=" in capsys.readouterr().err


def test_who_never_serves_is_cut(breakout):
    """With whole games the agent has to serve after a lost life, which a policy that only waits never does."""
    words = ["experiment=constant50_sub2_packed", "network.dense=16", "network.lstm=16"]
    agent = Agent(compose([*words, "env.episodic_life=false", "env.max_episode_steps=700"]), 4, 34)
    params = jax.tree.map(np.copy, breakout.params)
    params["params"]["natural_policy"]["bias"] = np.array([9, 0, 0, 0], np.float32)  # waits
    waiting = TrainedAgent(agent, params, breakout.statistics, env_steps=0)
    played = play(waiting, episodes=2, num_envs=2, seed=0, greedy=True)
    assert isinstance(played, Games) and played.cut == 2 and played.lengths.tolist() == [700, 700]


def test_a_shipped_agent_wins_with_another_seed():
    played = play(load_agent(PONG), episodes=2, num_envs=2, seed=7, greedy=False)
    assert played.returns.mean() > 10 and played.cut == 0
