"""Recordings: the screens, gazes and decisions of a real game, row by row."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from foajax.config.compose import compose
from foajax.config.parse import ConfigError
from foajax.envs.base import Environment
from foajax.envs.make import action_names, steps_per_second
from foajax.learning.agent import Agent
from foajax.sensors.frames import to_frame
from foajax.sensors.gaze import DIRECTIONS
from foajax.types import Outcome, TimeStep
from foajax.viewing import games
from foajax.viewing.games import play
from foajax.viewing.heatmap import bounds
from foajax.viewing.recording import Screens, record


def test_every_row_is_there(recording):
    steps = len(recording.screens)
    assert steps == 130 and not recording.is_over
    for name in ("focal_point", "natural_probs", "natural_value", "vision_probs", "vision_value", "score", "lives"):
        assert len(getattr(recording, name)) == steps
    assert recording.screens[0].shape == (210, 160, 3) and recording.screens[3:5][1].shape == (210, 160, 3)
    assert recording.actions == ("noop", "fire", "right", "left")
    assert [image.shape[1:] for image in recording.images] == [(30, 30), (25, 25), (18, 18), (5, 5)]
    np.testing.assert_allclose(recording.natural_probs.sum(1), 1, atol=1e-6)
    np.testing.assert_allclose(recording.vision_probs.sum(1), 1, atol=1e-6)


def test_the_focal_point_goes_where_the_visual_actions_send_it(recording):
    low, high = bounds(recording.config)
    for t in range(len(recording.screens) - 1):
        if recording.is_first[t + 1]:
            expected = np.array([40, 40])
        else:
            expected = recording.focal_point[t] + 4 * DIRECTIONS[recording.vision_action[t]]
        np.testing.assert_array_equal(recording.focal_point[t + 1], np.clip(expected, low, high))
    assert len(np.unique(recording.focal_point, axis=0)) > 10


def test_lives_and_score_are_the_games(recording):
    assert recording.lives[0] == 5 and recording.lives[-1] < 5
    assert (np.diff(recording.lives) <= 0).all() and (np.diff(recording.score) >= 0).all()
    np.testing.assert_array_equal(recording.life_lost[1:], np.diff(recording.lives) < 0)
    assert not recording.life_lost[0] and not recording._replace(lives=None).life_lost.any()
    # The step after a lost life is the first one of the learner's next episode.
    np.testing.assert_array_equal(np.flatnonzero(np.diff(recording.lives)) + 2, np.flatnonzero(recording.is_first)[1:])


def test_the_sensor_looks_at_the_screen_that_is_shown(recording):
    """The emulator's colours are not the gray levels, but background is black in both."""
    top, down, across = recording.frame_origin
    assert (top, down, across) == (34.0, 2.0, 2.0)
    lit, bright = [], []
    for screen, point, fovea in zip(recording.screens, recording.focal_point, recording.images[0], strict=True):
        frame = np.pad(screen[34:194].max(axis=-1).reshape(80, 2, 80, 2).max(axis=(1, 3)), 15)
        lit.append(frame[point[0] : point[0] + 30, point[1] : point[1] + 30] > 0)  # 0 beyond the frame
        bright.append(fovea > 0)
    lit, bright = np.stack(lit), np.stack(bright)
    assert 0.02 < lit.mean() < 0.98
    # `recv` shows the brighter of two screens: more may be lit in it, never less.
    assert bright[lit].mean() > 0.99 and bright[~lit].mean() < 0.05


def test_the_sensor_looks_at_the_screen_that_is_shown_where_all_of_it_shrinks(untrained):
    words = ["sensor=constant50_sub2", "sensor.rings=[[40,40,1]]", "network.dense=8", "network.lstm=8"]
    agent = Agent(compose([*words, "env.crop=false", "env.frame_shape=[105,80]"]), 4, None)
    game = next(record(untrained(agent), max_steps=40))
    assert game.frame_origin == (0.0, 2.0, 2.0) and game.mean_frame.shape == (105, 80)
    assert game.screens[0].shape == (210, 160, 3)
    for screen, (y, x), area in zip(game.screens, game.focal_point, game.images[0], strict=True):
        blocks = screen.max(axis=-1).reshape(105, 2, 80, 2).max(axis=(1, 3))
        lit, bright = blocks[y - 20 : y + 20, x - 20 : x + 20] > 0, area > 0
        assert np.mean(bright[lit]) > 0.99 and np.mean(bright[~lit]) < 0.05
    assert len(np.unique(game.focal_point, axis=0)) > 10


@pytest.fixture(scope="module")
def seeker(untrained):
    """An agent for seek that has learned nothing, without a vision head."""
    words = ["game=seek", "sensor=constant50_sub2", "gaze=random", "name=tiny", "network.dense=8", "network.lstm=8"]
    return untrained(Agent(compose(words), 2, None), env_steps=7)


