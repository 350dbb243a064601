"""Where in a recorded frame each pixel of the restored frame was recorded."""

import math

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor

from rsvib_torch.motion.field import displacement_at
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.numerics.tables import Array

# Columns at which displacements that differ along a row are computed; a polynomial interpolates them. Without a camera,
# the displacement is linear along a row, up to the motion between its rows. With one, for 2048 columns, 60 degrees and
# strong distortion, the error is 1e-9 px with 5 px and 5 mrad of roll at 400 Hz, 1e-7 px with a random free motion of
# 3 px and 2 mrad.
_NODES, _NODES_WITH_CAMERA = 5, 17
_PERIOD_STEP = 0.01  # periods of the fastest tone between knots of a spline; its error is 4e-8 of the amplitude
_KNOT_STEP = 0.05  # of the time between the knots of a free motion; white noise at knots finer than rows: 5e-5 of it
_BESIDE = 16  # rows beyond half of the frame on each side, for which the motion is known; the sensor has none there
_CLOSE = 1e-6  # px, change of a position in the last round
_ROUNDS = 60  # at most; 5 suffice for 5 px at 100 Hz and 20 us per row


def recorded_offsets(
    motion: Motion, timing: SensorTiming, size: tuple[int, int], frame: int = 0, shift: Tensor | None = None
) -> tuple[Array, Array]:
    """How far (x, y) from each pixel of the restored frame it was recorded, (2, n, m) px, and weights (m, length).

    Content that is at rest at s - shift was recorded at ``q = s - shift + D(s - shift, t(q))`` with the mean
    displacement D during the exposure of the row of q. Rows in the order of the sensor are n. Along them, the offsets
    at all pixels are ``offsets @ weights``, a polynomial through m columns from the first to the last; where all
    columns are displaced alike, there is one.
    """
    height, width = size
    along, across = (1, 0) if timing.scan_axis == -2 else (0, 1)  # axes (x, y) along which rows follow, and along rows
    count, length = (height, width) if along == 1 else (width, height)
    nodes = 1 if motion.same_for_all_columns else _NODES if motion.camera is None else _NODES_WITH_CAMERA
    columns, weights = _interpolation(length, min(nodes, length))
    pixels = torch.empty(2, count, len(columns), dtype=torch.float64, device="cpu")
    pixels[along] = torch.arange(count, device="cpu")[:, None]
    pixels[across] = torch.from_numpy(columns)
    still = pixels if shift is None else pixels - shift[:2, None, None].cpu()
    x, y = still[0] - 0.5 * (width - 1), still[1] - 0.5 * (height - 1)
    # Mean displacements as a spline of the row, also beyond the frame.
    start, fastest = timing.frame_starts(frame + 1)[frame].item(), float(motion.periods_within(timing.row_time).max())
    knots = motion.spacing / timing.row_time if isinstance(motion, FreeMotion) else math.inf  # rows
    step = min(0.5, _PERIOD_STEP / max(fastest, 1e-12), _KNOT_STEP * knots)
    grid = np.arange(-0.5 * count - _BESIDE, 1.5 * count + _BESIDE, step)
    of_grid = motion.mean_displacement(torch.from_numpy(start + grid * timing.row_time), timing.exposure_time)
    of_rows = CubicSpline(grid, of_grid.detach().cpu().numpy())
    places = still
    for _ in range(_ROUNDS):  # the row of a place determines when it was recorded
        rows = places[along] if timing.readout_direction == "forward" else count - 1 - places[along]
        moved = torch.from_numpy(of_rows(rows.clamp(grid[0], grid[-1])))
        before, places = places, still + displacement_at(moved, x, y, motion.camera).movedim(-1, 0)
        if float((places[along] - before[along]).abs().max()) < _CLOSE:
            break
    return (places - pixels).numpy(), weights


def places_at_rest(motion: Motion, recorded: Array, starts: Array, exposure_time: float) -> Array:
    """Places s (N, 2) in px from the centre of content that was recorded at ``q = s + D(s, t)``, the inverse of above.

    The places q (N, 2) were recorded in exposures from ``starts`` (N,) in s on.
    """
    moved = motion.mean_displacement(torch.from_numpy(starts), exposure_time)
    still = q = torch.from_numpy(recorded)
    for _ in range(3):  # each makes the error smaller by the roll and zoom: 1e-4 px with 0.05 rad and 20 px
        still = q - displacement_at(moved, still[:, 0], still[:, 1], motion.camera)
    return still.numpy()


def _interpolation(length: int, count: int) -> tuple[Array, Array]:
    """Chebyshev nodes (count,) among columns, and the weights (count, length) of interpolation at all columns."""
    nodes, series = -np.cos(np.pi * np.arange(count) / max(count - 1, 1)), np.polynomial.chebyshev.chebvander
    weights = series(np.linspace(-1.0, 1.0, length), count - 1) @ np.linalg.inv(series(nodes, count - 1))
    return 0.5 * (length - 1) * (nodes + 1), weights.T


def places(
    offsets: Array, weights: Array, timing: SensorTiming, size: tuple[int, int], dtype: type[np.floating] = np.float32
) -> Array:
    """(2, H, W) px, the places (x, y) of all pixels with the offsets of ``recorded_offsets``."""
    along, across = (1, 0) if timing.scan_axis == -2 else (0, 1)
    count, length = size[::-1][along], size[::-1][across]
    offsets = offsets.astype(dtype)
    if len(weights) > 1:
        offsets = offsets @ weights.astype(dtype)
    result = np.empty((2, count, length), dtype)
    np.add(np.arange(count, dtype=dtype)[:, None], offsets[along], out=result[along])
    np.add(np.arange(length, dtype=dtype), offsets[across], out=result[across])
    return result if along == 1 else result.transpose(0, 2, 1)
