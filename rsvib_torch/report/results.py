"""Result files: ``vibration.json``, ``offsets.csv`` and tables."""

import csv
import math
import os
from collections.abc import Iterable, Mapping

import numpy as np
import torch
from numpy.typing import ArrayLike

from rsvib_torch.checks.arguments import checks_arguments
from rsvib_torch.checks.values import check_single
from rsvib_torch.detection import DetectionResult, MotionDetection
from rsvib_torch.files.atomic import whole
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.results.presentation import Result, plain_values


@checks_arguments
def read_vibration(path: str | os.PathLike[str], timing: SensorTiming | None = None) -> DetectionResult:
    """Read one detection from a ``vibration.json``, as the program does.

    Args:
        path: A file that the program or ``DetectionResult.save`` wrote.
        timing: The sensor of the frames to be restored, which must be that of the file; None not to compare them.

    Raises:
        ValueError: If it is not a complete ``vibration.json``, or was detected with another timing.

    Example:
        >>> import tempfile
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import example_frames
        >>> frames, timing, _ = example_frames()
        >>> path = tempfile.mkdtemp() + "/vibration.json"
        >>> rsv.detect_vibration(frames, timing).save(path)
        >>> rsv.read_vibration(path, timing).vibration.frequency[:, 0].round().tolist()  # Hz
        [110.0, 90.0]
    """
    result = DetectionResult.load(path)
    check_single(str(path), result.batch_shape)
    if timing is not None and result.timing is not None:
        check_same_timing(str(path), result.timing, timing)
    return result


def check_same_timing(source: str, stored: SensorTiming, timing: SensorTiming) -> None:
    """Raise an error if a detection was stored with another timing than that of the frames to be restored."""

    def equal(first: ArrayLike, second: ArrayLike) -> bool:
        if np.shape(first) != np.shape(second) or {str, type(None)} & {type(first), type(second)}:
            return bool(first == second)
        return np.allclose(first, second, rtol=1e-9, atol=0.0)  # up to rounding

    theirs, ours = stored.to_dict(), timing.to_dict()
    different = [name for name in ours if not equal(theirs[name], ours[name])]
    if different:
        shown = [
            [f"{one:.6g}" if isinstance(one, float) else repr(one) for one in both.values()] for both in (theirs, ours)
        ]
        texts = zip(ours, *shown, strict=True)
        values = ", ".join(f"{name}={stored} (here {here})" for name, stored, here in texts if name in different)
        remedy = "detect it again, or state the timing of the detection"
        raise ValueError(f"{source}: the vibration was detected with another timing: {values}; {remedy}")


@checks_arguments
def write_offsets(path: str | os.PathLike[str], result: DetectionResult) -> None:
    """Write the measured and the fitted offset curve as CSV; offsets that were not measured are empty.

    One line per band (or row, in the direct method) and pair of frames, see docs/export.md: ``offset`` before
    correction, ``fitted`` by the vibration, ``residual = offset - fitted`` after it, and ``std`` of both.
    """
    check_single("result", result.batch_shape)
    curve = result.offsets
    earlier, later = curve.pairs.T[..., None]
    columns = {"earlier_frame": earlier, "later_frame": later, "row": curve.rows, "time_s": curve.times}
    columns = {name: values.expand_as(curve.times) for name, values in columns.items()}
    axes = ("x_px", "y_px", "roll_rad", "zoom")[: result.vibration.num_axes]
    curves = {"offset": curve.offsets, "fitted": result.fitted, "residual": curve.offsets - result.fitted}
    for kind, values in curves.items():
        columns |= {f"{kind}_{name}": values[..., axis] for axis, name in enumerate(axes)}
    columns["quality"] = curve.quality
    if curve.std is not None:
        columns |= {f"std_{name}": curve.std[..., axis] for axis, name in enumerate(axes)}
    write_columns(path, {name: plain_values(column.flatten()) for name, column in columns.items()})


def write_columns(path: str | os.PathLike[str], columns: Mapping[str, Iterable[object]]) -> None:
    """Write columns of one length by name as CSV; None becomes an empty cell."""
    with whole(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))


@checks_arguments
def write_table(path: str | os.PathLike[str], result: Result, *, pixel_size: float | None = None) -> None:
    """Write ``result.table()`` as CSV: tones of a detection or of the windows of a manifest, or a spectrum.

    Args:
        path: The file to write; an existing file is replaced.
        result: A result that has a table. Its unknown values are empty cells.
        pixel_size: Size of a pixel in m, to add columns in um, um/s and m/s^2.

    Example:
        >>> import tempfile
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import example_frames
        >>> frames, timing, _ = example_frames()
        >>> path = tempfile.mkdtemp() + "/tones.csv"
        >>> rsv.write_table(path, rsv.detect_vibration(frames, timing, tones=1))
        >>> with open(path) as file:
        ...     print(len(file.readlines()))  # a tone along x and y each, below the header
        3
    """
    write_columns(path, result.table(pixel_size=pixel_size))


def motion_columns(result: MotionDetection, timing: SensorTiming) -> dict[str, list[str]]:
    """Columns of a table of a motion at equidistant times, two per knot: time in s, x and y and their std in px."""
    curve = result.motion
    end = max(curve.end, float(result.times.max()) + timing.exposure_time)
    steps = math.ceil((end - curve.start) / (0.5 * curve.spacing))
    times = torch.linspace(curve.start, end, steps + 1, dtype=torch.float64, device=curve.device)
    displacement, at = curve.displacement(times).cpu().numpy(), times.cpu().numpy()
    rows, stds = result.times.flatten().cpu(), result.std.flatten(0, 1).cpu()
    columns = {"time": at, "x": displacement[:, 0], "y": displacement[:, 1]}
    columns |= {f"std_{name}": np.interp(at, rows, stds[:, axis]) for axis, name in enumerate("xy")}
    return {name: [f"{v:.{9 if name == 'time' else 5}f}" for v in values] for name, values in columns.items()}
