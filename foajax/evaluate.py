"""`python -m foajax.evaluate run=<dir>`: an agent's score in 100 whole games, unclipped.

The games are those of the agent's training, with seeds of their own. `env.<key>=value` changes them, for another
protocol: `env.sticky_actions=0.25`, `env.episodic_life=false` (the agent has to start each life itself),
`env.max_episode_steps=4500`. A game that reaches the last of these, 27,000 decisions by default, is cut and counted.
"""

from __future__ import annotations

import dataclasses
import functools
import sys
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import jax
import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from rich.text import Text

from foajax import cli
from foajax.config import ConfigError
from foajax.envs import Environment, make
from foajax.store import Stored, load_agent

_SEEDS = 2**31  # seeds to choose from
_WATCHED = 1_000_003  # keeps what `np.random.SeedSequence` makes of them apart from the seeds of training
# What may differ from training: the rest of `env` decides what a frame is.
_PROTOCOL = (
    *("engine", "frame_skip", "noop_max", "clip_rewards", "episodic_life", "fire_on_reset", "sticky_actions"),
    *("max_episode_steps", "threads"),
)


@dataclasses.dataclass(frozen=True)
class Options:
    """What the command takes."""

    run: str  # a run directory or a shipped agent
    episodes: int = 100
    policy: Literal["sampled", "greedy"] = "sampled"  # greedy games that begin alike are alike: 31 ways with no-ops
    checkpoint: Literal["newest", "best"] = "newest"  # of a run: the latest, or that with the best score in training
    json: str | None = None  # file for the result
    num_envs: int = 25  # games played at once
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
    cut: int  # how many of them reached `env.max_episode_steps`


def environment(stored: Stored, *, num_envs: int, seed: int, render: bool = False) -> Environment:
    """What an agent is watched in: the game that it was trained in, with seeds apart from those of training.

    Raises:
      ConfigError: a seed out of range; no such game, or one whose actions are no longer those of the training.
    """
    if not 0 <= seed < _SEEDS:
        raise ConfigError(f"seed={seed}: accepted is an integer from 0 to {_SEEDS - 1}")
    config, actions = stored.agent.config, stored.agent.num_actions
    # An engine adds an environment's number to its seed: neighbouring seeds may not lie side by side.
    first = int(np.random.SeedSequence([_WATCHED, seed]).generate_state(1)[0] >> 2)
    made = make(config, num_envs=num_envs, seed=first, render=render)
    if made.num_actions != actions:
        made.close()
        raise ConfigError(f"game={config.game}: has {made.num_actions} actions; accepted are {actions}, as in training")
    return made


def play(
    stored: Stored,
    *,
    episodes: int,
    num_envs: int,
    seed: int,
    greedy: bool,
    progress: Callable[[int], None] | None = None,
) -> Games:
    """Plays `episodes` games with fixed parameters; `progress` is told how many have ended, after each step.

    Every environment plays the same number of games, to within one, so that short games are not over-represented.
    """
    num_envs = min(num_envs, episodes)
    rounds = [len(part) for part in np.array_split(np.arange(episodes), num_envs)]
    watched = environment(stored, num_envs=num_envs, seed=seed)
    act = jax.jit(functools.partial(stored.agent.act, greedy=greedy))
    state = stored.agent.initial_state(num_envs)
    key = jax.random.key(seed)
    returns, lengths, games = np.zeros(num_envs), np.zeros(num_envs, int), np.zeros(num_envs, int)
    finished: list[tuple[float, int, bool]] = []
    timestep, _ = watched.reset()
    step = 0
    while len(finished) < episodes:
        output, _, state = act(stored.params, stored.statistics, state, timestep, jax.random.fold_in(key, step))
        watched.send(np.asarray(output.natural_action))
        timestep, outcome = watched.recv()
        returns += outcome.score
        lengths += 1 - timestep.is_first
        most = stored.agent.config.env.max_episode_steps
        for i in np.flatnonzero(outcome.is_over):
            if games[i] < rounds[i]:
                finished.append((float(returns[i]), int(lengths[i]), bool(lengths[i] >= most)))
            games[i] += 1
            returns[i], lengths[i] = 0, 0
        step += 1
        if progress is not None:
            progress(len(finished))
    watched.close()
    scores, steps, cut = map(np.array, zip(*finished, strict=True))
    return Games(returns=scores, lengths=steps, cut=int(cut.sum()))


def evaluate(arguments: Sequence[str]) -> None:
    """The command."""
    protocol = [word for word in arguments if word.startswith("env.")]
    options = cli.parse(Options, [word for word in arguments if word not in protocol])
    stored = load_agent(options.run, best=options.checkpoint == "best")
    env = cli.override(stored.agent.config.env, protocol, "env", _PROTOCOL)
    config = dataclasses.replace(stored.agent.config, env=env)
    with Progress(console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty()) as bar:
        task = bar.add_task("games", total=options.episodes)
        games = play(
            stored._replace(agent=dataclasses.replace(stored.agent, config=config)),
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
        "stderr": standard_error(games.returns),
        "cut": games.cut,
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
    console = Console(width=120)
    console.print(table)
    if result["cut"]:
        console.print(f"{result['cut']} of them were cut at env.max_episode_steps")


if __name__ == "__main__":
    sys.exit(cli.run(evaluate))
