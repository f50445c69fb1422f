"""What a run is made of: every key with its type, its bounds, its default and a sentence on it, in one place.

Hydra's base configuration, `--help`, docs/keys.md and the errors come from here. Standard library and pydantic only.
"""

from __future__ import annotations

import copy
import math
import re
from collections.abc import Collection, Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Discriminator, Field, Tag, field_validator

from foajax.config.parse import CODE, Section, build, file_name, refuse

# Words of before, which are still understood, and today's.
RENAMED = {
    "env.groups": "env.num_groups",
    "learner.minibatches": "learner.num_minibatches",
    "learner.epochs": "learner.num_epochs",
    "learner.natural.beta": "learner.natural.entropy_weight",
    "learner.vision.beta": "learner.vision.entropy_weight",
    "train.keep": "train.keep_checkpoints",
}


def _says(accepted: str) -> Any:
    """What a type accepts, where that is not plain from the type."""
    return Field(json_schema_extra={"accepted": accepted})


Point = Annotated[tuple[int, int], _says("[y, x]")]
Ring = Annotated[tuple[int, int, int], _says("[height, width, factor] with 1 <= factor <= height and width")]
Grid = Annotated[tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]], _says("[rows, columns] >= 1")]
Side = Annotated[int, Field(ge=8, le=10_000)]
Shape = Annotated[tuple[Side, Side], _says("[height, width], each from 8 to 10000")]
Letters = Annotated[int, Field(ge=1, le=1000)]
Width = Annotated[int, Field(ge=1, le=16_384)]
Row = Annotated[int, Field(ge=0, le=50), _says("a screen row from 0 to 50 (160 rows are kept of 210)")]
Name = Annotated[str, Field(pattern=r"\S"), _says("a name")]


class RingSensor(Section):
    """A focal area of nested rings; non-FoA, Constant, Decreasing and their (P) forms (Table II)."""

    prefix: ClassVar[str] = "sensor."
    size_key: ClassVar[str] = "sensor.rings"  # what decides how large the focal area is
    may_overhang: ClassVar[bool] = False  # whether the area may be larger than the frame where gaze.bounds=point
    rings: tuple[Ring, ...] = Field(min_length=1, description="Rings, inner to outer, with their subsampling factors.")
    kind: Literal["rings"] = Field("rings", description="Nested rings.")
    peripheral: Grid | None = Field(None, description="Grid of the coarse background; null for none.")
    layout: Literal["canvas", "packed"] = Field(
        "canvas", description="Whether the values stand at their place in a frame, or alone, without the canvas."
    )
    pooling: Literal["mean", "stride"] = Field("mean", description="What stands for a block of pixels: mean or corner.")

    def check(self) -> None:
        for height, width, factor in self.rings:
            if not 1 <= factor <= min(height, width):
                accepted = "[height, width, factor] with 1 <= factor <= height and width"
                raise refuse("rings", (height, width, factor), accepted)
        for inner, outer in zip(self.rings, self.rings[1:], strict=False):
            if not (inner[0] <= outer[0] and inner[1] <= outer[1] and inner[:2] != outer[:2]):
                raise refuse("rings", self.rings, "rings that nest, each larger than the one before")

    @property
    def window(self) -> tuple[int, int]:
        """Height and width of the focal area in frame pixels."""
        return self.rings[-1][:2]

    @property
    def finest(self) -> tuple[int, int]:
        """Height and width of the inner ring, which is seen best."""
        return self.rings[0][:2]


