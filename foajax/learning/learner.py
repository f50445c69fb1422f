"""The learner: both heads' losses on a minibatch of environments, and one optimiser step.

Each minibatch is a step of its own. One step per rollout would make `num_envs` times fewer updates per frame than the
paper's asynchronous workers.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from foajax.config.schema import HeadConfig, LearnerConfig
from foajax.learning import losses, returns
from foajax.learning.agent import Agent
from foajax.sensors import frames
from foajax.types import Params, Rollout, TrainState

Metrics = dict[str, Float[Array, "..."]]


def initial_state(agent: Agent, optimizer: optax.GradientTransformationExtraArgs, key: PRNGKeyArray) -> TrainState:
    """Returns the train state before the first update."""
    params = agent.initial_params(key)
    return TrainState(
        params=params,
        opt_state=optimizer.init(params),
        statistics=agent.initial_statistics(),
        updates=jnp.zeros((), jnp.int32),
        skipped=jnp.zeros((), jnp.int32),
    )


def minibatch(rollout: Rollout, index: Int[Array, ""], size: int) -> Rollout:
    """Selects `size` environments of a rollout: every n-th column from `index` on, n = B / size.

    So a device that holds a multiple of n environments has its share of every minibatch, and which environments meet in
    one does not depend on how many devices share them. The frames' averages remain the rollout's.
    """

    def columns(x: Array, axis: int) -> Array:
        rows = x.reshape(*x.shape[:axis], size, x.shape[axis] // size, *x.shape[axis + 1 :])
        return jax.lax.dynamic_index_in_dim(rows, index, axis + 1, keepdims=False)

    each = rollout.steps._replace(frames=())
    return Rollout(
        steps=jax.tree.map(lambda x: columns(x, 1), each)._replace(frames=rollout.steps.frames),
        core_state=jax.tree.map(lambda x: columns(x, 0), rollout.core_state),
    )


def loss(
    params: Params, agent: Agent, rollout: Rollout, *, axis: str | None = None
) -> tuple[Float[Array, ""], Metrics]:
    """Returns the paper's total loss (section "Dual-head Loss Function"): both heads' value and policy losses.

    With `axis`, the mesh axis that the environments are spread along, the results are a device's parts of the sums.
    """
    config = agent.config.learner
    output = agent.unroll(params, rollout)
    steps = rollout.steps
    # Time is aligned here, once: transition i leads from row i to row i+1.
    is_terminal_t = steps.is_terminal[1:]
    mask_t = 1.0 - steps.is_first[1:].astype(jnp.float32)  # the step after an episode's end is nobody's
    transitions = (steps.reward[1:], is_terminal_t, mask_t)

    per_environment = functools.partial(jax.vmap, in_axes=1, out_axes=1)
    natural = functools.partial(_natural_targets, config.natural)
    heads = {"natural": per_environment(natural)(*transitions, output.natural_value)}
    if output.vision_value is not None:
        vision = functools.partial(_vision_targets, config)
        heads["vision"] = per_environment(vision)(*transitions, output.vision_value)
    masks = [(targets.policy_mask_t, targets.value_mask_t) for targets in heads.values()]
    valid = _whole(jnp.stack([jnp.stack([losses.valid_steps(mask) for mask in pair]) for pair in masks]), axis)
    totals: dict[str, Array] = {}
    metrics: Metrics = {}
    for i, (name, targets) in enumerate(heads.items()):
        totals[name], found = _head_loss(
            config,
            getattr(config, name),
            targets,
            valid[i],
            logits=getattr(output, f"{name}_logits")[:-1],
            value=getattr(output, f"{name}_value")[:-1],
            action=getattr(steps, f"{name}_action")[:-1],
            behaviour_log_prob=getattr(steps, f"{name}_log_prob")[:-1],
            axis=axis,
        )
        metrics |= {f"{name}_{metric}": value for metric, value in found.items()}
    total = totals["natural"]
    if "vision" in totals:
        total = total + config.vision_weight * totals["vision"]
    return total, metrics | {"loss": total}


class Targets(NamedTuple):
    """What one head learns from, constants to its loss."""

    returns: Float[Array, "T B"]  # n-step
    advantages: Float[Array, "T B"]
    policy_mask_t: Float[Array, "T B"]  # 1 where the step enters the policy's loss
    value_mask_t: Float[Array, "T B"]  # and the value's


def _natural_targets(head: HeadConfig, r_t: Array, is_terminal_t: Array, mask_t: Array, v: Array) -> Targets:
    """Computes the natural head's targets for one environment; every field is [T]."""
    discount_t = head.gamma * (1.0 - is_terminal_t)
    return Targets(
        returns=returns.n_step_returns(r_t, discount_t, mask_t, v[1:]),
        advantages=returns.generalized_advantages(r_t, discount_t, mask_t, v[:-1], v[1:], head.gae_lambda),
        policy_mask_t=mask_t,
        value_mask_t=mask_t,
    )


