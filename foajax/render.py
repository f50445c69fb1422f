"""Writes whole games as videos, and a heat map of where the agent looked: `foajax render run=<dir>`.

The files are `episode-<seed>.mp4`, `heatmap.png` and `heatmap.json`. Without the extra `video`, a GIF of the first
1,000 steps replaces the MP4. A video runs at the game's speed: 15 decisions per second on Atari with a frame skip of 4.
In visual search, `scanpath-<seed>.png` shows the fixations in order, and what was seen at each.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pydantic import Field

from foajax import cli
from foajax.config.parse import refuse
from foajax.runs.agents import StoredAgent
from foajax.runtime import use_compilation_cache
from foajax.viewing import heatmap
from foajax.viewing.recording import progress_bar, watch
from foajax.viewing.scanpath import draw_scanpath
from foajax.viewing.video import why_no_mp4, write_video


class Options(StoredAgent):
    out: str | None = Field(None, description="Directory of the files; null for render/ in the run's.")
    episodes: int = Field(1, ge=1, description="Games to play.")
    policy: Literal["sampled", "greedy"] = Field("sampled", description="How actions are chosen.")
    seed: int = Field(0, description="Seed of the first game; the next one has the next seed.")
    steps: int | None = Field(None, ge=1, description="Cut a game after so many decisions; null for whole games.")
    format: Literal["mp4", "gif"] | None = Field(
        None, description="Format of videos; null for mp4 where it can be written."
    )
    video: bool = Field(True, description="Write videos; false for the pictures alone.")

    def check(self) -> None:
        if self.format == "mp4" and (why := why_no_mp4()):
            raise refuse("format", "mp4", "gif", why=why)


def render(arguments: Sequence[str]) -> None:
    """Plays games and prints the paths of their videos and pictures."""
    options = cli.parse(Options, arguments)
    use_compilation_cache()
    stored = options.load()
    directory = cli.make_directory(options.out or Path(options.run) / "render")
    suffix = options.format or ("gif" if why_no_mp4() else "mp4")
    recordings, written = [], []
    with progress_bar() as bar:
        greedy = options.policy == "greedy"
        games = watch(stored, bar, episodes=options.episodes, seed=options.seed, greedy=greedy, max_steps=options.steps)
        for recording in games:
            if options.video:
                written.append(directory / f"episode-{recording.seed}.{suffix}")
                write_video(recording, written[-1], bar)
            if recording.config.searches:
                written.append(directory / f"scanpath-{recording.seed}.png")
                draw_scanpath(recording).save(written[-1])
            recordings.append(recording._replace(images=()))  # what the heat map does not need may go
    config = stored.agent.config
    heatmap.save(heatmap.heat_map(recordings), directory, f"{config.name} on {config.game}")
    for file in [*written, directory / "heatmap.png", directory / "heatmap.json"]:
        print(file)


if __name__ == "__main__":
    sys.exit(cli.run(render))