class LogPolarSensor(Section):
    """A log-polar retina: rings x wedges around the focal point, radii growing geometrically."""

    prefix: ClassVar[str] = "sensor."
    size_key: ClassVar[str] = "sensor.radius"
    may_overhang: ClassVar[bool] = True
    kind: Literal["logpolar"] = Field("logpolar", description="A log-polar retina.")
    rings: int = Field(35, ge=2, le=1000, description="How many rings there are.")
    wedges: int = Field(35, ge=4, le=1000, description="How many values each ring has.")
    fovea: float = Field(3.0, gt=0, description="Radius of the innermost ring, a disc, in frame pixels.")
    radius: float = Field(40.0, gt=0, le=10_000, description="Outer radius in frame pixels.")
    sampling: Literal["area", "bilinear"] = Field("area", description="A value is the mean of its area, or one sample.")

    def check(self) -> None:
        if self.fovea >= self.radius:
            raise refuse("radius", self.radius, f"a radius > sensor.fovea={self.fovea} and <= 10000")

    @property
    def window(self) -> tuple[int, int]:
        """Height and width of the square around the outer circle, frame pixels."""
        side = 2 * math.ceil(self.radius)
        return side, side

    @property
    def finest(self) -> tuple[int, int]:
        """Height and width of the square around the innermost disc, which is seen best."""
        side = 2 * math.ceil(self.fovea)
        return side, side


class OwnSensor(Section):
    """A sensor from elsewhere; see `foajax.sensors.base.Sensor`. It is made, and checked, where it is first used."""

    prefix: ClassVar[str] = "sensor."
    size_key: ClassVar[str] = "sensor.kwargs"
    may_overhang: ClassVar[bool] = True
    window: ClassVar[None] = None  # not known before it is made
    finest: ClassVar[None] = None
    kind: str = Field(description="Its class, package.module:Class.")
    kwargs: Mapping[str, Any] = Field({}, description="Arguments of its constructor.")


SensorConfig = RingSensor | LogPolarSensor | OwnSensor


def _kind(value: Any) -> str | None:
    """Which sensor a value is; rings where it is not said."""
    kind = str(value.get("kind", "rings")) if isinstance(value, Mapping) else getattr(value, "kind", None)
    return CODE if kind is not None and re.fullmatch(r"[\w.]+:[\w.]+", kind) else kind


class GazeConfig(Section):
    """How the focal point moves."""

    prefix: ClassVar[str] = "gaze."
    mode: Literal["none", "learned", "frozen", "random", "scripted"] = Field(
        "learned", description="What moves the focal point; none for a sensor that shows the whole frame."
    )
    actions: Literal[5, 9] = Field(
        5, description="Directions of steps: stay, up, down, left, right; 9 adds the diagonals."
    )
    step: int | tuple[int, ...] = Field(
        4, description="Frame pixels of a step; several sizes, rising, give an action each per direction."
    )
    bounds: Literal["window", "fovea", "point"] = Field(
        "window", description="What has to stay inside the frame: the whole area, its finest part, or the point alone."
    )
    start: Literal["centre", "random"] | Point = Field("centre", description="Start of an episode, moved in bounds.")
    path: tuple[Point, ...] = Field((), description="Points that mode=scripted visits in turn, moved in bounds.")
    moves: Literal["steps", "absolute"] = Field(
        "steps", description="What a visual action is: a step, or a cell of a grid to look at."
    )
    grid: Grid = Field((5, 5), description="Cells that an absolute move chooses from.")
    cost: float = Field(0.0, ge=0, description="Price of a saccade, taken from the reward that is learned from.")
    cost_per: Literal["pixel", "saccade"] = Field(
        "pixel", description="What is counted: frame pixels moved, or saccades of any length."
    )

    def check(self) -> None:
        sizes = self.sizes
        rising = all(a < b for a, b in zip(sizes, sizes[1:], strict=False))
        if not sizes or not rising or sizes[0] < 1 or sizes[-1] > 10_000:
            raise refuse("step", self.step, "an integer from 1 to 10000, or a rising list of them")
        if self.grid[0] * self.grid[1] > 10_000:
            raise refuse("grid", self.grid, "[rows, columns] >= 1, at most 10000 cells")
        if self.mode == "scripted" and not self.path:
            raise refuse("path", self.path, "at least one [y, x] where gaze.mode=scripted")

    @property
    def sense_bounds(self) -> Literal["window", "point"]:
        """`bounds` as sensing has them: where less than the whole area stays inside the frame, it may overhang."""
        return "window" if self.bounds == "window" else "point"

    @property
    def sizes(self) -> tuple[int, ...]:
        """The step sizes, frame pixels, smallest first."""
        return (self.step,) if isinstance(self.step, int) else self.step

    @property
    def num_actions(self) -> int:
        """How many visual actions there are."""
        if self.moves == "absolute":
            return self.grid[0] * self.grid[1]
        return 1 + (self.actions - 1) * len(self.sizes)

    @property
    def learned(self) -> bool:
        """Whether the network has a vision head."""
        return self.mode == "learned"


