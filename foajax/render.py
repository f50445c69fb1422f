"""`python -m foajax.render run=<dir> episodes=1`: whole games as videos, and where the agent looked.

Writes `episode-<seed>.mp4` (a GIF of the first 1,000 steps where the extra `video` is not installed), `heatmap.png` and
`heatmap.json`, at the speed at which the game is played: 15 decisions a second on Atari with its 60 frames and a frame
skip of 4.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import importlib.util
import itertools
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import Image
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from foajax import cli
from foajax.config.parse import ConfigError
from foajax.envs.make import steps_per_second
from foajax.learning.programs import use_compilation_cache
from foajax.runs.agents import Stored, load_agent
from foajax.viewing import heatmap
from foajax.viewing.recording import Recording, record
from foajax.viewing.scene import Scene

_GIF_STEPS = 1000  # written at most: each takes 1.2 MB of memory


@dataclasses.dataclass(frozen=True)
class Options:
    """What the command takes."""

    run: str  # a run directory or a shipped agent
    out: str | None = None  # directory; null for render/ in the run's
    episodes: int = 1
    policy: Literal["sampled", "greedy"] = "sampled"
    seed: int = 0  # of the first game; the next one has the next seed
    steps: int | None = None  # cuts a game after so many decisions; null for whole games
    format: Literal["mp4", "gif"] | None = None  # null for mp4 where it can be written
    video: bool = True  # false for the heat map alone

    def __post_init__(self) -> None:
        for key in ("episodes", "steps"):
            value = getattr(self, key)
            if value is not None and value < 1:
                raise ConfigError(f"{key}={value}: accepted is an integer >= 1")
        if self.format == "mp4" and not _has_ffmpeg():
            raise ConfigError("format=mp4: accepted is gif where imageio-ffmpeg is missing (pip install -e '.[video]')")


def play(stored: Stored, bar: Progress, *, episodes: int = 1, seed: int, **how: Any) -> Iterator[Recording]:
    """`recording.record`, with a bar for each game while it is played."""

    def progress(steps: int, score: float) -> None:
        bar.update(task, completed=steps, note=f"{steps:,} steps, score {score:g}")

    games = record(stored, episodes=episodes, seed=seed, progress=progress, **how)
    for game in range(seed, seed + episodes):
        task = bar.add_task(f"game {game}", total=how["max_steps"], note="starts")
        yield next(games)
        bar.update(task, total=bar.tasks[task].completed)


def write_video(recording: Recording, file: Path, bar: Progress) -> None:
    """An mp4, or the first minute or so as a GIF, by the name of the file."""
    scene, steps, write = Scene(recording), len(recording.screens), _write_mp4
    if file.suffix == ".gif":
        write = _write_gif
        if steps > _GIF_STEPS:
            remedy = "whole games are for format=mp4 (pip install -e '.[video]')"
            bar.console.print(f"{file}: the first {_GIF_STEPS:,} of {steps:,} steps; {remedy}", markup=False)
        steps = min(steps, _GIF_STEPS)
    task = bar.add_task(file.name, total=steps, note="")
    frames = (scene.draw(i) for i in range(steps))
    write(iter(bar.track(frames, task_id=task)), file, steps_per_second(recording.config))


def _write_mp4(frames: Iterator[Image.Image], file: Path, rate: float) -> None:
    """Through a pipe to the ffmpeg of imageio-ffmpeg, whose own writer forks, which JAX's threads do not bear."""
    from imageio_ffmpeg import get_ffmpeg_exe  # an extra

    first = next(frames)
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{first.width}x{first.height}", "-r", f"{rate}", "-i", "-"]
    codec = ["-c:v", "libx264", "-preset", "veryfast", "-crf", "20", "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
    command = [get_ffmpeg_exe(), "-y", "-loglevel", "error", *source, *codec, str(file)]
    # A pipe that breaks is an ffmpeg that has ended, and its exit code tells.
    with contextlib.suppress(BrokenPipeError), subprocess.Popen(command, stdin=subprocess.PIPE) as process:
        assert process.stdin is not None
        for frame in itertools.chain([first], frames):
            process.stdin.write(frame.tobytes())
    if process.returncode:
        raise ConfigError(f"out={file.parent}: accepted is a directory that a video can be written to")


def _write_gif(frames: Iterator[Image.Image], file: Path, rate: float) -> None:
    """All pictures are in memory, twice, because Pillow writes none before it has the last one.

    A GIF's times are whole hundredths of a second: rounded so that they add up.
    """
    small = [frame.quantize(64, dither=Image.Dither.NONE) for frame in frames]
    ends = np.round(np.arange(1, len(small) + 1) * 100 / rate)
    durations = (10 * np.diff(ends, prepend=0)).astype(int).tolist()
    small[0].save(file, save_all=True, append_images=small[1:], duration=durations, loop=0)


def _has_ffmpeg() -> bool:
    return importlib.util.find_spec("imageio_ffmpeg") is not None


def make_directory(out: str | Path) -> Path:
    """Creates the directory for results; one line where that cannot be."""
    try:
        Path(out).mkdir(parents=True, exist_ok=True)
        if not os.access(out, os.W_OK | os.X_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except OSError as error:
        raise ConfigError(f"out={out}: accepted is a directory that can be written ({error.strerror})") from None
    return Path(out)


def progress_bar() -> Progress:
    """Bars with a note at their end."""
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[note]}"), TimeRemainingColumn())
    return Progress(*columns)


def render(arguments: Sequence[str]) -> None:
    """The command; prints the paths of what it wrote."""
    options = cli.parse(Options, arguments)
    use_compilation_cache()
    stored = load_agent(options.run)
    directory = make_directory(options.out or Path(options.run) / "render")
    suffix = options.format or ("mp4" if _has_ffmpeg() else "gif")
    recordings, written = [], []
    with progress_bar() as bar:
        greedy = options.policy == "greedy"
        games = play(stored, bar, episodes=options.episodes, seed=options.seed, greedy=greedy, max_steps=options.steps)
        for recording in games:
            if options.video:
                written.append(directory / f"episode-{recording.seed}.{suffix}")
                write_video(recording, written[-1], bar)
            recordings.append(recording._replace(images=()))  # what the heat map does not need may go
    config = stored.agent.config
    heatmap.save(heatmap.heat_map(recordings), directory, f"{config.name} on {config.game}")
    for file in [*written, directory / "heatmap.png", directory / "heatmap.json"]:
        print(file)


if __name__ == "__main__":
    sys.exit(cli.run(render))
