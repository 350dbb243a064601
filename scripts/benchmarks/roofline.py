"""Roofline of the exact restoration: memory traffic and operations of one frame, compared with the rates of the device.

Counted from the shapes of the steps, complex64. "Least" is the input and output of a step without its intermediate
values; "moved" is the input and output of each of its tensor operations, without regard to caches. A complex product
and sum is eight operations, a real Fourier transform of L values 2.5 L log2 L. The estimation of noise and prior is not
counted, but it is part of the measured time; so is the repeated work of overlapping segments of rows on a GPU.

Second, the rate of frames of detection and restoration together, from pairs of frames and tracked from frame to frame,
next to the limit by memory traffic.
"""

import argparse
import math
import statistics
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from benchmarks.measure import in_turns, seconds_of, shown_seconds
from benchmarks.restoration import MARGIN, SEED, TIMED_NOISE, camera, vibration

import rsvib_torch as rsv
from rsvib_torch.evaluation import city_and_fields
from rsvib_torch.restoration.exact import exact
from rsvib_torch.restoration.exact.scene_solver import Partition
from rsvib_torch.restoration.frame_motion import frame_motion
from rsvib_torch.restoration.scene_model.observation import Observation, row_kernels, scene_weights, smooth_kernels
from rsvib_torch.restoration.scene_model.scene_prior import ORDER

REAL, COMPLEX = 4, 8  # bytes
COPIED = 1 << 28  # bytes copied to measure the bandwidth
MULTIPLIED = 1536  # rows and columns of the matrices multiplied to measure the rate
FOLLOWED, WINDOW = 12, 4  # frames of the clip, and of them for the first detection of the tracker


@dataclass(frozen=True)
class Shapes:
    """Sizes of the systems that restore one frame.

    Attributes:
        rows: H.
        columns: W.
        length: Period of the extended rows.
        frequencies: Frequencies along a row; one system each.
        unknowns: Scene rows in a system.
        taps: Scene rows that contribute to a row of the frame.
        width: Half-width of the band.
        kernel_terms: Terms of the sum that forms the kernels at each frequency.
        band_terms: Terms of the sum that forms the entries of the band.
        chunks: Groups of frequencies that are solved together.
    """

    rows: int
    columns: int
    length: int
    frequencies: int
    unknowns: int
    taps: int
    width: int
    kernel_terms: int
    band_terms: int
    chunks: int


def shapes_of(size: tuple[int, int], timing: rsv.SensorTiming, truth: rsv.Vibration, device: str = "cpu") -> Shapes:
    """Sizes for a frame of that size, camera and vibration."""
    height, width = size
    motion = frame_motion(truth.expanded(1), timing.in_row_order(), 1, height)
    moved, weights = motion.exposures
    length = exact.scene_period(motion, width)
    kernels = row_kernels(moved[0], weights, torch.ones(1), height)
    observation = Observation(kernels, height, length, torch.float32)
    band = observation.normal(ORDER)
    frequencies = length // 2 + 1
    parts, _ = Partition().divide(
        observation.count, band.width, frequencies, torch.device(device), blurred=kernels.blurred, keep=False
    )
    return Shapes(
        rows=height,
        columns=width,
        length=length,
        frequencies=frequencies,
        unknowns=observation.count,
        taps=kernels.taps.shape[-2],
        width=band.width,
        kernel_terms=smooth_kernels(kernels, torch.float32).left.shape[-1],
        band_terms=band.left.shape[-1],
        chunks=len(parts),
    )


