"""Gymnasium's pixel environments as frames, gray or in colour: `gymnasium:<id>`, the id as `gymnasium.make` takes it.

The keys of `env` that need an emulator do not apply: engine, threads, crop, full action space, skipped frames, no-ops,
lives, FIRE, sticky actions. An id may name the module that registers it: `gymnasium:my_package:MyGame-v0`.
"""

from __future__ import annotations

import functools

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import TimeLimit

from foajax.config.parse import brief, one_line, refuse
from foajax.config.schema import Config
from foajax.envs.base import first_step
from foajax.types import Outcome, TimeStep

LUMA = np.array([299, 587, 114])  # thousandths of red, green and blue in gray (ITU-R BT.601)


class GymnasiumEnvironment:
    """Copies of one Gymnasium environment as an `Environment`. They step one after another, in `recv`."""

    crop_top: int | None = None
    lives: np.ndarray | None = None

    def __init__(self, config: Config, *, num_envs: int, seed: int, render: bool) -> None:
        name = config.game.removeprefix("gymnasium:")
        if name.count(":") > 1 or name.startswith(":"):
            raise refuse("game", config.game, "gymnasium:<id> or gymnasium:<module>:<id>")
        if name.startswith("ALE/"):
            name = f"ale_py:{name}"
        make = functools.partial(gymnasium.make, name, disable_env_checker=True, **config.env.kwargs)

        def make_one() -> gymnasium.Env:
            env = make()
            if render and "rgb_array" in (env.metadata.get("render_modes") or ()):
                env.close()
                try:
                    env = make(render_mode="rgb_array")
                except TypeError:  # it does not take the argument
                    env = make()
            return TimeLimit(env, config.env.max_episode_steps)  # beside a limit of its own

        try:
            self._env = SyncVectorEnv([make_one] * num_envs, copy=False, autoreset_mode=AutoresetMode.NEXT_STEP)
        except (gymnasium.error.Error, ImportError, TypeError) as error:
            accepted = "the id of an environment, or gymnasium:<module>:<id> with the module that registers it"
            if isinstance(error, TypeError):
                accepted = "env.kwargs that the constructor takes"
            missing = getattr(error.__cause__ or error, "name", None) if isinstance(error, ImportError) else None
            why = f"{missing} is missing (pip install {missing})" if missing else one_line(error).rstrip(".")
            raise refuse("game", config.game, accepted, why=why) from None
        observations, actions = self._env.single_observation_space, self._env.single_action_space
        color = config.env.color
        is_pixels = isinstance(observations, spaces.Box) and _is_image(observations, color)
        if not (is_pixels and isinstance(actions, spaces.Discrete)):
            images = "[h, w, 3] where env.color=true" if color else "[h, w], [h, w, 1] or [h, w, 3]"
            spaces_here = f"{brief(observations)} and {brief(actions)}"
            accepted = f"an environment with discrete actions and uint8 images {images}, not {spaces_here}"
            raise refuse("game", config.game, accepted)
        self.num_envs, self.num_actions = num_envs, int(actions.n)
        self._frames = functools.partial(make_frames, frame_shape=config.env.frame_shape, color=color)
        self._first_action, self._seed, self._clip = int(actions.start), seed, config.env.clip_rewards

    def reset(self) -> tuple[TimeStep, Outcome]:
        """Begins all episodes, from the seed."""
        self._image, _ = self._env.reset(seed=self._seed)
        self._ended = np.zeros(self.num_envs, bool)
        return first_step(self._frames(self._image))

    def send(self, action: np.ndarray) -> None:
        """Keeps the actions for `recv`."""
        self._action = np.asarray(action) + self._first_action

    def recv(self) -> tuple[TimeStep, Outcome]:
        """Steps every environment."""
        self._image, score, terminated, truncated, _ = self._env.step(self._action)
        score = score.astype(np.float32)
        timestep = TimeStep(
            frame=self._frames(self._image),
            reward=np.sign(score) if self._clip else score,
            is_first=self._ended,
            is_terminal=terminated.copy(),
        )
        self._ended = terminated | truncated
        return timestep, Outcome(score=score, is_over=self._ended)

    def render(self) -> np.ndarray:
        """Returns what the environments render, uint8 [B, h, w, 3], if made with `render`; else what they observe."""
        if self._env.render_mode == "rgb_array":
            return np.stack(self._env.render())
        image = self._image if self._image.ndim == 4 else self._image[..., None]
        return np.broadcast_to(image, (*image.shape[:3], 3))

    def close(self) -> None:
        """Closes every environment."""
        self._env.close()


def gray_frames(images: np.ndarray, frame_shape: tuple[int, ...]) -> np.ndarray:
    """Turns images, uint8 [B, h, w], [B, h, w, 1] or [B, h, w, 3] (RGB), into frames, uint8 [B, H, W] of `frame_shape`.

    Gray by ITU-R BT.601, then resized by area means; both are rounded half up. Raises `ValueError` for other images.
    """
    if images.dtype != np.uint8 or not (images.ndim == 3 or (images.ndim == 4 and images.shape[-1] in (1, 3))):
        accepted = "uint8 [B, h, w], [B, h, w, 1] or [B, h, w, 3]"
        raise refuse("images", f"{images.dtype} {list(images.shape)}", accepted)
    if images.ndim == 4:
        images = (images @ LUMA + 500) // 1000 if images.shape[-1] == 3 else images[..., 0]
    rows, columns = (area_weights(*sizes) for sizes in zip(images.shape[1:], frame_shape, strict=True))
    return np.floor(rows @ images.astype(np.float32) @ columns.T + np.float32(0.5)).astype(np.uint8)


def make_frames(images: np.ndarray, frame_shape: tuple[int, ...], *, color: bool) -> np.ndarray:
    """Makes `gray_frames` or, with `color`, frames [B, H, W, 3] of RGB images, each channel resized in the same way."""
    if not color:
        return gray_frames(images, frame_shape)
    return np.stack([gray_frames(images[..., channel], frame_shape) for channel in range(3)], axis=-1)


@functools.cache
def area_weights(source: int, target: int) -> np.ndarray:
    """Returns [target, source] float32: the share of each source pixel in each target pixel, along one axis.

    Target pixel i covers source coordinates [i, i + 1) * source / target: a block mean where target divides source.
    Elsewhere border pixels count by the part that is covered. Each row sums to 1.
    """
    edges = np.arange(target + 1)[:, None] * source / target
    pixel = np.arange(source)[None, :]
    covered = np.minimum(edges[1:], pixel + 1) - np.maximum(edges[:-1], pixel)
    return (np.maximum(covered, 0) * target / source).astype(np.float32)


def _is_image(space: spaces.Box, color: bool) -> bool:
    pixel_shapes = [(3,)] if color else [(), (1,), (3,)]
    return space.dtype == np.uint8 and len(space.shape) in (2, 3) and space.shape[2:] in pixel_shapes
