"""Lets several processes share one run: they find each other, exchange data, and end together.

With one process, which is the ordinary case, nothing here talks to anybody. Several processes each step their own
environments and take part in one update over all devices. Process 0 alone reads and writes the run's directory and
sends the others what it read, so that no shared file system is needed.

A process that dies or hangs leaves the others waiting in a collective. So a thread watches each process. If that has
waited for `distributed.timeout`, or a collective fails, process 0 writes the last state that all had reached as a
checkpoint. Each process says why in one line and ends with exit code 75 (try again). If process 0 is the one that
died, another process that sees the run's directory writes the checkpoint.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, TypeVar
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jaxlib import _jax

from foajax.config.parse import ConfigError, flatten, one_line, refuse, to_mapping
from foajax.config.schema import Config, check_address, check_shares
from foajax.launch import coordinator

T = TypeVar("T")

EXIT_CODE = 75  # the system's "temporary failure": start the same command again
_STARTING = 300  # seconds that processes wait for each other until all have started
_OWN = ("run", "distributed.", "env.threads", "env.timeout")  # keys that each process may have its own value for
_KEEPALIVE = 10  # times `distributed.timeout` until JAX's own watch ends a process: ours comes first


class Job:
    """The processes of a run and this one's place among them."""

    def __init__(self, config: Config) -> None:
        self.index, self.count = jax.process_index(), jax.process_count()
        # Gloo gives processes half a minute for their first exchange: now, before each compiles at its own pace.
        self.gather(np.zeros(1))
        self.local_devices = _local_devices(config)
        by_process = [jax.local_devices(process_index=i)[: config.train.devices] for i in range(self.count)]
        self.devices = [device for devices in by_process for device in devices]
        check_shares(
            config,
            len(self.devices),
            "train.devices",
            f"{config.train.devices} in {self.count} processes" if self.count > 1 else config.train.devices,
        )

    @property
    def is_first(self) -> bool:
        """Whether this process reads, writes and speaks for the run."""
        return self.index == 0

    def gather(self, tree: Any) -> Any:
        """Concatenates the arrays of all processes along their leading axis; on the host if there are several."""
        if self.count == 1 or not jax.tree.leaves(tree):
            return tree
        return _by_data(_gather, tree)

    def broadcast(self, tree: Any) -> Any:
        """Returns process 0's arrays in every process; the others' arrays give the shapes."""
        if self.count == 1:
            return tree
        return _by_data(multihost_utils.broadcast_one_to_all, tree)

    def local_part(self, tree: Any) -> Any:
        """Returns this process's part of the leading axis: the inverse of `gather`."""
        if self.count == 1:
            return tree

        def part(x: Any) -> Any:
            size = x.shape[0] // self.count
            return x[self.index * size : (self.index + 1) * size]

        return jax.tree.map(part, tree)

    def broadcast_text(self, name: str, text: str) -> str:
        """Returns process 0's `text` in every process. A `name` can be used once."""
        if self.count == 1:
            return text
        client: Any = jax._src.distributed.global_state.client  # no public way leads to it
        if self.is_first:
            client.key_value_set(f"foajax/{name}", text)
        return client.blocking_key_value_get(f"foajax/{name}", 1000 * _STARTING)

    def agree(self, config: Config) -> None:
        """Raises `ConfigError` in every process, unless all were started with the same configuration."""
        if self.count == 1:
            return
        settings = {key: value for key, value in flatten(to_mapping(config)) if not key.startswith(_OWN)}
        first = json.loads(self.broadcast_text("configuration", json.dumps(settings)))
        differ = [key for key in {**settings, **first} if settings.get(key) != first.get(key)]
        others = np.flatnonzero(self.gather(np.array([bool(differ)])))
        if differ:
            key = differ[0]
            raise refuse(key, settings.get(key), f"{first.get(key)}, as in process 0")
        if others.size:
            raise refuse(f"process {others[0]}", accepted="that of process 0", why="has another configuration")

    def run_on_first(self, name: str, task: Callable[[], T]) -> T | None:
        """Runs `task` in process 0 and returns its result there, else None; raises its `ConfigError` everywhere."""
        result, problem = None, ""
        if self.is_first:
            try:
                result = task()
            except ConfigError as error:
                problem = str(error)
        if problem := self.broadcast_text(f"problem: {name}", problem):
            raise ConfigError(problem)
        return result


