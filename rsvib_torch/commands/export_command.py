"""The command ``export``: a detected vibration in the file formats of other programs."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rsvib_torch import detection, io, restoration
from rsvib_torch import report as reports
from rsvib_torch.commands.shared_options import OverwriteOption, check_new
from rsvib_torch.commands.terminal import Answer, error_line, working
from rsvib_torch.core.atomic import check_writable
from rsvib_torch.core.validation import read_json
from rsvib_torch.options import ExportFormat, IsdModel, StmapConvention

if TYPE_CHECKING:
    from rsvib_torch.detection import DetectionResult
    from rsvib_torch.motion.timing import SensorTiming
    from rsvib_torch.motion.vibration import Vibration

_FORMAT_OF_ENDING: dict[str, ExportFormat] = {".gcsv": "gcsv", ".json": "isd", ".csv": "csv"}


def _size(text: str) -> tuple[int, int]:
    """(height, width) from ``HEIGHTxWIDTH``."""
    match = re.fullmatch(r"(\d+)x(\d+)", text.strip().lower())
    if match is None:
        raise ValueError(f"--size must be HEIGHTxWIDTH in px such as 1080x1920, got {text!r}")
    return int(match[1]), int(match[2])


def export(
    vibration: Annotated[Path, typer.Argument(help="The vibration.json written by detect or run.")],
    out: Annotated[Path, typer.Argument(help="File to write; for stmap a folder.")],
    *,
    file_format: Annotated[
        ExportFormat | None,
        typer.Option(
            "--format",
            help="gcsv: angular rates, for Gyroflow; stmap: a position per pixel and frame, for compositing programs "
            "and OpenCV; isd: image support data, for the Community Sensor Model; csv: offsets of the rows before and "
            "after correction.",
            show_default="from the extension: .gcsv, .csv, .json for isd",
        ),
    ] = None,
    frames: Annotated[
        Path | None, typer.Option(help="The stack of frames, for their size and number (gcsv, stmap).")
    ] = None,
    size: Annotated[
        str | None, typer.Option(metavar="HEIGHTxWIDTH", help="Size of the frames in px, in place of --frames.")
    ] = None,
    num_frames: Annotated[int | None, typer.Option(help="Number of frames, in place of --frames.")] = None,
    focal_length: Annotated[
        float | None,
        typer.Option(help="Focal length in px, for a vibration that was detected without one; required for gcsv."),
    ] = None,
    camera_isd: Annotated[
        Path | None, typer.Option("--isd", help="ISD of the camera at rest (JSON), which isd requires.")
    ] = None,
    frame: Annotated[int, typer.Option(help="Number of the frame that isd describes, from 0.")] = 0,
    model: Annotated[
        IsdModel,
        typer.Option(
            help="Sensor model of isd: frame, a frame camera with jitter polynomials; line-scan, one quaternion per "
            "row; auto, the first of them that is accurate enough."
        ),
    ] = "auto",
    tolerance: Annotated[float, typer.Option(help="Largest error of a position by isd, in px.")] = 0.005,
    convention: Annotated[
        StmapConvention,
        typer.Option(
            help="Positions of stmap: nuke, 0 to 1 from the bottom left corner; opencv, px from the first pixel."
        ),
    ] = "nuke",
    sample_rate: Annotated[
        float | None,
        typer.Option(help="Samples per second of gcsv.", show_default="chosen for an attitude within 2e-7 rad"),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Export axes as well that are not reliable or not accurate.")
    ] = False,
    overwrite: OverwriteOption = False,
) -> Answer:
    """Write a detected vibration for other programs.

    As in rsvib restore, axes that are not reliable or not accurate are left out, unless --force is given.
    """
    chosen = file_format or _FORMAT_OF_ENDING.get(out.suffix.lower())
    if chosen is None:
        raise ValueError(f"the format of {out.name} is not known from its name: give --format gcsv, stmap, isd or csv")
    check_new([out], overwrite, [vibration, *(io.stack_files(frames) if frames is not None else []), camera_isd])
    check_writable(out, folder=chosen == "stmap")
    reports.read_vibration(vibration)  # its errors name what to give instead
    detected = detection.DetectionResult.load(vibration)
    if chosen == "csv":
        reports.write_offsets(out, detected)
        return Answer({"Offsets before and after correction": _residuals(detected)}, {"format": chosen}, [out])
    if detected.timing is None:
        raise ValueError(f"{vibration}: the timing of the sensor is missing; detect the vibration again")
    timing = detected.timing
    data: dict[str, Any] = {"format": chosen}
    if chosen == "isd":
        if camera_isd is None:
            raise ValueError(
                "isd needs the ISD of the camera at rest: give --isd FILE; camera_isd of Python builds one"
            )
        found = read_json(camera_isd, "ISD")
        rows = found.get("image_lines")
        motion = _trusted(
            detected, timing, frame + 1, rows if isinstance(rows, int) and rows > 0 else 1, force, focal_length
        )
        written = reports.write_isd(out, motion, timing, found, frame=frame, model=model, tolerance=tolerance)
        sentence = {
            "frame": f"frame {frame} as a frame camera with jitter polynomials",
            "line-scan": f"frame {frame} as a line scanner with one quaternion per row",
        }
        return Answer({"Sensor model": [sentence[written]]}, data | {"model": written, "frame": frame}, [out])
    shape, count = _extent(frames, size, num_frames)
    motion = _trusted(detected, timing, count, shape[int(timing.scan_axis)], force, focal_length)
    data |= {"size": list(shape), "num_frames": count}
    if chosen == "gcsv":
        reports.write_gcsv(out, motion, timing, shape, count, sample_rate=sample_rate)
        return Answer({"Angular rates": [f"of {count} frames, on the clock of the first row of frame 0"]}, data, [out])
    with working("computing the positions"):
        files = reports.write_stmap(out, motion, timing, shape, count, convention=convention)
    text = f"{count} maps of {shape[0]} x {shape[1]} px, convention {convention}"
    return Answer({"Sampling maps": [text]}, data | {"convention": convention}, files)


def _extent(frames: Path | None, size: str | None, num_frames: int | None) -> tuple[tuple[int, int], int]:
    """Size and number of the frames, from the stack or the options."""
    if frames is not None:
        shape = io.read_stack_info(frames).shape
        return (shape[-2], shape[-1]) if size is None else _size(size), shape[0] if num_frames is None else num_frames
    if size is None or num_frames is None:
        raise ValueError(
            "the size and the number of the frames are not known: give --frames, or --size and --num-frames"
        )
    return _size(size), num_frames


def _trusted(
    detected: DetectionResult, timing: SensorTiming, count: int, rows: int, force: bool, focal_length: float | None
) -> Vibration:
    """The accurate part of a detected vibration, or all of it with ``force``, with a camera if a focal length is given.

    Raises:
        ValueError: If nothing of it is accurate enough, or there are two focal lengths.
    """
    from rsvib_torch.motion.camera import Camera  # noqa: PLC0415

    motion = detected.vibration
    if not force:
        motion, reasons = restoration.trusted_vibration(detected, timing, count, rows)
        notes = [str(replace(one, details={**one.details, "action": "exported"})) for one in reasons]
        if not bool(motion.moving_axes().any()):
            raise ValueError(
                f"nothing to export: {'; '.join(notes) or 'no vibration'}; --force exports it nevertheless"
            )
        for note in notes:
            error_line(note, "warning")
    if focal_length is None:
        return motion
    if motion.camera is not None:
        raise ValueError(
            f"the vibration was detected with focal_length={motion.camera.focal_length:g} px; omit --focal-length"
        )
    return motion.with_camera(Camera(focal_length))


def _residuals(detected: DetectionResult) -> list[str]:
    """A line for each axis: root mean square of the offsets and of the residuals."""
    from rsvib_torch.core.presentation import AXIS_NAMES  # noqa: PLC0415

    curve = detected.offsets
    lines = []
    for axis, name in enumerate(AXIS_NAMES[: detected.vibration.num_axes]):
        before = curve.offsets[..., axis][curve.good]
        after = before - detected.fitted[..., axis][curve.good]
        unit = ("px", "px", "rad", "")[axis]
        size = [f"{float(values.square().mean().sqrt()):.3g}" for values in (before, after)]
        lines.append(f"{name}: {size[0]} {unit} before, {size[1]} {unit} after (root mean square)")
    return lines
