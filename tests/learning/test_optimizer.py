"""Adam and AMSGrad against PyTorch's rule in NumPy (and PyTorch itself where it is installed)."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from foajax.config.parse import replace
from foajax.config.schema import LearnerConfig
from foajax.learning.optimizer import make_optimizer

UPDATES = 200
RTOL = 1e-5  # Optax corrects the bias in float32, which loses some digits of 1 - 0.999
SHAPES = {"dense": {"kernel": (5, 3), "bias": (3,)}, "scale": ()}
PLAIN = LearnerConfig(
    learning_rate=0.01, full_rate_inputs=None, warmup_updates=0, schedule="constant", amsgrad=True, max_grad_norm=None
)


def is_shape(x):
    return isinstance(x, tuple)


def gradients():
    """Gradients that grow and shrink by a factor of a thousand, so that the maximum matters, and eps too."""
    rng = np.random.default_rng(0)
    for n in range(UPDATES):
        size = 10 ** (1.5 * np.sin(n / 15) - 2)
        yield jax.tree.map(lambda s, size=size: np.float32(size * rng.normal(size=s)), SHAPES, is_leaf=is_shape)


def pytorch_rule(learner, total_updates):
    """Yields each update of `torch.optim.Adam(amsgrad=learner.amsgrad)` after clipping by global norm, in float64."""
    b1, b2 = learner.adam_b1, learner.adam_b2
    m = v = v_max = None
    for step, tree in enumerate(gradients(), start=1):
        leaves = [np.float64(g) for g in jax.tree.leaves(tree)]
        if learner.max_grad_norm is not None:
            norm = np.sqrt(sum((g**2).sum() for g in leaves))
            leaves = [g * min(1.0, learner.max_grad_norm / norm) for g in leaves]
        g = np.concatenate([np.ravel(g) for g in leaves])
        m, v, v_max = (np.zeros_like(g),) * 3 if m is None else (m, v, v_max)
        lr = learner.learning_rate
        if learner.schedule == "linear":
            lr *= max(0.0, 1 - (step - 1) / total_updates)
        m = b1 * m + (1 - b1) * g
        v = b2 * v + (1 - b2) * g * g
        v_max = np.maximum(v_max, v) if learner.amsgrad else v
        denominator = np.sqrt(v_max) / np.sqrt(1 - b2**step) + learner.adam_eps
        yield -lr / (1 - b1**step) * m / denominator


def run(learner, total_updates, compiled=jax.jit):
    """Yields each update as one vector."""
    optimizer = make_optimizer(learner, total_updates)
    update = compiled(optimizer.update)
    params = jax.tree.map(jnp.ones, SHAPES, is_leaf=is_shape)
    state = optimizer.init(params)
    for grads in gradients():
        updates, state = update(jax.tree.map(jnp.asarray, grads), state, params)
        yield np.concatenate([np.ravel(u) for u in jax.tree.leaves(updates)])


@pytest.mark.parametrize("amsgrad", [True, False])
@pytest.mark.parametrize("eps", [1e-8, 1e-3])
@pytest.mark.parametrize("max_grad_norm", [None, 0.05])
@pytest.mark.parametrize("schedule", ["constant", "linear"])
def test_every_update_is_pytorchs(amsgrad, eps, max_grad_norm, schedule):
    learner = replace(PLAIN, amsgrad=amsgrad, adam_eps=eps, max_grad_norm=max_grad_norm, schedule=schedule)
    actual, expected = list(run(learner, 150)), list(pytorch_rule(learner, 150))
    assert len(actual) == UPDATES
    np.testing.assert_allclose(actual, expected, rtol=RTOL, atol=RTOL * learner.learning_rate)
    assert np.any(actual[150:]) == (schedule == "constant")


@pytest.mark.parametrize(("most", "share"), [(2, 2 / 5), (5, 1.0), (64, 1.0)])
def test_weights_with_many_inputs_move_in_inverse_proportion(most, share):
    whole = np.array(list(run(PLAIN, UPDATES)))
    scaled = np.array(list(run(replace(PLAIN, full_rate_inputs=most), UPDATES)))
    expected = whole * np.repeat([1.0, share, 1.0], [3, 15, 1])  # bias, kernel, scale
    np.testing.assert_allclose(scaled, expected, rtol=1e-6)


def test_other_decay_rates_and_no_jit():
    learner = replace(PLAIN, adam_b1=0.0, adam_b2=0.9, adam_eps=1e-3, max_grad_norm=0.05)
    actual = list(run(learner, 150, compiled=lambda f: f))
    expected = list(pytorch_rule(learner, 150))
    np.testing.assert_allclose(actual, expected, rtol=RTOL, atol=RTOL * learner.learning_rate)


@pytest.mark.parametrize("amsgrad", [True, False])
@pytest.mark.parametrize("eps", [1e-8, 1e-3])
def test_against_pytorch(amsgrad, eps):
    torch = pytest.importorskip("torch")
    param = torch.nn.Parameter(torch.zeros(19))
    optimizer = torch.optim.Adam([param], lr=PLAIN.learning_rate, eps=eps, amsgrad=amsgrad)
    total = np.zeros(19)
    learner = replace(PLAIN, adam_eps=eps, amsgrad=amsgrad)
    for update, grads in zip(run(learner, 1), gradients(), strict=True):
        param.grad = torch.tensor(np.concatenate([np.ravel(g) for g in jax.tree.leaves(grads)]))
        optimizer.step()
        total += update
        np.testing.assert_allclose(total, param.detach().numpy(), atol=1e-6)


# ----- by hand


def one_update(learner, grads):
    optimizer = make_optimizer(learner, 10)
    return optimizer.update(grads, optimizer.init(grads))


def test_first_update_by_hand():
    """After bias correction the moments are g and g^2: -lr g / (|g| + eps)."""
    learner = replace(PLAIN, learning_rate=0.5, adam_eps=1.0)
    updates, state = one_update(learner, {"w": jnp.array([3.0, -1.0, 0.0])})
    np.testing.assert_allclose(updates["w"], [-0.375, 0.25, 0.0], rtol=RTOL)
    np.testing.assert_allclose(state.mu["w"], [0.3, -0.1, 0.0], rtol=1e-6)
    np.testing.assert_allclose(state.nu["w"], [0.009, 0.001, 0.0], rtol=1e-6)


@pytest.mark.parametrize("max_grad_norm, expected", [(1.0, [0.06, 0.08]), (5.0, [0.3, 0.4]), (6.0, [0.3, 0.4])])
def test_clipping_by_hand(max_grad_norm, expected):
    """The gradient (3, 4) has norm 5, over both leaves; `mu` is a tenth of what is left of it."""
    learner = replace(PLAIN, max_grad_norm=max_grad_norm)
    _, state = one_update(learner, {"a": jnp.array(3.0), "b": jnp.array([4.0])})
    np.testing.assert_allclose([state.mu["a"], state.mu["b"][0]], expected, rtol=1e-6)


def test_zero_gradients_give_zero_updates():
    updates, _ = one_update(replace(PLAIN, max_grad_norm=0.5), {"w": jnp.zeros(3)})
    np.testing.assert_array_equal(updates["w"], 0.0)


def test_maximum_outlives_a_large_gradient():
    """This is what tells AMSGrad from Adam: afterwards the steps stay small."""
    learner = replace(PLAIN, adam_b1=0.0, adam_b2=0.5)
    optimizer = make_optimizer(learner, 10)
    state = optimizer.init(jnp.zeros(1))
    _, state = optimizer.update(jnp.array([100.0]), state)
    for _ in range(20):
        updates, state = optimizer.update(jnp.array([1.0]), state)
    assert state.nu_max == 0.5 * 100.0**2 and state.nu < 1.01
    np.testing.assert_allclose(updates, [-0.01 / np.sqrt(5000.0)], rtol=1e-5)


# ----- schedule, state, errors


def rates(total_updates, **learner):
    """The learning rates of six updates: without averages and eps an update is its rate."""
    learner = replace(PLAIN, adam_b1=0.0, adam_b2=0.0, adam_eps=1e-30, **learner)
    optimizer = make_optimizer(learner, total_updates)
    state = optimizer.init(jnp.zeros(1))
    sizes = []
    for _ in range(6):
        updates, state = optimizer.update(jnp.ones(1), state)
        sizes.append(-float(updates[0]))
    return sizes


def test_linear_schedule_ends_at_total_updates():
    np.testing.assert_allclose(rates(4, schedule="linear"), [0.01, 0.0075, 0.005, 0.0025, 0, 0], rtol=1e-6)


def test_warmup_rises_to_the_rate_and_joins_the_schedule():
    for schedule, expected in (
        ("constant", [1, 2, 3, 4, 4, 4]),
        ("linear", [1, 2 * 0.9, 3 * 0.8, 4 * 0.7, 4 * 0.6, 2]),
    ):
        np.testing.assert_allclose(
            rates(10, schedule=schedule, warmup_updates=4), 0.0025 * np.array(expected), rtol=1e-6
        )


def test_state_survives_being_stored_and_fits_every_configuration():
    clipped = replace(PLAIN, max_grad_norm=0.5, schedule="linear")
    grads = {"w": jnp.array([1.0, -2.0]), "b": jnp.array(3.0)}
    _, state = one_update(PLAIN, grads)
    leaves, tree = jax.tree.flatten(state)
    assert len(leaves) == 1 + 3 * 2 and all(isinstance(leaf, jax.Array) for leaf in leaves)
    assert tree == jax.tree.structure(make_optimizer(clipped, 10).init(grads))

    stored = jax.tree.unflatten(tree, [jnp.asarray(np.array(leaf)) for leaf in leaves])
    update = make_optimizer(PLAIN, 10).update
    for expected, actual in zip(*(jax.tree.leaves(update(grads, s)) for s in (state, stored)), strict=True):
        np.testing.assert_array_equal(actual, expected)


def test_state_can_be_donated():
    """The moments must not share a buffer, or an update could not take over the old state's memory."""
    optimizer = make_optimizer(PLAIN, 10)
    params = {"w": jnp.ones(3)}
    state = optimizer.init(params)
    step = jax.jit(optimizer.update, donate_argnums=1)
    updates, state = step({"w": jnp.ones(3)}, state)
    assert state.count == 1
    np.testing.assert_allclose(optax.apply_updates(params, updates)["w"], 0.99, rtol=1e-5)


@pytest.mark.parametrize("max_grad_norm", [None, 0.5])
@pytest.mark.parametrize("value", [np.nan, np.inf, 1.0])
def test_a_gradient_that_is_not_accepted_changes_nothing(max_grad_norm, value):
    optimizer = make_optimizer(replace(PLAIN, max_grad_norm=max_grad_norm), 10)
    params = {"a": jnp.array([1.0, -2.0]), "b": jnp.array(3.0)}
    for state in (optimizer.init(params), optimizer.update(params, optimizer.init(params))[1]):
        bad = jax.tree.map(lambda p: jnp.full_like(p, value), params)
        change, after = jax.jit(optimizer.update)(bad, state, accept=jnp.bool_(False))
        chex.assert_trees_all_equal(after, state)
        assert all((c == 0).all() for c in jax.tree.leaves(change))
