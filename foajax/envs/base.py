"""The host's interface to environments.

All engines show an episode's end the same way (*next-step* auto-reset): the step that ends an episode gives its last
frame; the step after it ignores its action and gives the next episode's first frame, with `is_first` and reward 0.

For the learner an episode ends as a terminal when the game is over or, with `env.episodic_life`, when a life is
lost; then the game goes on in the learner's next episode. At the step limit it ends without a terminal. (A game that
ends early among the skipped frames shows the frame before once more.)

An environment of one's own is what `game=package.module:factory` calls: `factory(num_envs=, seed=, **env.kwargs)` gives
an `Environment` of `num_envs` copies, of which copy i draws from `seed + i`. Its screens are frames of
`env.frame_shape`, gray unless `env.color`. `foajax.envs.tasks.JaxEnvironment` makes one of a pure JAX `Task`, a
`gymnasium:<id>` needs none.
"""

from __future__ import annotations

from typing import Any, Protocol, cast, runtime_checkable

import numpy as np

from foajax.types import Outcome, TimeStep


@runtime_checkable
class Environment(Protocol):
    """A batch of equal environments, stepped together by the host.

    Arrays handed out are NumPy's, in the environments' order, and never written to again.
    """

    num_envs: int  # B
    num_actions: int
    crop_top: int | None  # first of the 160 screen rows kept; None where the screen is the frame

    @property
    def lives(self) -> np.ndarray | None:
        """Left in each game after the last step, int [B]; None where games have none."""

    def reset(self) -> tuple[TimeStep, Outcome]:
        """Begins all episodes; once, before the first `send`."""

    def send(self, action: np.ndarray) -> None:
        """Starts a step with the natural actions, int32 [B], and does not wait for it."""

    def recv(self) -> tuple[TimeStep, Outcome]:
        """The step that `send` started, once every environment is through."""

    def render(self) -> np.ndarray:
        """The screens in colour, uint8 [B, h, w, 3]; of an environment made with `render`."""

    def close(self) -> None:
        """Ends the engine's threads."""


def first_step(screen: np.ndarray) -> tuple[TimeStep, Outcome]:
    """What `Environment.reset` gives, with these screens."""
    zeros, false = np.zeros(len(screen), np.float32), np.zeros(len(screen), bool)
    return TimeStep(screen, zeros, is_first=~false, is_terminal=false), Outcome(score=zeros, is_over=false)


def reads_gaze(environment: Environment) -> bool:
    """Whether its rules depend on where the agent looks."""
    return getattr(environment, "reads_gaze", False)


def send(environment: Environment, action: np.ndarray, focal_point: Any) -> None:
    """`environment.send`; one that reads the gaze is told where the screens were sensed, int32 [B, 2], too."""
    if reads_gaze(environment):
        cast(Any, environment).send(action, np.asarray(focal_point))
    else:
        environment.send(action)


def facts(environment: Environment) -> dict[str, np.ndarray] | None:
    """What the environment tells about its episodes as they stand, each [B, ...]; None where it tells nothing."""
    return cast(Any, environment).facts() if hasattr(environment, "facts") else None
