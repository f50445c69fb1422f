"""Adam by Optax, and AMSGrad as PyTorch's `torch.optim.Adam` defines it, with clipping and a schedule.

Why not `optax.amsgrad`: it takes the maximum of the bias-corrected second moment, PyTorch corrects after the
maximum; and no choice of its options scales eps as PyTorch does. The paper's shared Adam exists in
several versions; PyTorch's own rule is the one meant here. Why not `optax.apply_if_finite`: the learner refuses
an update for its loss and its new parameters too, and counts what it refused.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Int

from foajax.config.schema import LearnerConfig
from foajax.types import Params


class AdamState(NamedTuple):
    """The optimiser's state. Its tree is the same for every configuration and in checkpoints of any age."""

    count: Int[Array, ""]  # type: ignore[assignment]  # updates made; hides tuple.count
    mu: Params  # moving average of the gradient
    nu: Params  # moving average of its square
    nu_max: Params  # largest nu so far, element by element, before bias correction; stays 0 for Adam


def make_optimizer(learner: LearnerConfig, total_updates: int) -> optax.GradientTransformationExtraArgs:
    """Makes a run's optimiser: clipping by global norm; Adam (Kingma & Ba 2015) or AMSGrad (Reddi et al. 2018); rate.

    The rate of update n = 1, 2, .. is `learning_rate`, times min(1, n / warmup_updates), times
    max(0, 1 - (n - 1) / total_updates) where `schedule` is `linear`. With `full_rate_inputs`, the update of a layer's
    weights is multiplied by min(1, full_rate_inputs / inputs): the more inputs a unit has, the further it is moved by
    a step of one size in every weight (Yang et al. 2022, table 3).

    `update` takes one argument more than Optax's: with `accept=False` the gradient, whatever it holds, changes
    nothing and the update is 0.
    """
    most, b1, b2 = learner.max_grad_norm, learner.adam_b1, learner.adam_b2
    clip = optax.identity() if most is None else optax.clip_by_global_norm(most)
    adam = optax.scale_by_adam(b1, b2, learner.adam_eps)

    def share(weights: Array) -> float:
        inputs = math.prod(weights.shape[:-1]) if weights.ndim > 1 else 1
        return 1.0 if learner.full_rate_inputs is None else min(1.0, learner.full_rate_inputs / inputs)

    def init(params: Params) -> AdamState:
        count, mu, nu = adam.init(params)
        return AdamState(count=count, mu=mu, nu=nu, nu_max=jax.tree.map(jnp.zeros_like, params))

    def update(
        grads: Params, state: AdamState, params: Params | None = None, *, accept: Bool[Array, ""] | bool = True
    ) -> tuple[Params, AdamState]:
        del params
        grads, _ = clip.update(grads, optax.EmptyState())
        change, (count, mu, nu) = adam.update(grads, optax.ScaleByAdamState(state.count, state.mu, state.nu))
        nu_max = state.nu_max
        if learner.amsgrad:
            nu_max = jax.tree.map(jnp.maximum, nu_max, nu)
            first, second = optax.tree.bias_correction(mu, b1, count), optax.tree.bias_correction(nu_max, b2, count)
            change = jax.tree.map(lambda m, v: m / (jnp.sqrt(v) + learner.adam_eps), first, second)
        rate = -_rate(learner, total_updates, state.count)
        change = jax.tree.map(lambda u: jnp.where(accept, rate * share(u) * u, 0.0), change)
        after = AdamState(count=count, mu=mu, nu=nu, nu_max=nu_max)
        return change, jax.tree.map(lambda new, old: jnp.where(accept, new, old), after, state)

    return optax.GradientTransformationExtraArgs(init, update)


def _rate(learner: LearnerConfig, total_updates: int, count: Int[Array, ""]) -> Array | float:
    """Returns the learning rate after `count` updates."""
    rate: Array | float = learner.learning_rate
    if learner.warmup_updates:
        rate *= jnp.minimum((count + 1) / learner.warmup_updates, 1.0)
    if learner.schedule == "linear":
        # The subtraction is in integers: the rate ends at 0 exactly, and never below.
        rate *= jnp.maximum(total_updates - count, 0) / total_updates
    return rate
