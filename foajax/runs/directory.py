"""A run's directory: one process at a time holds it, and no later start changes what the run learns.

    config.yaml   the resolved configuration
    run.json      every start: command, versions, commit, machine, devices, time
    lock          locked by the process that trains; the text names it
    failure.txt   why the last start failed, if it did

Further files belong to others: ``metrics.jsonl`` (logger), ``checkpoints/`` (checkpoints).
"""

from __future__ import annotations

import contextlib
import json
import os
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from foajax.config.parse import ConfigError, flatten, one_line, refuse, replace, to_mapping
from foajax.config.schema import Config, from_mapping
from foajax.runs import durable
from foajax.runs.lock import RunError, reason_of, refuse_run, take_lock
from foajax.runs.provenance import RECORD, record_start

PARAMETERS = "agent.safetensors"  # of a shipped agent, which is no run
_CONFIG = "config.yaml"
_FAILURE = "failure.txt"
# Keys that older runs lack, with the values that act as these runs did.
_BEFORE = {
    "network": {
        **{"lstm_norm": False, "padding": "valid", "focal_point": "packed", "focal_scale": "frame"},
        **{"dense_norm": False, "last_actions": False, "last_reward": False, "forget_bias": 0.0},
    },
    "learner": {"amsgrad": True, "value_target": "n_step"},
}
# What may change between two starts of a run: none of it changes what a step learns.
FREE = {
    *("name", "run", "profile", "env.threads", "env.timeout"),
    *("train.env_steps", "train.log_every", "train.checkpoint_every", "train.keep_checkpoints"),
    *("train.max_skipped", "train.dump_skipped"),
    *("train.devices", *(f"distributed.{key}" for key in ("coordinator", "processes", "process", "timeout"))),
}


class RunDir:
    """A run's directory, held by this process until `close` or the end of a `with`."""

    def __init__(self, path: Path, lock: int) -> None:
        self.path = path
        self._lock = lock

    def close(self) -> None:
        """Lets another process have the directory."""
        if self._lock >= 0:
            os.close(self._lock)
        self._lock = -1

    def __enter__(self) -> RunDir:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, Exception):
            note_failure(self.path, describe_error(error))
        self.close()


def open_run(config: Config, *, command: Sequence[str], devices: Sequence[str] = ()) -> RunDir:
    """Creates or reopens ``config.run_dir`` and holds it.

    The lock is the kernel's: it ends with the process, however that ends. ``config.yaml`` is written, or
    compared with what is there: a key that changes what is learned has to have its old value, the others
    (lengths, intervals, threads) are taken over. ``run.json`` gains an entry.

    Args:
      config: the run that is asked for.
      command: the words that started this process, for the record.
      devices: the kinds of the run's devices, for the record.

    Raises:
      RunError: the directory cannot be created, written or read, is in use, or holds another run or a shipped agent.
    """
    path = Path(config.run_dir)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise refuse_run(path, "is a file", "a directory") from None
    except (OSError, ValueError) as error:
        raise refuse_run(path, f"cannot be created ({reason_of(error)}); choose another run=<dir>") from None
    if os.path.lexists(path / PARAMETERS):
        accepted = f"another run=<dir>, with train.init_from={path} to begin from its parameters"
        raise refuse_run(path, "is a shipped agent", accepted)
    run_dir = RunDir(path, take_lock(path))
    try:
        _settle_config(path, config)
        record_start(path, command, devices)
        (path / _FAILURE).unlink(missing_ok=True)
    except OSError as error:
        run_dir.close()
        raise refuse_run(path, f"cannot be used ({reason_of(error)}); choose another run=<dir>") from None
    except BaseException:
        run_dir.close()
        raise
    return run_dir


def take_over(path: Path) -> RunDir | None:
    """Holds the directory of a run that no process holds any more; returns None if one does or there is no run."""
    try:
        return RunDir(path, take_lock(path)) if is_run(path) else None
    except RunError:
        return None


