"""The learner: both heads' losses on a minibatch of environments, and one optimiser step.

Minibatches are applied one after another, as the asynchronous workers' gradients were: a synchronous batch
would otherwise make `num_envs` times fewer updates a frame than the paper's threads.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from foajax import frames, losses, returns
from foajax.agent import Agent
from foajax.config import HeadConfig, LearnerConfig
from foajax.types import Params, Rollout, TrainState

Metrics = dict[str, Float[Array, ""]]


def initial_state(agent: Agent, optimizer: optax.GradientTransformationExtraArgs, key: PRNGKeyArray) -> TrainState:
    """State before the first update."""
    params = agent.initial_params(key)
    return TrainState(
        params=params,
        opt_state=optimizer.init(params),
        statistics=frames.initial_statistics(),
        updates=jnp.zeros((), jnp.int32),
        skipped=jnp.zeros((), jnp.int32),
    )


def minibatch(rollout: Rollout, index: Int[Array, ""], size: int) -> Rollout:
    """`size` environments of a rollout: columns index*size .. (index+1)*size - 1."""

    def columns(x: Array, axis: int) -> Array:
        return jax.lax.dynamic_slice_in_dim(x, index * size, size, axis)

    return Rollout(
        steps=jax.tree.map(lambda x: columns(x, 1), rollout.steps),
        core_state=jax.tree.map(lambda x: columns(x, 0), rollout.core_state),
    )


def loss(params: Params, agent: Agent, rollout: Rollout) -> tuple[Float[Array, ""], Metrics]:
    """The paper's total loss (section "Dual-head Loss Function"): both heads' value and policy losses."""
    config = agent.config.learner
    output = agent.unroll(params, rollout)
    steps = rollout.steps
    # Time is aligned here, once: transition i leads from row i to row i+1.
    is_terminal_t = steps.is_terminal[1:]
    mask_t = 1.0 - steps.is_first[1:].astype(jnp.float32)  # the step after an episode's end is nobody's
    transitions = (steps.reward[1:], is_terminal_t, mask_t)

    natural = _natural_targets(config.natural, *transitions, output.natural_value)
    total, metrics = _head_loss(
        config,
        config.natural,
        natural,
        logits=output.natural_logits[:-1],
        value=output.natural_value[:-1],
        action=steps.natural_action[:-1],
        behaviour_log_prob=steps.natural_log_prob[:-1],
    )
    metrics = {f"natural_{name}": value for name, value in metrics.items()}
    if output.vision_logits is not None and output.vision_value is not None:
        vision = _vision_targets(config, *transitions, output.vision_value)
        vision_total, vision_metrics = _head_loss(
            config,
            config.vision,
            vision,
            logits=output.vision_logits[:-1],
            value=output.vision_value[:-1],
            action=steps.vision_action[:-1],
            behaviour_log_prob=steps.vision_log_prob[:-1],
        )
        total = total + config.vision_weight * vision_total
        metrics |= {f"vision_{name}": value for name, value in vision_metrics.items()}
    return total, metrics | {"loss": total}


class Targets(NamedTuple):
    """What one head learns from, constants to its loss."""

    returns: Float[Array, "T B"]
    advantages: Float[Array, "T B"]
    mask_t: Float[Array, "T B"]  # 1 where the step enters the loss


def _natural_targets(head: HeadConfig, r_t: Array, is_terminal_t: Array, mask_t: Array, value: Array) -> Targets:
    def one(r_t, is_terminal_t, mask_t, v):
        discount_t = head.gamma * (1.0 - is_terminal_t)
        return Targets(
            returns=returns.n_step_returns(r_t, discount_t, mask_t, v[1:]),
            advantages=returns.generalized_advantages(r_t, discount_t, mask_t, v[:-1], v[1:], head.gae_lambda),
            mask_t=mask_t,
        )

    return jax.vmap(one, in_axes=1, out_axes=1)(r_t, is_terminal_t, mask_t, value)


def _vision_targets(config: LearnerConfig, r_t: Array, is_terminal_t: Array, mask_t: Array, value: Array) -> Targets:
    head = config.vision

    def one(r_t, is_terminal_t, mask_t, v):
        stream = (r_t, head.gamma * (1.0 - is_terminal_t), is_terminal_t, mask_t)
        return Targets(
            returns=returns.vision_returns(*stream, v[1:], bootstrap=config.vision_bootstrap),
            advantages=returns.vision_advantages(*stream, v[:-1], v[1:], head.gae_lambda),
            mask_t=returns.vision_stream(r_t, is_terminal_t, mask_t).loss_mask_t,
        )

    return jax.vmap(one, in_axes=1, out_axes=1)(r_t, is_terminal_t, mask_t, value)


def _head_loss(
    config: LearnerConfig,
    head: HeadConfig,
    targets: Targets,
    *,
    logits: Float[Array, "T B A"],
    value: Float[Array, "T B"],
    action: Int[Array, "T B"],
    behaviour_log_prob: Float[Array, "T B"],
) -> tuple[Float[Array, ""], Metrics]:
    """One head's policy, value and entropy terms; the only place where they are masked, reduced and weighted."""

    def mean(x: Float[Array, "T B"]) -> Float[Array, ""]:
        return losses.reduce_steps(x, targets.mask_t, reduction="mean")

    advantages = targets.advantages
    if config.normalize_advantages:
        centred = advantages - mean(advantages)
        advantages = centred / (jnp.sqrt(mean(centred**2)) + 1e-8)
    policy = losses.policy_loss(
        logits, action, advantages, behaviour_log_prob=behaviour_log_prob, clip_ratio=config.clip_ratio
    )
    error = losses.value_loss(value, targets.returns)
    entropy = losses.entropy(logits)
    total = policy - head.beta * entropy + config.value_weight * error
    metrics = {"policy_loss": mean(policy), "value_loss": mean(error), "entropy": mean(entropy), "value": mean(value)}
    return losses.reduce_steps(total, targets.mask_t, reduction=config.reduction), metrics


