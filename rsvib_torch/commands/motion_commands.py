"""``rsvib motion`` and ``rsvib known``: motion of any shape from frames, and frames restored with a recorded one."""

import csv
import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from torch import Tensor

from rsvib_torch.commands.options import ConfigOption, DeviceOption, ScaleOption
from rsvib_torch.commands.terminal import error_line, say, working
from rsvib_torch.commands.workflow import chosen_device, full_scale_of, load, save
from rsvib_torch.config import read_config
from rsvib_torch.detection import align_motion, check_motion, detect_motion, detect_swept_tone
from rsvib_torch.io import check_stack_target, check_writable, read_stack_info, whole_file
from rsvib_torch.motion.recorded import MotionUnit, TimeUnit, read_motion
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.restoration import restore

__all__ = ["known", "motion"]

Array = NDArray[np.float64]


def motion(
    frames: Annotated[Path, typer.Argument(help="Stack of frames.")],
    *,
    config: ConfigOption,
    out: Annotated[Path, typer.Option(help="CSV file to write: time, x, y; and std_x, std_y of a free motion.")],
    model: Annotated[
        Literal["free", "swept"],
        typer.Option(help="A smooth curve of any shape, or one tone an axis that decays or grows and sweeps."),
    ] = "free",
    knot_rows: Annotated[int, typer.Option(help="Rows from one knot of a free motion to the next.")] = 24,
    search: Annotated[int, typer.Option(help="Search range in px around the whole-frame offset.")] = 16,
    device: DeviceOption = "auto",
    full_scale: ScaleOption = None,
) -> None:
    """Detect a motion that is no steady vibration in a stack of frames.

    The CSV file goes into rsvib known, with --unit px --offset 0.
    """
    settings = read_config(config)
    check_writable(out)
    stack = load(frames, settings, full_scale, chosen_device(device))
    with working("detecting the motion"):
        lines, table = _MODELS[model](stack.frames, stack.timing, knot_rows, search)
    with whole_file(out) as file, file.open("w", newline="", encoding="utf-8") as text:
        csv.writer(text).writerows(table)
    for line in lines:
        say(line)
    say(f"{out}: {', '.join(table[0])}")


_Table = list[list[str]]


def _free(stack: Tensor, timing: SensorTiming, knot_rows: int, search: int) -> tuple[list[str], _Table]:
    """A free motion in words, and as a table at even times with standard deviations."""
    found = detect_motion(stack, timing, knot_rows=knot_rows, search=search)
    lines = []
    for axis, name in enumerate("xy"):
        size = float(found.displacement[..., axis].square().mean().sqrt())
        lines.append(
            f"{name}: moves by {size:.3f} px rms; known to {float(found.std_seen[axis]):.3f} px between frames, a "
            f"warp that stays with the scene to {float(found.unseen[axis]):.3f} px; {_verdict(found.reasons[axis])}"
        )
    times, values = _sampled(found.motion, float(found.times.max()) + timing.exposure_time, 0.5)
    known_at, stds = found.times.flatten().cpu().numpy(), found.std.flatten(0, 1).cpu().numpy()
    spread = np.stack([np.interp(times, known_at, stds[:, axis]) for axis in range(2)], -1)
    return lines, _table(("time", "x", "y", "std_x", "std_y"), times, np.concatenate([values, spread], -1))


def _swept(stack: Tensor, timing: SensorTiming, knot_rows: int, search: int) -> tuple[list[str], _Table]:
    """Swept tones in words, and their motion as a table at even times."""
    found = detect_swept_tone(stack, timing, search=search)
    units = {"amplitude": "px", "frequency": "Hz", "decay": "/s", "chirp": "Hz/s", "phase": "rad"}
    lines = []
    for axis, name in enumerate("xy"):
        told = [
            f"{what} {float(getattr(found, what)[axis]):.4g} ± {float(found.std[what][axis]):.2g} {unit}"
            for what, unit in units.items()
        ]
        lines.append(f"{name}: {', '.join(told)}; {_verdict(found.reasons[axis])}")
    times, values = _sampled(found.motion, found.motion.end, 1.0)
    return lines, _table(("time", "x", "y"), times, values)


def _verdict(reasons: tuple[str, ...]) -> str:
    return f"not reliable: {'; '.join(reasons)}" if reasons else "reliable"


def _sampled(motion: FreeMotion, last: float, steps: float) -> tuple[Array, Array]:
    """A motion (N, 2) at even times (N,) up to the last, ``steps`` knots apart."""
    end = max(motion.end, last)
    times = np.linspace(motion.start, end, math.ceil((end - motion.start) / (steps * motion.spacing)) + 1)
    return times, motion.displacement(torch.from_numpy(times).to(motion.device)).cpu().numpy()


