"""The pictures of what a sensor sees: pixels where they belong, headings, and errors in one line."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from foajax import cli, show
from foajax.config.compose import compose
from foajax.config.schema import LogPolarSensor, RingSensor
from foajax.sensors.registry import make_sensor
from foajax.viewing import sheet
from foajax.viewing.style import draw_gaze

CANVAS = make_sensor(RingSensor(rings=((20, 20, 2), (40, 40, 4))))
PACKED = make_sensor(RingSensor(rings=((20, 20, 2), (40, 40, 4)), peripheral=(5, 5), layout="packed"))
FRAME = np.random.default_rng(0).random((80, 80)).astype(np.float32)


def levels(panel):
    return np.asarray(panel[1].convert("L"))


def test_the_panels_of_a_canvas():
    marked, seen = sheet._panels(FRAME, CANVAS, (30, 50))
    assert marked[0] == "frame, gaze at y 30, x 50"
    assert marked[1].size == seen[1].size == (240, 240)  # three pixels for one
    white = FRAME.max()
    # The block of the inner ring whose corner is (20, 40), and what is outside of all rings.
    mean = FRAME[20:22, 40:42].mean() / white
    assert (levels(seen)[60:66, 120:126] == round(255 * mean)).all()
    assert (levels(seen)[: 3 * 10] == 0).all()
    assert levels(marked)[0, 0] == round(255 * FRAME[0, 0] / white)


def test_the_rings_are_drawn_where_the_areas_end():
    image = np.asarray(sheet._marked(np.zeros((80, 80), np.float32), CANVAS, (30, 50)))
    inner, outer = (255, 176, 0), (47, 184, 255)
    assert {tuple(c) for c in image.reshape(-1, 3)} == {(0, 0, 0), inner, outer}
    for colour, top, left, side in ((outer, 10, 30, 40), (inner, 20, 40, 20)):
        rows, columns = np.nonzero((image == colour).all(axis=-1))
        assert (rows.min(), columns.min()) == (3 * top, 3 * left)
        assert (rows.max(), columns.max()) == (3 * (top + side) - 1, 3 * (left + side) - 1)


@pytest.mark.parametrize("sensor", [RingSensor(rings=((1, 1, 1), (40, 40, 4))), LogPolarSensor(fovea=0.4, radius=0.5)])
def test_an_area_smaller_than_a_pixel_of_the_picture_is_drawn(sensor):
    image = Image.new("RGB", (20, 20))
    draw_gaze(image, make_sensor(sensor), (41, 41), scale=(0.2, 0.2))
    assert image.getbbox()


def test_a_retina_is_drawn_as_a_circle():
    image = np.asarray(
        sheet._marked(np.zeros((80, 80), np.float32), make_sensor(LogPolarSensor(radius=20.0)), (40, 40))
    )
    rows, columns = np.nonzero(image[..., 0])
    distance = np.hypot(rows + 0.5 - 120, columns + 0.5 - 120)
    assert ((abs(distance - 59) < 2.5) | (distance < 8)).all()  # the circle, and the cross in its middle
    assert (abs(distance - 59) < 2.5).sum() > 300


def test_a_packed_layout_shows_its_images():
    panels = sheet._panels(FRAME, PACKED, (40, 40))
    captions = [caption for caption, _ in panels[2:]]
    assert captions == ["image 0: 10 x 10", "image 1: 10 x 10", "image 2: 5 x 5"]
    mean = FRAME[30:32, 30:32].mean() / FRAME.max()
    assert (levels(panels[2])[:24, :24] == round(255 * mean)).all()
    assert len(sheet._panels(FRAME, make_sensor(LogPolarSensor(rings=8, wedges=8)), (40, 40))) == 3


def test_a_black_frame_is_drawn():
    (_, marked), (_, seen) = sheet._panels(np.zeros((80, 80), np.float32), CANVAS, (40, 40))
    assert np.asarray(seen).max() == 0 < np.asarray(marked).max()


def test_a_row_for_each_focal_point():
    one = sheet.draw(FRAME, CANVAS, [(40, 40)], name="mine")
    two = sheet.draw(FRAME, CANVAS, [(40, 40), (30, 30)], name="mine")
    assert two.width == one.width
    assert two.height > one.height + 240
    assert (np.asarray(two)[: one.height] == np.asarray(one)).all()


def test_the_heading_counts_values():
    decreasing = make_sensor(RingSensor(rings=((30, 30, 1), (50, 50, 2), (70, 70, 4))))
    expected = "1,450 values (1,480 shown), 23% of the frame"
    assert sheet._heading(FRAME, decreasing, "decreasing") == ("decreasing", expected)
    nonfoa = make_sensor(RingSensor(rings=((80, 80, 1),)))
    assert sheet._heading(FRAME, nonfoa, "nonfoa") == ("nonfoa", "6,400 values, 100% of the frame")


def test_a_sensor_of_search_is_drawn_on_frames_of_its_size(tmp_path):
    out = tmp_path / "view.png"
    words = ["sensor=search_rings_p", "game=search", "env.frame_shape=[160,160]", "points=[[150,30]]", "steps=0"]
    assert cli.run(show.show, [*words, f"out={out}"]) == 0
    with Image.open(out) as image:
        assert image.width > 3 * 160


@pytest.fixture
def still(monkeypatch):
    """A frame without a game."""
    played = []
    monkeypatch.setattr(show, "walk", lambda config, steps: played.append((config.game, config.seed, steps)) or FRAME)
    return played


def test_the_command(still, tmp_path, capsys):
    out = tmp_path / "view.png"
    words = ["game=pong", "seed=4", "steps=7", "points=[[40,40],[60,20]]", f"out={out}"]
    assert cli.run(show.show, words) == 0
    assert capsys.readouterr().out == f"{out}\n"
    assert still == [("pong", 4, 7)]
    with Image.open(out) as image:
        assert image.height > 2 * 240
    assert out.stat().st_size < 60_000  # of noise, which does not compress


def test_a_sensor_of_ones_own(still, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(
        show, "draw", lambda frame, sensor, points, name: drawn.append(sensor.config) or Image.new("RGB", (9, 9))
    )
    (tmp_path / "sensor").mkdir()
    (tmp_path / "sensor" / "mine.yaml").write_text("rings: [[16, 16, 1]]\n")
    for words in (
        ["sensor=rings", "sensor.rings=[[40,40,1]]"],
        ["sensor=constant70", "sensor.pooling=stride"],
        ["sensor=mine", f"--config-dir={tmp_path}"],
    ):
        assert cli.run(show.show, [*words, f"out={tmp_path / 'own.png'}"]) == 0
    assert drawn == [
        RingSensor(rings=((40, 40, 1),)),
        RingSensor(rings=((70, 70, 2),), pooling="stride"),
        RingSensor(rings=((16, 16, 1),)),
    ]


@pytest.mark.parametrize("word", ["all=true", "sensor=all"])
def test_a_sheet_of_all_sensors(still, tmp_path, capsys, monkeypatch, word):
    names = []
    monkeypatch.setattr(
        show,
        "contact_sheet",
        lambda frame, sensors, points: names.extend(sensors) or Image.new("RGB", (9, 9)),
    )
    assert cli.run(show.show, [word, f"out={tmp_path / 'sheet.png'}"]) == 0
    assert names == [*sheet.PAPER, "logpolar"]
    assert len(still) == 1  # all look at the same frame


def test_the_sheet_is_two_abreast():
    pair = sheet.contact_sheet(FRAME, {"a": CANVAS, "b": PACKED}, [(40, 40)])
    four = sheet.contact_sheet(FRAME, {"a": CANVAS, "b": PACKED, "c": CANVAS, "d": CANVAS}, [(40, 40)])
    assert pair.width == four.width > 4 * 240
    assert four.height > 2 * pair.height


def test_a_frame_of_a_game_that_needs_no_emulator():
    config = compose(["game=seek", "sensor=constant70"])
    first, later = show.walk(config, 0), show.walk(config, 20)
    assert first.shape == (80, 80)
    assert first.max() == 1
    assert not np.array_equal(first, later)
    np.testing.assert_array_equal(later, show.walk(config, 20))


@pytest.mark.parametrize(
    "word, message",
    [
        ("sensor=constant71", "sensor=constant71: did you mean constant70? accepted is one of"),
        ("--config-dir=nowhere", "--config-dir=nowhere: accepted is a directory with experiment/, sensor/"),
        ("sensor=rings", "sensor.rings: missing; accepted is a list of one or more [height, width, factor] with "),
        (
            "sensor.ring=3",
            "sensor.ring=3: unknown key (did you mean sensor.rings?); accepted is one of rings, kind, peripheral, ",
        ),
        ("sensor=all sensor.layout=packed", "sensor.layout=packed: accepted is a key of one sensor, without sensor=a"),
        ("env.frame_shape=[0,80]", "env.frame_shape=[0, 80]: accepted is [height, width], each from 8 to 10000"),
        ("points=[[40,80]]", "points=[40, 80]: accepted is [y, x] inside the frame, 80x80"),
        ("points=40", "points=40: accepted is a list of [y, x]"),
        ("steps=-1", "steps=-1: accepted is an integer >= 0"),
        ("out=view.gif", "out=view.gif: accepted is a file name that ends in .png"),
        ("out=/nowhere/at/all.png", "out=/nowhere/at/all.png: accepted is a file that can be written"),
    ],
)
def test_a_mistake_is_one_line(still, word, message, capsys):
    assert cli.run(show.show, word.split()) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"foajax: error: {message}")
    assert error.count("\n") == 1
