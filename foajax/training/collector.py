"""The host loop: environments and actors in turn, one rollout at a time.

The environments come in groups of equal size. While one group's emulators step, the next group's actors
decide, so that neither waits for the other; with fixed groups the result does not depend on the timing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array

from foajax.config.schema import LearnerConfig
from foajax.envs.base import Environment, facts, reads_gaze, send
from foajax.envs.measures import FactsTracker, pooled, summarise
from foajax.learning.agent import Agent
from foajax.learning.learner import Metrics
from foajax.learning.programs import Programs, acting_keys, empty_rollout
from foajax.types import ActorState, Outcome, Rollout, TimeStep, TrainState


def update_on(
    rollouts: Sequence[Rollout], state: TrainState, programs: Programs, learner: LearnerConfig
) -> tuple[TrainState, list[Metrics]]:
    """Updates on all minibatches of the groups' rollouts, `num_epochs` times, without waiting for the device."""
    metrics = []
    for epoch in range(learner.num_epochs):
        for rollout in rollouts:
            for index in range(learner.num_minibatches // len(rollouts)):
                state, row = programs.update(state, rollout, np.int32(index), np.bool_(epoch == 0))
                metrics.append(row)
    return state, metrics


# Rollouts that a run plays before its first update. The first tells each pixel's mean, the second how far frames lie
# from it: without them the input's scale drifts while the network is young.
ROLLOUTS_TO_OBSERVE = 2


class Group(NamedTuple):
    """What one group takes from one rollout to the next."""

    timestep: TimeStep  # to be acted on next
    actor_state: ActorState
    rollout: Rollout  # the buffer, written anew each time


class Collector:
    """Steps all groups through T steps and returns their rollouts.

    Where several processes share a run, `part` is this one's number: its environments are that part of each group.
    """

    def __init__(
        self, agent: Agent, programs: Programs, environments: Sequence[Environment], *, seed: int, part: int = 0
    ) -> None:
        self._programs = programs
        self._environments: list[Any] = list(environments)  # some have `get_state`
        self._length = agent.config.learner.rollout_length
        batch = environments[0].num_envs
        self._keys = [acting_keys(seed, group, part * batch, batch) for group in range(len(environments))]
        self._facts = [FactsTracker() for _ in environments]
        self.groups: list[Group] = []
        for environment in environments:
            timestep, _ = environment.reset()
            self.groups.append(
                Group(
                    timestep=timestep,
                    actor_state=agent.initial_state(batch),
                    rollout=empty_rollout(agent, batch, timestep, programs.shards),
                )
            )

    def collect(self, state: TrainState, first_step: int) -> tuple[list[Rollout], list[list[Outcome]]]:
        """Collects one rollout of each group, and its outcomes step by step.

        `first_step` counts the steps that each environment has made, from below 0 where a run first observes; it
        seeds the sampling.
        """
        acting = (state.params, state.statistics)
        outcomes: list[list[Outcome]] = [[] for _ in self.groups]
        for row in range(self._length):
            for i, environment in enumerate(self._environments):
                if row:
                    self._receive(i, outcomes[i])
                action, actor_state = self._act(i, acting, row, first_step + row)
                self.groups[i] = self.groups[i]._replace(actor_state=actor_state)
                points = self.groups[i].rollout.steps.focal_point
                send(environment, np.asarray(action), points[row] if reads_gaze(environment) else None)
        for i in range(len(self._environments)):
            self._receive(i, outcomes[i])
            # The last row is only bootstrapped from: the same step is acted on again, with newer parameters,
            # as row 0 of the next rollout.
            self._act(i, acting, self._length, first_step + self._length)
        return [group.rollout for group in self.groups], outcomes

    def decide(self, state: TrainState, first_step: int) -> None:
        """Makes a rollout's decisions without the environments and waits for them, to time acting. Spoils the rows."""
        acting = (state.params, state.statistics)
        for row in range(self._length):
            for i in range(len(self.groups)):
                action, actor_state = self._act(i, acting, row, first_step + row)
                self.groups[i] = self.groups[i]._replace(actor_state=actor_state)
                jax.block_until_ready(action)

    def measures(self) -> dict[str, float]:
        """Returns measures of this process's last episodes beside their scores, by name; empty for most games."""
        return summarise(pooled([tracker.table() for tracker in self._facts]))

    @property
    def resumable(self) -> bool:
        """Whether the environments can be saved; emulators cannot."""
        return all(hasattr(environment, "get_state") for environment in self._environments)

    def get_state(self) -> list[dict[str, Any]]:
        """Returns each group's state, to go on bit for bit; empty where the environments cannot be saved."""
        if not self.resumable:
            return []
        return [
            {"environment": environment.get_state(), "actor": group.actor_state}
            for environment, group in zip(self._environments, self.groups, strict=True)
        ]

    def set_state(self, state: Sequence[dict[str, Any]]) -> None:
        """Goes on from what `get_state` returned."""
        for i, saved in enumerate(state):
            timestep, _ = self._environments[i].set_state(saved["environment"])
            # On the host: how many devices share them may have changed.
            actor_state = jax.tree.map(np.asarray, saved["actor"])
            self.groups[i] = self.groups[i]._replace(timestep=timestep, actor_state=actor_state)

    def _act(self, i: int, acting: tuple, row: int, step: int) -> tuple[Array, ActorState]:
        group = self.groups[i]
        action, actor_state, rollout = self._programs.act(
            acting, group.actor_state, group.timestep, group.rollout, np.int32(row), self._keys[i], np.int32(step)
        )
        self.groups[i] = group._replace(rollout=rollout)
        return action, actor_state

    def _receive(self, i: int, outcomes: list[Outcome]) -> None:
        timestep, outcome = self._environments[i].recv()
        self.groups[i] = self.groups[i]._replace(timestep=timestep)
        outcomes.append(outcome)
        if outcome.is_over.any() and (about := facts(self._environments[i])) is not None:
            self._facts[i].add(about, outcome.is_over)
