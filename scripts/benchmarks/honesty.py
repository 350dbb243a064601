"""Confident wrong answers of detection and restoration, counted over many recordings of benchmarks/honesty_cases.py.

Each axis of a recording is correct, wrong, assumed or refused. It is wrong if it is called reliable and

* the amplitude or frequency of a true tone differs by more than 5 standard deviations and more than 2 %, or
* the displacement of the rows differs from the true one by more than 5 % rms and 0.01 px, and by more than 5 of its
  standard deviations unless a tone is missing or spurious or the motion does not consist of tones. Mean and linear
  trend over the record do not count: the former is not observable, and a uniform motion moves the restored frames only.

It is assumed instead of wrong if the stated timing has an error, the result states the timing as an assumption, and its
sensitivity to the timing gives a third of the errors or more.

True tones whose offsets do not exceed 0.05 px in any frames do not count, because they are not observable. Tones that
are closer than a quarter of 1 / duration count as one tone with their sum in the middle of the record. A refused axis
is known if the timing is correct, the displacement is within 2 % of the true one, and no parameter is wrong. A
restoration is worse if the PSNR of the restored frames, each compared with the still scene displaced by the
best constant, is more than 0.1 dB below that of the raw frames.
"""

import argparse
import math
import time
import warnings
from contextlib import suppress
from typing import Any

import cv2
import numpy as np
import torch
from benchmarks.honesty_camera import Array
from benchmarks.honesty_cases import CLASSES, MODELLED, MORE, TIMING_CORRECT, Recording, recording
from harness import Rows, table
from scipy.optimize import linear_sum_assignment

import rsvib_torch as rsv

OPTIONS = {
    "honesty_classes": (tuple(CLASSES), "honesty: classes of recordings", CLASSES),
    "honesty_cases": (9, "honesty: cases of each class, of some a multiple; 387 in all"),
    "honesty_size": (384, "honesty: rows and columns of the frames"),
}
QUICK = {"honesty_classes": ("plain", "frame_rows +2%"), "honesty_cases": 1, "honesty_size": 128}
MIN_OFFSET = 0.05  # px, amplitude of the offsets of a tone from which it must be correct
MANY_STD, WRONG_SHARE = 5.0, 0.02  # of a parameter
WRONG_DISPLACEMENT, WRONG_PX, KNOWN_DISPLACEMENT = 0.05, 0.01, 0.02  # share of its rms, px, share
MERGED = 0.25  # of 1 / duration; closer tones count as one
WORSE_DB = 0.1
RIM = 1 / 12  # of the frame; pixels near the border are not compared
WITHIN_95 = 1.96


def without_trend(values: Array, times: Array) -> Array:
    """Displacements (T, H) without mean and linear trend over the record."""
    t = times.ravel() - times.mean()
    flat = values.ravel() - values.mean()
    return np.asarray((flat - t * (t @ flat) / (t @ t)).reshape(values.shape))


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def observable_tones(taken: Recording, axis: int) -> Array:
    """True tones (K, 3) of an axis that the frames can show: amplitude, frequency, phase; close ones as one."""
    assert taken.case.tones is not None
    first_rows = taken.starts[:, 0]
    intervals = np.abs(first_rows[:, None] - first_rows)
    middle, duration = 0.5 * (taken.starts.min() + taken.starts.max()), float(np.ptp(taken.starts))
    merged: list[list[float]] = []
    for amplitude, frequency, phase in sorted(taken.case.tones[axis].tolist(), key=lambda tone: tone[1]):
        value = amplitude * np.exp(1j * (2 * np.pi * frequency * middle + phase))
        if merged and (frequency - merged[-1][1]) * duration < MERGED:
            size, other = merged[-1][0], merged[-1][2]
            between = (size * merged[-1][1] + amplitude * frequency) / (size + amplitude)
            merged[-1] = [abs(value + other), between, value + other]
        else:
            merged.append([amplitude, frequency, value])
    tones = [
        (amplitude, frequency, np.angle(value) - 2 * np.pi * frequency * middle)
        for amplitude, frequency, value in merged
        if amplitude
        * np.abs(2 * np.sin(np.pi * frequency * intervals)).max()
        * abs(np.sinc(frequency * taken.exposure))
        > MIN_OFFSET
    ]
    return np.array(tones).reshape(-1, 3)


