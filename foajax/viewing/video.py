"""Writes a recorded game as a video."""

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

_GIF_STEPS = 1000  # at most, as each takes 1.2 MB of memory


def write_video(recording: Recording, file: Path, bar: Progress) -> None:
    """Writes an mp4 or, if the file's name ends in .gif, the first 1,000 steps as a GIF."""
    scene, steps, write = Scene(recording), len(recording.screens), _write_mp4
    if file.suffix == ".gif":
        write = _write_gif
        if steps > _GIF_STEPS:
            remedy = "for whole games, pip install 'foajax[video]' and use format=mp4"
            bar.console.print(f"{file}: only the first {_GIF_STEPS:,} of {steps:,} steps; {remedy}", markup=False)
        steps = min(steps, _GIF_STEPS)
    task = bar.add_task(file.name, total=steps, note="")
    frames = (scene.draw(i) for i in range(steps))
    write(iter(bar.track(frames, task_id=task)), file, steps_per_second(recording.config))


def _write_mp4(frames: Iterator[Image.Image], file: Path, rate: float) -> None:
    """Pipes frames to the ffmpeg of imageio-ffmpeg. Its own writer forks, which JAX's threads do not survive."""
    from imageio_ffmpeg import get_ffmpeg_exe  # an extra

    first = next(frames)
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{first.width}x{first.height}", "-r", f"{rate}", "-i", "-"]
    codec = ["-c:v", "libx264", "-preset", "veryfast", "-crf", "20", "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
    command = [get_ffmpeg_exe(), "-y", "-loglevel", "error", *source, *codec, str(file)]
    # If the pipe breaks, ffmpeg has ended, and its exit code says why.
    with contextlib.suppress(BrokenPipeError), subprocess.Popen(command, stdin=subprocess.PIPE) as process:
        assert process.stdin is not None
        for frame in itertools.chain([first], frames):
            process.stdin.write(frame.tobytes())
    if process.returncode:
        raise refuse("out", file.parent, "a directory that can be written", why=f"ffmpeg could not write {file.name}")


def _write_gif(frames: Iterator[Image.Image], file: Path, rate: float) -> None:
    """Holds all pictures in memory, twice, as Pillow writes none before it has the last one.

    A GIF's times are whole hundredths of a second, rounded so that they add up.
    """
    small = [frame.quantize(64, dither=Image.Dither.NONE) for frame in frames]
    ends = np.round(np.arange(1, len(small) + 1) * 100 / rate)
    durations = (10 * np.diff(ends, prepend=0)).astype(int).tolist()
    small[0].save(file, save_all=True, append_images=small[1:], duration=durations, loop=0)


@functools.cache
def why_no_mp4() -> str | None:
    """Says what is missing to write an mp4; None if nothing is."""
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        return "imageio-ffmpeg is missing (pip install 'foajax[video]')"
    from imageio_ffmpeg import get_ffmpeg_exe

    try:
        subprocess.run([get_ffmpeg_exe(), "-version"], check=True, capture_output=True)
    except (OSError, RuntimeError, subprocess.CalledProcessError) as error:
        return f"the ffmpeg of imageio-ffmpeg does not run ({one_line(error)}); IMAGEIO_FFMPEG_EXE=<path> names another"
    return None
