"""Turns signals into requests to stop."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

# SIGUSR1 is a cluster's preemption, SIGHUP a terminal that is closed.
STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP)


def signal_in(numbers: bytes) -> str:
    """Returns the name of the first request to stop among numbers of signals, or an empty text."""
    names = [signal.Signals(number).name for number in numbers if number in STOPS]
    return names[0] if names else ""


def handle_stops(handler: Callable[[int, FrameType | None], None]) -> dict[int, Any]:
    """Has `handler` called for requests to stop; returns the former handlers. Under nohup, SIGHUP stays ignored."""
    heard = [number for number in STOPS if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN]
    return {number: signal.signal(number, handler) for number in heard}


def arrive_here() -> bool:
    """Whether this is the main thread, the only one that Python lets handle signals."""
    return threading.current_thread() is threading.main_thread()


@contextlib.contextmanager
def interrupt_ends() -> Iterator[None]:
    """Makes SIGINT end the process outright, as SIGTERM does, until a `StopRequest` takes it over.

    Python would raise KeyboardInterrupt, which is lost inside a callback, such as JAX's at a garbage collection.
    If SIGINT is ignored or has another handler than Python's, nothing changes.
    """
    before = signal.getsignal(signal.SIGINT)
    if not arrive_here() or before is not signal.default_int_handler:
        yield
        return
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


class StopRequest:
    """Turns the signals of `STOPS` into a flag; a second SIGINT interrupts the rollout too.

    Outside the main thread it hears of no signal. After its `with`, the former handlers are back.
    """

    def __init__(self) -> None:
        self.name: str | None = None
        self._former: dict[int, Any] = {}

    def __enter__(self) -> StopRequest:
        if arrive_here():
            self._former = handle_stops(self._note)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._former.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.name is not None and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.name = signal.Signals(number).name
