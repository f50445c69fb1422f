"""Gymnasium wrappers, which show an environment's pixels through a sensor with a gaze.

The order is that of training (`foajax.learning.agent`): a visual action moves the focal point before the frame that the
step leads to is sensed, and a price of saccades (`gaze.cost`) is taken from the reward one step late.

NumPy senses. JAX is imported only for a user's own sensor.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from foajax.config.parse import refuse
from foajax.config.schema import GazeConfig
from foajax.sensors.actions import Form, split
from foajax.sensors.eye import Eye
from foajax.sensors.pixels import dtype_name


class FoveatedObservation(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):
    """Shows a Gymnasium environment through a sensor, and adds an action that moves the gaze.

    An action has two parts: `natural` is the environment's own action, `vision` (an integer from 0) moves the focal
    point before the next frame is sensed. By default 0 stays, and 1 to 4 move up, down, left, right.

    An observation is a dict of `image` [h, w, c] and `focal_point`, (y, x) in [-1, 1]. A sensor of several images gives
    `image_0`, `image_1`, ... as `foajax.sense` orders them. What is hidden is 0. Colours and stacked frames are
    channels.

    The info dict has `focal_point`, (y, x) in frame pixels; `saccade`, how far it moved to this frame; and `values`,
    how many values the sensor shows of it.

    Args:
      env: an environment that observes a `Box` of unsigned integers or floats: [H, W], [H, W, C], [C, H, W], or a stack
        of such images, 8x8 or larger; or a `Dict` with such a `Box`.
      sensor: a `RingSensor`, a `LogPolarSensor`, an object of your own `Sensor` class, or the name of an experiment,
        which stands for its sensor and its gaze.
      gaze: how the focal point moves. None takes the experiment's gaze, or else the defaults. A random start is drawn
        from the environment's `np_random`.
      image_key: the key of the image in a `Dict`. The other entries are passed on.
      dtype: type of the images. float32 has integers scaled to [0, 1]; uint8 has 0..255, for small replay buffers.
      actions: form of an action: 'dict' {"natural", "vision"}, 'tuple' (natural, vision) or 'multidiscrete' [natural,
        vision].

    Raises:
      ConfigError: the environment observes no such image; the sensor is unknown or does not fit the frames; the gaze
        takes no visual actions; or `actions` does not suit the environment's own actions.
    """

    def __init__(
        self,
        env: Any,
        sensor: Any,
        gaze: GazeConfig | None = None,
        *,
        image_key: str | None = None,
        dtype: Any = np.float32,
        actions: Form = "dict",
    ) -> None:
        options: dict[str, Any] = {"image_key": image_key, "dtype": dtype_name(dtype), "actions": actions}
        gymnasium.utils.RecordConstructorArgs.__init__(self, sensor=sensor, gaze=gaze, **options)
        if isinstance(env, VectorEnv):  # EnvPool's pools are both
            raise refuse("env", env, "one environment; FoveatedVectorObservation takes many")
        gymnasium.Wrapper.__init__(self, env)
        self._eye = Eye(env.observation_space, env.action_space, 1, sensor=sensor, gaze=gaze, **options)
        self._form = actions
        self.observation_space, self.action_space = self._eye.observation_space, self._eye.action_space
        self._ended = False  # where the environment restarts by itself, the next step begins an episode

    @property
    def focal_point(self) -> np.ndarray:
        """Where the last frame was sensed: (y, x) in frame pixels, int32 [2]."""
        return self._eye.focal_point[0]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """Begins an episode. The focal point is where `gaze` starts."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._ended = False
        self._eye.begin(np.array([True]), self._random)
        return self._eye.look_one(observation), info | self._facts()

    def step(self, action: Any) -> tuple[dict, Any, bool, bool, dict]:
        """Takes the natural action, moves the focal point and senses the new frame there.

        Raises:
          ConfigError: `action` is not in the action space.
        """
        natural, vision = split(self._form, action, self.env.action_space, self._eye.num_vision, ())
        observation, reward, terminated, truncated, info = self.env.step(natural)
        begins = np.array([self._ended])
        self._eye.begin(begins, self._random)
        due = float(self._eye.move(vision[None], ~begins)[0])
        self._ended = bool(terminated or truncated)
        reward = float(reward) - due if due else reward
        return self._eye.look_one(observation), reward, terminated, truncated, info | self._facts()

    def _facts(self) -> dict[str, Any]:
        return {name: value[0] for name, value in self._eye.facts().items()}

    def _random(self) -> np.random.Generator:
        return self.env.unwrapped.np_random


