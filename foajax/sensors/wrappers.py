"""The sensors for other libraries: Gymnasium environments whose pixels are looked at through a gaze.

An action has the environment's own part and a visual one, 0 .. V-1 as in `foajax.sensors.gaze`. The visual action moves
the focal point before the frame that the step leads to is sensed, as in `foajax.learning.agent`; where an episode
starts, the focal point is at the gaze's start instead. A price of saccades (`gaze.cost`) is taken from the reward one
step late, as in training.

An observation is `{"image": [h, w, c], "focal_point": [2]}`, or `image_0`, `image_1`, ... where the sensor gives
several images (see `foajax.sense`). Images have 0 for what is hidden; colours and stacked frames are channels, the last
axis. The focal point is (y, x) in [-1, 1]. The info dict has `focal_point`, (y, x) in frame pixels; `saccade`, how far
it moved for this frame; `values`, how many values the sensor shows of a frame.

NumPy senses, and JAX is not imported, but for a sensor of one's own.
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
    """One environment, seen through a sensor.

    Args:
      env: observes a `Box` of unsigned integers or floats: [H, W], [H, W, C], [C, H, W], or a stack of such images, of
        8x8 and more; or a `Dict` that has one.
      sensor: a `RingSensor`, a `LogPolarSensor`, a `Sensor` of one's own, or the name of an experiment whose sensor and
        gaze it stands for.
      gaze: how the focal point moves; None for the experiment's, or the defaults. A random start is drawn from the
        environment's `np_random`.
      image_key: where the image is in a `Dict`, whose other parts are passed on.
      dtype: of the images: float32, integers scaled to [0, 1]; or uint8, 0..255, for replay buffers.
      actions: their form: 'dict' {"natural", "vision"}, 'tuple' (natural, vision), 'multidiscrete' [natural, vision].

    Raises:
      ConfigError: not a pixel environment, a sensor that is none or does not fit its frames, an unknown name, a gaze
        that is none or takes no visual actions, or a form that does not suit the environment's own actions.
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
        """(y, x) in frame pixels, int32 [2]: where the last frame was sensed."""
        return self._eye.focal_point[0]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """Begins an episode, with the focal point at the gaze's start."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._ended = False
        self._eye.begin(np.array([True]), self._random)
        return self._eye.look_one(observation), info | self._facts()

    def step(self, action: Any) -> tuple[dict, Any, bool, bool, dict]:
        """Takes the natural action, moves the focal point and senses the new frame there.

        `ConfigError`, a `ValueError`, for what is no action.
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
    """Many environments at once, seen through a sensor each.

    Args:
      env: a vector environment of Gymnasium, ale-py's `AtariVectorEnv` or a Gymnasium pool of EnvPool; one environment
        of it is as in `FoveatedObservation`. Episodes may restart on the next step, on the step that ends them, whose
        last observations are in `info["final_obs"]` and are sensed too, or not by themselves.
      sensor: as in `FoveatedObservation`.
      gaze: as in `FoveatedObservation`. Random starts are drawn from a generator of the wrapper's own, seeded by
        `reset(seed=)`.
      image_key: as in `FoveatedObservation`.
      dtype: as in `FoveatedObservation`.
      actions: as in `FoveatedObservation`.

    Raises:
      ConfigError: as in `FoveatedObservation`, or an environment that does not say how its episodes restart.
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
        """(y, x) in frame pixels, int32 [B, 2]: where the last frames were sensed."""
        return self._eye.focal_point

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """Begins the episodes, those of `options["reset_mask"]` where it is given; `seed` may be a list."""
        if seed is not None:
            self._generator = np.random.default_rng([s or 0 for s in np.atleast_1d(seed)])
        started = np.array((options or {}).get("reset_mask", np.ones(self.num_envs, bool)))
        observation, info = self.env.reset(seed=seed, options=options)
        self._ended = self._ended & ~started
        self._eye.begin(started, self._random)
        return self._eye.look(observation), info | self._facts()

    def step(self, actions: Any) -> tuple[dict, Any, Any, Any, dict]:
        """A step of each. Where episodes restart on the next step, that step ignores its action."""
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
        """The last observations of the episodes that ended, each as of one environment; None of the others."""
        seen = np.full(self.num_envs, None, object)
        for i in np.flatnonzero(ended).tolist():
            seen[i] = self._eye.look_one(observations[i], i)
        return seen

    def _facts(self, which: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """What the info dict has of the gazes, with Gymnasium's masks of who has it."""
        mask = np.ones(self.num_envs, bool) if which is None else which
        facts = self._eye.facts()
        return facts | {f"_{name}": mask.copy() for name in facts}

    def _random(self) -> np.random.Generator:
        return self._generator
