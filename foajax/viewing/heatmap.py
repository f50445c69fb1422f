"""Counts and draws where an agent looks: its focal points over whole games (the paper's Fig. 10)."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from matplotlib import colormaps, rc_context
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from foajax.config.parse import refuse
from foajax.config.schema import Config
from foajax.runs import durable
from foajax.sensors import gaze
from foajax.sensors.registry import make_sensor
from foajax.viewing.recording import Recording
from foajax.viewing.style import STYLE

FILE = "heatmap.json"
_COLOURS = colormaps["inferno"](np.linspace(0.4, 1, 256))  # without the end that is as dark as a game
_ZOOM = 0.25  # gaze that can reach less than this share of the frame is shown enlarged as well


@dataclasses.dataclass(frozen=True)
class HeatMap:
    """How often the focal point was at each place of the frame."""

    counts: Int[np.ndarray, "H W"]  # steps with the focal point at (y, x)
    mean_frame: Float[np.ndarray, "H W *C"]  # over the same steps, 0 to 1
    low: Int[np.ndarray, "2"]  # the smallest and the largest focal point (y, x) that the gaze may have
    high: Int[np.ndarray, "2"]
    games: int
    # Whose gaze it is; None where an older file does not say so.
    env_steps: int | None = None  # the agent had been trained for
    policy: str | None = None  # "sampled" or "greedy"
    whole_games: bool | None = None  # False where one was cut

    @property
    def steps(self) -> int:
        return int(self.counts.sum())

    @property
    def entropy(self) -> float:
        """Entropy of the focal point's distribution, in bits: 0 for a gaze that never moves."""
        shares = self.counts[self.counts > 0] / self.steps
        return float(abs((shares * np.log2(shares)).sum()))

    @property
    def share_at_bounds(self) -> float:
        """Share of the steps at which the focal point was at a bound, along either axis."""
        y, x = np.nonzero(self.counts)
        points = np.stack([y, x], axis=-1)
        at_bounds = ((points == self.low) | (points == self.high)).any(axis=-1)
        return float(self.counts[y, x][at_bounds].sum() / self.steps)

    @property
    def share_below(self) -> float:
        """Share of the steps with the focal point in the lower half of the frame, below its middle row."""
        return float(self.counts[self.counts.shape[0] // 2 + 1 :].sum() / self.steps)

    @property
    def spread(self) -> float:
        """Root mean square distance from the mean focal point, in frame pixels."""
        return _spread(self.counts)

    @property
    def relative_spread(self) -> float:
        """`spread` divided by that of a gaze spread evenly within its bounds; 0 if the bounds leave no room."""
        even = np.zeros_like(self.counts)
        even[self.low[0] : self.high[0] + 1, self.low[1] : self.high[1] + 1] = 1
        return self.spread / most if (most := _spread(even)) else 0.0

    @property
    def summary(self) -> str:
        """The main numbers in one line."""
        games = f"{self.games} game{'s' if self.games > 1 else ''}"
        share = f"{100 * self.share_at_bounds:.0f} % at the bounds"
        return f"{self.steps:,} steps of {games}, {self.entropy:.2f} bits, {share}"

    def to_json(self) -> dict[str, Any]:
        """Returns plain values for JSON."""
        return {
            "steps": self.steps,
            "games": self.games,
            "env_steps": self.env_steps,
            "policy": self.policy,
            "whole_games": self.whole_games,
            "entropy_bits": self.entropy,
            "share_at_bounds": self.share_at_bounds,
            "low": self.low.tolist(),
            "high": self.high.tolist(),
            "counts": self.counts.tolist(),
            "mean_frame": self.mean_frame.round(4).tolist(),
        }

    @classmethod
    def from_json(cls, record: dict[str, Any]) -> HeatMap:
        """Makes a heat map of what `to_json` returned."""
        fields: dict[str, Any] = {key: np.array(record[key]) for key in ("counts", "mean_frame", "low", "high")}
        fields |= {key: record.get(key) for key in ("env_steps", "policy", "whole_games")}
        return cls(games=record["games"], **fields)


def _spread(counts: Int[np.ndarray, "H W"]) -> float:
    points = np.argwhere(counts)
    weights = counts[counts > 0]
    mean = np.average(points, axis=0, weights=weights)
    return float(np.sqrt(np.average(((points - mean) ** 2).sum(axis=1), weights=weights)))


def heat_map(recordings: Sequence[Recording]) -> HeatMap:
    """Counts the focal points of games of one agent."""
    config, env_steps = recordings[0].config, recordings[0].env_steps
    lengths = [len(each.focal_point) for each in recordings]
    mean = np.average([each.mean_frame for each in recordings], axis=0, weights=lengths)
    points = np.concatenate([each.focal_point for each in recordings])
    low, high = bounds(config)
    policy = "greedy" if recordings[0].greedy else "sampled"
    whole = all(each.is_over for each in recordings)
    counts = gaze.count(points, config.env.frame_shape)
    return HeatMap(counts, mean, low, high, len(recordings), env_steps, policy, whole)


def bounds(config: Config) -> tuple[np.ndarray, np.ndarray]:
    """Returns the smallest and the largest focal point (y, x) that an agent can have."""
    window = gaze.bounded(config.gaze, make_sensor(config.sensor))
    return gaze.limits(gaze=config.gaze, window=window, frame_shape=config.env.frame_shape)


def save(heat: HeatMap, directory: Path, title: str) -> None:
    """Writes `heatmap.png`, and `heatmap.json` with the counts behind it."""
    draw(heat, title).savefig(directory / "heatmap.png", dpi=150)
    durable.replace(directory / FILE, (json.dumps(heat.to_json()) + "\n").encode())


def read(file: Path) -> HeatMap:
    """Reads the JSON file that `save` wrote.

    Raises:
      ConfigError: the file is something else.
    """
    try:
        return HeatMap.from_json(json.loads(file.read_text()))
    except (OSError, ValueError, KeyError, TypeError):
        raise refuse(str(file), accepted="", why="is no heat map of foajax render; remove it") from None


def of_run(path: Path, env_steps: int, *, games: int = 1) -> HeatMap | None:
    """Reads a run's heat map, if `render` made it from `games` or more whole games, sampled, at `env_steps`."""
    file = path / "render" / FILE
    heat = read(file) if file.exists() else None
    said = heat and (heat.env_steps, heat.policy, heat.whole_games, heat.games >= games)
    return heat if said == (env_steps, "sampled", True, True) else None


def draw(heat: HeatMap, title: str) -> Figure:
    """Draws the counts over the mean frame; beside it, where the gaze has little room, that room enlarged."""
    room = int(np.prod(heat.high - heat.low + 1))
    zoomed = 1 < room < _ZOOM * heat.counts.size
    with rc_context(STYLE):
        figure = Figure(figsize=(8.6 if zoomed else 5.0, 4.6), layout="constrained")
        axes = figure.subplots(1, 2 if zoomed else 1, squeeze=False)[0]
        shares = np.ma.masked_equal(100 * heat.counts / heat.steps, 0)
        low, high = float(shares.min()), float(shares.max())
        norm = LogNorm(vmin=low if low < high else high / 10, vmax=high)
        white = float(heat.mean_frame.max()) or 1.0
        for axis in axes:
            # The frame is lightened, so that dark cells stand out from black.
            axis.imshow(0.2 + 0.6 * heat.mean_frame / white, cmap="gray", vmin=0, vmax=1)
            image = axis.imshow(shares, cmap=ListedColormap(_COLOURS), norm=norm)
        _mark_bounds(axes[0], heat)
        if zoomed:
            margin = 2
            axes[1].set_xlim(heat.low[1] - margin - 0.5, heat.high[1] + margin + 0.5)
            axes[1].set_ylim(heat.high[0] + margin + 0.5, heat.low[0] - margin - 0.5)
            _mark_bounds(axes[1], heat)
            axes[1].set_title("where it may be, enlarged", loc="left")
        axes[0].set_title(title, loc="left", fontweight="bold")
        axes[0].set_xlabel(heat.summary)
        colour_bar = figure.colorbar(image, ax=axes, shrink=0.8, pad=0.02)
        colour_bar.ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        colour_bar.ax.yaxis.set_major_formatter(FuncFormatter(lambda share, _: f"{share:g}"))
        colour_bar.ax.yaxis.set_minor_formatter(NullFormatter())
        colour_bar.set_label("focal point here, % of the steps")
    return figure


def _mark_bounds(axis: Any, heat: HeatMap) -> None:
    top, left = heat.low - 0.5
    height, width = heat.high - heat.low + 1
    axis.add_patch(Rectangle((left, top), width, height, fill=False, edgecolor="white", linestyle=":", linewidth=1))
