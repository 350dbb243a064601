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
DRONE_CAMERA = rsv.Camera(400.0)  # px; 94 degrees across, typical of this camera: the amplitude in px scales with it
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
    times = rsv.read_stack_info(path).frame_times[:most]
    frames = rsv.read_stack(path)[:most]
    timing = _drone_timing(30e-6, times[:60])
    found = rsv.align_motion(frames[:60], timing, rates, camera=DRONE_CAMERA, offsets=(-0.1, 0.1))
    print(f"drone, 60 frames:\n{found}")
    _compare(found)
    curve = rsv.register_bands(frames, _drone_timing(30e-6, times), method="phase")
    print(f"drone, line in {len(frames)} frames (amplitudes in px, before the average over the exposure)")
    for row_time in (20e-6, 30e-6, 40e-6, 50e-6, 60e-6):
        line(rates, curve.offsets.numpy(), curve.rows.numpy(), np.array(times), row_time)


def _drone_timing(row_time: float, times: tuple[float, ...]) -> rsv.SensorTiming:
    return rsv.SensorTiming(row_time, DRONE_EXPOSURE / row_time, 1001 / 30000 / row_time, frame_start_times=list(times))


def line(rates: rsv.AngularRates, offsets, rows, frame_times, row_time: float) -> None:
    """Amplitude of the line and of its alias in the offsets of the bands, for one row time.

    The axis with the largest line gives its phase; the factor between it and the image is unknown. The times of
    the gyroscope are those of the packets in the video; the clocks agree to 2e-4, by the exposures in the file.
    """
    samples, times = rates.rates.numpy(), rates.times.numpy()
    rate = (len(times) - 1) / (times[-1] - times[0])
    frequency = np.fft.rfftfreq(len(samples), 1 / rate)
    spectrum = np.abs(np.fft.rfft(samples * np.hanning(len(samples))[:, None], axis=0)) * (frequency > 120)[:, None]
    centre, axis = frequency[spectrum.max(1).argmax()], spectrum.max(0).argmax()
    near = np.fft.rfft(samples[:, axis]) * (np.abs(frequency - centre) < LINE_WIDTH)
    envelope = hilbert(np.fft.irfft(near, len(samples))) * np.exp(-2j * np.pi * centre * times)
    for name, hertz, slow in (("line", centre, envelope), ("alias", rate - centre, envelope.conj())):
        angle = DRONE_CAMERA.focal_length * slow / (2j * np.pi * hertz)  # px
        exposed = np.sinc(hertz * DRONE_EXPOSURE)
        size = float(np.sqrt((np.abs(angle) ** 2).mean()))
        found = {"x": (0.0, 0.0), "y": (0.0, 0.0)}  # the largest gain within the error of the ratio of the clocks
        for drift in np.linspace(-2e-4, 2e-4, 9):
            predicted = np.zeros(offsets.shape[:2], complex)
            for starts, moved, sign in ((frame_times[1:], offsets[..., 1], 1.0), (frame_times[:-1], 0.0, -1.0)):
                t = starts[:, None] + (rows + np.nan_to_num(moved)) * row_time + DRONE_EXPOSURE / 2
                t *= 1.0 + drift
                slowly = np.interp(t, times, angle.real) + 1j * np.interp(t, times, angle.imag)
                predicted += sign * exposed * slowly * np.exp(2j * np.pi * hertz * t)
            for index, label in enumerate("xy"):
                found[label] = max(found[label], _gain(offsets[..., index], predicted, rows))
        for label, (gain, std) in found.items():
            print(
                f"  row time {1e6 * row_time:.0f} us, {name} {hertz:.2f} Hz, {label}: {gain * size:.4f} ± "
                f"{std * size:.4f} px, 95 % limit {(gain + 2 * std) * size:.4f} px; gyroscope {size:.4f} px, of which "
                f"the exposure leaves {abs(exposed):.2f}",
                flush=True,
            )


def _gain(offsets, predicted, rows) -> tuple[float, float]:
    """Size of the complex factor of the predicted offsets (P, N), and the standard deviation of each of its parts.

    A cubic polynomial in the row is fitted to every pair of frames as well: other motion of the camera.
    """
    smooth = np.polynomial.legendre.legvander(2 * rows / rows.max() - 1, 3)
    parts = []
    for measured, expected in zip(offsets, predicted, strict=True):
        good = np.isfinite(measured)
        if good.sum() < 12:
            continue
        basis, _ = np.linalg.qr(smooth[good])
        data = np.stack([measured[good], expected[good].real, -expected[good].imag], -1)
        data -= basis @ (basis.T @ data)
        parts.append(data[np.abs(data[:, 0]) < 4.5 * np.median(np.abs(data[:, 0]))])  # 3 standard deviations
    data = np.concatenate(parts)
    normal = data[:, 1:].T @ data[:, 1:]
    gain = np.linalg.solve(normal, data[:, 1:].T @ data[:, 0])
    rest = data[:, 0] - data[:, 1:] @ gain
    variance = 2.0 * (rest**2).sum() / (len(data) - 4 * len(parts))  # bands overlap by half
    return float(np.hypot(*gain)), float(np.sqrt(variance * np.linalg.inv(normal).diagonal().mean()))


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