class EnvConfig(Section):
    """The environment and its preprocessing (Table III)."""

    prefix: ClassVar[str] = "env."
    engine: Literal["envpool", "ale"] = Field("envpool", description="What runs Atari games.")
    num_envs: int = Field(32, ge=1, le=100_000, description="Environments, of all processes together.")
    num_groups: int = Field(1, ge=1, description="Sets of environments that step in turn, while another decides.")
    frame_shape: Shape = Field((80, 80), description="Size of the frame that the sensor looks at.")
    crop: bool = Field(
        True, description="Halve 160 of an Atari screen's 210 rows; else shrink the whole screen to env.frame_shape."
    )
    crop_top: Mapping[str, Row] = Field({"default": 34, "beam_rider": 20}, description="First screen row, by game.")
    color: bool = Field(False, description="Frames in colour, of Atari and Gymnasium games; else gray.")
    full_action_space: bool = Field(
        False, description="All 18 actions of an Atari game, not just those that do anything."
    )
    frame_skip: int = Field(4, ge=1, le=1000, description="Emulator frames per step.")
    noop_max: int = Field(30, ge=0, le=200, description="No-ops before an episode are drawn from 0 to this.")
    clip_rewards: bool = Field(True, description="Clip rewards to [-1, 1] for learning.")
    episodic_life: bool = Field(True, description="A lost life ends the learner's episode.")
    fire_on_reset: bool = Field(True, description="Press FIRE where a game waits for it.")
    sticky_actions: float = Field(0.0, ge=0, lt=1, description="Probability that the emulator repeats the last action.")
    # The engines count frames in 32 bits, and abort the process where the system has no threads left.
    max_episode_steps: int = Field(27_000, ge=1, le=2_000_000, description="Agent steps after which a game is cut.")
    threads: int = Field(0, ge=0, le=1024, description="Threads of the engine; 0 lets it choose.")
    timeout: float = Field(120.0, gt=0, description="Seconds per step after which the engine is taken for hung.")
    kwargs: Mapping[str, Any] = Field({}, description="Arguments of a Gymnasium environment or of one's own factory.")

    def check(self) -> None:
        if "default" not in self.crop_top:
            raise refuse("crop_top", self.crop_top, "a mapping with the key 'default'")

    @property
    def pixel_shape(self) -> tuple[int, ...]:
        """What follows rows and columns in the shape of screens and frames: (3,) in colour, else ()."""
        return (3,) if self.color else ()


class SearchConfig(Section):
    """The scenes of game=search and game=detect."""

    prefix: ClassVar[str] = "search."
    target: Literal["letter", "feature", "conjunction", "cued"] = Field(
        "letter", description="What tells the target: its letter, its brightness, both, or a cue shown first."
    )
    set_sizes: tuple[Letters, ...] = Field((8,), min_length=1, description="Letters in a scene, drawn from these.")
    staircase: bool = Field(
        False, description="Train on scenes with several targets first, one fewer per right answer, two more per wrong."
    )
    absent: bool = Field(False, description="Half of the scenes have no target, and one more answer says so.")
    classes: Literal[2, 4] = Field(4, description="Ways that the target may point, and answers.")
    max_fixations: int = Field(
        30, ge=1, le=10_000, description="Decisions after which an episode ends as with a wrong answer."
    )
    price: float = Field(0.01, ge=0, lt=1, description="Price of a decision, in units of reward.")
    contrast: tuple[float, float] = Field(
        (0.6, 1.0), description="Contrast of letters on their plates, drawn between these."
    )
    noise: float = Field(0.0, ge=0, le=64, description="Standard deviation of noise, gray levels.")
    clutter: int = Field(0, ge=0, le=1000, description="Bars between the letters.")

    def check(self) -> None:
        if not 0 < self.contrast[0] <= self.contrast[1] <= 1:
            raise refuse("contrast", self.contrast, "[least, most] in (0, 1]")


