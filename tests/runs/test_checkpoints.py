"""Checkpoints under the conditions they are for: kills, full disks, damage, foreign files."""

from __future__ import annotations

import json
import os
import pickle
import random
import resource
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from foajax.config.parse import ConfigError
from foajax.runs import durable
from foajax.runs.checkpoints import CheckpointError, Checkpoints

ROOT = Path(__file__).parents[2]


class State(NamedTuple):
    params: dict
    opt_state: object
    env_steps: jax.Array


def make_state(seed: int) -> State:
    """Different values everywhere; as many kinds of leaves as a state of training may have."""
    keys = jax.random.split(jax.random.key(seed), 3)
    params = {
        "torso": [{"kernel": jax.random.normal(keys[0], (3, 4)), "bias": jnp.arange(4.0) + seed}],
        "half": jax.random.normal(keys[1], (5,)).astype(jnp.bfloat16),
    }
    state = State(params, optax.amsgrad(1e-3).init(params), jnp.int32(seed))
    return state._replace(
        opt_state=(
            state.opt_state,
            {
                "key": keys[2],
                "keys": jax.random.split(jax.random.key(seed, impl="rbg"), 2),
                "bool": jnp.array([True, False]),
                "byte": np.arange(seed, seed + 3, dtype=np.uint8),
            },
        )
    )


def assert_same(found: object, expected: object) -> None:
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert type(one) is type(other)
        assert one.dtype == other.dtype
        if jax.dtypes.issubdtype(one.dtype, jax.dtypes.prng_key):
            one, other = jax.random.key_data(one), jax.random.key_data(other)
        np.testing.assert_array_equal(one, other)


def small(value: int) -> dict[str, jax.Array]:
    return {"a": jnp.full((64,), value, jnp.float32), "b": jnp.full((3, 2), -value, jnp.int32)}


@pytest.fixture
def told() -> list[str]:
    return []


@pytest.fixture
def opened(tmp_path: Path, told: list[str]) -> Iterator[Callable[..., Checkpoints]]:
    """Opens the directory anew at each call, as another process would."""

    def open_(keep: int | None = 3) -> Checkpoints:
        return Checkpoints(tmp_path / "run" / "checkpoints", keep=keep, warn=told.append)

    yield open_


def fill(checkpoints: Checkpoints, *steps: int, **meta: object) -> None:
    for step in steps:
        assert checkpoints.save(step, small(step), meta | {"step": step})
        checkpoints.wait()


# What goes in comes out


def test_everything_comes_back(opened, told):
    state, meta = make_state(7), {"score": 1.5, "games": [[3.0, 10]], "text": "ü"}
    with opened() as checkpoints:
        assert checkpoints.save(1200, state, meta)
    restored = opened(keep=None).restore(make_state(1))
    assert restored is not None
    assert (restored.env_steps, restored.meta) == (1200, meta)
    assert_same(restored.state, state)
    assert told == []


def test_shapes_alone_are_a_template(opened):
    state = make_state(7)
    with opened() as checkpoints:
        checkpoints.save(1, state, {})
    restored = opened().restore(jax.eval_shape(lambda: jax.tree.map(jnp.asarray, make_state(1))))
    assert_same(restored.state, jax.tree.map(jnp.asarray, state))


def test_a_part_comes_back_alone(opened):
    state = make_state(7)
    with opened() as checkpoints:
        checkpoints.save(1, {"train": state, "rest": jnp.zeros(3)}, {})
    restored = opened(keep=None).restore({"train": make_state(1)}, part=True)
    assert_same(restored.state, {"train": state})
    with pytest.raises(CheckpointError, match="rest is float32"):
        opened(keep=None).restore({"train": make_state(1)})
    with pytest.raises(CheckpointError, match="other is missing"):
        opened(keep=None).restore({"other": jnp.zeros(3)}, part=True)


def test_arrays_arrive_where_the_template_has_them(opened):
    with opened() as checkpoints:
        checkpoints.save(1, {"a": jnp.arange(3)}, {})
    sharding = jax.sharding.NamedSharding(jax.make_mesh((1,), ("data",)), jax.sharding.PartitionSpec("data"))
    template = {"a": jax.ShapeDtypeStruct((3,), jnp.int32, sharding=sharding)}
    assert opened().restore(template).state["a"].sharding == sharding
    assert isinstance(opened().restore({"a": np.zeros(3, np.int32)}).state["a"], np.ndarray)


