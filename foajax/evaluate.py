"""`python -m foajax.evaluate run=<dir> episodes=30`: whole games, unclipped scores."""

from __future__ import annotations

import dataclasses
import functools
import sys
from collections.abc import Sequence
from typing import Literal, NamedTuple

import jax
import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from foajax import cli
from foajax.config.parse import ConfigError
from foajax.envs.base import Environment
from foajax.envs.make import make
from foajax.runs.agents import Stored, load_agent

_FIRST_SEED = 1_000_003  # apart from the seeds of training
_SEEDS = 2**31 - 2_000_000  # the engines take 32 bits, and add an environment's number


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


class Games(NamedTuple):
    """Whole games, in the order in which they ended."""

    returns: np.ndarray  # [episodes] unclipped
    lengths: np.ndarray  # [episodes] agent steps


def environment(stored: Stored, *, num_envs: int, seed: int, render: bool = False) -> Environment:
    """What an agent is watched in: the game that it was trained in, with seeds apart from those of training.

    Raises:
      ConfigError: a seed out of range; no such game, or one whose actions are no longer those of the training.
    """
    if not 0 <= seed < _SEEDS:
        raise ConfigError(f"seed={seed}: accepted is an integer from 0 to {_SEEDS - 1}")
    config, actions = stored.agent.config, stored.agent.num_actions
    made = make(config, num_envs=num_envs, seed=_FIRST_SEED + seed, render=render)
    if made.num_actions != actions:
        made.close()
        raise ConfigError(f"game={config.game}: has {made.num_actions} actions; accepted are {actions}, as in training")
    return made


def play(stored: Stored, *, episodes: int, num_envs: int, seed: int, greedy: bool) -> Games:
    """Plays `episodes` games with fixed parameters.

    Every environment plays the same number of games, to within one, so that short games are not over-represented.
    """
    num_envs = min(num_envs, episodes)
    rounds = [len(part) for part in np.array_split(np.arange(episodes), num_envs)]
    watched = environment(stored, num_envs=num_envs, seed=seed)
    act = jax.jit(functools.partial(stored.agent.act, greedy=greedy))
    state = stored.agent.initial_state(num_envs)
    key = jax.random.key(seed)
    returns, lengths, games = np.zeros(num_envs), np.zeros(num_envs, int), np.zeros(num_envs, int)
    finished: list[tuple[float, int]] = []
    timestep, _ = watched.reset()
    step = 0
    while len(finished) < episodes:
        output, _, state = act(stored.params, stored.statistics, state, timestep, jax.random.fold_in(key, step))
        watched.send(np.asarray(output.natural_action))
        timestep, outcome = watched.recv()
        returns += outcome.score
        lengths += 1 - timestep.is_first
        for i in np.flatnonzero(outcome.is_over):
            if games[i] < rounds[i]:
                finished.append((float(returns[i]), int(lengths[i])))
            games[i] += 1
            returns[i], lengths[i] = 0, 0
        step += 1
    watched.close()
    return Games(returns=np.array([r for r, _ in finished]), lengths=np.array([n for _, n in finished]))


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
