"""Heat maps: counts, entropy and bounds against numbers worked out by hand, and the files."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from foajax.sensors import gaze
from foajax.viewing import heatmap
from foajax.viewing.heatmap import HeatMap


def by_hand():
    """Eight steps: four at (2, 3), two at (2, 4), one each at two corners of what may be looked at."""
    points = np.array([[2, 3]] * 4 + [[2, 4]] * 2 + [[1, 1], [3, 6]])
    counts = gaze.count(points, (5, 8))
    return HeatMap(counts, np.full((5, 8), 0.5), np.array([1, 1]), np.array([3, 6]), games=1)


def test_the_numbers():
    heat = by_hand()
    assert heat.counts[2, 3] == 4 and heat.counts[2, 4] == 2 and heat.counts.sum() == heat.steps == 8
    # 1/2 * 1 + 1/4 * 2 + 2 * 1/8 * 3 bits
    assert heat.entropy == pytest.approx(1.75)
    assert heat.share_at_bounds == 2 / 8
    assert heat.share_below == 1 / 8  # row 3 of 0 to 4
    # Variances down and across: of the steps 1/4 and 111/64, of rows 1 to 3 and columns 1 to 6 8/12 and 35/12.
    assert heat.spread == pytest.approx((1 / 4 + 111 / 64) ** 0.5)
    assert heat.relative_spread == pytest.approx(((1 / 4 + 111 / 64) / (43 / 12)) ** 0.5)
    assert heat.summary == "8 steps of 1 game, 1.75 bits, 25 % at the bounds"


def test_a_gaze_that_never_moves_has_no_entropy():
    heat = HeatMap(gaze.count(np.array([[2, 2]] * 9), (5, 5)), np.zeros((5, 5)), np.array([2, 2]), np.array([2, 2]), 1)
    assert heat.entropy == 0 and heat.share_at_bounds == 1 and heat.relative_spread == 0
    heatmap.draw(heat, "still")


def test_one_of_a_recording(recording):
    heat = heatmap.heat_map([recording, recording])
    assert heat.steps == 2 * len(recording.screens) and heat.games == 2
    for y, x in recording.focal_point[:10]:
        assert heat.counts[y, x] >= 2
    np.testing.assert_allclose(heat.mean_frame, recording.mean_frame, rtol=1e-6)
    assert heat.low.tolist() == [0, 0] and heat.high.tolist() == [79, 79]  # bounds=point


def test_it_says_whose_gaze_it_is(recording):
    def said(*recordings):
        heat = HeatMap.from_json(heatmap.heat_map(recordings).to_json())
        return heat.env_steps, heat.policy, heat.whole_games

    cut, over = (recording._replace(is_over=is_over, env_steps=5) for is_over in (False, True))
    assert said(over, over) == (5, "sampled", True)
    assert said(over, cut) == (5, "sampled", False)
    assert said(over._replace(greedy=True)) == (5, "greedy", True)


def test_a_file_from_before_that_was_kept_does_not_say_it():
    record = by_hand().to_json()
    for key in ("env_steps", "policy", "whole_games"):
        del record[key]
    assert HeatMap.from_json(record).env_steps is None


def test_the_files(tmp_path):
    heat = by_hand()
    heatmap.save(heat, tmp_path, "by hand")
    record = json.loads((tmp_path / "heatmap.json").read_text())
    assert record["steps"] == 8 and record["entropy_bits"] == pytest.approx(1.75)
    assert record["counts"][2][3] == 4
    again = HeatMap.from_json(record)
    np.testing.assert_array_equal(again.counts, heat.counts)
    assert again.summary == heat.summary
    with Image.open(tmp_path / "heatmap.png") as image:
        pixels = np.asarray(image.convert("RGB")).reshape(-1, 3)
    brightest = (252, 255, 164)  # inferno's end, of the cell with the largest count
    assert (pixels == brightest).all(axis=1).sum() > 50
