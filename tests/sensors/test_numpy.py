"""The sensors in NumPy give what those in JAX give, and JAX is not imported for them."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

import foajax
from foajax.config.parse import ConfigError
from foajax.config.schema import LogPolarSensor, OwnSensor, RingSensor
from foajax.sensors.numpy import sense_many

NESTED = ((7, 9, 1), (15, 16, 3), (22, 20, 4))  # blocks that divide neither the rings nor each other
SENSORS = {
    "canvas": RingSensor(rings=NESTED),
    "canvas with grid": RingSensor(rings=NESTED, peripheral=(5, 4)),
    "packed with grid": RingSensor(rings=NESTED, peripheral=(5, 4), layout="packed"),
    "corners": RingSensor(rings=NESTED, peripheral=(5, 4), layout="packed", pooling="stride"),
    "log-polar": LogPolarSensor(rings=6, wedges=10, fovea=1.5, radius=12),
    "samples": LogPolarSensor(rings=6, wedges=10, fovea=1.5, radius=12, sampling="bilinear"),
}
POINTS = [(20, 15), (0, 0), (39, 31), (3, 28), (-40, 90)]  # inside; overhanging on every side; far outside
CLOSE = {"rtol": 1e-5, "atol": 1e-3}  # of values up to 255


def noise(shape, dtype=np.uint8):
    return (np.random.default_rng(3).random(shape) * 255).astype(dtype)


@pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS)
@pytest.mark.parametrize("frame", [noise((40, 32)), noise((40, 32, 3), np.float32)], ids=["gray", "colour"])
def test_numpy_sees_and_draws_what_jax_does(sensor, frame):
    for point in POINTS:
        ours = foajax.numpy.sense(frame, np.array(point), sensor=sensor)
        theirs = foajax.sense(frame, np.array(point), sensor=sensor)
        drawn = {"sensor": sensor, "frame_shape": (40, 32)}
        pair = [of.picture(images, np.array(point), **drawn) for of, images in ((foajax.numpy, ours), (foajax, theirs))]
        for a, b in zip((*ours, pair[0]), (*theirs, pair[1]), strict=True):
            assert a.dtype == np.float32
            np.testing.assert_allclose(a, b, **CLOSE)


@pytest.mark.parametrize("name", ["packed with grid", "log-polar"])
def test_an_area_is_moved_inside_as_jax_moves_it(name):
    frame, point = noise((40, 32)), np.array([2, 31])
    ours, theirs = (of.sense(frame, point, sensor=SENSORS[name], bounds="window") for of in (foajax.numpy, foajax))
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a, b, **CLOSE)


@pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS)
def test_many_frames_are_seen_as_each_alone(sensor):
    frames, points = noise((len(POINTS), 40, 32, 2)), np.array(POINTS)
    together = sense_many(frames, points, sensor=sensor)
    for i, (frame, point) in enumerate(zip(frames, points, strict=True)):
        for many, one in zip(together, foajax.numpy.sense(frame, point, sensor=sensor), strict=True):
            np.testing.assert_array_equal(many[i], one)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"bounds": "fovea"}, "^bounds=fovea: accepted is 'window' or 'point'"),
        ({"frame": noise((16, 16)), "bounds": "window"}, "^bounds=window.*exceeds"),
        ({"sensor": RingSensor(rings=((8, 8, 1),), peripheral=(41, 4))}, "^sensor.peripheral=.*40x32"),
    ],
)
def test_what_cannot_be_sensed_is_refused_as_jax_refuses_it(arguments, message):
    given = {"frame": noise((40, 32)), "focal_point": np.array([9, 9]), "sensor": SENSORS["canvas"], **arguments}
    frame, point = given.pop("frame"), given.pop("focal_point")
    for of in (foajax.numpy, foajax):
        with pytest.raises(ConfigError, match=message):
            of.sense(frame, point, **given)


def test_a_sensor_of_ones_own_is_left_to_jax():
    with pytest.raises(ConfigError, match="^sensor=.*foajax.sense takes your own"):
        foajax.numpy.sense(noise((40, 32)), np.array([9, 9]), sensor=OwnSensor(kind="mine:Random"))


def test_jax_is_not_imported():
    code = (
        "import sys, gymnasium, numpy as np, foajax\n"
        "from gymnasium import spaces\n"
        "class Env(gymnasium.Env):\n"
        "    observation_space, action_space = spaces.Box(0, 255, (84, 84, 3), np.uint8), spaces.Discrete(2)\n"
        "    def reset(self, seed=None, options=None): return self.observation_space.sample(), {}\n"
        "    def step(self, action): return self.observation_space.sample(), 0.0, False, False, {}\n"
        "env = foajax.FoveatedObservation(Env(), 'constant70_packed')\n"
        "env.reset(seed=0), env.step(env.action_space.sample())\n"
        "sensor = foajax.LogPolarSensor()\n"
        "images = foajax.numpy.sense(np.zeros((80, 80), np.uint8), np.array([9, 9]), sensor=sensor)\n"
        "foajax.numpy.picture(images, np.array([9, 9]), sensor=sensor, frame_shape=(80, 80))\n"
        "print('jax' in sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "False", done.stderr[-500:]
