"""The update: what it learns where values are known, what it must leave alone, and one compilation."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from loops import SMALL, VIEW, Loop

from foajax.config import compose
from foajax.envs.make import make_environments
from foajax.learning import learner, losses
from foajax.learning.agent import Agent
from foajax.learning.programs import acting_keys, total_updates
from foajax.sensors.frames import PIXEL_DECAY
from foajax.training.collector import Collector, update_on


@pytest.fixture(scope="module")
def seek():
    """Both heads on the pure-JAX game, a few updates in."""
    loop = Loop("game=seek", "experiment=constant50_sub2_packed")
    loop.run(3)
    return loop


def test_act_and_update_compile_once(seek):
    seek.run(2)
    assert seek.programs.act._cache_size() == 1
    assert seek.programs.update._cache_size() == 1


def test_every_parameter_of_both_heads_gets_a_gradient(seek):
    (rollout,), _ = seek.collect()
    gradient = jax.jit(jax.grad(lambda params: seek.loss(params, rollout)[0]))(seek.state.params)
    for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
        assert np.any(leaf != 0), jax.tree_util.keystr(path)


def test_the_loss_is_the_sum_of_its_weighted_terms(seek):
    (rollout,), _ = seek.collect()
    total, metrics = seek.loss(seek.state.params, rollout)
    config = seek.config.learner
    expected = sum(
        weight
        * (
            metrics[f"{head}_policy_loss"]
            - getattr(config, head).entropy_weight * metrics[f"{head}_entropy"]
            + config.value_weight * metrics[f"{head}_value_loss"]
        )
        for head, weight in (("natural", 1.0), ("vision", config.vision_weight))
    )
    np.testing.assert_allclose(total, expected, rtol=1e-5)


APART = ["clip_ratio=0.2", "value_weight=0.7", "vision_weight=0.3", "credits_last_gaze=false"]
APART += ["natural.gamma=0.9", "natural.gae_lambda=0", "natural.entropy_weight=0.01"]
APART += ["vision.gamma=0.5", "vision.gae_lambda=0", "vision.entropy_weight=0.03"]


@pytest.mark.parametrize("normalises", [False, True])
def test_the_loss_is_that_of_each_step_where_episodes_end(seek, normalises):
    """Lambda is 0: an advantage is a reward, the next value and the own one. The vision head's reward comes later."""
    (rollout,), _ = seek.collect()
    random, is_first, is_terminal = np.random.default_rng(0), *np.zeros((2, 7, 8), bool)
    is_terminal[[3, 0, 6, 5], [3, 1, 6, 7]] = True
    is_first[[4, 1, 3, 6], [3, 1, 5, 7]] = True  # environment 5 is cut; 6 ends with the rollout
    reward, natural, vision = (random.normal(size=(7, 8)).astype(np.float32) for _ in range(3))
    behaviour = {"natural": natural - 1, "vision": vision - 2}
    new = {"reward": reward, "is_first": is_first, "is_terminal": is_terminal}
    new |= {f"{head}_log_prob": value for head, value in behaviour.items()}
    steps = rollout.steps._replace(**jax.tree.map(jnp.asarray, new))
    rollout = rollout._replace(steps=steps)
    words = [f"learner.{word}" for word in [*APART, f"normalize_advantages={normalises}"]]
    config = compose.compose([*SMALL, "game=seek", "experiment=constant50_sub2_packed", *words])
    agent = Agent(config, seek.agent.num_actions, seek.agent.crop_top)
    total, _ = jax.jit(lambda params: learner.loss(params, agent, rollout))(seek.state.params)

    output, expected = seek.unroll(seek.state.params, rollout), 0.0
    for head, weight in (("natural", 1.0), ("vision", 0.3)):
        own, value = getattr(config.learner, head), np.asarray(getattr(output, f"{head}_value"))
        advantage, learns, acts = np.zeros((6, 8)), np.zeros((6, 8), bool), np.zeros((6, 8), bool)
        for t, b in np.ndindex(6, 8):
            ends, later = is_terminal[t + 1, b], head == "vision"
            known = t < 5 and (ends or not is_first[t + 2, b])
            if is_first[t + 1, b] or (later and not known):
                continue
            earned = (0.0 if ends else reward[t + 2, b]) if later else reward[t + 1, b]
            advantage[t, b] = earned + own.gamma * (not ends) * value[t + 1, b] - value[t, b]
            learns[t, b], acts[t, b] = True, not (later and ends)
        log_p = np.asarray(jax.nn.log_softmax(getattr(output, f"{head}_logits")))[:-1]
        chosen = np.take_along_axis(log_p, np.asarray(getattr(steps, f"{head}_action"))[:-1, :, None], -1)[..., 0]
        ratio = np.exp(chosen - behaviour[head][:-1])
        scaled = (advantage - advantage[acts].mean()) / advantage[acts].std() if normalises else advantage
        gained = np.minimum(ratio * scaled, np.clip(ratio, 0.8, 1.2) * scaled)
        gained -= own.entropy_weight * (np.exp(log_p) * log_p).sum(-1)
        expected += weight * (0.7 * 0.5 * np.square(advantage[learns]).mean() - gained[acts].mean())
    np.testing.assert_allclose(total, expected, rtol=1e-4)


