"""What a program of one's own may get wrong is one clear line.

In a process of its own: here, every call's annotations are checked before the package is asked.
"""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

PROLOGUE = """
import json, sys
import gymnasium, numpy as np
from gymnasium import spaces
from foajax import FoveatedObservation, LogPolarSensor, RingSensor, sense
from foajax.learning.agent import Agent
from foajax.config.compose import compose
from foajax.config.schema import GazeConfig
from foajax.envs.gymnasium import gray_frames

class Pixels(gymnasium.Env):
    observation_space, action_space = spaces.Box(0, 255, (16, 20), np.uint8), spaces.Discrete(2)

sensor = RingSensor([[8, 8, 1]], peripheral=[2, 2])  # lists serve as well
assert sensor == RingSensor(((8, 8, 1),), peripheral=(2, 2)) and GazeConfig(start=[3, 4]).start == (3, 4)
atari, frames = Agent(compose([]), 4, 34), Agent(compose([]), 4, None)
said = []
for line in json.load(sys.stdin):
    try:
        eval(line)
        said.append("nothing")
    except ValueError as error:  # a ConfigError is one
        said.append(str(error))
print(json.dumps(said))
"""
RING = "accepted is a list of one or more [height, width, factor]"
MISTAKES = {
    "RingSensor(((8, 8, 1),), layout='Canvas')": "sensor.layout=Canvas: accepted is one of canvas, packed",
    "RingSensor(((8, 8),))": f"sensor.rings=[[8, 8]]: {RING}",
    "RingSensor((8, 8, 1))": f"sensor.rings=[8, 8, 1]: {RING}",
    "RingSensor(((8, 8, 1),), peripheral=5)": "sensor.peripheral=5: accepted is [rows, columns] >= 1 or null",
    "LogPolarSensor(sampling='nearest')": "sensor.sampling=nearest: accepted is one of area, bilinear",
    "GazeConfig(actions=12)": "gaze.actions=12: accepted is one of 5, 9",
    "GazeConfig(step=2.5)": "gaze.step=2.5: accepted is an integer",
    "GazeConfig(start='center')": "gaze.start=center: accepted is one of centre, random or [y, x]",
    "sense(np.zeros((16, 20)), np.array([8.0, 8.0]), sensor=sensor)": "focal_point.dtype=float32: accepted is integers",
    "sense(np.zeros((16, 20)), np.array(8), sensor=sensor)": "focal_point.shape=[]: accepted is [2], for (y, x)",
    "sense(np.zeros((16, 20)), np.zeros((3, 2), int), sensor=sensor)": "focal_point.shape=[3, 2]: accepted is [2]",
    "sense(np.zeros((2, 8, 8, 3)), np.array([4, 4]), sensor=sensor)": "frame.shape=[2, 8, 8, 3]: accepted is [H, W]",
    "sense(np.zeros((16, 20)), np.array([8, 8]), sensor='constant70')": "sensor=constant70: accepted is a RingSe",
    "FoveatedObservation(Pixels(), None)": "sensor=null: accepted is a RingSensor, LogPolarSensor or ",
    "FoveatedObservation(Pixels(), sensor, 'learned')": "gaze=learned: accepted is a GazeConfig",
    "atari.frame(np.zeros((1, 210, 160)))": "frame=float64 [1, 210, 160]: accepted is uint8 [B, 210, 160], gray",
    "atari.frame(np.zeros((1, 80, 80), np.uint8))": "frame=uint8 [1, 80, 80]: accepted is uint8 [B, 210, 160], gray",
    "frames.frame(np.zeros((80, 80), np.uint8))": "frame=uint8 [80, 80]: accepted is uint8 [B, 80, 80], gray",
    "gray_frames(np.zeros((1, 3, 8, 8), np.uint8), (8, 8))": "images=uint8 [1, 3, 8, 8]: accepted is uint8 [B, h, w], ",
}


@pytest.fixture(scope="module")
def said():
    """What each mistake was answered with."""
    command = [sys.executable, "-c", PROLOGUE]
    run = subprocess.run(command, input=json.dumps(list(MISTAKES)), capture_output=True, text=True, check=True)
    return dict(zip(MISTAKES, json.loads(run.stdout), strict=True))


@pytest.mark.parametrize("line", MISTAKES)
def test_a_mistake_is_one_clear_line(said, line):
    assert said[line].startswith(MISTAKES[line]) and "\n" not in said[line]
