"""Defines every key of a run: its type, bounds, default and a sentence.

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

# Old names of keys, which are still understood, and today's.
RENAMED = {
    "env.groups": "env.num_groups",
    "learner.minibatches": "learner.num_minibatches",
    "learner.epochs": "learner.num_epochs",
    "learner.natural.beta": "learner.natural.entropy_weight",
    "learner.vision.beta": "learner.vision.entropy_weight",
    "train.keep": "train.keep_checkpoints",
}


def _says(accepted: str) -> Any:
    """Gives the words for what a type accepts, where `describe` cannot tell."""
    return Field(json_schema_extra={"accepted": accepted})


Point = Annotated[tuple[int, int], _says("[y, x]")]
Ring = Annotated[tuple[int, int, int], _says("[height, width, factor] with 1 <= factor <= height and width")]
Grid = Annotated[tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]], _says("[rows, columns] >= 1")]
Side = Annotated[int, Field(ge=8, le=10_000)]
Shape = Annotated[tuple[Side, Side], _says("[height, width], each from 8 to 10000")]
Steps = Annotated[int | tuple[int, ...], _says("an integer from 1 to 10000, or a rising list of them")]
Letters = Annotated[
    tuple[Annotated[int, Field(ge=1, le=1000)], ...], _says("a list of one or more integers from 1 to 1000")
]
Width = Annotated[int, Field(ge=1, le=16_384)]
Widths = Annotated[tuple[Width, ...], _says("a list of one or more integers from 1 to 16384")]
Contrast = Annotated[tuple[float, float], _says("[least, most] in (0, 1]")]
Row = Annotated[int, Field(ge=0, le=50), _says("a screen row from 0 to 50 (160 rows are kept of 210)")]
Name = Annotated[str, Field(pattern=r"\S"), _says("a name")]


class RingSensor(Section):
    """Windows nested around the focal point, called rings, each with its own resolution: the paper's Table II."""

    prefix: ClassVar[str] = "sensor."
    size_key: ClassVar[str] = "sensor.rings"  # what decides how large the focal area is
    may_overhang: ClassVar[bool] = False  # whether the area may be larger than the frame where gaze.bounds=point
    rings: tuple[Ring, ...] = Field(
        min_length=1, description="Rings, innermost first; each shows one value per block of factor x factor pixels."
    )
    kind: Literal["rings"] = Field("rings", description="Selects nested rings.")
    peripheral: Grid | None = Field(None, description="Background: a coarse grid over the whole frame; null for none.")
    layout: Literal["canvas", "packed"] = Field(
        "canvas", description="One image of the frame's size, 0 where nothing is seen, or a small image per ring."
    )
    pooling: Literal["mean", "stride"] = Field(
        "mean", description="Value of a block: the mean of its pixels, or its upper left pixel (stride)."
    )

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
    """A log-polar retina: rings of wedges around the focal point, larger the farther out."""

    prefix: ClassVar[str] = "sensor."
    size_key: ClassVar[str] = "sensor.radius"
    may_overhang: ClassVar[bool] = True
    kind: Literal["logpolar"] = Field("logpolar", description="Selects the log-polar retina.")
    rings: int = Field(35, ge=2, le=1000, description="Number of rings.")
    wedges: int = Field(35, ge=4, le=1000, description="Number of wedges per ring, one value each.")
    fovea: float = Field(3.0, gt=0, description="Radius of the innermost ring, a disc, in frame pixels.")
    radius: float = Field(40.0, gt=0, le=10_000, description="Radius of the outermost ring, in frame pixels.")
    sampling: Literal["area", "bilinear"] = Field(
        "area",
        description="Value of a wedge: the mean of 32x32 points of its area, or one sample at its centre (bilinear).",
    )

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
    """A class of your own that is a `foajax.Sensor`, chosen by `sensor=own`. It is checked when it is first used."""

    prefix: ClassVar[str] = "sensor."
    size_key: ClassVar[str] = "sensor.kwargs"
    may_overhang: ClassVar[bool] = True
    window: ClassVar[None] = None  # not known before it is made
    finest: ClassVar[None] = None
    kind: str = Field(description="The sensor's class, package.module:Class.")
    kwargs: Mapping[str, Any] = Field({}, description="Arguments of the sensor's constructor.")


