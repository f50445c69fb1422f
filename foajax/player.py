"""`python -m foajax.player run=<dir> out=player`: one recorded game as a page to play, scrub and study.

The page is one file and needs nothing else, no network and no server.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from typing import Literal

from foajax import cli
from foajax.config.parse import ConfigError
from foajax.runs.agents import load_agent
from foajax.runtime import use_compilation_cache
from foajax.viewing.player_page import write_page
from foajax.viewing.recording import play, progress_bar


@dataclasses.dataclass(frozen=True)
class Options:
    """What the command takes."""

    run: str  # a directory of a run or an agent, or the name of a shipped agent
    out: str = "player"  # directory of the page
    policy: Literal["sampled", "greedy"] = "sampled"
    seed: int = 0
    steps: int | None = None  # cuts the game after so many decisions; null for the whole game
    trust: bool = False  # whether code that the agent's configuration names may run

    def __post_init__(self) -> None:
        if self.steps is not None and self.steps < 1:
            raise ConfigError(f"steps={self.steps}: accepted is null or an integer >= 1")


def player(arguments: Sequence[str]) -> None:
    """The command; prints the path of the page."""
    options = cli.parse(Options, arguments)
    use_compilation_cache()
    stored, directory = load_agent(options.run, trust=options.trust), cli.make_directory(options.out)
    with progress_bar() as bar:
        greedy = options.policy == "greedy"
        recording = next(play(stored, bar, seed=options.seed, greedy=greedy, max_steps=options.steps))
    print(write_page(recording, directory))


if __name__ == "__main__":
    sys.exit(cli.run(player))
