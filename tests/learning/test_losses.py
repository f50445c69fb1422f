"""The loss terms against NumPy loops and hand-computed numbers; where their gradients go and do not go."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from foajax.learning import losses

T, B, A = 4, 3, 5
INF = np.inf


def array(*values):
    return jnp.asarray(values, jnp.float32)


@pytest.fixture(scope="module")
def steps():
    rng = np.random.default_rng(0)
    return {
        "logits": jnp.asarray(3 * rng.normal(size=(T, B, A)), jnp.float32),
        "action": jnp.asarray(rng.integers(A, size=(T, B))),
        "advantage": jnp.asarray(rng.normal(size=(T, B)), jnp.float32),
        "behaviour_log_prob": jnp.asarray(-rng.uniform(0.1, 4, size=(T, B)), jnp.float32),
    }


@pytest.fixture(params=[False, True], ids=["eager", "jit"])
def compiled(request):
    return jax.jit if request.param else lambda f: f


def numpy_log_prob(logits, action):
    logits, action = np.asarray(logits, np.float64), np.asarray(action)
    out = np.zeros(action.shape)
    for i in np.ndindex(action.shape):
        out[i] = logits[i][action[i]] - np.log(sum(np.exp(x) for x in logits[i]))
    return out


# ----- log-probability and entropy


def test_log_prob_is_that_of_each_step(steps, compiled):
    actual = compiled(losses.log_prob)(steps["logits"], steps["action"])
    np.testing.assert_allclose(actual, numpy_log_prob(steps["logits"], steps["action"]), atol=1e-5)


def test_log_prob_by_hand():
    logits = jnp.log(array([0.5, 0.25, 0.25], [0.1, 0.2, 0.7]))
    np.testing.assert_allclose(losses.log_prob(logits, jnp.array([1, 2])), np.log([0.25, 0.7]), rtol=1e-6)


def test_entropy_is_that_of_each_step(steps, compiled):
    every = [numpy_log_prob(steps["logits"], np.full((T, B), a)) for a in range(A)]
    expected = -sum(np.exp(log_p) * log_p for log_p in every)
    np.testing.assert_allclose(compiled(losses.entropy)(steps["logits"]), expected, atol=1e-5)


@pytest.mark.parametrize(
    "logits, expected",
    [
        ([7.0] * 4, np.log(4)),
        ([0.0, 1e4, 0.0, 0.0], 0.0),
        ([-3e38, 3e38, -3e38, -3e38], 0.0),
        ([0.0, -INF, -INF, 0.0], np.log(2)),
        ([0.0, -INF, -INF, -INF], 0.0),
    ],
)
def test_entropy_and_its_gradient_are_finite_at_the_limits(logits, expected):
    entropy, gradient = jax.value_and_grad(losses.entropy)(array(*logits))
    np.testing.assert_allclose(entropy, expected, atol=1e-6)
    np.testing.assert_allclose(gradient, 0.0, atol=1e-6)  # each of these is an extremum


def test_gradient_of_entropy(steps):
    logits = steps["logits"]
    p = np.asarray(jax.nn.softmax(logits))
    entropy = np.asarray(losses.entropy(logits))[..., None]
    gradient = jax.grad(lambda x: losses.entropy(x).sum())(logits)
    np.testing.assert_allclose(gradient, -p * (np.log(p) + entropy), atol=1e-5)


def test_log_prob_and_its_gradient_are_finite_at_the_limits():
    for logits in ([0.0, -INF, 0.0], [0.0, -1e4, 0.0]):
        value, gradient = jax.value_and_grad(losses.log_prob)(array(*logits), jnp.array(2))
        np.testing.assert_allclose(value, np.log(0.5), rtol=1e-6)
        np.testing.assert_allclose(gradient, [-0.5, 0.0, 0.5], atol=1e-6)
    assert losses.log_prob(array(0.0, -1e4), jnp.array(1)) == -1e4


# ----- the policy's loss


def plain_loss(logits, action, advantage, behaviour_log_prob):
    return losses.policy_loss(logits, action, advantage, behaviour_log_prob=behaviour_log_prob, clip_ratio=None)


def test_policy_loss_is_that_of_each_step(steps, compiled):
    actual = compiled(plain_loss)(**steps)
    expected = -numpy_log_prob(steps["logits"], steps["action"]) * np.asarray(steps["advantage"])
    np.testing.assert_allclose(actual, expected, atol=1e-5)


def test_gradient_of_the_policy_loss(steps):
    """A (pi - onehot), step by step: no step reaches another's logits, or the advantage."""

    def total(logits, advantage):
        return plain_loss(**{**steps, "logits": logits, "advantage": advantage}).sum()

    by_logits, by_advantage = jax.grad(total, (0, 1))(steps["logits"], steps["advantage"])
    expected = jax.nn.softmax(steps["logits"]) - jax.nn.one_hot(steps["action"], A)
    np.testing.assert_allclose(by_logits, steps["advantage"][..., None] * expected, atol=1e-5)
    assert not by_advantage.any()


def clipped_loss(logits, action, advantage, behaviour_log_prob):
    return losses.policy_loss(logits, action, advantage, behaviour_log_prob=behaviour_log_prob, clip_ratio=0.2)


