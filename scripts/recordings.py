#!/usr/bin/env python
"""Measurements on published recordings.

They are not part of this project. FOLDER holds those that are used:

* gyroflow_rollingshutter/frame_example.png (github.com/gyroflow/rollingshutter): a 1000 Hz LED, readout
  15.730 +- 0.004 ms published,
* phone_gyro (github.com/lhaippp/gyro-video-stabilization): 61 frames of a phone behind a windscreen with its gyroscope,
* drone_gyro/karma.mp4 (github.com/gopro/gpmf-parser): a flying drone with a GPMF track,
* revas/tslo-dark.avi, tslo-stim.avi (github.com/lowvisionresearch/ReVAS): scanned videos of a moving eye, 512 rows,
* isis_hirise_jitter/mroJitter.txt: jitter of the Mars Reconnaissance Orbiter, image PSP_008469_2040, as the planetary
  software ISIS writes it (sample and line offset in px, time in s).
"""

import argparse
import csv
import statistics
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from harness import table
from numpy.typing import NDArray
from scipy import ndimage
from scipy.interpolate import CubicSpline

import rsvib_torch as rsv

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from motion_truth import common_warp, offset_error, rms
from truth import Curve, crop, decibel, draw_scene, take_frames

Array = NDArray[np.float64]
PHONE_EXPOSURE, DRONE_EXPOSURE = 5.248e-3, 4.870e-3  # s; published, and stated in the GPMF track
PHONE_CAMERA = rsv.Camera(574.0, principal_point=(406 - 399.5, 309 - 299.5))  # published
SCENE_ROWS = 400  # of the phone's 600; the dashboard below moves with the camera
CLOCK_RANGE = (-0.05, 0.07)  # s, of the phone's gyroscope from the clock of the frames
DRONE_CAMERA = rsv.Camera(400.0)  # px; 94 degrees across, typical of this camera: the amplitude in px scales with it
DRONE_RATE = 30000 / 1001  # frames per second
WINDOW, WINDOWS = 10, 6  # frames of a row time, and row times of a recording


# Row time from light


def light(folder: Path) -> None:
    """Row time from an LED, compared with the published value."""
    frame = rsv.read_stack(folder / "gyroflow_rollingshutter" / "frame_example.png")
    rows = frame.shape[-2]
    found = rsv.calibrate_row_time(frame, 1000.0)
    print(f"LED: {1e6 * found.row_time:.4f} +- {1e6 * found.row_time_std:.4f} us per row")
    for count, name in ((rows - 1, "from the first row to the last"), (rows, "of all rows")):
        readout = 1e3 * found.row_time * count
        print(f"     readout {name}: {readout:.4f} ms, {100 * (readout / 15.730 - 1):+.3f} % from 15.730 +- 0.004 ms")


# Row time from motion


def phone_frames(folder: Path) -> tuple[Array, torch.Tensor]:
    """Times in s and frames of the phone."""
    with (folder / "phone_gyro" / "frames.csv").open(newline="") as text:
        rows = list(csv.DictReader(text))
    frames = [rsv.read_stack(folder / "phone_gyro" / f"frame_{row['frame']}.jpg") for row in rows]
    return np.array([float(row["time_s"]) for row in rows]), torch.cat(frames)