SensorConfig = RingSensor | LogPolarSensor | OwnSensor


def _kind(value: Any) -> str | None:
    """Tells which section a value of `sensor` belongs to: rings if it has no `kind`."""
    kind = str(value.get("kind", "rings")) if isinstance(value, Mapping) else getattr(value, "kind", None)
    return CODE if kind is not None and re.fullmatch(r"[\w.]+:[\w.]+", kind) else kind


class GazeConfig(Section):
    """How the focal point moves."""

    prefix: ClassVar[str] = "gaze."
    mode: Literal["none", "learned", "frozen", "random", "scripted"] = Field(
        "learned", description="What moves the gaze: the network, nothing, chance, gaze.path; none is for whole frames."
    )
    actions: Literal[5, 9] = Field(
        5, description="Directions of a step: stay, up, down, left, right; 9 adds the diagonals."
    )
    step: Steps = Field(4, description="Frame pixels of a step; a list gives each direction one action per length.")
    bounds: Literal["window", "fovea", "point"] = Field(
        "window", description="What stays in the frame: the sensor's window, its finest part, or the focal point."
    )
    start: Literal["centre", "random"] | Point = Field(
        "centre", description="Focal point at an episode's start, within gaze.bounds."
    )
    path: tuple[Point, ...] = Field(
        (), description="Focal points that mode=scripted visits in turn, within gaze.bounds."
    )
    moves: Literal["steps", "absolute"] = Field(
        "steps", description="What a visual action is: a step, or a cell of gaze.grid to look at (absolute)."
    )
    grid: Grid = Field((5, 5), description="Grid over the frame whose cells gaze.moves=absolute chooses from.")
    cost: float = Field(
        0.0, ge=0, description="Price of moving the gaze; lowers the reward to learn from, not the score."
    )
    cost_per: Literal["pixel", "saccade"] = Field(
        "pixel", description="What the price is per: a frame pixel moved, or a move of any length (saccade)."
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
        """The `bounds` to sense with: 'window' if the whole focal area stays in the frame, else 'point'."""
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
    """The environment, and how its frames and rewards are preprocessed."""

    prefix: ClassVar[str] = "env."
    engine: Literal["envpool", "ale"] = Field("envpool", description="What runs Atari games: EnvPool or ale-py.")
    num_envs: int = Field(32, ge=1, le=100_000, description="Environments that run at the same time, in all processes.")
    num_groups: int = Field(
        1, ge=1, description="Groups of environments; while one steps, the network decides for another."
    )
    frame_shape: Shape = Field((80, 80), description="Size in pixels of the frame that the sensor looks at.")
    crop: bool = Field(
        True, description="Keep 160 of Atari's 210 rows and halve both sides; else shrink all to env.frame_shape."
    )
    crop_top: Mapping[str, Row] = Field(
        {"default": 34, "beam_rider": 20}, description="First row that env.crop keeps, by game."
    )
    color: bool = Field(False, description="Frames in colour, for Atari and Gymnasium environments; else gray.")
    full_action_space: bool = Field(False, description="All 18 actions of Atari; else those that have an effect.")
    frame_skip: int = Field(4, ge=1, le=1000, description="Emulator frames per decision; the action is held.")
    noop_max: int = Field(
        30, ge=0, le=200, description="Most no-op actions at an episode's start; drawn from 0 to this."
    )
    clip_rewards: bool = Field(
        True, description="Learn from the sign of rewards in Atari and Gymnasium environments; scores stay unclipped."
    )
    episodic_life: bool = Field(True, description="A lost life ends the episode for learning; the game goes on.")
    fire_on_reset: bool = Field(
        True, description="Press FIRE at the start and after a lost life, in games that have it."
    )
    sticky_actions: float = Field(
        0.0, ge=0, lt=1, description="Probability that the emulator repeats the action before."
    )
    # The engines count frames in 32 bits, and abort the process where the system has no threads left.
    max_episode_steps: int = Field(27_000, ge=1, le=2_000_000, description="Decisions after which a game is cut short.")
    threads: int = Field(0, ge=0, le=1024, description="Threads of env.engine; 0 lets it choose.")
    timeout: float = Field(120.0, gt=0, description="Seconds that a step may take; then the run saves and ends.")
    kwargs: Mapping[str, Any] = Field({}, description="Arguments of a Gymnasium environment or of your own factory.")

    def check(self) -> None:
        if "default" not in self.crop_top:
            raise refuse("crop_top", self.crop_top, "a mapping with the key 'default'")

    @property
    def pixel_shape(self) -> tuple[int, ...]:
        """What follows rows and columns in the shape of screens and frames: (3,) in colour, else ()."""
        return (3,) if self.color else ()


class SearchConfig(Section):
    """The scenes of game=search and game=detect: letters, of which one is the target."""

    prefix: ClassVar[str] = "search."
    target: Literal["letter", "feature", "conjunction", "cued"] = Field(
        "letter", description="What marks the target: its letter, its brightness, both, or a letter shown first (cued)."
    )
    set_sizes: Letters = Field((8,), min_length=1, description="Numbers of letters; each scene has one of them.")
    staircase: bool = Field(
        False,
        description="Begin with many targets per scene: one fewer after a right answer, two more after a wrong one.",
    )
    absent: bool = Field(
        False, description="Half of the scenes have no target; their right answer is the action absent."
    )
    classes: Literal[2, 4] = Field(
        4, description="Directions that the target may point in, an answer each: left, right; 4 adds up, down."
    )
    max_fixations: int = Field(
        30, ge=1, le=10_000, description="Decisions until an episode ends; no answer counts as a wrong one."
    )
    price: float = Field(0.01, ge=0, lt=1, description="Price of a decision, subtracted from the reward.")
    contrast: Contrast = Field((0.6, 1.0), description="Range of the letters' contrast with their plates.")
    noise: float = Field(0.0, ge=0, le=64, description="Standard deviation of the noise in each pixel, in gray levels.")
    clutter: int = Field(0, ge=0, le=1000, description="Bars between the letters, as distractors.")

    def check(self) -> None:
        if not 0 < self.contrast[0] <= self.contrast[1] <= 1:
            raise refuse("contrast", self.contrast, "[least, most] in (0, 1]")


class NetworkConfig(Section):
    """The network's parts and their sizes."""

    prefix: ClassVar[str] = "network."
    torso: str = Field(
        "nature",
        description="Convolutions for the sensor's images: nature, a3c, small, impala, or package.module:Class.",
    )
    widths: Widths | None = Field(
        None, min_length=1, description="Channels of the torso's layers; null for its defaults."
    )
    torso_kwargs: Mapping[str, Any] = Field({}, description="Further arguments of the torso's constructor.")
    core: str = Field("lstm", description="Memory before the heads: lstm, gru, mingru, none, or package.module:Class.")
    core_kwargs: Mapping[str, Any] = Field({}, description="Further arguments of the core's constructor.")
    dense: int = Field(256, ge=0, le=16_384, description="Units of the layer between torso and core; 0 for no layer.")
    dense_norm: bool = Field(True, description="Apply layer norm to the inputs of the dense layer.")
    lstm: int = Field(256, ge=1, le=16_384, description="Units of the core, whichever network.core is.")
    padding: Literal["cover", "valid"] = Field(
        "cover", description="Rows and columns that the nature torso's strides leave over: seen (cover) or dropped."
    )
    focal_point: Literal["always", "packed"] = Field(
        "always", description="When the core is told the focal point: always, or where there is no canvas (packed)."
    )
    focal_scale: Literal["reach", "frame"] = Field(
        "reach", description="The core is told the focal point as -1 to 1 over the gaze's reach, or over the frame."
    )
    last_actions: bool = Field(True, description="Tell the core the natural and the visual action of the last step.")
    last_reward: bool = Field(True, description="Tell the core the reward of the last step.")
    forget_bias: float = Field(
        1.0, ge=-100, le=100, description="Initial bias of the forget gates; more keeps memory longer."
    )
    lstm_norm: bool = Field(True, description="Apply layer norm to what the core's gates get from its inputs.")
    priority_map: bool = Field(
        False, description="Prefer to look at those cells of the periphery that match a query from the core."
    )
    normalization: Literal["pixel", "running", "frame", "none"] = Field(
        "pixel", description="Mean subtracted from frames: running per pixel, running over all, or each frame's own."
    )

    def check(self) -> None:
        for key, ours in (("torso", ("nature", "a3c", "small", "impala")), ("core", ("lstm", "gru", "mingru", "none"))):
            if (name := getattr(self, key)) not in ours and ":" not in name:
                raise refuse(key, name, (*ours, "package.module:Class"))


class HeadConfig(Section):
    """What one head learns with."""

    gamma: float = Field(0.99, ge=0, le=1, description="Discount per decision.")
    gae_lambda: float = Field(0.95, ge=0, le=1, description="Lambda of generalised advantage estimation (GAE).")
    entropy_weight: float = Field(0.003, ge=0, description="Weight of the entropy, a bonus for exploring.")


class LearnerConfig(Section):
    """How the network learns from a rollout: losses, optimizer and schedule."""

    prefix: ClassVar[str] = "learner."
    rollout_length: int = Field(
        64, ge=2, le=100_000, description="Decisions per environment between two updates of the network, T."
    )
    num_minibatches: int = Field(
        16, ge=1, le=100_000, description="Gradient steps per pass, each on a share of the environments."
    )
    num_epochs: int = Field(2, ge=1, le=1000, description="Passes over each rollout.")
    clip_ratio: float | None = Field(
        0.1, gt=0, description="PPO's bound on how far probability ratios leave 1; null for none, as in A2C."
    )
    learning_rate: float = Field(1e-3, gt=0, description="Adam's learning rate after the warm-up.")
    full_rate_inputs: int | None = Field(
        None,
        ge=1,
        le=10**9,
        description="Layers with n times this many inputs learn at 1/n of the rate; null for one rate.",
    )
    warmup_updates: int = Field(
        1000, ge=0, le=10**9, description="Updates until the full learning rate; 0 for no warm-up."
    )
    schedule: Literal["constant", "linear"] = Field(
        "linear", description="Learning rate: constant, or falling linearly to 0 at train.env_steps."
    )
    amsgrad: bool = Field(False, description="Use AMSGrad: divide by the largest second moment so far.")
    adam_b1: float = Field(0.9, ge=0, lt=1, description="Decay rate of Adam's first moment.")
    adam_b2: float = Field(0.999, ge=0, lt=1, description="Decay rate of Adam's second moment.")
    adam_eps: float = Field(1e-5, gt=0, description="Added to the root of Adam's second moment.")
    max_grad_norm: float | None = Field(
        0.5, gt=0, description="Norm that the whole gradient is cut down to; null for no limit."
    )
    reduction: Literal["mean", "sum"] = Field("mean", description="Losses over time: their mean or their sum.")
    normalize_advantages: bool = Field(
        False, description="Scale each minibatch's advantages to mean 0, deviation 1; for rewards that are not clipped."
    )
    value_weight: float = Field(0.5, ge=0, description="Weight of each head's value loss.")
    vision_weight: float = Field(
        0.25, ge=0, description="Weight of the vision head's whole loss, beside 1 of the natural head's."
    )
    value_target: Literal["n_step", "lambda"] = Field("lambda", description="Values learn n-step or lambda-returns.")
    vision_bootstrap: Literal["consistent", "literal"] = Field(
        "consistent",
        description="Vision head's n-step returns: as the paper's TD error implies, or as its formula says.",
    )
    credits_last_gaze: bool = Field(
        True, description="An episode's last visual action gets a gradient, though no frame follows it."
    )
    natural: HeadConfig = Field(HeadConfig(), description="The head that acts in the environment.")
    vision: HeadConfig = Field(
        HeadConfig(),
        description="The head that moves the gaze. Its keys follow the natural head's unless you set them.",
        json_schema_extra={"follows": "learner.natural"},
    )

    def check(self) -> None:
        if self.vision_bootstrap == "literal" and self.value_target == "lambda":
            accepted = "consistent where learner.value_target=lambda"
            raise refuse("vision_bootstrap", self.vision_bootstrap, accepted)


class TrainConfig(Section):
    """How long a run trains, what it starts from, and what it writes."""

    prefix: ClassVar[str] = "train."
    env_steps: int = Field(
        5_000_000, ge=1, description="Decisions of all environments together, at least: a run ends with a rollout."
    )
    init_from: str | None = Field(
        None, description="Run or agent whose parameters and frame statistics a new run begins with."
    )
    log_every: float = Field(10.0, gt=0, description="Seconds between two rows of metrics.")
    logger: str | None = Field(
        None, description="Another logger of each row: wandb (Weights & Biases), or package.module:Class."
    )
    logger_kwargs: Mapping[str, Any] = Field({}, description="Arguments of wandb.init or of your logger.")
    checkpoint_every: float = Field(60.0, gt=0, description="Seconds between two checkpoints.")
    keep_checkpoints: int = Field(
        3, ge=1, le=10**9, description="Newest checkpoints that are kept, besides the best one."
    )
    devices: int = Field(1, ge=1, le=10**9, description="Devices per process; they share its environments.")
    max_skipped: int = Field(
        20, ge=1, le=10**9, description="Stop after so many updates in a row that were not finite."
    )
    dump_skipped: bool = Field(False, description="Keep batches of updates that were not finite, in <run>/skipped.")

    def check(self) -> None:
        if self.logger is not None and self.logger != "wandb" and ":" not in self.logger:
            raise refuse("logger", self.logger, ("wandb", CODE))


class DistributedConfig(Section):
    """The processes that share one run. Under SLURM they find each other; elsewhere, set the first three keys."""

    prefix: ClassVar[str] = "distributed."
    coordinator: str | None = Field(None, description="Address of process 0, host:port.")
    processes: int | None = Field(None, ge=1, description="Number of processes that share the run.")
    process: int | None = Field(None, ge=0, description="Number of this process, counted from 0.")
    timeout: float = Field(180.0, gt=0, description="Seconds to wait for other processes; more than env.timeout.")

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
    """What a run trains, on what, and where its files go."""

    name: Name = Field(description="Name of the experiment; experiment=constant70 sets it to constant70.")
    sensor: Annotated[
        Annotated[RingSensor, Tag("rings")]
        | Annotated[LogPolarSensor, Tag("logpolar")]
        | Annotated[OwnSensor, Tag(CODE)],
        Discriminator(_kind),
    ]
    game: Name = Field(
        "breakout",
        description="An Atari game, seek, search, detect, probe:<test>, gymnasium:<id>, or package.module:factory.",
    )
    seed: int = Field(
        0, ge=0, le=2**31 - 10_001, description="Seed of environments, first parameters and sampled actions."
    )
    run: str | None = Field(None, description="Directory of the run; null for runs/<game>-<name>-s<seed>.")
    profile: bool = Field(
        False, description="Time a few updates in place of training; print a table, write a trace to <run>/profile."
    )
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
        """Checks that the focal area, the grids and the focal points lie inside of the frame."""
        height, width = self.env.frame_shape
        frame = f"env.frame_shape={height}x{width}"
        if self.sensor.window is not None:
            check_window(self, self.sensor)
        grid = getattr(self.sensor, "peripheral", None) or (1, 1)
        if grid[0] > height or grid[1] > width:
            raise refuse("sensor.peripheral", grid, f"a grid no finer than {frame}")
        if self.gaze.moves == "absolute" and (self.gaze.grid[0] > height or self.gaze.grid[1] > width):
            raise refuse("gaze.grid", self.gaze.grid, f"a grid no finer than {frame}")
        for key, point in (("gaze.start", self.gaze.start), *(("gaze.path", point) for point in self.gaze.path)):
            if isinstance(point, tuple) and not (0 <= point[0] < height and 0 <= point[1] < width):
                raise refuse(key, point, f"[y, x] inside {frame}")

    def _check_map(self) -> None:
        """Checks that each cell of the priority map is a place that the gaze can choose."""
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
        """Limits `train.env_steps`: each environment's steps and the updates are counted in 32 bits."""
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
        """The `key=name` words that name code outside of foajax, which runs when the part is made.

        `train.logger` is not among them: only training makes a logger, never what reads a run or an agent.
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
    """Returns the snake-case name for Gymnasium's or EnvPool's name of an Atari game; any other name as it is.

    SpaceInvaders, ALE/SpaceInvaders-v5, SpaceInvadersNoFrameskip-v4 and SpaceInvaders-v5 are space_invaders.
    """
    found = re.fullmatch(r"(?:ALE/)?([A-Z][A-Za-z0-9]*?)(?:NoFrameskip|Deterministic)?(?:-v\d+)?", game)
    return re.sub(r"(?<!^)(?=[A-Z])", "_", found[1]).lower() if found else game


def check_window(config: Config, sensor: Any) -> None:
    """Raises `ConfigError` unless the sensor's focal area fits into the frame and the gaze can move it.

    `sensor` is the one of `config` or, where that is `OwnSensor`, the `Sensor` that was made.
    """
    (height, width), key = config.env.frame_shape, config.sensor.size_key
    frame, bounds = f"env.frame_shape={height}x{width}", config.gaze.bounds
    window, finest = sensor.window, sensor.finest
    if (bounds == "window" or not config.sensor.may_overhang) and (window[0] > height or window[1] > width):
        raise refuse(key, window, f"a focal area inside {frame}")
    if bounds == "fovea" and (finest[0] > height or finest[1] > width):
        raise refuse("gaze.bounds", bounds, "point", why=f"the finest part of {key}, {list(finest)}, exceeds {frame}")
    kept_inside = {"window": window, "fovea": finest}.get(bounds)
    if config.gaze.mode in ("learned", "random") and kept_inside == (height, width):
        why = f"the focal area of {key} fills {frame} and cannot move"
        raise refuse("gaze.bounds", bounds, "point, or gaze=none", why=why)


def check_address(key: str, value: str) -> None:
    """Raises `ConfigError` about `key` unless `value` has the form host:port."""
    host, _, port = value.rpartition(":")
    if host == "" or not port.isdecimal():
        raise refuse(key, value, "host:port of process 0")


def check_shares(config: Config, shares: int, key: str, value: object) -> None:
    """Raises `ConfigError` about `key` unless `shares` devices can have equal parts of a minibatch."""
    size = config.env.num_envs // config.learner.num_minibatches
    if size % shares:
        parts = "env.num_envs / learner.num_minibatches"
        raise refuse(key, value, f"a divisor of the {size} environments of a minibatch ({parts})")


def renamed(mapping: Mapping[str, Any], fixed: Collection[str] = ()) -> dict[str, Any]:
    """Copies nested mappings with today's names for old keys. A new name in `fixed` keeps its own value."""
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
    """Makes a checked `Config` from nested mappings, which may have old keys; raises `ConfigError`."""
    return build(Config, renamed(mapping) if isinstance(mapping, Mapping) else mapping)
