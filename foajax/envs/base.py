"""The host's interface to environments.

All engines show an episode's end the same way (*next-step* auto-reset): the step that ends an episode gives its last
frame; the step after it ignores its action and gives the next episode's first frame, with `is_first` and reward 0.

For the learner an episode ends as a terminal when the game is over. With `env.episodic_life` a lost life ends it too,
and the game goes on in the next episode. At the step limit it ends without a terminal. If a game ends within the
skipped frames, the frame before is shown once more.

`docs/extending.md` shows how to write an environment.
"""

from __future__ import annotations

from typing import Any, Protocol, cast, runtime_checkable

import numpy as np

from foajax.types import Outcome, TimeStep


@runtime_checkable
class Environment(Protocol):
    """A batch of B equal environments, which step together.

    `game=package.module:factory` calls `factory(num_envs=, seed=, **env.kwargs)`, which returns one. Environment i of
    the batch is seeded with `seed + i`. Frames have the size `env.frame_shape` and are gray, unless `env.color`.

    The step that ends an episode returns its last frame. The step after it ignores its action and returns the first
    frame of the next episode, with `is_first` and reward 0. Return NumPy arrays, and do not write to them
    afterwards.

    If it also has `get_state` and `set_state`, as `JaxEnvironment` has, a resumed run continues its episodes.

    Attributes:
      num_envs: B.
      num_actions: how many natural actions there are, counted from 0.
      crop_top: None. If frames are whole Atari screens: the first of the 160 rows that are kept.
    """

    num_envs: int
    num_actions: int
    crop_top: int | None

    @property
    def lives(self) -> np.ndarray | None:
        """The lives left in each game after the last step, int [B]; None if games have no lives."""

    def reset(self) -> tuple[TimeStep, Outcome]:
        """Begins all episodes. It is called once, before the first `send`."""

    def send(self, action: np.ndarray) -> None:
        """Starts a step with the natural actions, int32 [B], and does not wait for it."""

    def recv(self) -> tuple[TimeStep, Outcome]:
        """Waits for the step that `send` started, and returns it."""

    def render(self) -> np.ndarray:
        """Returns the screens in colour, uint8 [B, h, w, 3], for videos and pages."""

    def close(self) -> None:
        """Frees what the environments hold, such as threads."""


def first_step(screen: np.ndarray) -> tuple[TimeStep, Outcome]:
    """Returns what `Environment.reset` has to return, with these screens."""
    zeros, false = np.zeros(len(screen), np.float32), np.zeros(len(screen), bool)
    return TimeStep(screen, zeros, is_first=~false, is_terminal=false), Outcome(score=zeros, is_over=false)


def reads_gaze(environment: Environment) -> bool:
    """Whether its rules depend on where the agent looks."""
    return getattr(environment, "reads_gaze", False)


def send(environment: Environment, action: np.ndarray, focal_point: Any) -> None:
    """Calls `environment.send`, with the focal points, int32 [B, 2], if its rules depend on where the agent looked."""
    if reads_gaze(environment):
        cast(Any, environment).send(action, np.asarray(focal_point))
    else:
        environment.send(action)


def facts(environment: Environment) -> dict[str, np.ndarray] | None:
    """Returns the facts about the current episodes by name, each [B, ...]; None if the environment has none."""
    return cast(Any, environment).facts() if hasattr(environment, "facts") else None
