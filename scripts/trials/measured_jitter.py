#!/usr/bin/env python
"""Free-form motion on a measured jitter profile: Mars Reconnaissance Orbiter's, its time axis compressed.

The profile is not part of this project. FILE is mroJitter.txt as the planetary software ISIS writes it (sample offset
px, line offset px, time s; image PSP_008469_2040). Frames of a drawn city are taken by the independent camera of the
tests while the profile goes by in a fraction of a second. Printed: root-mean-square errors of the detected motion in
px, what is stated for them, and PSNR of frames restored with it and with the truth.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

import rsvib_torch as rsv

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from truth import Motion, crop, decibel, draw_scene, take_frames

Array = NDArray[np.float64]
MARGIN, WIDTH, RIM = 80, 256, 48


def profile(path: Path) -> tuple[Array, Array]:
    """Times from the first, and displacement (N, 2) less its mean."""
    lines = [
        line.split() for line in path.read_text().splitlines() if line.strip() and line.strip()[0] in "-0123456789"
    ]
    table = np.array(lines, dtype=float)
    return table[:, 2] - table[0, 2], table[:, :2] - table[:, :2].mean(0)


def rms(values: Array) -> str:
    return ", ".join(f"{v:.3f}" for v in np.sqrt(np.mean(np.square(values), axis=(0, 1))))


def trial(times: Array, path: Array, squeeze: float, frames: int, rows: int, row_time: float, noise: float) -> None:
    curve = CubicSpline(times / squeeze, path)

    class Jitter(Motion):
        def displacement(self, moments: Array) -> Array:
            return np.asarray(curve(np.clip(moments, 0, times[-1] / squeeze)))

    timing = rsv.SensorTiming(row_time=row_time, exposure_rows=20, frame_rows=rows)
    scene = draw_scene(rows + 2 * MARGIN, WIDTH + 2 * MARGIN, 3)
    taken = torch.from_numpy(take_frames(scene, timing, Jitter(), frames, noise, margin=MARGIN)).float()
    found = rsv.detect_motion(taken, timing)
    moments = (timing.row_starts(frames, rows) + 0.5 * timing.exposure_time).numpy()
    truth = Jitter().displacement(moments)
    error = found.motion.displacement(torch.from_numpy(moments)).numpy() - truth
    error = error - error.mean((0, 1))
    seen = error - error.mean(0)
    print(
        f"x{squeeze:g}, {frames} frames of {rows} rows, {timing.frame_rate:.0f} a second, noise {noise:g}: moves by "
        f"{rms(truth - truth.mean((0, 1)))} px rms"
    )
    stated = ", ".join(f"{v:.3f}" for v in found.std_seen.tolist())
    unseen = ", ".join(f"{v:.3f}" for v in found.unseen.tolist())
    print(f"    error of what can be seen {rms(seen)} px (stated {stated}), of all {rms(error)} px (stated {unseen})")
    still = crop(scene, MARGIN)
    versions = (("truth", truth), ("without what cannot be seen", truth + seen), ("as it is, in place", truth + error))
    told = []
    for name, motion in versions:
        moving = rsv.FreeMotion.from_samples(moments.ravel(), motion.reshape(-1, 2), spacing=8 * row_time)
        told.append(f"{decibel(rsv.restore(taken, timing, moving, check=False).numpy(), still, RIM):.2f} ({name})")
    print(f"    PSNR {decibel(taken.numpy(), still, RIM):.2f} as taken, {', '.join(told)}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    path = parser.parse_args().file
    if not path.is_file():
        print(f"{path} is not there", file=sys.stderr)
        return 2
    times, motion = profile(path)
    for squeeze, frames, rows, row_time in (
        (30, 10, 512, 4e-5),
        (30, 12, 256, 6e-5),
        (60, 15, 512, 1.5e-5),
        (100, 12, 256, 2e-5),
    ):
        trial(times, motion, squeeze, frames, rows, row_time, 0.005)
    return 0


if __name__ == "__main__":
    sys.exit(main())
