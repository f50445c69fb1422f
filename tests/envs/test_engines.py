"""The emulators at the edges of what the configuration accepts: a crash there would take the process along."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

_PLAY = """
import sys
import numpy as np
from foajax.config import compose
from foajax.envs.make import make
config = compose.compose(sys.argv[1:])
environment = make(config, num_envs=2, seed=config.seed)
environment.reset()
for _ in range(5):
    environment.send(np.zeros(2, np.int32))
    timestep, _ = environment.recv()
    assert timestep.frame.shape == (2, 210, 160)
print("played")
"""
EDGES = [
    ["env.noop_max=0"],
    ["env.noop_max=200", "env.max_episode_steps=1"],
    ["env.frame_skip=1", "env.max_episode_steps=1"],
    ["env.frame_skip=1000", "env.max_episode_steps=2000000"],
    ["env.sticky_actions=0.999"],
    ["env.threads=1024"],
    ["seed=2147473647"],
]


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["envpool", "ale"])
@pytest.mark.parametrize("words", EDGES, ids=" ".join)
def test_an_engine_survives_the_edges_of_what_is_accepted(engine, words):
    command = [sys.executable, "-c", _PLAY, f"env.engine={engine}", *words]
    result = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True, timeout=300)
    assert (result.returncode, result.stdout) == (0, "played\n"), result.stderr
