"""The command ``export``: a detected vibration as angular rates for other programs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import rsvib_torch
from rsvib_torch import export as exports
from rsvib_torch import io, restoration
from rsvib_torch import report as reports
from rsvib_torch.checks.validation import options
from rsvib_torch.commands.flat_command import argument, option
from rsvib_torch.commands.shared_options import check_file
from rsvib_torch.commands.terminal import Answer, warn


@options
class ExportOptions:
    """Options of ``export``."""

    vibration: Path = argument()
    """The vibration.json written by detect or run."""
    out: Path = argument()
    """File to write (.gcsv)."""
    frames: Path = option(...)
    """The stack of frames, for their size and number."""
    focal_length: float | None = None
    """Focal length in px, for a vibration that was detected without one."""
    force: bool = False
    """Export axes as well that are not reliable or not accurate."""
    overwrite: bool = False
    """Replace results that exist already."""


def export(given: ExportOptions) -> Answer:
    """Write a detected vibration as angular rates for Gyroflow.

    As in rsvib restore, axes that are not reliable or not accurate are left out, unless --force is given.
    """
    out = given.out
    check_file(out, given.overwrite, [given.vibration, *io.stack_files(given.frames)])
    if out.suffix.lower() != ".gcsv":
        raise ValueError(f"{out}: the name of a file for Gyroflow ends with .gcsv")
    detected = reports.load_detection(given.vibration)
    timing = detected.timing
    if timing is None:
        raise ValueError(f"{given.vibration}: the timing of the sensor is missing; detect the vibration again")
    shape = io.read_stack_info(given.frames).shape
    count, size = shape[0], (shape[-2], shape[-1])
    motion = detected.vibration
    if not given.force:  # the accurate part
        motion, reasons = restoration.trusted_vibration(detected, timing, count, size[int(timing.scan_axis)])
        notes = [str(replace(one, details={**one.details, "action": "exported"})) for one in reasons]
        if not bool(motion.moving_axes().any()):
            why = "; ".join(notes) or "no vibration"
            raise ValueError(f"nothing to export: {why}; --force exports it nevertheless")
        for note in notes:
            warn(note)
    if given.focal_length is not None:
        if motion.camera is not None:
            known = f"focal_length={motion.camera.focal_length:g} px"
            raise ValueError(f"the vibration was detected with {known}; omit --focal-length")
        motion = motion.with_camera(rsvib_torch.Camera(given.focal_length))
    exports.write_gcsv(out, motion, timing, size, count)
    text = f"of {count} frames, on the clock of the first row of frame 0"
    return Answer({"Angular rates": [text]}, {"size": list(size), "num_frames": count}, [out])
