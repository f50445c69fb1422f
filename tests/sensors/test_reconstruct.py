"""The tables of a painting against the picture that they stand for."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from foajax.config.schema import LogPolarSensor, RingSensor
from foajax.sensors.reconstruct import paint, tables
from foajax.sensors.registry import make_sensor
from foajax.sensors.sense import picture, sense

SENSORS = {
    "rings": RingSensor(rings=((10, 12, 1), (20, 20, 2), (30, 28, 4)), peripheral=(5, 5)),
    "odd": RingSensor(rings=((7, 7, 2), (15, 13, 3))),
    "a grid finer than the area": RingSensor(rings=((16, 16, 1),), peripheral=(20, 20), layout="packed"),
    "whole": RingSensor(rings=((40, 36, 1),)),
    "retina": LogPolarSensor(rings=9, wedges=12, fovea=2.0, radius=30.0),  # larger than the frame
}
SHAPE = (40, 36)


@pytest.mark.parametrize("name", SENSORS)
def test_a_painting_is_the_picture(name):
    sensor = make_sensor(SENSORS[name]).packed
    painting = tables(sensor, SHAPE)
    levels = np.random.default_rng(0).integers(1, 256, SHAPE)
    for point in ((20, 18), (0, 0), (39, 35), (7, 30)):
        point = np.array(point, np.int32)
        images = sense(jnp.asarray(levels, jnp.float32), jnp.asarray(point), sensor=sensor)
        images = tuple(jnp.round(image) for image in images)
        expected = picture(images, jnp.asarray(point), sensor=sensor, frame_shape=SHAPE)[..., 0]
        values = np.concatenate([np.asarray(image, np.uint8).ravel() for image in images])
        np.testing.assert_array_equal(paint(values, point, painting), np.asarray(expected))


def test_a_canvas_is_packed_and_a_retina_is_left_alone():
    canvas, retina = make_sensor(SENSORS["rings"]), make_sensor(SENSORS["retina"])
    assert canvas.in_place and not canvas.packed.in_place and canvas.packed.packed is canvas.packed
    assert canvas.packed.config.rings == canvas.config.rings
    assert retina.packed is retina
