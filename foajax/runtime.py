"""Sets what holds for a whole process: memory, the compilation cache, where programs run.

Everyone may import it, so only its functions import JAX.
"""

from __future__ import annotations

import ctypes
import os
import sys

_forked = False  # whether this process is the fork of one that had JAX


def _mark_fork() -> None:
    global _forked
    _forked = _forked or "jax" in sys.modules


os.register_at_fork(after_in_child=_mark_fork)


def refuse_fork() -> None:
    """Raises `RuntimeError` in a forked process, where JAX would hang: its threads do not survive a fork."""
    if _forked:
        raise RuntimeError(
            "JAX hangs in a forked process: accepted is multiprocessing with 'spawn' or 'forkserver',"
            " or foajax.numpy, which needs no JAX, with a RingSensor or a LogPolarSensor"
        )


# Parameters of glibc's mallopt (malloc.h).
_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_MAX, _M_ARENA_MAX = -1, -2, -4, -8


def keep_memory() -> bool:
    """Makes the C library keep freed memory for the next allocation; returns whether it does.

    XLA on the CPU allocates a program's temporary arrays at each call. Above 32 MB glibc gives such memory back to
    the system, and each call pays for its pages anew: up to half the time of an update. A thread's own arena never
    keeps a block of 64 MB, so all threads share one: call this before they are started. Only glibc has these switches.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    settings = {_M_MMAP_MAX: 0, _M_TRIM_THRESHOLD: 2**31 - 1, _M_TOP_PAD: 2**26, _M_ARENA_MAX: 1}
    return all(mallopt(name, value) == 1 for name, value in settings.items())


def use_compilation_cache() -> None:
    """Keeps compiled programs for the next start, in JAX_COMPILATION_CACHE_DIR or the user's cache."""
    import jax

    if jax.config.values["jax_compilation_cache_dir"] is None:
        cache = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
        jax.config.update("jax_compilation_cache_dir", os.path.join(cache, "foajax"))


def wait_in_place() -> None:
    """Makes programs on the CPU run in the thread that calls them; without effect once JAX has computed anything.

    JAX hands a program to another thread and back, which takes 40 to 60 us and helps only callers that do not wait.
    """
    import jax

    jax.config.update("jax_cpu_enable_async_dispatch", False)
