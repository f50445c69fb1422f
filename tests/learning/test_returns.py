"""Returns and advantages against the paper's sums, per stretch, on every short rollout there is."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from foajax.learning import returns

GAMMA, LAMBDA, T = 0.9, 0.7, 5


def array(*values):
    return jnp.asarray(values, jnp.float32)


# ----- every rollout of T transitions: what each state is decides the masks and the terminals


def event_lists():
    """What the states s_0 .. s_T are. After a terminal or truncated state comes the first of an episode."""
    for events in itertools.product(("inside", "terminal", "truncated", "life lost"), repeat=T + 1):
        ends = [e in ("terminal", "truncated") for e in events]
        resets_into_an_end = any(a and b != "inside" for a, b in zip(ends, events[1:], strict=False))
        if not resets_into_an_end and events[0] != "life lost":
            yield events


@pytest.fixture(scope="module")
def streams():
    """All of them as one batch, each with rewards and values of its own: arrays [N, T], values [N, T+1]."""
    events = np.array(list(event_lists()))
    rng = np.random.default_rng(0)
    is_terminal = np.isin(events[:, 1:], ("terminal", "life lost"))
    mask = (~np.isin(events[:, :-1], ("terminal", "truncated"))).astype(np.float32)
    return {
        "r": rng.normal(size=mask.shape).astype(np.float32),
        "discount": (GAMMA * ~is_terminal).astype(np.float32),
        "is_terminal": is_terminal,
        "mask": mask,
        "v": rng.normal(size=(len(mask), T + 1)).astype(np.float32),
    }


def test_streams_hold_the_cases_that_matter(streams):
    mask, is_terminal = streams["mask"], streams["is_terminal"]
    assert len(mask) == 360
    assert (mask.sum(1) == T).any() and (mask[:, 0] == 0).any() and (mask[:, -1] == 0).any()
    assert ((mask == 0).sum(1) >= 2).any(), "two short episodes in one rollout"
    cut = mask[:, 1:] == 0
    assert (cut & ~is_terminal[:, :-1]).any() and (cut & is_terminal[:, :-1]).any()
    assert is_terminal[:, -1].any() and (~cut & is_terminal[:, :-1]).any()


def stretches(mask, is_terminal):
    """(first, k): the states first .. first+k are one episode, as far as the rollout shows it."""
    first = None
    for i in range(T):
        if mask[i] and first is None:
            first = i
        if first is not None and (i + 1 == T or not mask[i + 1] or is_terminal[i]):
            yield first, i + 1 - first
            first = None


def natural_oracle(r, is_terminal, mask, v):
    """The paper's A^nat plus its baseline, and A^{GAE,nat}; one environment."""
    g, advantage = np.zeros(T), np.zeros(T)
    for first, k in stretches(mask, is_terminal):
        v_end = 0.0 if is_terminal[first + k - 1] else v[first + k]
        values = [*v[first : first + k], v_end]
        for t in range(k):
            rewards = [r[first + i] for i in range(t, k)]
            g[first + t] = sum(GAMMA**n * x for n, x in enumerate(rewards)) + GAMMA ** (k - t) * v_end
            deltas = [r[first + i] + GAMMA * values[i + 1] - values[i] for i in range(t, k)]
            advantage[first + t] = sum((GAMMA * LAMBDA) ** n * x for n, x in enumerate(deltas))
    return g, advantage


def vision_oracle(r, is_terminal, mask, v):
    """The paper's A^vis plus its baseline in both forms, A^{GAE,vis}, and where a gradient belongs."""
    consistent, literal, advantage, loss_mask = (np.zeros(T) for _ in range(4))
    for first, k in stretches(mask, is_terminal):
        ends = is_terminal[first + k - 1]
        consistent_seed = 0.0 if ends else v[first + k - 1]
        literal_seed = 0.0 if ends else GAMMA * v[first + k]
        for t in range(k):
            rewards = sum(GAMMA ** (i - t) * r[first + i + 1] for i in range(t, k - 1))
            consistent[first + t] = rewards + GAMMA ** (k - 1 - t) * consistent_seed
            literal[first + t] = rewards + GAMMA ** (k - 1 - t) * literal_seed
            deltas = [r[first + i + 1] + GAMMA * v[first + i + 1] - v[first + i] for i in range(t, k - 1)]
            deltas += [-v[first + k - 1]] if ends else []
            advantage[first + t] = sum((GAMMA * LAMBDA) ** n * x for n, x in enumerate(deltas))
            loss_mask[first + t] = (t < k - 1 or ends) and first + t != T - 1
    return consistent, literal, advantage, loss_mask


