"""The camera loop: a real video file, a camera that is lost, a request to stop."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

cv2 = pytest.importorskip("cv2", reason="needs the extra robot")
camera = pytest.importorskip("camera", reason="needs the extra robot")
pytest.importorskip("onnx", reason="needs the extra robot")
Agent, AgentError = camera.Agent, camera.AgentError


@pytest.fixture
def path(make_stored, fill):
    """The folder of an agent that decides 15 times a second."""
    return fill(make_stored("experiment=constant70_p_packed"))


@pytest.fixture
def agent(path):
    """That agent in front of a camera."""
    return Agent(path, source="camera", order="bgr")


def film(file, images, fps=30):
    """Writes so many images of a moving square as a video."""
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), fps, (160, 120))
    assert writer.isOpened()
    for step in range(images):
        image = np.full((120, 160, 3), 40, np.uint8)
        image[20:60, step % 100 : step % 100 + 40] = (250, 10, 90)
        writer.write(image)
    writer.release()
    return str(file)


class Capture:
    """Stands in for `cv2.VideoCapture`: gives images as long as its script says so, a word for each opening."""

    script: list[int] = []  # images that each opening gives; an opening beyond the last one fails
    opened = 0

    def __init__(self, source):
        self.open(source)

    def open(self, source):
        self.left = self.script[Capture.opened] if Capture.opened < len(self.script) else -1
        Capture.opened += 1

    def isOpened(self):
        return self.left >= 0

    def get(self, what):
        return 0.0  # as drivers that do not know

    def grab(self):
        self.left -= 1
        return self.left >= 0

    def read(self):
        return (True, np.zeros((90, 120, 3), np.uint8)) if self.grab() else (False, None)

    def release(self):
        pass


@pytest.fixture
def script(monkeypatch):
    """Sets what the cameras of a test give."""

    def write(*images):
        monkeypatch.setattr(Capture, "script", list(images))
        monkeypatch.setattr(Capture, "opened", 0)
        monkeypatch.setattr(camera.cv2, "VideoCapture", Capture)

    return write


def test_a_film_is_decided_upon_at_the_rate_of_training(agent, tmp_path, capsys):
    source = camera.Camera(film(tmp_path / "film.avi", 20), rate=15)
    assert (source.every, source.period) == (2, pytest.approx(1 / 15))
    said = []

    def drive(natural, vision):
        said.append((natural, vision))
        return 0.5

    found = camera.run(agent, source, drive=drive, log_every=0)
    assert found.frames == len(said) == agent.age == 10
    assert said[-1] == agent.last_actions
    lines = capsys.readouterr().err.splitlines()
    assert re.search(r"10 frames, \d+ late; read [\d.]+ ms \(99%: [\d.]+\), decide .*, drive ", lines[-1])


def test_rewards_come_from_what_drives(path, tmp_path):
    class Told(Agent):
        rewards: list[float] = []

        def decide(self, frame, reward=0.0):
            self.rewards.append(reward)
            return super().decide(frame, reward)

    rewards = iter([0.5, None, -1.0])
    agent = Told(path, source="camera")
    source = camera.Camera(film(tmp_path / "film.avi", 3), rate=30)
    camera.run(agent, source, drive=lambda natural, vision: next(rewards))
    assert agent.rewards == [0.0, 0.5, 0.0]


def test_the_gaze_is_drawn_where_it_was(agent, tmp_path):
    image = np.zeros((120, 160, 3), np.uint8)
    agent.decide(image)
    drawn = camera.drawn(image, agent)
    assert not image.any()
    rows, columns = np.nonzero((drawn == camera.COLOUR).all(-1) & (np.arange(120) > 40)[:, None])
    y, x = agent.looked_at
    # 70x70 of 80x80, on 120x160; the line is two or three pixels wide
    assert abs(rows.max() - (y + 35) * 1.5) <= 3
    assert abs(columns.max() - (x + 35) * 2) <= 3


@pytest.mark.parametrize("name", ["seen.mp4", "seen.avi"])
def test_a_film_of_the_gaze_is_written(name, path, tmp_path, capsys):
    words = ["--folder", str(path), "--source", film(tmp_path / "film.avi", 12), "--draw", str(tmp_path / name)]
    assert camera.main(words) == 0
    assert "camera: end: 6 frames" in capsys.readouterr().err
    seen = cv2.VideoCapture(str(tmp_path / name))
    assert int(seen.get(cv2.CAP_PROP_FRAME_COUNT)) == 6
    assert round(seen.get(cv2.CAP_PROP_FPS)) == 15


def test_a_frame_that_takes_too_long_is_told(agent, tmp_path, capsys):
    source = camera.Camera(film(tmp_path / "film.avi", 3), rate=30)
    found = camera.run(agent, source, drive=lambda natural, vision: time.sleep(0.04))
    assert found.late == 3
    assert re.search(r"frame 2 took \d+\.\d ms, longer than its period of 33\.3 ms", capsys.readouterr().err)
    assert "3 frames, 3 late" in str(found)


def test_a_lost_camera_is_opened_again_and_the_memory_goes_on(agent, script, capsys):
    script(3, -1, 0, 4, -1, -1)
    source = camera.Camera("0", rate=15, retries=2, wait=0.0)
    with pytest.raises(AgentError, match="source=0: is lost; 2 attempts to open it again have failed"):
        camera.run(agent, source)
    assert agent.age == 3  # the second opening fails, and the third gives nothing
    assert capsys.readouterr().err.count("attempt") == 2

    script(3, -1, 5, 4)
    agent.reset()
    source = camera.Camera("0", rate=15, retries=2, wait=0.0)
    with pytest.raises(AgentError, match="is lost"):
        camera.run(agent, source)
    assert agent.age == 3 + 4 + 3  # one image of each opening finds out that the camera is back
    assert capsys.readouterr().err.count("camera is back; the agent goes on with the memory that it had") == 2


def test_a_request_to_stop_is_heard_while_the_camera_is_lost(agent, script):
    script(3)
    source = camera.Camera("0", rate=15, retries=5, wait=0.0)
    asked = iter([False] * 4 + [True] * 10)
    found = camera.run(agent, source, stopped=lambda: next(asked))
    assert found.frames == 3


def test_images_are_gray_or_another_size_from_one_to_the_next(agent):
    class Sizes:
        period = 1.0

        def images(self, stopped):
            yield np.zeros((120, 160), np.uint8)
            yield np.zeros((1080, 1920, 3), np.uint8)

    drawn = []
    assert camera.run(agent, Sizes(), draw=drawn.append).frames == 2
    assert [image.shape for image in drawn] == [(120, 160, 3), (1080, 1920, 3)]


@pytest.mark.parametrize(
    "words, message",
    [
        (["--source", "nothing.avi"], "source=nothing.avi: cannot be opened; accepted is a camera's number"),
        (["--drive", "nothing:go"], "drive=nothing:go: accepted is module:function"),
        (["--drive", ""], "end: 2 frames"),
        (["--draw", "/nowhere/seen.mp4"], "draw=/nowhere/seen.mp4: cannot be written; accepted is a .mp4"),
        (["--folder", "/nowhere"], "/nowhere: accepted is a folder that foajax export wrote"),
    ],
)
def test_mistakes_are_one_line(words, message, path, tmp_path, capfd):
    words = ["--folder", str(path), "--source", film(tmp_path / "film.avi", 5), *words]
    ended = camera.main(words)
    lines = [line for line in capfd.readouterr().err.splitlines() if line.startswith("camera: ")]
    assert ended == (0 if "end" in message else 1)
    assert message in lines[-1]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_after_the_frame_at_hand(number, path, tmp_path):
    (tmp_path / "slow.py").write_text("import time\ndef drive(natural, vision):\n    time.sleep(0.02)\n")
    words = ["--source", film(tmp_path / "film.avi", 4000), "--drive", "slow:drive", "--log-every", "0"]
    command = [sys.executable, "-u", str(path / "camera.py"), *words]
    environment = {"PATH": "/usr/bin:/bin"}
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment, cwd=tmp_path)
    assert process.stderr is not None
    try:
        line = process.stderr.readline()
        while "frames" not in line:
            assert line
            line = process.stderr.readline()
        process.send_signal(number)
        rest = process.stderr.read()
        assert process.wait(60) == 0
    finally:
        process.kill()
        process.stderr.close()
    assert "camera: stopped: " in rest.splitlines()[-1]