def start(config: Config) -> Job:
    """Joins the other processes, if the configuration, the environment or SLURM names any.

    Call it before anything else uses JAX's devices. The environment names them by JAX_COORDINATOR_ADDRESS,
    JAX_NUM_PROCESSES and JAX_PROCESS_ID.

    Raises:
      ConfigError: the others are not found, or the devices cannot share the environments.
    """
    others = where(config)
    if others is not None:
        # This service's handler of SIGTERM would replace ours, which saves.
        jax.config.update("jax_enable_preemption_service", False)
        keepalive = math.ceil(_KEEPALIVE * config.distributed.timeout)
        try:
            with mock.patch.object(_jax, "get_distributed_runtime_service", _Service):
                jax.distributed.initialize(
                    **others, initialization_timeout=_STARTING, heartbeat_timeout_seconds=keepalive
                )
        except (RuntimeError, ValueError) as error:
            why = f"cannot be joined ({one_line(error)[:200]})"
            raise refuse("distributed", others, "a coordinator that all processes can reach", why=why) from None
    return Job(config)


class _Service:
    """Runs JAX's coordination service for process 0, in a process that outlives it."""

    def __init__(self, *positional: Any, **named: Any) -> None:
        words = [sys.executable, "-P", coordinator.__file__, json.dumps([positional, named])]
        # It may outlive this process, so it holds no stderr whose end others wait for.
        pipe, nowhere = subprocess.PIPE, subprocess.DEVNULL
        self._process = subprocess.Popen(words, stdin=pipe, stdout=pipe, stderr=nowhere, text=True)
        assert self._process.stdout is not None
        said = self._process.stdout.readline().strip()
        if said != coordinator.READY:
            raise RuntimeError(said or f"the coordination service ended with exit code {self._process.wait()}")

    def shutdown(self) -> None:
        self._process.communicate("done")


def where(config: Config) -> dict[str, Any] | None:
    """Finds the arguments of `jax.distributed.initialize`; None for a process that is alone."""
    stated = config.distributed
    if stated.coordinator is not None:
        return {
            "coordinator_address": stated.coordinator,
            "num_processes": stated.processes,
            "process_id": stated.process,
            "cluster_detection_method": "deactivate",
        }
    if "JAX_COORDINATOR_ADDRESS" in os.environ:
        try:
            count, index = (int(os.environ[f"JAX_{name}"]) for name in ("NUM_PROCESSES", "PROCESS_ID"))
        except (KeyError, ValueError):
            names = "JAX_NUM_PROCESSES and JAX_PROCESS_ID, integers, beside JAX_COORDINATOR_ADDRESS"
            raise refuse("distributed", accepted=names) from None
        check_address("JAX_COORDINATOR_ADDRESS", os.environ["JAX_COORDINATOR_ADDRESS"])
        return {"num_processes": count, "process_id": index, "cluster_detection_method": "deactivate"}
    # A SLURM step of one task is a run of its own, whatever else its job holds.
    if int(os.environ.get("SLURM_STEP_NUM_TASKS", "1")) > 1:
        local = {"local_device_ids": list(range(config.train.devices))} if config.train.devices > 1 else {}
        return {"cluster_detection_method": "slurm", **local}
    return None


def _local_devices(config: Config) -> list[jax.Device]:
    wanted, there = config.train.devices, jax.local_devices()
    if wanted > len(there):
        hint = " (JAX_NUM_CPU_DEVICES=N makes a CPU look like N)" if there[0].platform == "cpu" else ""
        raise refuse("train.devices", wanted, f"up to {len(there)} here, {there[0].platform}{hint}")
    return there[:wanted]


