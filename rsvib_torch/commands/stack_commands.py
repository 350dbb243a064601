"""The commands ``detect``, ``motion`` and ``restore``, and how all commands read frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import rsvib_torch
from rsvib_torch import detection, io, stacks
from rsvib_torch import report as reports
from rsvib_torch.checks.values import options
from rsvib_torch.commands import answers
from rsvib_torch.commands import shared_options as shared
from rsvib_torch.commands.flat_command import Given, argument, option
from rsvib_torch.commands.terminal import Answer, current_output, warn, working
from rsvib_torch.files.atomic import check_writable, whole
from rsvib_torch.files.reading import Table
from rsvib_torch.options import FreeMotionOptions, MotionUnit

if TYPE_CHECKING:
    from torch import Tensor

    from rsvib_torch.io.stack_info import StackInfo


def load(command: shared.StackCommand) -> tuple[Tensor, rsvib_torch.SensorTiming]:
    """Read a stack that is processed as a whole, if the memory suffices for it.

    The frames are (T, H, W) or (T, C, H, W), full scale 1; the timing has the frame times of the file.
    """
    device = stacks.chosen_device(command.device)
    stacks.check_stack_fits(command.info, on_gpu=device.type != "cpu")
    with working(f"reading {command.frames}"):
        frames = io.read_stack(command.frames, full_scale=command.scale)
    command.print_notes()
    return frames.to(device), io.timing_from_first_frame(command.settings.timing, command.info)


@options
class DetectCommand(shared.StackCommand, shared.PixelSizeOptions, shared.VerdictOptions):
    """Options of ``detect``."""

    out: Path = option(...)
    """Folder for vibration.json, tables (tones, offsets, spectrum) and figures."""


def detect(command: DetectCommand) -> Answer:
    """Detect the vibration in a stack of frames.

    The vibration is modelled as sinusoids of constant amplitude and frequency in all frames. For those that change, and
    for long stacks, see rsvib run, which detects in windows; for other motion see rsvib motion.
    """
    settings, frames, out = command.settings, command.frames, command.out
    answers.check_folder(out, answers.OF_DETECTION, command.overwrite, command.inputs)
    pixels, timing = load(command)
    with working("detecting the vibration"):
        result = detection.detect_vibration(pixels, timing, channels=io.channels_of(pixels), **settings.detection)
    with whole(out, "folder") as folder:
        names = answers.write_detection(folder, result, timing, command.pixel_size)
    answer = answers.stack_answer(frames, result, command.pixel_size)
    answer.next_steps += answers.steps_after_detection(result, frames, settings, out / "vibration.json")
    answers.remove_old(out, answers.OF_DETECTION, names)
    answer.files += [out / name for name in names]
    return answer


@options
class MotionCommand(shared.StackCommand, shared.VerdictOptions):
    """Options of ``motion``."""

    out: Path = option(...)
    """CSV file to write: time in s, x and y in px, and their standard deviations."""
    detection: Annotated[Table, Given(FreeMotionOptions, ("knot_rows", "search"))]


def motion(command: MotionCommand) -> Answer:
    """Detect motion that is not a steady vibration.

    To restore frames with the CSV file: rsvib restore --motion FILE --unit px --offset 0.
    """
    out, frames = command.out, command.frames
    if out.suffix.lower() != ".csv":
        raise ValueError(f"--out must be a .csv file, got {out}")
    shared.check_file(out, command.overwrite, command.inputs)
    pixels, timing = load(command)
    with working("detecting the motion"):
        result = detection.detect_motion(pixels, timing, channels=io.channels_of(pixels), **command.detection)
    columns = reports.motion_columns(result, timing)
    reports.write_columns(out, columns)
    known_motion = ("--motion", out, "--unit", "px", "--offset", "0")
    restore = ("restore", frames, frames.with_name("restored.tif"), *command.settings.arguments, *known_motion)
    return Answer(
        {f"Motion in {frames.name}": [result.summary()]},
        {"motion": answers.without_curves(result), "columns": list(columns)},
        [out],
        [answers.next_step("restore the frames", *restore)] * bool(result.reliable.any()),
        answers.verdicts([result]),
    )


@options
class RestoreCommand(shared.RestoringCommand):
    """Options of ``restore``."""

    restored: Path = argument()
    """Stack to write, with the data type and full scale of the input. The extension selects the format; .mp4 and .mkv
    are videos with the time stamps and the sound of the input."""
    vibration: Path | None = None
    """The vibration.json written by detect or run."""
    motion: Path | None = None
    """In place of a vibration: CSV file with the columns time in s, x and y; or, without --unit, the angular rates of a
    gyroscope: a gyroflow log (.gcsv), a GoPro video (.mp4), or CSV with three rates whose names state the unit."""
    unit: MotionUnit | None = option(None, show_default="the rates of a gyroscope")
    """Unit of x and y: px, an angle, or an angular rate."""
    focal_length: float | None = option(None, show_default="for a gyroscope, estimated from the frames")
    """Focal length in px; required for angles and angular rates."""
    lens_profile: Path | None = option(None, show_default="a lens without distortion")
    """With a gyroscope: lens profile of Gyroflow (JSON)."""
    offset: float | None = option(None, show_default="for a gyroscope, estimated from the frames")
    """Required with --unit: time of the recording, in s, at the exposure start of the first row of frame 0."""
    ignore: list[str] | None = option(None, metavar="ROWS[,COLUMNS]", show_default="all rows count")
    """With a gyroscope: rows of the frames, or a part of them, that do not count in the comparison with it, for example
    400: for a dashboard below row 400, or :60,500: for a sign in a corner; may be given several times."""

    @property
    def manifest(self) -> Path:
        """What was restored in each window."""
        return self.restored.with_name(f"{self.restored.name}.manifest.json")


def restore(command: RestoreCommand) -> Answer:
    """Restore a stack of frames with a detected vibration or a recorded motion.

    The offset of a recorded motion is stated (--offset); that of a gyroscope is found by the frames: rates that do not
    explain them are refused. If the restored frames are judged no better than the input, the input is written
    unchanged. --force restores in both cases.
    """
    settings, vibration = command.settings, command.vibration
    outputs = [*io.stack_files(command.restored), command.manifest]
    shared.check_new(outputs, command.replaces, [*command.inputs, vibration, command.motion, command.lens_profile])
    current_output().work = stacks.work_folder(command.restored)
    check_writable(command.restored, "file" if command.restored.suffix else "folder")
    # 1. The vibration of all frames, or the motion on the clock of the frames.
    info, of_run = command.info, Table()
    if vibration is not None and command.motion is None:
        of_recordings = ("offset", "unit", "ignore", "focal_length", "lens_profile")
        if useless := [name for name in of_recordings if getattr(command, name) not in (None, ())]:
            name = useless[0].replace("_", "-")
            raise ValueError(f"--{name} is for --motion, a recording; --vibration is that of the frames themselves")
        detected = reports.read_vibration(vibration, io.timing_from_first_frame(settings.timing, info))
        command.print_notes()
        of_run |= {"given": [detected], "window": max(2, info.shape[0])}
        answer = Answer({"Vibration": [detected.summary()]}, {"detection": answers.without_curves(detected)})
    elif command.motion is not None and vibration is None:
        answer = Answer({}, {"alignment": None})
        of_run["motion"] = _motion_of_frames(command, command.motion, replace(info, full_scale=command.scale), answer)
    else:
        raise ValueError("give --vibration FILE, or --motion FILE of a recording")
    # 2. Restoration in windows.
    run = command.process(command.restored, of_run)
    stored = stacks.read_manifest(run.manifest)
    answer.results["Restoration"] = answers.restoration_lines(run, stored)
    answer.data["restoration"] = stored.totals()
    answer.files += [command.restored, command.manifest]
    return answer


def _motion_of_frames(command: RestoreCommand, path: Path, info: StackInfo, answer: Answer) -> rsvib_torch.FreeMotion:
    """A recorded motion on the clock of the frames, which is stated or estimated."""
    recorded, timing = _recorded(command, path), command.settings.timing
    ignore = stacks.mask_of_regions(command.ignore or (), (info.shape[-2], info.shape[-1]))
    command.print_notes()
    if isinstance(recorded, rsvib_torch.FreeMotion):
        if command.offset is None:
            raise ValueError(
                f"--unit {command.unit} needs --offset: the time of the recording when frame 0 begins, in s"
            )
        return recorded.retimed(command.offset)
    camera = None
    if command.lens_profile is not None:
        camera = rsvib_torch.Camera.from_gyroflow(command.lens_profile, info.shape[-1], info.shape[-2])
    elif command.focal_length is not None:
        camera = rsvib_torch.Camera(command.focal_length)
    with working("aligning the recording"):
        alignment = stacks.align_stack(command.frames, info, timing, recorded, camera=camera, ignore=ignore)
    answer.results["Recording on the clock of the frames"] = [alignment.summary()]
    answer.data["alignment"] = answers.without_curves(alignment)
    if alignment.reasons and not command.force:
        raise ValueError(f"{path}: {'; '.join(alignment.reasons)}; --force restores with it nevertheless")
    for reason in alignment.reasons:
        warn(reason)
    return alignment.motion


def _recorded(command: RestoreCommand, path: Path) -> rsvib_torch.FreeMotion | rsvib_torch.AngularRates:
    """The motion of a CSV file, or the rates of a gyroscope."""
    if command.unit is not None:
        if command.lens_profile is not None or command.ignore:
            name = "--ignore" if command.lens_profile is None else "--lens-profile"
            raise ValueError(f"{name} is for a gyroscope, without --unit")
        return rsvib_torch.read_motion(path, unit=command.unit, focal_length=command.focal_length)
    if command.offset is not None:
        raise ValueError("--offset needs --unit; axes and clock of a gyroscope are estimated from the frames")
    if command.lens_profile is not None and command.focal_length is not None:
        raise ValueError("--lens-profile and --focal-length both state the focal length: give one of them")
    return rsvib_torch.read_gyroscope(path)
