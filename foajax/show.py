"""Draws what a sensor sees of a game's frame: `foajax show sensor=constant70 points=[[40,40],[60,20]]`.

Each focal point gets a row: the frame with the focal area drawn on it, and what the sensor sees, put back in its
place. A packed sensor's row has its images too, which are all that the network gets. `sensor=all` draws the paper's
sensors and the log-polar one on one sheet. Keys of the sensor change it:
`sensor=rings 'sensor.rings=[[16,16,1],[48,48,4]]' sensor.layout=packed`. `--config-dir=DIR` adds the sensors of
DIR/sensor/, as in `foajax train`.

Frames are not normalised, so black may be a black pixel or a hidden one. The frame's brightest pixel is drawn white.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from pydantic import Field

from foajax import cli
from foajax.config.compose import choices, compose
from foajax.config.parse import Section, refuse
from foajax.config.schema import Config, Point, Shape
from foajax.envs.make import make
from foajax.sensors.frames import to_frame
from foajax.sensors.registry import make_sensor
from foajax.viewing.sheet import ALL, contact_sheet, draw, save


class Options(Section):
    sensor: str = Field("constant70", description="A sensor, as `foajax train --help` lists them, or all.")
    game: str = Field("breakout", description="The game whose frame is shown.")
    points: tuple[Point, ...] = Field((), description="Focal points in frame pixels; none for the frame's centre.")
    out: str = Field("show.png", description="The image, a .png file.")
    color: bool = Field(False, alias="env.color", description="Frames in colour; else gray.")
    frame_shape: Shape = Field((80, 80), alias="env.frame_shape", description="Height and width of frames in pixels.")
    steps: int = Field(60, ge=0, description="Random actions before the frame is taken.")
    seed: int = Field(0, description="Seed of the game.")
    all: bool = Field(False, description="The same as sensor=all.")

    def check(self) -> None:
        if not self.out.endswith(".png"):
            raise refuse("out", self.out, "a file name that ends in .png")
        cli.check_file("out", self.out)


def walk(config: Config, steps: int) -> np.ndarray:
    """Plays `steps` random actions; returns the frame, float32 [H, W] or, in colour, [H, W, 3] in [0, 1]."""
    environment = make(config, num_envs=1, seed=config.seed)
    try:
        timestep, _ = environment.reset()
        random = np.random.default_rng(config.seed)
        for _ in range(steps):
            environment.send(random.integers(environment.num_actions, size=1, dtype=np.int32))
            timestep, _ = environment.recv()
        return np.asarray(to_frame(jnp.asarray(timestep.frame[0]), environment.crop_top))
    finally:
        environment.close()


def show(arguments: Sequence[str]) -> None:
    """Draws what sensors see and prints the path of the picture."""
    directory, arguments = cli.take_directory(arguments)
    own = [word for word in arguments if word.startswith("sensor.")]
    options = cli.parse(Options, [word for word in arguments if word not in own])
    if options.sensor not in (known := [*choices(directory)["sensor"], "all"]):
        raise refuse("sensor", options.sensor, known)
    sheet = options.all or options.sensor == "all"
    if sheet and own:
        raise refuse(own[0], accepted="a key of one sensor, without sensor=all")
    words = [*own, f"game={options.game}", f"seed={options.seed}", "gaze=none"]
    words += [f"env.color={options.color}", f"env.frame_shape={list(options.frame_shape)}"]
    configs = {name: compose([f"sensor={name}", *words], directory) for name in (ALL if sheet else (options.sensor,))}
    config = next(iter(configs.values()))
    height, width = config.env.frame_shape
    points = options.points or ((height // 2, width // 2),)
    for y, x in points:
        if not (0 <= y < height and 0 <= x < width):
            raise refuse("points", f"[{y}, {x}]", f"[y, x] inside the frame, {height}x{width}")
    frame = walk(config, options.steps)
    if sheet:
        image = contact_sheet(frame, {name: make_sensor(each.sensor) for name, each in configs.items()}, points)
    else:
        image = draw(frame, make_sensor(config.sensor), points, name=options.sensor)
    save(image, options.out)
    print(options.out)


if __name__ == "__main__":
    sys.exit(cli.run(show))
