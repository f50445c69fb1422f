"""Every core: one carry for whole and split unrolls, no leak between episodes, its gradient against a plain loop's."""

import functools

import chex
import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from foajax.config.compose import compose
from foajax.config.parse import ConfigError
from foajax.config.schema import NetworkConfig
from foajax.learning.agent import Agent
from foajax.networks.cores import CORES, make_core
from foajax.networks.torsos import make_torso

T, B, F, L = 7, 3, 5, 4
REMEMBER = [name for name in CORES if name != "none"]


@pytest.fixture(params=CORES)
def core(request):
    return made(request.param)


@functools.cache
def made(name, **kwargs):
    """The core, its parameters, inputs, episodes' starts, and a carry of noise."""
    core = make_core(NetworkConfig(core=name, lstm=L, core_kwargs=kwargs))
    random = np.random.default_rng(0)
    inputs = jnp.asarray(random.normal(size=(T, B, F)), jnp.float32)
    is_first = np.zeros((T, B), bool)
    is_first[0, 0] = is_first[3, 1] = is_first[4, 1] = True  # environment 2 never starts anew
    noise = lambda x: jnp.asarray(random.normal(size=x.shape), jnp.float32)  # noqa: E731
    state = jax.tree.map(noise, core.initial_state(B))
    params = jax.tree.map(noise, jax.eval_shape(core.init, jax.random.key(0), inputs, jnp.asarray(is_first), state))
    return jax.jit(core.apply), params, inputs, jnp.asarray(is_first), state


def test_a_split_unroll_is_the_whole(core):
    run, params, inputs, is_first, state = core
    whole, last = run(params, inputs, is_first, state)
    assert whole.shape == (T, B, L)
    first, middle = run(params, inputs[:3], is_first[:3], state)
    second, end = run(params, inputs[3:], is_first[3:], middle)
    np.testing.assert_allclose(jnp.concatenate([first, second]), whole, atol=1e-5)
    chex.assert_trees_all_close(end, last, atol=1e-5)


def test_episodes_and_environments_do_not_leak(core):
    run, params, inputs, is_first, state = core
    gradient = jax.jit(jax.grad(lambda x: run(params, x, is_first, state)[0][5, 1].sum()))
    reached = np.any(gradient(inputs) != 0, axis=-1)
    remembers = bool(jax.tree.leaves(state))
    np.testing.assert_array_equal(reached[:, 1], [False, False, False, False, remembers, True, False])
    assert not reached[:, [0, 2]].any()


def test_an_episodes_start_forgets_what_is_not_finite(core):
    run, params, inputs, is_first, state = core
    is_first = is_first.at[0].set(True)
    broken = jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), state)
    np.testing.assert_array_equal(run(params, inputs, is_first, broken)[0], run(params, inputs, is_first, state)[0])


@pytest.mark.parametrize("name", REMEMBER)
def test_a_carry_is_remembered_while_the_episode_lasts(name):
    run, params, inputs, is_first, state = made(name)
    reached = jax.jit(jax.grad(lambda s: (run(params, inputs, is_first, s)[0][-1] ** 2).sum()))(state)
    for part in jax.tree.leaves(reached):
        assert np.any(part[2] != 0) and not np.any(part[:2])


def gru(params, projected, is_first, hidden):
    outputs = []
    for t in range(T):
        hidden = jnp.where(is_first[t][:, None], 0.0, hidden)
        r, z, n = jnp.split(hidden @ params["recurrent"], 3, -1)
        reset, keep, new = jnp.split(projected[t], 3, -1)
        keep = jax.nn.sigmoid(keep + z)
        new = jnp.tanh(new + jax.nn.sigmoid(reset + r) * (n + params["bias"][None]))
        hidden = keep * hidden + (1 - keep) * new
        outputs.append(hidden)
    return jnp.stack(outputs)


def mingru(params, projected, is_first, hidden):
    outputs = []
    for t in range(T):
        keep, candidate = jnp.split(projected[t], 2, -1)
        keep = jax.nn.sigmoid(keep)
        hidden = keep * jnp.where(is_first[t][:, None], 0.0, hidden) + (1 - keep) * candidate
        outputs.append(hidden)
    return jnp.stack(outputs)


@pytest.mark.parametrize(("name", "loop"), [("gru", gru), ("mingru", mingru)])
def test_values_and_gradients_are_those_of_a_plain_loop(name, loop):
    run, params, inputs, is_first, state = made(name, norm=False)

    def plain(params, inputs, is_first, state):
        own = params["params"]
        projected = inputs @ own["input"]["kernel"] + own["input"]["bias"].reshape(1, 1, -1)
        return loop(own, projected, is_first, state), None

    def results(function):
        total = lambda p, x, s: jnp.sum(jnp.sin(function(p, x, is_first, s)[0]))  # noqa: E731
        outputs = jax.jit(function)(params, inputs, is_first, state)[0]
        return outputs, jax.jit(jax.grad(total, (0, 1, 2)))(params, inputs, state)

    chex.assert_trees_all_close(results(run), results(plain), rtol=1e-4, atol=1e-5)


