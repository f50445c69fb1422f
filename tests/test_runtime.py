"""Memory that is kept, in a process of its own: the setting cannot be taken back."""

import subprocess
import sys

import pytest

PROGRAM = """
import resource, sys, threading
from foajax.runtime import keep_memory
if sys.argv[1] == "kept":
    assert keep_memory()

def touch():
    block = bytearray(80 * 2**20)  # zeroed: every page is touched
    block[::4096] = bytes(len(block) // 4096)

def faults():
    touch()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(5):
        touch()
    print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)

if sys.argv[2] == "thread":
    thread = threading.Thread(target=faults)
    thread.start()
    thread.join()
else:
    faults()
"""


def page_faults(mode, where):
    command = [sys.executable, "-c", PROGRAM, mode, where]
    return int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the settings are glibc's")
@pytest.mark.parametrize("where", ["main", "thread"])
def test_freed_memory_is_used_again_without_page_faults(where):
    assert page_faults("given back", where) > 5 * 1000
    assert page_faults("kept", where) < 500
