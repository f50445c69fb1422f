"""Plays one game with a trained agent and writes it as a page to study: `foajax player run=<dir> out=player`.

The page is one file; it needs no network and no server.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Literal

from pydantic import Field

from foajax import cli
from foajax.runs.agents import StoredAgent
from foajax.runtime import use_compilation_cache
from foajax.viewing.player_page import write_page
from foajax.viewing.recording import progress_bar, watch


class Options(StoredAgent):
    out: str = Field("player", description="Directory of the page.")
    policy: Literal["sampled", "greedy"] = Field("sampled", description="How actions are chosen.")
    seed: int = Field(0, description="Seed of the game.")
    steps: int | None = Field(None, ge=1, description="Cut the game after so many decisions; null for the whole game.")


def player(arguments: Sequence[str]) -> None:
    """Plays one game and prints the path of its page."""
    options = cli.parse(Options, arguments)
    use_compilation_cache()
    stored, directory = options.load(), cli.make_directory(options.out)
    with progress_bar() as bar:
        greedy = options.policy == "greedy"
        recording = next(watch(stored, bar, seed=options.seed, greedy=greedy, max_steps=options.steps))
    print(write_page(recording, directory))


if __name__ == "__main__":
    sys.exit(cli.run(player))
