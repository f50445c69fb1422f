"""Records what the JAX agent does, to compare the exported one with it."""

from __future__ import annotations

import jax
import numpy as np

from foajax.config.schema import EnvConfig
from foajax.envs.base import send
from foajax.envs.gymnasium import make_frames
from foajax.runs.agents import TrainedAgent
from foajax.viewing import games

STEPS, GAMES = 200, 2  # the second game begins half way, with memory and gaze reset
_BLOCK = 5  # side of a block of one colour in the images: noise would make the file large


def record(stored: TrainedAgent, *, seed: int = 0) -> dict[str, np.ndarray]:
    """Records the first `STEPS` / 2 greedy decisions of two games, one game after the other: arrays [STEPS, ...].

    `frame` is what the environment shows, uint8; `is_first` says where memory and gaze begin anew. Further arrays
    `image_<i>` are colour images, uint8 [h, w, 3], and `frame_<i>` the frames that training would make of them.

    Raises:
      ConfigError: the game cannot be played here.
    """
    environment = games.environment(stored, num_envs=GAMES, seed=seed)
    state, key = stored.agent.initial_state(GAMES), jax.random.key(seed)
    rows: dict[str, list[np.ndarray]] = {}
    timestep, _ = environment.reset()
    for step in range(STEPS // GAMES):
        now = jax.random.fold_in(key, step)
        output, network, state = stored.act(stored.params, stored.statistics, state, timestep, now, greedy=True)
        row = {name: getattr(timestep, name) for name in ("frame", "reward", "is_first")}
        row |= {name: getattr(output, name) for name in ("focal_point", "natural_action", "vision_action")}
        row |= {name: getattr(network, name) for name in ("natural_logits", "vision_logits")}
        for name, value in row.items():
            if value is not None:
                rows.setdefault(name, []).append(np.array(value))
        send(environment, np.asarray(output.natural_action), output.focal_point)
        timestep, _ = environment.recv()
    environment.close()
    golden = {name: np.concatenate(np.stack(values, axis=1)) for name, values in rows.items()}
    return golden | _images(stored.agent.config.env, seed)


def _images(env: EnvConfig, seed: int) -> dict[str, np.ndarray]:
    """Makes two camera images, a little and much larger than the frame, by factors that are not whole."""
    frame_shape, random, arrays = env.frame_shape, np.random.default_rng(seed), {}
    for i, (height, width) in enumerate(((9, 3), (frame_shape[0] + 7, 2 * frame_shape[1] + 5))):
        size = frame_shape[0] + height, frame_shape[1] + width
        blocks = random.integers(0, 256, (*(-(-length // _BLOCK) for length in size), 3), np.uint8)
        image = blocks.repeat(_BLOCK, 0).repeat(_BLOCK, 1)[: size[0], : size[1]]
        arrays[f"image_{i}"] = image
        arrays[f"frame_{i}"] = make_frames(image[None], frame_shape, color=env.color)[0]
    return arrays
