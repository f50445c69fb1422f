"""Plays whole games with a trained agent, whose parameters stay fixed, for its scores."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from foajax.config.parse import refuse, replace
from foajax.envs.base import Environment, facts, send
from foajax.envs.make import make
from foajax.envs.measures import Facts, pooled
from foajax.runs.agents import TrainedAgent

_SEEDS = 2**31  # seeds to choose from
_WATCHED = 1_000_003  # mixed into them by `np.random.SeedSequence`, so that they differ from the seeds of training


class Games(NamedTuple):
    """Whole games, in the order in which they ended."""

    returns: np.ndarray  # [episodes] unclipped
    lengths: np.ndarray  # [episodes] agent steps
    cut: int  # how many of them reached `env.max_episode_steps`
    facts: Facts = {}  # about each game, where the task tells any (`foajax.envs.measures`)


def environment(stored: TrainedAgent, *, num_envs: int, seed: int, render: bool = False) -> Environment:
    """Makes the game that an agent was trained in, with seeds apart from those of training.

    Visual search has no staircase here: scenes are as hard as `search` says from the first one on.

    Raises:
      ConfigError: a seed out of range; no such game; a game with another number of actions than in training.
    """
    if not 0 <= seed < _SEEDS:
        raise refuse("seed", seed, f"an integer from 0 to {_SEEDS - 1}")
    config, actions = stored.agent.config, stored.agent.num_actions
    # An engine adds an environment's number to its seed, so neighbouring seeds are moved far apart.
    first = int(np.random.SeedSequence([_WATCHED, seed]).generate_state(1)[0] >> 2)
    config = replace(config, search=replace(config.search, staircase=False))
    made = make(config, num_envs=num_envs, seed=first, render=render)
    if made.num_actions != actions:
        made.close()
        raise refuse("game", config.game, f"{actions}, as in training", why=f"has {made.num_actions} actions")
    return made


def play(
    stored: TrainedAgent,
    *,
    episodes: int,
    num_envs: int,
    seed: int,
    greedy: bool,
    progress: Callable[[int], None] | None = None,
) -> Games:
    """Plays `episodes` games with fixed parameters; after each step, tells `progress` how many have ended.

    Every environment plays the same number of games, or one less, so that short games are not over-represented.
    """
    num_envs = min(num_envs, episodes)
    rounds = [len(part) for part in np.array_split(np.arange(episodes), num_envs)]
    watched = environment(stored, num_envs=num_envs, seed=seed)
    state = stored.agent.initial_state(num_envs)
    key = jax.random.key(seed)
    returns, lengths, games = np.zeros(num_envs), np.zeros(num_envs, int), np.zeros(num_envs, int)
    finished: list[tuple[float, int, bool]] = []
    tables: list[Facts] = []
    timestep, _ = watched.reset()
    step = 0
    while len(finished) < episodes:
        now = jax.random.fold_in(key, step)
        output, _, state = stored.act(stored.params, stored.statistics, state, timestep, now, greedy=greedy)
        send(watched, np.asarray(output.natural_action), output.focal_point)
        timestep, outcome = watched.recv()
        returns += outcome.score
        lengths += 1 - timestep.is_first
        most = stored.agent.config.env.max_episode_steps
        counted = outcome.is_over & (games < rounds)
        if counted.any() and (about := facts(watched)) is not None:
            tables.append({name: values[counted] for name, values in about.items()})
        for i in np.flatnonzero(outcome.is_over):
            if counted[i]:
                finished.append((float(returns[i]), int(lengths[i]), bool(lengths[i] >= most)))
            games[i] += 1
            returns[i], lengths[i] = 0, 0
        step += 1
        if progress is not None:
            progress(len(finished))
    watched.close()
    scores, steps, cut = map(np.array, zip(*finished, strict=True))
    return Games(returns=scores, lengths=steps, cut=int(cut.sum()), facts=pooled(tables))