def test_values_learn_from_lambda_returns(seek):
    """They are the n-step returns where lambda is 1, and rewards with the next value where it is 0."""
    (rollout,), _ = seek.collect()

    def value_losses(target, gae_lambda):
        words = [f"learner.value_target={target}", f"learner.natural.gae_lambda={gae_lambda}"]
        config = compose.compose([*SMALL, "game=seek", "experiment=constant50_sub2_packed", *words])
        agent = Agent(config, seek.agent.num_actions, seek.agent.crop_top)
        _, metrics = jax.jit(lambda params: learner.loss(params, agent, rollout))(seek.state.params)
        return metrics["natural_value_loss"], metrics["vision_value_loss"]

    np.testing.assert_allclose(value_losses("lambda", 1.0), value_losses("n_step", 1.0), rtol=1e-5)
    steps, value = rollout.steps, seek.unroll(seek.state.params, rollout).natural_value
    error = steps.reward[1:] + seek.config.learner.natural.gamma * ~steps.is_terminal[1:] * value[1:] - value[:-1]
    expected = 0.5 * np.mean(np.square(error), where=~np.asarray(steps.is_first[1:]))
    np.testing.assert_allclose(value_losses("lambda", 0.0)[0], expected, rtol=1e-5)


def test_the_last_row_is_only_bootstrapped_from(seek):
    """Changing what the last row chose, or its vision value's target, changes nothing but the bootstrap."""
    (rollout,), _ = seek.collect()
    steps = rollout.steps
    other = steps._replace(
        natural_action=steps.natural_action.at[-1].add(1) % 2,
        vision_action=steps.vision_action.at[-1].add(1) % 5,
        natural_log_prob=steps.natural_log_prob.at[-1].set(-9.0),
    )
    same, _ = seek.loss(seek.state.params, rollout._replace(steps=other))
    np.testing.assert_array_equal(same, seek.loss(seek.state.params, rollout)[0])


def test_ignored_actions_do_not_matter(seek):
    """The step after an episode's end ignores its action: neither it nor its reward may enter the loss."""
    (rollout,), _ = seek.collect()
    steps = rollout.steps
    is_terminal = steps.is_terminal.at[3, 3].set(True)
    is_first = steps.is_first.at[4, 3].set(True)
    steps = steps._replace(is_terminal=is_terminal, is_first=is_first)
    changed = steps._replace(
        natural_action=steps.natural_action.at[3, 3].set(1 - steps.natural_action[3, 3]),
        vision_action=steps.vision_action.at[3, 3].set((steps.vision_action[3, 3] + 1) % 5),
        reward=steps.reward.at[4, 3].set(100.0),
    )
    before, after = (seek.loss(seek.state.params, rollout._replace(steps=s))[0] for s in (steps, changed))
    np.testing.assert_array_equal(before, after)


def test_a_minibatch_is_its_own_environments(seek):
    (rollout,), _ = seek.collect()
    part = learner.minibatch(rollout, jnp.int32(1), 4)
    np.testing.assert_array_equal(part.steps.reward, rollout.steps.reward[:, 1::2])
    np.testing.assert_array_equal(part.core_state.hidden, rollout.core_state.hidden[1::2])


