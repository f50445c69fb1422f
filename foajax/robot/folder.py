"""Writes the folder of an exported agent: network, sensor's tables, facts, recorded steps, and the code to run them."""

from __future__ import annotations

import datetime
import hashlib
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from foajax.config.parse import ConfigError, refuse, to_mapping
from foajax.config.schema import Config, LogPolarSensor, OwnSensor, RingSensor
from foajax.envs.atari import is_atari
from foajax.envs.make import action_names, steps_per_second
from foajax.learning.agent import Agent
from foajax.robot import golden, onnx_graph, smaller, stablehlo
from foajax.runs import provenance
from foajax.runs.agents import TrainedAgent, load_score
from foajax.sensors import gaze, geometry
from foajax.sensors.base import Sensor
from foajax.sensors.frames import SMALLEST_STD
from foajax.sensors.reconstruct import tables
from foajax.sensors.sense import sense
from foajax.types import FrameStatistics

FORMAT = 1
WEIGHTS = {"float32": lambda model: model, "float16": smaller.float16, "int8": smaller.int8}
# Of the recorded steps: by how much logits may differ, and what share of the actions must be the same.
CHECKS = {
    "float32": {"logits": 1e-4, "same": 1.0},
    "float16": {"logits": 0.1, "same": 0.98},
    "int8": {"logits": 2.0, "same": 0.8},
}
FACTS = "agent.json"
CODE = ("agent.py", "check.py", "camera.py", "node.py")  # copied as they are
_TIMEOUT = 600.0  # seconds that the check may take


def write(
    stored: TrainedAgent,
    out: Path,
    *,
    source: str,
    dtype: str = "float32",
    with_stablehlo: bool = False,
    command: Sequence[str] = (),
) -> str:
    """Writes an agent to `out` if the folder's own check passes; returns the check's line.

    Args:
      stored: the agent.
      out: a new directory, or one that an earlier export has written.
      source: the run or agent that it was read from, for `agent.json`.
      dtype: type of the stored weights, one of `CHECKS`.
      with_stablehlo: whether to write the whole decision as a program for JAX too.
      command: as it was typed, for `agent.json`.

    Raises:
      ConfigError: `out` is something else or cannot be written; the network has a part that cannot be exported; the
        game cannot be played here; the check fails.
    """
    if out.exists() and not (out.is_dir() and (_is_export(out) or not any(out.iterdir()))):
        raise refuse("out", out, "a new directory, or one that export has written")
    facts(stored)  # these two refuse what cannot be exported, before games are played
    onnx_graph.policy(stored.agent, stored.params, {})
    recorded, origin = golden.record(stored), _provenance(stored, source, command)
    try:
        whole = out.resolve()  # `.` has neither a name nor a parent
        whole.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=whole.parent, prefix=f".{whole.name}-") as made:
            folder = Path(made) / whole.name
            program = stablehlo.serialise(stored) if with_stablehlo else b""
            fill(folder, stored, recorded, origin, dtype, program)
            found = run_check(folder)
            if with_stablehlo:
                found += f"; {stablehlo.FILE}: logits within {stablehlo.check(program, recorded, stored.agent):.1e}"
            out.mkdir(exist_ok=True)
            (out / stablehlo.FILE).unlink(missing_ok=True)  # an earlier agent's
            for name in sorted(file.name for file in folder.iterdir() if file.is_file()):
                (folder / name).replace(out / name)  # what else lies there is the user's
    except OSError as error:
        raise refuse("out", out, f"a directory that can be written ({error.strerror})") from None
    return found


