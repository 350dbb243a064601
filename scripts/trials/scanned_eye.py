#!/usr/bin/env python
"""Registration of a scanned video of a moving eye, with a vignette that is fixed to the sensor.

The recordings are not part of this project: FOLDER holds tslo-dark.avi and tslo-stim.avi of
github.com/lowvisionresearch/ReVAS (512 rows, 30 frames per second). Printed: correlation of consecutive frames before
and after correction of every row by its offset, with and without the vignette (local mean and contrast removed); the
difference between the sum of the offsets p to p + 1 and p + 1 to p + 2 and the offset p to p + 2; the verdict of
detection.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

import rsvib_torch as rsv
from rsvib_torch.options import Registration

FILES = ("tslo-dark.avi", "tslo-stim.avi")
PERIOD, ROWS, RIM = 1 / 30, 512, 32
METHODS: tuple[tuple[Registration, int], ...] = (("ncc", 32), ("phase", 32), ("phase", 48))

Array = NDArray[np.float64]


def offsets(frames: torch.Tensor, first: int, second: int, method: Registration, tall: int) -> tuple[Array, Array]:
    """Rows and offsets (N, 2) between two frames, without failed bands."""
    timing = rsv.SensorTiming(PERIOD / ROWS, 1, ROWS, frame_start_times=[first * PERIOD, second * PERIOD])
    curve = rsv.register_bands(frames[[first, second]], timing, method=method, band_rows=tall)
    found = curve.offsets[0].numpy()
    good = np.isfinite(found).all(1)
    return curve.rows.numpy()[good], found[good]


def at(rows: Array, place: Array, values: Array) -> Array:
    return np.stack([np.interp(rows, place, values[:, axis]) for axis in range(2)], axis=-1)


def evened(frame: Array) -> Array:
    """A frame without its slow variations."""
    low = ndimage.gaussian_filter(frame, 12.0)
    spread = np.sqrt(ndimage.gaussian_filter((frame - low) ** 2, 12.0))
    return np.asarray((ndimage.gaussian_filter(frame, 1.0) - low) / (spread + 1e-3))


def correlation(one: Array, other: Array) -> float:
    inside = (slice(RIM, -RIM), slice(RIM, -RIM))
    return float(np.corrcoef(one[inside].ravel(), other[inside].ravel())[0, 1])


def report(path: Path, method: Registration, tall: int) -> str:
    frames = rsv.read_stack(path).mean(1)
    pictures = frames.double().numpy()
    down, across = np.mgrid[: frames.shape[-2], : frames.shape[-1]].astype(float)
    correlations: list[list[float]] = []
    misfits, sizes = [], []
    for p in range(len(frames) - 1):
        rows, found = offsets(frames, p, p + 1, method, tall)
        moved = at(np.arange(frames.shape[-2]), rows, found)
        sizes.append(np.abs(moved).mean(0))
        place = [down + moved[:, 1:], across + moved[:, :1]]
        values = []
        for one, other in ((pictures[p], pictures[p + 1]), (evened(pictures[p]), evened(pictures[p + 1]))):
            back = ndimage.map_coordinates(other, place, order=3, mode="nearest")
            values += [correlation(one, other), correlation(one, back)]
        correlations.append(values)
        if p + 2 < len(frames):
            next_rows, step = offsets(frames, p + 1, p + 2, method, tall)
            both_rows, both = offsets(frames, p, p + 2, method, tall)
            misfits.append(np.abs(found + at(rows + found[:, 1], next_rows, step) - at(rows, both_rows, both)))
    raw, after, even, even_after = np.mean(correlations, axis=0)
    apart = np.median(np.concatenate(misfits), axis=0)
    size = np.mean(sizes, axis=0)
    return (
        f"{path.name} {method:>5}, bands of {tall} rows: offsets {size[0]:.2f}, {size[1]:.2f} px; "
        f"correlation {raw:.3f} -> {after:.3f}, without vignette {even:.3f} -> {even_after:.3f}; "
        f"closure {apart[0]:.3f}, {apart[1]:.3f} px (median x, y)"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    missing = [name for name in FILES if not (folder / name).is_file()]
    if missing:
        print(f"{folder}: {', '.join(missing)} missing", file=sys.stderr)
        return 2
    for name in FILES:
        for method, tall in METHODS:
            print(report(folder / name, method, tall), flush=True)
        timing = rsv.SensorTiming(PERIOD / ROWS, 1, ROWS)
        found = rsv.detect_vibration(rsv.read_stack(folder / name), timing)
        for axis, reasons in zip("xy", found.reasons, strict=True):
            print(f"    {axis}: {'reliable' if not reasons else 'not reliable: ' + '; '.join(reasons)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