def steps(s: Shapes) -> list[dict[str, Any]]:
    """Operations and bytes of each step of restoring one frame."""
    frame, period, spectrum = REAL * s.rows * s.columns, REAL * s.rows * s.length, COMPLEX * s.rows * s.frequencies
    solution = COMPLEX * s.unknowns * s.frequencies
    values, unknowns, b = s.rows * s.frequencies, s.unknowns * s.frequencies, s.width
    transform = 2.5 * s.rows * s.length * math.log2(s.length)
    kernels = REAL * s.rows * s.taps * s.kernel_terms
    entries = (s.unknowns + b) * (2 * b + 1)
    band, terms = COMPLEX * entries * s.frequencies, REAL * entries * s.band_terms
    shared = len(scene_weights())
    counted = [
        ("Fourier transform of rows", transform, frame + spectrum, frame + 2 * period + spectrum),
        (
            "right sides: kernels times data",
            (14 + s.taps * (4 * s.kernel_terms + 8)) * values,
            kernels + spectrum + solution,
            6 * spectrum + s.taps * 7 * spectrum + s.chunks * kernels + 2 * solution,
        ),
        ("bands", 4 * entries * s.band_terms * s.frequencies, terms + band, s.chunks * terms + band),
        ("factors", 8 * b * (b + 1) * unknowns, 2 * band, 2 * b * (b + 2) * solution),
        ("forward substitution", (8 * b + 2) * unknowns, (b + 2) * solution, (3 * b + 3) * solution),
        ("back substitution", 8 * b * unknowns, (b + 2) * solution, (4 * b + 2) * solution),
        (
            "scene between its rows",
            4 * shared * values,
            solution + spectrum,
            5 * shared * spectrum + 2 * spectrum,
        ),
        ("Fourier transform back", transform, spectrum + frame, 3 * spectrum + period),
    ]
    return [
        {"part": "step", "step": name, "operations": operations, "bytes_least": least, "bytes_moved": moved}
        for name, operations, least, moved in counted
    ]


