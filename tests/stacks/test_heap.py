"""One heap for all threads: none of them keeps memory of its own."""

import platform
import subprocess
import sys
from pathlib import Path

import pytest

import rsvib_torch.stacks.heap

_COUNT = """
import ctypes, os, runpy, sys, threading
heap = runpy.run_path(sys.argv[1])
if sys.argv[2] == "one":
    assert heap["share_one_heap"]()
libc = ctypes.CDLL(None)
libc.malloc.restype = ctypes.c_void_p
threads = [threading.Thread(target=lambda: (libc.malloc(1000), barrier.wait())) for _ in range(4)]
barrier = threading.Barrier(4)
for thread in threads: thread.start()
for thread in threads: thread.join()
libc.fopen.restype = ctypes.c_void_p
file = libc.fopen(b"/dev/stdout", b"w")
libc.malloc_info(0, ctypes.c_void_p(file))
libc.fflush(ctypes.c_void_p(file))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_threads_share_one_heap():
    heaps = {}
    for choice in ("one", "own"):
        command = [sys.executable, "-c", _COUNT, str(Path(rsvib_torch.stacks.heap.__file__)), choice]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        heaps[choice] = done.stdout.count("<heap nr=")
    assert heaps["one"] == 1
    assert heaps["own"] > 3


def test_other_c_libraries_are_left_alone(monkeypatch):
    monkeypatch.setattr(platform, "libc_ver", lambda: ("", ""))
    assert not rsvib_torch.stacks.heap.share_one_heap()