def fill(
    folder: Path,
    stored: TrainedAgent,
    recorded: dict[str, Any],
    origin: Mapping[str, Any],
    dtype: str = "float32",
    program: bytes = b"",
) -> None:
    """Makes the folder without checking it: network, arrays, recorded steps, code, and facts with all checksums.

    `program` is that of `stablehlo`, if it is to be there.
    """
    folder.mkdir()
    config = stored.agent.config
    labels = {"game": config.game, "experiment": config.name, "env_steps": str(stored.env_steps)}
    model = WEIGHTS[dtype](onnx_graph.policy(stored.agent, stored.params, labels))
    (folder / "policy.onnx").write_bytes(model.SerializeToString())
    contents: dict[str, Any] = arrays(stored.agent, stored.statistics)
    np.savez_compressed(folder / "arrays.npz", **contents)
    np.savez_compressed(folder / "golden.npz", **recorded)
    for name in CODE:
        shutil.copyfile(Path(__file__).parent / name, folder / name)
    if program:
        (folder / stablehlo.FILE).write_bytes(program)
    digests = {file.name: digest(file) for file in sorted(folder.iterdir())}
    more = {"dtype": dtype, "check": CHECKS[dtype], "provenance": origin, "files": digests}
    text = json.dumps(facts(stored) | more, indent=1)
    (folder / FACTS).write_text(text + "\n", encoding="utf-8")


def digest(file: Path) -> str:
    """Returns a file's SHA-256, which `agent.py` compares."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


def run_check(folder: Path) -> str:
    """Runs `agent.py --check` in a process of its own; returns its line, or raises `ConfigError` with its message."""
    command = [sys.executable, str(folder / "agent.py"), "--check"]
    try:
        ended = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT)
    except subprocess.TimeoutExpired:
        raise ConfigError(f"export: the folder's check took longer than {_TIMEOUT:.0f} s; nothing is written") from None
    if ended.returncode:
        why = (ended.stderr.strip().splitlines() or ["no message"])[-1]
        raise ConfigError(f"export: the folder's own check fails ({why}); nothing is written")
    return ended.stdout.strip()


def _is_export(directory: Path) -> bool:
    try:
        return "format" in json.loads((directory / FACTS).read_text(encoding="utf-8"))
    except (OSError, ValueError, TypeError):
        return False


def facts(stored: TrainedAgent) -> dict[str, Any]:
    """Collects what `agent.py` is told besides arrays; `ConfigError` for a sensor that it does not know."""
    agent = stored.agent
    if isinstance(agent.config.sensor, OwnSensor):
        raise refuse("sensor.kind", agent.config.sensor.kind, ("rings", "logpolar"), why="cannot be exported")
    config, network = agent.config, agent.config.network
    width = onnx_graph.side_width(agent)
    last = [agent.num_actions, agent.network.num_vision_actions] if network.last_actions else None
    sees_point = width - sum(last or ()) - network.last_reward > 0
    names = action_names(config) or tuple(f"action {i}" for i in range(agent.num_actions))
    return {
        "format": FORMAT,
        "game": config.game,
        "experiment": config.name,
        "actions": list(names),
        "visual_actions": list(gaze.names(config.gaze)),
        "steps_per_second": steps_per_second(config),
        "source": "camera" if agent.crop_top is None else "screen",
        "crop_top": agent.crop_top,
        "frame_shape": list(config.env.frame_shape),
        "color": config.env.color,
        "normalisation": _normalisation(agent, stored.statistics),
        "sensor": to_mapping(config.sensor),
        "window": list(agent.sensor.window),
        "gaze": _gaze(config, agent.sensor),
        "side": {
            "focal_point": network.focal_scale if sees_point else None,
            "last_actions": last,
            "last_reward": network.last_reward,
            "clip_reward": config.env.clip_rewards and (is_atari(config) or config.game.startswith("gymnasium:")),
        },
    }


def _normalisation(agent: Agent, statistics: FrameStatistics) -> str:
    """Names what normalises a frame: the frame's own mean and deviation while running ones have seen none."""
    mode = agent.config.network.normalization
    return "frame" if mode in ("running", "pixel") and not statistics.weight > 0 else mode


