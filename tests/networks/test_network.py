"""Shapes of both torsos for every sensor, one state for whole and split unrolls, the heads' presence."""

import chex
import jax
import jax.numpy as jnp
import noise
import numpy as np
import pytest

from foajax.config import compose
from foajax.config.parse import ConfigError
from foajax.config.schema import NetworkConfig
from foajax.learning.agent import Agent
from foajax.networks.network import initial_core_state
from foajax.networks.torsos import make_torso

EXPERIMENTS = compose.list_experiments()


KEY = jax.random.key(0)
SMALL = ("network.dense=16", "network.lstm=16")


def build(*overrides):
    return Agent(compose.compose(overrides), num_actions=4, crop_top=None)


def build_small(*overrides):
    """A narrow agent, its network as a compiled function, and parameters of noise."""
    agent = build(*SMALL, *overrides)
    return agent, jax.jit(agent.network.apply), noise.params(agent.initial_params, KEY)


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
    agent = build(f"experiment={experiment}", f"network={torso}")

    def run():
        state = initial_core_state(agent.network, 2)
        return agent.network.apply(agent.initial_params(KEY), *inputs(agent, 3, 2), state)

    output, _ = jax.eval_shape(run)
    assert output.natural_logits.shape == (3, 2, 4) and output.natural_value.shape == (3, 2)
    if agent.config.gaze.learned:
        assert output.vision_logits.shape == (3, 2, agent.config.gaze.num_actions)
        assert output.vision_value.shape == (3, 2)
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
    agent, run, params = build_small(*words.split())
    state = initial_core_state(agent.network, 2)
    roi, _, is_first = inputs(agent, 3, 2)

    @jax.jit
    def value(point):
        actions, reward = jnp.zeros((3, 2, 2), jnp.int32), jnp.zeros((3, 2))
        side = agent.side(jnp.broadcast_to(point, (3, 2, 2)), actions, reward, is_first)
        return run(params, roi, side, is_first, state)[0].natural_value

    assert (np.abs(value(jnp.array([36, 38])) - value(jnp.array([44, 42]))).max() > 1e-4) == sees


def test_the_core_is_told_the_last_actions_and_reward_but_not_of_another_episode():
    agent = build("experiment=constant70_packed")
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
    whole = build("experiment=nonfoa")
    assert whole.side(point, actions, jnp.zeros(3), jnp.zeros(3, bool)).shape == (3, 4 + 1)
    paper = build("experiment=constant70", "network=a3c")
    assert paper.side(point, actions, jnp.zeros(3), jnp.zeros(3, bool)).shape == (3, 0)


def test_a_priority_map_treats_all_cells_alike():
    """What it adds for a bright cell moves with the cell, and other cells get the same wherever that is."""
    agent = build("experiment=search_rings_p", "network.dense=4", "network.lstm=4")
    params = jax.tree.map(lambda x: x + 0.1, jax.jit(agent.initial_params)(KEY))
    for layer in ("dense", "vision_policy"):  # nothing but the map sees the images, or tells a cell from another
        params["params"][layer]["kernel"] *= 0

    @jax.jit
    def logits(row, column):
        images = [jnp.zeros((1, 1, *shape)) for shape in agent.image_shapes]
        images[-1] = images[-1].at[0, 0, row, column].set(1.0)
        side, is_first = jnp.zeros((1, 1, 2 + 4 + 64 + 1)), jnp.zeros((1, 1), bool)
        state = initial_core_state(agent.network, 1)
        return agent.network.apply(params, images, side, is_first, state)[0].vision_logits

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
    words = (*SMALL, f"network.lstm_norm={str(norm).lower()}", "network.forget_bias=2")
    agent = build("experiment=constant50_sub2_packed", *words)
    layer = "lstm_norm" if norm else "lstm_input"
    biases = jax.jit(lambda: agent.initial_params(KEY)["params"][layer]["bias"])()
    np.testing.assert_array_equal(biases.reshape(4, 16).T, np.broadcast_to([0, 2, 0, 0], (16, 4)))


@pytest.mark.parametrize("size", [80, 50, 35, 30, 25, 18, 16])
def test_the_nature_torso_leaves_out_no_pixel(size):
    random = np.random.default_rng(0)
    image = random.normal(size=(4, size, size, 1)).astype(np.float32)
    torso = make_torso(NetworkConfig())
    params = noise.params(torso.init, KEY, image)

    def total(image):
        features = torso.apply(params, image)
        return (features * random.normal(size=features.shape)).sum()

    assert np.all(np.abs(jax.jit(jax.grad(total))(image)).sum(0) > 0)


def test_what_strides_left_out_before():
    """The last four rows and columns of 80: `padding=valid`, as older runs were made."""
    image = jnp.ones((1, 80, 80, 1))
    torso = make_torso(NetworkConfig(padding="valid"))
    run, params = jax.jit(torso.apply), noise.params(torso.init, KEY, image)
    features = run(params, image)
    assert features.shape == (1, 6 * 6 * 64)
    np.testing.assert_array_equal(run(params, image.at[:, 76:].set(9.0).at[:, :, 76:].set(9.0)), features)


def test_a_split_unroll_is_the_whole():
    agent, run, params = build_small("experiment=constant50_sub2_packed")
    roi, side, is_first = inputs(agent, 6, 2)
    state = initial_core_state(agent.network, 2)
    whole, last = run(params, roi, side, is_first, state)
    first, middle = run(params, [x[:3] for x in roi], side[:3], is_first[:3], state)
    second, end = run(params, [x[3:] for x in roi], side[3:], is_first[3:], middle)
    joined = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), first, second)
    chex.assert_trees_all_close(joined, whole, atol=1e-5)
    chex.assert_trees_all_close(end, last, atol=1e-5)


def test_environments_do_not_mix_and_episodes_do_not_leak():
    agent, run, params = build_small("experiment=constant50_sub2_packed")
    roi, side, is_first = inputs(agent, 5, 2)
    state = initial_core_state(agent.network, 2)

    def value(image, t, b):
        output, _ = run(params, [image], side, is_first, state)
        return output.natural_value[t, b] + output.vision_value[t, b]

    reached = np.any(jax.grad(value)(roi[0], 4, 1) != 0, axis=(2, 3, 4))
    # Environment 1 starts an episode at step 2: steps 2..4 matter, nothing before and nobody else.
    np.testing.assert_array_equal(reached[:, 1], [False, False, True, True, True])
    assert not reached[:, 0].any()


@pytest.mark.parametrize("norm", [True, False])
def test_large_weights_drive_the_gates_to_their_ends_only_without_the_norm(norm):
    agent, run, params = build_small("experiment=constant50_sub2_packed", f"network.lstm_norm={str(norm).lower()}")
    roi, side, is_first = inputs(agent, 3, 2)
    state = initial_core_state(agent.network, 2)
    inner = params["params"]
    assert ("lstm_norm" in inner) == norm
    large = {"params": inner | {"lstm_input": jax.tree.map(lambda x: 1000.0 * x, inner["lstm_input"])}}
    before, after = (run(p, roi, side, is_first, state)[0].natural_value for p in (params, large))
    assert np.allclose(before, after, atol=1e-3) == norm


def test_the_initial_policies_are_about_uniform():
    agent, run, _ = build_small("experiment=constant70")
    params = jax.jit(agent.initial_params)(KEY)
    output, _ = run(params, *inputs(agent, 3, 2), initial_core_state(agent.network, 2))
    for logits in (output.natural_logits, output.vision_logits):
        probabilities = jax.nn.softmax(logits)
        np.testing.assert_allclose(probabilities, 1 / logits.shape[-1], atol=0.02)
