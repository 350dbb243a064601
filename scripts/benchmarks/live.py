"""Tracking at camera rate: dropped frames, delay, memory and errors of a long session; changes; speed next to peers.

Frames come from benchmarks/independent_camera.py. The session repeats one second of frames with whole numbers of
periods; its noise is that of this second.
"""

import argparse
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import psutil
import torch
from benchmarks.independent_camera import closed, take_frames
from harness import Rows, table, table_of
from numpy.typing import NDArray

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields
from rsvib_torch.video import TimedFrame, run_live
from rsvib_torch.video.session import to_counts

OPTIONS = {
    "minutes": (0.5, "live: duration of the session"),
    "live_size": (1024, "live: rows and columns of the frames"),
    "live_periods": (5, "live: repetitions of the frames for the accuracy"),
}
QUICK = {"minutes": 0.05, "live_size": 192, "live_periods": 2}
SEED, NOISE, MARGIN, RATE, EXPOSURE_ROWS = 11, 0.005, 32, 30, 20
AMPLITUDE, FREQUENCY, PHASE = np.array([2.1, 1.6]), np.array([52.0, 71.0]), np.array([0.5, 1.0])
BEFORE = 0.3  # s, the vibration is steady before it changes
WINDOW = 8  # frames of the batch


def changing_time(times: NDArray[Any]) -> NDArray[Any]:
    """Time (..., 2) in s since the vibration along x changes; that along y does not."""
    return np.maximum(times - BEFORE, 0.0)[..., None] * [1.0, 0.0]


@dataclass(frozen=True)
class Changing:
    """Tones along x and y; that along x may sweep (Hz/s) and grow (doublings per second) after ``BEFORE`` s."""

    sweep: float = 0.0
    doublings: float = 0.0

    def amplitude(self, times: NDArray[Any]) -> NDArray[Any]:
        """(..., 2) px."""
        return AMPLITUDE * 2.0 ** (self.doublings * changing_time(times))

    def frequency(self, times: NDArray[Any]) -> NDArray[Any]:
        """(..., 2) Hz."""
        return FREQUENCY + self.sweep * changing_time(times)

    def displacement(self, times: NDArray[Any]) -> NDArray[Any]:
        """(..., 2) px."""
        cycles = FREQUENCY * times[..., None] + 0.5 * self.sweep * changing_time(times) ** 2
        return np.asarray(self.amplitude(times) * np.sin(2 * np.pi * cycles + PHASE))


def timing_of(size: int, exposure_rows: int = EXPOSURE_ROWS) -> rsv.SensorTiming:
    """A camera of 30 frames/s with ``size`` rows and a tenth of the frame period for blanking."""
    row_time = 0.9 / RATE / size
    return rsv.SensorTiming(row_time=row_time, exposure_rows=exposure_rows, frame_rows=1 / RATE / row_time)


