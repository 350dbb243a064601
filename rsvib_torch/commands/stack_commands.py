"""The commands ``detect`` and ``motion``, and how all commands read frames."""

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
from rsvib_torch.options import FreeMotionOptions

if TYPE_CHECKING:
    from torch import Tensor

    from rsvib_torch.config import Config


def load(given: shared.StackCommand) -> tuple[Tensor, rsvib_torch.SensorTiming]:
    """Read a stack that is processed as a whole, if the memory suffices for it.

    The frames are (T, H, W) or (T, C, H, W), full scale 1; the timing has the frame times of the file.
    """
    stacks.check_stack_fits(given.info, on_gpu=given.torch_device.type != "cpu")
    with working(f"reading {given.frames}"):
        frames = io.read_stack(given.frames, full_scale=given.scale)
    print_notes(given.info, given.settings)
    return frames.to(given.torch_device), io.timing_from_first_frame(given.settings.timing, given.info)


def read_frames(path: Path, indices: Sequence[int], full_scale: float | None) -> Tensor:
    """Frames of a stack, (T, H, W) or (T, C, H, W) with full scale 1 and 0 for missing pixels."""
    import numpy as np  # noqa: PLC0415

    with closing(io.open_stack(path)) as reader:
        info = reader.info
        pixels = np.empty((len(indices), *info.shape[1:]), info.dtype)
        for place, index in enumerate(indices):
            pixels[place] = reader.frame(index)
    return io.counts_to_frames(pixels, full_scale or info.full_scale, str(path), info.nodata).nan_to_num(0.0)


def print_notes(info: io.StackInfo, config: Config) -> None:
    """Print what the file states about orientation, dropped frames and unequal intervals."""
    for sentence in io.describe_stack(info, config.timing):
        note(sentence)


@options
class DetectOptions(shared.StackCommand, shared.PixelSizeOptions, shared.VerdictOptions):
    """Options of ``detect``."""

    out: Path = option(...)
    """Folder for vibration.json, tables (tones, offsets, spectrum) and figures."""


def detect(given: DetectOptions) -> Answer:
    """Detect the vibration in a stack of frames.

    The vibration is modelled as sinusoids of constant amplitude and frequency in all frames. For those that change, and
    for long stacks, see rsvib run, which detects in windows; for other motion see rsvib motion.
    """
    settings, frames, out = given.settings, given.frames, given.out
    answers.check_folder(out, answers.OF_DETECTION, given.overwrite, given.inputs)
    pixels, timing = load(given)
    with working("detecting the vibration"):
        result = detection.detect_vibration(pixels, timing, **settings.detection)
    with whole_folder(out) as folder:
        names = answers.write_detection(folder, result, timing, given.pixel_size)
    answer = answers.stack_answer(frames, result, given.pixel_size)
    answer.next_steps += answers.steps_after_detection(result, frames, settings, out / "vibration.json")
    answers.remove_old(out, answers.OF_DETECTION, names)
    answer.files += [out / name for name in names]
    return answer


@options
class MotionOptions(shared.StackCommand, shared.VerdictOptions):
    """Options of ``motion``."""

    out: Path = option(...)
    """CSV file to write: time in s, x and y in px, and their standard deviations."""
    detection: Annotated[Table, Given(FreeMotionOptions, ("knot_rows", "search"))]


def motion(given: MotionOptions) -> Answer:
    """Detect motion that is not a steady vibration.

    To restore frames with the CSV file: rsvib restore --motion FILE --unit px --offset 0.
    """
    out, frames = given.out, given.frames
    shared.check_file(out, given.overwrite, given.inputs)
    pixels, timing = load(given)
    with working("detecting the motion"):
        result = detection.detect_motion(pixels, timing, **given.detection)
    columns = reports.motion_columns(result, timing)
    reports.write_columns(out, columns)
    known_motion = ("--motion", out, "--unit", "px", "--offset", "0")
    restore = ("restore", frames, frames.with_name("restored.tif"), *given.settings.arguments, *known_motion)
    return Answer(
        {f"Motion in {frames.name}": [result.summary()]},
        {"motion": answers.without_curves(result), "columns": list(columns)},
        [out],
        [answers.next_step("restore the frames", *restore)] * bool(result.reliable.any()),
        answers.verdicts([result]),
    )
