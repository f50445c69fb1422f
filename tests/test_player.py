"""The gaze player, in a real browser: what it draws against what was recorded."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path

import numpy as np
import pytest
from browser import browser_needed, opened_page

from foajax import cli, player
from foajax.config.compose import compose
from foajax.learning.agent import Agent
from foajax.sensors import gaze
from foajax.sensors.reconstruct import paint, tables
from foajax.sensors.registry import make_sensor
from foajax.viewing import player_page
from foajax.viewing.recording import Screens, record

ARTEFACTS = Path(__file__).resolve().parent.parent / "build"
GAZE = """() => {  // centre of all that is drawn in the colour of the focal point, in CSS pixels
  const canvas = document.getElementById("gaze"), ratio = canvas.width / canvas.clientWidth;
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  let x = 0, y = 0, n = 0;
  for (let i = 0; i < data.length; i += 4) if (data[i] === 255 && data[i + 1] === 176 && data[i + 2] === 0) {
    x += i / 4 % canvas.width + 0.5; y += Math.floor(i / 4 / canvas.width) + 0.5; n++;
  }
  return [y / n / ratio, x / n / ratio, n];
}"""
PIXELS = """id => {
  const canvas = document.getElementById(id);
  return Array.from(canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data);
}"""


@contextlib.contextmanager
def opened(file):
    """A player that shows its first step."""
    with opened_page(file) as page:
        page.wait_for_function("document.body.dataset.shown === '0'")
        yield page


def go(page, step):
    page.locator("#slider").fill(str(step))
    page.wait_for_function(f"document.body.dataset.shown === '{step}'")


@browser_needed
def test_the_player(recording, tmp_path):
    with opened(player_page.write_page(recording, tmp_path)) as page:
        pictures_are_what_was_recorded(page, recording)
        numbers_are_what_was_recorded(page, recording)
        the_focal_point_is_where_it_was(page, recording)
        keys_and_mouse_move_it(page, recording)
        it_plays(page)
        go(page, 57)
        ARTEFACTS.mkdir(exist_ok=True)
        page.screenshot(path=ARTEFACTS / "player.png")


@browser_needed
@pytest.mark.parametrize(("width", "parts"), [(3, 1), (80, 0)])
def test_an_image_is_left_out_only_if_it_has_the_frames_shape(width, parts, recording, tmp_path):
    config = compose([f"sensor.rings=[[80,{width},1]]", "sensor.layout=packed", "gaze.bounds=point"])
    image = np.ones((len(recording.screens), 80, width), np.uint8)
    page_file = player_page.write_page(recording._replace(config=config, images=(image,)), tmp_path)
    with opened(page_file) as page:
        assert page.locator("#parts canvas").count() == parts


@pytest.mark.slow
@browser_needed
def test_the_player_shows_colours(untrained, tmp_path):
    words = ["experiment=constant70_p_packed", "env.color=true", "network.dense=8", "network.lstm=8"]
    game = next(record(untrained(Agent(compose(words), 4, 34)), max_steps=130))
    assert np.ptp(game.values, axis=-1).max() > 100
    with opened(player_page.write_page(game, tmp_path)) as page:
        pictures_are_what_was_recorded(page, game)


def pictures_are_what_was_recorded(page, recording):
    values = recording.values
    painting = tables(make_sensor(recording.config.sensor).packed, recording.config.env.frame_shape)
    for step in (119, 0, 60, 59, 129):  # parts of 60 steps begin and end here
        go(page, step)
        screen = np.array(page.evaluate(PIXELS, "screen")).reshape(210, 160, 4)
        np.testing.assert_array_equal(screen[..., :3], recording.screens[step])
        view = np.array(page.evaluate(PIXELS, "view")).reshape(80, 80, 4)[..., :3]
        picture = paint(values[step], recording.focal_point[step], painting).reshape(80, 80, -1)
        np.testing.assert_array_equal(view, np.broadcast_to(picture.astype(int) * 255 // values.max(), view.shape))


def numbers_are_what_was_recorded(page, recording):
    go(page, 77)
    for head, probs in (("natural", recording.natural_probs), ("vision", recording.vision_probs)):
        shares = page.locator(f"#{head} .row > :last-child").all_inner_texts()
        np.testing.assert_allclose([float(share.rstrip("%")) for share in shares], 100 * probs[77], atol=0.8)
        chosen = page.locator(f"#{head} .row.chosen > :first-child").inner_text()
        names = recording.actions if head == "natural" else gaze.names(recording.config.gaze)
        assert chosen == names[getattr(recording, f"{head}_action")[77]]
        value = float(page.locator(f"#{head}Value").inner_text())
        assert value == pytest.approx(getattr(recording, f"{head}_value")[77], abs=0.006)
    assert page.locator("#lives").inner_text() == str(recording.lives[77])
    assert float(page.locator("#score").inner_text()) == recording.score[77]


def the_focal_point_is_where_it_was(page, recording):
    page.keyboard.press("a")  # areas and trail off: the cross alone
    page.keyboard.press("t")
    top, down, across = recording.frame_origin
    for step in (3, 64, 128):
        go(page, step)
        y, x, count = page.evaluate(GAZE)
        unit = page.locator("#screen").bounding_box()["width"] / 160
        expected = recording.focal_point[step] * [down, across] + [top, 0]
        assert count > 10
        np.testing.assert_allclose([y, x], unit * expected, atol=0.6)
    page.keyboard.press("a")
    page.keyboard.press("t")
    assert page.evaluate(GAZE)[2] > 10  # drawn, with the inner area in the same colour


def keys_and_mouse_move_it(page, recording):
    go(page, 50)
    for key, step in (("ArrowRight", 51), ("Shift+ArrowLeft", 36), ("ArrowLeft", 35), ("End", 129), ("Home", 0)):
        page.keyboard.press(key)
        page.wait_for_function(f"document.body.dataset.shown === '{step}'")
    page.keyboard.press("]")
    changes = np.flatnonzero((np.diff(recording.score) != 0) | recording.life_lost[1:]) + 1
    page.wait_for_function(f"document.body.dataset.shown === '{changes[0]}'")
    box = page.locator("#timeline").bounding_box()
    page.mouse.move(box["x"] + 0.25 * box["width"], box["y"] + 20)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.75 * box["width"], box["y"] + 20, steps=5)
    page.mouse.up()
    page.wait_for_function(f"document.body.dataset.shown === '{round(0.75 * 129)}'")


def it_plays(page):
    go(page, 20)
    begin = time.monotonic()
    page.locator("#play").click()
    page.wait_for_function("+document.body.dataset.shown >= 35")
    assert 0.5 < time.monotonic() - begin < 10  # a second on a machine that is not busy
    page.keyboard.press(" ")
    assert page.locator("#play").inner_text() == "Play"
    stopped = page.locator("#slider").input_value()
    page.wait_for_timeout(200)
    assert page.locator("#slider").input_value() == stopped


@browser_needed
@pytest.mark.slow
def test_ten_minutes_fit_into_15_mb_and_scrub_without_lag(recording, tmp_path):
    page_file = player_page.write_page(lengthened(recording, 9000), tmp_path)
    assert page_file.stat().st_size < 15e6
    random, waits = np.random.default_rng(0), []
    with opened(page_file) as page:
        for step in random.integers(0, 9000, 60).tolist():
            script = """step => new Promise(done => {
              const begin = performance.now();
              seek(step);
              const look = () => document.body.dataset.shown === String(step)
                ? done(performance.now() - begin) : requestAnimationFrame(look);
              look();
            })"""
            waits.append(page.evaluate(script, step))
    assert np.median(waits) < 60  # some four frames of a 60 Hz display, also where nothing is cached


def lengthened(recording, steps):
    """The same steps again and again."""
    rows = np.arange(steps) % len(recording.screens)
    screens = Screens()
    for row in rows:
        screens.append(recording.screens[row])
    columns = {
        name: value[rows]
        for name, value in recording._asdict().items()
        if isinstance(value, np.ndarray) and len(value) == len(recording.screens)
    }
    return recording._replace(screens=screens, images=tuple(part[rows] for part in recording.images), **columns)


def test_more_colours_than_a_palette_has_and_large_screens_are_reduced(recording):
    noise, screens = np.random.default_rng(0), Screens()
    for _ in range(70):
        screens.append(noise.integers(0, 256, (400, 600, 3), dtype=np.uint8))
    few = lengthened(recording, 70)._replace(screens=screens, crop_top=None)
    encoded = player_page.encode(few)
    height, width = encoded["screen_shape"]
    assert height * width < 48_500 and width / height == pytest.approx(1.5, rel=0.01)
    assert len(encoded["palette"]) == 256 and len(encoded["screens"]) == len(encoded["values"]) == 2
    np.testing.assert_allclose(encoded["origin"], [0, height / 80, width / 80])


def test_a_gaze_that_is_not_learned_leaves_its_head_out(recording):
    encoded = player_page.encode(recording._replace(vision_probs=None, vision_value=None, lives=None))
    assert not {"vision_probs", "vision_value", "lives"} & set(encoded["columns"])


@pytest.mark.parametrize(
    "words, message",
    [
        (["run=nowhere"], "run=nowhere: does not exist"),
        (["run=nowhere", "steps=0"], "steps=0: accepted is an integer >= 1 or null"),
        (["run=nowhere", "policy=best"], "policy=best: accepted is one of sampled, greedy"),
    ],
)
def test_a_mistake_is_one_line(words, message, capsys):
    assert cli.run(player.player, words) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"foajax: error: {message}") and error.count("\n") == 1
