"""Defines the records that travel between the packages. Every field carries its shape.

T rollout length, B environments, H W frame, A natural and V visual actions, L width of the LSTM.
Progress is counted in `env_steps`: agent steps, summed over environments.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

SCREEN_SHAPE = (210, 160)  # rows and columns of an Atari screen

HostArray = Array | np.ndarray  # environments give NumPy arrays
Params = Any  # the network's parameters, a pytree of float32 arrays


class TimeStep(NamedTuple):
    """What B environments show after a step; the part that goes to the device.

    Attributes:
      frame: the screens, 0..255: [B, H, W], gray, or [B, H, W, 3], RGB.
      reward: what the last action earned, clipped if `env.clip_rewards`: the agent learns from it.
      is_first: whether an episode begins here. The last action was ignored then, and the reward is 0.
      is_terminal: whether the episode ends here, so that nothing follows. An episode that is cut has False.
    """

    frame: UInt8[HostArray, "B ..."]
    reward: Float[HostArray, "B"]
    is_first: Bool[HostArray, "B"]
    is_terminal: Bool[HostArray, "B"]


class Outcome(NamedTuple):
    """The part of a step that scores are counted from; it stays on the host.

    Attributes:
      score: the unclipped reward of this step.
      is_over: whether the whole game ended here. A lost life does not end it.
    """

    score: Float[HostArray, "B"]
    is_over: Bool[HostArray, "B"]


class CoreState(NamedTuple):
    """The state of the LSTM."""

    cell: Float[Array, "B L"]
    hidden: Float[Array, "B L"]


class ActorState(NamedTuple):
    """What an actor remembers between two steps."""

    core_state: Any  # the core's carry, a pytree of [B, ...]
    focal_point: Int[Array, "B 2"]  # (y, x) in frame pixels, used to sense the next frame
    age: Int[Array, "B"]  # steps since the episode began, for a scripted gaze
    last_actions: Int[Array, "B 2"] | None = None  # natural, visual; None where the network is not told
    # Prices of the last two saccades, which the next reward and the one after it pay (`Agent.act`); None where saccades
    # are free.
    owed: Float[Array, "B 2"] | None = None


class NetworkOutput(NamedTuple):
    """The four outputs of the two heads; the vision head's are None where gaze is not learned."""

    natural_logits: Float[Array, "... A"]
    natural_value: Float[Array, "..."]
    vision_logits: Float[Array, "... V"] | None
    vision_value: Float[Array, "..."] | None


class ActorOutput(NamedTuple):
    """What is recorded of one decision. In a rollout each field gains a leading [T+1]."""

    roi: tuple[Float[Array, "B h w c"], ...]  # what the sensor gave, one image a part
    focal_point: Int[Array, "B 2"]  # where it was sensed
    natural_action: Int[Array, "B"]
    vision_action: Int[Array, "B"]  # 0 where gaze is not learned
    natural_log_prob: Float[Array, "B"]  # of the action, when it was chosen
    vision_log_prob: Float[Array, "B"]
    reward: Float[Array, "B"]  # of the time step acted on, less the price of a saccade
    is_first: Bool[Array, "B"]
    is_terminal: Bool[Array, "B"]
    last_actions: Int[Array, "B 2"] | None  # natural and visual action of the step before, as the network was told
    # Mean and deviation of the frames before normalisation, for the running statistics: averages over the batch, or
    # over each device's part of it.
    frames: tuple[Float[Array, "1 ..."], ...]


class Rollout(NamedTuple):
    """T transitions of B environments: T+1 rows, the last one only to bootstrap from."""

    steps: ActorOutput  # each field [T+1, B, ...]
    core_state: Any  # the core's carry, [B, ...], enters row 0


class FrameStatistics(NamedTuple):
    """Running mean and deviation of the frames, not yet bias-corrected."""

    mean: Float[Array, "*mean"]  # one number, or one a pixel
    std: Float[Array, ""]
    weight: Float[Array, ""]  # 1 - decay^count: what the corrected values are divided by


class TrainState(NamedTuple):
    """All that training changes and a checkpoint keeps."""

    params: Params
    opt_state: Any
    statistics: FrameStatistics
    updates: Int[Array, ""]  # minibatch updates so far, those skipped included
    skipped: Int[Array, ""]  # updates skipped in a row because something was not finite