def _vision_targets(config: LearnerConfig, r_t: Array, is_terminal_t: Array, mask_t: Array, v: Array) -> Targets:
    """Computes the vision head's targets for one environment; every field is [T]."""
    head = config.vision
    stream = (r_t, head.gamma * (1.0 - is_terminal_t), is_terminal_t, mask_t)
    credited = returns.vision_stream(r_t, is_terminal_t, mask_t, credits_last=config.credits_last_gaze)
    return Targets(
        returns=returns.vision_returns(*stream, v[1:], bootstrap=config.vision_bootstrap),
        advantages=returns.vision_advantages(*stream, v[:-1], v[1:], head.gae_lambda),
        policy_mask_t=credited.policy_mask_t,
        value_mask_t=credited.value_mask_t,
    )


def _head_loss(
    config: LearnerConfig,
    head: HeadConfig,
    targets: Targets,
    valid: Int[Array, "2"],
    *,
    logits: Float[Array, "T B A"],
    value: Float[Array, "T B"],
    action: Int[Array, "T B"],
    behaviour_log_prob: Float[Array, "T B"],
    axis: str | None,
) -> tuple[Float[Array, ""], Metrics]:
    """Returns one head's loss and metrics. Only here are the terms masked, reduced and weighted.

    `valid` counts the steps that enter the policy's and the value's loss, on all devices.
    """
    shards = jax.lax.axis_size(axis) if axis else 1
    acts, values = (
        functools.partial(losses.reduce_steps, mask_t=mask, steps=steps, shards=shards)
        for mask, steps in zip((targets.policy_mask_t, targets.value_mask_t), valid, strict=True)
    )
    mean, mean_of_values = (functools.partial(reduce, reduction="mean") for reduce in (acts, values))
    advantages = targets.advantages
    target = targets.returns if config.value_target == "n_step" else value + advantages
    if config.normalize_advantages:
        centred = advantages - _whole(mean(advantages), axis)
        advantages = centred / (jnp.sqrt(_whole(mean(centred**2), axis)) + 1e-8)
    policy = losses.policy_loss(
        logits, action, advantages, behaviour_log_prob=behaviour_log_prob, clip_ratio=config.clip_ratio
    )
    error = losses.value_loss(value, target)
    entropy = losses.entropy(logits)
    total = acts(policy - head.entropy_weight * entropy, reduction=config.reduction)
    total += config.value_weight * values(error, reduction=config.reduction)
    log_ratio = losses.log_prob(logits, action) - behaviour_log_prob
    metrics = {
        "policy_loss": mean(policy),
        "value_loss": mean_of_values(error),
        "entropy": mean(entropy),
        "value": mean_of_values(value),
        "approx_kl": mean(jnp.expm1(log_ratio) - log_ratio),  # of the policy that acted from today's (Schulman 2020)
        "policy": jax.vmap(mean, in_axes=-1)(jax.nn.softmax(logits)),
        "moments": jax.vmap(mean_of_values)(jnp.stack([target, target**2, target - value, (target - value) ** 2])),
    }
    if config.clip_ratio is not None:
        outside = jnp.abs(jnp.expm1(log_ratio)) > config.clip_ratio
        metrics["clip_fraction"] = mean(outside.astype(jnp.float32))
    return total, metrics


def _whole(parts: Any, axis: str | None) -> Any:
    """Sums the devices' parts of a tree in one exchange, whose fixed cost is then paid once, not for each array."""
    if not axis:
        return parts
    flat, restore = ravel_pytree(parts)
    return restore(jax.lax.psum(flat, axis))