def tone_errors(found: rsv.DetectionResult, true: Array, axis: int) -> tuple[list[dict[str, float]], bool]:
    """Relative errors and errors over the standard deviation of the true tones, and whether the number is wrong.

    The number is right if all true tones have a counterpart, and no tone is left without a true one. If it is wrong,
    the standard deviation is that if another tone is hidden.
    """
    tones = (found.vibration.amplitude[axis] > 0).nonzero()[:, 0].tolist()
    frequencies = found.vibration.frequency[axis].numpy()
    miss = np.array([[abs(frequencies[tone] - frequency) for tone in tones] for _, frequency, _ in true])
    errors: list[dict[str, float]] = []
    pairs = list(zip(*linear_sum_assignment(miss), strict=True)) if miss.size else []
    wrong_number = len(pairs) < len(true) or len(tones) > len(pairs)
    stated = found.std_if_hidden_tone if wrong_number and found.std_if_hidden_tone is not None else found.std
    for one, at in pairs:
        pair: dict[str, float] = {"place": tones[at]}
        for name, value in zip(("amplitude", "frequency"), true[one], strict=False):
            error = float(getattr(found.vibration, name)[axis, tones[at]]) - value
            std = float(getattr(stated, name)[axis, tones[at]])
            pair[f"{name}_error"], pair[f"{name}_z"] = error / value, error / std if std > 0 else math.inf
        errors.append(pair)
    return errors, wrong_number


def effect_of(found: rsv.DetectionResult, taken: Recording, of: str, name: str, axis: int, tone: int) -> float:
    """Logarithm of the factor by which an error of a stated time changes an amplitude or a frequency."""
    if name == "exposure_rows" and of == "amplitude":  # its effect is not linear
        frequency = float(found.vibration.frequency[axis, tone])
        return float(np.log(np.sinc(frequency * taken.exposure) / np.sinc(frequency * taken.timing.exposure_time)))
    factor = taken.case.stated[name]
    return float(getattr(found.sensitivity, f"{of}_by_{name}")[axis, tone]) * math.log(factor)


def is_assumed(found: rsv.DetectionResult, taken: Recording, axis: int, tones: list[dict[str, float]]) -> bool:
    """Whether the sensitivity to a stated assumption gives at least a third of every wrong parameter's error."""
    names = [name for name in taken.case.stated if any(name in text for text in found.assumptions)]
    for tone in tones:
        for of in ("amplitude", "frequency"):
            if abs(tone[f"{of}_z"]) > MANY_STD and abs(tone[f"{of}_error"]) > WRONG_SHARE:
                effect = sum(effect_of(found, taken, of, name, axis, int(tone["place"])) for name in names)
                if effect * tone[f"{of}_error"] <= 0 or abs(tone[f"{of}_error"]) > 3 * abs(effect):
                    return False
    return bool(names)


def mean_of_columns(found: rsv.DetectionResult, starts: torch.Tensor, exposure: float) -> torch.Tensor:
    """Displacement (T, R, 2) of the rows of a detected vibration, mean over the columns; roll moves them along x."""
    components = found.vibration.mean_displacement(starts, exposure)
    y = torch.arange(starts.shape[1], dtype=torch.float64) - 0.5 * (starts.shape[1] - 1) - components[..., 1]
    x, down = components[..., 0], components[..., 1]
    if components.shape[-1] > 2:
        x = x - components[..., 2] * y
    if components.shape[-1] > 3:
        down = down + components[..., 3] * y
    return torch.stack([x, down], -1)


