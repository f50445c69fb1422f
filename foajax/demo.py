"""`python -m foajax.demo`: a shipped agent plays one game, with nothing to train, and its page to watch.

The best agent in agents/ for the game, by the score that it was shipped with.
"""

from __future__ import annotations

import math
import sys
import webbrowser
from collections.abc import Sequence
from pathlib import Path

from pydantic import Field

from foajax import cli
from foajax.config.parse import ConfigError, Section, refuse
from foajax.config.shipped import agents
from foajax.runs.agents import load_agent, load_score
from foajax.runs.directory import load_config
from foajax.runtime import use_compilation_cache
from foajax.viewing.player_page import write_page
from foajax.viewing.recording import play, progress_bar

_FIRST = ("breakout", "pong")  # what is played where no game is asked for


class Options(Section):
    """What the command takes."""

    game: str | None = Field(None, description="Game to play; null for breakout, else pong, else any with an agent.")
    out: str = Field("demo", description="Directory of the page.")
    seed: int = Field(0, description="Seed of the game.")
    steps: int = Field(6000, ge=1, description="Decisions at most; 6,000 are seven minutes of an Atari game.")
    open: bool = Field(False, description="Show the page in the browser.")


def choose(directory: Path, game: str | None) -> Path:
    """The best agent for a game, by its mean score.

    Raises:
      ConfigError: there is none.
    """
    shipped: dict[str, list[Path]] = {}
    for file in sorted(directory.glob("*/config.yaml")):
        shipped.setdefault(load_config(file.parent).game, []).append(file.parent)
    if not shipped:
        raise ConfigError("demo: no agent is shipped yet; python -m foajax.player run=<dir> shows one of your own")
    asked = game or next((name for name in _FIRST if name in shipped), min(shipped))
    if asked not in shipped:
        raise refuse("game", asked, shipped, why="no agent is shipped for it")
    return max(shipped[asked], key=lambda path: (load_score(path) or {}).get("mean", -math.inf))


def demo(arguments: Sequence[str]) -> None:
    """The command; prints the score and the page's path."""
    options = cli.parse(Options, arguments)
    path = choose(agents(), options.game)
    stored, directory = load_agent(path), cli.make_directory(options.out)
    use_compilation_cache()
    with progress_bar() as bar:
        recording = next(play(stored, bar, seed=options.seed, greedy=False, max_steps=options.steps))
    page = write_page(recording, directory)
    ended = "game over" if recording.is_over else "cut"
    print(f"{path.name}: {recording.score[-1]:g} points in {len(recording.score):,} steps ({ended})")
    if score := load_score(path):
        error = "" if score["stderr"] is None else f" +- {score['stderr']:.1f}"
        print(f"its evaluation: {score['mean']:.1f}{error} over {score['episodes']} games ({score['policy']} actions)")
    print(f"watch it: {page.resolve().as_uri()}")
    if options.open:
        webbrowser.open(page.resolve().as_uri())


if __name__ == "__main__":
    sys.exit(cli.run(demo))