def _table(names: tuple[str, ...], times: Array, values: Array) -> _Table:
    rows = ([f"{time:.9f}", *(f"{v:.5f}" for v in row)] for time, row in zip(times, values, strict=True))
    return [list(names), *rows]


_MODELS: dict[str, Callable[[Tensor, SensorTiming, int, int], tuple[list[str], _Table]]] = {
    "free": _free,
    "swept": _swept,
}


def known(
    frames: Annotated[Path, typer.Argument(help="Stack of frames.")],
    restored: Annotated[Path, typer.Argument(help="Stack to write, in the type and full scale of the frames.")],
    *,
    config: ConfigOption,
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
    force: Annotated[
        bool, typer.Option("--force", help="Restore also where the recording does not explain the frames.")
    ] = False,
    device: DeviceOption = "auto",
    full_scale: ScaleOption = None,
) -> None:
    """Restore frames with a motion recorded by a gyroscope or attitude sensor.

    The motion is held against the offsets of rows between the frames: one that does not explain them is refused.
    """
    settings = read_config(config)
    recorded = read_motion(
        motion,
        unit=unit,
        focal_length=focal_length,
        time_unit=time_unit,
        signs=(-1.0 if flip_x else 1.0, -1.0 if flip_y else 1.0),
    )
    info = read_stack_info(frames)
    scale = full_scale_of(frames, info, settings, full_scale)
    check_stack_target(restored, info.shape, dtype=info.dtype, full_scale=scale)
    stack = load(frames, settings, full_scale, chosen_device(device))
    if offset is None:
        with working("looking for the frames in the recording"):
            found = align_motion(stack.frames, stack.timing, recorded, fit_gain=fit_gain)
        say(f"clock {found.offset:.6f} ± {found.offset_std:.6f} s at the first row, speed {found.scale:.7f}")
        say(f"gain {found.gain[0]:.4f}, {found.gain[1]:.4f}; drift {found.drift[0]:.4g}, {found.drift[1]:.4g} px/s")
        _refuse(motion, found.reasons, force)
        moving = found.motion
    else:
        moving = _placed(motion, recorded, offset, stack.frames, stack.timing)
    _judge(motion, stack.frames, stack.timing, moving, force, required=offset is None)
    with working("restoring the frames"):
        clear = restore(stack.frames, stack.timing, moving, **settings.restoration)
    save(restored, clear, stack)
    say(f"{restored}: {len(clear)} frames restored, {info.dtype}")


def _refuse(path: Path, reasons: tuple[str, ...], force: bool) -> None:
    """An error for a recording that speaks against itself; warnings where it is to be used all the same."""
    if reasons and not force:
        raise ValueError(f"{path}: {'; '.join(reasons)}; --force restores with it all the same")
    for reason in reasons:
        error_line(reason, "warning")


def _placed(path: Path, recorded: FreeMotion, offset: float, frames: Tensor, timing: SensorTiming) -> FreeMotion:
    """The recording on the clock of the frames, at an offset that was given."""
    moving = recorded.retimed(offset)
    rows = frames.shape[-1 if timing.scan_axis == -1 else -2]
    starts = timing.row_starts(len(frames), rows)
    first, last = float(starts.min()), float(starts.max()) + timing.exposure_time
    if moving.start > first + 1e-9 or moving.end < last - 1e-9:
        raise ValueError(
            f"{path}: covers {recorded.start:.6g} to {recorded.end:.6g} s, the frames need {offset + first:.6g} to "
            f"{offset + last:.6g} s"
        )
    return moving


def _judge(
    path: Path, frames: Tensor, timing: SensorTiming, moving: FreeMotion, force: bool, *, required: bool
) -> None:
    """Say how far rows are apart before and after, and refuse a motion that brings them no closer."""
    if len(frames) < 2:
        error_line("one frame alone does not tell whether the motion fits", "warning")
        return
    try:
        with working("holding the motion against the frames"):
            check = check_motion(frames, timing, moving)
    except ValueError as error:
        if required:
            raise
        error_line(f"whether the motion fits cannot be told: {error}", "warning")
        return
    before, after = (" and ".join(f"{value:.3f}" for value in sizes) for sizes in (check.before, check.after))
    say(f"rows are {before} px rms apart between frames along x and y, less the motion {after} px")
    if not check.helps:
        _refuse(path, check.reasons or ("the motion brings rows no closer to each other",), force)
    for reason in check.reasons if check.helps else ():
        error_line(reason, "warning")