def load_config(path: str | os.PathLike[str], *, key: str = "run", accepted: str = "the directory of a run") -> Config:
    """Reads the configuration of the run in `path`, with ``run`` set to `path`.

    Args:
      path: its directory.
      key: the key that named it, for the message where there is none.
      accepted: what that key accepts.

    Raises:
      RunError: there is no such directory, it is no run, or its ``config.yaml`` cannot be read.
    """
    path = Path(path)
    file = path / _CONFIG
    try:
        mapping = yaml.safe_load(file.read_text(encoding="utf-8"))
        if not isinstance(mapping, dict):
            raise ConfigError("is not the configuration of a run (no mapping)")
        for group, before in _BEFORE.items():
            if isinstance(mapping.get(group), dict):
                mapping[group] = before | mapping[group]
        config = from_mapping(mapping)
    except (FileNotFoundError, NotADirectoryError):
        there = f"has no {_CONFIG}" if os.path.isdir(path) else "is a file"
        what = there if os.path.exists(path) else "does not exist"
        raise refuse(key, path, accepted, why=what, kind=RunError) from None
    except ConfigError as error:
        raise refuse(str(file), accepted="", why=str(error), kind=RunError) from None
    except OSError as error:
        raise refuse(str(file), accepted="", why=f"cannot be read ({reason_of(error)})", kind=RunError) from None
    except Exception as error:  # a file of any content ends up here
        why = f"is not the configuration of a run ({reason_of(error)})"
        raise refuse(str(file), accepted="", why=why, kind=RunError) from None
    return replace(config, run=str(path))


def is_run(path: Path) -> bool:
    """Whether `path` is the directory of a run that has been started."""
    return (path / _CONFIG).is_file() and (path / RECORD).is_file()


def note_failure(path: Path, why: str) -> None:
    """Writes to ``failure.txt`` why this start of the run in `path` failed."""
    with contextlib.suppress(OSError):
        (path / _FAILURE).write_text(why + "\n", encoding="utf-8")


def forget_failure(path: Path) -> None:
    """Deletes ``failure.txt``, because the run in `path` is started again."""
    with contextlib.suppress(OSError):
        (path / _FAILURE).unlink(missing_ok=True)


def failure(path: Path) -> str | None:
    """Reads why the last start of the run in `path` failed, in one line; None where it did not."""
    try:
        return (path / _FAILURE).read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return None


def describe_error(error: Exception) -> str:
    """Describes an error in one line: its text and, unless the user can mend it, its type."""
    text = one_line(error)
    return text if isinstance(error, ConfigError) else f"{type(error).__name__}: {text}"


def compared(config: Config) -> dict[str, Any]:
    """Returns a run's values by dotted key, without those of its logger, which may always change."""
    return {key: value for key, value in flatten(to_mapping(config)) if not key.startswith("train.logger")}


def differing(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[str]:
    """Lists the keys whose values differ between two runs (`compared`)."""
    return [key for key in dict.fromkeys([*first, *second]) if first.get(key) != second.get(key)]


def _settle_config(path: Path, config: Config) -> None:
    """Writes ``config.yaml`` if it is new or differs only as it may (`FREE`); else raises RunError."""
    text = yaml.safe_dump(to_mapping(config), sort_keys=False)
    file = path / _CONFIG
    if os.path.lexists(file):
        check_same_run(path, config)
        if file.read_text(encoding="utf-8") == text:
            return
    elif _has_begun(path):
        raise refuse_run(path, f"has rows or checkpoints but no {_CONFIG}", "another directory, or that file again")
    durable.replace(file, text.encode())


def check_same_run(path: Path, config: Config) -> None:
    """Raises RunError if the run in `path` differs from `config` in a key that changes what is learned.

    A run without a row or a checkpoint may differ: it has learned nothing, so the new words replace the old ones.
    """
    stored, asked = compared(load_config(path)), compared(config)
    if not _has_begun(path):
        return
    # With a falling learning rate the length of the run is part of what a step learns.
    free = FREE - {"train.env_steps"} if config.learner.schedule == "linear" else FREE
    if keys := [key for key in differing(asked, stored) if key not in free]:
        old, new = _show(stored.get(keys[0])), _show(asked.get(keys[0]))
        still = FREE if stored["learner.schedule"] == "constant" else ()
        words = shlex.join(w for key in keys if key in stored and key not in still for w in _words(key, stored[key]))
        remedy = f"choose another run=<dir>, or {f'go on with {words}' if words else f'leave out {keys[0]}'}"
        if keys[0] == "train.env_steps":
            remedy = f"its learning rate falls to 0 there; accepted is another run=<dir> with train.init_from={path}"
        raise refuse(keys[0], new, "", why=f"the run in {path} has {old}; {remedy}", kind=RunError)


def _has_begun(path: Path) -> bool:
    """Whether the run has a row of metrics or a checkpoint."""
    rows, checkpoints = path / "metrics.jsonl", path / "checkpoints"
    return (rows.is_file() and rows.stat().st_size > 0) or (checkpoints.is_dir() and any(checkpoints.iterdir()))


def _words(key: str, value: Any) -> list[str]:
    """Writes a key and its value as one types them. `sensor=rings` brings the keys of its kind, `sensor.kind` none."""
    if key != "sensor.kind":
        return [f"{key}={_show(value)}"]
    return ["sensor=own", f"sensor.kind={value}"] if ":" in value else [f"sensor={value}"]


def _show(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
