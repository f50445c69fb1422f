"""What both wrappers of environments share: the gazes of a batch, and what is seen there."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces
from jaxtyping import Bool, Float, Int

from foajax.config.compose import compose
from foajax.config.parse import refuse, replace
from foajax.config.schema import (
    Config,
    EnvConfig,
    GazeConfig,
    LogPolarSensor,
    OwnSensor,
    RingSensor,
    SensorConfig,
    check_window,
)
from foajax.sensors import gaze as gazes
from foajax.sensors import numpy as host
from foajax.sensors.actions import Form, joint_space
from foajax.sensors.geometry import ring_count, ring_shapes
from foajax.sensors.pixels import Pixels

Images = tuple[np.ndarray, ...]


@dataclasses.dataclass(frozen=True)
class Seeing:
    """A sensor for frames of one size."""

    sensor: Any  # a RingSensor or a LogPolarSensor, seen with by NumPy; or a `Sensor` of one's own, by JAX
    shapes: tuple[tuple[int, int], ...]  # of its images
    count: int  # values that it shows of a gray frame

    @classmethod
    def of(cls, sensor: Any, frame_shape: tuple[int, int]) -> Seeing:
        """Prepares a sensor; raises `ConfigError` for anything else."""
        if isinstance(sensor, RingSensor):
            shapes = (frame_shape,) if sensor.layout == "canvas" else ring_shapes(sensor)
            return cls(sensor, shapes, ring_count(sensor, frame_shape).actual)
        if isinstance(sensor, LogPolarSensor):
            return cls(sensor, ((sensor.rings, sensor.wedges),), sensor.rings * sensor.wedges)
        from foajax.sensors.registry import check_images, make_sensor

        made = make_sensor(sensor)
        check_images(made, frame_shape)
        return cls(made, made.image_shapes(frame_shape), made.count(frame_shape).actual)

    def look(self, frames: np.ndarray, focal_points: np.ndarray, bounds: str) -> Images:
        """Senses frames [B, H, W, C]; returns images [B, h, w, C]."""
        if isinstance(self.sensor, RingSensor | LogPolarSensor):
            return host.sense_many(frames, focal_points, sensor=self.sensor, bounds=bounds)
        from foajax.sensors.compiled import sense_many

        return tuple(np.array(image) for image in sense_many(frames, focal_points, sensor=self.sensor, bounds=bounds))


class Eye:
    """The gazes of a batch of equal environments.

    Args:
      observation_space, action_space: of one environment.
      batch: how many there are.
      sensor, gaze, image_key, dtype, actions: as in `foajax.FoveatedObservation`.
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        batch: int,
        *,
        sensor: Any,
        gaze: GazeConfig | None,
        image_key: str | None,
        dtype: Any,
        actions: Form,
    ) -> None:
        self._pixels = Pixels.of(observation_space, image_key, dtype)
        if isinstance(sensor, str):
            experiment = compose([f"experiment={sensor}"])
            sensor, gaze = experiment.sensor, gaze or replace(experiment.gaze, mode="learned")
        self._gaze = gaze or GazeConfig()
        self._seeing = Seeing.of(sensor, self._pixels.frame_shape)
        _check(self._gaze, self._seeing.sensor, self._pixels.frame_shape)
        window = gazes.bounded(self._gaze, self._seeing.sensor)
        self._where: dict[str, Any] = {"gaze": self._gaze, "window": window, "frame_shape": self._pixels.frame_shape}
        self.observation_space = self._observation_space(observation_space)
        self.action_space = joint_space(actions, action_space, self._gaze.num_actions)
        self.num_vision = self._gaze.num_actions
        self.focal_point = np.zeros((batch, 2), np.int32)  # (y, x) in frame pixels: where the last frames were sensed
        self._saccade = np.zeros(batch, np.float32)  # how far each moved for it, frame pixels
        self._owed = np.zeros(batch, np.float32)  # prices of these, which the next rewards pay

    def begin(self, which: Bool[np.ndarray, "B"], random: Callable[[], np.random.Generator]) -> None:
        """Puts the gazes of new episodes at their start. Prices that the old episodes still owe are dropped."""
        self.focal_point = self.focal_point.copy()
        for i in np.flatnonzero(which):
            generator = random() if self._gaze.start == "random" else None
            self.focal_point[i] = gazes.start(generator, **self._where)
        self._saccade[which], self._owed[which] = 0, 0

    def move(self, vision: Int[np.ndarray, "B"], which: Bool[np.ndarray, "B"]) -> Float[np.ndarray, "B"]:
        """Moves these gazes; returns the price of the move before, which is due now (`learning.agent.Agent.act`)."""
        before, due = self.focal_point, np.where(which, self._owed, 0)
        self.focal_point = np.where(which[:, None], gazes.move(before, vision, **self._where), before)
        self._saccade = gazes.saccade(before, self.focal_point)
        self._owed = np.where(which, gazes.price(before, self.focal_point, gaze=self._gaze), self._owed)
        return due

    def look(self, observation: Any) -> dict[str, Any]:
        """Senses the batch's observations. The other entries of a Dict are passed on."""
        return self._rest(observation) | self._see(self._image(observation), self.focal_point)

    def look_one(self, observation: Any, i: int = 0) -> dict[str, Any]:
        """Senses a single observation with the gaze of environment `i`."""
        seen = self._see(self._image(observation)[None], self.focal_point[i : i + 1])
        return self._rest(observation) | {name: value[0] for name, value in seen.items()}

    def _see(self, observed: np.ndarray, points: np.ndarray) -> dict[str, np.ndarray]:
        frames = self._pixels.frames(observed)
        if len(frames) != len(points):
            accepted = f"all {len(points)} environments at each step, so batch_size=num_envs and no reset_mask"
            raise refuse("observation", f"{len(frames)} environments", accepted)
        images = self._seeing.look(frames, points, self._gaze.sense_bounds)
        seen = self._named([self._pixels.finish(image) for image in images])
        seen["focal_point"] = gazes.to_unit(points, self._pixels.frame_shape).astype(np.float32)
        return seen

    def _image(self, observation: Any) -> np.ndarray:
        return np.asarray(observation if self._pixels.key is None else observation[self._pixels.key])

    def _rest(self, observation: Any) -> dict[str, Any]:
        """Returns the entries of a Dict, or of its space, other than the image."""
        key = self._pixels.key
        return {} if key is None else {name: value for name, value in observation.items() if name != key}

    def facts(self) -> dict[str, np.ndarray]:
        """Returns the gazes' entries of the info dict: the focal point, its last move, the values shown per frame."""
        values = np.full(len(self._owed), self._seeing.count * self._pixels.channels)
        return {"focal_point": self.focal_point.copy(), "saccade": self._saccade.copy(), "values": values}

    def _observation_space(self, space: spaces.Space) -> spaces.Space:
        low, high = self._pixels.range
        shapes = [(*shape, self._pixels.channels) for shape in self._seeing.shapes]
        ours = self._named([spaces.Box(low, high, shape, self._pixels.dtype.type) for shape in shapes])
        ours["focal_point"] = spaces.Box(-1.0, 1.0, (2,), np.float32)
        rest = self._rest(space)
        for name in rest.keys() & ours.keys():
            raise refuse("observation_space", name, f"names other than {', '.join(ours)}")
        return spaces.Dict({**rest, **ours})

    def _named(self, images: list) -> dict[str, Any]:
        """Names the images: `image`, or `image_0`, `image_1`, ... of several."""
        return {"image": images[0]} if len(images) == 1 else {f"image_{i}": x for i, x in enumerate(images)}


def _check(gaze: Any, sensor: Any, frame_shape: tuple[int, int]) -> None:
    """Raises `ConfigError` unless visual actions move the gaze, and gaze and sensor suit the frame."""
    if not isinstance(gaze, GazeConfig):
        raise refuse("gaze", gaze, "a GazeConfig")
    if not gaze.learned:
        raise refuse("gaze.mode", gaze.mode, "learned: in a wrapper visual actions move the gaze")
    # The checks of a run, but for a gaze that stands still: here the whole frame may be a baseline, which a run whose
    # gaze has to move is refused.
    still = replace(gaze, mode="frozen")
    known = sensor if isinstance(sensor, SensorConfig) else OwnSensor(kind=f"own:{type(sensor).__name__}")
    env = EnvConfig(frame_shape=frame_shape)
    check_window(Config(name="wrapper", sensor=known, gaze=still, env=env), sensor)
