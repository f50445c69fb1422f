"""What a run is made of: frozen dataclasses, checked when they are built. Standard library only.

A mapping (from YAML, from a command line) becomes a `Config` through `from_mapping`; whatever is
unknown, of the wrong type or out of range raises `ConfigError` with one line that names the key,
the value and what is accepted.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from foajax.config.parse import build, check, check_types, file_name


@dataclasses.dataclass(frozen=True)
class RingSensor:
    """A focal area of nested rings; non-FoA, Constant, Decreasing and their (P) forms (Table II)."""

    rings: tuple[tuple[int, int, int], ...]  # (height, width, subsampling factor), inner to outer
    kind: Literal["rings"] = "rings"
    peripheral: tuple[int, int] | None = None  # grid of the coarse background, e.g. (5, 5)
    layout: Literal["canvas", "packed"] = "canvas"
    pooling: Literal["mean", "stride"] = "mean"
    size_key: ClassVar[str] = "sensor.rings"  # what decides how large the focal area is
    may_overhang: ClassVar[bool] = False  # whether the area may be larger than the frame where gaze.bounds=point

    def __post_init__(self) -> None:
        check_types(self, "sensor")
        check(len(self.rings) > 0, "sensor.rings", self.rings, "at least one [height, width, factor]")
        for ring in self.rings:
            height, width, factor = ring
            check(
                1 <= factor <= min(height, width),
                "sensor.rings",
                ring,
                "[height, width, factor] with 1 <= factor <= height and width",
            )
        for inner, outer in zip(self.rings, self.rings[1:], strict=False):
            nested = inner[0] <= outer[0] and inner[1] <= outer[1] and inner[:2] != outer[:2]
            check(nested, "sensor.rings", self.rings, "rings that nest, each larger than the one before")
        if self.peripheral is not None:
            check(min(self.peripheral) >= 1, "sensor.peripheral", self.peripheral, "null or [rows, columns] >= 1")

    @property
    def window(self) -> tuple[int, int]:
        """Height and width of the focal area in frame pixels."""
        return self.rings[-1][:2]


@dataclasses.dataclass(frozen=True)
class LogPolarSensor:
    """A log-polar retina: rings x wedges around the focal point, radii growing geometrically."""

    kind: Literal["logpolar"] = "logpolar"
    rings: int = 35
    wedges: int = 35
    fovea: float = 3.0  # radius of the innermost ring, a disc, frame pixels
    radius: float = 40.0  # outer radius, frame pixels
    sampling: Literal["area", "bilinear"] = "area"
    size_key: ClassVar[str] = "sensor.radius"
    may_overhang: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_types(self, "sensor")
        check(2 <= self.rings <= 1000, "sensor.rings", self.rings, "an integer from 2 to 1000")
        check(4 <= self.wedges <= 1000, "sensor.wedges", self.wedges, "an integer from 4 to 1000")
        check(self.fovea > 0, "sensor.fovea", self.fovea, "a radius > 0")
        radius = f"a radius > sensor.fovea={self.fovea} and <= 10000"
        check(self.fovea < self.radius <= 10_000, "sensor.radius", self.radius, radius)

    @property
    def window(self) -> tuple[int, int]:
        """Height and width of the square around the outer circle, frame pixels."""
        side = 2 * math.ceil(self.radius)
        return side, side


@dataclasses.dataclass(frozen=True)
class OwnSensor:
    """A sensor from elsewhere; see `foajax.sensors.base.Sensor`. It is made, and checked, where it is first used."""

    kind: str  # package.module:Class
    kwargs: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # of its constructor
    size_key: ClassVar[str] = "sensor.kwargs"
    may_overhang: ClassVar[bool] = True
    window: ClassVar[None] = None  # not known before it is made


SensorConfig = RingSensor | LogPolarSensor | OwnSensor


@dataclasses.dataclass(frozen=True)
class GazeConfig:
    """How the focal point moves."""

    mode: Literal["none", "learned", "frozen", "random", "scripted"] = "learned"
    actions: Literal[5, 9] = 5  # stay, up, down, left, right; 9 adds the diagonals
    step: int = 4  # frame pixels a visual action moves
    bounds: Literal["window", "point"] = "window"  # what has to stay inside the frame
    start: Literal["centre", "random"] | tuple[int, int] = "centre"  # of an episode; moved within bounds
    path: tuple[tuple[int, int], ...] = ()  # scripted: the points (y, x) visited in turn, moved within bounds

    def __post_init__(self) -> None:
        check_types(self, "gaze")
        check(1 <= self.step <= 10_000, "gaze.step", self.step, "an integer from 1 to 10000")
        if self.mode == "scripted":
            check(len(self.path) > 0, "gaze.path", self.path, "at least one [y, x] where gaze.mode=scripted")

    @property
    def learned(self) -> bool:
        """Whether the network has a vision head."""
        return self.mode == "learned"


@dataclasses.dataclass(frozen=True)
class EnvConfig:
    """The environment and its preprocessing (Table III)."""

    engine: Literal["envpool", "ale"] = "envpool"
    num_envs: int = 32
    groups: int = 1  # sets of environments that step in turn: with 2, one decides while the other's emulators run
    frame_shape: tuple[int, int] = (80, 80)  # what the sensor looks at
    crop_top: Mapping[str, int] = dataclasses.field(default_factory=lambda: {"default": 34, "beam_rider": 20})
    frame_skip: int = 4
    noop_max: int = 30  # no-ops before an episode are drawn from [0, noop_max]
    clip_rewards: bool = True
    episodic_life: bool = True  # a lost life ends the learner's episode
    fire_on_reset: bool = True
    sticky_actions: float = 0.0  # probability that the emulator repeats the last action
    max_episode_steps: int = 27_000  # agent steps
    threads: int = 0  # of the engine; 0 lets it choose
    timeout: float = 120.0  # seconds that a step may take before the engine is taken for hung
    kwargs: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # of a Gymnasium environment or one's own

    def __post_init__(self) -> None:
        check(1 <= self.num_envs <= 100_000, "env.num_envs", self.num_envs, "an integer from 1 to 100000")
        check(self.groups >= 1, "env.groups", self.groups, "an integer >= 1")
        fits = min(self.frame_shape) >= 8 and max(self.frame_shape) <= 10_000
        check(fits, "env.frame_shape", self.frame_shape, "[height, width], each from 8 to 10000")
        check("default" in self.crop_top, "env.crop_top", dict(self.crop_top), "a mapping with the key 'default'")
        for game, row in self.crop_top.items():
            check(0 <= row <= 50, f"env.crop_top.{game}", row, "a screen row from 0 to 50 (160 rows are kept of 210)")
        check(1 <= self.frame_skip <= 1000, "env.frame_skip", self.frame_skip, "an integer from 1 to 1000")
        check(0 <= self.noop_max <= 200, "env.noop_max", self.noop_max, "an integer from 0 to 200")
        check(0 <= self.sticky_actions < 1, "env.sticky_actions", self.sticky_actions, "a probability in [0, 1)")
        # The engines count frames in 32 bits, and abort the process where the system has no threads left.
        steps = "an integer from 1 to 2000000"
        check(1 <= self.max_episode_steps <= 2_000_000, "env.max_episode_steps", self.max_episode_steps, steps)
        check(0 <= self.threads <= 1024, "env.threads", self.threads, "an integer from 0 to 1024")
        check(self.timeout > 0, "env.timeout", self.timeout, "seconds > 0")


@dataclasses.dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the network."""

    torso: str = "nature"  # nature, a3c, impala, or a Flax module of one's own: package.module:Class
    widths: tuple[int, ...] | None = None  # channels of the torso's layers; null for its own
    torso_kwargs: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # further arguments of the torso
    core: str = "lstm"  # lstm, gru, mingru, none (no memory), or one's own: package.module:Class
    core_kwargs: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # further arguments of the core
    dense: int = 256  # units between torso and LSTM; 0 for none
    dense_norm: bool = False  # layer norm of what enters these units
    lstm: int = 256
    padding: Literal["cover", "valid"] = "cover"  # valid: the nature torso leaves out what its strides do not fit
    focal_point: Literal["always", "packed"] = "always"  # which gaze tells the LSTM where it is; packed: no canvas's
    focal_scale: Literal["reach", "frame"] = (
        "reach"  # of that point: -1 and 1 are the ends of its reach, or of the frame
    )
    last_actions: bool = True  # the LSTM is told both actions of the step before
    last_reward: bool = True  # and the reward that followed
    forget_bias: float = 1.0  # of the LSTM's forget gates, before learning
    lstm_norm: bool = True  # layer norm of the input's part of the LSTM's gates
    normalization: Literal["pixel", "running", "frame", "none"] = "pixel"

    def __post_init__(self) -> None:
        for key, ours in (("torso", ("nature", "a3c", "impala")), ("core", ("lstm", "gru", "mingru", "none"))):
            name, accepted = getattr(self, key), f"one of {', '.join(ours)} or package.module:Class"
            check(name in ours or ":" in name, f"network.{key}", name, accepted)
        widths = self.widths is None or (len(self.widths) > 0 and 1 <= min(self.widths) <= max(self.widths) <= 16_384)
        check(widths, "network.widths", self.widths, "null or a list of integers from 1 to 16384")
        check(0 <= self.dense <= 16_384, "network.dense", self.dense, "an integer from 0 to 16384")
        check(1 <= self.lstm <= 16_384, "network.lstm", self.lstm, "an integer from 1 to 16384")
        check(abs(self.forget_bias) <= 100, "network.forget_bias", self.forget_bias, "a number from -100 to 100")