@pytest.mark.parametrize("where", ["reward", "parameter"])
def test_what_is_not_finite_is_skipped_and_counted(seek, where):
    (rollout,), _ = seek.collect()

    def update(state, rollout):
        kept = jax.tree.map(jnp.copy, state)  # the update takes its argument's memory
        return seek.programs.update(kept, rollout, np.int32(0), np.bool_(True))

    state = seek.state
    if where == "reward":
        rollout = rollout._replace(steps=rollout.steps._replace(reward=rollout.steps.reward.at[3, 2].set(jnp.nan)))
    else:
        state = state._replace(params=jax.tree.map(lambda x: x.at[(0,) * x.ndim].set(jnp.inf), state.params))
    after, metrics = update(state, rollout)
    chex.assert_trees_all_equal((after.params, after.opt_state), (state.params, state.opt_state))
    assert metrics["skipped"] == 1 and after.skipped == state.skipped + 1
    assert metrics["skipped_updates"] == 1
    again, metrics = update(after, rollout)
    assert again.skipped == state.skipped + 2 and metrics["skipped_updates"] == 2
    (good,), _ = seek.collect()
    if where == "reward":
        then, metrics = update(again, good)
        assert then.skipped == 0 and metrics["skipped_updates"] == 2


def test_a_parameter_that_overflows_is_caught_in_the_update_that_would_make_it(seek):
    """Loss and gradient are finite, but the optimiser's memory makes a step of it that is not."""
    (rollout,), _ = seek.collect()
    state = jax.tree.map(jnp.copy, seek.state)
    state = state._replace(opt_state=state.opt_state._replace(mu=jax.tree.map(lambda x: x + 1e38, state.opt_state.mu)))
    before = jax.tree.map(jnp.copy, state)
    after, metrics = seek.programs.update(state, rollout, np.int32(0), np.bool_(True))
    assert np.isfinite(metrics["loss"]) and np.isfinite(metrics["grad_norm"])
    assert metrics["skipped"] == 1 and not np.isfinite(metrics["param_norm"])
    chex.assert_trees_all_equal(after.params, before.params)
    assert after.opt_state.count == before.opt_state.count and metrics["skipped_updates"] == 1


@pytest.mark.parametrize(("scale", "clipped"), [(0.0, 0), (1e4, 1), (np.nan, 0)])
def test_a_clipped_update_is_counted(scale, clipped):
    loop = Loop("game=seek", *VIEW, "learner.max_grad_norm=100")
    (rollout,), _ = loop.collect()
    rollout = rollout._replace(steps=rollout.steps._replace(reward=(rollout.steps.reward + 1) * scale))
    metrics = loop.programs.update(loop.state, rollout, np.int32(0), np.bool_(True))[1]
    assert metrics["clipped"] == clipped == (metrics["grad_norm"] > 100)


def test_frames_are_counted_once_however_many_passes():
    one, two = (Loop("game=seek", *VIEW, f"learner.num_epochs={passes}") for passes in (1, 2))
    one.run(1), two.run(1)
    np.testing.assert_allclose(one.state.statistics.weight, two.state.statistics.weight, rtol=1e-6)
    assert two.state.updates == 2 * one.state.updates


def test_by_pixel_the_statistics_hold_the_mean_frame():
    loop = Loop("game=seek", *VIEW, "network.normalization=pixel")
    rollouts, _ = loop.collect()
    seen = rollouts[0].steps.frames[0][:-1]
    assert seen.shape == (6, 1, 80, 80)
    state, _ = update_on(rollouts, loop.state, loop.programs, loop.config.learner)
    mean, _, weight = state.statistics
    np.testing.assert_allclose(mean / weight, seen.mean((0, 1)), atol=1e-3)
    np.testing.assert_allclose(weight, 1 - PIXEL_DECAY**48, rtol=1e-5)


def test_who_observes_knows_frames_and_learns_nothing():
    """The deviation is that of the last rollout: while the first was seen, the mean was not known."""
    loop, seen = Loop("game=seek", *VIEW, "network.normalization=pixel"), []
    params = jax.tree.map(np.array, loop.state.params)
    for _ in range(2):
        (rollout,), _ = loop.collect()
        seen.append([np.array(x[:-1]) for x in rollout.steps.frames])
        loop.state = loop.programs.observe(loop.state, rollout)
    mean, std, weight = loop.state.statistics
    np.testing.assert_allclose(weight, 1 - PIXEL_DECAY**96, rtol=1e-5)
    np.testing.assert_allclose(mean / weight, np.concatenate([seen[0][0], seen[1][0]]).mean((0, 1)), atol=1e-3)
    np.testing.assert_allclose(std / weight, seen[1][1].mean(), rtol=1e-5)
    chex.assert_trees_all_equal(loop.state.params, params)


