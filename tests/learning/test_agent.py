"""One decision of many actors: whose random numbers it takes, by each way to move the gaze."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from foajax.config.compose import compose
from foajax.learning.agent import Agent
from foajax.sensors.base import Sensor
from foajax.types import TimeStep

ACTORS = 6000
WORDS = ["sensor=rings", "sensor.rings=[[8,8,1]]", "sensor.layout=packed", "env.frame_shape=[12,12]", "gaze.step=1"]
WORDS += ["network.torso=small", "network.dense=0", "network.lstm=4", "network.normalization=none"]


@pytest.mark.parametrize("mode", ["learned", "random", "frozen"])
def test_both_actions_are_drawn_by_each_actor_apart(mode):
    """Parameters of zeros make every action as likely as the others; a frozen gaze stays, whatever is drawn."""
    agent = Agent(compose([*WORDS, f"gaze.mode={mode}"]), num_actions=3, crop_top=None)
    shapes = jax.eval_shape(agent.initial_params, jax.random.key(0))
    params = jax.tree.map(lambda shape: jnp.zeros(shape.shape), shapes)
    frame, zeros = np.zeros((ACTORS, 12, 12), np.uint8), np.zeros(ACTORS, np.float32)
    timestep = TimeStep(frame, zeros, is_first=zeros == 0, is_terminal=zeros > 0)
    act, state = jax.jit(agent.act), agent.initial_state(ACTORS)
    output, _, state = act(params, agent.initial_statistics(), state, timestep, jax.random.key(0))
    visions = 1 if mode == "frozen" else 5
    drawn = np.zeros((3, visions), int)
    np.add.at(drawn, (output.natural_action, output.vision_action), 1)
    mean = ACTORS / drawn.size
    assert np.abs(drawn - mean).max() < 5 * np.sqrt(mean)
    np.testing.assert_allclose(output.natural_log_prob, -np.log(3), rtol=1e-5)
    np.testing.assert_allclose(output.vision_log_prob, -np.log(5) if mode == "learned" else 0.0, rtol=1e-5)
    assert len(np.unique(state.focal_point, axis=0)) == visions


class Edges(Sensor):
    """A sensor that subtracts, which wraps in uint8, and is not linear."""

    window = (4, 4)

    def sense(self, frame, focal_point, bounds):
        return (jnp.abs(frame[1:, :4] - frame[:-1, :4]) + (frame[1:, :4] > 0.5),)

    def image_shapes(self, frame_shape):
        return ((frame_shape[0] - 1, 4),)

    def picture(self, images, focal_point, frame_shape):
        raise NotImplementedError


def test_a_sensor_of_ones_own_sees_frames_from_0_to_1_without_normalisation_too():
    words = ["sensor=own", f"sensor.kind={__name__}:Edges", "env.frame_shape=[12,12]", "network.normalization=none"]
    agent = Agent(compose(words), num_actions=3, crop_top=None)
    screen = np.random.default_rng(0).integers(0, 256, (2, 12, 12)).astype(np.uint8)
    (seen,), *_ = agent.see(screen, jnp.full((2, 2), 6), agent.initial_statistics())
    frame = screen[:, :, :4] / 255
    expected = np.abs(np.diff(frame, axis=1)) + (frame[:, 1:] > 0.5)
    np.testing.assert_allclose(seen[..., 0], expected, atol=1e-6)
