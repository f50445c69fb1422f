"""The sensors for other libraries: Gymnasium environments whose pixels are looked at through a gaze.

An action is `{"natural": the environment's own, "vision": 0 .. V-1}`, a visual action as in
`foajax.sensors.gaze`. It moves the focal point before the frame that the step leads to is sensed, as in
`foajax.learning.agent`; where an episode starts, the focal point is at the gaze's start instead.

An observation is `{"image": [h, w, c], "focal_point": [2]}`, or `image_0`, `image_1`, ... where the
sensor gives several images (see `foajax.sensors.sense.sense`). Images are float32 in the range of the
environment's pixels, uint8 scaled to [0, 1], with 0 for what is hidden; colours are kept. The focal
point is (y, x) in [-1, 1].
"""

from __future__ import annotations

import dataclasses
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from jaxtyping import Array, Bool, Float, Int, Num, UInt32

from foajax.config.compose import compose
from foajax.config.parse import refuse, replace
from foajax.config.schema import Config, EnvConfig, GazeConfig, OwnSensor, SensorConfig, check_window
from foajax.sensors import gaze as gazes
from foajax.sensors.base import Sensor
from foajax.sensors.registry import make_sensor
from foajax.sensors.sense import sense

AnySensor = SensorConfig | Sensor | str
_SEEDS = 2**32


class FoveatedObservation(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):
    """One environment, seen through a sensor.

    Args:
      env: observes a `Box` of uint8 or float pixels, [H, W], [H, W, 1] or [H, W, 3], of 8x8 and more.
      sensor: a sensor, or the name of an experiment whose sensor and gaze it stands for.
      gaze: how the focal point moves; None for the experiment's, or the defaults. A random start is
        drawn from the environment's `np_random`.

    Raises:
      ConfigError: not a pixel environment, a sensor that is none or does not fit its frames, an unknown name, or a gaze
        that is none or takes no visual actions.
    """

    def __init__(self, env: gymnasium.Env, sensor: AnySensor, gaze: GazeConfig | None = None) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(self, sensor=sensor, gaze=gaze)
        gymnasium.Wrapper.__init__(self, env)
        self._eye = _Eye.of(env.observation_space, sensor, gaze)
        self.observation_space = self._eye.observation_space
        self.action_space = self._eye.action_space(env.action_space)
        self._look = jax.jit(self._eye.look)
        self._focal_point = np.zeros(2, np.int32)
        self._ended = False  # where the environment restarts by itself, the next step begins an episode

    @property
    def focal_point(self) -> np.ndarray:
        """(y, x) in frame pixels, int32 [2]: where the last frame was sensed."""
        return self._focal_point

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """Begins an episode, with the focal point at the gaze's start."""
        frame, info = self.env.reset(seed=seed, options=options)
        self._ended = False
        return self._observe(frame, np.zeros((), np.int32), True), info

    def step(self, action: dict[str, Any]) -> tuple[dict, Any, bool, bool, dict]:
        """Takes the natural action, moves the focal point and senses the new frame there.

        `ValueError` for what is not a visual action.
        """
        vision_action = self._eye.checked(action["vision"], ())
        frame, reward, terminated, truncated, info = self.env.step(action["natural"])
        observation = self._observe(frame, vision_action, self._ended)
        self._ended = bool(terminated or truncated)
        return observation, reward, terminated, truncated, info

    def _observe(self, frame: np.ndarray, vision_action: np.ndarray, is_first: bool) -> dict[str, np.ndarray]:
        drawn = is_first and self._eye.gaze.start == "random"
        seed = self.env.unwrapped.np_random.integers(_SEEDS) if drawn else 0
        arguments = self._focal_point, vision_action, np.bool_(is_first), np.uint32(seed)
        observation, focal_point = self._look(self._eye.pixels(frame), *arguments)
        self._focal_point = np.array(focal_point)
        return {name: np.array(value) for name, value in observation.items()}