def test_devices_need_not_be_the_ones_it_was_saved_from(tmp_path):
    code = f"""
import jax, jax.numpy as jnp
from jax.sharding import NamedSharding, PartitionSpec
from foajax.runs.checkpoints import Checkpoints
mesh = jax.make_mesh((2,), ("data",))
place = lambda x, *spec: jax.device_put(x, NamedSharding(mesh, PartitionSpec(*spec)))
with Checkpoints({str(tmp_path)!r}, keep=1) as checkpoints:
    checkpoints.save(1, {{"whole": place(jnp.arange(6)), "split": place(jnp.arange(8.0), "data")}}, {{}})
"""
    flags = {"XLA_FLAGS": "--xla_force_host_platform_device_count=2", "JAX_PLATFORMS": "cpu"}
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=os.environ | flags, check=True)
    restored = Checkpoints(tmp_path, keep=None).restore({"whole": jnp.zeros(6, int), "split": jnp.zeros(8)})
    np.testing.assert_array_equal(restored.state["whole"], np.arange(6))
    np.testing.assert_array_equal(restored.state["split"], np.arange(8.0))


def test_a_saved_state_may_be_donated_at_once(opened):
    donate = jax.jit(lambda state: jax.tree.map(lambda x: x * 0 - 1, state), donate_argnums=0)
    state, array = small(5), np.arange(4)
    with opened() as checkpoints:
        checkpoints.save(1, {**state, "array": array}, {})
        array[:] = -1
        jax.block_until_ready(donate(state))
    restored = opened().restore({**small(0), "array": np.zeros(4, int)})
    assert_same(restored.state, {**small(5), "array": np.arange(4)})


def test_names_that_collide_are_refused(opened):
    with pytest.raises(ValueError, match="same name"):
        opened().save(1, {"a/b": jnp.zeros(1), "a": {"b": jnp.ones(1)}}, {})


def test_arrays_without_elements_come_back(opened):
    state = {**small(5), "empty": [jnp.zeros((32, 0)), np.zeros(0, np.int8)]}
    with opened() as checkpoints:
        checkpoints.save(1, state, {})
    assert_same(opened().restore(state).state, state)


def test_an_array_without_elements_is_not_taken_for_another(opened):
    with opened() as checkpoints:
        checkpoints.save(1, {**small(5), "empty": jnp.zeros((32, 0))}, {})
    with pytest.raises(CheckpointError, match=r"empty is float32\[32,0\], expected is float32\[32,1\]"):
        opened().restore({**small(5), "empty": jnp.zeros((32, 1))})


def test_meta_that_json_cannot_hold_is_refused(opened):
    with pytest.raises(TypeError):
        opened().save(1, small(1), {"x": object()})


# Which ones are kept and used


def test_nothing_there(opened, tmp_path):
    assert opened().restore(small(0)) is None
    assert opened(keep=None).restore(small(0), best=True, part=True) is None
    assert not (tmp_path / "run").exists()


def test_the_newest_are_kept_and_the_best(opened):
    scores = {10: 1.0, 20: 7.0, 30: 7.0, 40: float("nan"), 100: 2.0, 200: -1.0}
    with opened(keep=2) as checkpoints:
        for step, score in scores.items():
            fill(checkpoints, step, score=score)
        assert checkpoints.steps() == [30, 100, 200]
        assert checkpoints.restore(small(0)).env_steps == 200
        best = checkpoints.restore(small(0), best=True, part=True)
        assert best.env_steps == 30
        assert_same(best.state, small(30))


def test_without_scores_the_newest_is_the_best(opened):
    with opened() as checkpoints:
        fill(checkpoints, 9, 10)
        assert checkpoints.restore(small(0), best=True, part=True).env_steps == 10


def test_two_writes_never_run_at_once(opened, monkeypatch):
    seal, go = durable.seal, threading.Event()
    monkeypatch.setattr(durable, "seal", lambda path: (go.wait(20), seal(path)))
    with opened() as checkpoints:
        assert checkpoints.save(1, small(1), {})
        assert not checkpoints.save(2, small(2), {})
        assert checkpoints.steps() == []
        go.set()
        checkpoints.wait()
        assert checkpoints.save(3, small(3), {})
    assert opened().steps() == [1, 3]


