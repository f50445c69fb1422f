"""The host's interface to environments, and the two Atari engines behind it.

All engines show an episode's end the same way (*next-step* auto-reset): the step that ends an episode gives its last
frame; the step after it ignores its action and gives the next episode's first frame, with `is_first` and reward 0.

For the learner an episode ends as a terminal when the game is over or, with `env.episodic_life`, when a life is
lost; then the game goes on in the learner's next episode. At the step limit it ends without a terminal. (A game that
ends early among the skipped frames shows the frame before once more.)

The Atari engines play the same games, not the same way. Where an episode begins, EnvPool makes its 0 to
`env.noop_max` no-ops and then one more action, FIRE where the game has it (a no-op where not, or where
`env.fire_on_reset` is off); ale-py makes FIRE first and counts it among the no-ops. After a lost life EnvPool begins
with no-ops and FIRE again, ale-py with FIRE alone. Neither can be saved: a resumed run starts new games.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Protocol, cast, runtime_checkable

import numpy as np

from foajax.config.parse import ConfigError
from foajax.config.schema import Config
from foajax.envs import probes, seek
from foajax.envs.gymnasium import GymnasiumEnvironment
from foajax.envs.tasks import JaxEnvironment, Task
from foajax.types import SCREEN_SHAPE, Outcome, TimeStep

FRAME_SHAPE = (80, 80)  # of what `frames.crop_and_halve` makes of it

OWN: dict[str, Callable[[tuple[int, int]], Task]] = {
    "seek": seek.task,
    **{f"probe:{name}": task for name, task in probes.PROBES.items()},
}


@runtime_checkable
class Environment(Protocol):
    """A batch of equal environments, stepped together by the host.

    Arrays handed out are NumPy's, in the environments' order, and never written to again.
    """

    num_envs: int  # B
    num_actions: int
    crop_top: int | None  # first of the 160 screen rows kept; None where the screen is the frame

    @property
    def lives(self) -> np.ndarray | None:
        """Left in each game after the last step, int [B]; None where games have none."""

    def reset(self) -> tuple[TimeStep, Outcome]:
        """Begins all episodes; once, before the first `send`."""

    def send(self, action: np.ndarray) -> None:
        """Starts a step with the natural actions, int32 [B], and does not wait for it."""

    def recv(self) -> tuple[TimeStep, Outcome]:
        """The step that `send` started, once every environment is through."""

    def render(self) -> np.ndarray:
        """The screens in colour, uint8 [B, h, w, 3]; of an environment made with `render`."""

    def close(self) -> None:
        """Ends the engine's threads."""


def make(config: Config, *, num_envs: int, seed: int, render: bool = False) -> Environment:
    """The environment that plays `config.game`: an Atari game, `seek`, `probe:<name>` or `gymnasium:<id>`.

    Args:
      config: `game` and `env` are read.
      num_envs: how many environments step together.
      seed: environment i is seeded with `seed + i`.
      render: whether `Environment.render` will be called.

    Raises:
      ConfigError: if there is no such game, or the engine cannot do what `env` asks.
    """
    if config.game in OWN:
        return JaxEnvironment(OWN[config.game](config.env.frame_shape), num_envs=num_envs, seed=seed)
    if config.game.startswith("gymnasium:"):
        return GymnasiumEnvironment(config, num_envs=num_envs, seed=seed, render=render)
    engine = EnvPoolEnvironment if config.env.engine == "envpool" else AleEnvironment
    return engine(config, num_envs=num_envs, seed=seed, render=render)