class FoveatedVectorObservation(gymnasium.vector.VectorWrapper):
    """Many environments at once, seen through a sensor each: one dispatch senses all frames.

    Wrap the vector environment, not its members: JAX does not survive the forks of `AsyncVectorEnv`.

    Args:
      env: as in `FoveatedObservation`; its episodes restart on the next step or not by themselves.
      sensor: as in `FoveatedObservation`.
      gaze: as in `FoveatedObservation`. Random starts are drawn from a generator of the wrapper's own, seeded by
        `reset(seed=)`.

    Raises:
      ConfigError: as in `FoveatedObservation`, or episodes that restart on the step that ends them.
    """

    def __init__(self, env: gymnasium.vector.VectorEnv, sensor: AnySensor, gaze: GazeConfig | None = None) -> None:
        super().__init__(env)
        mode = env.metadata.get("autoreset_mode")
        if mode not in (AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED):
            raise refuse("autoreset_mode", mode, "AutoresetMode.NEXT_STEP or DISABLED")
        self._restarts = mode == AutoresetMode.NEXT_STEP
        self._eye = _Eye.of(env.single_observation_space, sensor, gaze)
        self._single_observation_space = self._eye.observation_space
        self._observation_space = batch_space(self._single_observation_space, env.num_envs)
        self._single_action_space = self._eye.action_space(env.single_action_space)
        self._action_space = batch_space(self._single_action_space, env.num_envs)
        self._look = jax.jit(jax.vmap(self._eye.look))
        self._random = np.random.default_rng()
        self._focal_point = np.zeros((env.num_envs, 2), np.int32)
        self._ended = np.zeros(env.num_envs, bool)  # whose next step begins an episode

    @property
    def focal_point(self) -> np.ndarray:
        """(y, x) in frame pixels, int32 [B, 2]: where the last frames were sensed."""
        return self._focal_point

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """Begins the episodes, those of `options["reset_mask"]` where it is given; `seed` may be a list."""
        if seed is not None:
            self._random = np.random.default_rng([s or 0 for s in np.atleast_1d(seed)])
        started = np.array((options or {}).get("reset_mask", np.ones(self.num_envs, bool)))
        frame, info = self.env.reset(seed=seed, options=options)
        self._ended = self._ended & ~started
        return self._observe(frame, np.zeros(self.num_envs, np.int32), started), info

    def step(self, actions: dict[str, Any]) -> tuple[dict, Any, Any, Any, dict]:
        """A step of each; the one after an episode's last ignores its actions and begins the next."""
        vision_action = self._eye.checked(actions["vision"], (self.num_envs,))
        frame, reward, terminated, truncated, info = self.env.step(actions["natural"])
        observation = self._observe(frame, vision_action, self._ended)
        self._ended = (terminated | truncated) & self._restarts
        return observation, reward, terminated, truncated, info

    def _observe(self, frame: np.ndarray, vision_action: np.ndarray, is_first: np.ndarray) -> dict[str, np.ndarray]:
        seed = self._random.integers(_SEEDS, size=self.num_envs, dtype=np.uint32)
        arguments = self._focal_point, vision_action, is_first, seed
        observation, focal_point = self._look(self._eye.pixels(frame), *arguments)
        self._focal_point = np.array(focal_point)
        return {name: np.array(value) for name, value in observation.items()}


