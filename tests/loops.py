"""A training run without its outside, for tests of what is inside."""

from __future__ import annotations

import functools

import jax
import numpy as np

from foajax.config import compose
from foajax.config.parse import replace
from foajax.envs.make import make_environments
from foajax.learning import learner
from foajax.learning.agent import Agent
from foajax.learning.programs import make_programs, make_state
from foajax.training.collector import Collector, update_on

# Small networks and short rollouts: most of the time goes into compiling them.
SMALL = [
    "network.dense=32",
    "network.lstm=32",
    "env.num_envs=8",
    "learner.num_minibatches=2",
    "learner.rollout_length=6",
]
# A small full view: cheap, and it tells all that a probe shows.
VIEW = ["sensor=rings", "sensor.rings=[[80,80,8]]", "sensor.layout=packed", "experiment=nonfoa"]


@functools.cache
def built(config, num_actions, crop_top):
    """The agent and its compiled functions: both programs, the loss, the network unrolled."""
    agent = Agent(config, num_actions, crop_top)
    loss = jax.jit(lambda params, rollout: learner.loss(params, agent, rollout))
    return agent, make_programs(agent), loss, jax.jit(agent.unroll)


class Loop:
    """A run without its outside: environments, both programs, the state. Another seed has the same programs."""

    def __init__(self, *overrides):
        self.config = compose.compose([*SMALL, *overrides])
        environments = make_environments(self.config, 0)
        without_seed = replace(self.config, seed=0)
        parts = built(without_seed, environments[0].num_actions, environments[0].crop_top)
        self.agent, self.programs, self.loss, self.unroll = parts
        self.state = make_state(self.agent, self.config.seed)
        self.collector = Collector(self.agent, self.programs, environments, seed=self.config.seed)
        self.step = 0
        self.metrics = []

    def collect(self):
        rollouts, outcomes = self.collector.collect(self.state, self.step)
        self.step += self.config.learner.rollout_length
        return rollouts, outcomes

    def run(self, count):
        """`count` rollouts with their updates; the mean score a step of the last tenth."""
        scores = []
        for _ in range(count):
            rollouts, outcomes = self.collect()
            self.state, metrics = update_on(rollouts, self.state, self.programs, self.config.learner)
            self.metrics += metrics
            scores.append(np.mean([outcome.score for group in outcomes for outcome in group]))
        return np.mean(scores[-max(1, count // 10) :])
