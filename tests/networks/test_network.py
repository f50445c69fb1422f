"""Shapes of both torsos for every sensor, one state for whole and split unrolls, the heads' presence."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from foajax.config import compose
from foajax.config.parse import ConfigError
from foajax.config.schema import NetworkConfig
from foajax.learning.agent import Agent
from foajax.networks.network import initial_core_state
from foajax.networks.torsos import make_torso

EXPERIMENTS = compose.list_experiments()


def build(*overrides):
    agent = Agent(compose.compose(overrides), num_actions=4, crop_top=None)
    return agent, agent.network, lambda: jax.jit(agent.initial_params)(jax.random.key(0))


def inputs(agent, steps, batch):
    """Random images, what the LSTM is told beside them, and one episode that starts at step 2."""
    rng = np.random.default_rng(0)
    roi = [jnp.asarray(rng.normal(size=(steps, batch, *shape)), jnp.float32) for shape in agent.image_shapes]
    is_first = np.zeros((steps, batch), bool)
    is_first[2, 1] = True
    point, actions = rng.integers(30, 50, (steps, batch, 2)), rng.integers(0, 4, (steps, batch, 2))
    side = agent.side(*map(jnp.asarray, (point, actions, np.ones((steps, batch), np.float32), is_first)))
    return roi, side, jnp.asarray(is_first)


@pytest.mark.parametrize("torso", ["nature", "a3c"])
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_experiment_has_four_outputs_or_two(experiment, torso):
    agent, network, params = build(f"experiment={experiment}", f"network={torso}")
    roi, side, is_first = inputs(agent, 3, 2)
    state = initial_core_state(network, 2)
    output, _ = jax.eval_shape(lambda: network.apply(params(), roi, side, is_first, state))
    assert output.natural_logits.shape == (3, 2, 4) and output.natural_value.shape == (3, 2)
    if agent.config.gaze.learned:
        assert output.vision_logits.shape == (3, 2, agent.config.gaze.num_actions) and output.vision_value.shape == (
            3,
            2,
        )
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
    agent, network, params = build(*words.split())
    params, state = params(), initial_core_state(network, 2)
    roi, _, is_first = inputs(agent, 3, 2)

    @jax.jit
    def value(point):
        actions, reward = jnp.zeros((3, 2, 2), jnp.int32), jnp.zeros((3, 2))
        side = agent.side(jnp.broadcast_to(point, (3, 2, 2)), actions, reward, is_first)
        return network.apply(params, roi, side, is_first, state)[0].natural_value

    assert (np.abs(value(jnp.array([36, 38])) - value(jnp.array([44, 42]))).max() > 1e-4) == sees


def test_the_core_is_told_the_last_actions_and_reward_but_not_of_another_episode():
    agent, *_ = build("experiment=constant70_packed")
    point, actions = jnp.array([[35, 45], [40, 40], [40, 40]]), jnp.array([[3, 4], [0, 1], [2, 2]])
    side = agent.side(point, actions, jnp.array([1.0, -1.0, 0.0]), jnp.array([False, False, True]))
    np.testing.assert_array_equal(
        side,
        [
            [-1, 1, *(0, 0, 0, 1), *(0, 0, 0, 0, 1), 1],  # where in its reach; natural, visual; reward
            [0, 0, *(1, 0, 0, 0), *(0, 1, 0, 0, 0), -1],
            [0, 0, *(0, 0, 0, 0), *(0, 0, 0, 0, 0), 0],
        ],
    )
    whole, *_ = build("experiment=nonfoa")
    assert whole.side(point, actions, jnp.zeros(3), jnp.zeros(3, bool)).shape == (3, 4 + 1)
    paper, *_ = build("experiment=constant70", "network=a3c")
    assert paper.side(point, actions, jnp.zeros(3), jnp.zeros(3, bool)).shape == (3, 0)


def test_a_priority_map_treats_all_cells_alike():
    """What it adds for a bright cell moves with the cell, and other cells get the same wherever that is."""
    agent, network, params = build("experiment=search_rings_p", "network.dense=4", "network.lstm=4")
    params = jax.tree.map(lambda x: x + 0.1, params())
    for layer in ("dense", "vision_policy"):  # nothing but the map sees the images, or tells a cell from another
        params["params"][layer]["kernel"] *= 0

    @jax.jit
    def logits(row, column):
        images = [jnp.zeros((1, 1, *shape)) for shape in agent.image_shapes]
        images[-1] = images[-1].at[0, 0, row, column].set(1.0)
        side, is_first = jnp.zeros((1, 1, 2 + 4 + 64 + 1)), jnp.zeros((1, 1), bool)
        return network.apply(params, images, side, is_first, initial_core_state(network, 1))[0].vision_logits

    first, second = (np.asarray(logits(*cell)).reshape(8, 8) for cell in ((2, 2), (4, 5)))
    np.testing.assert_allclose(second, np.roll(first, (2, 3), (0, 1)), atol=1e-6)
    assert np.abs(first - first[7, 7]).max() > 1e-2


@pytest.mark.parametrize(
    "word", ["gaze=search", "gaze.grid=[4,4]", "sensor.layout=canvas", "sensor=search_logpolar", "sensor=search_window"]
)
def test_a_priority_map_needs_a_cell_for_each_place(word):
    with pytest.raises(ConfigError, match="network.priority_map=true: accepted is false, or gaze.moves=absolute with"):
        compose.compose(["experiment=search_rings_p", word])
    compose.compose(["experiment=search_rings_p", word, "network.priority_map=false"])


@pytest.mark.parametrize("norm", [True, False])
def test_the_forget_gates_begin_open(norm):
    words = (f"network.lstm_norm={str(norm).lower()}", "network.forget_bias=2", "network.lstm=16")
    _, _, params = build("experiment=constant50_sub2_packed", *words)
    biases = params()["params"]["lstm_norm" if norm else "lstm_input"]["bias"]
    np.testing.assert_array_equal(biases.reshape(4, 16).T, np.broadcast_to([0, 2, 0, 0], (16, 4)))


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
    agent, network, params = build("experiment=constant50_sub2_packed")
    params = params()
    roi, side, is_first = inputs(agent, 6, 2)
    state = initial_core_state(network, 2)
    whole, last = network.apply(params, roi, side, is_first, state)
    first, middle = network.apply(params, [x[:3] for x in roi], side[:3], is_first[:3], state)
    second, end = network.apply(params, [x[3:] for x in roi], side[3:], is_first[3:], middle)
    joined = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), first, second)
    chex.assert_trees_all_close(joined, whole, atol=1e-5)
    chex.assert_trees_all_close(end, last, atol=1e-5)


def test_environments_do_not_mix_and_episodes_do_not_leak():
    agent, network, params = build("experiment=constant50_sub2_packed")
    params = params()
    roi, side, is_first = inputs(agent, 5, 2)
    state = initial_core_state(network, 2)

    def value(image, t, b):
        output, _ = network.apply(params, [image], side, is_first, state)
        return output.natural_value[t, b] + output.vision_value[t, b]

    reached = np.any(jax.grad(value)(roi[0], 4, 1) != 0, axis=(2, 3, 4))
    # Environment 1 starts an episode at step 2: steps 2..4 matter, nothing before and nobody else.
    np.testing.assert_array_equal(reached[:, 1], [False, False, True, True, True])
    assert not reached[:, 0].any()


@pytest.mark.parametrize("norm", [True, False])
def test_large_weights_drive_the_gates_to_their_ends_only_without_the_norm(norm):
    agent, network, params = build("experiment=constant50_sub2_packed", f"network.lstm_norm={str(norm).lower()}")
    params = params()
    roi, side, is_first = inputs(agent, 3, 2)
    state = initial_core_state(network, 2)
    inner = params["params"]
    assert ("lstm_norm" in inner) == norm
    large = {"params": inner | {"lstm_input": jax.tree.map(lambda x: 1000.0 * x, inner["lstm_input"])}}
    before, after = (network.apply(p, roi, side, is_first, state)[0].natural_value for p in (params, large))
    assert np.allclose(before, after, atol=1e-3) == norm


def test_the_initial_policies_are_about_uniform():
    agent, network, params = build("experiment=constant70")
    roi, side, is_first = inputs(agent, 3, 2)
    output, _ = network.apply(params(), roi, side, is_first, initial_core_state(network, 2))
    for logits in (output.natural_logits, output.vision_logits):
        probabilities = jax.nn.softmax(logits)
        np.testing.assert_allclose(probabilities, 1 / logits.shape[-1], atol=0.02)
