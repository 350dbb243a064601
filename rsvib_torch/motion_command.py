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

from rsvib_torch.config import read_config
from rsvib_torch.detection import align_motion, detect_motion, detect_swept_tone
from rsvib_torch.free_motion import FreeMotion
from rsvib_torch.motion_file import MotionUnit, TimeUnit, read_motion
from rsvib_torch.restoration import restore
from rsvib_torch.sensor import SensorTiming
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

Array = NDArray[np.float64]


def motion(
    frames: Annotated[Path, typer.Argument(help="Stack of frames.")],
    *,
    config: Annotated[Path, typer.Option("--config", help="TOML file that describes the camera.")],
    out: Annotated[Path, typer.Option(help="CSV file to write: time, x, y; and std_x, std_y of a free motion.")],
    model: Annotated[
        Literal["free", "swept"],
        typer.Option(help="A smooth curve of any shape, or one tone an axis that decays or grows and sweeps."),
    ] = "free",
    knot_rows: Annotated[int, typer.Option(help="Rows from one knot of a free motion to the next.")] = 24,
    search: Annotated[int, typer.Option(help="Search range in px around the whole-frame offset.")] = 16,
    full_scale: Annotated[float | None, typer.Option(help="Count that means full scale.")] = None,
) -> None:
    """Detect a motion that is no steady vibration in a stack of frames.

    The CSV file goes into rsvib known, with --unit px --offset 0.
    """
    settings = read_config(config)
    check_writable(out)
    info = read_stack_info(frames)
    scale = full_scale if full_scale is not None or not info.is_integer else info.full_scale or settings.full_scale
    with working(f"reading {frames}"):
        stack = read_stack(frames, full_scale=scale)
    with working("detecting the motion"):
        lines, table = _MODELS[model](stack, settings.timing, knot_rows, search)
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
            f"{name}: moves by {size:.3f} px rms; known to {float(found.std_seen[axis]):.3f} px between frames, what "
            f"repeats in every frame to {float(found.unseen[axis]):.3f} px; {_verdict(found.reasons[axis])}"
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
