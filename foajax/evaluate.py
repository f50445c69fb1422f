"""Plays 100 whole games with a trained agent and prints its unclipped score: `foajax evaluate run=<dir>`.

The games are those of the agent's training, with other seeds. `env.<key>=value` changes their rules:
`env.sticky_actions=0.25`, `env.episodic_life=false` (the agent has to start each life itself) or
`env.max_episode_steps=4500`. A game of `env.max_episode_steps` decisions, 27,000 by default, is cut and counts.
`search.<key>=value` changes the scenes of visual search: `search.set_sizes=[1,4,8,16]`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Literal

import numpy as np
from pydantic import Field
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from rich.text import Text

from foajax import cli
from foajax.config.parse import one_line, refuse, replace
from foajax.config.schema import SearchConfig
from foajax.envs.measures import summarise
from foajax.envs.own import OWN
from foajax.runs.agents import StoredAgent
from foajax.viewing.games import play

# What may differ from training: the rest of `env` decides what a frame is.
_PROTOCOL = (
    *("engine", "frame_skip", "noop_max", "clip_rewards", "episodic_life", "fire_on_reset", "sticky_actions"),
    *("max_episode_steps", "threads"),
)


class Options(StoredAgent):
    episodes: int = Field(100, ge=1, description="Games to play.")
    policy: Literal["sampled", "greedy"] = Field(
        "sampled", description="How actions are chosen; greedy games differ by their no-ops at the start alone."
    )
    json_file: str | None = Field(None, alias="json", description="JSON file to write the result to.")
    num_envs: int = Field(25, ge=1, description="Games played at once.")
    seed: int = Field(0, description="Seed of the games.")

    def check(self) -> None:
        cli.check_file("json", self.json_file)


def evaluate(arguments: Sequence[str]) -> None:
    """Plays whole games and prints a table of their scores."""
    protocol = [word for word in arguments if word.startswith(("env.", "search."))]
    options = cli.parse(Options, [word for word in arguments if word not in protocol])
    stored = options.load()
    config = stored.agent.config
    env, scenes = ([word for word in protocol if word.startswith(part)] for part in ("env.", "search."))
    if ignored := (env if config.game in OWN else []) + ([] if config.searches else scenes):
        raise refuse(one_line(ignored[0]), accepted="", why=f"changes nothing in game={config.game}")
    config = replace(
        config,
        env=cli.override(config.env, env, "env", _PROTOCOL),
        search=cli.override(config.search, scenes, "search", list(SearchConfig.model_fields)),
    )
    with Progress(console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty()) as bar:
        task = bar.add_task("games", total=options.episodes)
        games = play(
            stored.with_config(config),
            episodes=options.episodes,
            num_envs=options.num_envs,
            seed=options.seed,
            greedy=options.policy == "greedy",
            progress=lambda ended: bar.update(task, completed=ended),
        )
    result = {
        "run": options.run,
        "game": config.game,
        "experiment": config.name,
        "env_steps": stored.env_steps,
        "policy": options.policy,
        "seed": options.seed,
        "protocol": protocol,
        "episodes": options.episodes,
        "mean": float(games.returns.mean()),
        "stderr": float(games.returns.std(ddof=1) / np.sqrt(len(games.returns))) if len(games.returns) > 1 else None,
        "cut": games.cut,
        "measures": summarise(games.facts),
        "returns": games.returns.tolist(),
        "lengths": games.lengths.tolist(),
    }
    if options.json_file:
        cli.write_json("json", options.json_file, result)
    _print(result)


def _print(result: dict) -> None:
    table = Table("game", "experiment", "policy", "games", "mean", "std. error", "min", "median", "max", "steps/game")
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
    console = Console(width=120)
    console.print(table)
    if result["measures"]:
        console.print(", ".join(f"{name} {value:.3g}" for name, value in result["measures"].items()))
    if result["cut"]:
        console.print(f"{result['cut']} of the games were cut at env.max_episode_steps")


if __name__ == "__main__":
    sys.exit(cli.run(evaluate))