def test_a_checkpoint_that_exists_stays_as_it_is(opened):
    with opened() as checkpoints:
        fill(checkpoints, 1)
        checkpoints.save(1, small(99), {})
    assert_same(opened().restore(small(0)).state, small(1))


def test_reading_only_touches_nothing(opened, tmp_path):
    with opened() as checkpoints:
        fill(checkpoints, 1)
        leftover = checkpoints.directory / ".2.new"
        leftover.mkdir()
    reader = opened(keep=None)
    assert reader.restore(small(0)).env_steps == 1
    assert leftover.exists()
    with pytest.raises(ValueError, match="reading only"):
        reader.save(2, small(2), {})


def test_leftovers_are_removed_on_opening_and_nothing_else(opened):
    with opened() as checkpoints:
        fill(checkpoints, 1)
    directory = checkpoints.directory
    for name in (".2.new", ".1.old", "notes", ".hidden", "007"):
        (directory / name / "state").mkdir(parents=True)
    opened()
    assert sorted(os.listdir(directory)) == [".hidden", "007", "1", "notes"]
    assert opened().steps() == [1]


# Damage


def damage_first_byte(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[0] ^= 1
    file.write_bytes(content)


def damage_last_byte(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[-1] ^= 0x80
    file.write_bytes(content)


def truncate(file: Path) -> None:
    os.truncate(file, file.stat().st_size - 1)


def empty(file: Path) -> None:
    os.truncate(file, 0)


def link(file: Path) -> None:
    file.rename(file.with_name("elsewhere"))
    file.symlink_to("elsewhere")


@pytest.mark.parametrize("damage", [damage_first_byte, damage_last_byte, truncate, empty, link, Path.unlink])
def test_damage_to_any_file_is_found_and_named(opened, tmp_path, damage):
    with opened() as checkpoints:
        fill(checkpoints, 8)
    whole = checkpoints.directory / "8"
    files = [path.relative_to(whole) for path in whole.rglob("*") if path.is_file()]
    assert len(files) > 8
    for i, name in enumerate(files):
        copy = tmp_path / f"{i}" / "8"
        shutil.copytree(whole, copy)
        damage(copy / name)
        with pytest.raises(CheckpointError) as caught:
            Checkpoints(copy.parent, keep=None).restore(small(0))
        assert str(copy) in str(caught.value)
        assert "\n" not in str(caught.value)
        if name.name != "SHA256SUMS":  # damage there shows as a mismatch of the file it lists
            assert str(name) in str(caught.value)


def test_an_additional_file_is_found(opened):
    with opened() as checkpoints:
        fill(checkpoints, 8)
    (checkpoints.directory / "8" / "state" / "more").touch()
    with pytest.raises(CheckpointError, match="state/more does not match its checksum"):
        opened().restore(small(0))


def test_a_damaged_newest_is_reported_and_the_one_before_used(opened, told):
    with opened() as checkpoints:
        fill(checkpoints, 1, 2, 3)
    directory = checkpoints.directory
    truncate(directory / "3" / "meta.json")
    with opened() as checkpoints:
        restored = checkpoints.restore(small(0))
        assert_same(restored.state, small(2))
        assert told == [
            f"checkpoint {directory}/3 cannot be used: meta.json does not match its checksum; using 2 instead"
        ]
        # Training comes to the same point again: the damaged one makes room and is not lost.
        assert checkpoints.has(2) and not checkpoints.has(3) and not checkpoints.has(4)
        fill(checkpoints, 3)
        assert checkpoints.has(3)
    assert sorted(os.listdir(directory)) == ["1", "2", "3", "3.unusable"]
    assert_same(opened().restore(small(0)).state, small(3))
    assert len(told) == 1


def test_a_damaged_best_leaves_the_second_best(opened, told):
    with opened() as checkpoints:
        for step, score in ((1, 5.0), (2, 9.0), (3, 2.0)):
            fill(checkpoints, step, score=score)
    damage_last_byte(checkpoints.directory / "2" / "state" / "_METADATA")
    assert opened(keep=None).restore(small(0), best=True, part=True).env_steps == 1
    assert "using 1 instead" in told[0]


def test_none_usable_is_an_error_that_names_the_newest(opened, told):
    with opened() as checkpoints:
        fill(checkpoints, 1, 2)
    for step in ("1", "2"):
        (checkpoints.directory / step / "SHA256SUMS").unlink()
    with pytest.raises(CheckpointError, match="no usable checkpoint in .*/2 cannot be used: SHA256SUMS is missing"):
        opened().restore(small(0))
    assert told == []
    assert issubclass(CheckpointError, ConfigError)  # what the commands show as one line


@pytest.mark.parametrize(
    ("template", "message"),
    [
        ({"a": jnp.zeros(64)}, r"b is int32\[3,2\], expected is no such array"),
        ({**small(0), "c": jnp.zeros(1)}, r"c is missing, expected is float32\[1\]"),
        ({**small(0), "a": jnp.zeros(63)}, r"a is float32\[64\], expected is float32\[63\]"),
        ({**small(0), "a": jnp.zeros(64, int)}, r"a is float32\[64\], expected is int32\[64\]"),
        ({**small(0), "a": jax.random.split(jax.random.key(0), 64)}, r"expected is key<fry>\[64\]"),
    ],
)
def test_a_state_of_another_shape_is_refused(opened, template, message):
    with opened() as checkpoints:
        fill(checkpoints, 1)
    with pytest.raises(CheckpointError, match=message):
        opened().restore(template)


# Foreign and hostile files


class Trap:
    """Leaves a mark when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple:
        return (os.mkdir, (str(self.mark),))


def test_a_pickle_is_not_executed(opened, tmp_path, told):
    with opened() as checkpoints:
        fill(checkpoints, 1, 2, 3)
    trap = pickle.dumps(Trap(tmp_path / "sprung"))
    pickle.loads(pickle.dumps(Trap(tmp_path / "works")))
    assert (tmp_path / "works").exists()
    for name in ("meta.json", "_METADATA", "manifest.ocdbt"):
        target = checkpoints.directory / "3"
        (target / name if name == "meta.json" else target / "state" / name).write_bytes(trap)
        durable.seal(target)  # whoever puts it there can also compute checksums
        assert opened(keep=None).restore(small(0)).env_steps == 2
    (checkpoints.directory / "4").write_bytes(trap)
    assert opened(keep=None).restore(small(0)).env_steps == 2
    assert not (tmp_path / "sprung").exists()
    assert all("\n" not in line for line in told)
    assert any("/4 cannot be used: it is not a directory" in line for line in told)


GOOD = {"format": 1, "env_steps": 1, "meta": {}, "leaves": {"a": "float32[64]", "b": "int32[3,2]"}}


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"[]",
        b"null",
        b"\xff\xfe",
        b"[" * 100_000,
        json.dumps(GOOD | {"format": 2}).encode(),
        json.dumps(GOOD | {"env_steps": 2}).encode(),
        json.dumps(GOOD | {"meta": []}).encode(),
        json.dumps(GOOD | {"leaves": []}).encode(),
        json.dumps(GOOD | {"leaves": {"a": "float32[64]", "b": 3}}).encode(),
        json.dumps({"format": 1}).encode(),
    ],
)
def test_any_content_gives_one_line(opened, content):
    with opened() as checkpoints:
        fill(checkpoints, 1)
    (checkpoints.directory / "1" / "meta.json").write_bytes(content)
    durable.seal(checkpoints.directory / "1")
    with pytest.raises(CheckpointError) as caught:
        opened().restore(small(0))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000


def test_what_was_read_counts_not_what_is_said_about_it(opened):
    """Sealed, and with a meta.json that agrees with the template, but the arrays are others."""
    with opened() as checkpoints:
        checkpoints.save(1, {"a": jnp.zeros(5), "b": jnp.zeros((3, 2), int)}, {})
    path = checkpoints.directory / "1"
    (path / "meta.json").write_text(json.dumps(GOOD))
    durable.seal(path)
    with pytest.raises(CheckpointError, match=r"a is float32\[5\], expected is float32\[64\]"):
        opened().restore(small(0))


@pytest.mark.parametrize("kind", ["pipe", "missing state", "file"])
def test_a_directory_of_something_else_gives_one_line(opened, kind):
    directory = opened().directory / "1"
    directory.mkdir(parents=True)
    if kind == "pipe":
        os.mkfifo(directory / "meta.json")
        (directory / "SHA256SUMS").touch()
    elif kind == "missing state":
        (directory / "meta.json").write_text(json.dumps(GOOD))
        durable.seal(directory)
    else:
        directory.rmdir()
        directory.write_text("hello")
    with pytest.raises(CheckpointError, match="cannot be used") as caught:
        opened().restore(small(0))
    assert "\n" not in str(caught.value)


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


def test_a_failed_write_is_reported_and_leaves_everything_as_it_was(opened, told):
    with opened() as checkpoints:
        fill(checkpoints, 1)
        before = sorted(checkpoints.directory.rglob("*"))
        with limited_files(100_000):
            fill(checkpoints, 2)
        assert sorted(checkpoints.directory.rglob("*")) == before
        assert len(told) == 1
        assert told[0].startswith("checkpoint 2 was not written: [Errno 27] File too large")
        assert "\n" not in told[0]
        fill(checkpoints, 3)
        assert checkpoints.steps() == [1, 3]
    assert len(told) == 1


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 4 MB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(disk)]
    if os.geteuid() != 0 or shutil.which("mount") is None or subprocess.run(mount).returncode != 0:
        pytest.skip("a file system can be mounted by root only")
    yield disk
    subprocess.run(["umount", "--lazy", str(disk)], check=True)


@pytest.mark.parametrize("claimed", [True, False], ids=["noticed before", "noticed by Orbax"])
def test_a_full_disk_costs_one_checkpoint_and_one_line(small_disk, monkeypatch, told, claimed):
    if not claimed:
        monkeypatch.setattr("foajax.runs.checkpoints._claim", lambda path, size: None)
    noise = np.random.default_rng(0).random(220_000)  # does not compress
    ballast = small_disk / "ballast"
    with Checkpoints(small_disk / "checkpoints", keep=3, warn=told.append) as checkpoints:
        fill(checkpoints, 1)
        ballast.write_bytes(bytes(3_000_000))
        checkpoints.save(2, {"noise": noise}, {})
        checkpoints.wait()
        assert checkpoints.steps() == [1]
        assert len(told) == 1
        assert "No space left on device" in told[0]
        assert "\n" not in told[0]
        assert checkpoints.restore(small(0)).env_steps == 1
        ballast.unlink()
        checkpoints.save(3, {"noise": noise}, {})
        checkpoints.wait()
        assert checkpoints.steps() == [1, 3]
        np.testing.assert_array_equal(checkpoints.restore({"noise": noise}).state["noise"], noise)
    assert len(told) == 1


# Kills

_SAVE_FOREVER = """
import os, random, signal, sys, time, warnings
warnings.simplefilter("ignore")
import numpy as np
from foajax.runs.checkpoints import Checkpoints

def save_forever(directory, report):
    with Checkpoints(directory, keep=2) as checkpoints:
        for step in range(1, 10_000):
            checkpoints.save(step, {"a": np.full(50_000, step), "b": np.full((3, 2), -step)}, {})
            checkpoints.wait()
            os.write(report, b"%d\\n" % step)

for directory, delay in zip(sys.argv[1::2], sys.argv[2::2]):
    theirs, ours = os.pipe()
    child = os.fork()  # importing once for all; nothing of JAX runs yet
    if child == 0:
        save_forever(directory, ours)
    os.close(ours)
    reports = os.fdopen(theirs)
    last = reports.readline()
    time.sleep(float(delay))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    print(directory, (last + reports.read()).split()[-1])
"""


def test_a_killed_writer_leaves_its_newest_complete_checkpoint(tmp_path, told):
    chance = random.Random(3)
    arguments = [word for i in range(10) for word in (str(tmp_path / f"{i}"), f"{chance.uniform(0, 0.5):.3f}")]
    command = [sys.executable, "-c", _SAVE_FOREVER, *arguments]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=True)
    rounds = [line.split() for line in result.stdout.splitlines()]
    assert len(rounds) == 10
    torn = 0
    for directory, reported in rounds:
        torn += any(name.startswith(".") for name in os.listdir(directory))
        checkpoints = Checkpoints(directory, keep=2, warn=told.append)
        assert not any(name.startswith(".") for name in os.listdir(directory))
        restored = checkpoints.restore({"a": np.zeros(50_000, int), "b": np.zeros((3, 2), int)})
        step = restored.env_steps
        assert step in (int(reported), int(reported) + 1)  # killed after the rename, before the report
        assert_same(restored.state, {"a": np.full(50_000, step), "b": np.full((3, 2), -step)})
    assert told == []
    assert torn > 0  # some were hit in the middle
