"""Shapes of both torsos for every sensor, one state for whole and split unrolls, the heads' presence."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from foajax.config import compose
from foajax.config.schema import NetworkConfig
from foajax.networks.network import initial_core_state, initial_params, make_network, make_torso
from foajax.sensors.sense import image_shapes

EXPERIMENTS = compose.list_experiments()


def build(*overrides):
    config = compose.compose(overrides)
    network = make_network(config, 4)
    shapes = image_shapes(config.sensor, config.env.frame_shape)
    return config, network, lambda: jax.jit(lambda key: initial_params(network, key, shapes))(jax.random.key(0))


def inputs(config, steps, batch):
    rng = np.random.default_rng(0)
    shapes = image_shapes(config.sensor, config.env.frame_shape)
    roi = [jnp.asarray(rng.normal(size=(steps, batch, *shape)), jnp.float32) for shape in shapes]
    focal_point = jnp.asarray(rng.uniform(-1, 1, (steps, batch, 2)), jnp.float32)
    is_first = np.zeros((steps, batch), bool)
    is_first[2, 1] = True
    return roi, focal_point, jnp.asarray(is_first)


@pytest.mark.parametrize("torso", ["nature", "a3c"])
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_experiment_has_four_outputs_or_two(experiment, torso):
    config, network, params = build(f"experiment={experiment}", f"network={torso}")
    roi, focal_point, is_first = inputs(config, 3, 2)
    state = initial_core_state(network, 2)
    output, _ = jax.eval_shape(lambda: network.apply(params(), roi, focal_point, is_first, state))
    assert output.natural_logits.shape == (3, 2, 4) and output.natural_value.shape == (3, 2)
    if config.gaze.learned:
        assert output.vision_logits.shape == (3, 2, config.gaze.actions) and output.vision_value.shape == (3, 2)
    else:
        assert output.vision_logits is None and output.vision_value is None


@pytest.mark.parametrize(
    ("words", "sees"),
    [
        ("experiment=constant70", True),
        ("experiment=constant70 gaze=frozen", True),
        ("experiment=constant70 network.focal_point=packed", False),
        ("experiment=constant70 network=a3c", False),
        ("experiment=nonfoa", False),
        ("experiment=constant70_packed network=a3c", True),
        ("experiment=logpolar network=a3c", True),
    ],
)
def test_a_gaze_that_moves_tells_where_it_is_but_not_the_papers_canvas(words, sees):
    config, network, params = build(*words.split())
    params, state = params(), initial_core_state(network, 2)
    roi, focal_point, is_first = inputs(config, 3, 2)
    apply = jax.jit(lambda point: network.apply(params, roi, point, is_first, state)[0].natural_value)
    assert (np.abs(apply(focal_point) - apply(-focal_point)).max() > 1e-4) == sees


@pytest.mark.parametrize("size", [80, 50, 35, 30, 25, 18, 16])
def test_the_nature_torso_leaves_out_no_pixel(size):
    image = jax.random.normal(jax.random.key(0), (4, size, size, 1))
    torso = make_torso(NetworkConfig())
    features, params = torso.init_with_output(jax.random.key(1), image)
    weights = jax.random.normal(jax.random.key(2), features.shape)
    gradient = jax.grad(lambda x: (torso.apply(params, x) * weights).sum())(image)
    assert (jnp.abs(gradient).sum(0) > 0).all()


def test_what_strides_left_out_before():
    """The last four rows and columns of 80: `padding=valid`, as older runs were made."""
    image = jnp.ones((1, 80, 80, 1))
    torso = make_torso(NetworkConfig(padding="valid"))
    features, params = torso.init_with_output(jax.random.key(1), image)
    assert features.shape == (1, 6 * 6 * 64)
    np.testing.assert_array_equal(torso.apply(params, image.at[:, 76:].set(9.0).at[:, :, 76:].set(9.0)), features)


def test_a_split_unroll_is_the_whole():
    config, network, params = build("experiment=constant50_sub2_packed")
    params = params()
    roi, focal_point, is_first = inputs(config, 6, 2)
    state = initial_core_state(network, 2)
    whole, last = network.apply(params, roi, focal_point, is_first, state)
    first, middle = network.apply(params, [x[:3] for x in roi], focal_point[:3], is_first[:3], state)
    second, end = network.apply(params, [x[3:] for x in roi], focal_point[3:], is_first[3:], middle)
    joined = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), first, second)
    chex.assert_trees_all_close(joined, whole, atol=1e-5)
    chex.assert_trees_all_close(end, last, atol=1e-5)


def test_environments_do_not_mix_and_episodes_do_not_leak():
    config, network, params = build("experiment=constant50_sub2_packed")
    params = params()
    roi, focal_point, is_first = inputs(config, 5, 2)
    state = initial_core_state(network, 2)

    def value(image, t, b):
        output, _ = network.apply(params, [image], focal_point, is_first, state)
        return output.natural_value[t, b] + output.vision_value[t, b]

    reached = np.any(jax.grad(value)(roi[0], 4, 1) != 0, axis=(2, 3, 4))
    # Environment 1 starts an episode at step 2: steps 2..4 matter, nothing before and nobody else.
    np.testing.assert_array_equal(reached[:, 1], [False, False, True, True, True])
    assert not reached[:, 0].any()


@pytest.mark.parametrize("norm", [True, False])
def test_large_weights_drive_the_gates_to_their_ends_only_without_the_norm(norm):
    config, network, params = build("experiment=constant50_sub2_packed", f"network.lstm_norm={str(norm).lower()}")
    params = params()
    roi, focal_point, is_first = inputs(config, 3, 2)
    state = initial_core_state(network, 2)
    inner = params["params"]
    assert ("lstm_norm" in inner) == norm
    large = {"params": inner | {"lstm_input": jax.tree.map(lambda x: 1000.0 * x, inner["lstm_input"])}}
    before, after = (network.apply(p, roi, focal_point, is_first, state)[0].natural_value for p in (params, large))
    assert np.allclose(before, after, atol=1e-3) == norm


def test_the_initial_policies_are_about_uniform():
    config, network, params = build("experiment=constant70")
    roi, focal_point, is_first = inputs(config, 3, 2)
    output, _ = network.apply(params(), roi, focal_point, is_first, initial_core_state(network, 2))
    for logits in (output.natural_logits, output.vision_logits):
        probabilities = jax.nn.softmax(logits)
        np.testing.assert_allclose(probabilities, 1 / logits.shape[-1], atol=0.02)
