#!/usr/bin/env python
"""Free-form motion on a measured jitter profile: Mars Reconnaissance Orbiter's, its time axis compressed.

The profile is not part of this project. FILE is mroJitter.txt as the planetary software ISIS writes it (sample offset
px, line offset px, time s; image PSP_008469_2040). Frames of drawn cities, or of the images given, are taken by the
independent camera of the tests while the profile goes by in a fraction of a second.

What frames cannot tell is a warp w that is fixed to the scene: frames that show row s of a scene at r = s + Y(r) show
row s - w(s) of a warped scene at the same r if the motion is larger by w(s). So w is what the errors of the rows that
show one scene row have in common. Printed, in px rms for x and y over all rows:

  offsets   error of the offsets between any two frames that the motion predicts: where content at each row of the one
            lies in the other. Nothing is taken out here, and no warp changes it. Also for no motion, and half of it
  seen      error less w, and what is stated for it
  by rows   error less its mean over the frames at equal rows of the frames: w enters where it has moved
  all       error less its mean over the record, and what is stated for w

and PSNR in dB of the frames as they are, restored with the truth, with what was found less w, and with what was found.
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
    (60, 8, 512, 3e-5),  # one tone turns once a frame: blind
)


def profile(path: Path) -> tuple[Array, Array]:
    """Times from the first, and displacement (N, 2) less its mean."""
    lines = [
        line.split() for line in path.read_text().splitlines() if line.strip() and line.strip()[0] in "-0123456789"
    ]
    table = np.array(lines, dtype=float)
    return table[:, 2] - table[0, 2], table[:, :2] - table[:, :2].mean(0)


class Jitter(Motion):
    """The profile, its time axis compressed; it stands still after its end."""

    def __init__(self, times: Array, path: Array, squeeze: float) -> None:
        object.__setattr__(self, "curve", CubicSpline(times / squeeze, path))
        object.__setattr__(self, "end", times[-1] / squeeze)

    def displacement(self, moments: Array) -> Array:
        """Displacement in px at moments in seconds."""
        return np.asarray(self.curve(np.clip(moments, 0, self.end)))  # type: ignore[attr-defined]


def scene_of(source: int | Path, height: int, width: int) -> Array:
    """A drawn city, or the middle of an image, its brightness within 0 ... 1."""
    if isinstance(source, int):
        return draw_scene(height, width, source)
    image = rsv.read_stack(source, full_scale=65535)[0].double().numpy()
    image = image.mean(0) if image.ndim == 3 else image
    top, left = ((size - wanted) // 2 for size, wanted in zip(image.shape, (height, width), strict=True))
    part = image[top : top + height, left : left + width]
    low, high = np.percentile(part, [0.5, 99.5])
    return np.clip((part - low) / (high - low), 0.0, 1.0)


def told(values: Array) -> str:
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
    print(f"x{squeeze:g}, {frames} frames of {rows} rows, {timing.frame_rate:.0f} a second, scene {name}:", end=" ")
    print(f"moves by {told(rms(truth - truth.mean((0, 1))))}")
    still, half = (offset_error(part * truth, truth) for part in (0.0, 0.5))
    print(f"    offsets {told(offset_error(motion, truth))}; none {told(still)}; half {told(half)}")
    print(f"    seen {told(rms(seen))} (stated {told(found.std_seen.numpy())}); by rows", end=" ")
    print(f"{told(rms(error - error.mean(0)))}; all {told(rms(error))} (stated {told(found.unseen.numpy())})")
    sharp = crop(scene, MARGIN)
    values = [f"{decibel(taken.numpy(), sharp, RIM):.2f} as taken"]
    for label, path in (("truth", truth), ("found less w", truth + seen), ("found", motion)):
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
            print(f"{path} is not there", file=sys.stderr)
            return 2
    curve = profile(options.file)
    for source in options.images or SEEDS:
        for setting in SETTINGS:
            trial(source, curve, *setting)
    return 0


if __name__ == "__main__":
    sys.exit(main())
