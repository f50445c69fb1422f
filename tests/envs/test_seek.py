"""foajax.envs.seek: what can be earned, by whom, and what low resolution gives away."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from foajax.envs import seek, tasks

TASK = seek.task((80, 80))
STEPS = seek.LEGS * seek.LEG
EPISODES = 200


@pytest.fixture(scope="module")
def episodes() -> seek.SeekState:
    """Start states of many episodes, as NumPy arrays with a leading [EPISODES]."""
    keys = jax.random.split(jax.random.key(0), EPISODES)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(TASK.start))(keys))


def play(policy) -> np.ndarray:
    """Returns of one episode in each of 64 environments; `policy(state, t)` gives the actions [64]."""
    environment = tasks.JaxEnvironment(TASK, num_envs=64, seed=3)
    environment.reset()
    returns = np.zeros(64)
    for t in range(STEPS):
        environment.send(policy(jax.tree.map(np.asarray, environment.get_state().task), t))
        timestep, outcome = environment.recv()
        returns += outcome.score
        assert np.all(timestep.is_terminal == (t == STEPS - 1))
    return returns


def kinds(state: seek.SeekState, t: int) -> np.ndarray:
    return state.kind[:, t // seek.LEG]


def test_an_oracle_earns_a_point_a_leg():
    np.testing.assert_array_equal(play(kinds), np.full(64, 12.0))
    np.testing.assert_array_equal(play(lambda state, t: 1 - kinds(state, t)), np.full(64, -12.0))


def test_who_sees_nothing_earns_nothing():
    random = np.random.default_rng(0)
    for returns in (play(lambda *_: random.integers(0, 2, 64)), play(lambda *_: np.ones(64, np.int32))):
        # A constant policy's return is a sum of 12 coins of +-1: its mean over 64 has a deviation of 0.43.
        assert abs(returns.mean()) < 1.5


def test_the_last_reward_tells_what_the_object_was():
    """Of each leg's steps only the first is a guess to who is told it; here the episode's very first is right."""
    returns = play(lambda state, t: kinds(state, max(t - 1, 0)))
    assert abs(returns.mean() - 10.5) < 0.3


def test_the_object_is_drawn_where_and_as_the_state_says(episodes):
    draw = jax.jit(TASK.draw)
    for episode, t in ((0, 0), (1, 37), (2, STEPS)):
        state = seek.SeekState(path=episodes.path[episode], kind=episodes.kind[episode], time=np.int32(t))
        y, x = state.path[t]
        take = state.kind[min(t // seek.LEG, seek.LEGS - 1)] == seek.TAKE
        expected = np.zeros((80, 80), np.uint8)
        for i in range(8):
            for j in range(8):
                expected[y + i, x + j] = 255 * (((i if take else j) % 2) == 0)
        np.testing.assert_array_equal(draw(state), expected)


def test_the_path_bounces_inside_the_frame_on_even_pixels(episodes):
    path = episodes.path
    assert path.min() == 0 and path.max() == 72  # both borders are reached in 200 episodes
    assert np.all(path % 2 == 0)
    np.testing.assert_array_equal(path[:, 0], np.full((EPISODES, 2), 36))
    assert set(np.abs(np.diff(path, axis=1)).ravel()) == {0, 2}  # bouncing keeps the speed
    # A leg without a border is a straight line, one of eight.
    legs = np.diff(path, axis=1).reshape(EPISODES, seek.LEGS, seek.LEG, 2)
    inside = np.all((path[:, :-1] > 2) & (path[:, :-1] < 70), axis=2).reshape(EPISODES, seek.LEGS, seek.LEG).all(2)
    assert np.all(legs[inside] == legs[inside][:, :1])
    assert {tuple(step) for step in legs[inside][:, 0] // 2} == set(seek.HEADINGS)


def test_kinds_are_fair_and_independent_coins(episodes):
    kind = episodes.kind
    assert abs(kind.mean() - 0.5) < 0.05  # 2400 coins: a deviation of 0.01
    assert abs((kind[:, 1:] == kind[:, :-1]).mean() - 0.5) < 0.05


@pytest.mark.parametrize("block", [2, 4, 8, 16])
def test_means_of_blocks_tell_where_and_never_what(episodes, block):
    draw = jax.jit(functools.partial(seek.draw_object, (80, 80)))
    for corner in episodes.path[:20, 50]:
        leave, take = (np.asarray(draw(jnp.asarray(corner), jnp.int32(kind)), float) for kind in (0, 1))
        low = [frame.reshape(80 // block, block, 80 // block, block).mean((1, 3)) for frame in (leave, take)]
        np.testing.assert_array_equal(*low)
        y, x = np.nonzero(low[0])
        assert abs(block * (y.mean() + 0.5) - corner[0] - 4) <= block  # where
        assert np.any(leave != take)  # what, at full resolution


def visible(centre: np.ndarray, corner: np.ndarray, fovea: int = 16) -> np.ndarray:
    """Whether 2x2 pixels of the object, which tell its kind, are inside a fovea; [...] of [..., 2]."""
    overlap = np.minimum(centre + fovea // 2, corner + seek.SIZE) - np.maximum(centre - fovea // 2, corner)
    return np.all(overlap >= 2, axis=-1)


@pytest.mark.parametrize("step", [4, 8])
def test_a_greedy_fovea_never_loses_the_object(episodes, step):
    centre = np.full((EPISODES, 2), 40)
    for t in range(STEPS):
        assert np.all(visible(centre, episodes.path[:, t]))
        away = episodes.path[:, t] + seek.SIZE // 2 - centre
        axis = np.abs(away).argmax(1)
        rows = np.arange(EPISODES)
        move = step * np.sign(away[rows, axis]) * (np.abs(away[rows, axis]) >= step // 2)
        centre[rows, axis] = np.clip(centre[rows, axis] + move, 8, 72)


def earned(seen: np.ndarray) -> float:
    """Mean return of who acts right from the first sight of a leg's stripes on; `seen` is [EPISODES, STEPS]."""
    legs = seen.reshape(EPISODES, seek.LEGS, seek.LEG)
    return seek.LEGS * np.logical_or.accumulate(legs, axis=2).mean()


def test_a_gaze_that_does_not_follow_misses_most(episodes):
    seen = visible(np.array([40, 40]), episodes.path[:, :STEPS])
    assert abs(seen.mean() - 0.16) < 0.03 and abs(earned(seen) - 2.5) < 0.4
    random = np.random.default_rng(1)
    centre, seen = np.full((EPISODES, 2), 40), []
    moves = 8 * np.array([[0, 0], [-1, 0], [1, 0], [0, -1], [0, 1]])
    for t in range(STEPS):
        seen.append(visible(centre, episodes.path[:, t]))
        centre = np.clip(centre + moves[random.integers(0, 5, EPISODES)], 8, 72)
    assert abs(earned(np.stack(seen, axis=1)) - 3.0) < 0.5


def test_other_frame_shapes_have_the_same_rules():
    task = seek.task((32, 49))
    state = jax.jit(task.start)(jax.random.key(1))
    path = np.asarray(state.path)
    assert path.min() >= 0 and path[:, 0].max() <= 24 and path[:, 1].max() <= 41
    assert np.all(path % 2 == 0)
    assert jax.eval_shape(task.draw, state).shape == (32, 49)
