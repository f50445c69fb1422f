"""Run directories: who holds them, what they are for, and every way in which they may be unusable."""

from __future__ import annotations

import json
import os
import platform
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import yaml

from foajax.config.parse import ConfigError, flatten, replace, to_mapping
from foajax.config.schema import RENAMED, Config, LogPolarSensor, RingSensor, from_mapping, renamed
from foajax.runs import provenance
from foajax.runs.directory import load_config, open_run
from foajax.runs.lock import RunError

ROOT = Path(__file__).parents[2]
COMMAND = ["python", "-m", "foajax.train", "game=breakout"]


@pytest.fixture
def config(tmp_path: Path) -> Config:
    return Config(name="constant70", sensor=RingSensor(rings=((70, 70, 2),)), run=str(tmp_path / "runs" / "x"))


def changed(config: Config, **values: object) -> Config:
    """A copy in which dotted keys, with __ for the dot, have other values."""
    mapping = to_mapping(config)
    for key, value in values.items():
        *groups, name = key.split("__")
        inner = mapping
        for group in groups:
            inner = inner[group]
        inner[name] = value
    return from_mapping(mapping)


def refusal(config: Config) -> str:
    """The one line with which the run is refused."""
    with pytest.raises(RunError) as caught:
        open_run(config, command=COMMAND)
    assert "\n" not in str(caught.value)
    return str(caught.value)


# What it writes


def test_a_new_directory_holds_config_and_record(config):
    with open_run(config, command=COMMAND) as run:
        assert run.path == Path(config.run_dir)
        assert from_mapping(yaml.safe_load((run.path / "config.yaml").read_text())) == config
    record = json.loads((run.path / "run.json").read_text())
    (start,) = record["starts"]
    assert start["command"] == COMMAND
    assert start["python"] == platform.python_version()
    assert start["process"] == os.getpid()
    assert set(start["packages"]) >= {"jax", "flax", "envpool", "orbax-checkpoint"}
    assert start["packages"]["numpy"] is not None
    assert start["cpu"]


def test_every_start_is_added(config):
    for words in (["first"], ["second"], ["third"]):
        open_run(config, command=words).close()
    record = json.loads((Path(config.run_dir) / "run.json").read_text())
    assert [start["command"] for start in record["starts"]] == [["first"], ["second"], ["third"]]


def test_config_survives_the_file_in_every_detail(config, tmp_path):
    log_polar = replace(
        changed(config, learner__adam_eps=3e-17, gaze__start=[40, 41], gaze__bounds="point"),
        sensor=LogPolarSensor(),
        game="gymnasium:ALE/Pong-v5",
        run=str(tmp_path / "other"),
    )
    for each in (config, log_polar):
        open_run(each, command=COMMAND).close()
        assert load_config(each.run_dir) == each


def test_a_shipped_agent_is_not_taken_for_a_run(config):
    path = Path(config.run_dir)
    path.mkdir(parents=True)
    (path / "agent.safetensors").touch()
    said = f"run={path}: is a shipped agent; accepted is another run=<dir>, with train.init_from={path} to begin "
    assert refusal(config).startswith(said)
    assert [entry.name for entry in path.iterdir()] == ["agent.safetensors"]


@pytest.mark.parametrize(
    ("group", "key", "before"),
    [
        ("network", "lstm_norm", False),
        ("network", "padding", "valid"),
        ("network", "focal_point", "packed"),
        ("network", "dense_norm", False),
        ("network", "last_actions", False),
        ("network", "last_reward", False),
        ("network", "focal_scale", "frame"),
        ("network", "forget_bias", 0.0),
        ("learner", "amsgrad", True),
        ("learner", "value_target", "n_step"),
    ],
)
def test_a_run_from_before_a_key_is_read_as_it_was_made(config, group, key, before):
    open_run(config, command=COMMAND).close()
    file = Path(config.run_dir) / "config.yaml"
    mapping = yaml.safe_load(file.read_text())
    assert getattr(getattr(load_config(config.run_dir), group), key) == mapping[group].pop(key) != before
    file.write_text(yaml.safe_dump(mapping))
    assert getattr(getattr(load_config(config.run_dir), group), key) == before


