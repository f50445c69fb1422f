"""`python -m foajax.evaluate run=<dir> episodes=30`: whole games, unclipped scores."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from typing import Literal

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from foajax import cli
from foajax.config.parse import ConfigError
from foajax.runs.agents import load_agent
from foajax.viewing.games import play


@dataclasses.dataclass(frozen=True)
class Options:
    """What the command takes."""

    run: str  # a run directory or a shipped agent
    episodes: int = 30
    policy: Literal["sampled", "greedy"] = "sampled"  # greedy games that begin alike are alike: 31 ways with no-ops
    checkpoint: Literal["newest", "best"] = "newest"  # of a run: the latest, or that with the best score in training
    json: str | None = None  # file for the result
    num_envs: int = 30  # games played at once
    seed: int = 0

    def __post_init__(self) -> None:
        for key in ("episodes", "num_envs"):
            if getattr(self, key) < 1:
                raise ConfigError(f"{key}={getattr(self, key)}: accepted is an integer >= 1")
        cli.check_file("json", self.json)


def evaluate(arguments: Sequence[str]) -> None:
    """The command."""
    options = cli.parse(Options, arguments)
    stored = load_agent(options.run, best=options.checkpoint == "best")
    config = stored.agent.config
    games = play(
        stored,
        episodes=options.episodes,
        num_envs=options.num_envs,
        seed=options.seed,
        greedy=options.policy == "greedy",
    )
    result = {
        "run": options.run,
        "game": config.game,
        "experiment": config.name,
        "env_steps": stored.env_steps,
        "policy": options.policy,
        "seed": options.seed,
        "episodes": options.episodes,
        "mean": float(games.returns.mean()),
        "stderr": standard_error(games.returns),
        "returns": games.returns.tolist(),
        "lengths": games.lengths.tolist(),
    }
    if options.json:
        cli.write_json("json", options.json, result)
    _print(result)


def standard_error(returns: np.ndarray) -> float | None:
    """Of the mean; None for a single game."""
    return float(returns.std(ddof=1) / np.sqrt(len(returns))) if len(returns) > 1 else None


def _print(result: dict) -> None:
    table = Table("game", "experiment", "policy", "games", "mean", "std. error", "min", "median", "max", "steps a game")
    returns = np.array(result["returns"])
    error = "" if result["stderr"] is None else f"{result['stderr']:.2f}"
    table.add_row(
        Text(result["game"]),  # a name may hold what rich takes for markup
        Text(result["experiment"]),
        result["policy"],
        str(len(returns)),
        f"{returns.mean():.2f}",
        error,
        f"{returns.min():.0f}",
        f"{np.median(returns):.1f}",
        f"{returns.max():.0f}",
        f"{np.mean(result['lengths']):.0f}",
    )
    Console(width=120).print(table)


if __name__ == "__main__":
    sys.exit(cli.run(evaluate))
