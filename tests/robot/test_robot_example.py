"""The example plays with an exported agent and ale-py, and counts what it earns."""

from __future__ import annotations

import importlib.util
import types
from pathlib import Path

import numpy as np
import pytest

EXAMPLE = Path(__file__).resolve().parent.parent.parent / "examples" / "robot_plays_atari.py"


@pytest.fixture(scope="module")
def example():
    """The script as a module."""
    spec = importlib.util.spec_from_file_location("robot_plays_atari", EXAMPLE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Emulator:
    """A game of two lives: every action earns 1, and the sixth and the twelfth frame lose a life."""

    def __init__(self):
        self.frames, self.acted = 0, []

    def reset_game(self):
        self.frames = 0

    def act(self, action):
        self.frames += 1
        self.acted.append(action)
        return 1

    def lives(self):
        return 2 - (self.frames >= 6) - (self.frames >= 12)

    def game_over(self):
        return self.lives() == 0

    def getScreenGrayscale(self):
        return np.full((210, 160), self.frames, np.uint8)

    def getScreenRGB(self):
        return np.full((210, 160, 3), self.frames, np.uint8)


class Agent:
    def __init__(self, color):
        self.facts, self.shape = {"color": color}, (210, 160, 3)[: 2 + color]
        self.seen, self.resets, self.rewards = [], 0, []

    def reset(self):
        self.resets += 1

    def decide(self, screen, reward):
        assert screen.shape == self.shape
        self.seen.append(int(screen.max()))
        self.rewards.append(reward)
        return 1, 0


@pytest.mark.parametrize("color", [False, True])
def test_lives_begin_with_fire_and_an_agent_that_is_reset(example, color):
    emulator, agent = Emulator(), Agent(color)
    random = types.SimpleNamespace(integers=lambda bound: 0)  # no no-ops
    actions = [example.Action.NOOP, example.Action.LEFT, example.Action.FIRE]
    score, steps = example.play(agent, emulator, actions, random)
    # FIRE, four frames, four of which one loses a life, FIRE, and two until the game is over
    assert agent.seen == [1, 5, 10]
    assert (score, steps, agent.resets) == (12, 3, 2)
    assert agent.rewards == [0, 4, 0]
    assert emulator.acted.count(example.Action.FIRE) == 2
