"""Adam and AMSGrad as PyTorch's `torch.optim.Adam` defines them, with clipping and a schedule.

Why not `optax.amsgrad`: it takes the maximum of the bias-corrected second moment, PyTorch corrects after the
maximum; and no choice of its options scales eps as PyTorch does. The paper's shared Adam exists in
several versions; PyTorch's own rule is the one meant here.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from foajax.config.parse import refuse
from foajax.config.schema import LearnerConfig
from foajax.types import Params


class AdamState(NamedTuple):
    """What the optimiser remembers: the same tree for every configuration."""

    count: Int[Array, ""]  # type: ignore[assignment]  # updates made; hides tuple.count
    mu: Params  # moving average of the gradient
    nu: Params  # moving average of its square
    nu_max: Params  # largest nu so far, element by element, before bias correction; stays 0 for Adam


def make_optimizer(learner: LearnerConfig, total_updates: int) -> optax.GradientTransformationExtraArgs:
    """The optimiser of a run: clipping by global norm, Adam or AMSGrad, learning rate.

    The rate of update n = 1, 2, .. is `learning_rate`, times min(1, n / warmup_updates), times
    max(0, 1 - (n - 1) / total_updates) where `schedule` is `linear`. Raises `ConfigError` where `total_updates` is
    below 1.
    """
    if total_updates < 1:
        raise refuse("total_updates", total_updates, "an integer >= 1")

    def schedule(count):
        rate: Array | float = learner.learning_rate
        if learner.warmup_updates:
            rate *= jnp.minimum((count + 1) / learner.warmup_updates, 1.0)
        if learner.schedule == "linear":
            # The subtraction is in integers: the rate ends at 0 exactly, and never below.
            rate *= jnp.maximum(total_updates - count, 0) / total_updates
        return rate

    return adam(
        schedule,
        b1=learner.adam_b1,
        b2=learner.adam_b2,
        eps=learner.adam_eps,
        max_grad_norm=learner.max_grad_norm,
        full_rate_inputs=learner.full_rate_inputs,
        amsgrad=learner.amsgrad,
    )


def adam(
    schedule: optax.Schedule,
    *,
    b1: float,
    b2: float,
    eps: float,
    max_grad_norm: float | None,
    full_rate_inputs: int | None,
    amsgrad: bool,
) -> optax.GradientTransformationExtraArgs:
    """AMSGrad (Reddi et al. 2018) in PyTorch's form; without `amsgrad`, Adam (Kingma & Ba 2015).

    For update n = 1, 2, .. and gradient g, element by element:

        g      <- g * min(1, max_grad_norm / |g|)        |g| over the whole tree; skipped where None
        mu     <- b1 mu + (1 - b1) g
        nu     <- b2 nu + (1 - b2) g^2
        nu_max <- max(nu_max, nu)
        update  = -schedule(n - 1) / (1 - b1^n) * mu / (sqrt(nu_max) / sqrt(1 - b2^n) + eps)

    Adam has nu in the place of nu_max.

    With `full_rate_inputs`, the update of a layer's weights is multiplied by min(1, full_rate_inputs / inputs): a step
    of one size in every weight moves a unit the further, the more inputs it has (Yang et al. 2022, table 3).

    `update` takes one argument more than optax's: with `accept=False` the gradient, whatever it holds, changes
    nothing and the update is 0.

    Clipping is part of it so that the factor joins the same loops over the parameters, which on the CPU are
    memory traffic and nothing else.
    """

    def share(weights: Array) -> float:
        inputs = math.prod(weights.shape[:-1]) if weights.ndim > 1 else 1
        return 1.0 if full_rate_inputs is None else min(1.0, full_rate_inputs / inputs)

    def init(params: Params) -> AdamState:
        mu, nu, nu_max = (jax.tree.map(jnp.zeros_like, params) for _ in range(3))
        return AdamState(count=jnp.zeros((), jnp.int32), mu=mu, nu=nu, nu_max=nu_max)

    def update(
        grads: Params, state: AdamState, params: Params | None = None, *, accept: Bool[Array, ""] | bool = True
    ) -> tuple[Params, AdamState]:
        del params
        most = jnp.inf if max_grad_norm is None else max_grad_norm
        norm = optax.tree.norm(grads)
        scale = jnp.where(norm > most, most / norm, 1.0)
        # Where the gradient is not accepted these numbers leave everything as it is: no second pass picks old or new.
        grads = jax.tree.map(lambda g: jnp.where(accept, scale * g, 0.0), grads)
        keep1, keep2, rate = jnp.where(accept, jnp.array([b1, b2, schedule(state.count)]), jnp.array([1.0, 1.0, 0.0]))
        add1, add2 = jnp.where(accept, jnp.array([1 - b1, 1 - b2]), 0.0)
        rate = rate / _bias_correction(b1, state.count + 1)
        root = jnp.sqrt(_bias_correction(b2, state.count + 1))
        # The barriers keep XLA from computing a moment twice, which would cost a copy of its old value.
        mu = _done(jax.tree.map(lambda m, g: keep1 * m + add1 * g, state.mu, grads))
        nu = _done(jax.tree.map(lambda v, g: keep2 * v + add2 * g * g, state.nu, grads))
        nu_max = _done(jax.tree.map(jnp.maximum, state.nu_max, nu)) if amsgrad else state.nu_max
        second = nu_max if amsgrad else nu
        updates = jax.tree.map(lambda m, v: -rate * share(m) * m / (jnp.sqrt(v) / root + eps), mu, second)
        return updates, AdamState(count=state.count + accept, mu=mu, nu=nu, nu_max=nu_max)

    return optax.GradientTransformationExtraArgs(init, update)


def _done(tree: Params) -> Params:
    return jax.lax.optimization_barrier(tree)


def _bias_correction(decay: float, count: Int[Array, ""]) -> Float[Array, ""]:
    """1 - decay^count; `expm1` keeps the digits that a power of 0.999 in float32 would lose."""
    return -jnp.expm1(count * (math.log(decay) if decay > 0 else -math.inf))