def test_gradients_are_those_of_finite_differences(core):
    run, params, inputs, is_first, state = core
    total = jax.jit(lambda p, x, s: jnp.sum(jnp.sin(run(p, x, is_first, s)[0])))
    jax.test_util.check_grads(total, (params, inputs, state), order=1, modes=["rev"], eps=1e-2, rtol=0.05, atol=0.05)


@pytest.mark.parametrize("name", REMEMBER)
def test_the_gate_that_keeps_begins_open(name):
    core = make_core(NetworkConfig(core=name, lstm=L, forget_bias=2.0))
    inputs = jnp.zeros((1, 1, F)), jnp.zeros((1, 1), bool), core.initial_state(1)
    params = jax.jit(core.init)(jax.random.key(0), *inputs)
    norm = params["params"].get("norm", params["params"].get("lstm_norm"))
    assert sorted(np.unique(norm["bias"])) == [0.0, 2.0]


class Sum(nn.Module):
    """A core of one's own: the sum of all inputs since the episode began."""

    width: int
    scale: float = 1.0

    def initial_state(self, batch):
        return {"sum": jnp.zeros((batch, self.width))}

    def __call__(self, inputs, is_first, state):
        outputs = []
        for x, first in zip(inputs, is_first, strict=True):
            state = {"sum": self.scale * x + jnp.where(first[:, None], 0.0, state["sum"])}
            outputs.append(state["sum"])
        return jnp.stack(outputs), state


class Mean(nn.Module):
    """A torso of one's own: the image's mean."""

    @nn.compact
    def __call__(self, x):
        return x.mean((1, 2))


HERE = "test_cores"


def test_a_network_of_ones_own_parts():
    words = ["network.dense=0", "network.last_actions=false", f"network.torso={HERE}:Mean", f"network.core={HERE}:Sum"]
    words += ["network.core_kwargs.width=4", "network.core_kwargs.scale=2"]  # the mean, focal point and last reward
    agent = Agent(compose(["experiment=constant70_packed", *words]), 4, None)
    params = jax.jit(agent.initial_params)(jax.random.key(0))
    assert sorted(params["params"]) == ["natural_policy", "natural_value", "vision_policy", "vision_value"]
    assert jax.tree.map(jnp.shape, agent.initial_state(2).core_state) == {"sum": (2, 4)}


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("core", f"{HERE}:Nothing", "network.core=test_cores:Nothing: .*; accepted is package.module:Name"),
        (
            "core",
            f"{HERE}:Sum",
            "network.core=test_cores:Sum: missing a required argument: 'width'; accepted is arguments ",
        ),
        ("core", f"{HERE}:Mean", "network.core=test_cores:Mean: accepted is a Flax module with the methods of "),
        (
            "core",
            "no_such_module:Core",
            "network.core=no_such_module:Core: No module named .*; accepted is package.module:Name",
        ),
        (
            "core_kwargs",
            {"depth": 2},
            "network.core=lstm: got an unexpected keyword argument 'depth'; accepted is arguments width, ",
        ),
        ("torso", f"{HERE}:B", "network.torso=test_cores:B: accepted is package.module:Name of a class or a function"),
        ("torso", f"{HERE}:gru", "network.torso=test_cores:gru: .*; accepted is arguments "),
        ("widths", (32, 64), r"network.widths=\[32, 64\]: accepted is 3 numbers for network.torso=nature"),
    ],
)
def test_a_part_that_is_none_is_one_line(key, value, message):
    config = NetworkConfig(**{key: value})
    with pytest.raises(ConfigError, match=message) as caught:
        make_core(config) and make_torso(config)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("config", "shapes"),
    [
        ({"widths": (8, 16, 24)}, {"Convolution_0": (8, 8, 1, 8), "Convolution_2": (3, 3, 16, 24)}),
        ({"torso": "a3c", "widths": (4, 4, 8, 8)}, {"Convolution_3": (3, 3, 8, 8)}),
        ({"torso": "impala"}, {"Conv_0": (3, 3, 1, 16), "Conv_14": (3, 3, 32, 32)}),
        ({"torso": "impala", "widths": (8,)}, {"Conv_4": (3, 3, 8, 8)}),
    ],
)
def test_widths_are_a_torsos_channels(config, shapes):
    torso = make_torso(NetworkConfig(**config))
    params = jax.eval_shape(torso.init, jax.random.key(0), jnp.zeros((1, 80, 80, 1)))["params"]
    assert {name: params[name]["kernel"].shape for name in shapes} == shapes