def _device(options: argparse.Namespace, device: str, frame: torch.Tensor, timing: rsv.SensorTiming) -> dict[str, Any]:
    """Rates of copying and of multiplication of a device, and the time of restoration, in the same run."""
    source = torch.ones(COPIED // REAL, device=device)
    target, taken = torch.empty_like(source), frame.to(device)
    left, right = torch.ones(2, MULTIPLIED, MULTIPLIED, device=device)
    truth = vibration()
    done = in_turns(
        {
            "copy": lambda: target.copy_(source),
            "multiply": lambda: left @ right,
            "restore": lambda: rsv.restore(taken, timing, truth),
        },
        options.runs,
    )
    shapes = shapes_of(tuple(frame.shape[-2:]), timing, truth, device)
    counted = steps(shapes)
    operations, least, moved = (sum(s[key] for s in counted) for key in ("operations", "bytes_least", "bytes_moved"))
    bandwidth, rate = 2 * COPIED / done["copy"].seconds, 2 * MULTIPLIED**3 / done["multiply"].seconds
    seconds = done["restore"].seconds
    return {
        "part": "device",
        "device": device,
        "shapes": vars(shapes),
        "bytes_a_second": bandwidth,
        "operations_a_second": rate,
        **done["restore"].figures(),
        "least_seconds": max(least / bandwidth, operations / rate),
        "moved_seconds": max(moved / bandwidth, operations / rate),
        "share_of_bandwidth": moved / bandwidth / seconds,
        "share_of_operations": operations / rate / seconds,
    }


def _least_bytes(s: Shapes, method: str) -> float:
    """Bytes that detection and restoration of one frame move at least.

    Detection by one round of measurements: Fourier transforms of the rows, the spectra warped to the scene, two images
    of derivatives written and read, and the difference from the other frame; ``"dewarp"`` reads and writes the frame.
    """
    frame, spectrum = REAL * s.rows * s.columns, COMPLEX * s.rows * s.frequencies
    restoration = 2 * frame if method == "dewarp" else sum(step["bytes_least"] for step in steps(s))
    return frame + 3 * spectrum + 2 * 2 * frame + frame + restoration


def _rates(device: str, frames: torch.Tensor, timing: rsv.SensorTiming, bandwidth: float) -> list[dict[str, Any]]:
    """Frames per second of detection and restoration on a device."""
    frames, results = frames.to(device), []
    shapes = shapes_of(tuple(frames.shape[-2:]), timing, vibration(), device)

    def of_pairs(method: str) -> Iterator[torch.Tensor]:
        for first in range(len(frames) - 1):
            found = rsv.detect_vibration(frames[first : first + 2], timing)
            yield rsv.restore(frames[first : first + 1], timing, found, method=method)

    def tracked(method: str) -> Iterator[torch.Tensor]:
        tracker = rsv.VibrationTracker(timing, window=WINDOW, method=method)
        for frame in frames:
            yield tracker.update(frame).restored

    for method in ("dewarp", "exact"):
        for name, restored in (("pair by pair", of_pairs), ("tracked", tracked)):
            images = restored(method)
            for _ in range(WINDOW):  # the first detection of the tracker
                next(images)
            seconds = [seconds_of(lambda images=images: next(images)) for _ in range(FOLLOWED - WINDOW - 1)]
            results.append(
                {
                    "part": "rate",
                    "device": device,
                    "name": name,
                    "method": method,
                    "seconds": statistics.median(seconds),
                    "limit": _least_bytes(shapes, method) / bandwidth,
                }
            )
    return results


def rows(options: argparse.Namespace) -> list[dict[str, Any]]:
    """The counts, and the measurements on every device."""
    size, timing, truth = options.size, camera(20), vibration()
    if size > timing.frame_rows:
        timing = rsv.SensorTiming(timing.row_time, timing.exposure_rows, size)
    scene = city_and_fields(size + 2 * MARGIN, size + 2 * MARGIN, SEED)
    noise, generator = rsv.SensorNoise(read_noise=TIMED_NOISE), torch.Generator().manual_seed(SEED)
    frames = rsv.simulate_frames(
        scene, timing, truth, FOLLOWED, frame_size=(size, size), noise=noise, generator=generator
    )
    results = steps(shapes_of((size, size), timing, truth))
    for device in options.device:
        rates = _device(options, device, frames[:1], timing)
        results += [rates, *_rates(device, frames, timing, rates["bytes_a_second"])]
    return results


def lines(results: list[dict[str, Any]], options: argparse.Namespace) -> list[str]:
    """The counts and the measurements as Markdown tables."""
    counted = [row for row in results if row["part"] == "step"]
    on_devices = [row for row in results if row["part"] == "device"]
    shapes = on_devices[0]["shapes"]
    total = {"step": "**together**"} | {
        key: sum(row[key] for row in counted) for key in ("operations", "bytes_least", "bytes_moved")
    }
    text = [
        f'Roofline of restore(method="exact"), one frame of {options.size} x {options.size} px: '
        f"{shapes['frequencies']} systems of {shapes['unknowns']} unknowns, "
        f"half-width of the band {shapes['width']}. "
        "Limit: the least bytes at the rate of copying, or the operations at that of matrix multiplication, whichever "
        "takes longer; the rates are measured in the same run.",
        "",
        "| step | Gop | MB at least | MB moved | operations / byte moved |",
        "|---|---|---|---|---|",
    ]
    text += [
        f"| {row['step']} | {row['operations'] / 1e9:.2f} | {row['bytes_least'] / 1e6:.0f} "
        f"| {row['bytes_moved'] / 1e6:.0f} | {row['operations'] / row['bytes_moved']:.1f} |"
        for row in [*counted, total]
    ]
    text += [
        "",
        "| device | copies (GB/s) | multiplies (Gop/s, float32) | limit (s) | operation by operation (s) "
        "| measured (s) | share of the bandwidth | of the operations |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in on_devices:
        text.append(
            f"| {row['device']} | {row['bytes_a_second'] / 1e9:.1f} | {row['operations_a_second'] / 1e9:.0f} "
            f"| {row['least_seconds']:.4f} | {row['moved_seconds']:.4f} | {shown_seconds(row)} "
            f"| {100 * row['share_of_bandwidth']:.0f} % | {100 * row['share_of_operations']:.0f} % |"
        )
    text += [
        "",
        "Detection and restoration of one frame after the other: `detect_vibration` of each pair of frames and "
        "`restore`, or `VibrationTracker`. Limit: the least bytes at the rate of copying.",
        "",
        "| device | restoration | detection | frames/s | limit (frames/s) |",
        "|---|---|---|---|---|",
    ]
    text += [
        f"| {row['device']} | {row['method']} | {row['name']} | {1 / row['seconds']:.1f} | {1 / row['limit']:.0f} |"
        for row in results
        if row["part"] == "rate"
    ]
    if all(row["device"] == "cpu" for row in on_devices):
        text += ["", "No CUDA device, or not measured on it."]
    return text
