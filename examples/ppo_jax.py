"""Learns what to do and where to look with PPO, in one file of plain JAX to read and to change.

    python ppo_jax.py --game pong --sensor constant70_packed --steps 1000000

The environments are ale-py's; the sensor and the gaze are foajax's; everything else is here. One policy chooses both
actions: its log-probability is the sum of theirs, and one value serves both. The network has no memory, so it sees the
last four frames.
"""

from __future__ import annotations

import argparse
import functools
import time

import jax
import jax.numpy as jnp
import numpy as np
import optax
from ale_py.vector_env import AtariVectorEnv

import foajax

T, EPOCHS, MINIBATCHES, GAMMA, LAMBDA, CLIP, ENTROPY = 128, 4, 4, 0.99, 0.95, 0.1, 0.01


def initial_params(key, shape, counts, width=256):
    """Makes parameters: two convolutions for an image [h, w, c], a dense layer, linear heads for policies and value."""

    def layer(key, *shape, scale=1.0):
        fan_in = np.prod(shape[:-1])
        return {"w": jax.random.normal(key, shape) * scale * np.sqrt(2 / fan_in), "b": jnp.zeros(shape[-1])}

    keys = jax.random.split(key, 4 + len(counts))
    params = {"conv1": layer(keys[0], 4, 4, shape[2], 32), "conv2": layer(keys[1], 3, 3, 32, 32)}
    features = jax.eval_shape(convolve, params, jax.ShapeDtypeStruct((1, *shape), jnp.float32)).shape[1]
    params["dense"] = layer(keys[2], features + 2, width)
    params["value"] = layer(keys[3], width, 1, scale=0.5)
    params["heads"] = [layer(key, width, n, scale=0.01) for key, n in zip(keys[4:], counts, strict=True)]
    return params


def convolve(params, image):
    for name in ("conv1", "conv2"):
        layout = ("NHWC", "HWIO", "NHWC")
        image = jax.lax.conv_general_dilated(image, params[name]["w"], (2, 2), "VALID", dimension_numbers=layout)
        image = jax.nn.relu(image + params[name]["b"])
    return image.reshape(len(image), -1)


def forward(params, image, focal_point):
    """Returns the logits of both policies, [N, A] and [N, V], and values [N]."""
    x = jnp.concatenate([convolve(params, image / 255.0), focal_point], axis=1)
    x = jax.nn.relu(x @ params["dense"]["w"] + params["dense"]["b"])
    logits = [x @ head["w"] + head["b"] for head in params["heads"]]
    return logits, (x @ params["value"]["w"] + params["value"]["b"])[:, 0]


def log_prob(logits, action):
    each = [jax.nn.log_softmax(x) for x in logits]
    return sum(jnp.take_along_axis(x, action[:, i : i + 1], axis=1)[:, 0] for i, x in enumerate(each))


@jax.jit
def act(params, key, image, focal_point):
    """Draws actions [N, 2]; returns them, their log-probabilities and the values."""
    logits, value = forward(params, image, focal_point)
    keys = jax.random.split(key, len(logits))
    action = jnp.stack([jax.random.categorical(k, x) for k, x in zip(keys, logits, strict=True)], axis=1)
    return action, log_prob(logits, action), value


def advantages(reward, value, terminated, ignored):
    """Returns generalised advantages [T, N]; `value` is [T+1, N].

    The step after an episode's end is ignored: no advantage passes it. So the value of an episode's last frame stands
    for what a truncated episode would still have earned.
    """
    found, last = np.zeros_like(reward), 0.0
    for t in reversed(range(len(reward))):
        delta = reward[t] + GAMMA * value[t + 1] * ~terminated[t] - value[t]
        found[t] = last = (delta + GAMMA * LAMBDA * last) * ~ignored[t]
    return found


def loss(params, batch):
    logits, value = forward(params, batch["image"], batch["focal_point"])
    ratio = jnp.exp(log_prob(logits, batch["action"]) - batch["log_prob"])
    counted, advantage = batch["counted"], batch["advantage"]
    mean = lambda x: (x * counted).sum() / jnp.maximum(counted.sum(), 1)  # noqa: E731
    advantage = (advantage - mean(advantage)) / (jnp.sqrt(mean((advantage - mean(advantage)) ** 2)) + 1e-8)
    policy = -jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * advantage)
    entropy = sum(-(jax.nn.softmax(x) * jax.nn.log_softmax(x)).sum(1) for x in logits)
    return mean(policy + 0.25 * (value - batch["return"]) ** 2 - ENTROPY * entropy)


@functools.partial(jax.jit, static_argnames="optimizer")
def update(params, state, batch, optimizer):
    gradient = jax.grad(loss)(params, batch)
    change, state = optimizer.update(gradient, state)
    return optax.apply_updates(params, change), state


def train(game="pong", sensor="constant70_packed", steps=1_000_000, num_envs=8, seed=0, report=print):
    """Trains; returns the parameters and all episodes' returns."""
    env = foajax.FoveatedVectorObservation(
        AtariVectorEnv(game, num_envs, stack_num=4), sensor, dtype=np.uint8, actions="multidiscrete"
    )
    key, random = jax.random.key(seed), np.random.default_rng(seed)
    shape = env.single_observation_space["image"].shape
    params = initial_params(jax.random.fold_in(key, 0), shape, env.single_action_space.nvec)
    optimizer = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(2.5e-4, eps=1e-5))
    state, begun, returns, score = optimizer.init(params), time.perf_counter(), [], np.zeros(num_envs)
    observation, _ = env.reset(seed=seed)
    ignored = np.zeros(num_envs, bool)  # the step after an episode's end restarts it, whatever the action
    for step in range(0, steps, T * num_envs):
        rows = []
        for t in range(T):
            seen = observation["image"], observation["focal_point"]
            action, logged, value = map(np.array, act(params, jax.random.fold_in(key, 1 + step + t), *seen))
            observation, reward, terminated, truncated, _ = env.step(action)
            rows.append((*seen, action, logged, value, reward.astype(np.float32), terminated, ignored))
            score, ignored = score + reward, terminated | truncated
            returns += score[ignored].tolist()
            score[ignored] = 0
        image, focal_point, action, logged, value, reward, over, skipped = map(np.stack, zip(*rows, strict=True))
        following = np.array(act(params, key, observation["image"], observation["focal_point"])[2])
        gained = advantages(reward, np.concatenate([value, following[None]]), over, skipped)
        batch = {"image": image, "focal_point": focal_point, "action": action, "log_prob": logged, "advantage": gained}
        batch |= {"return": gained + value, "counted": 1.0 - skipped}
        batch = {name: x.reshape(T * num_envs, *x.shape[2:]) for name, x in batch.items()}
        for _ in range(EPOCHS):
            for part in np.split(random.permutation(T * num_envs), MINIBATCHES):
                params, state = update(params, state, {name: x[part] for name, x in batch.items()}, optimizer)
        done = step + T * num_envs
        mean = f"{np.mean(returns[-100:]):.1f}" if returns else "none yet"
        report(f"{done} steps, {done / (time.perf_counter() - begun):.0f}/s, mean of 100 episodes: {mean}")
    env.close()
    return params, returns


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--game", default="pong")
    parser.add_argument("--sensor", default="constant70_packed")
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--num-envs", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    train(**vars(parser.parse_args()))
