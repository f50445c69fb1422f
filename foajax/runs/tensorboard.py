"""Writes TensorBoard's files, without a thread."""

from __future__ import annotations

import os
import socket
import struct
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from foajax.runs.durable import WholeFile


class EventFile:
    """TensorBoard's file of one start, opened by the first event; what cannot be written is left out.

    tensorboardX encodes. Its own writer is not used: a full disk ends its thread, and then its queue of ten events
    blocks the caller for good.
    """

    def __init__(self, directory: Path, start_env_steps: int) -> None:
        self._path = directory / f"events.out.tfevents.{int(time.time())}.{socket.gethostname()}.{os.getpid()}"
        self._start = start_env_steps
        self._begun = False
        self._file: WholeFile | None = None

    def scalars(self, record: Mapping[str, Any]) -> None:
        from tensorboardX import summary  # a fifth of a second; seconds where PyTorch is installed too

        values = [(name, value) for name, value in record.items() if name != "env_steps" and value is not None]
        self._append([{"step": record["env_steps"], "summary": summary.scalar(*value)} for value in values])

    def image(self, tag: str, array: np.ndarray, env_steps: int) -> None:
        from tensorboardX import summary

        layout = "HW" if array.ndim == 2 else "HWC"
        self._append([{"step": env_steps, "summary": summary.image(tag, array, dataformats=layout)}])

    def close(self) -> None:
        if self._file is not None:
            self._file.close()

    def _append(self, events: list[dict[str, Any]]) -> None:
        from tensorboardX.proto.event_pb2 import SessionLog

        if self._file is None:
            self._path.parent.mkdir(exist_ok=True)
            self._file = WholeFile(self._path)
        if not self._begun:
            restart = SessionLog(status=SessionLog.START)  # hides what earlier starts logged from this step on
            events = [
                {"file_version": "brain.Event:2"},
                {"step": self._start + 1, "session_log": restart},
                *events,
            ]
        self._file.append(b"".join(map(_record, events)))
        self._begun = True


def _record(event: dict[str, Any]) -> bytes:
    """Encodes an event as TensorBoard's files have it: length, its checksum, content, its checksum."""
    from tensorboardX.proto.event_pb2 import Event
    from tensorboardX.record_writer import masked_crc32c

    content = Event(wall_time=time.time(), **event).SerializeToString()
    length = struct.pack("<Q", len(content))
    return b"".join(
        (length, struct.pack("<I", masked_crc32c(length)), content, struct.pack("<I", masked_crc32c(content)))
    )
