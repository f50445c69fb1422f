"""Records whole games of a trained agent, with all that it saw, expected and did; every picture is made from these."""

from __future__ import annotations

import functools
import zlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt8
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from scipy.special import softmax

from foajax.config.schema import Config
from foajax.envs.atari import is_atari
from foajax.envs.base import Environment, send
from foajax.envs.base import facts as facts_of
from foajax.envs.make import action_names
from foajax.learning.agent import Agent
from foajax.runs.agents import TrainedAgent
from foajax.sensors.sense import sense
from foajax.types import ActorOutput, ActorState, FrameStatistics, NetworkOutput, Params, TimeStep
from foajax.viewing import games

OnStep = Callable[[int, float], None]  # told the steps played so far and the score


class Screens(Sequence):
    """Colour screens, uint8 [h, w, 3], each compressed: ten minutes of a game fit into some 30 MB."""

    def __init__(self) -> None:
        self._packed: list[bytes] = []
        self.shape: tuple[int, ...] = (0, 0, 3)  # of each

    def append(self, screen: UInt8[np.ndarray, "h w 3"]) -> None:
        self.shape = screen.shape
        self._packed.append(zlib.compress(screen.tobytes(), 1))

    def __len__(self) -> int:
        return len(self._packed)

    def __getitem__(self, index):
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        return np.frombuffer(zlib.decompress(self._packed[index]), np.uint8).reshape(self.shape)


class Recording(NamedTuple):
    """One game, from its first screen to its last: N screens and N decisions.

    Row t is what was seen at t and what was decided upon it. `score` includes what the action at t - 1
    earned. The action decided at the last row of a life or of the game has no effect.
    """

    config: Config
    env_steps: int  # the agent has been trained for
    seed: int
    greedy: bool  # whether the agent took its likeliest actions, not sampled ones
    actions: tuple[str, ...]  # names of the natural actions
    crop_top: int | None  # screen row at which the frame begins; None where it is the whole screen
    is_over: bool  # False where the recording was cut
    screens: Screens
    mean_frame: Float[np.ndarray, "H W *C"]  # over the game, 0 to 1
    focal_point: Int[np.ndarray, "N 2"]  # (y, x) in frame pixels
    # The sensor's values in the packed layout, 255 times: [N, h, w] or, in colour, [N, h, w, 3] each.
    images: tuple[UInt8[np.ndarray, "N _ _ *C"], ...]
    natural_probs: Float[np.ndarray, "N A"]
    natural_value: Float[np.ndarray, "N"]
    natural_action: Int[np.ndarray, "N"]
    vision_probs: Float[np.ndarray, "N V"] | None  # None where gaze is not learned, like its value
    vision_value: Float[np.ndarray, "N"] | None
    vision_action: Int[np.ndarray, "N"]
    score: Float[np.ndarray, "N"]  # of the game so far, unclipped
    lives: Int[np.ndarray, "N"] | None  # None where the game has none
    is_first: np.ndarray  # bool [N]: the learner's episode starts, with memory and gaze reset
    facts: dict[str, np.ndarray] | None = None  # about the last episode, where the task tells any

    @property
    def values(self) -> UInt8[np.ndarray, "N n *C"]:
        """The values of all images of each step, one after the other."""
        parts = [part.reshape(len(part), -1, *self.config.env.pixel_shape) for part in self.images]
        return np.concatenate(parts, axis=1)

    @property
    def white(self) -> int:
        """The largest of `values`, at least 1. It is drawn white throughout the game, so that nothing flickers."""
        return max(1, *(int(part.max()) for part in self.images))

    @property
    def title(self) -> str:
        """The experiment and the game."""
        return f"{self.config.name} on {self.config.game}"

    @property
    def about(self) -> str:
        """The agent's training, its policy and the game's seed, in one line."""
        policy = "likeliest actions" if self.greedy else "sampled actions"
        return f"{self.env_steps:,} env_steps of training, {policy}, game {self.seed}"

    @property
    def life_lost(self) -> np.ndarray:
        """Bool [N]: the steps at which the game has fewer lives than at the step before."""
        if self.lives is None:
            return np.zeros(len(self.score), bool)
        return np.diff(self.lives, prepend=self.lives[0]) < 0

    @property
    def frame_origin(self) -> tuple[float, float, float]:
        """The screen row at which the frame begins, and screen pixels per frame pixel, down and across."""
        height, width = self.config.env.frame_shape
        if self.crop_top is None:
            return 0.0, self.screens.shape[0] / height, self.screens.shape[1] / width
        return float(self.crop_top), 2.0, 2.0


class _Row(NamedTuple):
    """What one step adds to a recording, still on the device."""

    output: ActorOutput
    network: NetworkOutput
    images: list[Array]


def record(
    stored: TrainedAgent,
    *,
    episodes: int = 1,
    seed: int = 0,
    greedy: bool = False,
    max_steps: int | None = None,
    progress: OnStep | None = None,
) -> Iterator[Recording]:
    """Plays whole games, one after another. Each equals the first game of `evaluate` with its seed and `num_envs=1`.

    Args:
      stored: the agent.
      episodes: how many games.
      seed: of the first game and of its sampled actions; the next game has the next seed.
      greedy: whether the likeliest actions are taken.
      max_steps: decisions after which a game is cut; None for a whole game.
      progress: called after each step with the steps so far and the score.

    Raises:
      ConfigError: the game cannot be played here.
    """
    config = stored.agent.config
    names = action_names(config) or tuple(f"action {i}" for i in range(stored.agent.num_actions))
    decide = jax.jit(functools.partial(_decide, stored.agent, greedy))
    for game in range(seed, seed + episodes):
        environment = games.environment(stored, num_envs=1, seed=game, render=_renders(config))
        try:
            played = _play(environment, stored, decide, jax.random.key(game), max_steps, progress)
        finally:
            environment.close()
        yield Recording(
            config=config,
            env_steps=stored.env_steps,
            seed=game,
            greedy=greedy,
            actions=names,
            crop_top=stored.agent.crop_top,
            **played,
        )