def _gather(leaves: list[np.ndarray]) -> list[np.ndarray]:
    """Concatenates over processes. All arrays go in one exchange, whose delay costs more than its size."""
    blob = np.frombuffer(b"".join(leaf.tobytes() for leaf in leaves), np.uint8)
    parts = []
    for row in multihost_utils.process_allgather(blob):
        ends = np.cumsum([leaf.nbytes for leaf in leaves])
        pieces = np.split(np.asarray(row), ends[:-1])
        parts.append([p.view(leaf.dtype).reshape(leaf.shape) for p, leaf in zip(pieces, leaves, strict=True)])
    return [np.concatenate(pieces) for pieces in zip(*parts, strict=True)]


def _by_data(function: Callable[[Any], Any], tree: Any) -> Any:
    """Applies `function` to a tree's arrays; typed PRNG keys pass as their data."""
    leaves, structure = jax.tree.flatten(tree)
    keys = [jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) for leaf in leaves]
    data = [jax.random.key_data(leaf) if is_key else leaf for leaf, is_key in zip(leaves, keys, strict=True)]
    results = [np.asarray(result) for result in function([np.asarray(leaf) for leaf in data])]
    wrapped = [jax.random.wrap_key_data(jnp.asarray(r)) if k else r for r, k in zip(results, keys, strict=True)]
    return jax.tree.unflatten(structure, wrapped)


def end_process(code: int) -> int:
    """Returns the exit code; with other processes, ends this one here, as an orderly end would wait for them."""
    if jax.process_count() > 1:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    return code


class PeerWatch:
    """Ends this process if it waits for others in vain.

    Args:
      job: the processes; a single one is not watched.
      timeout: seconds.
      rescue: saves what it can and returns words about it; called at most once, from any thread.
    """

    def __init__(self, job: Job, timeout: float, rescue: Callable[[], str]) -> None:
        self._job, self._timeout, self._rescue = job, timeout, rescue
        self._beat: float | None = None  # the time of the last sign of life; None while nothing is watched
        self._ending = threading.Lock()
        if job.count > 1:
            threading.Thread(target=self._watch, name="watch", daemon=True).start()

    def beat(self) -> None:
        """Gives a sign of life. From the first one on, the next is due within the timeout."""
        self._beat = time.monotonic()

    def rest(self) -> None:
        """Ends the watch until the next sign of life."""
        self._beat = None

    @contextlib.contextmanager
    def expecting_others(self):
        """Ends this process if a collective fails, as it does when another process dies."""
        try:
            yield
        except (jax.errors.JaxRuntimeError, ValueError) as error:
            # Gloo's failures come as either, depending on the call.
            if self._job.count == 1 or (isinstance(error, ValueError) and "Gloo" not in str(error)):
                raise
            self._end(one_line(error)[:160])

    def _watch(self) -> None:
        pause = min(1.0, self._timeout / 10)
        while True:
            before = time.monotonic()
            time.sleep(pause)
            now, beat = time.monotonic(), self._beat
            if beat is not None and now - before > 2 * pause + 1.0:
                self.beat()  # this process itself was stopped for a while: the time does not count
            elif beat is not None and now - beat > self._timeout:
                self._end(f"no progress for {self._timeout:g} s")

    def _end(self, reason: str) -> None:
        if not self._ending.acquire(blocking=False):
            threading.Event().wait()  # the other thread ends the process
        place = f"process {self._job.index} of {self._job.count}"
        try:
            try:
                left = self._rescue()
            except Exception as error:  # whatever it is, this process ends
                left = f"nothing could be saved: {one_line(error)}"
            said = f"{place}: another process died or hangs ({reason}); {left}"
            print(f"foajax: error: {said}", file=sys.stderr, flush=True)
        finally:
            os._exit(EXIT_CODE)  # an orderly end would wait for the others
