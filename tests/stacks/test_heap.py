"""Settings of the memory allocator: one heap for all threads, and freed memory is kept."""

import os
import platform
import subprocess
import sys

import pytest

from rsvib_torch.stacks import heap

_MEASURE = """
import ctypes, resource, runpy, sys, threading
if sys.argv[2] == "set":
    runpy.run_path(sys.argv[1])["share_one_heap"](keep_freed=True)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    bytearray(8_000_000)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before, flush=True)
libc = ctypes.CDLL(None)
libc.malloc.restype = libc.fopen.restype = ctypes.c_void_p
barrier = threading.Barrier(4)
threads = [threading.Thread(target=lambda: (libc.malloc(1000), barrier.wait())) for _ in range(4)]
for thread in threads: thread.start()
for thread in threads: thread.join()
file = ctypes.c_void_p(libc.fopen(b"/dev/stdout", b"a"))
libc.malloc_info(0, file)
libc.fflush(file)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_threads_share_one_heap_and_freed_memory_is_kept():
    faults, heaps = {}, {}
    for choice in ("set", "default"):
        environment = {**os.environ, "MALLOC_TRIM_THRESHOLD_": "65536"}  # as Dask starts its workers
        command = [sys.executable, "-c", _MEASURE, heap.__file__, choice]
        done = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
        faults[choice], heaps[choice] = int(done.stdout.split("\n")[0]), done.stdout.count("<heap nr=")
    assert faults["set"] < 5_000
    assert faults["default"] > 20_000
    assert heaps["set"] == 1
    assert heaps["default"] > 3
