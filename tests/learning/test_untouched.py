"""A decision without normalisation reads what the sensor looks at, and not the frame."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from foajax.config.compose import compose
from foajax.learning.agent import Agent
from foajax.sensors import frames
from foajax.sensors.sense import sense
from foajax.types import TimeStep

SMALL, LARGE = (160, 160), (1080, 1920)
WORDS = ["experiment=search_rings", "network.lstm=16", "network.dense=16"]


def agent(shape, *words):
    return Agent(compose([*WORDS, f"env.frame_shape=[{shape[0]},{shape[1]}]", *words]), num_actions=3, crop_top=None)


def cost(shape, *words) -> dict[str, float]:
    """What XLA counts of a compiled decision."""
    who = agent(shape, *words)
    zeros = jnp.zeros(1)
    timestep = TimeStep(jnp.zeros((1, *shape), jnp.uint8), zeros, zeros > 0, zeros > 0)
    params = jax.eval_shape(who.initial_params, jax.random.key(0))
    params = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), params)
    arguments = params, who.initial_statistics(), who.initial_state(1), timestep, jax.random.key(0)
    analysis = jax.jit(who.act).lower(*arguments).compile().cost_analysis()
    return {name: analysis[name] for name in ("flops", "bytes accessed")}


def test_the_work_of_a_decision_does_not_grow_with_the_frame():
    small, large = cost(SMALL), cost(LARGE)
    assert large["flops"] == pytest.approx(small["flops"], rel=0.01)
    # XLA counts a slice's whole operand as read: a byte per pixel, once or twice, where normalising takes many.
    grown = large["bytes accessed"] - small["bytes accessed"]
    pixels = np.prod(LARGE) - np.prod(SMALL)
    assert grown <= 4 * pixels
    normalised = cost(LARGE, "network.normalization=frame")
    assert normalised["flops"] > large["flops"] + 3 * pixels


@pytest.mark.parametrize("words", [(), ("sensor.peripheral=[5,5]",), ("sensor=search_logpolar",)])
def test_what_is_seen_is_the_frame_in_0_to_1(words):
    who = agent(SMALL, *words)
    screen = np.random.default_rng(0).integers(0, 256, (3, *SMALL), dtype=np.uint8)
    points = jnp.array([[80, 80], [10, 150], [0, 0]])
    roi, mean, std = jax.jit(who.see)(screen, points, who.initial_statistics())
    look = functools.partial(sense, sensor=who.config.sensor, bounds="point")
    wanted = jax.jit(jax.vmap(lambda s, p: look(frames.to_frame(s, None), p)))(screen, points)
    for image, expected in zip(roi, wanted, strict=True):
        np.testing.assert_allclose(image, expected, atol=1e-6)
    assert not np.any(mean) and not np.any(std)


def test_screens_of_another_kind_are_refused():
    who = agent(SMALL)
    with pytest.raises(ValueError, match=r"frame=uint8 \[1, 80, 80\]: accepted is uint8 \[B, 160, 160\], gray"):
        who.see(np.zeros((1, 80, 80), np.uint8), jnp.zeros((1, 2), jnp.int32), who.initial_statistics())