def _summed_up(metrics: Metrics) -> Metrics:
    """Replaces the means that were only parts of a metric of the whole minibatch.

    Each head's mean `policy` gives `information`: what its decisions tell of what was seen, in nats. It is the entropy
    of the mean policy less the mean entropy of the policies: 0 where an agent acts alike whatever it sees.

    The `moments` give `target_variance` and `error_variance`: see `explained_variance`.
    """
    kept = dict(metrics)
    # In the mapping's order: in a set's, which no two processes share, they would compile different programs.
    for head in [name.removesuffix("_policy") for name in metrics if name.endswith("_policy")]:
        p, moments = kept.pop(f"{head}_policy"), kept.pop(f"{head}_moments")
        kept[f"{head}_information"] = jnp.sum(jnp.where(p > 0, -p * jnp.log(p), 0.0)) - metrics[f"{head}_entropy"]
        kept[f"{head}_target_variance"] = moments[1] - moments[0] ** 2
        kept[f"{head}_error_variance"] = moments[3] - moments[2] ** 2
    return kept


def explained_variance(means: dict[str, float]) -> dict[str, float]:
    """Replaces each head's two variances by 1 - Var(target - value) / Var(target), which is 1 at best.

    It takes their means over updates, because a minibatch without any reward has targets that hardly differ.
    """
    kept = dict(means)
    for head in [name.removesuffix("_error_variance") for name in means if name.endswith("_error_variance")]:
        errors, targets = kept.pop(f"{head}_error_variance"), kept.pop(f"{head}_target_variance")
        kept[f"{head}_explained_variance"] = 1.0 - errors / max(targets, 1e-12)
    return kept


def observe(state: TrainState, rollout: Rollout, *, axis: str | None = None) -> TrainState:
    """Takes a rollout's frames into the running statistics and learns nothing.

    The deviation begins anew, because the earlier ones were measured from means that were not known yet.
    """
    averages, count = _frame_averages(rollout, axis)
    frame_mean, frame_std = _whole(averages, axis)
    statistics = frames.update_statistics(state.statistics, frame_mean, frame_std, count)
    return state._replace(statistics=statistics._replace(std=frame_std * statistics.weight))


def _frame_averages(rollout: Rollout, axis: str | None) -> tuple[tuple[Array, Array], int]:
    """Returns a device's part of a rollout's mean frame and deviation, and the number of frames on all devices."""
    shards = jax.lax.axis_size(axis) if axis else 1
    mean, std = (jnp.mean(x[:-1], (0, 1)) / shards for x in rollout.steps.frames)
    return (mean, std), rollout.steps.is_first[:-1].size * shards


def update(
    agent: Agent,
    optimizer: optax.GradientTransformationExtraArgs,
    size: int,
    state: TrainState,
    rollout: Rollout,
    index: Int[Array, ""],
    is_first_pass: Bool[Array, ""],
    *,
    axis: str | None = None,
) -> tuple[TrainState, Metrics]:
    """Makes one optimiser step on minibatch `index` of a rollout.

    If the loss or the gradient is not finite, parameters and optimiser stay as they were and the step is counted as
    skipped. If only a new parameter is not finite, it is skipped too, but the optimiser's averages go on: they saw a
    finite gradient, and later steps get smaller. Frames enter the running statistics on the first pass only.

    With `axis`, a mesh axis, `rollout` is a device's share and `size` its share of a minibatch; the state and the
    metrics are those of the whole, the same on every device.
    """
    part = minibatch(rollout, index, size)
    averages, frames_seen = _frame_averages(part, axis)
    results = jax.grad(loss, has_aux=True)(state.params, agent, part, axis=axis)
    (gradient, metrics), (frame_mean, frame_std) = _whole((results, averages), axis)
    metrics = _summed_up(metrics)
    grad_norm = optax.tree.norm(gradient)
    accept = jnp.isfinite(metrics["loss"]) & jnp.isfinite(grad_norm)
    change, opt_state = optimizer.update(gradient, state.opt_state, state.params, accept=accept)
    params = optax.apply_updates(state.params, change)
    param_norm = optax.tree.norm(params)
    finite = accept & jnp.isfinite(param_norm)
    params = jax.tree.map(lambda new, old: jnp.where(finite, new, old), params, state.params)
    opt_state = opt_state._replace(count=state.opt_state.count + finite)
    most = agent.config.learner.max_grad_norm
    statistics = frames.update_statistics(state.statistics, frame_mean, frame_std, is_first_pass * frames_seen)
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
