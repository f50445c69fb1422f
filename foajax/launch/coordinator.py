"""Runs JAX's coordination service in a process of its own, which `foajax.launch.processes` starts.

JAX would run it inside process 0. JAX aborts any process that loses the service, without a message and with nothing
saved. So the service outlives process 0 until the others have noticed and saved.

Of JAX it imports only the extension with the service, which takes a fraction of a second.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import sys
import time
from pathlib import Path

from jaxlib import _jax

READY = "ready"  # printed when others can connect; anything else says why they cannot
_LINGER = 30.0  # seconds after the end of process 0
_PAUSE = 0.2
_ESTABLISHED = "01"  # the kernel's name for a connection that is up


def main(arguments: str) -> None:
    """Serves until process 0 writes to stdin and closes it. If process 0 dies instead, waits for the others to end.

    `arguments` are those of JAX's service, as JSON: a list and a mapping.
    """
    # Meant for the run, which needs the service to stop.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    positional, named = json.loads(arguments)
    port = int(positional[0].rpartition(":")[2])
    try:
        _wait_for(port)
        service = _jax.get_distributed_runtime_service(*positional, **named)
    except Exception as error:
        print(" ".join(str(error).split()), flush=True)
        return
    print(READY, flush=True)
    said = sys.stdin.read()
    end = time.monotonic() + _LINGER
    while not said and time.monotonic() < end and _connected(port):
        time.sleep(_PAUSE)
    service.shutdown()


def _wait_for(port: int) -> None:
    """Waits until nobody listens at a port: a lost job's service may linger there, and gRPC would share the port."""
    end = time.monotonic() + _LINGER + 5.0
    while True:
        try:
            with socket.create_server(("", port)):
                return
        except OSError as error:
            if time.monotonic() > end:
                raise OSError(f"port {port}: {os.strerror(error.errno or 0)}") from None
        time.sleep(_PAUSE)


def _connected(port: int) -> bool:
    """Whether anyone is connected to a port of this machine."""
    for table in map(Path, ("/proc/net/tcp", "/proc/net/tcp6")):
        rows = [line.split() for line in table.read_text().splitlines()[1:]] if table.exists() else []
        if any(row[1].endswith(f":{port:04X}") and row[3] == _ESTABLISHED for row in rows):
            return True
    return False


if __name__ == "__main__":
    main(sys.argv[1])
