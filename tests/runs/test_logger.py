"""metrics.jsonl as the source of truth, TensorBoard beside it, and the count of whole games."""

from __future__ import annotations

import json
import math
import os
import resource
import shutil
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from foajax.runs import logger as module
from foajax.runs.logger import Logger
from foajax.training.episodes import EpisodeTracker
from foajax.types import Outcome

ROOT = Path(__file__).parents[2]


def start(run_dir: Path, env_steps: int = 0) -> Logger:
    return Logger(run_dir, total_env_steps=10_000, start_env_steps=env_steps, live=False)


def strict(text: str) -> dict:
    """JSON as the standard has it: no NaN, no Infinity."""

    def refuse(name: str) -> None:
        raise ValueError(name)

    return json.loads(text, parse_constant=refuse)


def rows(run_dir: Path) -> list[dict]:
    return [strict(line) for line in (run_dir / "metrics.jsonl").read_text().splitlines()]


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    """Time as the logger sees it."""
    now = [1000.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    return now


# Rows


def test_a_row_is_one_line_of_valid_json(tmp_path, clock):
    with start(tmp_path) as log:
        clock[0] += 12.5
        log.write(
            {
                "score": np.float32(1.5),
                "loss": jnp.float32(-0.25),
                "games": np.int64(3),
                "updates": jnp.int32(7),
                "nan": float("nan"),
                "high": np.inf,
                "low": jnp.float32(-jnp.inf),
                "env_steps": np.int64(640),
            }
        )
        text = (tmp_path / "metrics.jsonl").read_text()  # there at once, not at the end
    assert text == (
        '{"env_steps": 640, "time": 12.5, "score": 1.5, "loss": -0.25, "games": 3, "updates": 7.0, '
        '"nan": null, "high": null, "low": null}\n'
    )
    assert strict(text)["env_steps"] == 640


def test_a_row_needs_env_steps(tmp_path):
    with start(tmp_path) as log, pytest.raises(KeyError, match="env_steps"):
        log.write({"score": 1.0})


def test_a_time_that_is_given_counts(tmp_path, clock):
    with start(tmp_path) as log:
        log.write({"env_steps": 1, "score": 2.0, "time": 99.5})
    assert rows(tmp_path) == [{"env_steps": 1, "time": 99.5, "score": 2.0}]


def test_time_goes_on_over_starts_without_repeated_work(tmp_path, clock):
    with start(tmp_path) as log:
        for i in (1, 2, 3):
            clock[0] += 10
            log.write({"env_steps": 100 * i})
    clock[0] += 5000  # nobody trains
    with start(tmp_path, 250) as log:
        assert [row["env_steps"] for row in rows(tmp_path)] == [100, 200]
        clock[0] += 7
        log.write({"env_steps": 300})
    assert [(row["env_steps"], row["time"]) for row in rows(tmp_path)] == [(100, 10), (200, 20), (300, 27)]


WHOLE = ['{"env_steps": 100, "time": 1.0}\n', '{"env_steps": 200, "time": 2.0, "score": null}\n']


@pytest.mark.parametrize(
    ("content", "kept"),
    [
        ("", 0),
        (WHOLE[0] + WHOLE[1], 2),
        (WHOLE[0] + WHOLE[1][:-1], 1),  # whole but for the end of the line
        (WHOLE[0] + WHOLE[1][:-9], 1),
        (WHOLE[0] + '{"env_steps": 2', 1),
        (WHOLE[0] + '{"env_steps": 300, "time": 3.0}\n', 1),
        (WHOLE[0] + '{"env_steps": 2{"env_steps": 150, "time": 1}\n' + WHOLE[1], 2),
        (WHOLE[0] + "\0\0\0\n[]\n{}\nnull\n" + '{"env_steps": "1", "time": 2}\n' + WHOLE[1], 2),
        (WHOLE[0] + "[" * 100_000 + "\n" + '{"env_steps": NaN, "time": 2}\n' + WHOLE[1], 2),
    ],
)
def test_a_start_keeps_whole_rows_up_to_it(tmp_path, content, kept):
    file = tmp_path / "metrics.jsonl"
    file.write_text(content)
    os.utime(file, (1e9, 1e9))
    before = file.stat().st_ino
    with start(tmp_path, 200) as log:
        assert file.stat().st_mtime == 1e9
        assert file.read_text() == "".join(WHOLE[:kept])
        assert (file.stat().st_ino == before) == (content == "".join(WHOLE[:kept]))  # replaced only at need
        log.write({"env_steps": 300})
    assert [row["env_steps"] for row in rows(tmp_path)] == [100, 200][:kept] + [300]
    assert sorted(os.listdir(tmp_path)) == ["metrics.jsonl", "tensorboard"]


def test_a_start_without_checkpoints_keeps_the_rows_of_the_last_one(tmp_path):
    (tmp_path / "metrics.jsonl").write_text("".join(WHOLE))
    with start(tmp_path, 0) as log:
        log.write({"env_steps": 50})
    assert [row["env_steps"] for row in rows(tmp_path)] == [50]
    assert (tmp_path / "metrics.old.jsonl").read_text() == "".join(WHOLE)
    fresh = (tmp_path / "metrics.jsonl").read_text()
    start(tmp_path, 0).close()
    assert (tmp_path / "metrics.old.jsonl").read_text() == "".join(WHOLE) + fresh


def test_a_file_that_cannot_be_opened_is_an_error_at_the_start(tmp_path):
    (tmp_path / "metrics.jsonl").mkdir()
    with pytest.raises(OSError, match=r"metrics\.jsonl"):
        start(tmp_path)


_LOG_FOREVER = """
import sys
from foajax.runs.logger import Logger
log = Logger(sys.argv[1], total_env_steps=10**9, start_env_steps=0, live=False)
for i in range(1, 10**9):
    log.write({"env_steps": i, "score": i / 3})
"""


def test_a_killed_run_leaves_whole_rows(tmp_path):
    command = [sys.executable, "-c", _LOG_FOREVER, str(tmp_path)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        shown = [process.stdout.readline() for _ in range(200)][-1]
        process.kill()
    shown_steps = int(shown.split()[1].replace(",", ""))
    with start(tmp_path, 10**9):
        found = [row["env_steps"] for row in rows(tmp_path)]
    assert found == list(range(1, len(found) + 1))
    assert len(found) >= shown_steps == 200


# Disks


@contextmanager
def limited_files(size: int) -> Iterator[None]:
    """The kernel refuses to let a file grow beyond `size` bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_loses_no_row_and_warns_once_a_minute(tmp_path, clock, capsys):
    with start(tmp_path) as log:
        log.write({"env_steps": 1})
        size = (tmp_path / "metrics.jsonl").stat().st_size
        with limited_files(size + 10):  # room for half a row
            for i in range(2, 15):
                clock[0] += 10
                log.write({"env_steps": i})
                assert (tmp_path / "metrics.jsonl").stat().st_size == size  # and no half is left
        log.write({"env_steps": 15})
        assert [row["env_steps"] for row in rows(tmp_path)] == list(range(1, 16))
    told = [line for line in capsys.readouterr().out.splitlines() if "metrics.jsonl" in line]
    assert told == ["warning: metrics.jsonl cannot be written ([Errno 27] File too large); training goes on"] * 3


@pytest.mark.skipif(os.geteuid() != 0 or shutil.which("mount") is None, reason="only root can mount a file system")
def test_a_full_file_system_ends_nothing(tmp_path, capsys):
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(disk)]).returncode != 0:
        pytest.skip("no file system can be mounted here")
    try:
        log = start(disk)
        log.write({"env_steps": 1})
        ballast = disk / "ballast"
        with pytest.raises(OSError, match="No space left"):
            ballast.write_bytes(bytes(100_000))
        for i in range(2, 200):
            log.write({"env_steps": i, "score": 1.0})
        log.image("frame", np.random.default_rng(0).integers(0, 256, (80, 80), dtype=np.uint8))
        told = [line for line in capsys.readouterr().out.splitlines() if line.startswith("warning")]
        assert len(told) == 2
        assert all("No space left on device" in line for line in told)
        ballast.unlink()
        log.write({"env_steps": 200})
        log.close()
        assert [row["env_steps"] for row in rows(disk)] == list(range(1, 201))
    finally:
        subprocess.run(["umount", "--lazy", str(disk)], check=True)


# TensorBoard


def events(run_dir: Path) -> list:
    """All events of the only file."""
    from tensorboardX.proto.event_pb2 import Event

    (file,) = (run_dir / "tensorboard").glob("events.out.tfevents.*")
    content, found = file.read_bytes(), []
    while content:
        (length,) = struct.unpack("<Q", content[:8])
        assert content[8:12] == crc(content[:8])
        assert content[12 + length : 16 + length] == crc(content[12 : 12 + length])
        found.append(Event.FromString(content[12 : 12 + length]))
        content = content[16 + length :]
    return found


def crc(content: bytes) -> bytes:
    """CRC-32C bit by bit, rotated and shifted as TensorFlow's records have it."""
    value = 0xFFFFFFFF
    for byte in content:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (0x82F63B78 if value & 1 else 0)
    value ^= 0xFFFFFFFF
    return struct.pack("<I", ((value >> 15 | value << 17) + 0xA282EAD8) & 0xFFFFFFFF)


def test_scalars_and_images_reach_tensorboard(tmp_path):
    gray = np.arange(12, dtype=np.uint8).reshape(3, 4)
    with start(tmp_path, 500) as log:
        log.write({"env_steps": 640, "score": 1.5, "vision_entropy": float("nan")})
        log.image("frame", gray)
        log.image("colour", np.stack([gray] * 3, axis=-1))
        header, log_start, *found = events(tmp_path)  # flushed with each row
    assert header.file_version == "brain.Event:2"
    assert (log_start.session_log.status, log_start.step) == (1, 501)  # hides what was logged beyond 500
    values = {value.tag: value for event in found for value in event.summary.value}
    assert {event.step for event in found} == {640}
    assert set(values) == {"time", "score", "frame", "colour"}
    assert values["score"].simple_value == 1.5
    assert (values["frame"].image.height, values["frame"].image.width) == (3, 4)
    assert values["colour"].image.encoded_image_string.startswith(b"\x89PNG")


def test_a_failing_event_file_is_reported_and_tried_again(tmp_path, capsys):
    (tmp_path / "tensorboard").write_text("a file where the directory should be")
    with start(tmp_path) as log:
        log.write({"env_steps": 1})
        (tmp_path / "tensorboard").unlink()
        log.write({"env_steps": 2})
        noise = np.random.default_rng(0).integers(0, 256, (80, 80), dtype=np.uint8)
        with limited_files(1000):
            log.image("frame", noise)
        log.write({"env_steps": 3})
    told = [line for line in capsys.readouterr().out.splitlines() if line.startswith("warning")]
    assert len(told) == 1
    assert told[0].startswith("warning: tensorboard cannot be written ([Errno 17] File exists: ")
    assert [event.step for event in events(tmp_path)[1:]] == [1, 2, 3]  # the restart and two times `time`
    assert [row["env_steps"] for row in rows(tmp_path)] == [1, 2, 3]


def test_tensorboard_is_imported_only_when_something_is_logged(tmp_path):
    code = f"""
import sys
from foajax.runs.logger import Logger
with Logger({str(tmp_path)!r}, total_env_steps=1, start_env_steps=0) as log:
    log.message("hello")
    assert not any(name.startswith("tensorboardX") for name in sys.modules)
    log.write({{"env_steps": 1}})
    assert "tensorboardX" in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


# Games


def outcomes(num_envs: int, steps: int) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(5)
    score = generator.integers(-2, 5, (steps, num_envs)).astype(np.float32)
    over = generator.random((steps, num_envs)) < np.linspace(0.02, 0.3, num_envs)
    over[1:] &= ~over[:-1]  # a reset ends no game
    return score, over


@pytest.mark.parametrize("convert", [np.asarray, jnp.asarray])
def test_whole_games_against_a_loop(convert):
    num_envs, steps = 5, 200
    score, over = outcomes(num_envs, steps)
    tracker = EpisodeTracker(num_envs, window=10)
    assert math.isnan(tracker.mean_score)
    assert math.isnan(tracker.mean_length)
    total, length = [0.0] * num_envs, [0] * num_envs
    expected: list[tuple[float, int]] = []
    for t in range(steps):
        finished = tracker.add(Outcome(score=convert(score[t]), is_over=convert(over[t])))
        ended = []
        for i in range(num_envs):
            total[i] += float(score[t, i])
            length[i] += 0 if t and over[t - 1, i] else 1
            if over[t, i]:
                ended.append((total[i], length[i]))
                total[i], length[i] = 0.0, 0
        assert finished == ended
        expected += ended
    assert len(expected) > 50
    assert tracker.games == len(expected)
    assert tracker.mean_score == pytest.approx(sum(s for s, _ in expected[-10:]) / 10)
    assert tracker.mean_length == pytest.approx(sum(n for _, n in expected[-10:]) / 10)


def test_the_best_score_is_that_of_a_full_window_and_survives():
    tracker = EpisodeTracker(1, window=2)
    best = []
    for score in (9.0, 1.0, 3.0, 2.0):
        tracker.add(Outcome(score=np.float32([score]), is_over=np.array([True])))
        best.append(tracker.best_score)
    assert math.isnan(best[0]) and best[1:] == [5.0, 5.0, 5.0]
    other = EpisodeTracker(1, window=2)
    assert other.get_state()["best_score"] is None  # strict JSON has no NaN
    other.set_state(json.loads(json.dumps(tracker.get_state())), same_games=False)
    assert other.best_score == 5.0
    old = {name: value for name, value in tracker.get_state().items() if name != "best_score"}
    other.set_state(old, same_games=False)
    assert math.isnan(other.best_score)


def test_a_game_by_hand():
    tracker = EpisodeTracker(2)
    script = [([1, 0], [0, 0]), ([2, 5], [1, 0]), ([0, 0], [0, 0]), ([4, 1], [1, 1])]  # (score, is over)
    finished = [tracker.add(Outcome(score=np.float32(s), is_over=np.array(o, bool))) for s, o in script]
    assert finished == [[], [(3.0, 2)], [], [(4.0, 1), (6.0, 4)]]
    assert (tracker.games, tracker.mean_score, tracker.mean_length) == (3, 13 / 3, 7 / 3)


@pytest.mark.parametrize("same_games", [True, False])
def test_a_tracker_goes_on_after_json(same_games):
    score, over = outcomes(4, 100)
    whole, first, second = EpisodeTracker(4), EpisodeTracker(4), EpisodeTracker(4)
    for t in range(50):
        for tracker in (whole, first):
            tracker.add(Outcome(score=score[t], is_over=over[t]))
    second.set_state(json.loads(json.dumps(first.get_state())), same_games=same_games)
    assert (second.games, second.mean_score) == (first.games, first.mean_score)
    later = [
        [tracker.add(Outcome(score=score[t], is_over=over[t])) for t in range(50, 100)] for tracker in (whole, second)
    ]
    assert (later[0] == later[1]) == same_games
    if not same_games:  # only what had begun before is another count
        assert [len(games) for games in later[0]] == [len(games) for games in later[1]]
        assert sum(n for games in later[1] for _, n in games) < sum(n for games in later[0] for _, n in games)
