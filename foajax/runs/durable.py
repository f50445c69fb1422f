"""Files that are whole or not there: atomic replacement, and directories sealed with checksums.

`seal` writes ``SHA256SUMS`` beside the files, one line per file in the format of the `sha256sum` program
(`sha256sum -c SHA256SUMS` checks it by hand). `verify` finds and names what differs from the sealed content: a
changed, missing or additional file, or a damaged ``SHA256SUMS`` itself.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

_SUMS = "SHA256SUMS"


class DamageError(Exception):
    """A directory that is not what was sealed; the message is one line that names the file."""


def replace(path: Path, content: bytes) -> None:
    """Writes a file so that a reader, also one after a crash, finds the old content or the new."""
    new = path.with_name(f".{path.name}.new")
    try:
        new.write_bytes(content)
        sync(new)
        os.replace(new, path)
    finally:
        new.unlink(missing_ok=True)
    sync(path.parent)


def sync(path: Path) -> None:
    """Makes the content of a file, or the entries of a directory, survive a power cut."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def seal(directory: Path) -> None:
    """Writes the checksums and makes the whole directory survive a power cut."""
    (directory / _SUMS).write_text(_checksums(directory), encoding="utf-8")
    for entry in directory.rglob("*"):
        sync(entry)
    sync(directory)


def verify(directory: Path) -> None:
    """Raises `DamageError` unless the directory holds exactly what `seal` left."""
    if directory.is_symlink() or not directory.is_dir():
        raise DamageError("it is not a directory")
    sums = directory / _SUMS
    if sums.is_symlink() or not sums.is_file():
        raise DamageError(f"{_SUMS} is missing")
    found, stored = _checksums(directory), sums.read_bytes()
    if found.encode() == stored:
        return
    digests = _parse(found)
    listed = _parse(stored.decode("utf-8", errors="replace"))
    for name in sorted(digests.keys() | listed.keys()):
        if name not in digests:
            raise DamageError(f"{name} is missing")
        if digests[name] != listed.get(name):
            raise DamageError(f"{name} does not match its checksum")
    raise DamageError(f"{_SUMS} is damaged")


def _checksums(directory: Path) -> str:
    """Returns the text of ``SHA256SUMS`` for the files as they are; DamageError for links, pipes and devices."""
    lines = []
    for path in sorted(directory.rglob("*")):
        name = path.relative_to(directory).as_posix()
        if path.is_symlink() or not (path.is_file() or path.is_dir()):
            raise DamageError(f"{name} is not a plain file")
        if path.is_file() and name != _SUMS:
            with path.open("rb") as file:
                lines.append(f"{hashlib.file_digest(file, 'sha256').hexdigest()}  {name}\n")
    return "".join(lines)


def _parse(text: str) -> dict[str, str]:
    """Returns the digests by file name."""
    pairs = (line.partition("  ") for line in text.splitlines())
    return {name: digest for digest, _, name in pairs if name}


class WholeFile:
    """A file to which content is added whole or, with an OSError, not at all."""

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)

    def append(self, content: bytes) -> None:
        size = os.fstat(self._file).st_size
        try:
            rest = memoryview(content)
            while rest:
                rest = rest[os.write(self._file, rest) :]
        except OSError:
            os.ftruncate(self._file, size)
            raise

    def close(self) -> None:
        os.close(self._file)
