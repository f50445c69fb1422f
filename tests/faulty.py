"""`game=gymnasium:faulty:Faulty-v0`: an environment that raises or hangs where FAULTY says, e.g. `hang:step`."""

from __future__ import annotations

import os
import time

import gymnasium
import numpy as np
from gymnasium import spaces

SCREENS = np.random.default_rng(0).integers(0, 256, (8, 80, 80), np.uint8)


class Faulty(gymnasium.Env):
    """Six steps an episode; a fault in a step comes in the twenty-first."""

    observation_space = spaces.Box(0, 255, (80, 80), np.uint8)
    action_space = spaces.Discrete(2)

    def __init__(self, render_mode: str | None = None) -> None:
        self.steps = 0
        self._fail_in("make")

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._fail_in("reset")
        return SCREENS[0], {}

    def step(self, action):
        self.steps += 1
        if self.steps > 20:
            self._fail_in("step")
        return SCREENS[self.steps % 8], float(action), self.steps % 6 == 0, False, {}

    def close(self):
        self._fail_in("close")

    def _fail_in(self, place: str) -> None:
        how, _, where = os.environ.get("FAULTY", "").partition(":")
        if where == place and how == "raise":
            raise RuntimeError("the emulator\nis on fire")
        if where == place and how == "hang":
            time.sleep(1_000_000)


gymnasium.register("Faulty-v0", entry_point=Faulty)