class NetworkConfig(Section):
    """The network's parts and their sizes."""

    prefix: ClassVar[str] = "network."
    torso: str = Field("nature", description="The convolutions: nature, a3c, small, impala, or package.module:Class.")
    widths: tuple[Width, ...] | None = Field(
        None, min_length=1, description="Channels of the torso's layers; null for its own."
    )
    torso_kwargs: Mapping[str, Any] = Field({}, description="Further arguments of the torso.")
    core: str = Field("lstm", description="The memory: lstm, gru, mingru, none (no memory), or package.module:Class.")
    core_kwargs: Mapping[str, Any] = Field({}, description="Further arguments of the core.")
    dense: int = Field(256, ge=0, le=16_384, description="Units between torso and LSTM; 0 for none.")
    dense_norm: bool = Field(True, description="Layer norm of what enters these units.")
    lstm: int = Field(256, ge=1, le=16_384, description="Units of the LSTM.")
    padding: Literal["cover", "valid"] = Field(
        "cover", description="Whether the nature torso sees what its strides would leave out (cover) or not (valid)."
    )
    focal_point: Literal["always", "packed"] = Field(
        "always", description="When the LSTM is told the focal point: always, or where no canvas shows it (packed)."
    )
    focal_scale: Literal["reach", "frame"] = Field(
        "reach", description="What lies at -1 and 1 of that point: the ends of its reach, or of the frame."
    )
    last_actions: bool = Field(True, description="The LSTM is told both actions of the step before.")
    last_reward: bool = Field(True, description="The LSTM is told the reward of the step before.")
    forget_bias: float = Field(1.0, ge=-100, le=100, description="Of the LSTM's forget gates, before learning.")
    lstm_norm: bool = Field(True, description="Layer norm of the input's part of the LSTM's gates.")
    priority_map: bool = Field(
        False, description="The vision head reads the peripheral grid as a map of where to look."
    )
    normalization: Literal["pixel", "running", "frame", "none"] = Field(
        "pixel", description="Frames less a mean: of each pixel, of all pixels so far, of one frame, or none."
    )

    def check(self) -> None:
        for key, ours in (("torso", ("nature", "a3c", "small", "impala")), ("core", ("lstm", "gru", "mingru", "none"))):
            if (name := getattr(self, key)) not in ours and ":" not in name:
                raise refuse(key, name, (*ours, "package.module:Class"))


class HeadConfig(Section):
    """What one head learns with."""

    gamma: float = Field(0.99, ge=0, le=1, description="Discount per step.")
    gae_lambda: float = Field(0.95, ge=0, le=1, description="Lambda of the generalised advantages.")
    entropy_weight: float = Field(0.003, ge=0, description="Weight of the policy's entropy.")


