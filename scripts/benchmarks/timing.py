"""Mistakes of the stated timing: what a user sees, and what restoration loses.

Recordings of the camera of benchmarks/honesty_camera.py, which shares no code with the package: three scenes with three
vibrations each, one tone along each axis, twelve frames. Every mistake is stated for the same frames, of which
detection gets the first 2, 4, 8 or 12. An axis is

* detected: refused, or restored with a warning; the cause is named if a reason states the mistaken setting,
* assumed: reliable and wrong as defined in benchmarks/honesty.py, but the result names the mistaken setting among its
  assumptions,
* missed: reliable and wrong, and the result does not mention the setting,
* right: reliable, and not wrong in spite of the mistake.

The loss is the PSNR of the first two frames restored with the correct timing less that with the mistake, each as
``restore`` returns them: the rows of refused axes are not moved. Frames are compared as in benchmarks/honesty.py.
"""

import argparse
import itertools
import warnings
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from benchmarks.honesty import judge_axis, psnr
from benchmarks.honesty_cases import BLANKING, Recording, plain, record
from harness import Rows, one_thread, table

import rsvib_torch as rsv

OPTIONS = {
    "mistake_size": (160, "timing: rows and columns of the frames"),
    "mistake_vibrations": (3, "timing: vibrations of each scene"),
    "mistake_scenes": (("city", "chart", "text"), "timing: scenes"),
    "mistake_names": ((), "timing: mistakes, all if none are named", str),
}
QUICK = {"mistake_size": 128, "mistake_vibrations": 1, "mistake_scenes": ("city",)}
QUICK |= {"mistake_names": ("none", "frame_rows = image height")}
NUM_FRAMES = (2, 4, 8, 12)
EXPOSURE = 100.0  # rows of a frame of 2048 rows, so that twice and half of it differ in their blur
RESTORED = 2  # frames


@dataclass(frozen=True)
class Mistake:
    """A mistake of the timing."""

    state: Callable[[rsv.SensorTiming], rsv.SensorTiming]  # from the correct timing to the stated one
    # the mistaken setting, which an assumption must name. The ratio of frame period and row time is ``frame_rows``,
    # also if it is wrong because of ``row_time``.
    setting: str
    code: str  # code of the reason that names this setting as the cause; empty for none


def scaled(setting: str, code: str, **factors: float) -> Mistake:
    """Times that are stated as multiples of the correct ones."""

    def state(timing: rsv.SensorTiming) -> rsv.SensorTiming:
        return replace(timing, **{name: getattr(timing, name) * factor for name, factor in factors.items()})

    return Mistake(state, setting, code)


def wrong_frame_rows(factor: float) -> Mistake:
    """Other row times from frame to frame."""
    return scaled("frame_rows", "other_frame_rows", frame_rows=factor)


def wrong_row_time(factor: float) -> Mistake:
    """Another row time, with the correct frame rate and exposure time in seconds."""
    factors = {"row_time": factor, "frame_rows": 1 / factor, "exposure_rows": 1 / factor}
    return scaled("frame_rows", "other_frame_rows", **factors)


MISTAKES: dict[str, Mistake] = {
    "none": Mistake(lambda timing: timing, "none", ""),
    **{
        f"row_time {error:+.0%}, frame rate correct": wrong_row_time(1 + error)
        for error in (-0.10, -0.03, -0.01, 0.01, 0.03, 0.10)
    },
    **{f"frame_rows {error:+.1%}": wrong_frame_rows(1 + error) for error in (-0.02, -0.005, 0.005, 0.02)},
    "exposure x 0.5": scaled("exposure_rows", "blur_contradicts_exposure", exposure_rows=0.5),
    "exposure x 2": scaled("exposure_rows", "blur_contradicts_exposure", exposure_rows=2.0),
    "readout reversed": Mistake(
        lambda timing: replace(timing, readout_direction="reverse"), "readout direction", "other_readout_direction"
    ),
    "scan axis exchanged": Mistake(lambda timing: replace(timing, scan_axis="x"), "scan axis", "other_scan_axis"),
    "frame_rows = image height": wrong_frame_rows(1 / BLANKING),
    # all times are wrong by one factor; every other factor gives the same result, with frequencies over this factor
    "row_time = 1 / (frame rate x height)": scaled("row_time", "other_row_time", row_time=BLANKING),
    "both of these": wrong_row_time(BLANKING),
}


def take(scene: str, number: int, size: int) -> Recording:
    """A recording with correct timing."""
    generator = np.random.default_rng([zlib.crc32(b"timing mistakes"), zlib.crc32(scene.encode()), number])
    return record(plain(generator, num_frames=max(NUM_FRAMES), exposure=EXPOSURE, scene=scene), generator, size)