class EnvPoolEnvironment:
    """An Atari game of EnvPool, which steps in its own threads. `recv` hands out EnvPool's arrays, not copies."""

    crop_top: int | None
    lives: np.ndarray
    _ended: np.ndarray  # whether the last step ended an episode
    _over: np.ndarray  # whether it ended a game

    def __init__(self, config: Config, *, num_envs: int, seed: int, render: bool) -> None:
        import envpool  # here, because importing it takes seconds that other engines need not spend

        env = config.env
        game, self.crop_top = _atari_game(config)
        self._pool = envpool.make(
            envpool_id(game),
            env_type="gymnasium",
            num_envs=num_envs,
            num_threads=env.threads,
            seed=seed,
            render_mode="rgb_array" if render else None,
            stack_num=1,
            gray_scale=True,
            img_height=SCREEN_SHAPE[0],
            img_width=SCREEN_SHAPE[1],
            frame_skip=env.frame_skip,
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
        return _first_step(screen[:, 0])

    def send(self, action: np.ndarray) -> None:
        """Starts a step in EnvPool's threads."""
        self._pool.send(action)

    def recv(self) -> tuple[TimeStep, Outcome]:
        """The step, as EnvPool tells it.

        EnvPool flags the step limit alone where it falls together with a lost life or the game's end, and does not
        tell of a game that ends during the no-ops after a lost life, except by the lives of the new one: then
        `is_over` comes with that new episode's first step.
        """
        screen, reward, terminated, truncated, info = self._pool.recv()
        lives, game_over = info["lives"], info["terminated"] == 1
        lost = self._episodic_life & (lives > 0) & (lives < self.lives)
        restarted = self._ended & ~self._over & (lives > self.lives)
        is_over = game_over | truncated | restarted
        timestep = TimeStep(
            frame=screen[:, 0],
            reward=reward,
            is_first=self._ended,
            is_terminal=terminated | (truncated & (game_over | lost)),
        )
        self.lives, self._ended, self._over = lives, terminated | truncated, is_over
        return timestep, Outcome(score=info["reward"], is_over=is_over)

    def render(self) -> np.ndarray:
        """The emulators' screens now, uint8 [B, 210, 160, 3]; `recv` shows the brighter of the last two."""
        return np.asarray(self._pool.render(np.arange(self.num_envs)))

    def close(self) -> None:
        """Drops the pool, whose threads end with it."""
        self._pool.close()
        del self._pool


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
            raise ConfigError("env.engine=ale: accepted is envpool where screens are to be rendered in colour")
        env = config.env
        game, self.crop_top = _atari_game(config)
        self._env = AtariVectorEnv(
            game,
            num_envs,
            num_threads=env.threads,
            max_num_frames_per_episode=env.max_episode_steps * env.frame_skip,
            repeat_action_probability=env.sticky_actions,
            img_height=SCREEN_SHAPE[0],
            img_width=SCREEN_SHAPE[1],
            stack_num=1,
            frameskip=env.frame_skip,
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
        return _first_step(screen[:, 0])

    def send(self, action: np.ndarray) -> None:
        """Starts a step. After a lost life ale-py would take the action: it gets FIRE instead."""
        self._env.send(np.where(self._ended, self._restart, action).astype(np.int32))

    def recv(self) -> tuple[TimeStep, Outcome]:
        """The step; points made by the FIRE after a lost life count in the score alone."""
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
        """Not offered: ale-py's vector environment keeps gray screens only."""
        raise NotImplementedError("env.engine=ale does not render")

    def close(self) -> None:
        """Drops the engine, whose threads end with it."""
        del self._env


def action_names(config: Config) -> tuple[str, ...] | None:
    """The natural actions' names, e.g. ("noop", "fire", "right", "left"); None where they have none.

    Raises:
      ConfigError: there is no such game.
    """
    if config.game == "seek":
        return ("leave", "take")
    if not is_atari(config):
        return None
    from ale_py import ALEInterface, LoggerMode, roms  # here, like EnvPool

    name = atari_name(config.game, roms.get_all_rom_ids())
    ALEInterface.setLoggerMode(LoggerMode.Error)
    emulator = ALEInterface()
    emulator.loadROM(cast(Path, roms.get_rom_path(name)))
    return tuple(action.name.lower() for action in emulator.getMinimalActionSet())


def steps_per_second(config: Config) -> float:
    """Agent steps in a second of the game: an Atari console shows 60 frames a second. 15 elsewhere, as with Atari."""
    return 60 / config.env.frame_skip if is_atari(config) else 15.0


def is_atari(config: Config) -> bool:
    """Whether an emulator plays the game."""
    return config.game not in OWN and not config.game.startswith("gymnasium:")


def atari_name(game: str, known: Iterable[str]) -> str:
    """The snake-case name, e.g. beam_rider, of a game given by that name or as EnvPool's BeamRider-v5.

    Raises:
      ConfigError: if `known` does not have it; the message has the nearest names.
    """
    names = {form: name for name in known for form in (name, envpool_id(name))}
    if game in names:
        return names[game]
    near = difflib.get_close_matches(game.lower(), [*names, *OWN], n=3)
    hint = f"; near: {', '.join(near)}" if near else ""
    raise ConfigError(f"game={game}: accepted is an Atari game (breakout), {', '.join(OWN)} or gymnasium:<id>{hint}")


def envpool_id(name: str) -> str:
    """EnvPool's id of a snake-case name: BeamRider-v5 of beam_rider."""
    return "".join(part.capitalize() for part in name.split("_")) + "-v5"


def check_game(config: Config) -> None:
    """`ConfigError` where there is no such Atari game, or `env` does not suit it; others show once they are made."""
    if is_atari(config):
        _atari_game(config)


def _atari_game(config: Config) -> tuple[str, int]:
    """The engine's name of the game, and the first screen row kept of it."""
    known: Sequence[str]
    if config.env.engine == "envpool":
        from envpool.atari.registration import atari_game_list as known
    else:
        from ale_py import roms

        known = roms.get_all_rom_ids()
    game = atari_name(config.game, known)
    return game, _crop_top(config, game, known)


def _crop_top(config: Config, game: str, known: Iterable[str]) -> int:
    env = config.env
    if env.frame_shape != FRAME_SHAPE:
        shape = list(env.frame_shape)
        raise ConfigError(f"env.frame_shape={shape}: accepted is {list(FRAME_SHAPE)} for game={config.game}")
    for key, row in env.crop_top.items():
        if key not in known and key != "default":
            raise ConfigError(f"env.crop_top.{key}={row}: accepted is default or an Atari game in snake case")
    return env.crop_top.get(game, env.crop_top["default"])


def _first_step(screen: np.ndarray) -> tuple[TimeStep, Outcome]:
    zeros, false = np.zeros(len(screen), np.float32), np.zeros(len(screen), bool)
    return TimeStep(screen, zeros, is_first=~false, is_terminal=false), Outcome(score=zeros, is_over=false)