def update(
    agent: Agent,
    optimizer: optax.GradientTransformationExtraArgs,
    size: int,
    state: TrainState,
    rollout: Rollout,
    index: Int[Array, ""],
    is_first_pass: Bool[Array, ""],
) -> tuple[TrainState, Metrics]:
    """One optimiser step on minibatch `index` of a rollout.

    Where the loss or the gradient is not finite, parameters and optimiser stay as they were and the step is counted
    as skipped. So it is where a new parameter is not, but there the optimiser's averages go on: they have seen a
    finite gradient, and a step of theirs that is too large gets smaller. Frames enter the running statistics on the
    first pass over a rollout only.
    """
    part = minibatch(rollout, index, size)
    gradient, metrics = jax.grad(loss, has_aux=True)(state.params, agent, part)
    grad_norm = optax.tree.norm(gradient)
    accept = jnp.isfinite(metrics["loss"]) & jnp.isfinite(grad_norm)
    change, opt_state = optimizer.update(gradient, state.opt_state, state.params, accept=accept)
    params = optax.apply_updates(state.params, change)
    param_norm = optax.tree.norm(params)
    finite = accept & jnp.isfinite(param_norm)
    params = jax.tree.map(lambda new, old: jnp.where(finite, new, old), params, state.params)
    opt_state = opt_state._replace(count=state.opt_state.count + finite)
    most = agent.config.learner.max_grad_norm
    steps = part.steps
    statistics = frames.update_statistics(
        state.statistics,
        steps.frame_mean[:-1].reshape(-1),
        steps.frame_std[:-1].reshape(-1),
        jnp.broadcast_to(is_first_pass, steps.frame_mean[:-1].size),
    )
    skipped = jnp.where(finite, 0, state.skipped + 1)
    updates = state.updates + 1
    metrics |= {
        "grad_norm": grad_norm,
        "param_norm": param_norm,
        "clipped": (finite & (grad_norm > (jnp.inf if most is None else most))).astype(jnp.float32),
        "skipped": 1.0 - finite.astype(jnp.float32),
        "skipped_in_a_row": skipped,
        "skipped_updates": updates - opt_state.count,
    }
    state = TrainState(params=params, opt_state=opt_state, statistics=statistics, updates=updates, skipped=skipped)
    return state, metrics
