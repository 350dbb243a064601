"""The verdict of a page, in words."""

import math
from collections.abc import Sequence
from typing import Literal

import torch

from rsvib_torch.detection import DetectionResult
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration, blind_frequencies
from rsvib_torch.report.html.figures import smear
from rsvib_torch.report.plots import measured_text
from rsvib_torch.restoration import RestorationVerdict

__all__ = ["Mood", "camera_rows", "mood_of", "tone_rows", "verdict_words"]

Mood = Literal["good", "doubt", "bad"]
TONE_HEAD = ("axis", "amplitude (px)", "frequency (Hz)", "period (ms)", "phase (π)", "gain", "verdict")
_NEAR = 3.0  # Hz from a blind frequency, worth a word


def mood_of(result: DetectionResult, verdict: RestorationVerdict | None, restored: bool) -> Mood:
    """How good the news is."""
    if not restored and verdict is None:
        return "doubt"  # nothing was found that could be undone
    if not bool(result.reliable.any()) or not restored or (verdict is not None and verdict.overall == "worse"):
        return "bad"
    certain = bool(result.reliable.all()) and verdict is not None and verdict.overall == "helps"
    return "good" if certain else "doubt"


def _axis_words(result: DetectionResult, axis: int) -> str:
    vibration, std, name = result.vibration, result.std, "xy"[axis]
    if not bool(result.reliable[axis]):
        reasons = "; ".join(str(reason) for reason in result.reasons[axis])
        return f"Along {name} no vibration can be relied on: {reasons}."
    tones = [
        f"{measured_text(vibration.amplitude[axis, k], std.amplitude[axis, k], 2)} px at "
        f"{measured_text(vibration.frequency[axis, k], std.frequency[axis, k], 2)} Hz"
        for k in range(vibration.amplitude.shape[-1])
        if float(vibration.amplitude[axis, k]) > 0
    ]
    if not tones:
        return f"Along {name} the camera did not vibrate, as far as these frames can tell."
    return f"Along {name} the image vibrates by {' and '.join(tones)}."


def _motion_words(result: DetectionResult) -> list[str]:
    words = []
    for axis, name in enumerate("xy"):
        speed, std = result.vibration.image_motion[axis], result.std.image_motion[axis]
        if math.isfinite(float(std)) and abs(float(speed)) > max(4 * float(std), 1.0):
            words.append(f"Along {name} the image also moves steadily, by {measured_text(speed, std, 1)} px/s.")
    return words


def _blind_words(result: DetectionResult, timing: SensorTiming) -> list[str]:
    words = []
    for axis, name in enumerate("xy"):
        for tone in range(result.vibration.amplitude.shape[-1]):
            frequency = float(result.vibration.frequency[axis, tone])
            if float(result.vibration.amplitude[axis, tone]) <= 0:
                continue
            blind = blind_frequencies(timing, frequency + 2 * _NEAR)
            nearest = float(blind[(blind - frequency).abs().argmin()]) if len(blind) else math.inf
            if abs(nearest - frequency) < _NEAR:
                words.append(
                    f"The tone at {frequency:.1f} Hz along {name} is {abs(nearest - frequency):.1f} Hz from "
                    f"{nearest:.1f} Hz, which a pair of these frames cannot see: errors are magnified (gain "
                    f"{abs(float(result.gain[axis, tone])):.2f})."
                )
    return words


def _first_words(mood: Mood, restored: bool, verdict: RestorationVerdict | None) -> str:
    if mood == "good":
        return "The camera shook, the vibration was measured, and undoing it helps."
    if not restored and verdict is None:
        return "No vibration was found that could be undone; the frames are left as they were taken."
    if not restored:
        return "Undoing the vibration does not help; the frames are left as they were taken."
    if mood == "bad":
        return "What was found cannot be relied on; do not use the restored frames without a look."
    if verdict is None or verdict.overall == "unknown":
        return "The vibration was measured; whether undoing it helps cannot be told from these frames."
    return "The vibration was measured and undone in part."


def verdict_words(
    result: DetectionResult,
    undone: Vibration,
    timing: SensorTiming,
    num_rows: int,
    *,
    restored: bool,
    left_alone: Sequence[str],
    verdict: RestorationVerdict | None,
) -> list[str]:
    """The verdict: a first sentence, then one for each thing worth knowing.

    Args:
        result: A detection (not a batch).
        undone: The part of its vibration that was undone.
        timing: The sensor.
        num_rows: Rows of a frame.
        restored: Whether frames were restored, or left as taken.
        left_alone: A sentence for each axis that was left alone.
        verdict: What pairs of frames say; None where they could not be compared.
    """
    words = [_first_words(mood_of(result, verdict, restored), restored, verdict)]
    words += [_axis_words(result, axis) for axis in range(2)] + _motion_words(result)
    starts = timing.row_starts(1, num_rows)[0]
    if bool(undone.moving_axes().any()):
        blur = smear(undone, starts, timing).amax(0)
        bent = undone.amplitude.sum(-1)
        words.append(
            f"Rows are displaced by up to {float(bent[0]):.2f} px along x and {float(bent[1]):.2f} px along y, and "
            f"smeared by up to {float(blur[0]):.2f} px and {float(blur[1]):.2f} px while they are exposed."
        )
    words += _blind_words(result, timing)
    words += [f"{note[0].upper()}{note[1:]}." for note in left_alone if bool(torch.as_tensor(result.reliable).all())]
    if verdict is None and restored:
        words.append("No two frames show enough of the same scene to judge the restoration by.")
    if verdict is not None:
        words.append(f"{verdict.summary[0].upper()}{verdict.summary[1:]}.")
    return words


def tone_rows(result: DetectionResult) -> list[list[str]]:
    """Rows of the table of tones."""
    vibration, std = result.vibration, result.std
    rows = []
    for axis, name in enumerate("xy"):
        for tone in range(vibration.amplitude.shape[-1]):
            at = (axis, tone)
            if float(vibration.amplitude[at]) <= 0:
                continue
            rows.append(
                [
                    name,
                    measured_text(vibration.amplitude[at], std.amplitude[at], 3),
                    measured_text(vibration.frequency[at], std.frequency[at], 3),
                    measured_text(1e3 * vibration.period[at], 1e3 * std.period[at], 3),
                    measured_text(vibration.phase[at] / math.pi, std.phase[at] / math.pi, 3),
                    f"{float(result.gain[at]):+.2f}",
                    "reliable" if bool(result.reliable[axis]) else "not reliable",
                ]
            )
    return rows


def camera_rows(timing: SensorTiming, shape: Sequence[int]) -> list[list[str]]:
    """Rows of the table of the camera."""
    blind = ", ".join(f"{value:.1f}" for value in blind_frequencies(timing, 4.5 / timing.frame_period).tolist())
    return [
        ["stack", " x ".join(str(size) for size in shape)],
        ["row time", f"{1e6 * timing.row_time:g} µs"],
        ["exposure", f"{timing.exposure_rows:g} rows, {1e3 * timing.exposure_time:.4g} ms"],
        ["rows from frame to frame", f"{timing.frame_rows:g} ({timing.frame_rate:.2f} frames a second)"],
        ["rows follow one another along", {-2: "y", -1: "x"}[int(timing.scan_axis)] + f", {timing.readout_direction}"],
        ["blind frequencies of a pair", f"{blind} … Hz" if blind else "none below"],
    ]
