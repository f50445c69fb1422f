"""Atari games on ale-py's own vector environment."""

from __future__ import annotations

import numpy as np

from foajax.config.parse import refuse
from foajax.config.schema import Config
from foajax.envs.atari import atari_game, screen_shape
from foajax.envs.base import first_step
from foajax.types import Outcome, TimeStep


class AleEnvironment:
    """An Atari game of ale-py's own vector environment, which steps in its own threads."""

    crop_top: int | None
    lives: np.ndarray
    _ended: np.ndarray  # whether the last step ended an episode
    _over: np.ndarray  # whether it ended a game

    def __init__(self, config: Config, *, num_envs: int, seed: int, render: bool) -> None:
        from ale_py import Action  # here, like EnvPool
        from ale_py.vector_env import AtariVectorEnv

        if render:
            raise refuse("env.engine", "ale", "envpool where screens are to be rendered in colour")
        env = config.env
        game, self.crop_top = atari_game(config)
        height, width = screen_shape(config)
        self._env = AtariVectorEnv(
            game,
            num_envs,
            num_threads=env.threads,
            max_num_frames_per_episode=env.max_episode_steps * env.frame_skip,
            repeat_action_probability=env.sticky_actions,
            img_height=height,
            img_width=width,
            grayscale=not env.color,
            stack_num=1,
            frameskip=env.frame_skip,
            full_action_space=env.full_action_space,
            noop_max=env.noop_max + 1,
            # Its own episodic_life would begin a new game at a lost life; this one only flags it.
            life_loss_info=env.episodic_life,
            reward_clipping=False,
            use_fire_reset=env.fire_on_reset,
        )
        actions = list(self._env.ale.get_action_set())
        fire = env.fire_on_reset and Action.FIRE in actions
        self._restart = np.int32(actions.index(Action.FIRE) if fire else 0)
        self.num_envs, self.num_actions = num_envs, len(actions)
        self.lives = np.zeros(num_envs, int)  # until `reset`
        self._seed, self._clip, self._max_steps = seed, env.clip_rewards, env.max_episode_steps

    def reset(self) -> tuple[TimeStep, Outcome]:
        """Begins all games, from the seed."""
        screen, info = self._env.reset(seed=self._seed)
        self.lives, self._steps = info["lives"], np.zeros(self.num_envs, int)
        self._ended = self._over = np.zeros(self.num_envs, bool)
        return first_step(screen[:, 0])

    def send(self, action: np.ndarray) -> None:
        """Starts a step. In the step after an episode's end ale-py gets FIRE, or a no-op, in place of the action."""
        self._env.send(np.where(self._ended, self._restart, action).astype(np.int32))

    def recv(self) -> tuple[TimeStep, Outcome]:
        """Waits for the step. Points made by the FIRE after a lost life count in the score, not in the reward."""
        screen, points, terminated, truncated, info = self._env.recv()
        lives, score = info["lives"], points.astype(np.float32)
        lost = terminated & (lives > 0) & (lives < self.lives)
        # ale-py does not flag a step limit that falls together with a lost life.
        self._steps = np.where(self._over, 0, self._steps + 1)
        is_over = (terminated & ~lost) | (self._steps >= self._max_steps)
        reward = np.where(self._ended, np.float32(0), np.sign(score) if self._clip else score)
        timestep = TimeStep(frame=screen[:, 0], reward=reward, is_first=self._ended, is_terminal=terminated)
        self.lives, self._ended, self._over = lives, terminated | truncated, is_over
        return timestep, Outcome(score=score, is_over=is_over)

    def render(self) -> np.ndarray:
        """Raises NotImplementedError: ale-py's vector environment keeps only the screens that it has shrunk."""
        raise NotImplementedError("env.engine=ale does not render")

    def close(self) -> None:
        """Drops the engine, whose threads end with it."""
        del self._env
