"""The command ``export``: a detected vibration in the file formats of other programs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import rsvib_torch
from rsvib_torch import export as exports
from rsvib_torch import io, restoration
from rsvib_torch import report as reports
from rsvib_torch.checks.validation import options
from rsvib_torch.commands.flat_command import argument, option
from rsvib_torch.commands.shared_options import check_file, size_of
from rsvib_torch.commands.terminal import Answer, warn
from rsvib_torch.options import ExportFormat
from rsvib_torch.text import AXES

_FORMAT_OF_ENDING: dict[str, ExportFormat] = {".gcsv": "gcsv", ".csv": "csv"}


@options
class ExportOptions:
    """Options of ``export``."""

    vibration: Path = argument()
    """The vibration.json written by detect or run."""
    out: Path = argument()
    """File to write."""
    file_format: ExportFormat | None = option(None, "--format", show_default="from the extension: .gcsv, .csv")
    """gcsv: angular rates, for Gyroflow; csv: offsets of the rows before and after correction."""
    frames: Path | None = None
    """The stack of frames, for their size and number (gcsv)."""
    size: str | None = option(None, metavar="HEIGHTxWIDTH")
    """Size of the frames in px, in place of --frames."""
    num_frames: int | None = None
    """Number of frames, in place of --frames."""
    focal_length: float | None = None
    """Focal length in px, for a vibration that was detected without one; required for gcsv."""
    sample_rate: float | None = option(None, show_default="chosen for an attitude within 2e-7 rad")
    """Samples per second of gcsv."""
    force: bool = False
    """Export axes as well that are not reliable or not accurate."""
    overwrite: bool = False
    """Replace results that exist already."""


def export(given: ExportOptions) -> Answer:
    """Write a detected vibration for other programs.

    As in rsvib restore, axes that are not reliable or not accurate are left out, unless --force is given.
    """
    out = given.out
    chosen = given.file_format or _FORMAT_OF_ENDING.get(out.suffix.lower())
    if chosen is None:
        raise ValueError(f"the format of {out.name} is not known from its name: give --format gcsv or csv")
    frames = [] if given.frames is None else io.stack_files(given.frames)
    check_file(out, given.overwrite, [given.vibration, *frames])
    detected = reports.read_vibration(given.vibration)
    if chosen == "csv":
        reports.write_offsets(out, detected)
        lines = []  # for each axis, root mean square of the offsets and of the residuals
        for axis, name in enumerate(AXES[: detected.vibration.num_axes]):
            before = detected.offsets.offsets[..., axis][detected.offsets.good]
            after, unit = before - detected.fitted[..., axis][detected.offsets.good], ("px", "px", "rad", "")[axis]
            size = [f"{float(values.square().mean().sqrt()):.3g} {unit}" for values in (before, after)]
            lines.append(f"{name}: {size[0]} before, {size[1]} after (root mean square)")
        return Answer({"Offsets before and after correction": lines}, {"format": chosen}, [out])
    timing = detected.timing
    if timing is None:
        raise ValueError(f"{given.vibration}: the timing of the sensor is missing; detect the vibration again")
    shape = None if given.size is None else size_of(given.size, "HEIGHTxWIDTH in px such as 1080x1920")
    count = given.num_frames
    if given.frames is not None:
        of_stack = io.read_stack_info(given.frames).shape
        shape, count = shape or (of_stack[-2], of_stack[-1]), of_stack[0] if count is None else count
    if shape is None or count is None:
        raise ValueError("size and number of the frames are not known: give --frames, or --size and --num-frames")
    motion = _trusted(given, detected, timing, count, shape[int(timing.scan_axis)])
    exports.write_gcsv(out, motion, timing, shape, count, sample_rate=given.sample_rate)
    text = f"of {count} frames, on the clock of the first row of frame 0"
    return Answer({"Angular rates": [text]}, {"format": chosen, "size": list(shape), "num_frames": count}, [out])


def _trusted(
    given: ExportOptions, detected: rsvib_torch.DetectionResult, timing: rsvib_torch.SensorTiming, count: int, rows: int
) -> rsvib_torch.Vibration:
    """The accurate part of a detected vibration, or all of it with ``force``; with a camera if its lens is given."""
    motion = detected.vibration
    if not given.force:
        motion, reasons = restoration.trusted_vibration(detected, timing, count, rows)
        notes = [str(replace(one, details={**one.details, "action": "exported"})) for one in reasons]
        if not bool(motion.moving_axes().any()):
            why = "; ".join(notes) or "no vibration"
            raise ValueError(f"nothing to export: {why}; --force exports it nevertheless")
        for note in notes:
            warn(note)
    if given.focal_length is None:
        return motion
    if motion.camera is not None:
        known = f"focal_length={motion.camera.focal_length:g} px"
        raise ValueError(f"the vibration was detected with {known}; omit --focal-length")
    return motion.with_camera(rsvib_torch.Camera(given.focal_length))
