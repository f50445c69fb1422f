"""The images of a training run: pixels where they belong."""

from __future__ import annotations

import numpy as np

from foajax.viewing.previews import heat_map, views


def test_the_heat_map_is_brightest_where_the_gaze_is_most():
    image = heat_map(np.array([[2, 3]] * 7 + [[4, 0]]), (6, 5))
    assert image.shape == (24, 20)
    assert (image[8:12, 12:16] == 255).all() and (image[16:20, :4] == round(80 + 175 * np.log(2) / np.log(8))).all()
    assert (image == 24).sum() == (30 - 2) * 16


def test_views_lie_side_by_side_and_parts_below_one_another():
    fine, coarse = np.zeros((11, 3, 4, 1), np.float32), np.zeros((11, 2, 2, 1), np.float32)
    fine[:] = np.arange(11)[:, None, None, None]  # brighter with every step
    coarse[10] = -2
    image = views([fine, coarse])
    assert image.shape == (4 * (3 + 2 + 2 + 2), 4 * 6 * (4 + 2), 1)
    for column, step in enumerate((0, 2, 4, 6, 8, 10)):
        assert (image[:12, 24 * column : 24 * column + 16] == round(255 * (step + 2) / 12)).all()
    assert (image[20:28, 120:128] == 0).all() and (image[20:28, :8] == round(255 * 2 / 12)).all()
