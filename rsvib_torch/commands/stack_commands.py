"""The commands ``detect`` and ``restore``, and how all commands read frames."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import rsvib_torch
from rsvib_torch import detection, io, stacks
from rsvib_torch import report as reports
from rsvib_torch.checks.validation import options
from rsvib_torch.commands import answers
from rsvib_torch.commands import shared_options as shared
from rsvib_torch.commands.flat_command import option
from rsvib_torch.commands.terminal import Answer, note, working
from rsvib_torch.files.atomic import whole_folder
from rsvib_torch.files.reading import Table

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
