"""Returns and advantages of both heads, on one stream of T transitions; the caller vmaps over environments.

Alignment. A rollout of T transitions visits the states s_0 .. s_T. Transition i = 0 .. T-1 leads from s_i to
s_{i+1}, and every array is indexed by transition:

- `r_t[i]`            reward R_{i+1} of that transition
- `discount_t[i]`     gamma, or 0 where s_{i+1} is terminal
- `is_terminal_t[i]`  whether s_{i+1} is terminal (asked for beside the discount because gamma may be 0)
- `mask_t[i]`         1, or 0 where the transition is an auto-reset: its action was ignored, and s_{i+1} is
                      the first state of a new episode
- `v_tm1[i]`, `v_t[i]`   V(s_i) and V(s_{i+1}): `v[:-1]` and `v[1:]` of the T+1 values

No chain crosses a masked transition. A truncated episode, one that ends without a terminal state, keeps its
discount into its last state and therefore bootstraps from that state's value, as the rollout does from s_T.

Nothing here stops a gradient: the losses treat what they are given as targets (`foajax.learning.losses`).
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def n_step_returns(
    r_t: Float[Array, " T"],
    discount_t: Float[Array, " T"],
    mask_t: Float[Array, " T"],
    v_t: Float[Array, " T"],
) -> Float[Array, " T"]:
    """The return from each s_i to the end of its episode or of the rollout, bootstrapped there.

    For i = T-1 .. 0:

        G_i = r_t[i] + discount_t[i] * (G_{i+1} if i+1 < T and mask_t[i+1] else v_t[i])
        G_i = 0 where mask_t[i] is 0

    This is the bracket in the paper's A^nat (section "Dual-head Loss Function"), its value loss's target.
    """
    continues_t = jnp.append(mask_t[1:], 0.0)
    ends_t = r_t + discount_t * (1.0 - continues_t) * v_t
    return _accumulate(mask_t * ends_t, mask_t * discount_t * continues_t)


def generalized_advantages(
    r_t: Float[Array, " T"],
    discount_t: Float[Array, " T"],
    mask_t: Float[Array, " T"],
    v_tm1: Float[Array, " T"],
    v_t: Float[Array, " T"],
    gae_lambda: float,
) -> Float[Array, " T"]:
    """Generalised advantage estimates (Schulman et al. 2016; the paper's A^{GAE,nat}).

    For i = T-1 .. 0, with A_T = 0:

        delta_i = mask_t[i] * (r_t[i] + discount_t[i] * v_t[i] - v_tm1[i])
        A_i     = delta_i + mask_t[i] * discount_t[i] * gae_lambda * A_{i+1}

    `gae_lambda` in [0, 1]: 0 gives the TD error, 1 gives `n_step_returns` less `v_tm1`. 0 where masked.
    """
    delta_t = mask_t * (r_t + discount_t * v_t - v_tm1)
    return _accumulate(delta_t, mask_t * discount_t * gae_lambda)


class VisionStream(NamedTuple):
    """A stream as the vision head is credited for it: see `vision_stream`."""

    r_t: Float[Array, " T"]  # r'_j, the reward one transition later
    mask_t: Float[Array, " T"]  # 1 where r'_j is known: what its chains run over
    value_mask_t: Float[Array, " T"]  # 1 where the value is learned from it
    policy_mask_t: Float[Array, " T"]  # 1 where the policy is


def vision_stream(
    r_t: Float[Array, " T"],
    is_terminal_t: Bool[Array, " T"],
    mask_t: Float[Array, " T"],
    *,
    credits_last: bool = True,
) -> VisionStream:
    """Credits each visual action with the next reward: it moves the gaze that the *next* action is based on.

    For j = 0 .. T-1, where s_{j+1} is the state that the action at s_j leads to:

        r'_j = r_t[j+1]  (R_{j+2})  if s_{j+1} is not terminal, j+1 < T and mask_t[j+1];  else 0
        known: s_{j+1} is terminal (nothing follows: r'_j is 0), or j+1 < T and mask_t[j+1]
        mask_t[j]  of the result = mask_t[j] and known;  value_mask_t is the same, but 0 at j = T-1;
        policy_mask_t too, and 0 where s_{j+1} is terminal unless `credits_last`

    The reward of the last visual action before a cut, be it the rollout's end or a truncation, is unknown and
    the action gets no gradient (the paper's sums end at k-2). Where s_T is terminal the reward is known to be
    0, which the chains use; that action gets no gradient either. No frame is seen after a terminal state, so the
    visual action before it cannot matter: `credits_last` learns from it all the same, which adds noise alone.
    """
    next_is_real_t = jnp.append(mask_t[1:], 0.0)
    not_terminal_t = 1.0 - is_terminal_t.astype(mask_t.dtype)
    known_t = mask_t * jnp.where(is_terminal_t, 1.0, next_is_real_t)
    value_mask_t = known_t.at[-1].set(0.0)
    return VisionStream(
        r_t=jnp.append(r_t[1:], 0.0) * next_is_real_t * not_terminal_t,
        mask_t=known_t,
        value_mask_t=value_mask_t,
        policy_mask_t=value_mask_t if credits_last else value_mask_t * not_terminal_t,
    )


def vision_returns(
    r_t: Float[Array, " T"],
    discount_t: Float[Array, " T"],
    is_terminal_t: Bool[Array, " T"],
    mask_t: Float[Array, " T"],
    v_t: Float[Array, " T"],
    *,
    bootstrap: Literal["consistent", "literal"],
) -> Float[Array, " T"]:
    """The vision head's return from each s_j, the target of its value loss where `value_mask_t` is 1.

    With r' of `vision_stream`, for each stretch of k transitions s_0 .. s_k up to a cut, j = k-2 .. 0:

        G_j = r'_j + gamma * G_{j+1}
        consistent:  G_{k-1} = V(s_{k-1})         literal:  G_{k-1} = gamma * V(s_k)
        both:        G_{k-1} = 0 where s_k is terminal

    *Literal* is the paper's printed A^vis (rewards to k-2, then gamma^k V); *consistent* agrees with its
    printed TD error: with lambda = 1 the printed advantages telescope to it. Either is `n_step_returns` of
    the shifted stream: *consistent* stops before the action whose reward is unknown, *literal* takes that
    reward to be 0.
    """
    stream = vision_stream(r_t, is_terminal_t, mask_t)
    chain_t = stream.mask_t if bootstrap == "consistent" else mask_t
    return n_step_returns(stream.r_t, discount_t, chain_t, v_t)


def vision_advantages(
    r_t: Float[Array, " T"],
    discount_t: Float[Array, " T"],
    is_terminal_t: Bool[Array, " T"],
    mask_t: Float[Array, " T"],
    v_tm1: Float[Array, " T"],
    v_t: Float[Array, " T"],
    gae_lambda: float,
) -> Float[Array, " T"]:
    """Generalised advantage estimates of the vision head (the paper's A^{GAE,vis}).

    `generalized_advantages` of the shifted stream: delta_j = r'_j + gamma V(s_{j+1}) - V(s_j) up to j = k-2
    of each stretch of k transitions, and at j = k-1 only where s_k is terminal (delta = -V(s_{k-1}), so that
    the value before the end cancels). With `gae_lambda` 1: the *consistent* `vision_returns` less `v_tm1`.
    """
    stream = vision_stream(r_t, is_terminal_t, mask_t)
    return generalized_advantages(stream.r_t, discount_t, stream.mask_t, v_tm1, v_t, gae_lambda)


def _accumulate(a: Float[Array, " T"], b: Float[Array, " T"]) -> Float[Array, " T"]:
    """Computes x_i = a[i] + b[i] * x_{i+1} for i = T-1 .. 0, with x_T = 0."""

    def step(x, row):
        x = row[0] + row[1] * x
        return x, x

    return jax.lax.scan(step, jnp.zeros((), a.dtype), (a, b), reverse=True)[1]
