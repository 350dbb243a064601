"""Answers and files of the commands: what was detected and restored, what was left unchanged, and what to do next."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rsvib_torch import detection, io, stacks
from rsvib_torch import report as reports
from rsvib_torch.commands.shared_options import check_new
from rsvib_torch.commands.terminal import Answer, warn, working
from rsvib_torch.files.atomic import check_writable
from rsvib_torch.files.reading import Table
from rsvib_torch.text import AXES, number_of, printable

if TYPE_CHECKING:
    from rsvib_torch.config import Config
    from rsvib_torch.motion.detected_vibration import DetectedVibration
    from rsvib_torch.motion.timing import SensorTiming
    from rsvib_torch.results.presentation import Result


# a value for every row or knot
_CURVES = {"motion", "times", "displacement", "offsets", "fitted", "measured", "predicted"}


def without_curves(result: Result) -> Table:
    """The values of a result without its curves."""
    curves = _CURVES | ({"std"} if isinstance(result, detection.MotionDetection) else set())
    return {name: value for name, value in result.to_dict().items() if name not in curves}


def verdicts(detections: Sequence[DetectedVibration | detection.MotionDetection | None]) -> dict[str, bool]:
    """Whether each axis is reliable in all detections; None is one that failed."""
    flags = [[] if one is None else one.reliable.tolist() for one in detections]
    return {name: all(of_one[axis : axis + 1] == [True] for of_one in flags) for axis, name in enumerate(AXES)}


def stack_answer(frames: Path, result: detection.DetectionResult, pixel_size: float | None = None) -> Answer:
    """The vibration in a stack, also in units of length if the size of a pixel in m is given."""
    answer = Answer({f"Vibration in {frames.name}": [result.summary()]}, {"detection": without_curves(result)})
    answer.reliable = verdicts([result])
    if pixel_size is not None:
        answer.results[f"For pixels of {1e6 * pixel_size:.6g} µm"] = [result.physical_summary(pixel_size)]
    return answer


def restoration_lines(run: stacks.StackReport, stored: stacks.StackManifest) -> list[str]:
    """What a run restored, with warnings of what failed, and of frames that are not better."""
    nothing, forced = "no vibration was found that can be removed", " (--force writes the restored ones)"
    if run.bad_frames:
        warn(f"{number_of(run.bad_frames, 'frame')} could not be used: see {run.manifest.name}")
    failed = [record for record in stored.windows if record.error is not None]
    if failed:
        where = f"{number_of(len(failed), 'window')}; in window {failed[0].window}"
        warn(f"detection failed in {where}: {failed[0].error}")
    if not run.restored and not stored.doubts and not failed:
        warn(f"{nothing}: the frames are written unchanged")
    if {"partly", "worse"} & {record.outcome for record in stored.windows}:
        unchanged = any(record.outcome == "worse" and record.frames == "as taken" for record in stored.windows)
        warn(" ".join(stored.doubts) + (f"; its frames are written unchanged{forced}" if unchanged else ""))
    return [run.summary(), *stored.lines()[1]]


def next_step(sentence: str, *command: object) -> str:
    """A step: a sentence, and the command that does it, which can be copied into a shell."""
    return f"{sentence}:\n  {printable(shlex.join(['rsvib', *map(str, command)]))}"


def run_step(frames: Path, out: Path, arguments: Sequence[str]) -> str:
    """The step to detect and restore; a video is followed frame by frame."""
    video = ["--video"] * io.is_video(frames)
    return next_step("detect the vibration and restore the frames", "run", frames, out, *arguments, *video)


def steps_after_detection(
    result: detection.DetectionResult, frames: Path, settings: Config, vibration: Path | None = None
) -> list[str]:
    """What to do after a detection: restore with the file ``vibration``, or try another model."""
    steps = []
    if vibration is not None and bool(result.reliable.any()):
        restore = ("restore", frames, frames.with_name("restored.tif"), *settings.arguments, "--vibration", vibration)
        steps.append(next_step("restore the frames", *restore))
    reasons = [reason for of_axis in result.findings for reason in of_axis]
    other = {reason.code for reason in reasons if reason.code.startswith("other_")}
    run = ("run", frames, frames.with_name("results"), *settings.arguments)
    if "other_frame_times" in other:
        steps.append(next_step("restore the frames with the times of those after the lost one", *run))
    # any motion explains frames with a wrong timing as well
    elif any(reason.kind.free_model for reason in reasons) and not other:
        if vibration is not None:  # a run in windows measures vibrations that change
            steps.append(next_step("measure a vibration that changes, and restore the frames", *run))
        motion = ("motion", frames, *settings.arguments, "--out", "motion.csv")
        steps.append(next_step("detect a motion that is not a steady vibration", *motion))
    return [*steps, "follow the remedies that the reasons above name"] if reasons else steps


# Files in a folder

OF_DETECTION = ("vibration.json", "tones.csv", "offsets.csv", "offsets.png", "spectrum.csv", "spectrum.png")
OF_WINDOWS = ("manifest.json", "tones.csv", "windows.png")


def check_folder(
    folder: Path, names: Iterable[str], overwrite: bool, inputs: Iterable[Path], output: Path | None = None
) -> None:
    """Raise an error if results, among them a stack ``output``, exist in a folder or would replace an input."""
    stack = [] if output is None else io.stack_files(output)
    check_new([*(folder / name for name in dict.fromkeys(names)), *stack], overwrite, inputs, folder=folder)
    check_writable(folder, "folder")


def remove_old(folder: Path, results: Iterable[str], names: Iterable[str]) -> None:
    """Remove results of an earlier run from a folder that this run did not replace."""
    for name in set(results) - set(names):
        (folder / name).unlink(missing_ok=True)


def write_detection(
    folder: Path, result: detection.DetectionResult, timing: SensorTiming, pixel_size: float | None = None
) -> list[str]:
    """Write a detection as JSON, tables and figures, and return the names of the files."""
    with working("drawing the offset curve"):
        replace(result, timing=timing).save(folder / "vibration.json")
        reports.write_table(folder / "tones.csv", result, pixel_size=pixel_size)
        reports.write_offsets(folder / "offsets.csv", result)
        result.plot(folder / "offsets.png")
    with working("computing the spectrum"):
        try:
            spectrum = result.spectrum()
        except ValueError as error:  # few rows were measured; the frames are restored all the same
            warn(f"the spectrum is not written: {error}")
        else:
            reports.write_table(folder / "spectrum.csv", spectrum, pixel_size=pixel_size)
            spectrum.plot(folder / "spectrum.png")
    names = ("offsets.png", "spectrum.png", "vibration.json", "tones.csv", "offsets.csv", "spectrum.csv")
    return [name for name in names if (folder / name).exists()]


def write_windows(folder: Path, manifest: stacks.StackManifest, pixel_size: float | None = None) -> list[str]:
    """Write table and figure of windows, and return the names of the files."""
    with working("drawing the windows"):
        reports.write_table(folder / "tones.csv", manifest, pixel_size=pixel_size)
        if manifest.gyroscope is not None:  # no tones are searched for
            return ["tones.csv"]
        manifest.plot(folder / "windows.png")
    return ["windows.png", "tones.csv"]