@dataclasses.dataclass(frozen=True)
class HeadConfig:
    """What one head learns with."""

    relative_keys: ClassVar[bool] = True  # a head does not know whose it is; the rest name their keys in full
    gamma: float = 0.99
    gae_lambda: float = 0.95
    beta: float = 0.003  # weight of the entropy

    def __post_init__(self) -> None:
        check(0 <= self.gamma <= 1, "gamma", self.gamma, "a number in [0, 1]")
        check(0 <= self.gae_lambda <= 1, "gae_lambda", self.gae_lambda, "a number in [0, 1]")
        check(self.beta >= 0, "beta", self.beta, "a number >= 0")


@dataclasses.dataclass(frozen=True)
class LearnerConfig:
    """The update."""

    rollout_length: int = 64  # T
    minibatches: int = 16  # groups of environments whose gradients are applied one after another
    epochs: int = 2  # passes over a rollout
    clip_ratio: float | None = 0.1  # PPO's clipping of the probability ratio; null for plain A2C
    learning_rate: float = 1e-3
    full_rate_inputs: int | None = 256  # layers with more inputs have a rate that much smaller; null for none
    warmup_updates: int = 1000  # over which the learning rate rises; 0 for none
    schedule: Literal["constant", "linear"] = "linear"  # linear falls to 0 at train.env_steps, skipped updates apart
    amsgrad: bool = False  # divide by the largest second moment so far, in place of Adam's latest
    adam_b1: float = 0.9
    adam_b2: float = 0.999
    adam_eps: float = 1e-5
    max_grad_norm: float | None = 0.5  # of the whole gradient; null for no clipping
    reduction: Literal["mean", "sum"] = "mean"  # of the losses over time; over environments always the mean
    normalize_advantages: bool = True
    value_weight: float = 0.5
    vision_weight: float = 0.25  # of both of the vision head's losses
    value_target: Literal["n_step", "lambda"] = "lambda"  # to the rollout's end, or mixed as the advantages are
    vision_bootstrap: Literal["consistent", "literal"] = "consistent"  # of the vision head's n-step returns
    credits_last_gaze: bool = True  # a policy gradient for the visual action before an end, which nothing follows
    natural: HeadConfig = HeadConfig()
    vision: HeadConfig = HeadConfig()

    def __post_init__(self) -> None:
        ranges = {"rollout_length": (2, 100_000), "minibatches": (1, 100_000), "epochs": (1, 1000)}
        ranges["warmup_updates"] = (0, 10**9)
        for key, (least, most) in ranges.items():
            value = getattr(self, key)
            check(least <= value <= most, f"learner.{key}", value, f"an integer from {least} to {most}")
        inputs = self.full_rate_inputs
        accepted = f"null or an integer from 1 to {10**9}"
        check(inputs is None or 1 <= inputs <= 10**9, "learner.full_rate_inputs", inputs, accepted)
        for key in ("learning_rate", "adam_eps"):
            check(getattr(self, key) > 0, f"learner.{key}", getattr(self, key), "a number > 0")
        for key in ("adam_b1", "adam_b2"):
            check(0 <= getattr(self, key) < 1, f"learner.{key}", getattr(self, key), "a number in [0, 1)")
        for key in ("clip_ratio", "max_grad_norm"):
            value = getattr(self, key)
            check(value is None or value > 0, f"learner.{key}", value, "null or a number > 0")
        for key in ("value_weight", "vision_weight"):
            check(getattr(self, key) >= 0, f"learner.{key}", getattr(self, key), "a number >= 0")
        applies = self.vision_bootstrap == "consistent" or self.value_target == "n_step"
        accepted = f"consistent where learner.value_target={self.value_target}"
        check(applies, "learner.vision_bootstrap", self.vision_bootstrap, accepted)


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """The loop around the learner."""

    env_steps: int = 5_000_000  # when to stop
    init_from: str | None = None  # run or shipped agent whose parameters a new run begins with
    log_every: float = 10.0  # seconds
    checkpoint_every: float = 60.0  # seconds
    keep: int = 3  # newest checkpoints kept
    devices: int = 1  # of each process, that share its environments
    max_skipped: int = 20  # updates in a row that may be skipped as not finite before the run stops
    dump_skipped: bool = False  # keep the batches that such rows begin with, in <run>/skipped

    def __post_init__(self) -> None:
        check(self.env_steps >= 1, "train.env_steps", self.env_steps, "an integer >= 1")
        for key in ("log_every", "checkpoint_every"):
            check(getattr(self, key) > 0, f"train.{key}", getattr(self, key), "seconds > 0")
        for key in ("keep", "devices", "max_skipped"):
            check(1 <= getattr(self, key) <= 10**9, f"train.{key}", getattr(self, key), "an integer from 1 to 10^9")


