"""Scaling of time and memory: one quantity at a time is varied around two frames of 1024 x 1024 px.

Seconds of ``detect_vibration`` and ``restore`` with their defaults, against height, width, number of frames, exposure,
bandwidth (the amplitude across the rows, with a long exposure) and tones; peak memory at a few sizes.
"""

import argparse
import warnings
from dataclasses import dataclass, replace
from typing import Any

import torch
from benchmarks.measure import in_turns, named, peak_memory, shown_seconds
from benchmarks.restoration import SEED, TIMED_NOISE
from benchmarks.roofline import shapes_of

import rsvib_torch as rsv
from rsvib_torch.evaluation import city_and_fields

PERIOD = 42.0e-3  # s; frame period
TONES = ((2.0, 61.0, 0.4), (0.7, 133.0, -1.1), (0.4, 187.0, 2.0))  # amplitude in px, Hz, rad; the same on both axes
BLURRED = 0.1  # of the frame period; exposure of the cases that vary the bandwidth


@dataclass(frozen=True)
class Case:
    """A case of the benchmark.

    Attributes:
        height: Rows.
        width: Columns.
        num_frames: Frames.
        exposure: Fraction of the frame period.
        amplitude: Amplitude of the strongest tone across the rows, px.
        tones: Number of tones of each axis.
    """

    height: int
    width: int
    num_frames: int = 2
    exposure: float = 0.01
    amplitude: float = TONES[0][0]
    tones: int = 1

    @property
    def timing(self) -> rsv.SensorTiming:
        """A camera whose frame period is the same for all heights."""
        return rsv.SensorTiming(PERIOD / self.height, max(1.0, self.exposure * self.height), self.height)

    @property
    def vibration(self) -> rsv.Vibration:
        """The motion."""
        tones = torch.tensor(TONES[: self.tones], dtype=torch.float64).T.repeat(2, 1, 1)
        tones[1, 0, 0] = self.amplitude
        return rsv.Vibration(tones[:, 0], tones[:, 1], tones[:, 2] + torch.tensor([[0.0], [1.0]]))

    def frames(self) -> torch.Tensor:
        """Frames (T, H, W) with a little noise."""
        margin = 32 + int(2 * self.amplitude)
        scene = city_and_fields(self.height + 2 * margin, self.width + 2 * margin, SEED)
        return rsv.simulate_frames(
            scene,
            self.timing,
            self.vibration,
            self.num_frames,
            frame_size=(self.height, self.width),
            noise=rsv.SensorNoise(read_noise=TIMED_NOISE),
            generator=torch.Generator().manual_seed(SEED),
        )


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this section."""
    parser.add_argument(
        "--scaling-size", type=int, default=1024, help="scaling: rows and columns of the reference case"
    )


def cases(size: int) -> dict[tuple[str, str], Case]:
    """Every case, by the quantity that is varied and its value."""
    usual = Case(size, size)
    half, double = size // 2, 2 * size
    blurred = replace(usual, exposure=BLURRED)
    varied = {
        "height": [replace(usual, height=value) for value in (half, size, double)],
        "width": [replace(usual, width=value) for value in (half, size, double)],
        "frames": [replace(usual, num_frames=value) for value in (2, 4, 8)],
        "exposure rows": [replace(usual, exposure=value) for value in (0.01, 0.05, 0.2)],
        "amplitude across (px)": [replace(blurred, amplitude=value) for value in (1.0, 4.0, 8.0, 12.0)],
        "tones": [replace(usual, tones=value) for value in (1, 2, 3)],
    }
    shown = {
        "height": lambda case: str(case.height),
        "width": lambda case: str(case.width),
        "frames": lambda case: str(case.num_frames),
        "exposure rows": lambda case: f"{case.timing.exposure_rows:.0f}",
        "amplitude across (px)": lambda case: f"{case.amplitude:g}",
        "tones": lambda case: str(case.tones),
    }
    return {(name, shown[name](case)): case for name, values in varied.items() for case in values}


def measure(case: Case, device: str, runs: int) -> dict[str, Any]:
    """Seconds of detection and restoration on a device, and the error of the detected amplitudes."""
    frames, timing, truth = case.frames().to(device), case.timing, case.vibration
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rsv.RestorationWarning)
        done = in_turns(
            {
                "detection": lambda: rsv.detect_vibration(frames, timing),
                "restoration": lambda: rsv.restore(frames, timing, truth),
            },
            runs,
        )
    found = done["detection"].result.vibration.amplitude[:, 0].cpu()
    return {
        "detection": done["detection"].figures(),
        "restoration": done["restoration"].figures(),
        "amplitude_percent": 100 * float((found / truth.amplitude.amax(1) - 1).abs().max()),
    }


def rows(options: argparse.Namespace) -> list[dict[str, Any]]:
    """All cases on all devices, then peak memory."""
    results: list[dict[str, Any]] = []
    measured: dict[tuple[Case, str], dict[str, Any]] = {}
    for device in options.device:
        for (varied, value), case in cases(options.scaling_size).items():
            if (case, device) not in measured:
                measured[case, device] = measure(case, device, options.runs)
            shapes = shapes_of((case.height, case.width), case.timing, case.vibration)
            results.append(
                {
                    "part": "time",
                    "varied": varied,
                    "value": value,
                    "device": device,
                    "pixels": case.num_frames * case.height * case.width,
                    "band_width": shapes.width,
                    **measured[case, device],
                }
            )
        size = options.scaling_size
        for height, width in ((size // 2, size // 2), (size, size), (2 * size, size)):
            for work in ("detection", "exact"):
                peak = peak_memory(work, 2, height, width, device)
                row = {"part": "memory", "work": work, "device": device, "height": height, "width": width}
                results.append({**row, "bytes": peak, "frames_of_memory": peak and peak / (2 * 4 * height * width)})
    return results


def lines(results: list[dict[str, Any]], options: argparse.Namespace) -> list[str]:
    """The figures as Markdown tables."""
    size = options.scaling_size
    text = [
        f"Scaling around two frames of {size} x {size} px, exposure {0.01 * size:.0f} rows, one tone of "
        f"{TONES[0][0]:g} px and {TONES[0][1]:g} Hz on both axes; bandwidth with an exposure of {BLURRED * size:.0f} "
        f"rows. Medians of {options.runs} alternating runs (range).",
        "",
        "| varied | value | half-width of the band | detection (s) | ns per pixel | restoration (s) | ns per pixel "
        "| amplitude error (%) |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in (row for row in results if row["part"] == "time"):
        cells = [
            f"{shown_seconds(row[name])} | {1e9 * row[name]['seconds'] / row['pixels']:.0f}"
            for name in ("detection", "restoration")
        ]
        text.append(
            f"| {named(row['varied'], row['device'])} | {row['value']} | {row['band_width']} | {' | '.join(cells)} "
            f"| {row['amplitude_percent']:.2g} |"
        )
    text += [
        "",
        "| memory of two frames | rows x columns | peak (MB) | over the frames in float32 |",
        "|---|---|---|---|",
    ]
    for row in (row for row in results if row["part"] == "memory"):
        name = {"detection": "detect_vibration", "exact": "restore"}[row["work"]]
        figures = (
            "not measured | " if row["bytes"] is None else f"{row['bytes'] / 1e6:.0f} | {row['frames_of_memory']:.1f}"
        )
        text.append(f"| {named(name, row['device'])} | {row['height']} x {row['width']} | {figures} |")
    return text