@dataclasses.dataclass(frozen=True)
class _Eye:
    """What both wrappers do with one frame; holds no state."""

    box: spaces.Box  # of the environment's frames
    sensor: Sensor
    gaze: GazeConfig

    @classmethod
    def of(cls, space: gymnasium.Space, sensor: AnySensor, gaze: GazeConfig | None) -> _Eye:
        """Checks that the parts fit each other."""
        box = _pixels(space)
        if isinstance(sensor, str):
            experiment = compose([f"experiment={sensor}"])
            sensor, gaze = experiment.sensor, gaze or replace(experiment.gaze, mode="learned")
        gaze = gaze or GazeConfig()
        if not isinstance(sensor, SensorConfig | Sensor):
            raise refuse("sensor", sensor, "a RingSensor, a LogPolarSensor or an experiment's name")
        if not isinstance(gaze, GazeConfig):
            raise refuse("gaze", gaze, "a GazeConfig")
        if not gaze.learned:
            raise refuse("gaze.mode", gaze.mode, "learned, for visual actions from outside")
        # What a run is checked for, a wrapped environment is checked for too. But the whole frame may be a baseline
        # here, which a gaze that has to move is refused.
        still = replace(gaze, mode="frozen")
        env = EnvConfig(frame_shape=(box.shape[0], box.shape[1]))
        known = sensor if isinstance(sensor, SensorConfig) else OwnSensor(kind=type(sensor).__name__)
        made = make_sensor(sensor)
        check_window(Config(name="wrapper", sensor=known, gaze=still, env=env), made.window)
        return cls(box=box, sensor=made, gaze=gaze)

    @property
    def observation_space(self) -> gymnasium.Space:
        """Of one environment."""
        low, high = self.range
        height, width, *channels = self.box.shape
        shapes = [(h, w, *(channels or [1])) for h, w in self.sensor.image_shapes((height, width))]
        images = self.named([spaces.Box(low, high, shape, np.float32) for shape in shapes])
        return spaces.Dict({**images, "focal_point": spaces.Box(-1.0, 1.0, (2,), np.float32)})

    def action_space(self, natural: gymnasium.Space) -> gymnasium.Space:
        """Of one environment, whose own actions are `natural`."""
        return spaces.Dict({"natural": natural, "vision": spaces.Discrete(self.gaze.num_actions)})

    def checked(self, vision_action: Any, shape: tuple[int, ...]) -> np.ndarray:
        """Visual actions as they go to the device; `ValueError` where they are none."""
        action = np.asarray(vision_action)
        known = action.shape == shape and np.issubdtype(action.dtype, np.integer)
        if not known or (action < 0).any() or (action >= self.gaze.num_actions).any():
            accepted = f"integers {list(shape)} from 0 to {self.gaze.num_actions - 1}"
            raise refuse("vision", action, accepted)
        return action.astype(np.int32)

    @property
    def scale(self) -> float:
        """What pixels are multiplied with."""
        return 1 / 255 if self.box.dtype == np.uint8 else 1.0

    @property
    def range(self) -> tuple[float, float]:
        """The least and the greatest value of an image; what is hidden is 0."""
        return min(float(self.box.low.min()) * self.scale, 0.0), max(float(self.box.high.max()) * self.scale, 0.0)

    def pixels(self, frame: Any) -> np.ndarray:
        """The frame as it goes to the device."""
        return np.asarray(frame, np.uint8 if self.box.dtype == np.uint8 else np.float32)

    def named(self, images: list | tuple) -> dict[str, Any]:
        """Images under their names."""
        return {"image": images[0]} if len(images) == 1 else {f"image_{i}": x for i, x in enumerate(images)}

    def look(
        self,
        frame: Num[Array, "H W *C"],
        focal_point: Int[Array, "2"],
        vision_action: Int[Array, ""],
        is_first: Bool[Array, ""],
        seed: UInt32[Array, ""],
    ) -> tuple[dict[str, Float[Array, "..."]], Int[Array, "2"]]:
        """The observation and where it was sensed: moved from `focal_point`, or the start of an episode."""
        shape = (frame.shape[0], frame.shape[1])
        where: dict[str, Any] = {
            "gaze": self.gaze,
            "window": gazes.bounded(self.gaze, self.sensor),
            "frame_shape": shape,
        }
        start = gazes.start(jax.random.key(seed), **where)
        focal_point = jnp.where(is_first, start, gazes.move(focal_point, vision_action, **where))
        bounds = "window" if self.gaze.bounds == "window" else "point"
        images = sense(frame, focal_point, sensor=self.sensor, bounds=bounds)
        # A mean may round to just outside the range, and then would not be of the observation space.
        named = self.named([jnp.clip(image * self.scale, *self.range) for image in images])
        return {**named, "focal_point": gazes.to_unit(focal_point, shape)}, focal_point


def _pixels(space: gymnasium.Space) -> spaces.Box:
    """The space itself, if it is one of pixels."""
    if isinstance(space, spaces.Box):
        number = space.dtype == np.uint8 or np.issubdtype(space.dtype, np.floating)
        if number and (len(space.shape) == 2 or (len(space.shape) == 3 and space.shape[2] in (1, 3))):
            return space
    accepted = "a Box of uint8 or float pixels, [H, W], [H, W, 1] or [H, W, 3]"
    raise refuse("observation_space", space, accepted)