@dataclasses.dataclass(frozen=True)
class DistributedConfig:
    """The processes that share a run. SLURM's are found without any of this; other launchers state all three."""

    coordinator: str | None = None  # host:port of process 0
    processes: int | None = None
    process: int | None = None  # this one's number, from 0
    timeout: float = 180.0  # seconds to wait for the others before saving and ending; more than env.timeout

    def __post_init__(self) -> None:
        stated = [value is not None for value in (self.coordinator, self.processes, self.process)]
        check(
            all(stated) or not any(stated),
            "distributed.coordinator, distributed.processes, distributed.process",
            (self.coordinator, self.processes, self.process),
            "a value for all three or for none",
        )
        if self.coordinator is not None and self.processes is not None and self.process is not None:
            check_address("distributed.coordinator", self.coordinator)
            check(self.processes >= 1, "distributed.processes", self.processes, "an integer >= 1")
            accepted = f"an integer from 0 to {self.processes - 1}"
            check(0 <= self.process < self.processes, "distributed.process", self.process, accepted)
        check(self.timeout > 0, "distributed.timeout", self.timeout, "seconds > 0")


@dataclasses.dataclass(frozen=True)
class Config:
    """One run."""

    name: str  # of the experiment, e.g. constant70
    sensor: SensorConfig
    game: str = "breakout"
    seed: int = 0
    run: str | None = None  # run directory; null for runs/<game>-<name>-s<seed>
    profile: bool = False
    gaze: GazeConfig = dataclasses.field(default_factory=GazeConfig)
    env: EnvConfig = EnvConfig()
    network: NetworkConfig = NetworkConfig()
    learner: LearnerConfig = LearnerConfig()
    train: TrainConfig = TrainConfig()
    distributed: DistributedConfig = DistributedConfig()

    def __post_init__(self) -> None:
        check(self.name.strip() != "", "name", repr(self.name), "the name of an experiment")
        check(self.game.strip() != "", "game", repr(self.game), "the name of a game")
        check(0 <= self.seed < 2**31 - 10_000, "seed", self.seed, "an integer from 0 to 2147473647")
        height, width = self.env.frame_shape
        if self.sensor.window is not None:
            check_window(self, self.sensor.window)
        peripheral = getattr(self.sensor, "peripheral", None)
        accepted = f"a grid no finer than env.frame_shape={height}x{width}"
        fits = peripheral is None or (peripheral[0] <= height and peripheral[1] <= width)
        check(fits, "sensor.peripheral", peripheral, accepted)
        points = self.gaze.path + ((self.gaze.start,) if isinstance(self.gaze.start, tuple) else ())
        for point in points:
            check(
                0 <= point[0] < height and 0 <= point[1] < width,
                "gaze.start or gaze.path",
                point,
                f"[y, x] inside env.frame_shape={height}x{width}",
            )
        check(
            self.env.num_envs % self.learner.minibatches == 0,
            "learner.minibatches",
            self.learner.minibatches,
            f"a divisor of env.num_envs={self.env.num_envs}",
        )
        check_shares(self, self.train.devices, "train.devices", self.train.devices)
        check(
            self.learner.minibatches % self.env.groups == 0,
            "env.groups",
            self.env.groups,
            f"a divisor of learner.minibatches={self.learner.minibatches}",
        )
        # Each environment's steps and the updates are counted in 32 bits.
        rollouts = -(-self.train.env_steps // (self.env.num_envs * self.learner.rollout_length))
        most = 2**31 // max(self.learner.rollout_length, self.learner.minibatches * self.learner.epochs) - 2
        steps = most * self.env.num_envs * self.learner.rollout_length
        accepted = f"at most {steps} with these learner.rollout_length, minibatches, epochs and env.num_envs"
        check(rollouts <= most, "train.env_steps", self.train.env_steps, accepted)

    @property
    def code(self) -> list[str]:
        """What of it names code outside of foajax, which runs where the part is made."""
        names = {"game": self.game, "sensor.kind": self.sensor.kind}
        names |= {"network.torso": self.network.torso, "network.core": self.network.core}
        ours = ("probe:", "gymnasium:ale_py:")
        return [
            f"{key}={name}"
            for key, name in names.items()
            if ":" in name.removeprefix("gymnasium:") and not name.startswith(ours)
        ]

    @property
    def run_dir(self) -> str:
        """Where the run's files are."""
        return self.run or f"runs/{file_name(self.game)}-{self.name}-s{self.seed}"


def check_window(config: Config, window: tuple[int, int]) -> None:
    """`ConfigError` unless the sensor's focal area fits into the frame and the gaze can move it."""
    (height, width), key = config.env.frame_shape, config.sensor.size_key
    if config.gaze.bounds == "window" or not config.sensor.may_overhang:
        accepted = f"a focal area inside env.frame_shape={height}x{width}"
        check(window[0] <= height and window[1] <= width, key, window, accepted)
    if config.gaze.mode in ("learned", "random") and config.gaze.bounds == "window":
        accepted = f"point, or gaze=none: {key} fills env.frame_shape={height}x{width} and could not move"
        check(window != (height, width), "gaze.bounds", config.gaze.bounds, accepted)


def check_address(key: str, value: str) -> None:
    """`ConfigError`, about `key`, unless `value` says where other processes find the first one."""
    host, _, port = value.rpartition(":")
    check(host != "" and port.isdecimal(), key, value, "host:port of process 0")


def check_shares(config: Config, shares: int, key: str, value: object) -> None:
    """`ConfigError`, about `key`, unless `shares` devices can each have the same part of a minibatch."""
    size = config.env.num_envs // config.learner.minibatches
    accepted = f"a divisor of the {size} environments of a minibatch (env.num_envs / learner.minibatches)"
    check(size % shares == 0, key, value, accepted)


def from_mapping(mapping: Mapping[str, Any]) -> Config:
    """Builds a checked `Config` from plain nested mappings; raises `ConfigError`."""
    return build(Config, mapping, "")