def test_information_is_what_decisions_tell_of_what_was_seen(seek):
    """None where the policy is the same whatever is seen; all of it where every decision is certain."""
    (rollout,), _ = seek.collect()

    def information(scale):
        state = jax.tree.map(jnp.copy, seek.state)
        seen = seek.unroll(state.params, learner.minibatch(rollout, jnp.int32(0), 4))
        for head, logits in (("natural", seen.natural_logits), ("vision", seen.vision_logits)):
            weights = state.params["params"][f"{head}_policy"]
            # About their mean, so that which action is the likeliest does depend on what is seen.
            weights["bias"] = scale * (weights["bias"] - logits.mean((0, 1)))
            weights["kernel"] = weights["kernel"] * scale
        metrics = seek.programs.update(state, rollout, np.int32(0), np.bool_(True))[1]
        return [metrics[f"{head}_information"] for head in ("natural", "vision")], metrics

    alike, _ = information(0.0)
    np.testing.assert_allclose(alike, 0.0, atol=1e-6)
    certain, metrics = information(1e6)
    assert all(value > 0.1 for value in certain)
    np.testing.assert_allclose([metrics["natural_entropy"], metrics["vision_entropy"]], 0.0, atol=0.05)


def test_two_groups_see_what_each_would_alone():
    """Groups only interleave: the first of two acts as it would by itself."""
    loop = Loop("game=seek", *VIEW, "env.num_groups=2")
    alone = Collector(loop.agent, loop.programs, make_environments(loop.config, 0)[:1], seed=0)
    (expected,), _ = alone.collect(loop.state, 0)
    (first, second), _ = loop.collect()
    chex.assert_trees_all_equal(expected.steps, first.steps)
    assert first.steps.reward.shape == second.steps.reward.shape == (7, 4)
    loop.run(2)
    assert loop.programs.update._cache_size() == 1


def test_unrolling_a_rollout_gives_what_acting_saw(seek):
    """Clipped ratios are 1 before the first update only if both know the same memory, gaze and episodes."""
    (rollout,), _ = seek.collect()
    while not rollout.steps.is_first[1:].any():
        (rollout,), _ = seek.collect()
    assert np.any(rollout.core_state.hidden != 0)
    output = seek.unroll(seek.state.params, rollout)
    for head in ("natural", "vision"):
        actual = losses.log_prob(getattr(output, f"{head}_logits"), getattr(rollout.steps, f"{head}_action"))
        np.testing.assert_allclose(actual, getattr(rollout.steps, f"{head}_log_prob"), atol=1e-5)


def test_the_same_seed_gives_the_same_parameters_and_another_does_not():
    runs = [Loop("game=seek", *VIEW, f"seed={seed}") for seed in (0, 0, 1)]
    for loop in runs:
        loop.run(25)  # four updates each
    assert all(loop.state.updates == 100 for loop in runs)
    first, second, other = (jax.tree.leaves(loop.state.params) for loop in runs)
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))
    assert not all(np.array_equal(a, b) for a, b in zip(first, other, strict=True))


def test_each_actor_has_random_numbers_of_its_own_in_whichever_process_it_is():
    keys = lambda *of: jax.random.key_data(acting_keys(*of))  # noqa: E731
    np.testing.assert_array_equal(keys(0, 0, 4, 4), keys(0, 0, 0, 8)[4:])
    every = np.concatenate([keys(seed, group, 0, 8) for seed, group in ((0, 0), (0, 1), (1, 0))])
    assert len(np.unique(every, axis=0)) == 24


def test_the_schedule_counts_the_updates_of_a_rollout_that_has_begun():
    config = compose.compose([*SMALL, "learner.num_epochs=3", "train.env_steps=49"])  # rollouts of 48
    assert total_updates(Agent(config, 4, 34)) == 2 * 2 * 3


PROBE = [*VIEW, "learner.learning_rate=2e-3", "learner.natural.gamma=0.5", "train.env_steps=1000000"]


@pytest.mark.parametrize(
    "probe, value",
    [
        ("delay", 0.75),  # the mean of gamma, a step before the reward, and 1
        pytest.param("match", 1.0, marks=pytest.mark.slow),  # of the action that suits what is seen
    ],
)
def test_the_value_of_a_probe_is_learned(probe, value):
    loop = Loop(f"game=probe:{probe}", *PROBE)
    loop.run(250)
    learned = np.mean([row["natural_value"] for row in loop.metrics[-40:]])
    np.testing.assert_allclose(learned, value, atol=0.05)


@pytest.mark.slow
def test_the_core_learns_to_remember():
    """The best is a reward in four steps and a reset. Without memory it is 0, unless the last action serves as one."""
    loop = Loop("game=probe:memory", *PROBE, "learner.natural.gamma=0.9", "network.last_actions=false")
    assert loop.run(400) > 0.8 / 5
