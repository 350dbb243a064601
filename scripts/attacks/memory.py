"""Runs with a memory limit for every layout of a stack: the peak memory must not exceed the limit."""

import json
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from attacks.files import Counts, vibrating_counts, write_hdf5, write_stack, write_tiff
from attacks.trial import Trial, outcome_of_command, rsvib, run_watched

import rsvib_torch as rsv
from rsvib_torch.stacks.memory import memory_needed

_SIZE, _FRAMES, _WINDOW = 512, 64, 4  # px; 34 MB of 16 bits
_FRAME, _STACK = (1, _SIZE, _SIZE), (_FRAMES, _SIZE, _SIZE)  # shapes of chunks
_TIMING = rsv.SensorTiming(row_time=4e-5, exposure_rows=20, frame_rows=560)
_CAMERA = """
[sensor]
row_time = 4e-5
exposure_rows = 20
frame_rows = 560
full_scale = 4095

[detection]
method = "bands"
tones = 1

[restoration]
"""


# Layout, name of the file, and function that writes it.
LAYOUTS: dict[str, tuple[str, Callable[[Path, Counts], None]]] = {
    "TIFF, contiguous": ("a.tif", partial(write_tiff, contiguous=True)),
    "TIFF, pages, zlib": ("b.tif", partial(write_tiff, metadata={}, compression="zlib")),
    "TIFF, tiled, zlib": ("c.tif", partial(write_tiff, metadata={}, compression="zlib", tile=(64, 64))),
    "npy, C order": ("f.npy", np.save),
    "HDF5, contiguous": ("h.h5", write_hdf5),
    "HDF5, chunk per frame": ("i.h5", partial(write_hdf5, chunks=_FRAME, compression="gzip")),
    "HDF5, one chunk": ("j.h5", partial(write_hdf5, chunks=_STACK, compression="gzip", compression_opts=1)),
    "HDF5, automatic chunks": ("k.h5", partial(write_hdf5, chunks=True, compression="lzf")),
    "PNG folder": ("p", write_stack),
    "video": ("q.mkv", write_stack),
}


def _restored(folder: Path) -> Counts:
    counts: Counts = tifffile.imread(folder / "out" / "restored.tif")
    return counts


def _trial(folder: Path, name: str, file: str, restoration: dict[str, Any], expected: Counts | None) -> Trial:
    """Run ``rsvib run --memory`` with the smallest limit that it accepts.

    A run that needs more than its limit has the outcome ``memory``; if its output differs from what is expected,
    ``wrong``.
    """
    limit = memory_needed(rsv.read_stack_info(folder / file), _WINDOW, restoration)
    keys = "".join(f"{key} = {json.dumps(value)}\n" for key, value in restoration.items())
    (folder / "camera.toml").write_text(_CAMERA + keys, encoding="utf-8")
    command = rsvib("run", file, "out", "--config", "camera.toml", "--window", str(_WINDOW), "--quiet", "--overwrite")
    run = run_watched([*command, "--memory", str(limit)], limit=300.0, folder=folder)
    detail = f"{100 * run.peak_memory / limit:.0f} % of {limit / 1e6:.0f} MB, {run.seconds:.0f} s"
    outcome = outcome_of_command(run)
    if outcome != "completed":
        return Trial(name, "wrong" if outcome == "refused" else outcome, f"{run.output.strip()[-200:]}, {detail}")
    if run.peak_memory > limit:
        return Trial(name, "memory", detail)
    same = expected is None or np.array_equal(_restored(folder), expected)
    return Trial(name, "completed" if same else "wrong", detail)


def trials(folder: Path, count: int, seed: int) -> Iterator[Trial]:
    """Stacks in different layouts, with the same result; the last trial restores a quarter with ``scale=2``."""
    counts = vibrating_counts(_TIMING, _FRAMES, (_SIZE, _SIZE), seed)
    expected = None
    for name in list(LAYOUTS)[:count]:
        file, write = LAYOUTS[name]
        write(folder / file, counts)
        trial = _trial(folder, name, file, {"method": "dewarp"}, expected)
        if expected is None and trial.outcome == "completed":
            expected = _restored(folder)
        yield trial
    np.save(folder / "finer.npy", counts[: _FRAMES // 4])
    trial = _trial(folder, "scale 2", "finer.npy", {"scale": 2, "joint": True}, None)
    if trial.outcome == "completed" and _restored(folder).shape[1:] != (2 * _SIZE, 2 * _SIZE):
        trial = Trial(trial.name, "wrong", trial.detail)
    yield trial