def test_a_run_with_words_of_before_is_read(config):
    values = {"num_epochs": 3, "num_minibatches": 8, "natural": {"entropy_weight": 0.02}}
    other = changed(config, train__keep_checkpoints=5, **{f"learner__{key}": value for key, value in values.items()})
    begun(other)
    file = Path(config.run_dir) / "config.yaml"
    text = file.read_text()
    for old, new in RENAMED.items():
        text = re.sub(rf"\b{new.rpartition('.')[2]}:", f"{old.rpartition('.')[2]}:", text)
    assert "  keep: 5\n" in text and "  beta: 0.02\n" in text
    file.write_text(text)
    assert load_config(config.run_dir) == other
    open_run(other, command=COMMAND).close()  # and goes on


SHIPPED = [*sorted(ROOT.glob("agents/*/config.yaml")), ROOT / "tests/data/shipped_before/config.yaml"]


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.parent.name)
def test_a_shipped_agent_is_read_with_all_that_its_file_says(path):
    said = dict(flatten(renamed(yaml.safe_load(path.read_text())))) | {"run": str(path.parent)}
    assert said.items() <= dict(flatten(to_mapping(load_config(path.parent)))).items()


def test_load_config_follows_a_moved_run(config, tmp_path):
    open_run(config, command=COMMAND).close()
    Path(config.run_dir).rename(tmp_path / "moved")
    assert load_config(tmp_path / "moved").run_dir == str(tmp_path / "moved")


def test_the_commit_is_that_of_the_package_or_none(tmp_path, monkeypatch):
    package = tmp_path / "checkout" / "foajax"
    package.mkdir(parents=True)
    monkeypatch.setattr(provenance, "__file__", str(package / "runs" / "provenance.py"))
    assert provenance.commit() is None
    if shutil.which("git") is None:
        pytest.skip("git is not installed")
    (package / "file").write_text("one")
    for words in (
        ["init", "--quiet"],
        ["add", "."],
        ["-c", "user.name=a", "-c", "user.email=a@b", "commit", "--quiet", "--message", "one"],
    ):
        subprocess.run(["git", *words], cwd=package.parent, check=True)
    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=package, capture_output=True, text=True).stdout.strip()
    assert provenance.commit() == head
    (package / "file").write_text("two")
    assert provenance.commit() == f"{head}-dirty"
    installed = package / "venv" / "foajax"
    monkeypatch.setattr(provenance, "__file__", str(installed / "runs" / "provenance.py"))
    assert provenance.commit() is None


# What may change between two starts


def begun(config):
    """Opens the run and lets it write a row."""
    open_run(config, command=COMMAND).close()
    (Path(config.run_dir) / "metrics.jsonl").write_text('{"env_steps": 640, "time": 1.0}\n')


def test_what_was_refused_before_it_began_may_be_corrected(config):
    open_run(changed(config, env__frame_shape=[84, 84]), command=COMMAND).close()
    open_run(config, command=COMMAND).close()
    assert load_config(config.run_dir) == config
    checkpoint = Path(config.run_dir) / "checkpoints" / "640"
    checkpoint.mkdir(parents=True)
    assert refusal(changed(config, seed=3)).startswith("seed=3: the run in ")


