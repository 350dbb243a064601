"""``rsvib motion`` and ``rsvib known``: motion of any shape from frames, and frames restored with a recorded one."""

import csv
import math
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer

from rsvib_torch.config import read_config
from rsvib_torch.detection import MotionDetection, align_motion, detect_motion
from rsvib_torch.motion_file import MotionUnit, TimeUnit, read_motion
from rsvib_torch.restoration import restore
from rsvib_torch.stacks import (
    check_stack_target,
    check_writable,
    read_stack,
    read_stack_info,
    whole_file,
    write_stack,
)
from rsvib_torch.terminal import error_line, say, working

__all__ = ["known", "motion"]


def motion(
    frames: Annotated[Path, typer.Argument(help="Stack of frames.")],
    *,
    config: Annotated[Path, typer.Option("--config", help="TOML file that describes the camera.")],
    out: Annotated[Path, typer.Option(help="CSV file to write: time, x, y and their standard deviations.")],
    knot_rows: Annotated[int, typer.Option(help="Rows from one knot of the motion to the next.")] = 24,
    search: Annotated[int, typer.Option(help="Search range in px around the whole-frame offset.")] = 16,
    full_scale: Annotated[float | None, typer.Option(help="Count that means full scale.")] = None,
) -> None:
    """Detect a motion of any shape, no sum of tones, in a stack of frames.

    The CSV file goes into rsvib known, with --unit px --offset 0.
    """
    settings = read_config(config)
    check_writable(out)
    info = read_stack_info(frames)
    scale = full_scale if full_scale is not None or not info.is_integer else info.full_scale or settings.full_scale
    with working(f"reading {frames}"):
        stack = read_stack(frames, full_scale=scale)
    with working("detecting the motion"):
        found = detect_motion(stack, settings.timing, knot_rows=knot_rows, search=search)
    with whole_file(out) as file:
        _write_motion(file, found, settings.timing.exposure_time)
    for axis, name in enumerate("xy"):
        size = float(found.displacement[..., axis].square().mean().sqrt())
        line = (
            f"{name}: moves by {size:.3f} px rms; known to {float(found.std_seen[axis]):.3f} px between frames, what "
            f"repeats in every frame to {float(found.unseen[axis]):.3f} px; "
        )
        say(line + ("reliable" if bool(found.reliable[axis]) else f"not reliable: {'; '.join(found.reasons[axis])}"))
    say(f"{out}: time, x, y, std_x, std_y")


def _write_motion(path: Path, found: MotionDetection, exposure_time: float) -> None:
    """A table of the motion at even times that cover all frames."""
    step = 0.5 * found.motion.spacing
    first, last = found.motion.start, max(found.motion.end, float(found.times.max()) + exposure_time)
    times = np.linspace(first, last, math.ceil((last - first) / step) + 1)
    values = found.motion.displacement(torch.from_numpy(times).to(found.motion.device)).cpu().numpy()
    known_at, stds = found.times.flatten().cpu().numpy(), found.std.flatten(0, 1).cpu().numpy()
    spread = np.stack([np.interp(times, known_at, stds[:, axis]) for axis in range(2)], -1)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["time", "x", "y", "std_x", "std_y"])
        for time, value, std in zip(times, values, spread, strict=True):
            writer.writerow([f"{time:.9f}", *(f"{v:.5f}" for v in (*value, *std))])


def known(
    frames: Annotated[Path, typer.Argument(help="Stack of frames.")],
    restored: Annotated[Path, typer.Argument(help="Stack to write, in the type and full scale of the frames.")],
    *,
    config: Annotated[Path, typer.Option("--config", help="TOML file that describes the camera.")],
    motion: Annotated[Path, typer.Option(help="CSV file with the columns time, x and y.")],
    unit: Annotated[MotionUnit, typer.Option(help="Of x and y: px, angles, or rates of angles.")],
    focal_length: Annotated[float | None, typer.Option(help="In px, for angles and rates.")] = None,
    time_unit: Annotated[TimeUnit, typer.Option(help="Of the times.")] = "s",
    flip_x: Annotated[bool, typer.Option("--flip-x", help="A positive x moves the image towards smaller x.")] = False,
    flip_y: Annotated[bool, typer.Option("--flip-y", help="A positive y moves the image towards smaller y.")] = False,
    offset: Annotated[
        float | None,
        typer.Option(
            help="Reading of the file's clock at the first row of frame 0, in s; found in the frames if not given."
        ),
    ] = None,
    fit_gain: Annotated[bool, typer.Option("--fit-gain", help="Find the focal length in the frames as well.")] = False,
    full_scale: Annotated[float | None, typer.Option(help="Count that means full scale.")] = None,
) -> None:
    """Restore frames with a motion recorded by a gyroscope or attitude sensor."""
    settings = read_config(config)
    recorded = read_motion(
        motion,
        unit=unit,
        focal_length=focal_length,
        time_unit=time_unit,
        signs=(-1.0 if flip_x else 1.0, -1.0 if flip_y else 1.0),
    )
    info = read_stack_info(frames)
    scale = full_scale if full_scale is not None or not info.is_integer else info.full_scale or settings.full_scale
    check_stack_target(restored, info.shape, dtype=info.dtype, full_scale=scale)
    with working(f"reading {frames}"):
        stack = read_stack(frames, full_scale=scale)
    if offset is None:
        with working("looking for the frames in the recording"):
            found = align_motion(stack, settings.timing, recorded, fit_gain=fit_gain)
        say(f"clock {found.offset:.6f} ± {found.offset_std:.6f} s at the first row, speed {found.scale:.7f}")
        say(f"gain {found.gain[0]:.4f}, {found.gain[1]:.4f}; drift {found.drift[0]:.4g}, {found.drift[1]:.4g} px/s")
        for reason in found.reasons:
            error_line(reason, "warning")
        moving = found.motion
    else:
        moving = recorded.retimed(offset)
        rows = stack.shape[-1 if settings.timing.scan_axis == -1 else -2]
        last = float(settings.timing.row_starts(len(stack), rows).max()) + settings.timing.exposure_time
        if moving.start > 1e-9 or moving.end < last - 1e-9:
            raise ValueError(
                f"{motion}: covers {recorded.start:.6g} to {recorded.end:.6g} s, the frames need {offset:.6g} to "
                f"{offset + last:.6g} s"
            )
    with working("restoring the frames"):
        clear = restore(stack, settings.timing, moving, **settings.restoration)
    with working(f"writing {restored}"):
        write_stack(restored, clear, dtype=info.dtype, full_scale=scale)
    say(f"{restored}: {len(clear)} frames restored, {info.dtype}")