class FoveatedVectorObservation(gymnasium.vector.VectorWrapper):
    """Shows each environment of a vector through a sensor, with a gaze of its own; see `FoveatedObservation`.

    Every autoreset mode of Gymnasium works. In the same-step mode the last observations, `info["final_obs"]`, are
    sensed too.

    Args:
      env: a vector environment of Gymnasium, ale-py's `AtariVectorEnv`, or a Gymnasium pool of EnvPool.
      sensor: as in `FoveatedObservation`.
      gaze: as in `FoveatedObservation`, but random starts are drawn from the wrapper's own generator, which
        `reset(seed=)` seeds.
      image_key: as in `FoveatedObservation`.
      dtype: as in `FoveatedObservation`.
      actions: as in `FoveatedObservation`.

    Raises:
      ConfigError: as in `FoveatedObservation`; or the environment's metadata has no `autoreset_mode`.
    """

    def __init__(
        self,
        env: Any,
        sensor: Any,
        gaze: GazeConfig | None = None,
        *,
        image_key: str | None = None,
        dtype: Any = np.float32,
        actions: Form = "dict",
    ) -> None:
        if not isinstance(env, VectorEnv):
            raise refuse("env", env, "a gymnasium.vector.VectorEnv; FoveatedObservation takes one environment")
        super().__init__(env)
        mode = env.metadata.get("autoreset_mode")
        if mode not in list(AutoresetMode):
            raise refuse("metadata['autoreset_mode']", str(mode), [str(known) for known in AutoresetMode])
        self._mode, self._form, self._own = AutoresetMode(mode), actions, env.single_action_space
        options: dict[str, Any] = {"image_key": image_key, "dtype": dtype_name(dtype), "actions": actions}
        self._eye = Eye(env.single_observation_space, self._own, env.num_envs, sensor=sensor, gaze=gaze, **options)
        self._single_observation_space = self._eye.observation_space
        self._observation_space = batch_space(self._single_observation_space, env.num_envs)
        self._single_action_space = self._eye.action_space
        self._action_space = batch_space(self._single_action_space, env.num_envs)
        self._generator = np.random.default_rng()
        self._ended = np.zeros(env.num_envs, bool)  # whose next step begins an episode

    @property
    def focal_point(self) -> np.ndarray:
        """Where the last frames were sensed: (y, x) in frame pixels, int32 [B, 2]."""
        return self._eye.focal_point

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """Begins all episodes, or those that `options["reset_mask"]` is true for. `seed` may be a list."""
        seeds = np.atleast_1d(seed)
        if any(each is not None for each in seeds):
            self._generator = np.random.default_rng([each or 0 for each in seeds])
        started = np.array((options or {}).get("reset_mask", np.ones(self.num_envs, bool)))
        observation, info = self.env.reset(seed=seed, options=options)
        self._ended = self._ended & ~started
        self._eye.begin(started, self._random)
        return self._eye.look(observation), info | self._facts()

    def step(self, actions: Any) -> tuple[dict, Any, Any, Any, dict]:
        """Steps every environment. In the next-step mode, the step that restarts an episode ignores its action."""
        natural, vision = split(self._form, actions, self._own, self._eye.num_vision, (self.num_envs,))
        observation, reward, terminated, truncated, info = self.env.step(natural)
        self._eye.begin(self._ended, self._random)
        due = self._eye.move(vision, ~self._ended)
        ended = terminated | truncated
        if self._mode == AutoresetMode.SAME_STEP and ended.any():
            info = {**info, "final_obs": self._final(info["final_obs"], ended)}
            info["final_info"] = {**info.get("final_info", {}), **self._facts(ended)}
            info |= {"_final_obs": ended.copy(), "_final_info": ended.copy()}
            self._eye.begin(ended, self._random)
        self._ended = ended & (self._mode == AutoresetMode.NEXT_STEP)
        reward = reward - due if due.any() else reward
        return self._eye.look(observation), reward, terminated, truncated, info | self._facts()

    def _final(self, observations: Any, ended: np.ndarray) -> np.ndarray:
        """Senses the last observations of the episodes that ended; None for the other environments."""
        seen = np.full(self.num_envs, None, object)
        for i in np.flatnonzero(ended).tolist():
            seen[i] = self._eye.look_one(observations[i], i)
        return seen

    def _facts(self, which: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """Returns the gazes' entries of the info dict, with Gymnasium's masks of which environments have them."""
        mask = np.ones(self.num_envs, bool) if which is None else which
        facts = self._eye.facts()
        return facts | {f"_{name}": mask.copy() for name in facts}

    def _random(self) -> np.random.Generator:
        return self._generator
