#!/usr/bin/env python
"""Published recordings of moving cameras compared with their gyroscopes.

The recordings are not part of this project. FOLDER holds phone_gyro (61 frames of a phone behind a windscreen, with its
gyroscope; github.com/lhaippp/gyro-video-stabilization) and drone_gyro/karma.mp4 (a flying drone with a GPMF track;
github.com/gopro/gpmf-parser).

phone: axes, bias, clock, focal length and row time are fitted; the difference between frames and gyroscope is printed
frame by frame and band by band. The dashboard in the lower third is left out by ``ignore``, or left to the robust
weights.

drone: the gyroscope shows a line near 167 Hz, or its alias above half of the sample rate. The line, times an unknown
complex factor, is fitted to the offsets of the row bands of all frames: its amplitude in the image with standard
deviation.
"""

import argparse
import csv
import sys
from pathlib import Path

import numpy as np
import torch
from scipy.signal import hilbert

import rsvib_torch as rsv

PHONE_EXPOSURE, DRONE_EXPOSURE = 5.248e-3, 4.870e-3  # s; published, and stated in the GPMF track
PHONE_CAMERA = rsv.Camera(574.0, principal_point=(406 - 399.5, 309 - 299.5))  # published
SCENE_ROWS = 400  # of the phone's 600; the dashboard is below
LINE_WIDTH = 4.0  # Hz, half the width of the band around the line


def phone(folder: Path, figure: Path | None) -> None:
    """Frames and gyroscope of the phone."""
    with (folder / "frames.csv").open(newline="") as text:
        rows = list(csv.DictReader(text))
    times = np.array([float(row["time_s"]) for row in rows])
    frames = torch.cat([rsv.read_stack(folder / f"frame_{row['frame']}.jpg") for row in rows])
    rates = rsv.read_gyroscope(folder / "gyroscope.csv")
    row_time = 30e-6  # s, start value
    dashboard = torch.zeros(frames.shape[-2:], dtype=torch.bool)
    dashboard[SCENE_ROWS:] = True
    half = len(times) // 2
    for name, part, ignore, camera in (
        ("dashboard ignored", slice(None), dashboard, PHONE_CAMERA),
        ("dashboard ignored, focal length known", slice(None), dashboard, PHONE_CAMERA),
        ("robust weights only", slice(None), None, PHONE_CAMERA),
        ("dashboard ignored, first half", slice(0, half + 1), dashboard, PHONE_CAMERA),
        ("dashboard ignored, second half", slice(half, None), dashboard, PHONE_CAMERA),
    ):
        own = times[part]
        rows_per_frame = (own[-1] - own[0]) / (len(own) - 1) / row_time
        timing = rsv.SensorTiming(row_time, PHONE_EXPOSURE / row_time, rows_per_frame, frame_start_times=own.tolist())
        found = rsv.align_motion(
            frames[part],
            timing,
            rates,
            camera=camera,
            offsets=(-0.05, 0.07),
            fit_gain="known" not in name,
            fit_row_time=True,
            ignore=ignore,
        )
        print(f"phone, {name}:\n{found}")
        _compare(found)
        if figure is not None and name == "dashboard ignored":
            found.plot(figure)
            print(f"figure: {figure}")


def _compare(found: rsv.RotationAlignment) -> None:
    """Print the differences between frames and gyroscope."""
    rest = (found.measured - found.predicted).square().mean(0).sqrt().tolist()
    rows = found.unexplained_rows.tolist()
    r = [float(torch.corrcoef(torch.stack([found.measured[:, k], found.predicted[:, k]]))[0, 1]) for k in range(3)]
    print(f"  rms difference frame by frame: {rest[0]:.3f} px, {rest[1]:.3f} px, roll {1e3 * rest[2]:.3f} mrad")
    print(f"  rms difference of single bands: {rows[0]:.3f} px, {rows[1]:.3f} px")
    print(f"  correlation frame by frame: {r[0]:.4f}, {r[1]:.4f}, roll {r[2]:.4f}")
    along = ", ".join(f"{value:.3f}" for value in found.translation.tolist())
    print(f"  translation along ({along}), parallax {found.parallax:.4f}\n", flush=True)


def drone(path: Path, most: int) -> None:
    """The line of the drone's gyroscope in its frames."""
    rates = rsv.read_gyroscope(path)
    info = rsv.read_stack_info(path)
    frames = rsv.read_stack(path)[:most]
    row_time = 30e-6  # s, start value
    timing = rsv.SensorTiming(
        row_time, DRONE_EXPOSURE / row_time, 1001 / 30000 / row_time, frame_start_times=info.frame_times[:most]
    )
    found = rsv.align_motion(frames, timing, rates, offsets=(-0.5, 0.5), fit_row_time=True)
    print(f"drone, {len(frames)} frames:\n{found}")
    _compare(found)
    curve = rsv.register_bands(frames, timing, method="phase")
    for row_time in sorted({15e-6, 30e-6, 45e-6, 60e-6, found.row_time}):
        line(found, rates, curve, row_time)


