"""Environments of one's own, and arguments of a constructor."""

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from foajax.config.compose import compose
from foajax.config.parse import ConfigError, replace
from foajax.envs import seek
from foajax.envs.atari import check_game
from foajax.envs.make import action_names, make, steps_per_second
from foajax.envs.tasks import JaxEnvironment

HERE = "test_own"


def seek_of(num_envs, seed, size=80):
    """A factory: `seek` on frames of another size."""
    return JaxEnvironment(seek.task((size, size)), num_envs=num_envs, seed=seed)


def nothing(num_envs, seed):
    return None


class Shades(gymnasium.Env):
    """One shade of gray."""

    def __init__(self, shade=1, render_mode=None):
        self.observation_space, self.action_space = spaces.Box(0, 255, (80, 80), np.uint8), spaces.Discrete(2)
        self.shade = shade

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.full((80, 80), self.shade, np.uint8), {}


gymnasium.register("foajax-shades-v0", Shades)


def own(*words):
    return compose(["experiment=constant70_packed", *words])


def test_a_factory_of_ones_own_makes_the_environment():
    config = own(f"game={HERE}:seek_of", "env.kwargs.size=40")
    check_game(config)
    environment = make(config, num_envs=3, seed=1)
    assert environment.reset()[0].frame.shape == (3, 40, 40) and environment.num_actions == 2
    same = JaxEnvironment(seek.task((40, 40)), num_envs=3, seed=1)
    np.testing.assert_array_equal(environment.reset()[0].frame, same.reset()[0].frame)
    assert action_names(config) is None and steps_per_second(config) == 15


def test_a_gymnasium_environments_constructor_gets_its_arguments():
    config = own("game=gymnasium:foajax-shades-v0", "env.kwargs.shade=7")
    for render in (False, True):
        assert (make(config, num_envs=2, seed=0, render=render).reset()[0].frame == 7).all()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["game=test_own:seek_of", "env.kwargs.color=1"], "game=test_own:seek_of: got an unexpected keyword"),
        (["game=test_own:no"], "game=test_own:no: .* has no attribute 'no'; accepted is package.module:Name"),
        (
            ["game=test_own:nothing"],
            "game=test_own:nothing: accepted is a function that returns a foajax.envs.base.Env",
        ),
        (
            ["game=gymnasium:foajax-shades-v0", "env.kwargs.x=1"],
            "'x'.*accepted is env.kwargs that the constructor takes",
        ),
        (["game=breakout", "env.kwargs.mode=4"], r"env.kwargs={'mode': 4}: accepted is {} for game=breakout"),
    ],
)
def test_what_cannot_be_made_is_one_line(words, message):
    config = own(*words)
    with pytest.raises(ConfigError, match=message) as caught:
        check_game(config)
        make(config, num_envs=1, seed=0)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("words", [["game=test_own:no"], ["game=test_own:seek_of", "env.kwargs.color=1"]])
def test_a_mistake_in_ones_own_is_found_before_anything_is_made(words):
    with pytest.raises(ConfigError, match="game=test_own:"):
        check_game(own(*words))


def test_names_of_code_are_told_from_ours():
    names = ["breakout", "seek", "probe:gaze", "gymnasium:foajax-shades-v0", "gymnasium:ale_py:ALE/Pong-v5"]
    config = own()
    assert not any(replace(config, game=name).code for name in names)
    for name in ("mine:walk", "gymnasium:mine:Walk-v0"):
        assert replace(config, game=name).code == [f"game={name}"]