def _play(
    environment: Environment,
    stored: TrainedAgent,
    decide: Callable[..., tuple[_Row, Array, ActorState]],
    key: PRNGKeyArray,
    max_steps: int | None,
    progress: OnStep | None,
) -> dict[str, Any]:
    """Plays one game; returns the fields of a recording that come from playing."""
    config, state = stored.agent.config, stored.agent.initial_state(1)
    timestep, outcome = environment.reset()
    screens, total = Screens(), np.zeros((*config.env.frame_shape, *config.env.pixel_shape))
    rows: list[_Row] = []
    scores: list[float] = []
    lives: list[int] = []
    while True:
        step_key = jax.random.fold_in(key, len(rows))
        row, frame, state = decide(stored.params, stored.statistics, state, timestep, step_key)
        screens.append(environment.render()[0] if _renders(config) else _rgb(np.asarray(timestep.frame)[0]))
        scores.append((scores[-1] if scores else 0.0) + float(outcome.score[0]))
        lives.append(0 if environment.lives is None else int(environment.lives[0]))
        rows.append(jax.device_get(row))
        total += np.asarray(frame)
        if progress is not None:
            progress(len(rows), scores[-1])
        if outcome.is_over[0] or len(rows) == max_steps:
            break
        send(environment, np.asarray(row.output.natural_action), row.output.focal_point)
        timestep, outcome = environment.recv()
        if outcome.is_over[0] and timestep.is_first[0]:
            break  # the engine reports the game's end together with the next game's first screen
    about = facts_of(environment)
    return {
        "facts": None if about is None else {name: values[0] for name, values in about.items()},
        "is_over": bool(outcome.is_over[0]),
        "screens": screens,
        "mean_frame": (total / len(rows)).astype(np.float32),
        "score": np.array(scores, np.float32),
        "lives": np.array(lives) if any(lives) else None,
        **_columns(rows),
    }


def _decide(
    agent: Agent,
    greedy: bool,
    params: Params,
    statistics: FrameStatistics,
    state: ActorState,
    timestep: TimeStep,
    key: PRNGKeyArray,
) -> tuple[_Row, Float[Array, "H W *C"], ActorState]:
    """Makes one decision; returns it with the frame and what the packed sensor gives of it before normalisation."""
    output, network, state = agent.act(params, statistics, state, timestep, key, greedy=greedy)
    frame = agent.frame(timestep.frame)[0]
    images = sense(frame, output.focal_point[0], sensor=agent.sensor.packed)
    levels = [jnp.round(255 * image.reshape(*image.shape[:2], *frame.shape[2:])).astype(jnp.uint8) for image in images]
    return _Row(output._replace(roi=(), frames=()), network, levels), frame, state


def _renders(config: Config) -> bool:
    """Whether the engine can render colour screens; ale-py's vector environment gives only the agent's frames."""
    return config.env.engine != "ale" or not is_atari(config)


def _columns(rows: Sequence[_Row]) -> dict[str, Any]:
    """Joins the decisions row by row; returns the fields of a recording that come from them."""
    outputs, networks, images = zip(*rows, strict=True)
    learned = networks[0].vision_logits is not None

    def column(records: Sequence, name: str) -> np.ndarray:
        return np.concatenate([getattr(each, name) for each in records])

    return {
        "focal_point": column(outputs, "focal_point"),
        "images": tuple(np.stack(part) for part in zip(*images, strict=True)),
        "natural_probs": softmax(column(networks, "natural_logits"), axis=-1),
        "natural_value": column(networks, "natural_value"),
        "natural_action": column(outputs, "natural_action"),
        "vision_probs": softmax(column(networks, "vision_logits"), axis=-1) if learned else None,
        "vision_value": column(networks, "vision_value") if learned else None,
        "vision_action": column(outputs, "vision_action"),
        "is_first": column(outputs, "is_first"),
    }


def _rgb(screen: np.ndarray) -> np.ndarray:
    return screen if screen.ndim == 3 else np.repeat(screen[..., None], 3, axis=-1)


def watch(stored: TrainedAgent, bar: Progress, *, episodes: int = 1, seed: int, **how: Any) -> Iterator[Recording]:
    """Plays games like `record`, with a progress bar for each."""

    def progress(steps: int, score: float) -> None:
        bar.update(task, completed=steps, note=f"{steps:,} steps, score {score:g}")

    games = record(stored, episodes=episodes, seed=seed, progress=progress, **how)
    for game in range(seed, seed + episodes):
        task = bar.add_task(f"game {game}", total=how["max_steps"], note="starts")
        yield next(games)
        bar.update(task, total=bar.tasks[task].completed)


def progress_bar() -> Progress:
    """Makes progress bars that end with a note, on stderr: stdout has the results."""
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[note]}"), TimeRemainingColumn())
    return Progress(*columns, console=Console(stderr=True))