def oracle(function, streams):
    rows = zip(streams["r"], streams["is_terminal"], streams["mask"], streams["v"], strict=True)
    return [np.stack(column) for column in zip(*(function(*row) for row in rows), strict=True)]


def arguments(streams, *names):
    v = streams["v"]
    every = {**streams, "v_tm1": v[:, :-1], "v_t": v[:, 1:]}
    return [jnp.asarray(every[name]) for name in names]


@pytest.fixture(params=[False, True], ids=["eager", "jit"])
def batched(request):
    """Over the batch, jitted or not."""
    return lambda f: jax.jit(jax.vmap(f)) if request.param else jax.vmap(f)


def advantages_with(gae_lambda):
    return lambda *args: returns.generalized_advantages(*args, gae_lambda)


def vision_advantages_with(gae_lambda):
    return lambda *args: returns.vision_advantages(*args, gae_lambda)


def vision_returns_with(bootstrap):
    return lambda *args: returns.vision_returns(*args, bootstrap=bootstrap)


@jax.jit
def every_output(r, discount, is_terminal, mask, v_tm1, v_t):
    args = r, discount, is_terminal, mask
    return {
        "return": returns.n_step_returns(r, discount, mask, v_t),
        "advantage": returns.generalized_advantages(r, discount, mask, v_tm1, v_t, LAMBDA),
        "consistent": returns.vision_returns(*args, v_t, bootstrap="consistent"),
        "literal": returns.vision_returns(*args, v_t, bootstrap="literal"),
        "vision advantage": returns.vision_advantages(*args, v_tm1, v_t, LAMBDA),
    }


NATURAL = ("r", "discount", "mask", "v_tm1", "v_t")
VISION = ("r", "discount", "is_terminal", "mask", "v_tm1", "v_t")
VISION_RETURNS = ("r", "discount", "is_terminal", "mask", "v_t")


def test_natural_head_on_every_rollout(streams, batched):
    g, advantage = oracle(natural_oracle, streams)
    actual = batched(returns.n_step_returns)(*arguments(streams, "r", "discount", "mask", "v_t"))
    np.testing.assert_allclose(actual, g, atol=1e-5)
    actual = batched(advantages_with(LAMBDA))(*arguments(streams, *NATURAL))
    np.testing.assert_allclose(actual, advantage, atol=1e-5)


def test_vision_head_on_every_rollout(streams, batched):
    consistent, literal, advantage, loss_mask = oracle(vision_oracle, streams)
    stream = batched(returns.vision_stream)(*arguments(streams, "r", "is_terminal", "mask"))
    np.testing.assert_array_equal(stream.value_mask_t, loss_mask)

    actual = batched(vision_advantages_with(LAMBDA))(*arguments(streams, *VISION))
    np.testing.assert_allclose(actual * stream.mask_t, advantage * stream.mask_t, atol=1e-5)
    actual = batched(vision_returns_with("consistent"))(*arguments(streams, *VISION_RETURNS))
    np.testing.assert_allclose(actual * stream.mask_t, consistent * stream.mask_t, atol=1e-5)
    actual = batched(vision_returns_with("literal"))(*arguments(streams, *VISION_RETURNS))
    np.testing.assert_allclose(actual, literal, atol=1e-5)


# ----- identities, on the same rollouts


def test_lambda_one_gives_the_return_less_the_value(streams, batched):
    v_tm1, mask = arguments(streams, "v_tm1", "mask")
    g = batched(returns.n_step_returns)(*arguments(streams, "r", "discount", "mask", "v_t"))
    advantage = batched(advantages_with(1.0))(*arguments(streams, *NATURAL))
    np.testing.assert_allclose(advantage, mask * (g - v_tm1), atol=1e-5)


def test_vision_advantages_telescope_to_the_consistent_return(streams, batched):
    (v_tm1,) = arguments(streams, "v_tm1")
    g = batched(vision_returns_with("consistent"))(*arguments(streams, *VISION_RETURNS))
    stream = batched(returns.vision_stream)(*arguments(streams, "r", "is_terminal", "mask"))
    advantage = batched(vision_advantages_with(1.0))(*arguments(streams, *VISION))
    np.testing.assert_allclose(advantage, stream.mask_t * (g - v_tm1), atol=1e-5)


