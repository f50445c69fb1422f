"""Replacement that is all or nothing, and seals."""

from __future__ import annotations

import hashlib
import os
import resource
import shutil
import subprocess
from pathlib import Path

import pytest

from foajax.runs import durable


@pytest.fixture
def sealed(tmp_path: Path) -> Path:
    directory = tmp_path / "sealed"
    (directory / "inner").mkdir(parents=True)
    (directory / "a").write_bytes(b"one")
    (directory / "inner" / "b c").write_bytes(b"two")
    durable.seal(directory)
    return directory


def test_a_seal_is_what_sha256sum_writes(sealed):
    one, two = (hashlib.sha256(content).hexdigest() for content in (b"one", b"two"))
    assert (sealed / "SHA256SUMS").read_text() == f"{one}  a\n{two}  inner/b c\n"
    durable.verify(sealed)
    if shutil.which("sha256sum"):
        subprocess.run(["sha256sum", "--check", "--strict", "SHA256SUMS"], cwd=sealed, check=True)


def test_every_byte_of_a_seal_counts(sealed):
    sums = sealed / "SHA256SUMS"
    content = sums.read_bytes()
    for i in range(len(content)):
        flipped = bytearray(content)
        flipped[i] ^= 1 << i % 8
        sums.write_bytes(flipped)
        with pytest.raises(durable.DamageError):
            durable.verify(sealed)
    for length in range(len(content)):
        sums.write_bytes(content[:length])
        with pytest.raises(durable.DamageError):
            durable.verify(sealed)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda d: (d / "a").write_bytes(b"One"), "^a does not match its checksum$"),
        (lambda d: (d / "a").unlink(), "^a is missing$"),
        (lambda d: (d / "inner" / "new").touch(), "^inner/new does not match its checksum$"),
        (lambda d: (d / "SHA256SUMS").unlink(), "^SHA256SUMS is missing$"),
        (
            lambda d: (d / "SHA256SUMS").write_bytes((d / "SHA256SUMS").read_bytes() + b"\n"),
            "^SHA256SUMS is damaged$",
        ),
        (lambda d: (d / "up").symlink_to(".."), "^up is not a plain file$"),
        (lambda d: os.mkfifo(d / "pipe"), "^pipe is not a plain file$"),
        (shutil.rmtree, "^it is not a directory$"),
    ],
)
def test_damage_is_named(sealed, damage, message):
    damage(sealed)
    with pytest.raises(durable.DamageError, match=message):
        durable.verify(sealed)


def test_a_link_to_a_sealed_directory_is_none(sealed, tmp_path):
    (tmp_path / "link").symlink_to(sealed)
    with pytest.raises(durable.DamageError, match="not a directory"):
        durable.verify(tmp_path / "link")


def test_a_file_is_replaced_or_left_alone(tmp_path):
    file = tmp_path / "file"
    durable.replace(file, b"old")
    durable.replace(file, b"new")
    assert file.read_bytes() == b"new"
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with pytest.raises(OSError, match="File too large"):
            durable.replace(file, bytes(2000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert file.read_bytes() == b"new"
    assert os.listdir(tmp_path) == ["file"]
