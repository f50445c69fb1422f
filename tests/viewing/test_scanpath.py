"""The scanpath: which decisions are one fixation, and what stands where in the picture."""

from __future__ import annotations

import re

import numpy as np
import pytest
from PIL import Image, ImageColor

from foajax import cli, demo, render
from foajax.config.compose import compose
from foajax.learning.agent import Agent
from foajax.runs.agents import save_agent
from foajax.viewing import scanpath
from foajax.viewing.recording import record
from foajax.viewing.style import NATURAL, VISION

pytestmark = pytest.mark.slow  # compiles many scenes


@pytest.fixture(scope="module")
def searcher(untrained):
    """An agent that has learned nothing."""
    words = ["experiment=search_rings", "network.lstm=16", "network.dense=16", "gaze=random"]
    words += ["gaze.step=[20,40,80]", "gaze.actions=9", "gaze.bounds=fovea"]
    return untrained(Agent(compose(words), num_actions=5, crop_top=None))


@pytest.fixture(scope="module")
def searched(searcher):
    """An episode of some fixations."""
    return next(r for r in record(searcher, episodes=50) if len(r.score) >= 5)


def test_decisions_at_one_place_are_one_fixation():
    points = np.array([[1, 1], [1, 1], [1, 2], [5, 2], [5, 2], [5, 2], [1, 1]])
    assert scanpath.fixations(points) == [(0, 2), (2, 1), (3, 3), (6, 1)]
    assert scanpath.fixations(points[:1]) == [(0, 1)]


def test_the_recording_knows_the_scene(searched):
    assert searched.facts is not None and searched.is_over
    assert searched.facts["decisions"] == len(searched.score) - 1
    assert searched.facts["fixations"] == len(scanpath.fixations(searched.focal_point[:-1]))


def test_the_picture_marks_the_target_the_path_and_every_fixation(searched):
    image = scanpath.draw_scanpath(searched)
    pixels = np.asarray(image)
    stays = scanpath.fixations(searched.focal_point[:-1])
    left, top, scale = 16, 44, 4
    y, x = (searched.facts["box"][:2] * scale).tolist()
    green = np.array(ImageColor.getrgb(NATURAL))
    marked = (pixels[top + y - 8 : top + y + 64, left + max(x - 8, 0) : left + x + 64] == green).all(-1)
    assert marked.sum() > 50
    violet = (pixels == np.array(ImageColor.getrgb(VISION))).all(-1)
    for first, _ in stays[:-1]:
        py, px = (searched.focal_point[first] * scale).tolist()
        assert violet[top + py - 12 : top + py + 13, left + px - 12 : left + px + 13].any()
    assert image.width == 3 * 16 + 640 + min(4, len(stays)) * 158
    plain = scanpath.draw_scanpath(searched._replace(facts=None))
    assert not (np.asarray(plain) == green).all(-1)[top:, left : left + 640].any()


def test_one_look_and_games_of_other_kinds_have_a_picture_too(searched, recording):
    once = searched._replace(**{name: getattr(searched, name)[:2] for name in ("score", "is_first", "focal_point")})
    assert scanpath.draw_scanpath(once).width == 3 * 16 + 640 + 158
    assert scanpath.draw_scanpath(recording).height > 400


def test_demo_and_render_draw_it(searcher, tmp_path, capsys):
    save_agent(searcher, tmp_path / "agent")
    assert cli.run(demo.demo, [f"agent={tmp_path / 'agent'}", f"out={tmp_path / 'demo'}"]) == 0
    said = capsys.readouterr().out
    assert re.search(r"It answered \d of 6 scenes right", said) and "demo/scanpath.png" in said
    assert cli.run(render.render, [f"run={tmp_path / 'agent'}", f"out={tmp_path / 'out'}", "video=false"]) == 0
    assert "scanpath-0.png" in capsys.readouterr().out
    for file in (tmp_path / "demo" / "scanpath.png", tmp_path / "out" / "scanpath-0.png"):
        with Image.open(file) as picture:
            assert picture.width >= 3 * 16 + 640 + 158