def windows(count: int) -> range:
    """First frames of the windows of a recording."""
    return range(0, count - WINDOW + 1, max(1, (count - WINDOW) // max(1, WINDOWS - 1)))[:WINDOWS]


def row_times(folder: Path) -> None:
    """Row times of windows of frames, whose scatter is an error that does not depend on their standard deviations."""
    times, frames = phone_frames(folder)
    rate = (len(times) - 1) / (times[-1] - times[0])
    found = []
    for first in windows(len(times)):
        result = rsv.calibrate_row_time_by_motion(
            frames[first : first + WINDOW, ..., :SCENE_ROWS, :],
            frame_rate=rate,
            row_time=(5e-6, 1 / (rate * 600)),
            exposure_time=PHONE_EXPOSURE,
        )
        print(f"phone, frames {first} to {first + WINDOW - 1}:\n{result}\n", flush=True)
        if result.row_time is not None:
            found.append(1e6 * result.row_time * (1 if result.readout_direction != "reverse" else -1))
    if len(found) > 1:
        listed = ", ".join(f"{value:.2f}" for value in found)
        spread = f"standard deviation of a window {statistics.stdev(found):.2f} us ({listed})"
        print(f"phone: median {statistics.median(found):.2f} us, {spread}")
    frames = rsv.read_stack(folder / "drone_gyro" / "karma.mp4")
    for first in windows(len(frames)):
        result = rsv.calibrate_row_time_by_motion(frames[first : first + WINDOW], frame_rate=DRONE_RATE)
        print(f"drone, frames {first} to {first + WINDOW - 1}:\n{result}\n", flush=True)


# Gyroscopes


def phone(folder: Path) -> None:
    """Axes, bias, clock, focal length and row time of the phone; difference between frames and gyroscope.

    The dashboard in the lower third is left out by ``ignore``, or left to the robust weights. A figure is written to
    gyroscope_phone.png.
    """
    times, frames = phone_frames(folder)
    rates = rsv.read_gyroscope(folder / "phone_gyro" / "gyroscope.csv")
    row_time = 30e-6  # s, start value
    dashboard = torch.zeros(frames.shape[-2:], dtype=torch.bool)
    dashboard[SCENE_ROWS:] = True
    half = len(times) // 2
    for name, part, ignore in (
        ("dashboard ignored", slice(None), dashboard),
        ("dashboard ignored, focal length known", slice(None), dashboard),
        ("robust weights only", slice(None), None),
        ("dashboard ignored, first half", slice(0, half + 1), dashboard),
        ("dashboard ignored, second half", slice(half, None), dashboard),
    ):
        starts = times[part]
        rows_per_frame = (starts[-1] - starts[0]) / (len(starts) - 1) / row_time
        timing = rsv.SensorTiming(
            row_time, PHONE_EXPOSURE / row_time, rows_per_frame, frame_start_times=starts.tolist()
        )
        found = rsv.align_motion(
            frames[part],
            timing,
            rates,
            camera=PHONE_CAMERA if "known" in name else None,
            offsets=CLOCK_RANGE,
            fit_row_time=True,
            ignore=ignore,
        )
        print(f"phone, {name}:\n{found}")
        print_differences(found)
        if name == "dashboard ignored":
            found.plot(Path("gyroscope_phone.png"))


def print_differences(found: rsv.RotationAlignment) -> None:
    """Print the differences between frames and gyroscope."""
    rest = (found.measured - found.predicted).square().mean(0).sqrt().tolist()
    r = [float(torch.corrcoef(torch.stack([found.measured[:, k], found.predicted[:, k]]))[0, 1]) for k in range(3)]
    print(f"  rms difference frame by frame: {rest[0]:.3f} px, {rest[1]:.3f} px, roll {1e3 * rest[2]:.3f} mrad")
    print(f"  standard deviation of a corner {found.corner_std:.3f} px")
    print(f"  correlation frame by frame: {r[0]:.4f}, {r[1]:.4f}, roll {r[2]:.4f}")
    along = ", ".join(f"{value:.4f}" for value in found.translation.mean(0).tolist())
    print(f"  mean translation between frames over distance ({along})\n", flush=True)


def drone(folder: Path) -> None:
    """Alignment of the drone's gyroscope, which turns too little between frames."""
    path = folder / "drone_gyro" / "karma.mp4"
    rates, times, row_time = rsv.read_gyroscope(path), rsv.read_stack_info(path).frame_times[:60], 30e-6
    frame_rows = 1 / DRONE_RATE / row_time
    timing = rsv.SensorTiming(row_time, DRONE_EXPOSURE / row_time, frame_rows, frame_start_times=list(times))
    found = rsv.align_motion(rsv.read_stack(path)[:60], timing, rates, camera=DRONE_CAMERA, offsets=(-0.1, 0.1))
    print(f"drone, 60 frames:\n{found}")
    print_differences(found)


# A scanned eye


def eye(folder: Path) -> None:
    """Correlation of consecutive frames before and after correction of every row, and closure of the offsets.

    With and without the vignette, which is fixed to the sensor (local mean and contrast removed). Closure: the
    difference between the sum of the offsets p to p + 1 and p + 1 to p + 2 and the offset p to p + 2.
    """
    period, num_rows, rim = 1 / 30, 512, (slice(32, -32), slice(32, -32))

    def offsets(frames: torch.Tensor, first: int, second: int, **options: object) -> tuple[Array, Array]:
        starts = [first * period, second * period]
        timing = rsv.SensorTiming(period / num_rows, 1, num_rows, frame_start_times=starts)
        curve = rsv.register_bands(frames[[first, second]], timing, **options)
        found = curve.offsets[0].numpy()
        good = np.isfinite(found).all(1)
        return curve.rows.numpy()[good], found[good]

    def at(rows: Array, place: Array, values: Array) -> Array:
        return np.stack([np.interp(rows, place, values[:, axis]) for axis in range(2)], axis=-1)

    def evened(frame: Array) -> Array:
        low = ndimage.gaussian_filter(frame, 12.0)
        spread = np.sqrt(ndimage.gaussian_filter((frame - low) ** 2, 12.0))
        return np.asarray((ndimage.gaussian_filter(frame, 1.0) - low) / (spread + 1e-3))

    def correlation(one: Array, other: Array) -> float:
        return float(np.corrcoef(one[rim].ravel(), other[rim].ravel())[0, 1])

    for name in ("tslo-dark.avi", "tslo-stim.avi"):
        stack = rsv.read_stack(folder / "revas" / name)
        frames = stack.mean(1)
        pictures = frames.double().numpy()
        down, across = np.mgrid[: frames.shape[-2], : frames.shape[-1]].astype(float)
        for method, tall in (("ncc", 32), ("phase", 32), ("phase", 48)):
            options, correlations, misfits, sizes = {"method": method, "band_rows": tall}, [], [], []
            for p in range(len(frames) - 1):
                rows, found = offsets(frames, p, p + 1, **options)
                moved = at(np.arange(frames.shape[-2]), rows, found)
                sizes.append(np.abs(moved).mean(0))
                place = [down + moved[:, 1:], across + moved[:, :1]]
                values = []
                for one, other in ((pictures[p], pictures[p + 1]), (evened(pictures[p]), evened(pictures[p + 1]))):
                    back = ndimage.map_coordinates(other, place, order=3, mode="nearest")
                    values += [correlation(one, other), correlation(one, back)]
                correlations.append(values)
                if p + 2 < len(frames):
                    next_rows, step = offsets(frames, p + 1, p + 2, **options)
                    both_rows, both = offsets(frames, p, p + 2, **options)
                    summed = found + at(rows + found[:, 1], next_rows, step)
                    misfits.append(np.abs(summed - at(rows, both_rows, both)))
            raw, after, even, even_after = np.mean(correlations, axis=0)
            apart, size = np.median(np.concatenate(misfits), axis=0), np.mean(sizes, axis=0)
            print(
                f"{name} {method:>5}, bands of {tall} rows: offsets {size[0]:.2f}, {size[1]:.2f} px; "
                f"correlation {raw:.3f} -> {after:.3f}, without vignette {even:.3f} -> {even_after:.3f}; "
                f"closure {apart[0]:.3f}, {apart[1]:.3f} px (median x, y)",
                flush=True,
            )
        found = rsv.detect_vibration(stack, rsv.SensorTiming(period / num_rows, 1, num_rows))
        for axis, reasons in zip("xy", found.reasons, strict=True):
            print(f"    {axis}: {'reliable' if not reasons else 'not reliable: ' + '; '.join(reasons)}")


# Jitter of an orbiter, its time axis compressed

JITTER_MARGIN, JITTER_WIDTH, JITTER_RIM, JITTER_NOISE, JITTER_EXPOSURE = 80, 256, 48, 0.005, 20
JITTER_SETTINGS = (  # compression, frames, rows, row time in s
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


def compressed(times: Array, path: Array, squeeze: float) -> Curve:
    """A measured displacement (N, 2) with a compressed time axis, constant after its end."""
    spline = CubicSpline(times / squeeze, path)
    return Curve(lambda moments: np.asarray(spline(np.clip(moments, 0, times[-1] / squeeze))))


def jitter(folder: Path) -> None:
    """Free motion with the jitter of the orbiter, in frames of drawn cities by the independent camera of the tests.

    Frames do not determine a warp w that is fixed to the scene: frames in which row s of a scene appears at
    r = s + Y(r) are equal to frames of a warped scene, with row s - w(s) at the same r, if the motion is larger by
    w(s). w is therefore the common part of the errors of all rows that contain one scene row. Columns, rms over all
    rows for x and y in px: error of the offsets between any two frames that the motion predicts, which a warp does not
    change, and those of no motion; error minus w ("seen") and its estimated standard deviation; error minus its mean
    over the record and the estimated standard deviation of w. PSNR in dB: input, restored with the true motion, with
    the detected motion minus w, and with the detected motion.
    """
    text = (folder / "isis_hirise_jitter" / "mroJitter.txt").read_text().splitlines()
    measured = np.array([each.split() for each in text if each.strip() and each.strip()[0] in "-0123456789"], float)
    times, path = measured[:, 2] - measured[0, 2], measured[:, :2] - measured[:, :2].mean(0)

    def numbers(values: Array) -> str:
        return ", ".join(f"{value:.3f}" for value in values)

    lines = []
    for seed in (3, 11):
        for squeeze, count, rows, row_time in JITTER_SETTINGS:
            timing = rsv.SensorTiming(row_time=row_time, exposure_rows=JITTER_EXPOSURE, frame_rows=rows)
            moving = compressed(times, path, squeeze)
            scene = draw_scene(rows + 2 * JITTER_MARGIN, JITTER_WIDTH + 2 * JITTER_MARGIN, seed)
            frames = take_frames(scene, timing, moving, count, JITTER_NOISE, margin=JITTER_MARGIN)
            taken = torch.from_numpy(frames).float()
            found = rsv.detect_motion(taken, timing)
            moments = (timing.row_starts(count, rows) + 0.5 * timing.exposure_time).numpy()
            truth = moving.displacement(moments)
            motion = found.motion.displacement(torch.from_numpy(moments)).numpy()
            motion = motion - (motion - truth).mean((0, 1))
            error = motion - truth
            seen = error - common_warp(error, truth)
            sharp = crop(scene, JITTER_MARGIN)
            quality = [decibel(taken.numpy(), sharp, JITTER_RIM)]
            for shape in (truth, truth + seen, motion):
                known = rsv.FreeMotion.from_samples(moments.ravel(), shape.reshape(-1, 2), spacing=8 * row_time)
                restored = rsv.restore(taken, timing, known, check=False)
                quality.append(decibel(restored.numpy(), sharp, JITTER_RIM))
            lines.append(
                (
                    f"x{squeeze}, {count} frames of {rows} rows, {timing.frame_rate:.0f} per second, scene {seed}",
                    numbers(rms(truth - truth.mean((0, 1)))),
                    f"{numbers(offset_error(motion, truth))} ({numbers(offset_error(0 * truth, truth))})",
                    f"{numbers(rms(seen))} ({numbers(found.std_seen.numpy())})",
                    f"{numbers(rms(error))} ({numbers(found.unseen.numpy())})",
                    ", ".join(f"{value:.2f}" for value in quality),
                )
            )
    heads = ("recording", "displacement", "offsets (no motion)", "seen (std)", "all (std of w)", "PSNR")
    print("\n".join(table(heads, lines)))


RECORDINGS: dict[str, tuple[Callable[[Path], None], tuple[str, ...]]] = {  # function, and what it needs in the folder
    "light": (light, ("gyroflow_rollingshutter",)),
    "row_times": (row_times, ("phone_gyro", "drone_gyro")),
    "phone": (phone, ("phone_gyro",)),
    "drone": (drone, ("drone_gyro",)),
    "eye": (eye, ("revas",)),
    "jitter": (jitter, ("isis_hirise_jitter",)),
}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", choices=RECORDINGS, nargs="+", default=list(RECORDINGS), help="default: all")
    options = parser.parse_args(arguments)
    for name in options.only:
        measure, needed = RECORDINGS[name]
        missing = [part for part in needed if not (options.folder / part).is_dir()]
        if missing:
            print(f"{options.folder}: {', '.join(missing)} missing", file=sys.stderr)
            return 2
        measure(options.folder)
    return 0


if __name__ == "__main__":
    sys.exit(main())