def frames_of(size: int, motion: Changing, count: int) -> NDArray[np.uint8]:
    """Frames (T, size, size) with noise."""
    scene = closed(city_and_fields(size + 2 * MARGIN, size + 2 * MARGIN, seed=SEED).double().numpy(), MARGIN // 2)
    taken = take_frames(scene, motion, timing_of(size), count, (size, size))
    noisy = taken + NOISE * np.random.default_rng(SEED).standard_normal(taken.shape)
    return np.clip(np.round(255 * noisy), 0, 255).astype(np.uint8)


@dataclass
class Repeated:
    """A source that repeats frames at the rate of the camera."""

    pixels: NDArray[np.uint8]
    count: int
    lost: int = 0
    waits: bool = False

    def frames(self) -> Iterator[TimedFrame]:
        """The frames."""
        begin = time.perf_counter()
        for index in range(self.count):
            time.sleep(max(0.0, begin + index / RATE - time.perf_counter()))
            yield TimedFrame(self.pixels[index % len(self.pixels)], index / RATE, time.perf_counter())


class Output:
    """An output that measures the memory of the process once a second."""

    def __init__(self) -> None:
        self.process, self.memory = psutil.Process(), list[int]()

    def write(self, frame: NDArray[np.uint8], index: int) -> None:
        """Take a frame."""
        if index % RATE == 0:
            self.memory.append(self.process.memory_info().rss)

    def close(self) -> None:
        """Nothing is open."""


def errors(found: rsv.DetectionResult, amplitude: NDArray[Any], frequency: NDArray[Any]) -> NDArray[Any]:
    """(2, 2) errors of amplitudes in px and frequencies in Hz of the strongest tones."""
    vibration = found.vibration
    return np.stack([vibration.amplitude[:, 0].numpy() - amplitude, vibration.frequency[:, 0].numpy() - frequency])


def session(pixels: NDArray[np.uint8], size: int, minutes: float) -> dict[str, Any]:
    """A paced session."""
    count, output, tracker = round(60 * RATE * minutes), Output(), rsv.VibrationTracker(timing_of(size))
    begin = output.process.cpu_times()
    report = run_live(Repeated(pixels, count), tracker, [output])
    cpu, memory = output.process.cpu_times(), output.memory
    half = len(memory) // 2
    return {
        "name": "session",
        "frames": report.frames,
        "dropped": report.dropped,
        "delay_median": report.latency(0.5),
        "delay_99": report.latency(0.99),
        "within_two": sum(report.latencies[:3]) / max(report.frames, 1),
        "cpu": 1e3 * (cpu.user + cpu.system - begin.user - begin.system) / max(report.frames, 1),
        "memory": max(memory) / 2**20,
        # of the largest values: the C library returns freed memory in steps of tens of MiB
        "drift": max(memory[half:]) / max(memory[min(5, half - 1) : half]) - 1,
        "tracked": report.tracked / max(report.frames, 1),
        "predicted": report.predicted,
        "detections": report.detections,
    }


def accuracy(pixels: NDArray[np.uint8], size: int, periods: int) -> dict[str, Any]:
    """Errors of the tracker from the second period of the frames on, and of the batch on windows of the same frames."""
    timing, tracker = timing_of(size), rsv.VibrationTracker(timing_of(size))
    count, ours = len(pixels), []
    for index in range(periods * count):
        found = tracker.update(pixels[index % count]).detection
        if index >= count and found is not None:
            ours.append(errors(found, AMPLITUDE, FREQUENCY))
    twice = torch.as_tensor(np.concatenate([pixels, pixels]))
    batch = [
        errors(rsv.detect_vibration(twice[first : first + WINDOW], timing), AMPLITUDE, FREQUENCY)
        for first in range(0, count, 3)
    ]
    rms = [np.sqrt(np.mean(np.square(one), 0)) for one in (ours, batch)]
    return {"name": "accuracy", "errors": rms[0].tolist(), "batch_errors": rms[1].tolist()}


def change(name: str, size: int, motion: Changing) -> dict[str, Any]:
    """A vibration that changes during the second half of a second and a half."""
    timing, tracker, found = timing_of(size), rsv.VibrationTracker(timing_of(size), columns=None), []
    middle = 0.5 * (size - 1 + EXPOSURE_ROWS) * timing.row_time
    pixels = frames_of(size, motion, 40)
    detections, lost = 0, 0
    for index, frame in enumerate(pixels):
        tracked = tracker.update(frame)
        detections += tracked.detected
        when = np.array(index / RATE + middle)
        if when < BEFORE:
            continue
        lost += tracked.state != "tracking"
        if tracked.detection is not None:
            error = errors(tracked.detection, motion.amplitude(when), motion.frequency(when))
            found.append([abs(error[0, 0]) / motion.amplitude(when)[0], abs(error[1, 0])])
    amplitude, frequency = np.sqrt(np.mean(np.square(found), 0)).tolist()
    errors_of = {"amplitude": amplitude, "frequency": frequency}
    return {"name": name, "size": size, **errors_of, "lost": lost, "detections": detections}


def residual(frames: NDArray[np.uint8], size: int) -> tuple[float, float]:
    """Rms offset (px) of the rows between consecutive frames, and of whole frames, over both axes."""
    curve = rsv.register_bands(torch.as_tensor(frames), timing_of(size), full_scale=255.0)
    whole = curve.offsets.nanmean(1, keepdim=True)
    apart = (curve.offsets - whole).square().nanmean().sqrt()
    return float(apart), float(whole.square().mean().sqrt())


def phase_correlated(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Frames moved back by the whole-frame offset of OpenCV's phase correlation."""
    place, results = np.zeros(2), [pixels[0]]
    size = pixels.shape[:0:-1]  # width, height
    window = cv2.createHanningWindow(size, cv2.CV_32F)
    for before, frame in pairwise(pixels):
        place = place + cv2.phaseCorrelate(before.astype(np.float32), frame.astype(np.float32), window)[0]
        matrix = np.array([[1.0, 0.0, -place[0]], [0.0, 1.0, -place[1]]])
        results.append(cv2.warpAffine(frame, matrix, size, borderMode=cv2.BORDER_REFLECT_101))
    return np.stack(results)


def tracked_frames(pixels: NDArray[np.uint8], size: int, method: str) -> NDArray[np.uint8]:
    """Frames that are tracked and restored as fast as possible."""
    tracker = rsv.VibrationTracker(timing_of(size), method=method)
    return np.stack([to_counts(tracker.update(frame).restored) for frame in pixels])


def rows(options: argparse.Namespace) -> Rows:
    size = options.live_size
    pixels = frames_of(size, Changing(), RATE)
    results = [session(pixels, size, options.minutes), accuracy(pixels, size, options.live_periods)]
    smaller = max(192, size // 2)  # with fewer pixels, the tracker loses the vibration
    results.append(change("sweep of 2 Hz/s", smaller, Changing(sweep=2.0)))
    results.append(change("amplitude doubles in 1 s", smaller, Changing(doublings=1.0)))
    clip = np.concatenate([pixels, pixels])
    tasks: dict[str, Callable[[], NDArray[np.uint8]]] = {
        "as taken": lambda: clip,
        "`VibrationTracker`, dewarp": lambda: tracked_frames(clip, size, "dewarp"),
        "`VibrationTracker`, exact": lambda: tracked_frames(clip, size, "exact"),
        "`cv2.phaseCorrelate`, `cv2.warpAffine`": lambda: phase_correlated(clip),
    }
    for name, work in tasks.items():
        begin, cpu = time.perf_counter(), time.process_time()
        restored = work()
        seconds, used = time.perf_counter() - begin, time.process_time() - cpu
        moving, whole = residual(restored[-RATE + 2 :], size)
        speed = {"rate": len(clip) / seconds, "cpu": 1e3 * used / len(clip)}
        speed = dict.fromkeys(speed, math.nan) if name == "as taken" else speed
        results.append({"name": name, **speed, "rows": moving, "whole": whole})
    return results


QUANTITIES = {  # of the session
    "frames, dropped": "{frames}, {dropped}",
    "delay of the written frames in frame periods: median, 99 %": "{delay_median}, {delay_99}",
    "frames with a delay of at most 2 frame periods": "{within_two:.1%}",
    "processor time per frame": "{cpu:.0f} ms",
    "largest resident memory, change between the halves": "{memory:.0f} MiB, {drift:+.1%}",
    "frames with known motion, late ones that were predicted, detections": "{tracked:.1%}, {predicted}, {detections}",
}


def lines(rows: Rows, options: argparse.Namespace) -> list[str]:
    one, errors_of, *others = rows
    cells = [(name, text.format(**one)) for name, text in QUANTITIES.items()]
    for place, (quantity, unit) in enumerate((("amplitude", "px"), ("frequency", "Hz"))):
        ours, batch = (math.hypot(*errors_of[name][place]) / math.sqrt(2) for name in ("errors", "batch_errors"))
        values = f"{ours:.5f} {unit}, {batch:.5f} {unit}, {ours / batch:.2f}"
        cells.append((f"error of the {quantity}: tracker, batch, ratio", values))
    changes = [row for row in others if "lost" in row]
    return [
        f"One session of {one['frames'] / RATE / 60:.2g} minutes, {options.live_size} x {options.live_size} at {RATE} "
        "frames/s, restored with dewarp. Errors are rms over both axes; the batch is `detect_vibration` on "
        f"{WINDOW} of the same frames.",
        "",
        *table(("quantity", "value"), cells),
        f"Changes along x, {changes[0]['size']} x {changes[0]['size']}, rms errors from the beginning of the change:",
        "",
        *table_of(
            changes,
            ("change", "{name}"),
            ("amplitude (%)", lambda row: f"{100 * row['amplitude']:.2f}"),
            ("frequency (Hz)", "{frequency:.3f}"),
            ("frames without known motion", "{lost}"),
            ("further detections", lambda row: row["detections"] - 1),
        ),
        "The same clip as fast as possible, with the motion between consecutive frames of the result:",
        "",
        *table_of(
            (row for row in others if "rows" in row),
            ("method", "{name}"),
            ("frames/s", lambda row: "" if math.isnan(row["rate"]) else f"{row['rate']:.1f}"),
            ("processor ms per frame", lambda row: "" if math.isnan(row["cpu"]) else f"{row['cpu']:.0f}"),
            ("rows about the frame (px)", "{rows:.3f}"),
            ("whole frames (px)", "{whole:.3f}"),
        ),
    ]