class LearnerConfig(Section):
    """The update."""

    prefix: ClassVar[str] = "learner."
    rollout_length: int = Field(64, ge=2, le=100_000, description="Steps per environment between two updates, T.")
    num_minibatches: int = Field(16, ge=1, le=100_000, description="Groups of environments, each with a gradient step.")
    num_epochs: int = Field(2, ge=1, le=1000, description="Passes over a rollout.")
    clip_ratio: float | None = Field(0.1, gt=0, description="PPO's clipping of probability ratios; null for plain A2C.")
    learning_rate: float = Field(1e-3, gt=0, description="Adam's, after the warm-up.")
    full_rate_inputs: int | None = Field(
        None, ge=1, le=10**9, description="Layers with more inputs learn at a rate that much smaller; null for none."
    )
    warmup_updates: int = Field(1000, ge=0, le=10**9, description="Updates over which the rate rises; 0 for none.")
    schedule: Literal["constant", "linear"] = Field(
        "linear", description="The rate after that; linear falls to 0 at train.env_steps, skipped updates apart."
    )
    amsgrad: bool = Field(False, description="Divide by the largest second moment so far, in place of Adam's latest.")
    adam_b1: float = Field(0.9, ge=0, lt=1, description="Decay of Adam's first moment.")
    adam_b2: float = Field(0.999, ge=0, lt=1, description="Decay of Adam's second moment.")
    adam_eps: float = Field(1e-5, gt=0, description="Added to the root of the second moment.")
    max_grad_norm: float | None = Field(0.5, gt=0, description="Largest norm of the whole gradient; null for no limit.")
    reduction: Literal["mean", "sum"] = Field("mean", description="Of losses over time; else it is the mean.")
    normalize_advantages: bool = Field(True, description="Advantages of a minibatch get mean 0 and deviation 1.")
    value_weight: float = Field(0.5, ge=0, description="Weight of both value losses.")
    vision_weight: float = Field(0.25, ge=0, description="Weight of both of the vision head's losses.")
    value_target: Literal["n_step", "lambda"] = Field("lambda", description="N-step or lambda-returns.")
    vision_bootstrap: Literal["consistent", "literal"] = Field(
        "consistent", description="Bootstrap of the vision head's n-step returns: consistent, or literal as printed."
    )
    credits_last_gaze: bool = Field(True, description="The visual action before an end gets a policy gradient too.")
    natural: HeadConfig = Field(HeadConfig(), description="The head that acts in the environment.")
    vision: HeadConfig = Field(
        HeadConfig(),
        description="The head that moves the gaze; follows the natural head until it is set.",
        json_schema_extra={"follows": "learner.natural"},
    )

    def check(self) -> None:
        if self.vision_bootstrap == "literal" and self.value_target == "lambda":
            accepted = "consistent where learner.value_target=lambda"
            raise refuse("vision_bootstrap", self.vision_bootstrap, accepted)


class TrainConfig(Section):
    """The loop around the learner."""

    prefix: ClassVar[str] = "train."
    env_steps: int = Field(5_000_000, ge=1, description="Agent steps, of all environments together, to train for.")
    init_from: str | None = Field(None, description="Run or agent whose parameters a new run begins with.")
    log_every: float = Field(10.0, gt=0, description="Seconds between two rows of metrics.")
    logger: str | None = Field(None, description="What gets each row too: wandb, or package.module:Class.")
    logger_kwargs: Mapping[str, Any] = Field({}, description="Arguments of that logger.")
    checkpoint_every: float = Field(60.0, gt=0, description="Seconds between two checkpoints.")
    keep_checkpoints: int = Field(3, ge=1, le=10**9, description="How many of the newest checkpoints are kept.")
    devices: int = Field(1, ge=1, le=10**9, description="Devices of each process, which share its environments.")
    max_skipped: int = Field(20, ge=1, le=10**9, description="Not finite updates in a row that stop the run.")
    dump_skipped: bool = Field(False, description="Keep the batches that such rows begin with, in <run>/skipped.")

    def check(self) -> None:
        if self.logger is not None and self.logger != "wandb" and ":" not in self.logger:
            raise refuse("logger", self.logger, ("wandb", CODE))


class DistributedConfig(Section):
    """The processes that share a run. SLURM's are found without any of this; other launchers state the first three."""

    prefix: ClassVar[str] = "distributed."
    coordinator: str | None = Field(None, description="Address of process 0, host:port.")
    processes: int | None = Field(None, ge=1, description="How many processes share the run.")
    process: int | None = Field(None, ge=0, description="This one's number, from 0.")
    timeout: float = Field(180.0, gt=0, description="Seconds that others are waited for; more than env.timeout.")

    def check(self) -> None:
        coordinator, processes, process = stated = (self.coordinator, self.processes, self.process)
        if coordinator is None or processes is None or process is None:
            if stated != (None, None, None):
                names = "coordinator, distributed.processes, distributed.process"
                raise refuse(names, stated, "a value for all three or for none")
            return
        check_address("coordinator", coordinator)
        if process >= processes:
            raise refuse("process", process, f"an integer from 0 to {processes - 1}")


