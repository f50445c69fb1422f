"""Noise for tests: parameters that take no time to compile, and an environment for wrappers."""

from __future__ import annotations

import gymnasium
import jax
import numpy as np
from gymnasium import spaces


def params(init, *inputs):
    """Noise in the shapes that `init(*inputs)` gives; initialisation as in training takes long to compile."""
    random = np.random.default_rng(0)
    shapes = jax.eval_shape(init, *inputs)
    return jax.tree.map(lambda shape: random.normal(0, 0.05, shape.shape).astype(np.float32), shapes)


class Noise(gymnasium.Env):
    """Frames of noise, drawn anew each step; an episode lasts `length` steps."""

    def __init__(self, space=None, action_space=None, length=99):
        self.observation_space = space or spaces.Box(0, 255, (16, 20), np.uint8)
        self.action_space = action_space or spaces.Discrete(3)
        self.length = length

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(int(self.np_random.integers(2**31)))
        self.time = 0
        return self.draw(), {}

    def step(self, action):
        self.time, self.action = self.time + 1, action
        return self.draw(), 1.0, self.time >= self.length, False, {"time": self.time}

    def draw(self):
        self.drawn = self.observation_space.sample()
        return self.drawn