@pytest.mark.parametrize(
    ("key", "value", "line"),
    [
        ("learner__learning_rate", 0.002, "learner.learning_rate=0.002: the run in {run} has 0.001; "),
        ("learner__vision__entropy_weight", 0.5, "learner.vision.entropy_weight=0.5: the run in {run} has 0.003; "),
        ("learner__clip_ratio", 0.2, "learner.clip_ratio=0.2: the run in {run} has 0.1; "),
        ("game", "pong", "game=pong: the run in {run} has breakout; "),
        ("seed", 3, "seed=3: the run in {run} has 0; "),
        ("env__frame_shape", [84, 84], "env.frame_shape=[84, 84]: the run in {run} has [80, 80]; "),
        ("env__crop_top", {"default": 30}, "env.crop_top.default=30: the run in {run} has 34; "),
        ("env__crop_top", {"default": 34}, "env.crop_top.beam_rider=null: the run in {run} has 20; "),
        ("sensor", {"kind": "logpolar", "radius": 30.0}, "sensor.kind=logpolar: the run in {run} has rings; "),
    ],
)
def test_another_meaning_is_refused_by_name(config, key, value, line):
    begun(config)
    before = {p.name: p.read_bytes() for p in Path(config.run_dir).iterdir()}
    told = refusal(changed(config, **{key: value}))
    changes, _, words = told.partition("choose another run=<dir>, or go on with ")
    assert changes == line.format(run=config.run_dir)
    name = "sensor" if key == "sensor" else line.partition("=")[0]  # the group, which brings all keys of a kind
    assert f"{name}={re.search(r'has (.*); ', changes)[1]}" in shlex.split(words)
    assert {p.name: p.read_bytes() for p in Path(config.run_dir).iterdir()} == before
    open_run(config, command=COMMAND).close()  # and nobody holds it


def test_the_way_back_to_a_sensor_of_ones_own_names_its_group(config):
    begun(changed(config, sensor={"kind": "mine:Dots", "kwargs": {}}))
    words = shlex.split(refusal(config).partition("go on with ")[2])
    assert words[-2:] == ["sensor=own", "sensor.kind=mine:Dots"]


def test_a_key_that_the_run_has_not_is_to_be_left_out(config):
    begun(config)
    told = refusal(changed(config, network__torso_kwargs={"b": 2}))
    assert told.startswith("network.torso_kwargs.b=2: the run in ")
    assert told.endswith("has null; choose another run=<dir>, or leave out network.torso_kwargs.b")


def test_a_run_without_its_configuration_is_not_gone_on_with(config):
    begun(config)
    (Path(config.run_dir) / "config.yaml").unlink()
    assert "has rows or checkpoints but no config.yaml; accepted is another directory" in refusal(config)


def test_what_means_the_same_is_taken_over(config):
    open_run(config, command=COMMAND).close()
    other = changed(
        config,
        name="of_another_name",
        train__env_steps=7,
        train__log_every=1.5,
        train__checkpoint_every=2.5,
        train__keep_checkpoints=9,
        train__max_skipped=3,
        env__threads=2,
        profile=True,
        run=os.path.relpath(config.run_dir),
    )
    open_run(other, command=COMMAND).close()
    assert load_config(config.run_dir) == replace(other, run=config.run_dir)


def test_the_length_of_a_run_counts_where_the_learning_rate_follows_it(config):
    linear = changed(config, learner__schedule="linear")
    begun(linear)
    assert refusal(changed(linear, train__env_steps=7)).startswith("train.env_steps=7: the run in ")


# Who holds it

_HOLD = """
import sys, time
from foajax.config.schema import Config, RingSensor
from foajax.runs.lock import RunError
from foajax.runs.directory import open_run
config = Config(name="constant70", sensor=RingSensor(rings=((70, 70, 2),)), run=sys.argv[1])
try:
    run = open_run(config, command=[])
except RunError as error:
    print(error)
else:
    print("held", flush=True)
    time.sleep(60)
"""


@contextmanager
def another_process(config: Config) -> Iterator[tuple[subprocess.Popen, str]]:
    """A process that holds the run, if it can, and its first line."""
    command = [sys.executable, "-c", _HOLD, config.run_dir]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process, process.stdout.readline().strip()
        finally:
            process.kill()


def test_one_process_at_a_time(config):
    with another_process(config) as (holder, line):
        assert line == "held"
        record = (Path(config.run_dir) / "run.json").read_bytes()
        told = refusal(config)
        assert told.startswith(f"run={config.run_dir}: in use by process {holder.pid} on {platform.node()}; ")
        with another_process(config) as (_, line):
            assert line == told
        assert (Path(config.run_dir) / "run.json").read_bytes() == record
        assert load_config(config.run_dir) == config  # reading is free


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_dead_process_holds_nothing(config, number):
    with another_process(config) as (holder, line):
        assert line == "held"
        holder.send_signal(number)
        holder.wait()
        open_run(config, command=COMMAND).close()


