"""Settings of the memory allocator: one heap for all threads, and freed memory is kept."""

import os
import platform
import subprocess
import sys

import pytest

from rsvib_torch.stacks import heap

_COUNT = """
import ctypes, runpy, sys, threading
if sys.argv[2] == "set":
    runpy.run_path(sys.argv[1])["share_one_heap"]()
libc = ctypes.CDLL(None)
libc.malloc.restype = libc.fopen.restype = ctypes.c_void_p
barrier = threading.Barrier(4)
threads = [threading.Thread(target=lambda: (libc.malloc(1000), barrier.wait())) for _ in range(4)]
for thread in threads: thread.start()
for thread in threads: thread.join()
file = ctypes.c_void_p(libc.fopen(b"/dev/stdout", b"w"))
libc.malloc_info(0, file)
libc.fflush(file)
"""
_FAULTS = """
import resource, runpy, sys
if sys.argv[2] == "set":
    runpy.run_path(sys.argv[1])["share_one_heap"](keep_freed=True)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    bytearray(8_000_000)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def output(program, choice):
    environment = {**os.environ, "MALLOC_TRIM_THRESHOLD_": "65536"}  # as Dask starts its workers
    command = [sys.executable, "-c", program, heap.__file__, choice]
    return subprocess.run(command, check=True, capture_output=True, text=True, env=environment).stdout


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_threads_share_one_heap_and_freed_memory_is_kept():
    assert output(_COUNT, "set").count("<heap nr=") == 1
    assert output(_COUNT, "default").count("<heap nr=") > 3
    assert int(output(_FAULTS, "set")) < 5_000
    assert int(output(_FAULTS, "default")) > 20_000