def test_clipped_loss_is_that_of_each_step(steps, compiled):
    ratio = np.exp(numpy_log_prob(steps["logits"], steps["action"]) - np.asarray(steps["behaviour_log_prob"]))
    expected, advantage = np.zeros((T, B)), np.asarray(steps["advantage"])
    for i in np.ndindex(T, B):
        expected[i] = -min(ratio[i] * advantage[i], min(max(ratio[i], 0.8), 1.2) * advantage[i])
    assert (ratio < 0.8).any() and (ratio > 1.2).any()
    np.testing.assert_allclose(compiled(clipped_loss)(**steps), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    "ratio, advantage, loss, slope",
    [
        (1.0, 2.0, -2.0, -2.0),
        (1.1, 2.0, -2.2, -2.2),
        (1.5, 2.0, -2.4, 0.0),  # already far enough towards a good action
        (1.5, -2.0, 3.0, 3.0),
        (0.5, -2.0, 1.6, 0.0),  # already far enough from a bad one
        (0.5, 2.0, -1.0, -1.0),
    ],
)
def test_clipped_loss_by_hand(ratio, advantage, loss, slope):
    """`slope` is the derivative by log pi(a); by the first of two equal logits it is half of that."""
    behaviour = jnp.log(0.5 / array(ratio))
    args = jnp.zeros((1, 2)), jnp.array([0]), array(advantage), behaviour
    np.testing.assert_allclose(clipped_loss(*args), [loss], rtol=1e-6)
    gradient = jax.grad(lambda *args: clipped_loss(*args).sum())(*args)
    np.testing.assert_allclose(gradient, [[slope / 2, -slope / 2]], atol=1e-6)


def test_clipped_loss_starts_with_the_plain_gradient(steps):
    on_policy = {**steps, "behaviour_log_prob": losses.log_prob(steps["logits"], steps["action"])}
    gradient = lambda loss, args: jax.grad(lambda x: loss(**{**args, "logits": x}).sum())(args["logits"])  # noqa: E731
    actual, expected = gradient(clipped_loss, on_policy), gradient(plain_loss, steps)
    np.testing.assert_allclose(actual, expected, atol=1e-5)


def test_clipped_loss_gives_no_gradient_to_constants(steps):
    gradients = jax.grad(
        lambda advantage, behaviour: clipped_loss(steps["logits"], steps["action"], advantage, behaviour).sum(),
        (0, 1),
    )(steps["advantage"], steps["behaviour_log_prob"])
    assert not any(g.any() for g in gradients)


@pytest.mark.parametrize("advantage", [1.0, -1.0])
def test_clipped_loss_is_finite_for_any_ratio(advantage):
    for behaviour in (-200.0, 0.0):
        args = array([0.0, 0.0], [0.0, -300.0]), jnp.array([0, 1]), array(advantage, advantage)
        loss, gradient = jax.value_and_grad(lambda *args: clipped_loss(*args).sum())(*args, jnp.full(2, behaviour))
        assert np.isfinite(loss) and np.isfinite(gradient).all()


# ----- the value's loss


def test_value_loss_by_hand(compiled):
    value, target = array([1.0, 2.0], [3.0, 4.0]), array([3.0, 2.0], [0.0, 4.5])
    np.testing.assert_array_equal(compiled(losses.value_loss)(value, target), [[2, 0], [4.5, 0.125]])


def test_gradient_of_the_value_loss_reaches_the_value_alone():
    value, target = array([1.0, 2.0], [3.0, 4.0]), array([3.0, 2.0], [0.0, 4.5])
    gradients = jax.grad(lambda *args: losses.value_loss(*args).sum(), (0, 1))(value, target)
    np.testing.assert_array_equal(gradients[0], value - target)
    assert not gradients[1].any()


# ----- reduction

X = array([1.0, 20.0], [4.0, 30.0], [1000.0, 40.0])
MASK = array([1.0, 1.0], [1.0, 0.0], [0.0, 1.0])


@pytest.mark.parametrize("reduction, expected", [("mean", 65 / 4), ("sum", 65 / 2)])
def test_reduction_by_hand(reduction, expected, compiled):
    reduce = compiled(lambda x, mask: losses.reduce_steps(x, mask, reduction=reduction))
    np.testing.assert_allclose(reduce(X, MASK), expected, rtol=1e-6)


@pytest.mark.parametrize("reduction, weight", [("mean", 1 / 4), ("sum", 1 / 2)])
def test_masked_steps_have_no_part_even_where_they_are_nan(reduction, weight):
    x = jnp.where(MASK > 0, X, jnp.nan)
    value, gradient = jax.value_and_grad(losses.reduce_steps)(x, MASK, reduction=reduction)
    np.testing.assert_allclose(value, 65 * weight, rtol=1e-6)
    np.testing.assert_allclose(gradient, MASK * weight)


@pytest.mark.parametrize("reduction", ["mean", "sum"])
def test_no_step_at_all_gives_zero(reduction):
    assert losses.reduce_steps(X, jnp.zeros_like(MASK), reduction=reduction) == 0