def test_a_game_is_the_one_that_evaluation_plays(seeker):
    games = list(record(seeker, episodes=2, seed=4))
    assert [len(game.screens) for game in games] == [97, 97] and all(game.is_over for game in games)
    scores = play(seeker, episodes=1, num_envs=1, seed=5, greedy=False)
    assert scores.returns[0] == pytest.approx(games[1].score[-1])
    assert scores.lengths[0] == len(games[1].screens) - 1  # the last screen ends it, nothing is done upon it
    assert games[0].vision_probs is None and games[0].vision_value is None and games[0].lives is None
    assert games[0].actions == ("leave", "take") and games[0].env_steps == 7
    assert not np.array_equal(games[0].focal_point, games[1].focal_point)


@pytest.mark.parametrize("gaze", ["frozen", "random", "scripted"])
def test_a_gaze_that_is_not_learned_goes_where_its_control_says(untrained, gaze):
    path = [(30, 50), (40, 2), (45, 44)]
    words = [f"gaze={gaze}", "gaze.path=[[30,50],[40,2],[45,44]]", "network.dense=8", "network.lstm=8"]
    agent = Agent(compose(["game=seek", "sensor=constant50_sub2", *words]), 2, None)
    game = next(record(untrained(agent), max_steps=20))
    low, high = bounds(agent.config)
    if gaze == "scripted":
        expected = [path[t % 3] for t in range(20)]
    elif gaze == "frozen":
        expected = [(40, 40)] * 20
    else:
        assert len(np.unique(game.vision_action)) > 2
        expected = [(40, 40), *(game.focal_point + 4 * DIRECTIONS[game.vision_action])[:-1]]
    np.testing.assert_array_equal(game.focal_point, np.clip(expected, low, high))


def test_a_greedy_game_takes_the_likeliest_actions(breakout_agent):
    game = next(record(breakout_agent, greedy=True, max_steps=20))
    np.testing.assert_array_equal(game.natural_action, game.natural_probs.argmax(1))
    np.testing.assert_array_equal(game.vision_action, game.vision_probs.argmax(1))


class UnequalGames(Environment):
    """Two environments: one whose games last 2 steps, one whose games last 5."""

    num_envs, num_actions, crop_top, lives = 2, 4, None, None

    def reset(self):
        self._age = np.zeros(2, int)
        return self._seen(np.ones(2, bool)), None

    def send(self, action):
        self._age += 1

    def recv(self):
        is_over = self._age == np.array([2, 5])
        is_first = self._age == np.array([3, 6])  # the step that begins the next game
        self._age[is_first] = 0
        return self._seen(is_first), Outcome(score=np.ones(2, np.float32) * ~is_first, is_over=is_over)

    def _seen(self, is_first):
        false = np.zeros(2, bool)
        return TimeStep(np.zeros((2, 80, 80), np.uint8), np.zeros(2, np.float32), is_first=is_first, is_terminal=false)

    def close(self):
        pass


def test_each_environment_plays_the_same_number_of_games(seeker, monkeypatch):
    monkeypatch.setattr(games, "environment", lambda *_, **__: UnequalGames())
    played = play(seeker, episodes=4, num_envs=2, seed=0, greedy=False)
    assert sorted(played.lengths) == sorted(played.returns) == [2, 2, 5, 5]


def test_a_game_of_other_actions_is_refused(seeker):
    other = dataclasses.replace(seeker, agent=Agent(seeker.agent.config, 3, None))
    for watch in (lambda: next(record(other)), lambda: play(other, episodes=1, num_envs=1, seed=0, greedy=False)):
        with pytest.raises(ConfigError, match="^game=seek: has 2 actions; accepted is 3, as in training$"):
            watch()


def test_a_recording_holds_what_the_sensor_gave(seeker):
    told = []
    game = next(record(seeker, max_steps=5, progress=lambda steps, score: told.append((steps, score))))
    assert [steps for steps, _ in told] == [1, 2, 3, 4, 5]
    sensor = seeker.agent.sensor.packed
    assert game.images[0].shape == (5, 25, 25) and not sensor.in_place
    frames = [np.asarray(to_frame(jnp.asarray(screen[..., 0]), None)) for screen in game.screens]
    np.testing.assert_allclose(game.mean_frame, np.mean(frames, axis=0), atol=1e-6)
    for frame, point, image in zip(frames, game.focal_point, game.images[0], strict=True):
        area = frame[point[0] - 25 : point[0] + 25, point[1] - 25 : point[1] + 25]
        expected = np.round(255 * area.reshape(25, 2, 25, 2).mean(axis=(1, 3)))
        np.testing.assert_allclose(image, expected, atol=1)


def test_screens_are_kept_exactly():
    noise = np.random.default_rng(0).integers(0, 256, (3, 5, 4, 3), dtype=np.uint8)
    screens = Screens()
    for screen in noise:
        screens.append(screen)
    assert len(screens) == 3 and screens.shape == (5, 4, 3)
    np.testing.assert_array_equal(np.stack(list(screens)), noise)


def test_actions_have_names_where_the_game_has_them():
    assert action_names(compose(["game=pong"])) == ("noop", "fire", "right", "left", "rightfire", "leftfire")
    assert action_names(compose(["game=gymnasium:CarRacing-v3"])) is None
    assert steps_per_second(compose(["env.frame_skip=2"])) == 30
    assert steps_per_second(compose(["game=seek"])) == 15
