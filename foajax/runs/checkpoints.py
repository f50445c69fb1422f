"""Checkpoints that survive being killed, a full disk and damaged files.

A checkpoint is a directory named after its ``env_steps``:

    1200/state/      the arrays, written by Orbax
    1200/meta.json   format, env_steps, the caller's ``meta``, name, dtype and shape of every array
    1200/SHA256SUMS  checksums of all the files above; `sha256sum -c SHA256SUMS` checks it by hand

It is written under another name, synced and renamed, so a numbered directory is always complete. Orbax
stores the arrays. Processes that share a run have the same state, so one of them writes it. Orbax's
CheckpointManager is not used: it has no place for checksums inside its atomic step, leaves the half-written
directory of a failed save behind, and on a full disk prints hundreds of lines from its own threads. Nothing
here reads pickles or any other format that can carry code.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import shutil
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
from orbax.checkpoint._src.multihost import multihost

from foajax.config.parse import ConfigError, one_line
from foajax.runs import durable

_FORMAT = 1
_COMPLETE = re.compile(r"0|[1-9][0-9]{0,17}")
_EMPTY = re.compile(r"[\[,]0[\],]")  # in what `_describe` says of an array without elements
_LEFTOVER = re.compile(r"\.[0-9]+\.(new|old)")
_HEADROOM = 2**20  # bytes beside the arrays: names, shapes, indices


class CheckpointError(ConfigError):
    """A checkpoint that cannot be used; the message is one line for the user."""


class Restored(NamedTuple):
    """What a checkpoint held."""

    env_steps: int
    state: Any  # a pytree like the template
    meta: dict[str, Any]


def _to_stderr(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


class Checkpoints:
    """The checkpoints of one run. One process may write; any number may read meanwhile.

    Use a writer in a `with`, or call `wait` before the process ends: else its last write may be lost.

    Args:
      directory: where they are; created by the first save.
      keep: how many of the newest are kept, beside the best one (highest finite ``meta["score"]``, the
        newest of equals). None opens them for reading only: nothing on disk is touched. Otherwise what
        killed writers left half-written is deleted now.
      warn: receives one line for each thing that went wrong and was survived. Failed writes are reported
        from the writing thread.
    """

    def __init__(
        self, directory: str | os.PathLike[str], *, keep: int | None, warn: Callable[[str], None] = _to_stderr
    ) -> None:
        self.directory = Path(directory).absolute()
        self._keep = keep
        self._warn = warn
        self._unusable: set[int] = set()  # failed to restore; set aside by the next save
        self._writer: threading.Thread | None = None
        if keep is not None and self.directory.is_dir():
            for path in self.directory.iterdir():
                if _LEFTOVER.fullmatch(path.name):
                    shutil.rmtree(path, ignore_errors=True)

    def steps(self) -> list[int]:
        """The ``env_steps`` of all complete checkpoints, ascending; CheckpointError if unreadable."""
        try:
            names = os.listdir(self.directory) if self.directory.is_dir() else []
        except OSError as error:
            raise CheckpointError(f"{self.directory} cannot be read: {error.strerror}") from error
        return sorted(int(name) for name in names if _COMPLETE.fullmatch(name))

    def has(self, env_steps: int) -> bool:
        """Whether there is a complete checkpoint of `env_steps`, and it has not failed to restore."""
        return env_steps not in self._unusable and os.path.isdir(self.directory / str(env_steps))

    def save(self, env_steps: int, state: Any, meta: Mapping[str, Any]) -> bool:
        """Starts writing a checkpoint in the background and returns.

        The caller is held up only while copies of the arrays are enqueued on their device; it may donate
        or overwrite `state` at once. Never two writes at once: while one is running nothing is started
        (call `wait` first where that matters, as at the end of training). A write that fails is reported
        through `warn`, leaves the older checkpoints as they are, and the next save tries again.

        Args:
          env_steps: the name of the checkpoint; one that exists already is left as it is.
          state: a pytree of arrays, typed PRNG keys included.
          meta: what JSON can hold (TypeError otherwise); ``meta["score"]`` decides which one is best.

        Returns:
          Whether a write was started.
        """
        if self._keep is None:
            raise ValueError("these checkpoints were opened for reading only")
        if self._writer is not None and self._writer.is_alive():
            return False
        leaves = named_leaves(state)
        spec = {name: _describe(leaf) for name, leaf in leaves.items()}
        body = {"format": _FORMAT, "env_steps": int(env_steps), "meta": dict(meta), "leaves": spec}
        text = json.dumps(body, indent=1)
        arrays = {name: _copy(leaf) for name, leaf in leaves.items() if leaf.size}  # Orbax refuses others
        self._writer = threading.Thread(
            target=self._run, args=(self._keep, int(env_steps), arrays, text), name="checkpoint-writer"
        )
        self._writer.start()
        return True

    def wait(self) -> None:
        """Returns when no write is running."""
        if self._writer is not None:
            self._writer.join()

    def __enter__(self) -> Checkpoints:
        return self

    def __exit__(self, *_: object) -> None:
        self.wait()

    def restore(self, template: Any, *, part: bool = False, best: bool = False) -> Restored | None:
        """Reads the newest usable checkpoint, to go on from; None where there is none at all.

        Each one is verified against its checksums and against `template` (a pytree of arrays or
        `jax.ShapeDtypeStruct`; names, shapes and dtypes must agree) before it is used. One that fails is
        reported through `warn` and the one before it is tried. Arrays arrive where the template has them.

        Args:
          part: whether `template` may leave out arrays that the checkpoint has.
          best: take the highest ``meta["score"]`` first (among equals, and without one, the newest).

        Raises:
          CheckpointError: there are checkpoints, but none can be used.
        """
        failed: dict[int, CheckpointError] = {}
        # Listed again after each failure: beside a running writer, old ones go and new ones come.
        while left := [step for step in self.steps() if step not in failed]:
            step = max(left, key=self._score_and_step if best else None)
            try:
                restored = _read(self.directory / str(step), template, part=part)
            except CheckpointError as error:
                failed[step] = error
                continue
            for other, reason in failed.items():
                if os.path.lexists(self.directory / str(other)):
                    self._unusable.add(other)
                    self._warn(f"{reason}; using {step} instead")
            return restored
        if failed:
            raise CheckpointError(f"no usable checkpoint in {self.directory}: {failed[max(failed)]}")
        return None

    def _score_and_step(self, step: int) -> tuple[float, int]:
        return _score(self.directory / str(step)), step

    def _run(self, keep: int, env_steps: int, arrays: dict[str, Any], text: str) -> None:
        """Writes a checkpoint and deletes old ones, on the writing thread."""
        new = self.directory / f".{env_steps}.new"
        try:
            self._write(env_steps, new, arrays, text)
        except Exception as error:  # whatever it is, training goes on
            self._warn(
                f"checkpoint {env_steps} was not written: {_one_line(error)}; "
                "older ones are intact, the next save tries again"
            )
        finally:
            shutil.rmtree(new, ignore_errors=True)
        try:
            self._prune(keep)
        except Exception as error:
            self._warn(f"old checkpoints were not deleted: {_one_line(error)}")

    def _write(self, env_steps: int, new: Path, arrays: dict[str, Any], text: str) -> None:
        final = self.directory / str(env_steps)
        if self.has(env_steps):
            return
        shutil.rmtree(new, ignore_errors=True)
        new.mkdir(parents=True)
        _claim(new / "claim", sum(array.nbytes for array in arrays.values()) + _HEADROOM)
        with _orbax() as orbax:
            # From the host: arrays of a device are refused where several processes share a run.
            orbax.save(new / "state", args=ocp.args.PyTreeSave({name: np.asarray(x) for name, x in arrays.items()}))
        (new / "meta.json").write_text(text, encoding="utf-8")
        durable.seal(new)
        for step in sorted(self._unusable):
            _set_aside(self.directory / str(step))
        self._unusable.clear()
        os.rename(new, final)
        durable.sync(self.directory)

    def _prune(self, keep: int) -> None:
        steps = [step for step in self.steps() if step not in self._unusable]
        if not steps:
            return
        best = max(steps, key=self._score_and_step)
        for step in set(steps) - set(steps[-keep:]) - {best}:
            # Renamed first: a directory with a number is complete, even if this is interrupted.
            old = self.directory / f".{step}.old"
            os.rename(self.directory / str(step), old)
            shutil.rmtree(old)


def named_leaves(tree: Any) -> dict[str, Any]:
    """Returns the leaves by their path, e.g. `0/params/dense/kernel`."""
    paths = jax.tree_util.tree_leaves_with_path(tree)
    named = {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in paths}
    if len(named) != len(paths):
        raise ValueError("two arrays of the state have the same name")
    return named


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _describe(leaf: Any) -> str:
    return f"{leaf.dtype}[{','.join(map(str, leaf.shape))}]"


def _copy(leaf: Any) -> Any:
    """Copies an array on its device, without waiting and sharing no memory; a key becomes its raw data.

    `may_alias=False` copies without compiling anything, which `jnp.copy` would do once for each shape.
    """
    if not isinstance(leaf, jax.Array):
        return np.array(leaf)
    return jax.device_put(jax.random.key_data(leaf) if _is_key(leaf) else leaf, may_alias=False)


@contextlib.contextmanager
def _orbax() -> Iterator[ocp.Checkpointer]:
    """Yields Orbax for this process alone. It would otherwise wait for all processes of a run, of which one writes.

    Its options leave one thing open: only process 0 writes arrays of the host, whoever the primary host is.
    """
    alone = ocp.options.MultiprocessingOptions(primary_host=0, active_processes={0})
    handler = ocp.PyTreeCheckpointHandler(multiprocessing_options=alone)
    with (
        mock.patch.object(multihost, "process_index", lambda: 0),
        ocp.Checkpointer(handler, multiprocessing_options=alone) as orbax,
    ):
        yield orbax


def _claim(path: Path, size: int) -> None:
    """Fills `size` bytes of the disk and frees them; raises OSError if there is no room.

    Orbax would notice too, with pages of tracebacks and writes that go on after the error.
    """
    with path.open("wb") as file:
        for _ in range(0, size, _HEADROOM):
            file.write(bytes(_HEADROOM))
    path.unlink()


def _read(path: Path, template: Any, *, part: bool) -> Restored:
    """Reads and verifies a checkpoint; raises CheckpointError for whatever may be wrong with it."""
    try:
        durable.verify(path)
        body = json.loads((path / "meta.json").read_text(encoding="utf-8"))
        if body.get("format") != _FORMAT:
            raise CheckpointError(f"its format is {body.get('format')}, this foajax reads {_FORMAT}")
        if str(body["env_steps"]) != path.name or not isinstance(body["meta"], dict):
            raise CheckpointError("meta.json belongs to another checkpoint")
        leaves = named_leaves(template)
        stored = body["leaves"]
        relevant = {name: stored[name] for name in leaves if name in stored} if part else stored
        _compare(relevant, {name: _describe(leaf) for name, leaf in leaves.items()})
        written = [name for name, spec in stored.items() if not _EMPTY.search(spec)]
        arrays = _place(_read_arrays(path / "state", written), leaves)
        state = jax.tree.unflatten(jax.tree.structure(template), [arrays[name] for name in leaves])
    except Exception as error:  # files of any content end up here, as do those of another program
        raise CheckpointError(f"checkpoint {path} cannot be used: {_one_line(error)}") from error
    return Restored(env_steps=body["env_steps"], state=state, meta=body["meta"])


def _read_arrays(path: Path, names: list[str]) -> dict[str, np.ndarray]:
    """Reads all arrays by name to the host, whatever devices they came from."""
    host = ocp.RestoreArgs(restore_type=np.ndarray)
    with _orbax() as orbax:
        return orbax.restore(path, args=ocp.args.PyTreeRestore(restore_args=dict.fromkeys(names, host)))


def _place(arrays: Mapping[str, np.ndarray], leaves: Mapping[str, Any]) -> dict[str, Any]:
    """Puts the arrays that `leaves` asks for where `leaves` are: on the host or a device, raw or as keys."""
    placed = {}
    for name, leaf in leaves.items():
        array = arrays[name] if leaf.size else np.empty(leaf.shape, leaf.dtype)
        if _is_key(leaf):
            array = jax.random.wrap_key_data(jnp.asarray(array), impl=jax.random.key_impl(jnp.empty((), leaf.dtype)))
        # What was read decides, not what meta.json says about it.
        _compare({name: _describe(array)}, {name: _describe(leaf)})
        on_host = isinstance(leaf, np.ndarray | np.generic)
        placed[name] = array if on_host else jax.device_put(array, getattr(leaf, "sharding", None))
    return placed


def _compare(stored: Mapping[str, str], expected: Mapping[str, str]) -> None:
    for name in [*expected, *stored]:
        have, want = stored.get(name, "missing"), expected.get(name, "no such array")
        if have != want:
            raise CheckpointError(f"{name} is {have}, expected is {want} (another configuration?)")


def _set_aside(path: Path) -> None:
    """Renames an unusable checkpoint so that it is neither tried again nor lost."""
    aside = path.with_name(f"{path.name}.unusable")
    if aside.is_dir():
        shutil.rmtree(aside)
    if os.path.lexists(path):
        os.rename(path, aside)


def _score(path: Path) -> float:
    """Reads a checkpoint's score; -inf where there is none or it cannot be read."""
    try:
        score = float(json.loads((path / "meta.json").read_text(encoding="utf-8"))["meta"]["score"])
    except Exception:  # an unreadable checkpoint is never the best; `restore` is what reports it
        return -math.inf
    return score if math.isfinite(score) else -math.inf


def _one_line(error: BaseException) -> str:
    text = one_line(error)
    if not isinstance(error, CheckpointError | durable.DamageError | OSError):
        text = f"{type(error).__name__}: {text}"
    return text if len(text) <= 300 else f"{text[:145]} ... {text[-150:]}"  # a reason may be at either end
