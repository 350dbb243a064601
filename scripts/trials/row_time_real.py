#!/usr/bin/env python
"""Row time of published recordings of moving cameras, from the motion in their frames.

The recordings are not part of this project. FOLDER holds phone_gyro (61 frames of a phone behind a windscreen, with its
gyroscope on the same clock; github.com/lhaippp/gyro-video-stabilization) and drone_gyro/karma.mp4 (a flying drone;
github.com/gopro/gpmf-parser). Their row times are not published. Windows of frames are calibrated one by one: the
scatter of the results is an error that does not depend on the stated standard deviations.
"""

import argparse
import csv
import statistics
import sys
import tempfile
from pathlib import Path

import torch

import rsvib_torch as rsv

SCENE_ROWS = 400  # of the phone's 600; the dashboard below moves with the camera
FOCAL_LENGTH = 574.0  # px, published
CLOCK_RANGE = (-0.05, 0.07)  # s, of the gyroscope's clock from that of the frames


def phone(folder: Path, window: int, windows: int, model: str) -> None:
    """Row time of the phone, with its gyroscope or from the frames alone."""
    with (folder / "frames.csv").open(newline="") as text:
        times = [(folder / f"frame_{row['frame']}.jpg", float(row["time_s"])) for row in csv.DictReader(text)]
    rate = (len(times) - 1) / (times[-1][1] - times[0][1])
    with (folder / "gyroscope.csv").open(newline="") as text, tempfile.TemporaryDirectory() as scratch:
        rates = [(row["time_s"], row["x_rad_s"], row["y_rad_s"]) for row in csv.DictReader(text)]
        table = Path(scratch) / "motion.csv"
        table.write_text("time,x,y\n" + "\n".join(",".join(row) for row in rates) + "\n")
        recorded = rsv.read_motion(table, unit="rad/s", focal_length=FOCAL_LENGTH, signs=(1.0, -1.0))
    found = []
    for first in range(0, len(times) - window + 1, max(1, (len(times) - window) // max(1, windows - 1)))[:windows]:
        part = times[first : first + window]
        frames = torch.cat([rsv.read_stack(path) for path, _ in part])[..., :SCENE_ROWS, :]
        options = {}
        if model == "gyroscope":
            options = {
                "recorded": recorded,
                "offsets": (part[0][1] + CLOCK_RANGE[0], part[0][1] + CLOCK_RANGE[1]),
                "fit_gain": True,
            }
        result = rsv.calibrate_row_time_by_motion(
            frames, frame_rate=rate, row_time=(5e-6, 1 / (rate * 600)), exposure_time=5.248e-3, **options
        )
        print(f"phone, {model}, frames {first} to {first + window - 1}:\n{result}\n", flush=True)
        if result.row_time is not None:
            found.append(1e6 * result.row_time * (1 if result.readout_direction != "reverse" else -1))
    if len(found) > 1:
        print(
            f"phone, {model}: median {statistics.median(found):.2f} us, standard deviation of a window "
            f"{statistics.stdev(found):.2f} us ({', '.join(f'{value:.2f}' for value in found)})"
        )


def drone(path: Path, window: int, windows: int) -> None:
    """Row time of the drone, from the frames alone."""
    count = rsv.read_stack_info(path).shape[0]
    frames = rsv.read_stack(path)
    for first in range(0, count - window + 1, max(1, (count - window) // max(1, windows)))[:windows]:
        result = rsv.calibrate_row_time_by_motion(frames[first : first + window], frame_rate=30000 / 1001)
        print(f"drone, frames {first} to {first + window - 1}:\n{result}\n", flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", choices=["gyroscope", "frames", "drone"])
    parser.add_argument("--window", type=int, default=10, help="frames of a result")
    parser.add_argument("--windows", type=int, default=6, help="results of each recording")
    options = parser.parse_args()
    phone_folder, video = options.folder / "phone_gyro", options.folder / "drone_gyro" / "karma.mp4"
    if not phone_folder.is_dir() or not video.is_file():
        print(f"{options.folder}: phone_gyro or drone_gyro/karma.mp4 not there", file=sys.stderr)
        return 2
    if options.only in (None, "gyroscope"):
        phone(phone_folder, options.window, options.windows, "gyroscope")
    if options.only in (None, "frames"):
        phone(phone_folder, options.window, options.windows, "frames alone")
    if options.only in (None, "drone"):
        drone(video, options.window, options.windows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
