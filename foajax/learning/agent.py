"""The agent: preprocess, sense, decide, move the gaze. Pure functions closed over one experiment."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, Num, PRNGKeyArray, UInt8

from foajax.config.parse import refuse
from foajax.config.schema import Config, OwnSensor, check_window
from foajax.learning.losses import log_prob
from foajax.networks import network as networks
from foajax.networks.cores import Carry
from foajax.sensors import frames, gaze
from foajax.sensors.base import Sensor
from foajax.sensors.registry import make_sensor
from foajax.sensors.sense import sense
from foajax.types import (
    SCREEN_SHAPE,
    ActorOutput,
    ActorState,
    FrameStatistics,
    HostArray,
    NetworkOutput,
    Params,
    Rollout,
    TimeStep,
)


@dataclasses.dataclass(frozen=True)
class Agent:
    """An experiment's agent as pure functions. It holds no arrays.

    Attributes:
      config: of the run.
      num_actions: how many natural actions the game has.
      crop_top: the first row of an Atari screen that is kept; None if screens are frames already.
    """

    config: Config
    num_actions: int
    crop_top: int | None

    def __post_init__(self) -> None:
        check_window(self.config, self.sensor)

    @property
    def sensor(self) -> Sensor:
        """The sensor that the configuration asks for."""
        return make_sensor(self.config.sensor)

    @property
    def network(self) -> networks.Network:
        """The network, without its parameters."""
        config = self.config
        num_vision_actions = config.gaze.num_actions if config.gaze.learned else 0
        return networks.Network(config.network, self.num_actions, num_vision_actions)

    @property
    def image_shapes(self) -> tuple[tuple[int, int, int], ...]:
        """The shapes of the sensor's images: (h, w, 1) or, in colour, (h, w, 3)."""
        env = self.config.env
        return tuple((*shape, math.prod(env.pixel_shape)) for shape in self.sensor.image_shapes(env.frame_shape))

    @property
    def screen_shape(self) -> tuple[int, ...]:
        """The shape of the environment's screens: [H, W] or, in colour, [H, W, 3]."""
        env = self.config.env
        return (*(env.frame_shape if self.crop_top is None else SCREEN_SHAPE), *env.pixel_shape)

    def initial_params(self, key: PRNGKeyArray) -> Params:
        """Draws the network's first parameters."""
        side = self.side(jnp.zeros((1, 2), jnp.int32), jnp.zeros((1, 2), jnp.int32), jnp.zeros(1), jnp.zeros(1, bool))
        return networks.initial_params(self.network, key, self.image_shapes, side.shape[-1])

    def initial_statistics(self) -> FrameStatistics:
        """Frame statistics before any frame."""
        env = self.config.env
        return frames.initial_statistics((*env.frame_shape, *env.pixel_shape) if self._by_pixel else ())

    def initial_state(self, batch: int) -> ActorState:
        """Returns the state of `batch` actors before their first step, whose `is_first` has to be true."""
        return ActorState(
            core_state=networks.initial_core_state(self.network, batch),
            focal_point=jnp.zeros((batch, 2), jnp.int32),
            age=jnp.zeros((batch,), jnp.int32),
            last_actions=jnp.zeros((batch, 2), jnp.int32) if self.config.network.last_actions else None,
            owed=jnp.zeros((batch, 2)) if self.config.gaze.cost else None,
        )

    def act(
        self,
        params: Params,
        statistics: FrameStatistics,
        state: ActorState,
        timestep: TimeStep,
        key: Key[Array, "*actors"],
        *,
        greedy: bool = False,
    ) -> tuple[ActorOutput, NetworkOutput, ActorState]:
        """Decides once for each actor. The visual action moves the focal point at which the *next* frame is sensed.

        Saccades are paid one step late. The move chosen at t serves the decision at t+1, so its price is taken from
        the reward R_{t+2} of that decision. That is the reward that credits the move (`returns.vision_stream`): both
        heads see the price in their returns, the vision head right after the move. Before an end nothing is paid.

        Args:
          params: the network's parameters.
          statistics: the frames' mean and deviation.
          state: of the actors, from `initial_state` or from the last call.
          timestep: what the environments show.
          key: one random key; or one per actor, so that an actor's samples do not depend on the others.
          greedy: whether the likeliest actions are taken; else both policies are sampled.

        Returns:
          The decisions (`natural_action`, `vision_action`, `focal_point` and more), the network's outputs, and the
          actors' next state.
        """
        actors = state.age.shape[0]
        keys = jax.random.split(key, actors) if key.ndim == 0 else key
        start_key, natural_key, vision_key = jax.vmap(lambda k: jax.random.split(k, 3), out_axes=1)(keys)
        focal_point, age = self.look(start_key, state, timestep)
        roi, frame_mean, frame_std = self.see(timestep.frame, focal_point, statistics)
        images = [image[None] for image in roi]
        is_first = jnp.asarray(timestep.is_first)
        reward, owed = _pay(jnp.asarray(timestep.reward), state.owed, is_first)
        side = self.side(focal_point, state.last_actions, reward, is_first)
        output, core_state = self.forward(params, images, side[None], is_first[None], state.core_state)
        output = jax.tree.map(lambda x: x[0], output)
        natural_action = _choose(natural_key, output.natural_logits, greedy)
        vision_action, vision_log_prob = self.choose_vision(vision_key, output, greedy)
        actor_output = ActorOutput(
            roi=roi,
            focal_point=focal_point,
            natural_action=natural_action,
            vision_action=vision_action,
            natural_log_prob=log_prob(output.natural_logits, natural_action),
            vision_log_prob=vision_log_prob,
            reward=reward,
            is_first=is_first,
            is_terminal=jnp.asarray(timestep.is_terminal),
            last_actions=state.last_actions,
            frames=(jnp.mean(frame_mean, axis=0, keepdims=True), jnp.mean(frame_std, keepdims=True)),
        )
        told = state.last_actions is not None
        moved = self.move(focal_point, vision_action, age + 1)
        state = ActorState(
            core_state=core_state,
            focal_point=moved,
            age=age + 1,
            last_actions=jnp.stack([natural_action, vision_action], axis=-1) if told else None,
            owed=None if owed is None else jnp.stack([owed, self.price(focal_point, moved)], axis=-1),
        )
        return actor_output, output, state

    def unroll(self, params: Params, rollout: Rollout) -> NetworkOutput:
        """Applies the network to a whole rollout; each output is [T+1, B, ...]."""
        steps = rollout.steps
        side = self.side(steps.focal_point, steps.last_actions, steps.reward, steps.is_first)
        return self.forward(params, list(steps.roi), side, steps.is_first, rollout.core_state)[0]

    def forward(self, params: Params, *inputs: Any) -> tuple[NetworkOutput, Carry]:
        """Applies the network to T steps; `inputs` are those of `networks.Network`."""
        return cast(tuple[NetworkOutput, Carry], self.network.apply(params, *inputs))

    def see(
        self, screen: UInt8[HostArray, "B ..."], focal_point: Int[Array, "B 2"], statistics: FrameStatistics
    ) -> tuple[tuple[Array, ...], Float[Array, "B ..."], Float[Array, "B"]]:
        """Returns the sensor's images of normalised frames, and each frame's part in the running statistics.

        Without normalisation and crop it reads only what the sensor looks at: then the cost of a decision does not grow
        with the frame. (A peripheral grid of means looks at all of it.) The statistics' parts are zeros then.
        """
        own = isinstance(self.config.sensor, OwnSensor)  # which may not scale with the frame
        if self.config.network.normalization == "none" and self.crop_top is None and not own:
            self.check(screen)
            none = jnp.zeros(screen.shape[0])
            roi = self.sense(jnp.asarray(screen), focal_point)
            return tuple(image * jnp.float32(1 / 255) for image in roi), none, none
        frame = self.frame(screen)
        if self._by_pixel:
            mean, std = jax.vmap(lambda f: frames.pixel_statistics(f, statistics))(frame)
        else:
            mean, std = jax.vmap(frames.frame_statistics)(frame)
        mode = self.config.network.normalization
        normalised = jax.vmap(lambda f: frames.normalise(f, statistics, mode=mode))(frame)
        return self.sense(normalised, focal_point), mean, std

    def frame(self, screen: UInt8[HostArray, "B ..."]) -> Float[Array, "B H W *C"]:
        """Turns screens into frames in [0, 1]; raises `ValueError` as `check` does."""
        self.check(screen)
        return jax.vmap(lambda s: frames.to_frame(s, self.crop_top))(jnp.asarray(screen))

    def check(self, screen: UInt8[HostArray, "B ..."]) -> None:
        """Raises `ValueError` unless screens have the type and shape that the agent was trained with."""
        shape = self.screen_shape
        if screen.dtype != jnp.uint8 or screen.shape[1:] != shape:
            accepted = f"uint8 [B, {', '.join(map(str, shape))}], {'RGB' if self.config.env.color else 'gray'}"
            raise refuse("frame", f"{screen.dtype} {list(screen.shape)}", accepted)

    def look(self, key: Key[Array, "B"], state: ActorState, timestep: TimeStep) -> tuple[Array, Array]:
        """Returns this step's focal points and the actors' ages in steps. Both begin anew with an episode."""
        age = jnp.where(timestep.is_first, 0, state.age)
        if self.config.gaze.mode == "scripted":
            return jax.vmap(lambda a: gaze.scripted(a, **self._gaze))(age), age
        first = jax.vmap(lambda k: gaze.start(k, **self._gaze))(key)
        return jnp.where(timestep.is_first[:, None], first, state.focal_point), age

    def move(self, focal_point: Int[Array, "B 2"], vision_action: Int[Array, "B"], age: Int[Array, "B"]) -> Array:
        """Returns the focal points at which the next frames are sensed."""
        if self.config.gaze.mode == "scripted":
            return jax.vmap(lambda a: gaze.scripted(a, **self._gaze))(age)
        if self.config.gaze.mode in ("none", "frozen"):
            return focal_point
        return jax.vmap(lambda p, a: gaze.move(p, a, **self._gaze))(focal_point, vision_action)

    def price(self, before: Int[Array, "B 2"], after: Int[Array, "B 2"]) -> Float[Array, "B"]:
        """Returns what the saccades from `before` to `after` cost, in units of reward."""
        return jax.vmap(functools.partial(gaze.price, gaze=self.config.gaze))(before, after)

    def choose_vision(self, key: Key[Array, "B"], output: NetworkOutput, greedy: bool) -> tuple[Array, Array]:
        """Returns visual actions, learned, random or 0 (stay), and their log-probabilities, 0 unless learned."""
        batch = output.natural_value.shape
        if output.vision_logits is not None:
            action = _choose(key, output.vision_logits, greedy)
            return action, log_prob(output.vision_logits, action)
        if self.config.gaze.mode == "random":
            draw = jax.vmap(lambda k: jax.random.randint(k, (), 0, self.config.gaze.num_actions))
            return draw(key), jnp.zeros(batch)
        return jnp.zeros(batch, jnp.int32), jnp.zeros(batch)

    def sense(self, frame: Num[Array, "B H W *C"], focal_point: Int[Array, "B 2"]) -> tuple[Array, ...]:
        """Returns the sensor's images of each frame, [B, h, w, 1] or, in colour, [B, h, w, 3]."""
        look = functools.partial(sense, sensor=self.sensor, bounds=self.config.gaze.sense_bounds)
        return jax.vmap(look)(frame, focal_point)

    def side(
        self,
        focal_point: Int[Array, "... 2"],
        last_actions: Int[Array, "... 2"] | None,
        reward: Float[Array, "..."],
        is_first: Bool[Array, "..."],
    ) -> Float[Array, "... S"]:
        """Returns what the core is told beside the images, as configured; S may be 0.

        It is the focal point; then, of the step before, the natural and the visual action as one-hot vectors and the
        reward that is learned from. Where an episode starts, these last three are 0.
        """
        parts = [jnp.zeros((*reward.shape, 0))]
        network = self.config.network
        if self._sees_focal_point:
            parts.append(self._scaled(focal_point))
        going_on = (1.0 - is_first.astype(jnp.float32))[..., None]
        if network.last_actions and last_actions is not None:
            counts = (self.num_actions, self.network.num_vision_actions)
            parts += [going_on * jax.nn.one_hot(last_actions[..., i], n) for i, n in enumerate(counts)]
        if network.last_reward:
            parts.append(going_on * reward[..., None])
        return jnp.concatenate(parts, axis=-1)

    def _scaled(self, focal_point: Int[Array, "... 2"]) -> Float[Array, "... 2"]:
        """Scales focal points to [-1, 1] over the gaze's reach or, with `network.focal_scale=frame`, over the frame."""
        if self.config.network.focal_scale == "frame":
            return gaze.to_unit(focal_point, self.config.env.frame_shape)
        return gaze.to_reach(focal_point, **self._gaze)

    @property
    def _sees_focal_point(self) -> bool:
        # A packed image does not tell where it was taken. Nor does a canvas whose normalisation makes 0 of what never
        # changes, as of what is outside: between two rows of Breakout's empty middle it is the same.
        config = self.config
        return not self.sensor.in_place or (config.network.focal_point == "always" and config.gaze.mode != "none")

    @property
    def _by_pixel(self) -> bool:
        return self.config.network.normalization == "pixel"

    @property
    def _gaze(self) -> dict:
        config = self.config
        window = gaze.bounded(config.gaze, self.sensor)
        return {"gaze": config.gaze, "window": window, "frame_shape": config.env.frame_shape}


def _pay(
    reward: Float[Array, "B"], owed: Float[Array, "B 2"] | None, is_first: Bool[Array, "B"]
) -> tuple[Float[Array, "B"], Float[Array, "B"] | None]:
    """Subtracts the due price from the reward; returns it and the price due next. A new episode owes nothing."""
    if owed is None:
        return reward, None
    owed = jnp.where(is_first[:, None], 0.0, owed)
    return reward - owed[:, 0], owed[:, 1]


def _choose(key: Key[Array, "B"], logits: Float[Array, "B A"], greedy: bool) -> Int[Array, "B"]:
    action = jnp.argmax(logits, axis=-1) if greedy else jax.vmap(jax.random.categorical)(key, logits)
    return action.astype(jnp.int32)
