"""Ends a run whose environments raise or hang, and one that is asked to stop while it is blocked.

A call that never returns holds the main thread for good, and no signal handler of Python runs there. So a
thread of its own watches. It knows which call of an environment the main thread is in, and hears of signals
through the descriptor that the interpreter writes their numbers to. If it takes over, it saves the state and
exits the process, as nothing else would end a call that does not return.

It cannot help if an engine hangs while it holds the interpreter's lock, or crashes the process. That costs
the time since the last checkpoint.
"""

from __future__ import annotations

import contextlib
import faulthandler
import functools
import os
import select
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax

from foajax.config.parse import ConfigError, one_line
from foajax.config.schema import Config
from foajax.launch.signals import arrive_here, signal_in
from foajax.runs.agents import CHECKPOINTS
from foajax.runs.checkpoints import Checkpoints

FAULT = 3  # exit code: an environment raised or hung; the same command goes on
GRACE = 5.0  # seconds that the main thread has to answer one of them, of the 10 that a cluster may leave
_TICK = 0.5  # seconds between two looks
_METHODS = ("reset", "send", "recv", "close")  # of an environment: what may raise or hang


class EnvironmentFault(Exception):
    """An environment raised. The message is one line that names the environment and its error."""


class Call(NamedTuple):
    """A call that the main thread waits for. Its identity tells it from a later one of the same method."""

    what: str
    timeout: float  # seconds


class Watchdog:
    """Watches until it is closed. It hears of signals where it belongs to the main thread.

    Args:
      timeout: seconds that one call of an environment may take. Only seconds in which this process runs count:
        one that was stopped, or a machine that slept, is not taken for hung.
      abandon: called on the watching thread before the process exits, with what happened (the name of a signal,
        or a line about the call) and the exit code; it returns the code to exit with. The main thread does
        nothing more then, and what it had before the call is whole.
      is_saved: whether nothing is left to save.
      alone: whether to end a process that does not answer a request to stop. Not for several that share a run:
        they stop together, and the end of one would break what the others are in.
    """

    def __init__(
        self,
        timeout: float,
        *,
        abandon: Callable[[str, int], int],
        is_saved: Callable[[], bool],
        alone: bool = True,
    ) -> None:
        self._timeout, self._abandon, self._is_saved, self._alone = timeout, abandon, is_saved, alone
        self._lock = threading.Lock()  # held for good by a watchdog that has taken over
        self._call: Call | None = None
        self._overdue = False  # a request to stop has not been answered in time
        self._closed = False
        self._hear, self._wake = os.pipe()
        os.set_blocking(self._wake, False)
        self._hears = arrive_here()
        self._former = signal.set_wakeup_fd(self._wake, warn_on_full_buffer=False) if self._hears else -1
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends the watch."""
        self._closed = True
        if self._hears:
            signal.set_wakeup_fd(self._former)
        os.write(self._wake, b"\0")
        self._thread.join()
        os.close(self._hear)
        os.close(self._wake)

    def __enter__(self) -> Watchdog:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def watched(self, what: str, function: Callable[..., Any], *, patience: float = 1.0) -> Callable[..., Any]:
        """Wraps an environment's function: errors become `EnvironmentFault`; it has `patience` timeouts to return."""

        @functools.wraps(function)
        def call(*arguments: Any) -> Any:
            self._call = Call(what, patience * self._timeout)
            try:
                if self._overdue:
                    threading.Event().wait()  # the watchdog is about to save and exit
                return function(*arguments)
            except ConfigError:
                raise
            except Exception as error:
                reason = one_line(f"{type(error).__name__}: {error}")
                raise EnvironmentFault(f"{what} raised {reason[:300]}") from error
            finally:
                self._call = None
                with self._lock:  # a watchdog that has taken over does not let go
                    pass

        return call

    def watch(self, environment: Any, name: str) -> None:
        """Watches the calls of an environment from now on."""
        for method in _METHODS:
            setattr(environment, method, self.watched(f"{name}: {method}", getattr(environment, method)))

    def _watch(self) -> None:
        now, seen, waited, asked = time.monotonic(), self._call, 0.0, ""
        since_asked = 0.0
        while not self._closed:
            if select.select([self._hear], [], [], _TICK)[0]:
                asked = asked or signal_in(os.read(self._hear, 64))
            before, now = now, time.monotonic()
            passed = min(now - before, 2 * _TICK)  # after a pause of the process itself one look counts, no more
            call = self._call
            waited = waited + passed if call is not None and call is seen else 0.0
            seen = call
            since_asked += passed if asked else 0.0
            if call is not None and waited > call.timeout:
                self._take_over(call, f"{call.what} has not returned for {call.timeout:g} s (env.timeout)", FAULT)
            elif self._alone and since_asked > GRACE:
                self._overdue = True
                self._take_over(call, asked, 0)

    def _take_over(self, call: Call | None, why: str, code: int) -> None:
        """Saves and exits, unless `call` has returned, or the main thread is in no call and has something to save."""
        with self._lock:
            if self._call is not call or (call is None and not self._is_saved()) or self._closed:
                return
            try:
                code = self._abandon(why, code)
            except BaseException:  # whatever it is, nothing else would end this process, or say so
                traceback.print_exc()
                code = code or 1
            with contextlib.suppress(OSError, ValueError):
                sys.stdout.flush()
            os._exit(code)


def record(run_dir: Path, error: BaseException | None) -> Path:
    """Writes `fault.txt` for a developer: the traceback of `error`, or where every thread is now; returns its path."""
    path = run_dir / "fault.txt"
    with contextlib.suppress(OSError), path.open("w", encoding="utf-8") as file:
        if error is None:
            faulthandler.dump_traceback(file, all_threads=True)
        else:
            traceback.print_exception(error, file=file)
    return path


def report_fault(config: Config, what: str, error: EnvironmentFault | None) -> int:
    """Prints one line about an environment that raised or hung; returns the exit code."""
    run_dir = Path(config.run_dir)
    steps = Checkpoints(run_dir / CHECKPOINTS, keep=None).steps()
    saved = f"saved at {steps[-1]:,} env_steps, the same command goes on from there" if steps else "nothing to save yet"
    if jax.process_index():
        saved = "the first process saves what it can"
    line = f"game={config.game}: {what}; {saved}; details in {record(run_dir, error)}"
    print(f"foajax: error: {line}", file=sys.stderr, flush=True)
    return FAULT