def test_lambda_zero_gives_the_td_error(streams, batched):
    r, discount, mask, v_tm1, v_t = arguments(streams, *NATURAL)
    advantage = batched(advantages_with(0.0))(r, discount, mask, v_tm1, v_t)
    np.testing.assert_allclose(advantage, mask * (r + discount * v_t - v_tm1), atol=1e-6)


def test_gamma_zero_leaves_each_head_its_own_reward(streams, batched):
    r, is_terminal, mask, v_t = arguments(streams, "r", "is_terminal", "mask", "v_t")
    none = jnp.zeros_like(r)
    np.testing.assert_allclose(batched(returns.n_step_returns)(r, none, mask, v_t), mask * r)
    stream = batched(returns.vision_stream)(r, is_terminal, mask)
    actual = batched(vision_returns_with("consistent"))(r, none, is_terminal, mask, v_t)
    follows = mask[:, :-1] * mask[:, 1:] * ~is_terminal[:, :-1]
    np.testing.assert_allclose((actual * stream.value_mask_t)[:, :-1], follows * r[:, 1:])


def test_nothing_crosses_the_end_of_an_episode():
    """States 0-2 are one episode (truncated at s_2), 3-6 another; no derivative links the two."""
    mask, is_terminal = array(1, 1, 0, 1, 1, 1), jnp.zeros(6, bool)

    def outputs(r, v):
        discount = jnp.full(6, GAMMA)
        return tuple(every_output(r, discount, is_terminal, mask, v[:-1], v[1:]).values())

    jacobians = jax.jit(jax.jacobian(outputs, (0, 1)))(jnp.arange(6.0), jnp.arange(7.0))
    for by_reward, by_value in jacobians:
        assert not by_reward[:2, 2:].any() and not by_reward[3:, :3].any()
        assert not by_value[:2, 3:].any() and not by_value[3:, :3].any()
        assert by_value[:2, :3].any() and by_value[3:, 3:].any()
        assert not by_reward[2].any() and not by_value[2].any(), "the reset itself"


# ----- exact values: a head that knows them sees no error, wherever the rollout is cut


@pytest.mark.parametrize("first", [0, 4, 7])
def test_exact_values_are_a_fixed_point(first):
    rewards = np.random.default_rng(1).normal(size=12).astype(np.float32)  # s_12 is terminal
    value = lambda r: array(*(sum(GAMMA**n * x for n, x in enumerate(r[i:])) for i in range(13)))  # noqa: E731
    v, v_vision = value(rewards), value([*rewards[1:], 0.0])
    window, after = slice(first, first + T), slice(first + 1, first + T + 1)
    r, is_terminal = jnp.asarray(rewards)[window], (jnp.arange(1, 13) == 12)[window]
    stream = (r, jnp.where(is_terminal, 0.0, GAMMA), is_terminal, jnp.ones(T))

    natural = every_output(*stream, v[window], v[after])
    np.testing.assert_allclose(natural["return"], v[window], atol=1e-5)
    np.testing.assert_allclose(natural["advantage"], 0.0, atol=1e-5)

    vision = every_output(*stream, v_vision[window], v_vision[after])
    known = returns.vision_stream(r, is_terminal, jnp.ones(T)).mask_t
    np.testing.assert_allclose(vision["consistent"] * known, v_vision[window] * known, atol=1e-5)
    np.testing.assert_allclose(vision["vision advantage"], 0.0, atol=1e-5)
    # The literal form skips the reward that comes after the rollout, and nothing else.
    skipped = 0.0 if first + T == 12 else rewards[first + T]
    expected = v_vision[window] - GAMMA ** np.arange(T)[::-1] * skipped
    np.testing.assert_allclose(vision["literal"], expected, atol=1e-5)


# ----- by hand: gamma 1/2, rewards 1 2 4 8, values 16 .. 20


def by_hand(mask=(1, 1, 1, 1), is_terminal=(0, 0, 0, 0)):
    is_terminal = jnp.asarray(is_terminal, bool)
    discount = jnp.where(is_terminal, 0.0, 0.5)
    return {"r": array(1, 2, 4, 8), "discount": discount, "is_terminal": is_terminal, "mask": array(*mask)}


