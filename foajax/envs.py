"""Environments of every engine behind one interface: EnvPool's Atari, ale-py's, Gymnasium's, and our own in JAX.

All of them show an episode's end the same way (*next-step* auto-reset): the step that ends an episode gives its last
frame, the step after it ignores its action and gives the next episode's first frame, with `is_first` and reward 0.
A lost life ends the learner's episode (`is_terminal`) where `env.episodic_life`, the game goes on. A step limit ends
an episode without a terminal: something would have followed.
"""

from __future__ import annotations

import difflib
from typing import Protocol, runtime_checkable

import envpool
import numpy as np

from foajax import jax_envs, seek
from foajax.config import Config, ConfigError, EnvConfig
from foajax.types import Outcome, TimeStep

SCREEN = (210, 160)  # rows, columns of the Atari 2600


@runtime_checkable
class Environment(Protocol):
    """A batch of equal environments, stepped together by the host. Arrays handed out stay as they are."""

    num_envs: int
    num_actions: int
    screen_shape: tuple[int, ...]  # of a frame without the batch
    crop_top: int | None  # first of the 160 screen rows kept; None where the screen is the frame

    def reset(self) -> tuple[TimeStep, Outcome]:
        """Begins all episodes; once, before the first step."""

    def send(self, action: np.ndarray) -> None:
        """Starts a step with natural actions, int32 [B], and returns."""

    def recv(self) -> tuple[TimeStep, Outcome]:
        """The step that `send` started, once all environments are through; NumPy arrays."""

    def close(self) -> None:
        """Ends the engine."""


def make(config: Config, *, num_envs: int, seed: int) -> Environment:
    """The environment of `config.game`; ConfigError where there is none of that name."""
    game = config.game
    if game == "seek":
        return jax_envs.JaxEnvironment(seek.task(config.env.frame_shape), num_envs=num_envs, seed=seed)
    return EnvPoolAtari(game, config.env, num_envs=num_envs, seed=seed)


class EnvPoolAtari(Environment):
    """EnvPool's Atari: env i is seeded with `seed + i`; its reset ignores seeds."""

    def __init__(self, game: str, env: EnvConfig, *, num_envs: int, seed: int) -> None:
        self._pool = envpool.make(
            _task_id(game),
            env_type="gymnasium",
            num_envs=num_envs,
            num_threads=env.threads,
            seed=seed,
            stack_num=1,
            gray_scale=True,
            img_height=SCREEN[0],
            img_width=SCREEN[1],
            frame_skip=env.frame_skip,
            # EnvPool draws the number of no-ops from [0, noop_max - 1] and crashes where that is empty.
            noop_max=env.noop_max + 1,
            use_fire_reset=env.fire_on_reset,
            reward_clip=env.clip_rewards,
            episodic_life=env.episodic_life,
            repeat_action_probability=env.sticky_actions,
            max_episode_steps=env.max_episode_steps,
        )
        self.num_envs = num_envs
        self.num_actions = int(self._pool.action_space.n)
        self.screen_shape = SCREEN
        self.crop_top = env.crop_top.get(game, env.crop_top["default"])
        self._ids = np.arange(num_envs, dtype=np.int32)
        self._ended = np.zeros(num_envs, bool)

    def reset(self) -> tuple[TimeStep, Outcome]:
        """Begins all games."""
        screen, _ = self._pool.reset()
        zeros, ones = np.zeros(self.num_envs, np.float32), np.ones(self.num_envs, bool)
        return TimeStep(screen[:, 0], zeros, ones, ~ones), Outcome(score=zeros, is_over=~ones)

    def send(self, action: np.ndarray) -> None:
        """Starts a step in EnvPool's threads."""
        self._pool.send(np.asarray(action, np.int32), self._ids)

    def recv(self) -> tuple[TimeStep, Outcome]:
        """All environments' step, in their own order whatever order they finished in."""
        screen, reward, terminated, truncated, info = self._pool.recv()
        order = np.argsort(info["env_id"], kind="stable")
        terminated, truncated = terminated[order], truncated[order]
        timestep = TimeStep(
            frame=screen[order, 0],
            reward=reward[order].astype(np.float32),
            is_first=self._ended,
            is_terminal=terminated,
        )
        self._ended = terminated | truncated
        is_over = info["terminated"][order].astype(bool) | truncated
        return timestep, Outcome(score=info["reward"][order], is_over=is_over & ~timestep.is_first)

    def close(self) -> None:
        """Ends EnvPool's threads."""
        self._pool.close()


def _task_id(game: str) -> str:
    """EnvPool's name of a game in snake case, or of one that is EnvPool's already."""
    known = {task for task in envpool.list_all_envs() if task.endswith("-v5")}
    task = game if game in known else "".join(word.capitalize() for word in game.split("_")) + "-v5"
    if task not in known:
        near = difflib.get_close_matches(task, known, n=3)
        hint = f" (near: {', '.join(near)})" if near else ""
        raise ConfigError(f"game={game}: accepted is an Atari game in snake case, seek or gymnasium:<id>{hint}")
    return task
