"""The kernel's lock by which one process at a time holds a run's directory."""

from __future__ import annotations

import fcntl
import os
import socket
import time
from pathlib import Path

from foajax.config.parse import ConfigError, brief, refuse


class RunError(ConfigError):
    """A run directory that cannot be used; the message is one line for the user."""


def refuse_run(path: Path, why: str, accepted: str = "") -> ConfigError:
    """Makes the error about a run's directory. The caller raises it."""
    return refuse("run", path, accepted, why=why, kind=RunError)


def is_held(path: Path) -> bool:
    """Whether a process has the run in `path` open, on this machine or on another that shares its files."""
    try:
        with (path / "lock").open("rb") as lock:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


def take_lock(path: Path) -> int:
    """Locks the directory until the returned descriptor is closed; raises RunError if another process has it."""
    try:
        lock = os.open(path / "lock", os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise refuse_run(path, f"cannot be written ({reason_of(error)}); choose another run=<dir>") from None
    try:
        _lock(lock)
        os.ftruncate(lock, 0)
        os.write(lock, f"process {os.getpid()} on {socket.gethostname()}\n".encode())
    except BlockingIOError:
        holder = os.read(lock, 200).decode(errors="replace").strip() or "another process"
        os.close(lock)
        raise refuse_run(path, f"in use by {holder}; end it or choose another run=<dir>") from None
    except OSError as error:
        os.close(lock)
        raise refuse_run(path, f"cannot be locked ({reason_of(error)}); choose another run=<dir>") from None
    return lock


def _lock(descriptor: int) -> None:
    """Takes the kernel's lock. Waits as long as a look (`is_held`) may take, then raises BlockingIOError."""
    for wait in (0.01, 0.05, 0.2, None):
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            if wait is None:
                raise
        time.sleep(wait)


def reason_of(error: Exception) -> str:
    """Returns why a file cannot be used, for the end of a line."""
    return brief(getattr(error, "strerror", None) or error)