def test_held_until_closed(config):
    run = open_run(config, command=COMMAND)
    with another_process(config) as (_, line):
        assert f"in use by process {os.getpid()} on " in line
    run.close()
    run.close()
    with another_process(config) as (_, line):
        assert line == "held"


# What cannot be used


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is not the configuration of a run"),
        (b"- 1\n", "is not the configuration of a run"),
        (b"nmae: x\n", "nmae=x: unknown key"),
        (b"name: x\n", "sensor: missing"),
        (b"a: [1\nb: }", "is not the configuration of a run"),
        (b"\x80\x03binary\x00", "is not the configuration of a run"),
        (b"!!python/object/apply:os.mkdir [sprung]", "is not the configuration of a run"),
        (b"[" * 1_000, "is not the configuration of a run"),
        (b"name: x\nsensor: {kind: [], rings: []}\n", "config.yaml: "),
    ],
)
def test_a_damaged_or_foreign_config_gives_one_line(config, content, message, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    path = Path(config.run_dir)
    open_run(config, command=COMMAND).close()
    (path / "config.yaml").write_bytes(content)
    with pytest.raises(RunError, match=message) as caught:
        load_config(path)
    assert str(caught.value).startswith(f"{path}/config.yaml: ")
    assert len(str(caught.value)) < 500
    assert refusal(config).startswith(str(caught.value).partition(" (")[0])
    assert (path / "config.yaml").read_bytes() == content
    assert not Path("sprung").exists()


@pytest.mark.parametrize("content", [b"", b"{}", b"[]", b'{"starts": 3}', b"\xff", b"[" * 100_000])
def test_a_foreign_record_gives_one_line(config, content):
    open_run(config, command=COMMAND).close()
    file = Path(config.run_dir) / "run.json"
    file.write_bytes(content)
    assert refusal(config) == f"{file}: is not the record of a run; move it away"
    assert file.read_bytes() == content


def test_load_config_says_what_is_missing(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "empty").mkdir()
    (tmp_path / "odd" / "config.yaml").mkdir(parents=True)
    for name, message in {
        "nowhere": f"run={tmp_path}/nowhere: does not exist; accepted is the directory of a run",
        "file": f"run={tmp_path}/file: is a file; accepted is the directory of a run",
        "empty": f"run={tmp_path}/empty: has no config.yaml; accepted is the directory of a run",
        "odd": f"{tmp_path}/odd/config.yaml: cannot be read (Is a directory)",
    }.items():
        with pytest.raises(RunError) as caught:
            load_config(tmp_path / name)
        assert str(caught.value) == message
    assert issubclass(RunError, ConfigError)  # what the commands show as one line


def test_a_file_in_place_of_the_directory(config, tmp_path):
    (tmp_path / "file").touch()
    assert (
        refusal(changed(config, run=f"{tmp_path}/file")) == f"run={tmp_path}/file: is a file; accepted is a directory"
    )
    inside = f"{tmp_path}/file/inside"
    assert refusal(changed(config, run=inside)).startswith(f"run={inside}: cannot be created (Not a directory); ")


@contextmanager
def ordinary_user() -> Iterator[None]:
    """Permissions mean nothing to root."""
    if os.geteuid() != 0:
        yield
        return
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


def test_directories_that_cannot_be_written(config):
    # Not in tmp_path: an ordinary user may not enter root's.
    base = Path(tempfile.mkdtemp(dir="/tmp"))
    try:
        (base / "run").mkdir()
        for path in (base / "run", base):
            path.chmod(0o555)
        with ordinary_user():
            told = refusal(changed(config, run=f"{base}/new"))
            assert told == f"run={base}/new: cannot be created (Permission denied); choose another run=<dir>"
            told = refusal(changed(config, run=f"{base}/run"))
            assert told == f"run={base}/run: cannot be written (Permission denied); choose another run=<dir>"
        assert os.listdir(base / "run") == []
    finally:
        base.chmod(0o755)
        shutil.rmtree(base)
