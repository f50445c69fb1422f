"""Requests to stop, which come as signals."""

from __future__ import annotations

import signal
from types import FrameType

STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)  # the last one is a cluster's preemption


def signal_in(numbers: bytes) -> str:
    """The first request to stop among the numbers of signals, if any."""
    names = [signal.Signals(number).name for number in numbers if number in STOPS]
    return names[0] if names else ""


class StopRequest:
    """Turns SIGINT, SIGTERM and SIGUSR1 (a cluster's preemption) into a flag; a second SIGINT interrupts at once."""

    def __init__(self) -> None:
        self.name: str | None = None
        for number in STOPS:
            signal.signal(number, self._note)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.name is not None and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.name = signal.Signals(number).name
