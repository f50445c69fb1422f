"""Makes the environment that plays a game. Tells the names of its actions and its speed without making it."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np

from foajax.config.parse import refuse
from foajax.config.parts import make_part
from foajax.config.schema import Config
from foajax.envs import search
from foajax.envs.ale import AleEnvironment
from foajax.envs.atari import atari_name, check_game, is_atari, is_own
from foajax.envs.base import Environment
from foajax.envs.envpool import EnvPoolEnvironment
from foajax.envs.gymnasium import GymnasiumEnvironment
from foajax.envs.own import OWN
from foajax.envs.tasks import JaxEnvironment


def make(config: Config, *, num_envs: int, seed: int, render: bool = False) -> Environment:
    """Makes the environment that plays `config.game`.

    Args:
      config: `game` and `env` are read.
      num_envs: how many environments step together.
      seed: environment i is seeded with `seed + i`.
      render: whether `Environment.render` will be called.

    Raises:
      ConfigError: if there is no such game, or the engine cannot do what `env` asks.
    """
    check_game(config)
    if is_own(config):
        arguments = {**config.env.kwargs, "num_envs": num_envs, "seed": seed}
        made = make_part("game", config.game, {}, **arguments)
        if not isinstance(made, Environment):
            raise refuse("game", config.game, "a function that returns a foajax.envs.base.Environment")
        return made
    if config.game in OWN:
        return JaxEnvironment(OWN[config.game](config), num_envs=num_envs, seed=seed)
    if config.game.startswith("gymnasium:"):
        return GymnasiumEnvironment(config, num_envs=num_envs, seed=seed, render=render)
    engine = EnvPoolEnvironment if config.env.engine == "envpool" else AleEnvironment
    return engine(config, num_envs=num_envs, seed=seed, render=render)


def action_names(config: Config) -> tuple[str, ...] | None:
    """Returns the natural actions' names, e.g. ("noop", "fire", "right", "left"); None for a game without names.

    Raises:
      ConfigError: there is no such game.
    """
    if config.game == "seek":
        return ("leave", "take")
    if config.searches:
        return search.action_names(config)
    if not is_atari(config):
        return None
    from ale_py import ALEInterface, LoggerMode, roms  # here, like EnvPool

    name = atari_name(config.game, roms.get_all_rom_ids())
    ALEInterface.setLoggerMode(LoggerMode.Error)
    emulator = ALEInterface()
    emulator.loadROM(cast(Path, roms.get_rom_path(name)))
    everything = config.env.full_action_space
    actions = emulator.getLegalActionSet() if everything else emulator.getMinimalActionSet()
    return tuple(action.name.lower() for action in actions)


def steps_per_second(config: Config) -> float:
    """Returns decisions per second of play: an Atari console shows 60 frames per second. Other games have 15."""
    return 60 / config.env.frame_skip if is_atari(config) else 15.0


def make_environments(config: Config, env_steps: int, index: int = 0, count: int = 1) -> list[Environment]:
    """Makes the groups of environments of a run that starts at `env_steps`, for process `index` of `count`."""
    batch, environments = config.env.num_envs // config.env.num_groups // count, []
    for group in range(config.env.num_groups):
        # Differs between runs, groups and starts. An engine adds the environment's number: seeds do not depend on the
        # number of processes.
        seed = int(np.random.SeedSequence([config.seed, env_steps, group]).generate_state(1)[0] >> 2)
        environments.append(make(config, num_envs=batch, seed=seed + index * batch))
    return environments