def line(found: rsv.RotationAlignment, rates: rsv.AngularRates, curve: rsv.OffsetCurve, row_time: float) -> None:
    """Amplitude of the line and of its alias in the offsets of the bands, for one row time."""
    samples, times = rates.rates.numpy(), rates.times.numpy()
    rate = (len(times) - 1) / (times[-1] - times[0])
    spectrum = np.fft.rfft(samples * np.hanning(len(samples))[:, None], axis=0)
    frequency = np.fft.rfftfreq(len(samples), 1 / rate)
    high = frequency > 120
    centre = float(frequency[high][np.abs(spectrum[high]).sum(1).argmax()])
    whole = np.fft.rfft(samples, axis=0) * (np.abs(frequency - centre) < LINE_WIDTH)[:, None]
    slow = hilbert(np.fft.irfft(whole, len(samples), axis=0), axis=0) * np.exp(-2j * np.pi * centre * times)[:, None]
    letters = [("xyz".index(letter.lower()), 1.0 if letter.isupper() else -1.0) for letter in found.orientation]
    camera = np.stack([sign * slow[:, column] for column, sign in letters], -1)  # pitch, yaw, roll rates
    starts = torch.tensor(curve.times.numpy() - curve.rows.numpy() * 30e-6)[:, 0].numpy()  # of the frames
    after = torch.tensor(curve.later_times.numpy() - curve.rows.numpy() * 30e-6)[:, 0].numpy()
    offsets, rows = curve.offsets.numpy(), curve.rows.numpy()
    for name, hertz, envelope in (("line", centre, camera), ("alias", rate - centre, camera.conj())):
        omega = 2 * np.pi * hertz
        angle = envelope[:, [1, 0]] * np.array([-1.0, 1.0]) * found.focal_length / (1j * omega)  # px along x, y
        exposed = np.sinc(hertz * DRONE_EXPOSURE)
        predicted = np.zeros((*offsets.shape[:2], 2), complex)
        for start, sign in ((after, 1.0), (starts, -1.0)):
            shift = offsets[..., 1] * row_time * (sign > 0)
            t = start[:, None] + rows * row_time + np.nan_to_num(shift) + DRONE_EXPOSURE / 2
            clock = found.scale * t + found.offset
            for axis in range(2):
                slowly = np.interp(clock, times, angle[:, axis].real) + 1j * np.interp(
                    clock, times, angle[:, axis].imag
                )
                predicted[..., axis] += sign * exposed * slowly * np.exp(1j * omega * clock)
        for axis, label in enumerate("xy"):
            amplitude, std, expected = _fitted(offsets[..., axis], predicted[..., axis], rows, angle[:, axis], exposed)
            print(
                f"  row time {1e6 * row_time:.1f} us, {name} {hertz:.2f} Hz, {label}: {amplitude:.4f} ± {std:.4f} px "
                f"(gyroscope: {expected:.4f} px; 95 % limit {amplitude + 2 * std:.4f} px)",
                flush=True,
            )


def _fitted(offsets, predicted, rows, angle, exposed):
    """Amplitude in px after the exposure, standard deviation, and the amplitude by the gyroscope.

    A cubic polynomial in the row is fitted to every pair of frames as well: other motion of the camera.
    """
    smooth = np.polynomial.legendre.legvander(2 * rows / rows.max() - 1, 3)
    values, lines, counted = [], [], 0
    for pair in range(len(offsets)):
        good = np.isfinite(offsets[pair])
        if good.sum() < 12:
            continue
        basis, _ = np.linalg.qr(smooth[good])
        data = np.stack([offsets[pair, good], predicted[pair, good].real, -predicted[pair, good].imag], -1)
        data = data - basis @ (basis.T @ data)
        limit = 4.5 * np.median(np.abs(data[:, 0])) + 1e-9  # outliers
        data = data[np.abs(data[:, 0]) < limit]
        values.append(data[:, 0])
        lines.append(data[:, 1:])
        counted += len(data) - 4
    y, A = np.concatenate(values), np.concatenate(lines)
    gain, *_ = np.linalg.lstsq(A, y, rcond=None)
    variance = 2.0 * ((y - A @ gain) ** 2).sum() / counted  # bands overlap by half
    size = np.sqrt((np.abs(angle) ** 2).mean()) * abs(exposed)  # amplitude
    std = np.sqrt(variance * np.linalg.inv(A.T @ A).diagonal().mean())
    return float(np.hypot(*gain) * size), float(std * size), float(size)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", choices=["phone", "drone"])
    parser.add_argument("--frames", type=int, default=362, help="frames of the drone")
    parser.add_argument("--figure", type=Path, help="picture of the phone's motion to write")
    options = parser.parse_args()
    phone_folder, video = options.folder / "phone_gyro", options.folder / "drone_gyro" / "karma.mp4"
    if not phone_folder.is_dir() or not video.is_file():
        print(f"{options.folder}: phone_gyro or drone_gyro/karma.mp4 not there", file=sys.stderr)
        return 2
    if options.only in (None, "phone"):
        phone(phone_folder, options.figure)
    if options.only in (None, "drone"):
        drone(video, options.frames)
    return 0


if __name__ == "__main__":
    sys.exit(main())
