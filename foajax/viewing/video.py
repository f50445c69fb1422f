"""A recorded game as a video."""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import itertools
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image
from rich.progress import Progress

from foajax.config.parse import one_line, refuse
from foajax.envs.make import steps_per_second
from foajax.viewing.recording import Recording
from foajax.viewing.scene import Scene

_GIF_STEPS = 1000  # written at most: each takes 1.2 MB of memory


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
        raise refuse("out", file.parent, "a directory that a video can be written to")


def _write_gif(frames: Iterator[Image.Image], file: Path, rate: float) -> None:
    """All pictures are in memory, twice, because Pillow writes none before it has the last one.

    A GIF's times are whole hundredths of a second: rounded so that they add up.
    """
    small = [frame.quantize(64, dither=Image.Dither.NONE) for frame in frames]
    ends = np.round(np.arange(1, len(small) + 1) * 100 / rate)
    durations = (10 * np.diff(ends, prepend=0)).astype(int).tolist()
    small[0].save(file, save_all=True, append_images=small[1:], duration=durations, loop=0)


@functools.cache
def why_no_mp4() -> str | None:
    """What is missing before an mp4 can be written; None where nothing is."""
    install = "pip install imageio-ffmpeg"
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        return f"imageio-ffmpeg is missing ({install})"
    from imageio_ffmpeg import get_ffmpeg_exe

    try:
        subprocess.run([get_ffmpeg_exe(), "-version"], check=True, capture_output=True)
    except (OSError, RuntimeError, subprocess.CalledProcessError) as error:
        return f"the ffmpeg of imageio-ffmpeg does not run ({one_line(error)}; {install}, or IMAGEIO_FFMPEG_EXE=<path>)"
    return None
