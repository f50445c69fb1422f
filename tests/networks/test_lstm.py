"""The LSTM against a step-by-step NumPy one; its written-out gradient against automatic differentiation."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from foajax.networks.lstm import lstm
from foajax.types import CoreState

T, B, L = 7, 3, 4


@pytest.fixture
def inputs():
    rng = np.random.default_rng(0)
    projected = jnp.asarray(rng.normal(size=(T, B, 4 * L)), jnp.float32)
    kernel = jnp.asarray(rng.normal(size=(L, 4 * L)), jnp.float32)
    is_first = np.zeros((T, B), bool)
    is_first[0, 0] = is_first[3, 1] = is_first[4, 1] = True  # environment 2 never starts anew
    state = CoreState(*(jnp.asarray(rng.normal(size=(B, L)), jnp.float32) for _ in range(2)))
    return projected, kernel, jnp.asarray(is_first), state


def numpy_lstm(projected, kernel, is_first, state):
    sigmoid = lambda x: 1 / (1 + np.exp(-x))  # noqa: E731
    projected, kernel = np.asarray(projected, np.float64), np.asarray(kernel, np.float64)
    cell, hidden = np.array(state.cell, np.float64), np.array(state.hidden, np.float64)
    out = np.zeros((T, B, L))
    for t in range(T):
        for b in range(B):
            if is_first[t, b]:
                cell[b], hidden[b] = 0, 0
            i, f, g, o = np.split(projected[t, b] + hidden[b] @ kernel, 4)
            cell[b] = sigmoid(f) * cell[b] + sigmoid(i) * np.tanh(g)
            hidden[b] = sigmoid(o) * np.tanh(cell[b])
            out[t, b] = hidden[b]
    return out, CoreState(cell=cell, hidden=hidden)


def autodiff_lstm(projected, kernel, is_first, state):
    """The same recurrence for JAX to differentiate by itself."""
    cell, hidden = state
    out = []
    for t in range(projected.shape[0]):
        keep = 1.0 - is_first[t].astype(jnp.float32)[:, None]
        i, f, g, o = jnp.split(projected[t] + (hidden * keep) @ kernel, 4, axis=-1)
        cell = jax.nn.sigmoid(f) * cell * keep + jax.nn.sigmoid(i) * jnp.tanh(g)
        hidden = jax.nn.sigmoid(o) * jnp.tanh(cell)
        out.append(hidden)
    return jnp.stack(out), CoreState(cell=cell, hidden=hidden)


@pytest.mark.parametrize("transform", [lambda f: f, jax.jit])
def test_it_follows_the_definition(inputs, transform):
    hidden, state = transform(lstm)(*inputs)
    expected, expected_state = numpy_lstm(*inputs)
    np.testing.assert_allclose(hidden, expected, atol=1e-5)
    np.testing.assert_allclose(state.cell, expected_state.cell, atol=1e-5)
    np.testing.assert_allclose(state.hidden, expected_state.hidden, atol=1e-5)


def test_its_gradient_is_the_recurrences(inputs):
    assert_same_gradient(*inputs)


def assert_same_gradient(projected, kernel, is_first, state):
    def total(function):
        def scalar(projected, kernel, state):
            hidden, last = function(projected, kernel, is_first, state)
            return jnp.sum(jnp.sin(hidden)) + jnp.sum(jnp.cos(last.cell)) + jnp.sum(last.hidden**2)

        return jax.jit(jax.grad(scalar, argnums=(0, 1, 2)))(projected, kernel, state)

    chex.assert_trees_all_close(total(lstm), total(autodiff_lstm), rtol=1e-4, atol=1e-5)


def test_two_halves_are_the_whole(inputs):
    projected, kernel, is_first, state = inputs
    whole, last = lstm(projected, kernel, is_first, state)
    first, middle = lstm(projected[:3], kernel, is_first[:3], state)
    second, end = lstm(projected[3:], kernel, is_first[3:], middle)
    np.testing.assert_allclose(jnp.concatenate([first, second]), whole, atol=1e-6)
    np.testing.assert_allclose(end.cell, last.cell, atol=1e-6)


def test_no_gradient_crosses_an_episodes_start(inputs):
    projected, kernel, is_first, state = inputs
    gradient = jax.grad(lambda p: jnp.sum(lstm(p, kernel, is_first, state)[0][4:]))(projected)
    assert np.all(gradient[:4, 1] == 0)  # environment 1 starts anew at step 4
    assert np.all(np.any(gradient[:4, [0, 2]] != 0, axis=(0, 2)))


def test_an_episodes_start_forgets_what_is_not_finite(inputs):
    projected, kernel, is_first, state = inputs
    broken = jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), state)
    hidden, _ = lstm(projected, kernel, is_first.at[0].set(True), broken)
    expected, _ = lstm(projected, kernel, is_first.at[0].set(True), state)
    np.testing.assert_array_equal(hidden, expected)


def test_a_long_sequence_runs_as_a_loop():
    rng = np.random.default_rng(3)
    projected = jnp.asarray(rng.normal(size=(20, 2, 4 * L)), jnp.float32)
    kernel = jnp.asarray(rng.normal(size=(L, 4 * L)) * 0.3, jnp.float32)
    is_first = jnp.zeros((20, 2), bool)
    state = CoreState(cell=jnp.zeros((2, L)), hidden=jnp.zeros((2, L)))
    one, other = (jax.jit(function)(projected, kernel, is_first, state)[0] for function in (lstm, autodiff_lstm))
    np.testing.assert_allclose(one, other, atol=1e-5)
    assert_same_gradient(projected, kernel, is_first, state)
