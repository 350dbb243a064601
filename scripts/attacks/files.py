"""Stacks of a small vibrating camera, and functions that write them in layouts of other programs."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import tifffile
import torch
from numpy.typing import NDArray
from small_stack import OPTIONS

import rsvib_torch as rsv

Counts = NDArray[np.uint16]
DETECTION: dict[str, Any] = OPTIONS["detection"]
BANDS: dict[str, Any] = {name: DETECTION[name] for name in ("band_rows", "band_step", "search")}
FULL_SCALE = 4095
_AT_ONCE = 8  # simulated frames; of 64 frames of 512 x 512 px the spectra need 1 GB


def vibrating_counts(timing: rsv.SensorTiming, count: int, size: tuple[int, int], seed: int = 0) -> Counts:
    """Frames (T, H, W) of a vibrating camera, 12 bits."""
    generator = torch.Generator().manual_seed(seed)
    texture = torch.randn(1, 1, size[0] + 64, size[1] + 64, generator=generator)
    scene = 0.5 + 0.2 * torch.nn.functional.avg_pool2d(texture, 3, 1, 1)[0, 0]
    vibration = rsv.Vibration([1.2, 0.8], [130.0, 170.0], [0.3, 0.9])
    counts = np.empty((count, *size), np.uint16)
    starts = timing.frame_starts(count).tolist()
    for first in range(0, count, _AT_ONCE):
        part = replace(timing, frame_start_times=starts[first : first + _AT_ONCE])
        frames = rsv.simulate_frames(scene, part, vibration, min(_AT_ONCE, count - first), frame_size=size)
        frames += 0.002 * torch.randn(frames.shape, generator=generator)
        counts[first : first + _AT_ONCE] = (FULL_SCALE * frames).round().clamp(0, FULL_SCALE).numpy()
    return counts


def write_stack(path: Path, counts: Counts) -> None:
    """Write counts with ``rsvib_torch.write_stack``, in the format of the name."""
    rsv.write_stack(path, counts / np.float32(FULL_SCALE), dtype="uint16", full_scale=FULL_SCALE)


def write_tiff(path: Path, counts: Counts, **options: Any) -> None:
    """Write a TIFF file; without further options like a program that stores no metadata."""
    tifffile.imwrite(path, counts, photometric="minisblack", maxworkers=1, **({"metadata": None} | options))


def write_hdf5(path: Path, counts: Counts, **options: Any) -> None:
    """Write a data set ``frames``."""
    with h5py.File(path, "w") as file:
        file.create_dataset("frames", data=counts, **options).attrs["full_scale"] = float(FULL_SCALE)
