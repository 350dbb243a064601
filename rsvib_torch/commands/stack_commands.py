"""The commands ``detect`` and ``restore``, and how all commands read frames."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import rsvib_torch
from rsvib_torch import detection, io, stacks
from rsvib_torch import report as reports
from rsvib_torch.checks.validation import options
from rsvib_torch.commands import answers
from rsvib_torch.commands import shared_options as shared
from rsvib_torch.commands.flat_command import Given, option
from rsvib_torch.commands.terminal import Answer, note, working
from rsvib_torch.files.atomic import whole_folder
from rsvib_torch.files.reading import Table
from rsvib_torch.options import DetectStackOptions

if TYPE_CHECKING:
    from torch import Tensor

    from rsvib_torch.config import Config


def load(given: shared.StackCommand, restoration: Table | None = None) -> tuple[Tensor, rsvib_torch.SensorTiming]:
    """Read a stack that is processed as a whole, if the memory suffices for it and for the restoration that follows.

    The frames are (T, H, W) or (T, C, H, W), full scale 1; the timing has the frame times of the file.
    """
    stacks.check_stack_fits(given.info, restoration, on_gpu=given.torch_device.type != "cpu")
    with working(f"reading {given.frames}"):
        frames = io.read_stack(given.frames, full_scale=given.scale)
    print_notes(given.info, given.settings)
    return frames.to(given.torch_device), io.timing_from_first_frame(given.settings.timing, given.info)


def read_frames(path: Path, indices: Sequence[int], full_scale: float | None) -> Tensor:
    """Frames of a stack, (T, H, W) or (T, C, H, W) with full scale 1 and 0 for missing pixels."""
    import numpy as np  # noqa: PLC0415

    with closing(io.open_stack(path)) as reader:
        info, pixels = reader.info, np.stack([reader.frame(index) for index in indices])
    return io.counts_to_frames(pixels, full_scale or info.full_scale, str(path), info.nodata).nan_to_num(0.0)


def print_notes(info: io.StackInfo, config: Config) -> None:
    """Print what the file states about orientation, dropped frames and unequal intervals."""
    for sentence in io.describe_stack(info, config.timing):
        note(sentence)


def _detect(frames: Tensor, timing: rsvib_torch.SensorTiming, config: Config) -> detection.DetectionResult:
    with working("detecting the vibration"):
        return detection.detect_vibration(frames, timing, **config.detection)


@options
class DetectOptions(shared.StackCommand, shared.PixelSizeOptions, shared.VerdictOptions):
    """Options of ``detect``."""

    out: Path = option(...)
    """Folder for vibration.json, tables (tones, offsets, spectrum) and figures."""
    windows: Annotated[
        Table,
        Given(
            DetectStackOptions,
            ("memory", "workers", "follow"),
            forms={
                "window": {
                    "text": "Detect separately in windows of at most this number of frames; writes manifest.json and "
                    "tones.csv.",
                    "show_default": "from the configuration, or all frames together if there are at most 256 and "
                    "their vibration is steady, else 8",
                }
            },
        ),
    ]


def detect(given: DetectOptions) -> Answer:
    """Detect the vibration in a stack of frames.

    The vibration is modelled as sinusoids of constant amplitude and frequency; if they change within the frames, they
    are followed from frame to frame. For other motion see rsvib motion.
    """
    settings, frames, out = given.settings, given.frames, given.out
    answers.check_folder(out, (*answers.OF_DETECTION, *answers.OF_WINDOWS), given.overwrite, given.inputs)
    windows = {name: value for name, value in settings.stack.items() if name in ("window", "follow")} | given.windows
    count = given.info.shape[0]
    result, many = None, "window" in windows or windows.get("follow") is True or count > _LONG
    with whole_folder(out) as folder:
        if many:
            print_notes(given.info, settings)
        else:
            pixels, timing = load(given)
            result = _detect(pixels, timing, settings)
            may_change = windows.get("follow") is not False and stacks.may_change(result, count)
        if many or may_change:
            stored = _detect_windows(given, folder / "manifest.json", windows)
            found = stored.detections()
            reliable = sum(0.0 if one is None else float(one.reliable.sum()) for one in found) / len(found)
            if result is not None and not reliable > float(result.reliable.sum()):
                (folder / "manifest.json").unlink()  # a steady vibration of all frames is known as well
            else:
                result = None
        if result is not None:
            names = answers.write_detection(folder, result, timing, given.pixel_size)
            answer = answers.stack_answer(frames, result, given.pixel_size)
            answer.next_steps += answers.steps_after_detection(result, frames, settings, out / "vibration.json")
        else:
            names = [*answers.write_windows(folder, stored, given.pixel_size), "manifest.json"]
            title = f"Vibration in {len(stored.windows)} windows of {frames.name}"
            answer = answers.windows_answer(title, stored, pixel_size=given.pixel_size)
            command = ["run", frames, out / "restored", *settings.arguments]
            command += ["--follow"] if windows.get("follow") is True else []
            answer.next_steps.append(answers.next_step("restore the frames", *command))
    answers.remove_old(out, (*answers.OF_DETECTION, *answers.OF_WINDOWS), names)
    answer.files += [out / name for name in names]
    return answer


# frames; longer stacks are detected in windows, shorter ones as a whole: 256 of 266 x 264 px take 21 s of a processor
_LONG = 256


def _detect_windows(given: DetectOptions, manifest: Path, windows: Table) -> stacks.StackManifest:
    """Detect the vibration in the windows of a stack, and write the manifest."""
    with working(f"detecting in {given.frames.name}", counts=True) as progress:
        stacks.detect_stack(
            given.frames,
            manifest,
            given.settings.timing,
            **windows,
            detection=None if windows.get("follow") is True else given.settings.detection,
            full_scale=given.scale,
            device=str(given.torch_device),
            progress=progress,
        )
    return stacks.read_manifest(manifest)


@options
class RestoreOptions(shared.RestoredStack, shared.RestorationCommand):
    """Options of ``restore``."""

    vibration: Path = option(...)
    """The vibration.json written by detect or run."""


def restore_frames(given: RestoreOptions) -> Answer:
    """Restore a stack of frames with a detected vibration.

    The result is judged. If the restored frames are judged no better than the input, the input is written
    unchanged, unless --force is given.
    """
    settings, frames, restored = given.settings, given.frames, given.restored
    shared.check_new([*io.stack_files(restored), given.manifest], given.overwrite, [*given.inputs, given.vibration])
    info, scale, options = given.planned_stack(given.restoration)
    detected = reports.read_vibration(given.vibration, io.timing_from_first_frame(settings.timing, info))
    stacks.check_stack_fits(info, options, on_gpu=given.torch_device.type != "cpu")
    print_notes(info, settings)
    of_run = given.of_stack(scale, options) | {"force": given.force, "given": [detected]}
    with working(f"restoring {frames.name}"):
        run = stacks.process_stack(frames, restored, settings.timing, window=max(2, info.shape[0]), **of_run)
    lines, data = answers.restoration_of(run, restored)
    return Answer(
        {"Vibration": [detected.summary()], "Restoration": lines},
        {"detection": detected.to_dict(), "restoration": data},
        [restored, given.manifest],
    )
