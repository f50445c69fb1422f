"""Torsos against a NumPy loop; max-pool and its gradient; a network for a batch of any size."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from foajax.config.compose import compose
from foajax.config.schema import NetworkConfig
from foajax.learning.agent import Agent
from foajax.networks.torsos import make_torso, max_pool


def convolve(x, layer, stride):
    """The definition of a valid convolution with bias and ReLU, in float64."""
    kernel, bias = (np.asarray(layer[name], np.float64) for name in ("kernel", "bias"))
    rows, columns = kernel.shape[:2]
    h, w = (x.shape[1] - rows) // stride + 1, (x.shape[2] - columns) // stride + 1
    patches = np.array(
        [[x[:, i * stride : i * stride + rows, j * stride : j * stride + columns] for j in range(w)] for i in range(h)]
    )
    return np.einsum("ijnklc,klcd->nijd", patches, kernel) + bias


def pool(x):
    h, w = x.shape[1] // 2, x.shape[2] // 2
    blocks = [[x[:, 2 * i : 2 * i + 2, 2 * j : 2 * j + 2].max((1, 2)) for j in range(w)] for i in range(h)]
    return np.array(blocks).transpose(2, 0, 1, 3)


def nature(x, params, layers):
    """`layers` are (kernel, stride, padding at the bottom and right)."""
    for layer, (kernel, stride, border) in enumerate(layers):
        own = params[f"Convolution_{layer}"]
        assert own["kernel"].shape[:2] == (kernel, kernel)
        x = np.maximum(convolve(np.pad(x, ((0, 0), (0, border), (0, border), (0, 0))), own, stride), 0)
    return x


def a3c(x, params, borders):
    for layer, border in enumerate(borders):
        x = convolve(np.pad(x, ((0, 0), (border, border), (border, border), (0, 0))), params[f"Convolution_{layer}"], 1)
        x = np.maximum(pool(x) if min(x.shape[1:3]) > 4 else x, 0)
    return x


@pytest.mark.parametrize(
    ("config", "size", "expected"),
    [
        ({}, 80, lambda x, p: nature(x, p, [(8, 4, 0), (4, 2, 1), (3, 1, 0)])),
        ({}, 35, lambda x, p: nature(x, p, [(5, 2, 0), (4, 2, 0), (3, 1, 0)])),
        ({"padding": "valid"}, 80, lambda x, p: nature(x, p, [(8, 4, 0), (4, 2, 0), (3, 1, 0)])),
        ({"torso": "a3c"}, 35, lambda x, p: a3c(x, p, (2, 1, 1, 1))),
    ],
)
def test_a_torso_follows_the_definition(config, size, expected):
    image = np.random.default_rng(0).normal(size=(2, size, size, 1)).astype(np.float32)
    init = jax.jit(make_torso(NetworkConfig(**config)).init_with_output)
    features, params = init(jax.random.key(1), jnp.asarray(image))
    wanted = expected(image.astype(np.float64), params["params"]).reshape(2, -1)
    np.testing.assert_allclose(features, wanted, atol=2e-5)
    assert np.ptp(wanted) > 0.1


@pytest.mark.parametrize("shape", [(2, 6, 8, 3), (2, 7, 5, 3)])
def test_max_pool_follows_the_definition(shape):
    x = np.random.default_rng(1).normal(size=shape).astype(np.float32)
    np.testing.assert_array_equal(max_pool(jnp.asarray(x)), pool(x))


def test_max_pool_gradient_goes_to_the_maximum_and_is_shared_by_equals():
    x = jnp.array([[1.0, 2.0], [3.0, 0.0]]).reshape(1, 2, 2, 1)
    gradient = jax.grad(lambda x: 5.0 * jnp.sum(max_pool(x)))
    np.testing.assert_array_equal(gradient(x)[0, :, :, 0], [[0, 0], [5, 0]])
    np.testing.assert_array_equal(gradient(jnp.ones_like(x))[0, :, :, 0], [[1.25, 1.25], [1.25, 1.25]])


@pytest.mark.parametrize("words", [["experiment=decreasing_p_packed"], ["experiment=constant70", "network=a3c"]])
def test_a_network_is_exported_for_a_batch_of_any_size(words):
    agent = Agent(compose(words), num_actions=4, crop_top=None)
    params = jax.eval_shape(agent.initial_params, jax.random.key(0))
    (batch,) = jax.export.symbolic_shape("batch")
    shaped = lambda shape, dtype=jnp.float32: jax.ShapeDtypeStruct(shape, dtype)  # noqa: E731
    images = [shaped((1, batch, *shape)) for shape in agent.image_shapes]
    side = jax.eval_shape(agent.side, *(shaped((1, *s), d) for s, d in SIDE)).shape[-1]
    state = jax.tree.map(lambda x: shaped((batch, *x.shape[1:])), jax.eval_shape(lambda: agent.initial_state(1)))
    inputs = params, images, shaped((1, batch, side)), shaped((1, batch), bool), state.core_state
    exported = jax.export.export(jax.jit(agent.forward))(*inputs)
    assert str(exported.out_avals[0].shape) == "(1, batch, 4)"


SIDE = (((2,), jnp.int32), ((2,), jnp.int32), ((), jnp.float32), ((), bool))
