"""What both engines of the Atari games share.

They start games in different ways. At an episode's start EnvPool makes 0 to `env.noop_max` no-ops and then one more
action: FIRE if the game has it and `env.fire_on_reset` is set, else a no-op. ale-py makes FIRE first and counts it
among the no-ops. After a lost life EnvPool makes no-ops and FIRE again, ale-py FIRE alone. With
`env.full_action_space` each game has FIRE. Neither engine can be saved: a resumed run starts new games.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence

from foajax.config.parse import refuse, suggest
from foajax.config.parts import bind_part
from foajax.config.schema import Config, game_name
from foajax.envs.own import OWN
from foajax.types import SCREEN_SHAPE

FRAME_SHAPE = (80, 80)  # of what `frames.crop_and_halve` makes of it


def is_atari(config: Config) -> bool:
    """Whether an emulator plays the game."""
    return config.game not in OWN and not config.game.startswith("gymnasium:") and not is_own(config)


def is_own(config: Config) -> bool:
    """Whether code of the user's makes the game, `package.module:factory`."""
    return ":" in config.game and not config.game.startswith(("gymnasium:", "probe:"))


def atari_name(game: str, known: Iterable[str]) -> str:
    """Returns the snake-case name, e.g. beam_rider, for a name of any library's: BeamRider-v5, beamrider.

    Raises:
      ConfigError: if `known` does not have it; the message has the nearest name.
    """
    names = {name.replace("_", ""): name for name in known}
    plain = game_name(game).replace("_", "")
    if plain in names:
        return names[plain]
    near = difflib.get_close_matches(game_name(game), [*names.values(), *OWN], n=1)
    others = f"{', '.join(OWN)}, gymnasium:<id> or package.module:factory"
    raise refuse("game", game, f"an Atari game such as breakout, {others}", why=suggest("", *near))


def envpool_id(name: str) -> str:
    """Returns EnvPool's id for a snake-case name: BeamRider-v5 for beam_rider."""
    return "".join(part.capitalize() for part in name.split("_")) + "-v5"


def check_game(config: Config) -> None:
    """Raises `ConfigError` if there is no such game or `env` does not suit it. Gymnasium's are checked when made."""
    if config.env.kwargs and not (is_own(config) or config.game.startswith("gymnasium:")):
        raise refuse("env.kwargs", config.env.kwargs, f"{{}} for game={config.game}")
    if config.env.color and config.game in OWN:
        raise refuse("env.color", True, f"false for game={config.game}, whose frames are gray")
    if is_own(config):
        bind_part("game", config.game, {}, **config.env.kwargs, num_envs=1, seed=0)
    if is_atari(config):
        atari_game(config)


def atari_game(config: Config) -> tuple[str, int | None]:
    """Returns the engine's name of the game and the first screen row to keep; None to keep the whole screen."""
    known: Sequence[str]
    if config.env.engine == "envpool":
        from envpool.atari.registration import atari_game_list as known
    else:
        from ale_py import roms

        known = roms.get_all_rom_ids()
    game = atari_name(config.game, known)
    return game, _crop_top(config, game, known)


def screen_shape(config: Config) -> tuple[int, int]:
    """Returns the size of the screens to ask an engine for: `env.frame_shape` if the engine shrinks them.

    Both engines shrink by area means (OpenCV's INTER_AREA), as Gymnasium's AtariPreprocessing does.
    """
    return SCREEN_SHAPE if config.env.crop else config.env.frame_shape


def _crop_top(config: Config, game: str, known: Iterable[str]) -> int | None:
    env, whole = config.env, list(SCREEN_SHAPE)
    if env.crop and env.frame_shape != FRAME_SHAPE:
        accepted = f"{list(FRAME_SHAPE)} for game={config.game}, or a size up to {whole} with env.crop=false"
        raise refuse("env.frame_shape", env.frame_shape, accepted)
    if env.frame_shape[0] > whole[0] or env.frame_shape[1] > whole[1]:
        raise refuse("env.frame_shape", env.frame_shape, f"a size up to the screen's, {whole}, where env.crop=false")
    for key, row in env.crop_top.items():
        if key not in known and key != "default":
            raise refuse(f"env.crop_top.{key}", row, "default or an Atari game in snake case")
    return env.crop_top.get(game, env.crop_top["default"]) if env.crop else None