def _gaze(config: Config, sensor: Sensor) -> dict[str, Any]:
    """Describes the gaze, all points within bounds; `moves` are steps if `relative`, else focal points."""
    look, frame_shape = config.gaze, config.env.frame_shape
    low, high = gaze.limits(gaze=look, window=gaze.bounded(look, sensor), frame_shape=frame_shape)
    is_still = look.mode in ("none", "frozen")
    relative = look.moves == "steps" or is_still
    moves = gaze.steps(look) if relative else gaze.targets(look, frame_shape)
    path = [np.clip(point, low, high).tolist() for point in look.path]
    start: Any = path[0] if look.mode == "scripted" else look.start
    if start == "centre":
        start = [size // 2 for size in frame_shape]
    if start != "random":
        start = np.clip(start, low, high).tolist()
    facts = {"mode": look.mode, "relative": relative, "moves": [[0, 0]] if is_still else moves.tolist()}
    facts |= {"cost": look.cost, "cost_per": look.cost_per}
    return facts | {"start": start, "path": path, "limits": [low.tolist(), high.tolist()]}


def arrays(agent: Agent, statistics: FrameStatistics) -> dict[str, np.ndarray]:
    """Tabulates what sensing needs: the mean of each channel, and weights that divide by the deviation too.

    Sensing is linear, so that a normalised frame need not be made: its difference from the mean is sensed and weighted.
    """
    sensor, shape = agent.config.sensor, agent.config.env.frame_shape
    mean, std = np.zeros((*shape, *agent.config.env.pixel_shape), np.float32), 1.0
    if _normalisation(agent, statistics) in ("running", "pixel"):
        mean = np.array(np.broadcast_to(np.asarray(statistics.mean / statistics.weight), mean.shape))
        std = max(float(statistics.std / statistics.weight), SMALLEST_STD)
    mean = mean.reshape(*shape, -1).transpose(2, 0, 1)
    found: dict[str, Any] = {"mean": mean}
    if isinstance(sensor, LogPolarSensor):
        cell, pixel, share = geometry.shares(sensor)
        first = np.searchsorted(cell, np.arange(sensor.rings * sensor.wedges))
        return found | {"pixel": pixel.astype(int), "weight": (share / std).astype(np.float32), "first": first}
    assert isinstance(sensor, RingSensor)
    packed = agent.sensor.packed
    # A frame of ones shows which blocks a finer ring hides.
    seen = sense(jnp.ones(shape), jnp.array(shape) // 2, sensor=packed)
    by_mean = sensor.pooling == "mean"
    for i, (height, width, factor) in enumerate(sensor.rings):
        pixels = np.outer(*(np.minimum(factor, size - np.arange(0, size, factor)) for size in (height, width)))
        visible = np.asarray(seen[i][..., 0] > 0)
        found[f"weight_{i}"] = (visible / std / (pixels if by_mean else 1)).astype(np.float32)
    if sensor.peripheral is not None:
        rows, columns = (np.arange(n + 1) * size // n for n, size in zip(sensor.peripheral, shape, strict=True))
        pixels = np.outer(np.diff(rows), np.diff(columns)) if by_mean else np.ones(sensor.peripheral)
        sums = np.add.reduceat(np.add.reduceat(mean, rows[:-1], 1), columns[:-1], 2)
        found |= {"row_edges": rows, "column_edges": columns, "cell_weight": (1 / std / pixels).astype(np.float32)}
        found["mean_cells"] = sums if by_mean else mean[:, rows[:-1]][..., columns[:-1]]
    if sensor.layout == "canvas":
        painting = tables(packed, shape)
        found |= {"paint_window": painting.window, "paint_background": painting.background}
    return found


def _provenance(stored: TrainedAgent, source: str, command: Sequence[str]) -> dict[str, Any]:
    """States where the agent comes from. `trained_with` is the commit of the run's last start, None if unknown."""
    return {
        "run": source,
        "env_steps": stored.env_steps,
        "score": load_score(source),
        "trained_with": provenance.last_commit(Path(source)),
        "exported_with": provenance.commit(),
        "foajax": provenance.version("foajax"),
        "command": list(command),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
    }
