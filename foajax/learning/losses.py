"""The terms of the loss, one number per step: [T, B], neither masked nor weighted.

The same functions serve the natural and the vision head. Masking, reduction (`reduce_steps`) and weights are
the learner's, in one place. Advantages, targets and the behaviour's log-probabilities are constants: no
gradient reaches what they were computed from.
"""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

# exp(20) is far beyond any clip ratio; larger exponents could overflow and turn masked steps into NaN.
_MAX_LOG_RATIO = 20.0


def log_prob(logits: Float[Array, "*N A"], action: Int[Array, "*N"]) -> Float[Array, "*N"]:
    """log pi(action) of a categorical policy; `action` in [0, A). A logit of -inf forbids its action."""
    # A select and a sum: the gradient of a gather is a scatter, which is slow on the CPU.
    chosen = jax.nn.one_hot(action, logits.shape[-1], dtype=bool)
    return jnp.sum(jnp.where(chosen, jax.nn.log_softmax(logits), 0.0), axis=-1)


def entropy(logits: Float[Array, "*N A"]) -> Float[Array, "*N"]:
    """Entropy of a categorical policy in nats, in [0, log A]: the paper's H(pi)."""
    log_p = jax.nn.log_softmax(logits)
    p = jnp.exp(log_p)
    # p log p is 0 at p = 0, where log p may be -inf.
    return -jnp.sum(p * jnp.where(p > 0, log_p, 0.0), axis=-1)


def policy_loss(
    logits: Float[Array, "*N A"],
    action: Int[Array, "*N"],
    advantage: Float[Array, "*N"],
    *,
    behaviour_log_prob: Float[Array, "*N"],
    clip_ratio: float | None,
) -> Float[Array, "*N"]:
    """Policy term of one head, without the entropy.

    Without `clip_ratio`, -log pi(a) A (the paper's L_policy; `behaviour_log_prob` is not used). With it, the
    clipped surrogate of PPO (Schulman et al. 2017, eq. 7), where mu is the policy that acted:

        -min(ratio A, clip(ratio, 1 - clip_ratio, 1 + clip_ratio) A),  ratio = min(pi(a) / mu(a), e^20)
    """
    advantage = jax.lax.stop_gradient(advantage)
    log_pi = log_prob(logits, action)
    if clip_ratio is None:
        return -log_pi * advantage
    log_ratio = log_pi - jax.lax.stop_gradient(behaviour_log_prob)
    ratio = jnp.exp(jnp.minimum(log_ratio, _MAX_LOG_RATIO))
    clipped = jnp.clip(ratio, 1.0 - clip_ratio, 1.0 + clip_ratio)
    return -jnp.minimum(ratio * advantage, clipped * advantage)


def value_loss(value: Float[Array, "*N"], target: Float[Array, "*N"]) -> Float[Array, "*N"]:
    """1/2 (target - value)^2: the paper's L_value with its 1/2 inside."""
    return 0.5 * jnp.square(jax.lax.stop_gradient(target) - value)


def reduce_steps(
    x: Float[Array, "T B"],
    mask_t: Float[Array, "T B"],
    *,
    reduction: Literal["mean", "sum"],
    steps: Int[Array, ""] | None = None,
    shards: int = 1,
) -> Float[Array, ""]:
    """Reduces a term of the loss to one number, over the steps where `mask_t` is not 0.

    `mean` is the mean over all these steps (0 where there is none); `sum` adds them up over time, as the
    paper does, and takes the mean over the B environments. Elsewhere `x` may hold anything, even NaN, as
    long as its own gradient there is finite.

    Where the environments are spread over `shards`, of B each, with `steps` valid steps in all (`valid_steps`), the
    result is one shard's part: the parts add up to the number.
    """
    total = jnp.sum(jnp.where(mask_t > 0, x, 0.0))
    if reduction == "sum":
        return total / (x.shape[1] * shards)
    return total / jnp.maximum(valid_steps(mask_t) if steps is None else steps, 1)


def valid_steps(mask_t: Float[Array, "T B"]) -> Int[Array, ""]:
    """Counts the steps that enter the loss."""
    return jnp.sum(mask_t > 0)