class Config(Section):
    """One run."""

    name: Name = Field(description="Name of the experiment, such as constant70.")
    sensor: Annotated[
        Annotated[RingSensor, Tag("rings")]
        | Annotated[LogPolarSensor, Tag("logpolar")]
        | Annotated[OwnSensor, Tag(CODE)],
        Discriminator(_kind),
    ]
    game: Name = Field(
        "breakout",
        description="An Atari game, seek, search, detect, probe:<name>, gymnasium:<id>, or package.module:factory.",
    )
    seed: int = Field(0, ge=0, le=2**31 - 10_001, description="Seed of environments, parameters and actions.")
    run: str | None = Field(None, description="The run's directory; null for runs/<game>-<name>-s<seed>.")
    profile: bool = Field(False, description="Trace some updates into <run>/profile in place of training.")
    gaze: GazeConfig = GazeConfig()
    env: EnvConfig = EnvConfig()
    search: SearchConfig = SearchConfig()
    network: NetworkConfig = NetworkConfig()
    learner: LearnerConfig = LearnerConfig()
    train: TrainConfig = TrainConfig()
    distributed: DistributedConfig = DistributedConfig()

    def check(self) -> None:
        self._check_places()
        self._check_map()
        self._check_minibatches()
        check_shares(self, self.train.devices, "train.devices", self.train.devices)
        self._check_counters()

    def _check_places(self) -> None:
        """The focal area, its grid and its points lie inside of the frame."""
        height, width = self.env.frame_shape
        frame = f"env.frame_shape={height}x{width}"
        if self.sensor.window is not None:
            check_window(self, self.sensor.window)
        grid = getattr(self.sensor, "peripheral", None) or (1, 1)
        if grid[0] > height or grid[1] > width:
            raise refuse("sensor.peripheral", grid, f"a grid no finer than {frame}")
        if self.gaze.moves == "absolute" and (self.gaze.grid[0] > height or self.gaze.grid[1] > width):
            raise refuse("gaze.grid", self.gaze.grid, f"a grid no finer than {frame}")
        for y, x in self.gaze.path + ((self.gaze.start,) if isinstance(self.gaze.start, tuple) else ()):
            if not (0 <= y < height and 0 <= x < width):
                raise refuse("gaze.start or gaze.path", (y, x), f"[y, x] inside {frame}")

    def _check_map(self) -> None:
        """Each cell of the priority map is a place that the gaze can choose."""
        sensor = self.sensor
        cells = sensor.peripheral if isinstance(sensor, RingSensor) and sensor.layout == "packed" else None
        chosen = self.gaze.grid if self.gaze.moves == "absolute" else None
        if self.network.priority_map and self.gaze.learned and (cells is None or cells != chosen):
            accepted = "false, or gaze.moves=absolute with gaze.grid=sensor.peripheral and sensor.layout=packed"
            raise refuse("network.priority_map", True, accepted)

    def _check_minibatches(self) -> None:
        count, envs, groups = self.learner.num_minibatches, self.env.num_envs, self.env.num_groups
        if envs % count:
            raise refuse("learner.num_minibatches", count, f"a divisor of env.num_envs={envs}")
        if count % groups:
            raise refuse("env.num_groups", groups, f"a divisor of learner.num_minibatches={count}")

    def _check_counters(self) -> None:
        """Each environment's steps and the updates are counted in 32 bits."""
        learner, rollout = self.learner, self.env.num_envs * self.learner.rollout_length
        most = 2**31 // max(learner.rollout_length, learner.num_minibatches * learner.num_epochs) - 2
        if -(-self.train.env_steps // rollout) > most:
            keys = "learner.rollout_length, num_minibatches, num_epochs and env.num_envs"
            raise refuse("train.env_steps", self.train.env_steps, f"at most {most * rollout} with these {keys}")

    @field_validator("game")
    @classmethod
    def _one_name(cls, game: str) -> str:
        return game_name(game)

    @property
    def code(self) -> list[str]:
        """What of it names code outside of foajax, which runs where the part is made.

        Not `train.logger`: training alone makes that, from its own words, and nothing that reads a run or an agent.
        """
        names = {"game": self.game, "sensor.kind": self.sensor.kind}
        names |= {"network.torso": self.network.torso, "network.core": self.network.core}
        ours = ("probe:", "gymnasium:ale_py:")
        return [
            f"{key}={name}"
            for key, name in names.items()
            if ":" in name.removeprefix("gymnasium:") and not name.startswith(ours)
        ]

    @property
    def searches(self) -> bool:
        """Whether its episodes are scenes of visual search."""
        return self.game in ("search", "detect")

    @property
    def run_dir(self) -> str:
        """Where the run's files are."""
        return self.run or f"runs/{file_name(self.game)}-{self.name}-s{self.seed}"


def game_name(game: str) -> str:
    """The snake-case name of an Atari game that has a name of Gymnasium's or EnvPool's; any other name as it is.

    SpaceInvaders, ALE/SpaceInvaders-v5, SpaceInvadersNoFrameskip-v4 and SpaceInvaders-v5 are space_invaders.
    """
    found = re.fullmatch(r"(?:ALE/)?([A-Z][A-Za-z0-9]*?)(?:NoFrameskip|Deterministic)?(?:-v\d+)?", game)
    return re.sub(r"(?<!^)(?=[A-Z])", "_", found[1]).lower() if found else game


def check_window(config: Config, window: tuple[int, int]) -> None:
    """`ConfigError` unless the sensor's focal area fits into the frame and the gaze can move it."""
    (height, width), key = config.env.frame_shape, config.sensor.size_key
    frame, bounds = f"env.frame_shape={height}x{width}", config.gaze.bounds
    if (bounds == "window" or not config.sensor.may_overhang) and (window[0] > height or window[1] > width):
        raise refuse(key, window, f"a focal area inside {frame}")
    if config.gaze.mode in ("learned", "random") and bounds == "window" and window == (height, width):
        raise refuse("gaze.bounds", bounds, f"point, or gaze=none: {key} fills {frame} and could not move")


def check_address(key: str, value: str) -> None:
    """`ConfigError`, about `key`, unless `value` says where other processes find the first one."""
    host, _, port = value.rpartition(":")
    if host == "" or not port.isdecimal():
        raise refuse(key, value, "host:port of process 0")


def check_shares(config: Config, shares: int, key: str, value: object) -> None:
    """`ConfigError`, about `key`, unless `shares` devices can each have the same part of a minibatch."""
    size = config.env.num_envs // config.learner.num_minibatches
    if size % shares:
        parts = "env.num_envs / learner.num_minibatches"
        raise refuse(key, value, f"a divisor of the {size} environments of a minibatch ({parts})")


def renamed(mapping: Mapping[str, Any], fixed: Collection[str] = ()) -> dict[str, Any]:
    """A copy of nested mappings in which words of before are today's; those of today in `fixed` keep their values."""
    found = copy.deepcopy(dict(mapping))
    for old, new in RENAMED.items():
        *path, word = old.split(".")
        section: Any = found
        for name in path:
            section = section.get(name) if isinstance(section, dict) else None
        if isinstance(section, dict) and word in section:
            value = section.pop(word)
            if new not in fixed:
                section[new.rpartition(".")[2]] = value
    return found


def from_mapping(mapping: Any) -> Config:
    """Builds a checked `Config` from plain nested mappings, words of before included; raises `ConfigError`."""
    return build(Config, renamed(mapping) if isinstance(mapping, Mapping) else mapping)
