"""Atari games on EnvPool."""

from __future__ import annotations

import numpy as np

from foajax.config.schema import Config
from foajax.envs.atari import atari_game, envpool_id, screen_shape
from foajax.envs.base import first_step
from foajax.types import Outcome, TimeStep


class EnvPoolEnvironment:
    """An Atari game of EnvPool, which steps in its own threads. `recv` hands out EnvPool's arrays, not copies."""

    crop_top: int | None
    lives: np.ndarray
    _ended: np.ndarray  # whether the last step ended an episode
    _over: np.ndarray  # whether it ended a game

    def __init__(self, config: Config, *, num_envs: int, seed: int, render: bool) -> None:
        import envpool  # here, because importing it takes seconds that other engines need not spend

        env = config.env
        game, self.crop_top = atari_game(config)
        height, width = screen_shape(config)
        self._pool = envpool.make(
            envpool_id(game),
            env_type="gymnasium",
            num_envs=num_envs,
            num_threads=env.threads,
            seed=seed,
            render_mode="rgb_array" if render else None,
            stack_num=1,
            gray_scale=not env.color,
            img_height=height,
            img_width=width,
            frame_skip=env.frame_skip,
            full_action_space=env.full_action_space,
            noop_max=env.noop_max + 1,  # EnvPool's no-ops are drawn from [0, noop_max - 1]; 0 crashes it
            episodic_life=env.episodic_life,
            use_fire_reset=env.fire_on_reset,
            reward_clip=env.clip_rewards,
            repeat_action_probability=env.sticky_actions,
            max_episode_steps=env.max_episode_steps,
        )
        self.num_envs, self.num_actions = num_envs, int(self._pool.action_space.n)
        self.lives = np.zeros(num_envs, int)  # until `reset`
        self._episodic_life = env.episodic_life

    def reset(self) -> tuple[TimeStep, Outcome]:
        """Begins all games. A second call would go on with the games, at the next life."""
        screen, info = self._pool.reset()
        self.lives = info["lives"]
        self._ended = self._over = np.zeros(self.num_envs, bool)
        return first_step(_screens(screen))

    def send(self, action: np.ndarray) -> None:
        """Starts a step in EnvPool's threads."""
        self._pool.send(action)

    def recv(self) -> tuple[TimeStep, Outcome]:
        """Waits for the step.

        If the step limit coincides with a lost life or the game's end, EnvPool flags only the limit. If a game ends
        during the no-ops after a lost life, EnvPool does not say so; the lives of the new game show it. Then
        `is_over` comes with the new episode's first step.
        """
        screen, reward, terminated, truncated, info = self._pool.recv()
        lives, game_over = info["lives"], info["terminated"] == 1
        lost = self._episodic_life & (lives > 0) & (lives < self.lives)
        restarted = self._ended & ~self._over & (lives > self.lives)
        is_over = game_over | truncated | restarted
        timestep = TimeStep(
            frame=_screens(screen),
            reward=reward,
            is_first=self._ended,
            is_terminal=terminated | (truncated & (game_over | lost)),
        )
        self.lives, self._ended, self._over = lives, terminated | truncated, is_over
        return timestep, Outcome(score=info["reward"], is_over=is_over)

    def render(self) -> np.ndarray:
        """Returns the current screens, uint8 [B, 210, 160, 3]; `recv` shows the brighter of the last two."""
        return np.asarray(self._pool.render(np.arange(self.num_envs)))

    def close(self) -> None:
        """Drops the pool, whose threads end with it."""
        self._pool.close()
        del self._pool


def _screens(observation: np.ndarray) -> np.ndarray:
    """Turns EnvPool's [B, 1, H, W] into [B, H, W] or, in colour, its [B, 3, H, W] into [B, H, W, 3]."""
    return observation[:, 0] if observation.shape[1] == 1 else np.moveaxis(observation, 1, -1)
