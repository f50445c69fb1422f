"""The learner: both heads' losses on a minibatch of environments, and one optimiser step.

Minibatches are applied one after another, as the asynchronous workers' gradients were: a synchronous batch
would otherwise make `num_envs` times fewer updates a frame than the paper's threads.
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
    """State before the first update."""
    params = agent.initial_params(key)
    return TrainState(
        params=params,
        opt_state=optimizer.init(params),
        statistics=agent.initial_statistics(),
        updates=jnp.zeros((), jnp.int32),
        skipped=jnp.zeros((), jnp.int32),
    )


def minibatch(rollout: Rollout, index: Int[Array, ""], size: int) -> Rollout:
    """`size` environments of a rollout: every n-th column from `index` on, n = B / size.

    A slice of the rollout that holds a multiple of n environments thus has its share of every minibatch, and which
    environments meet in one does not depend on how many devices share them. The frames' averages remain the rollout's.
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
    """The paper's total loss (section "Dual-head Loss Function"): both heads' value and policy losses.

    With `axis`, the mesh axis that the environments are spread along, the results are a device's parts of the sums.
    """
    config = agent.config.learner
    output = agent.unroll(params, rollout)
    steps = rollout.steps
    # Time is aligned here, once: transition i leads from row i to row i+1.
    is_terminal_t = steps.is_terminal[1:]
    mask_t = 1.0 - steps.is_first[1:].astype(jnp.float32)  # the step after an episode's end is nobody's
    transitions = (steps.reward[1:], is_terminal_t, mask_t)

    heads = [_natural_targets(config.natural, *transitions, output.natural_value)]
    if output.vision_value is not None:
        heads.append(_vision_targets(config, *transitions, output.vision_value))
    valid = _whole(jnp.stack([losses.valid_steps(targets.mask_t) for targets in heads]), axis)
    total, metrics = _head_loss(
        config,
        config.natural,
        heads[0],
        valid[0],
        logits=output.natural_logits[:-1],
        value=output.natural_value[:-1],
        action=steps.natural_action[:-1],
        behaviour_log_prob=steps.natural_log_prob[:-1],
        axis=axis,
    )
    metrics = {f"natural_{name}": value for name, value in metrics.items()}
    if output.vision_logits is not None and output.vision_value is not None:
        vision_total, vision_metrics = _head_loss(
            config,
            config.vision,
            heads[1],
            valid[1],
            logits=output.vision_logits[:-1],
            value=output.vision_value[:-1],
            action=steps.vision_action[:-1],
            behaviour_log_prob=steps.vision_log_prob[:-1],
            axis=axis,
        )
        total = total + config.vision_weight * vision_total
        metrics |= {f"vision_{name}": value for name, value in vision_metrics.items()}
    return total, metrics | {"loss": total}


class Targets(NamedTuple):
    """What one head learns from, constants to its loss."""

    returns: Float[Array, "T B"]  # n-step
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
    valid: Int[Array, ""],
    *,
    logits: Float[Array, "T B A"],
    value: Float[Array, "T B"],
    action: Int[Array, "T B"],
    behaviour_log_prob: Float[Array, "T B"],
    axis: str | None,
) -> tuple[Float[Array, ""], Metrics]:
    """One head's policy, value and entropy terms; the only place where they are masked, reduced and weighted.

    `valid` counts the steps that enter, on all devices.
    """
    shards = jax.lax.axis_size(axis) if axis else 1
    reduce = functools.partial(losses.reduce_steps, mask_t=targets.mask_t, steps=valid, shards=shards)
    mean = functools.partial(reduce, reduction="mean")
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
    total = policy - head.beta * entropy + config.value_weight * error
    metrics = {"policy_loss": mean(policy), "value_loss": mean(error), "entropy": mean(entropy), "value": mean(value)}
    metrics["policy"] = jax.vmap(mean, in_axes=-1)(jax.nn.softmax(logits))
    return reduce(total, reduction=config.reduction), metrics


def _whole(parts: Any, axis: str | None) -> Any:
    """The sums of the devices' parts of a tree, in one exchange: its fixed cost is paid once, not for each array."""
    if not axis:
        return parts
    flat, restore = ravel_pytree(parts)
    return restore(jax.lax.psum(flat, axis))


def _with_information(metrics: Metrics) -> Metrics:
    """Each head's mean `policy` replaced by `information`: what its decisions tell of what was seen, in nats.

    The entropy of the mean policy less the mean entropy of the policies: 0 where an agent acts alike whatever it sees.
    """
    kept = dict(metrics)
    # In the mapping's order: in a set's, which no two processes share, they would compile different programs.
    for name in [name for name in metrics if name.endswith("_policy")]:
        head, p = name.removesuffix("_policy"), kept.pop(name)
        kept[f"{head}_information"] = jnp.sum(jnp.where(p > 0, -p * jnp.log(p), 0.0)) - metrics[f"{head}_entropy"]
    return kept


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
    """One optimiser step on minibatch `index` of a rollout.

    Where the loss or the gradient is not finite, parameters and optimiser stay as they were and the step is counted
    as skipped. So it is where a new parameter is not, but there the optimiser's averages go on: they have seen a
    finite gradient, and a step of theirs that is too large gets smaller. Frames enter the running statistics on the
    first pass over a rollout only.

    With `axis`, a mesh axis, `rollout` is a device's share and `size` its share of a minibatch; the state and the
    metrics are those of the whole, the same on every device.
    """
    part = minibatch(rollout, index, size)
    frames_seen = part.steps.is_first[:-1].size
    frame_mean, frame_std = (jnp.mean(x[:-1], (0, 1)) for x in part.steps.frames)
    results = jax.grad(loss, has_aux=True)(state.params, agent, part, axis=axis)
    if axis:
        shards = jax.lax.axis_size(axis)
        results, frame_mean, frame_std = _whole((results, frame_mean / shards, frame_std / shards), axis)
        frames_seen *= shards
    gradient, metrics = results
    metrics = _with_information(metrics)
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
