"""Memory that is kept, in a process of its own: the setting cannot be taken back."""

import subprocess
import sys

import pytest

PROGRAM = """
import resource, sys
from foajax.allocator import keep_memory
if sys.argv[1] == "kept":
    assert keep_memory()

def touch():
    block = bytearray(64 * 2**20)  # zeroed: every page is touched
    block[::4096] = bytes(len(block) // 4096)

touch()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(5):
    touch()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def page_faults(mode):
    result = subprocess.run([sys.executable, "-c", PROGRAM, mode], capture_output=True, text=True, check=True)
    return int(result.stdout)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the setting is glibc's")
def test_freed_memory_is_used_again_without_page_faults():
    assert page_faults("given back") > 5 * 1000
    assert page_faults("kept") < 500
