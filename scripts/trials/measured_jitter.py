#!/usr/bin/env python
"""Free motion with a measured jitter profile of the Mars Reconnaissance Orbiter, its time axis compressed.

The profile is not part of this project. FILE is mroJitter.txt as the planetary software ISIS writes it (sample offset
px, line offset px, time s; image PSP_008469_2040). Frames of drawn cities, or of the images given, are simulated by the
independent camera of the tests with the profile compressed to a fraction of a second.

Frames do not determine a warp w that is fixed to the scene: frames in which row s of a scene appears at r = s + Y(r)
are equal to frames of a warped scene, with row s - w(s) at the same r, if the motion is larger by w(s). w is therefore
the common part of the errors of all rows that contain one scene row. Printed, in px rms for x and y over all rows:

  offsets   error of the offsets between any two frames that the motion predicts: where content at each row of the one
            lies in the other; not affected by a warp. Also for no motion, and for half of it
  seen      error minus w, and its estimated standard deviation
  by rows   error minus its mean over the frames at equal rows; includes the part of w that has moved
  all       error minus its mean over the record, and the estimated standard deviation of w

and PSNR in dB of the frames: input, restored with the true motion, with the detected motion minus w, and with the
detected motion.
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
from motion_truth import common_warp, offset_error, rms
from truth import Motion, crop, decibel, draw_scene, take_frames

Array = NDArray[np.float64]
MARGIN, WIDTH, RIM = 80, 256, 48
NOISE, EXPOSURE_ROWS = 0.005, 20
SEEDS = (3, 11)
SETTINGS = (  # compression, frames, rows, row time in s
    (30, 8, 512, 4e-5),
    (30, 8, 256, 6e-5),
    (40, 8, 512, 2.4e-5),
    (60, 8, 384, 2.2e-5),
    (60, 10, 256, 4e-5),
    (80, 8, 256, 3e-5),
    (100, 8, 256, 2e-5),
    (100, 8, 512, 1e-5),
    (60, 8, 512, 3e-5),  # includes a blind frequency
)


def profile(path: Path) -> tuple[Array, Array]:
    """Times relative to the first, and displacement (N, 2) minus its mean."""
    lines = [
        line.split() for line in path.read_text().splitlines() if line.strip() and line.strip()[0] in "-0123456789"
    ]
    table = np.array(lines, dtype=float)
    return table[:, 2] - table[0, 2], table[:, :2] - table[:, :2].mean(0)


class Jitter(Motion):
    """The profile with a compressed time axis, constant after its end."""

    def __init__(self, times: Array, path: Array, squeeze: float) -> None:
        object.__setattr__(self, "curve", CubicSpline(times / squeeze, path))
        object.__setattr__(self, "end", times[-1] / squeeze)

    def displacement(self, moments: Array) -> Array:
        """Displacement in px at times in seconds."""
        return np.asarray(self.curve(np.clip(moments, 0, self.end)))  # type: ignore[attr-defined]


def scene_of(source: int | Path, height: int, width: int) -> Array:
    """A drawn city, or the centre of an image, scaled to 0 ... 1."""
    if isinstance(source, int):
        return draw_scene(height, width, source)
    image = rsv.read_stack(source, full_scale=65535)[0].double().numpy()
    image = image.mean(0) if image.ndim == 3 else image
    top, left = ((size - wanted) // 2 for size, wanted in zip(image.shape, (height, width), strict=True))
    part = image[top : top + height, left : left + width]
    low, high = np.percentile(part, [0.5, 99.5])
    return np.clip((part - low) / (high - low), 0.0, 1.0)


def numbers(values: Array) -> str:
    return ", ".join(f"{value:.3f}" for value in values)


def trial(source: int | Path, curve: tuple[Array, Array], squeeze: float, frames: int, rows: int, time: float) -> None:
    timing = rsv.SensorTiming(row_time=time, exposure_rows=EXPOSURE_ROWS, frame_rows=rows)
    jitter = Jitter(*curve, squeeze)
    scene = scene_of(source, rows + 2 * MARGIN, WIDTH + 2 * MARGIN)
    taken = torch.from_numpy(take_frames(scene, timing, jitter, frames, NOISE, margin=MARGIN)).float()
    found = rsv.detect_motion(taken, timing)
    moments = (timing.row_starts(frames, rows) + 0.5 * timing.exposure_time).numpy()
    truth = jitter.displacement(moments)
    motion = found.motion.displacement(torch.from_numpy(moments)).numpy()
    motion = motion - (motion - truth).mean((0, 1))
    error = motion - truth
    seen = error - common_warp(error, truth)
    name = source if isinstance(source, int) else source.stem
    print(f"x{squeeze:g}, {frames} frames of {rows} rows, {timing.frame_rate:.0f} per second, scene {name}:", end=" ")
    print(f"displacement {numbers(rms(truth - truth.mean((0, 1))))}")
    still, half = (offset_error(part * truth, truth) for part in (0.0, 0.5))
    print(f"    offsets {numbers(offset_error(motion, truth))}; none {numbers(still)}; half {numbers(half)}")
    print(f"    seen {numbers(rms(seen))} (estimated {numbers(found.std_seen.numpy())}); by rows", end=" ")
    print(
        f"{numbers(rms(error - error.mean(0)))}; all {numbers(rms(error))} (estimated {numbers(found.unseen.numpy())})"
    )
    sharp = crop(scene, MARGIN)
    values = [f"{decibel(taken.numpy(), sharp, RIM):.2f} input"]
    for label, path in (("truth", truth), ("detected minus w", truth + seen), ("detected", motion)):
        moving = rsv.FreeMotion.from_samples(moments.ravel(), path.reshape(-1, 2), spacing=8 * time)
        values.append(f"{decibel(rsv.restore(taken, timing, moving, check=False).numpy(), sharp, RIM):.2f} {label}")
    print(f"    PSNR {', '.join(values)}", flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("images", type=Path, nargs="*", help="scenes of 672 x 416 px or more; drawn ones if none")
    options = parser.parse_args()
    for path in (options.file, *options.images):
        if not path.is_file():
            print(f"{path} does not exist", file=sys.stderr)
            return 2
    curve = profile(options.file)
    for source in options.images or SEEDS:
        for setting in SETTINGS:
            trial(source, curve, *setting)
    return 0


if __name__ == "__main__":
    sys.exit(main())