def judge_axis(found: rsv.DetectionResult, taken: Recording, axis: int) -> dict[str, Any]:
    """Outcome and figures of x, y, roll or zoom; turns count as displacements at half the width from the centre."""
    num_frames, height = taken.starts.shape
    stated = taken.timing.row_starts(num_frames, height)
    if taken.timing.readout_direction == "reverse":  # in the order of the image rows
        stated = stated.flip(1)
    # 1. The displacement, and its difference from the true one.
    turns, arm = axis > 1, 0.5 * taken.frames.shape[-1] if axis > 1 else 1.0
    has_tones, true = taken.case.tones is not None and not turns, np.zeros((0, 3))
    if turns:
        shown = arm * found.vibration.mean_displacement(stated, taken.timing.exposure_time)[..., axis].numpy()
        truths = [arm * without_trend(taken.case.motion(taken.starts + 0.5 * taken.exposure)[axis], taken.starts)]
    else:
        shown = mean_of_columns(found, stated, taken.timing.exposure_time)[..., axis].numpy()
        truths = [without_trend(taken.displacement()[axis], taken.starts)]
    if has_tones:  # tones that are not observable may be found all the same
        true = observable_tones(taken, axis)
        truths.append(without_trend(taken.displacement_by(true), taken.starts))
    error, size = min((rms(without_trend(shown, stated.numpy()) - truth), rms(truth)) for truth in truths)
    stds = found.std if turns else found.std_if_hidden_tone or found.std
    moves = bool((found.vibration.amplitude[axis] > 0).any())
    std = arm * float(stds.displacement[axis]) if moves else 0.0
    # 2. The outcome.
    tones, wrong_number = tone_errors(found, true, axis) if has_tones else ([], False)
    wrong_parameter = any(
        abs(tone[f"{name}_z"]) > MANY_STD and abs(tone[f"{name}_error"]) > WRONG_SHARE
        for tone in tones
        for name in ("amplitude", "frequency")
    )
    wrong_displacement = error > max(WRONG_DISPLACEMENT * size, WRONG_PX) and (wrong_number or error > MANY_STD * std)
    if not bool(found.reliable[axis]):
        known = not (turns or taken.case.timing_is_wrong or wrong_parameter) and error < KNOWN_DISPLACEMENT * size
        outcome = "known" if known else "refused"
    elif not (wrong_parameter or wrong_displacement):
        outcome = "correct"
    else:
        outcome = "assumed" if not wrong_displacement and is_assumed(found, taken, axis, tones) else "wrong"
    return {
        "outcome": outcome,
        "wrong_parameter": outcome == "wrong" and wrong_parameter,
        "wrong_displacement": outcome == "wrong" and wrong_displacement,
        "tones": tones,
        "true_tones": int(size > 0) if turns else len(true),
        "found_tones": int((found.vibration.amplitude[axis] > 0).sum()),
        "largest_z": max((abs(t[f"{name}_z"]) for t in tones for name in ("amplitude", "frequency")), default=0.0),
        "displacement_px": size,
        "displacement_error": error / max(size, 1e-9),
        "displacement_std": std / max(size, 1e-9),
        "reasons": list(found.reasons[axis]),
    }


def best_constant(image: Array, still: Array, rim: int) -> tuple[float, float]:
    """Displacement (x, y) of a still frame with which it is most like an image."""
    inner = np.zeros(image.shape, np.uint8)
    inner[rim:-rim, rim:-rim] = 1
    window = np.outer(*(np.hanning(size) for size in image.shape))
    start, _ = cv2.phaseCorrelate(still.copy(), image.copy(), window)  # OpenCV 5.0 overwrites its arguments
    moved, criteria = np.eye(2, 3, dtype=np.float32), (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-9)
    moved[:, 2] = -np.array(start)
    with suppress(cv2.error):  # they do not correlate: the start remains
        pair = image.astype(np.float32), still.astype(np.float32)
        _, moved = cv2.findTransformECC(*pair, moved, cv2.MOTION_TRANSLATION, criteria, inner, 1)
    return float(-moved[0, 2]), float(-moved[1, 2])


def psnr(frames: Array, taken: Recording, stills: list[Array]) -> float:
    """PSNR in dB of frames relative to the still scene, each displaced by the best constant."""
    rim = int(RIM * frames.shape[-1])
    errors = []
    for number, (frame, still) in enumerate(zip(frames, stills, strict=True)):
        error = frame - taken.still(number, *best_constant(frame, still, rim))
        errors.append(np.mean(error[rim:-rim, rim:-rim] ** 2))
    return float(-10 * np.log10(np.mean(errors)))


def judge_case(name: str, number: int, size: int) -> dict[str, Any]:
    """Detection and restoration of a case."""
    taken = recording(name, number, size)
    frames = torch.from_numpy(taken.frames).float()
    case: dict[str, Any] = {"class": name, "number": number, "num_frames": len(frames), "noise": taken.case.noise}
    case["exposure"] = taken.case.exposure
    begin = time.perf_counter()
    try:
        found = rsv.detect_vibration(frames, taken.timing)
    except ValueError as error:
        return case | {"error": str(error), "axes": []}
    case["axes"] = [judge_axis(found, taken, axis) for axis in range(found.vibration.num_axes)]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", rsv.RestorationWarning)
        restored = rsv.restore(frames, taken.timing, found)
    case["seconds"] = time.perf_counter() - begin
    case["warnings"] = [str(one.message) for one in caught if one.category is rsv.RestorationWarning]
    stills = [taken.still(number) for number in range(len(frames))]
    case["raw_db"] = psnr(taken.frames, taken, stills)
    case["restored_db"] = psnr(restored.double().numpy(), taken, stills)
    return case