def hand_vision(stream, bootstrap):
    args = stream["r"], stream["discount"], stream["is_terminal"], stream["mask"]
    return returns.vision_returns(*args, array(17, 18, 19, 20), bootstrap=bootstrap)


def test_natural_return_by_hand():
    stream = by_hand()
    g = returns.n_step_returns(stream["r"], stream["discount"], stream["mask"], array(17, 18, 19, 20))
    np.testing.assert_array_equal(g, [5.25, 8.5, 13, 18])


def test_natural_return_of_a_truncated_episode_by_hand():
    stream = by_hand(mask=(1, 1, 0, 1))
    g = returns.n_step_returns(stream["r"], stream["discount"], stream["mask"], array(17, 18, 19, 20))
    np.testing.assert_array_equal(g, [1 + 0.5 * 11, 2 + 0.5 * 18, 0, 8 + 0.5 * 20])


def test_natural_advantage_by_hand():
    stream = by_hand()
    args = stream["r"], stream["discount"], stream["mask"], array(16, 17, 18, 19), array(17, 18, 19, 20)
    # deltas -6.5 -6 -4.5 -1, decay 1/4
    np.testing.assert_array_equal(returns.generalized_advantages(*args, 0.5), [-8.296875, -7.1875, -4.75, -1])


def test_vision_return_by_hand():
    # r' = 2 4 8, then the seed: V(s_3) = 19, or 1/2 V(s_4) = 10
    np.testing.assert_array_equal(hand_vision(by_hand(), "consistent")[:3], [8.375, 12.75, 17.5])
    np.testing.assert_array_equal(hand_vision(by_hand(), "literal")[:3], [7.25, 10.5, 13])


@pytest.mark.parametrize("bootstrap", ["consistent", "literal"])
def test_vision_return_into_a_terminal_state_by_hand(bootstrap):
    stream = by_hand(is_terminal=(0, 0, 0, 1))
    np.testing.assert_array_equal(hand_vision(stream, bootstrap), [6, 8, 8, 0])


@pytest.mark.parametrize("bootstrap", ["consistent", "literal"])
def test_vision_reward_of_the_next_episode_is_not_credited(bootstrap):
    """s_2 is terminal, the third transition resets, and s_3 -> s_4 begins the next episode."""
    stream = by_hand(mask=(1, 1, 0, 1), is_terminal=(0, 1, 0, 0))
    np.testing.assert_array_equal(hand_vision(stream, bootstrap)[:2], [2, 0])
    shifted = returns.vision_stream(stream["r"], stream["is_terminal"], stream["mask"])
    np.testing.assert_array_equal(shifted.r_t, [2, 0, 8, 0])
    np.testing.assert_array_equal(shifted.value_mask_t, [1, 1, 0, 0])


def test_vision_return_of_a_truncated_episode_by_hand():
    """s_2 is the last state of an episode that is not over: a cut, as the rollout's end is one."""
    stream = by_hand(mask=(1, 1, 0, 1))
    assert hand_vision(stream, "consistent")[0] == 2 + 0.5 * 17
    np.testing.assert_array_equal(hand_vision(stream, "literal")[:2], [2 + 0.5 * 9, 9])
    shifted = returns.vision_stream(stream["r"], stream["is_terminal"], stream["mask"])
    np.testing.assert_array_equal(shifted.value_mask_t, [1, 0, 0, 0])


def test_no_frame_follows_the_visual_action_before_an_end(streams):
    r, is_terminal, mask = arguments(streams, "r", "is_terminal", "mask")
    every, useful = (
        jax.vmap(functools.partial(returns.vision_stream, credits_last=last))(r, is_terminal, mask)
        for last in (True, False)
    )
    np.testing.assert_array_equal(every.policy_mask_t, every.value_mask_t)
    np.testing.assert_array_equal(useful.value_mask_t, every.value_mask_t)
    np.testing.assert_array_equal(useful.policy_mask_t, every.value_mask_t * ~is_terminal)
    assert (useful.policy_mask_t != every.policy_mask_t).any()


def test_last_visual_action_gets_no_gradient(streams):
    stream = jax.vmap(returns.vision_stream)(*arguments(streams, "r", "is_terminal", "mask"))
    assert not np.asarray(stream.value_mask_t)[:, -1].any()
    assert np.asarray(stream.value_mask_t)[:, :-1].any(axis=0).all()
