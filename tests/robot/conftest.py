"""The files of an exported folder lie beside each other: they are imported by their own names."""

from __future__ import annotations

import dataclasses
import functools
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import foajax
from foajax.config.compose import compose
from foajax.learning.agent import Agent
from foajax.types import FrameStatistics, TimeStep

sys.path.insert(0, str(Path(foajax.__file__).parent / "robot"))

SMALL = ["network.dense=8", "network.lstm=8"]


@pytest.fixture(scope="session")
def make_stored(untrained):
    """Makes a small agent of any configuration, with parameters of noise and frame statistics that have seen much."""

    def make(*words, actions=4, crop_top=34):
        stored = untrained(Agent(compose([*SMALL, *words]), actions, crop_top))
        random, weight = np.random.default_rng(1), np.array(0.5, np.float32)
        mean = np.asarray(random.uniform(0.1, 0.4, np.shape(stored.statistics.mean)), np.float32)
        return dataclasses.replace(
            stored, statistics=FrameStatistics(mean=mean, std=np.array(0.1, np.float32), weight=weight)
        )

    return make


@pytest.fixture
def fill(tmp_path):
    """Writes an agent's folder, without recorded steps, and gives its path."""
    from foajax.robot import folder

    def write(stored):
        folder.fill(tmp_path / "robot", stored, {}, {})
        return tmp_path / "robot"

    return write


@pytest.fixture(scope="session")
def decisions():
    """Gives what the JAX agent does, greedily, frame after frame."""
    return _decisions


def _decisions(stored, frames, rewards, is_first):
    act = jax.jit(functools.partial(stored.agent.act, greedy=True))
    state, rows = stored.agent.initial_state(1), []
    for step, frame in enumerate(frames):
        timestep = TimeStep(frame[None], rewards[step : step + 1], is_first[step : step + 1], np.zeros(1, bool))
        output, network, state = act(stored.params, stored.statistics, state, timestep, jax.random.key(step))
        rows.append(jax.device_get((output, network)))
    return rows
