"""Settings of the memory allocator: one heap for all threads, and freed memory is kept."""

import os
import platform
import runpy
import subprocess
import sys

import pytest

from rsvib_torch.stacks import heap

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
        command = [sys.executable, "-c", _COUNT, heap.__file__, choice]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        heaps[choice] = done.stdout.count("<heap nr=")
    assert heaps["one"] == 1
    assert heaps["own"] > 3


def test_other_c_libraries_are_not_changed(monkeypatch):
    monkeypatch.setattr(platform, "libc_ver", lambda: ("", ""))
    functions = runpy.run_path(heap.__file__)
    assert not functions["share_one_heap"]()
    assert not functions["keep_freed_memory"]()


_FAULTS = """
import ctypes, os, resource, runpy, sys
heap = runpy.run_path(sys.argv[1])
if sys.argv[2] == "kept":
    assert heap["keep_freed_memory"]()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    bytearray(8_000_000)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_freed_memory_is_kept_in_dask_workers():
    faults = {}
    for choice in ("kept", "returned"):
        command = [sys.executable, "-c", _FAULTS, heap.__file__, choice]
        environment = {**os.environ, "MALLOC_TRIM_THRESHOLD_": "65536"}  # as Dask starts its workers
        done = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
        faults[choice] = int(done.stdout)
    assert faults["returned"] > 20_000
    assert faults["kept"] < 5_000
