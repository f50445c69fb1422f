"""The price of a saccade: what reward it is taken from, and which head is credited for it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from foajax.config.compose import compose
from foajax.config.parse import replace
from foajax.learning import returns
from foajax.learning.agent import Agent
from foajax.types import TimeStep

WORDS = ["experiment=seek", "gaze.moves=absolute", "gaze.grid=[3,3]", "network.lstm=8", "network.dense=8"]


def play(agent, params, rewards, firsts):
    """Decisions on black frames; focal points, rewards as recorded, and the owed sums after each."""
    state, steps = agent.initial_state(1), []
    act = jax.jit(agent.act)
    for t, (reward, first) in enumerate(zip(rewards, firsts, strict=True)):
        frame = np.zeros((1, 80, 80), np.uint8)
        timestep = TimeStep(frame, np.array([reward], np.float32), np.array([first]), np.array([False]))
        output, _, state = act(params, agent.initial_statistics(), state, timestep, jax.random.key(t))
        steps.append((np.asarray(output.focal_point[0]), float(output.reward[0])))
    return [np.stack(column) for column in zip(*steps, strict=True)]


@pytest.mark.parametrize("cost_per", ["pixel", "saccade"])
def test_a_saccade_is_paid_with_the_reward_of_the_decision_that_it_serves(cost_per, untrained):
    agent = Agent(compose([*WORDS, "gaze.cost=0.01", f"gaze.cost_per={cost_per}"]), num_actions=2, crop_top=None)
    rewards, firsts = np.linspace(-1, 1, 12), np.arange(12) % 7 == 0  # an episode of 7 steps, then another
    points, recorded = play(agent, untrained(agent).params, rewards, firsts)
    assert len(np.unique(points, axis=0)) > 3
    wanted = rewards.copy()
    for t in range(12):
        first = max(i for i in range(t + 1) if firsts[i])
        if t - first >= 2:  # the point at t-1 was reached by a saccade of this episode
            distance = np.linalg.norm(points[t - 1] - points[t - 2])
            wanted[t] -= 0.01 * (distance if cost_per == "pixel" else float(distance > 0))
    np.testing.assert_allclose(recorded, wanted, atol=1e-6)


def test_the_vision_head_is_credited_with_the_price_right_after_its_move():
    """Prices alone: what the agent records makes r'_j of the vision head the price of the move chosen at j."""
    prices = np.array([0.0, 0.3, 0.1, 0.2, 0.0, 0.5])  # of the move chosen at 0, 1, ...
    r_t = np.append(0.0, -prices[:-1])  # the reward R_{t+1} of transition t pays the move chosen at t-1
    none = jnp.zeros(6)
    stream = returns.vision_stream(jnp.asarray(r_t), none.astype(bool), jnp.ones(6))
    np.testing.assert_allclose(stream.r_t[:-1], -prices[:-1], atol=1e-7)


def test_a_gaze_that_stays_or_is_free_pays_nothing(untrained):
    for words in (["gaze=frozen", "gaze.cost=0.5"], ["gaze.cost=0"]):
        agent = Agent(compose([*WORDS, *words]), num_actions=2, crop_top=None)
        rewards = np.linspace(-1, 1, 5).astype(np.float32)
        _, recorded = play(agent, untrained(agent).params, rewards, np.arange(5) == 0)
        np.testing.assert_array_equal(recorded, rewards)
    free = replace(agent.config.gaze, cost=0.0)
    assert free == agent.config.gaze and agent.initial_state(2).owed is None
