"""Lets a shipped agent play one game and writes a page to watch it: `foajax demo`. Nothing is trained.

Of the agents for a game that choose where to look, the best one plays; `agent=` takes another. In visual search it
plays several scenes, and the page shows the longest successful one.
"""

from __future__ import annotations

import math
import sys
import webbrowser
from collections.abc import Sequence
from pathlib import Path

from pydantic import Field

from foajax import cli
from foajax.config.parse import ConfigError, Section, refuse, replace
from foajax.config.schema import Config, game_name
from foajax.config.shipped import agents
from foajax.runs.agents import load_agent, load_score
from foajax.runs.directory import load_config
from foajax.runtime import use_compilation_cache
from foajax.sensors.registry import make_sensor
from foajax.viewing.player_page import write_page
from foajax.viewing.recording import progress_bar, watch
from foajax.viewing.scanpath import draw_scanpath

_FIRST = ("breakout", "pong")  # what is played where no game is asked for
_SCENES = 6  # of visual search, which take some decisions each
_LOOK_AT = """What to look at:
  left     the game; the frame on it is where the agent looks
  middle   all that the agent sees of it
  right    its two choices: what to do, and where to look next
  below    the whole game; yellow marks are points. Click to go there, press space to play."""


class Options(Section):
    game: str | None = Field(None, description="Game to play; null for breakout, else pong, else any with an agent.")
    agent: str | None = Field(None, description="A shipped agent's name, or a directory; null for the game's best.")
    out: str = Field("demo", description="Directory of the page.")
    seed: int = Field(0, description="Seed of the game.")
    steps: int = Field(6000, ge=1, description="Decisions at most; 6,000 are seven minutes of an Atari game.")
    open: bool | None = Field(None, description="Show the page in the browser; null to be asked on a terminal.")
    trust: bool = Field(False, description="Let code run that the agent's configuration names.")


def choose(directory: Path, game: str | None) -> Path:
    """Chooses the best shipped agent for a game: of those with a learned gaze, if there are any, the best scorer.

    Raises:
      ConfigError: there is no agent for the game.
    """
    shipped: dict[str, list[Path]] = {}
    for file in sorted(directory.glob("*/config.yaml")):
        shipped.setdefault(load_config(file.parent).game, []).append(file.parent)
    if not shipped:
        raise ConfigError("demo: no agent is shipped yet; foajax player run=<dir> shows one of your own")
    asked = game or next((name for name in _FIRST if name in shipped), min(shipped))
    if asked not in shipped:
        raise refuse("game", asked, shipped, why="no agent is shipped for it")

    def worth(path: Path) -> tuple[bool, float]:
        return load_config(path).gaze.mode == "learned", (load_score(path) or {}).get("mean", -math.inf)

    return max(shipped[asked], key=worth)


def demo(arguments: Sequence[str]) -> None:
    """Plays a game; prints the score, the page's address and what to look at."""
    options = cli.parse(Options, arguments)
    game = options.game and game_name(options.game)
    path = Path(options.agent) if options.agent else choose(agents(), game)
    stored, directory = load_agent(path, trust=options.trust, key="agent"), cli.make_directory(options.out)
    if game not in (None, stored.agent.config.game):
        raise refuse("game", options.game, f"null or {stored.agent.config.game}", why=f"agent={path} plays another")
    use_compilation_cache()
    config = stored.agent.config
    if config.searches:  # scenes with as many letters as it was trained on
        config = replace(config, search=replace(config.search, set_sizes=(max(config.search.set_sizes),)))
        stored = stored.with_config(config)
    print(_introduction(path.name, config))
    games = _SCENES if config.searches else 1
    with progress_bar() as bar:
        played = list(watch(stored, bar, episodes=games, seed=options.seed, greedy=False, max_steps=options.steps))
    right = [each for each in played if each.facts is not None and each.facts.get("right")]
    recording = max(right or played, key=lambda each: len(each.score))
    page = write_page(recording, directory).resolve().as_uri()
    if config.searches:
        draw_scanpath(recording).save(directory / "scanpath.png")
    ended = "The game was over" if recording.is_over else "The demo stopped"
    decisions = len(recording.score) - recording.is_over  # nothing follows from the last row's
    score = None if config.searches else load_score(path)  # which is over scenes of all sizes
    usual = f" Its mean over {score['episodes']} games: {score['mean']:.1f}." if score else ""
    print(f"{ended} after {decisions:,} decisions. Score: {recording.score[-1]:g}.{usual}")
    print(f"Watch it: {page}\n{_LOOK_AT}")
    if config.searches:
        print(
            f"It answered {len(right)} of {games} scenes right. The page shows the longest of "
            f"{'these' if right else 'all'}.\nThe search in one picture: {directory / 'scanpath.png'}"
        )
    if _wants(options.open):
        webbrowser.open(page)


def _introduction(name: str, config: Config) -> str:
    shape = config.env.frame_shape
    sees = "the whole frame"
    if config.gaze.mode != "none":
        values = make_sensor(config.sensor).count(shape).nominal
        sees = f"{values:,} values of a frame of {shape[0] * shape[1]:,} pixels"
    chooses = ", and chooses where to look" if config.gaze.mode == "learned" else ""
    return f"{name} plays {config.game}. It sees {sees}{chooses}."


def _wants(said: bool | None) -> bool:
    if said is None and sys.stdin.isatty() and sys.stdout.isatty():
        return input("Open it in the browser now? [y/N] ").strip().lower().startswith("y")
    return bool(said)


if __name__ == "__main__":
    sys.exit(cli.run(demo))