def judge_mistake(taken: Recording, name: str, num_frames: int) -> dict[str, Any]:
    """Outcome of one mistake with the first frames of a recording."""
    mistake = MISTAKES[name]
    timing = mistake.state(taken.timing)
    stated = replace(taken, frames=taken.frames[:num_frames], timing=timing, starts=taken.starts[:num_frames])
    case: dict[str, Any] = {"mistake": name, "num_frames": num_frames}
    frames = torch.from_numpy(stated.frames).float()
    first = replace(stated, frames=stated.frames[:RESTORED], starts=stated.starts[:RESTORED])
    stills = [taken.still(frame) for frame in range(RESTORED)]
    case["raw_db"] = psnr(first.frames, first, stills)
    try:
        found = rsv.detect_vibration(frames, timing)
    except ValueError:  # refused with another message
        return case | {"outcomes": ["detected"] * 2, "named": [False] * 2, "restored_db": case["raw_db"]}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", rsv.RestorationWarning)
        restored = rsv.restore(frames[:RESTORED], timing, found)
    # a warning that an axis is not restored repeats its refusal
    texts = [str(one.message) for one in caught if one.category is rsv.RestorationWarning]
    warned = [text for text in texts if "is not restored" not in text]
    assumed = any(mistake.setting in text.split(":")[0] for text in found.assumptions)
    case["outcomes"], case["named"] = [], []
    for axis in range(2):
        judged = judge_axis(found, stated, axis)["outcome"]
        outcome = "right" if judged == "correct" else "assumed" if assumed else "missed"
        outcome = "detected" if judged in ("refused", "known") or warned else outcome
        case["outcomes"].append(outcome)
        codes = [reason.code for reason in found.findings[axis]]
        case["named"].append(outcome == "detected" and mistake.code in codes)
    case["restored_db"] = psnr(restored.double().numpy(), first, stills)
    return case


def rows(options: argparse.Namespace) -> Rows:
    """All mistakes with all recordings."""
    with one_thread():
        return [
            {"scene": scene, "number": number, **judge_mistake(taken, name, count)}
            for scene, number in itertools.product(options.mistake_scenes, range(options.mistake_vibrations))
            for taken in [take(scene, number, options.mistake_size)]
            for count in NUM_FRAMES
            for name in options.mistake_names or MISTAKES
        ]


def share(cases: Rows, outcome: str) -> float:
    """Percentage of the axes of cases with an outcome."""
    return float(100 * np.mean([one == outcome for case in cases for one in case["outcomes"]]))


def lines(results: Rows, options: argparse.Namespace) -> list[str]:
    """Tables of the shares and of the loss, one row per mistake and one column per number of frames."""
    names = list(dict.fromkeys(case["mistake"] for case in results))
    chosen: dict[tuple[str, int], Rows] = {}
    for case in results:
        chosen.setdefault((case["mistake"], case["num_frames"]), []).append(case)
    correct = {(one["scene"], one["number"], one["num_frames"]): one for one in results if one["mistake"] == "none"}

    def detected(name: str, cases: Rows) -> str:
        named = 100 * np.mean([one for case in cases for one in case["named"]])
        return f"{share(cases, 'detected'):.0f} ({named:.0f})"

    def wrong(name: str, cases: Rows) -> str:
        return f"{share(cases, 'assumed'):.0f} / {share(cases, 'missed'):.0f}"

    def loss(name: str, cases: Rows) -> str:
        of_cases = [
            correct[case["scene"], case["number"], case["num_frames"]]["restored_db"] - case["restored_db"]
            for case in cases
        ]
        gain = np.mean([case["restored_db"] - case["raw_db"] for case in cases])
        return f"(gain {gain:.1f})" if name == "none" else f"{np.mean(of_cases):.1f}"

    def counted(head: str, cell: Callable[[str, Rows], str]) -> list[str]:
        cells = [(name, *(cell(name, chosen[name, count]) for count in NUM_FRAMES)) for name in names]
        return [head, "", *table(("mistake", *(f"{count} frames" for count in NUM_FRAMES)), cells)]

    return [
        f"Frames of {options.mistake_size} x {options.mistake_size} px, exposed for {EXPOSURE:.0f} / 2048 of the rows;",
        f"a frame period has {BLANKING:g} row times per row. {len({case['scene'] for case in results})} scenes with "
        f"{options.mistake_vibrations}",
        "vibrations each, one tone along each axis. Every cell has both axes of these recordings. The row 'none' is",
        "for correct timing, and contains the false alarms.",
        "",
        *counted("Percentage of axes that are detected as doubtful (of all axes, with the cause named):", detected),
        *counted(
            "Percentage of axes that are reliable and wrong, with / without the setting among the assumptions:", wrong
        ),
        *counted("Loss of restoration in dB relative to the correct timing, mean over the recordings:", loss),
    ]