def rows(options: argparse.Namespace) -> Rows:
    return [
        judge_case(name, number, options.honesty_size)
        for name in options.honesty_classes
        for number in range(options.honesty_cases * MORE.get(name, 1))
    ]


def is_worse(case: dict[str, Any]) -> bool:
    """Whether restoration lowered the PSNR."""
    return "restored_db" in case and case["restored_db"] < case["raw_db"] - WORSE_DB


def covered(axes: list[dict[str, Any]]) -> list[Any]:
    """Share of 95 % intervals of amplitude and frequency that contain the truth, over reliable axes; their number."""
    tones = [tone for axis in axes if axis["outcome"] in ("correct", "wrong") for tone in axis["tones"]]
    if not tones:
        return ["", "", 0]
    shares = [np.mean([abs(tone[f"{name}_z"]) < WITHIN_95 for tone in tones]) for name in ("amplitude", "frequency")]
    return [*(f"{share:.0%}" for share in shares), len(tones)]


def counts(name: str, cases: Rows) -> list[Any]:
    """Line of the table for a class."""
    axes = [axis for case in cases for axis in case["axes"]]
    outcomes = [axis["outcome"] for axis in axes]
    worse = [case["warnings"] for case in cases if is_worse(case)]
    about_axes = [all("is not restored" in one for one in texts) for texts in worse if texts]
    reliable = [axis["largest_z"] for axis in axes if axis["outcome"] in ("correct", "wrong")]
    return [
        name,
        len(cases),
        outcomes.count("correct"),
        outcomes.count("assumed"),
        outcomes.count("wrong"),
        sum(axis["wrong_parameter"] for axis in axes),
        sum(axis["wrong_displacement"] for axis in axes),
        outcomes.count("refused") + 2 * sum("error" in case for case in cases),
        outcomes.count("known"),
        sum(not texts for texts in worse),
        sum(about_axes),
        f"{max(reliable, default=0.0):.1f}",
        *covered(axes),
    ]


def lines(results: Rows, options: argparse.Namespace) -> list[str]:
    """Counts of each class and in all, and the coverage of intervals."""
    classes = [
        (name, [case for case in results if case["class"] == name])
        for name in dict.fromkeys(case["class"] for case in results)
    ]
    for timing in ("correct", "wrong"):
        chosen = [case for case in results if (case["class"] in TIMING_CORRECT) == (timing == "correct")]
        classes.append((f"all, timing {timing}", chosen))
    modelled = [axis for case in results if case["class"].startswith(MODELLED) for axis in case["axes"]]
    heads = ("class", "cases", "correct", "assumed", "wrong", "parameters", "displacement", "refused")
    heads += ("although known", "worse, no warning", "worse, warning about an axis only", "largest error")
    within = ("amplitude within", "frequency within", "tones")
    return [
        f"Frames of {options.honesty_size} x {options.honesty_size} px; exposures are given for frames of 2048 rows.",
        "An axis is correct, assumed, wrong or refused. Assumed: the stated timing is wrong, and the result",
        "states this timing as an assumption with its effect. The columns 'parameters' and 'displacement' state",
        "why it is wrong: a parameter differs by more than 5 standard deviations and 2 %, or the displacement by more",
        "than 5 % and 0.01 px. 'Although known': refused, but the displacement is within 2 %. 'Worse': the",
        "PSNR after restoration is more than 0.1 dB lower. 'Largest error': of a tone of a reliable axis, in",
        "standard deviations. 'Within': share of the 95 % intervals that contain the truth.",
        "",
        *table((*heads, *within), [counts(*part) for part in classes]),
        *table(
            ("steady vibrations, timing correct", *within),
            [
                ("one tone", *covered([axis for axis in modelled if axis["true_tones"] == 1])),
                ("several tones", *covered([axis for axis in modelled if axis["true_tones"] > 1])),
            ],
        ),
    ]
