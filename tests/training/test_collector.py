"""The collector: which frame, action, focal point and reward belong together, in a rollout and from one to the next."""

from __future__ import annotations

from types import SimpleNamespace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from foajax.config.compose import compose
from foajax.learning.agent import Agent
from foajax.learning.programs import Programs, make_programs
from foajax.sensors import gaze
from foajax.training.collector import Collector, update_on
from foajax.types import Outcome, Rollout, TimeStep, TrainState

T, SIZE = 5, 20  # decisions per rollout; a frame's sides
WORDS = [
    *("sensor=rings", "sensor.rings=[[8,8,1]]", "sensor.layout=packed", f"env.frame_shape=[{SIZE},{SIZE}]"),
    *("gaze.start=random", "gaze.step=3", "network.normalization=none", "network.torso=small", "network.dense=0"),
    *("network.lstm=4", "env.num_envs=2", "learner.num_minibatches=1", f"learner.rollout_length={T}"),
]


class Clock:
    """Two environments of noise, with episodes of 4 and 5 steps, whose rewards number the steps.

    It writes down what it shows and what it is told: actions and, as if its rules depended on the gaze, focal points.
    """

    num_envs, num_actions, crop_top, lives, reads_gaze = 2, 3, None, None, True

    def __init__(self):
        self.shown, self.actions, self.points = [], [], []

    def reset(self):
        return self.recv()

    def send(self, action, focal_point):
        self.actions.append(action)
        self.points.append(focal_point)

    def recv(self):
        time, length = len(self.shown), np.array([4, 5])
        frame = np.random.default_rng(time).integers(0, 256, (2, SIZE, SIZE), np.uint8)
        is_first, is_last = time % length == 0, time % length == length - 1
        reward = np.where(is_first, 0, [time, -time]).astype(np.float32)
        self.shown.append(TimeStep(frame, reward, is_first=is_first, is_terminal=is_last))
        return self.shown[-1], Outcome(score=2 * reward, is_over=is_last)

    def render(self):
        raise NotImplementedError

    def close(self):
        pass


@pytest.fixture(scope="module")
def played(untrained):
    """Two rollouts with the same parameters: what was recorded, [T+1, 2, ...] each, the environment, the outcomes."""
    agent, clock = Agent(compose(WORDS), Clock.num_actions, None), Clock()
    stored = untrained(agent)
    state = TrainState(stored.params, None, stored.statistics, np.int32(0), np.int32(0))
    collector = Collector(agent, make_programs(agent), [clock], seed=0)
    rollouts, outcomes = [], []
    for k in range(2):
        (rollout,), (steps,) = collector.collect(state, k * T)
        rollouts.append(jax.tree.map(np.array, rollout.steps))  # the next rollout is written over it
        outcomes += steps
    first, second = rollouts
    joined = jax.tree.map(lambda a, b: np.concatenate([a[:T], b]), first, second)
    return SimpleNamespace(first=first, second=second, joined=joined, clock=clock, outcomes=outcomes, agent=agent)


def test_rows_are_the_environments_steps_and_each_step_has_its_outcome(played):
    for name in ("reward", "is_first", "is_terminal"):
        shown = [getattr(timestep, name) for timestep in played.clock.shown]
        np.testing.assert_array_equal(getattr(played.joined, name), shown)
    np.testing.assert_array_equal([o.score for o in played.outcomes], 2 * played.joined.reward[1:])


def test_the_last_row_of_a_rollout_is_the_first_of_the_next(played):
    """It is decided upon twice, from the same memory, at the same focal point, with the same random numbers."""
    last, first = jax.tree.map(lambda x: x[T], played.first), jax.tree.map(lambda x: x[0], played.second)
    chex.assert_trees_all_equal(last, first)


def test_an_action_is_sent_once_with_the_focal_point_of_the_frame_that_it_answers(played):
    np.testing.assert_array_equal(played.clock.actions, played.joined.natural_action[:-1])
    np.testing.assert_array_equal(played.clock.points, played.joined.focal_point[:-1])
    assert len(np.unique(played.joined.natural_action)) == 3


def test_a_frame_is_seen_at_the_focal_point_of_its_row(played):
    for timestep, points, roi in zip(played.clock.shown, played.joined.focal_point, played.joined.roi[0], strict=True):
        for frame, (y, x), seen in zip(timestep.frame, points, roi, strict=True):
            np.testing.assert_allclose(seen[..., 0], frame[y - 4 : y + 4, x - 4 : x + 4] / 255, atol=1e-6)


def test_the_gaze_starts_with_each_episode_and_moves_by_the_action_before(played):
    steps, how = played.joined, {"gaze": played.agent.config.gaze, "window": (8, 8), "frame_shape": (SIZE, SIZE)}
    moved = gaze.move(steps.focal_point[:-1], steps.vision_action[:-1], **how)
    goes_on = ~steps.is_first[1:]
    np.testing.assert_array_equal(steps.focal_point[1:][goes_on], moved[goes_on])
    assert (moved != steps.focal_point[:-1]).any() and (moved != steps.focal_point[1:])[~goes_on].any(-1).all()
    starts = steps.focal_point[steps.is_first]
    assert len(starts) == 6 and len(np.unique(starts, axis=0)) > 2  # drawn for each episode
    assert (starts[0] != starts[1]).any()  # and each environment


def test_the_network_is_told_both_actions_of_the_row_before(played):
    steps = played.joined
    chosen = np.stack([steps.natural_action, steps.vision_action], axis=-1)
    np.testing.assert_array_equal(steps.last_actions[1:], chosen[:-1])


@pytest.mark.parametrize("groups", [1, 2])
def test_each_pass_uses_every_minibatch_of_every_group_once(groups):
    used = []

    def update(state, rollout, index, is_first_pass):
        used.append((rollout.core_state, int(index), bool(is_first_pass)))
        return state._replace(updates=state.updates + 1), {"loss": jnp.float32(len(used))}

    rollouts = [Rollout(steps=None, core_state=name) for name in "ab"[:groups]]
    programs = Programs(act=None, update=update, observe=None)
    learner = compose(["learner.num_minibatches=4", "learner.num_epochs=2", "env.num_envs=8"]).learner
    state, metrics = update_on(rollouts, TrainState(None, None, None, 0, 0), programs, learner)
    each = [(rollout.core_state, index) for rollout in rollouts for index in range(4 // groups)]
    assert used == [(*part, is_first_pass) for is_first_pass in (True, False) for part in each]
    assert state.updates == 8 and [row["loss"] for row in metrics] == list(range(1, 9))
