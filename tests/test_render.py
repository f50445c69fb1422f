"""Videos: where things are in a frame, and files that play at the game's own speed."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from PIL import Image

from foajax import cli, render
from foajax.config.compose import compose
from foajax.runs.agents import save_agent
from foajax.viewing import video
from foajax.viewing.recording import Screens, progress_bar
from foajax.viewing.scene import _MARGIN, _TOP, Scene, _dim
from foajax.viewing.style import NATURAL, RINGS
from foajax.viewing.video import why_no_mp4


def rgb(colour):
    return [int(colour[i : i + 2], 16) for i in (1, 3, 5)]


def test_a_frame_shows_the_screen_the_gaze_and_the_view(recording):
    scene, step = Scene(recording), 40
    image = np.asarray(scene.draw(step)).astype(int)
    screen = image[_TOP : _TOP + 420, _MARGIN : _MARGIN + 320]
    y, x = 2 * (34 + 2 * recording.focal_point[step][0]), 2 * 2 * recording.focal_point[step][1]
    assert (screen[y, x - 4 : x + 5] == rgb(RINGS[0])).all()  # the cross, two screen pixels for one
    drawn = np.repeat(np.repeat(recording.screens[step], 2, 0), 2, 1)
    assert (screen == drawn).all(axis=-1).mean() > 0.9  # the rest is lines
    view = image[_TOP : _TOP + 320, 2 * _MARGIN + 320 : 2 * _MARGIN + 640]
    assert (view[..., 0] == view[..., 1]).all() and 0 < view.mean() < 250
    assert (image[:, 700:] == rgb(NATURAL)).all(axis=-1).sum() > 50  # the bar of the action taken


def test_more_actions_than_fit_are_drawn_by_the_likeliest(recording):
    probs = np.zeros((130, 300), np.float32)
    probs[:, 299], probs[:, 0] = 0.75, 0.25
    many = recording._replace(
        natural_probs=probs, natural_action=np.full(130, 299), actions=tuple(f"action {i}" for i in range(300))
    )
    image = np.asarray(Scene(many).draw(9))[:, 700:]
    bright, dim = ((image == rgb(colour)).all(axis=-1) for colour in (NATURAL, _dim(NATURAL)))
    assert bright[120:, 140:].any() and dim[:120].any()  # the last one's bar, taken, and the first one's


def test_a_whole_frame_without_a_gaze_of_its_own_is_drawn(recording):
    values = np.zeros((len(recording.screens), 80, 80), np.uint8)
    values[:, 40, 20] = 100
    nonfoa = recording._replace(
        config=compose(["experiment=nonfoa"]), images=(values,), vision_probs=None, vision_value=None, lives=None
    )._replace(focal_point=np.full_like(recording.focal_point, 40))
    image = np.asarray(Scene(nonfoa).draw(9))
    view = image[_TOP : _TOP + 320, 2 * _MARGIN + 320 : 2 * _MARGIN + 640]
    rows, columns = np.nonzero(view[..., 0])
    # The whole frame is shown around its centre; the brightest value is white.
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (160, 163, 80, 83) and view.max() == 255


def test_an_ffmpeg_that_does_not_run_is_found_before_the_game_is_played(monkeypatch, capsys):
    pytest.importorskip("imageio_ffmpeg", reason="imageio-ffmpeg (extra `video`) is not installed")
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", "/nowhere/ffmpeg")
    why_no_mp4.cache_clear()
    assert cli.run(render.render, ["run=pong-constant70_p_packed", "format=mp4"]) == 2
    said = capsys.readouterr().err
    assert "format=mp4: the ffmpeg of imageio-ffmpeg does not run" in said and "accepted is gif" in said
    assert said.count("\n") == 1
    monkeypatch.undo()
    why_no_mp4.cache_clear()


def test_the_command_writes_an_mp4_at_the_games_speed(breakout_agent, tmp_path, capsys):
    pytest.importorskip("imageio_ffmpeg", reason="imageio-ffmpeg (extra `video`) is not installed")
    save_agent(breakout_agent, tmp_path / "agent")
    words = [f"run={tmp_path / 'agent'}", "steps=30", "episodes=2", "seed=3", f"out={tmp_path / 'out'}"]
    assert cli.run(render.render, words) == 0
    written = capsys.readouterr().out.split()
    names = ["episode-3.mp4", "episode-4.mp4", "heatmap.png", "heatmap.json"]
    assert [str(tmp_path / "out" / name) for name in names] == written[-4:]
    video = cv2.VideoCapture(written[-4])
    assert (video.get(cv2.CAP_PROP_FRAME_COUNT), video.get(cv2.CAP_PROP_FPS)) == (30, 15)


def test_a_gif_has_the_same_speed(recording, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(video, "_GIF_STEPS", 20)
    first = Screens()
    for screen in recording.screens[:24]:
        first.append(screen)
    with progress_bar() as bar:
        video.write_video(recording._replace(screens=first), tmp_path / "game.gif", bar)
    with Image.open(tmp_path / "game.gif") as image:
        durations = []
        for i in range(image.n_frames):
            image.seek(i)
            durations.append(image.info["duration"])
    assert sum(durations) == pytest.approx(1000 * 20 / 15, abs=10)
    told = " ".join(capsys.readouterr().err.split())
    assert "only the first 20 of 24 steps" in told and "pip install 'foajax[video]'" in told


@pytest.mark.parametrize(
    "word, message",
    [
        ("episodes=0", "episodes=0: accepted is an integer >= 1"),
        ("format=avi", "format=avi: accepted is one of mp4, gif or null"),
        ("run=nowhere", "run=nowhere: does not exist"),
    ],
)
def test_a_mistake_is_one_line(word, message, capsys):
    assert cli.run(render.render, ["run=nowhere", word]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"foajax: error: {message}") and error.count("\n") == 1
