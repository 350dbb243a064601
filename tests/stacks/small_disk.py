"""Runs on a full or read-only file system, in a process that is allowed to mount one; prints their results as JSON.

The result of a run contains its error message, whether the output exists, and whether it was resumed to the same bytes.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import torch
from small_stack import process_small

PAGE = 4096


def free_pages(folder):
    disk = os.statvfs(folder)
    return disk.f_bavail * disk.f_frsize // PAGE


def leave_free(folder, pages):
    """Fill the disk except for a number of pages."""
    with (folder / "ballast").open("wb") as file:
        file.write(b"b" * (PAGE * (free_pages(folder) - pages)))
    assert abs(free_pages(folder) - pages) <= 1


def content(path):
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    return {str(file.relative_to(path)): file.read_bytes() for file in files}


def try_small_disk(source, whole, disk, name, pages):
    """A run on a disk with a number of free pages; 0: that is read-only."""
    leave_free(disk, pages)
    if pages == 0:
        subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
    message = "done"
    try:
        process_small(source, disk / "new" / name)
    except OSError as error:
        message = str(error)
    exists = (disk / "new" / name).exists()
    if pages == 0:
        subprocess.run(["mount", "-o", "remount,rw", disk], check=True)
    (disk / "ballast").unlink()
    process_small(source, disk / "new" / name, resume=True)
    same = content(disk / "new" / name) == content(whole / name)
    for path in sorted((disk / "new").rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()
    (disk / "new").rmdir()
    return {"message": message, "output_exists": exists, "same": same}


def main():
    source, whole, disk, trials = Path(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]), json.loads(sys.argv[4])
    torch.set_num_threads(1)
    results = [try_small_disk(source, whole, disk, *trial) for trial in trials]
    print(json.dumps({"runs": results}))


if __name__ == "__main__":
    main()
