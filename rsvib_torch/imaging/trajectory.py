"""Motion during exposures: quadrature nodes, the frame rows that show scene rows, and where pixels were recorded.

Invariant: the displacement depends on the row only (docs/architecture.md), but for ``recorded_offsets``.
"""

import math
from typing import Literal

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor

from rsvib_torch.checks.values import check_choice
from rsvib_torch.motion.camera import displacement_at
from rsvib_torch.motion.motion import Motion, check_two_axes
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import RowTiming, SensorTiming
from rsvib_torch.numerics.interpolation import gauss_legendre
from rsvib_torch.numerics.tables import Array

Quadrature = Literal["midpoint", "gauss"]


def gauss_node_count(vibration: Motion, exposure_time: float, *, at_most: int = 4096) -> int:
    """Gauss-Legendre nodes that integrate the image over this motion to about 1e-6 of full scale.

    The integrand is ``exp(-2 pi i (u X(t) + v Y(t)))`` with frequencies up to half a cycle per pixel, so the count
    grows with the path length (two nodes per px) and with the periods of the fastest tone (four nodes each).
    """
    path = float(vibration.displacement_within(exposure_time).amax())
    periods = float(vibration.periods_within(exposure_time).amax())
    count = 3 + math.ceil(2.0 * path) + math.ceil(4.0 * periods)
    if count > at_most:
        raise ValueError(
            f"the image moves {path:.3g} px and through {periods:.3g} periods while a row is exposed for "
            f"{exposure_time:g} s, which needs {count} quadrature nodes and not at most {at_most}; check frequency, "
            "amplitude and exposure"
        )
    return count


def exposure_trajectory(
    vibration: Motion,
    starts: Tensor,
    timing: SensorTiming,
    quadrature: Quadrature = "midpoint",
    num_nodes: int | None = None,
) -> tuple[Tensor, Tensor]:
    """Displacement (S, N, 2) in px at the nodes of exposures from ``starts`` S in s on, and weights (N,) of the nodes.

    ``"midpoint"`` is Eq. (25): N_e samples at (i - 1/2) T_row, weight 1/N_e each (a fractional N_e is rounded up and
    the samples are spread evenly). ``"gauss"`` uses Gauss-Legendre nodes, which give the same integral with far fewer:
    ``num_nodes``, or ``gauss_node_count``. Batch dimensions of the vibration lead.

    Raises:
        ValueError: If the motion has roll or zoom, see ``displacement_at``.
    """
    check_two_axes(vibration, "the displacement of a row")
    check_choice("quadrature", quadrature, ("midpoint", "gauss"))
    if quadrature == "gauss":
        nodes, weights = gauss_legendre(num_nodes or gauss_node_count(vibration, timing.exposure_time))
    else:
        count = math.ceil(timing.exposure_rows - 1e-9)
        nodes = (torch.arange(count, dtype=torch.float64, device="cpu") + 0.5) / count
        weights = torch.full_like(nodes, 1.0 / count)
    nodes, weights = nodes.to(vibration.device), weights.to(vibration.device)
    return vibration.path(starts, nodes * timing.exposure_time), weights


def rows_showing(
    scene_rows: Tensor, frame_start: Tensor, timing: RowTiming, vibration: Motion, exposure_time: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Frame rows r(s) that show scene rows s of shape S, and their mean displacement (S, 2) in px, float64.

    They are the solution of ``r = s + Y(t(r))``.
    Row r is exposed from ``frame_start + r T_row`` on, and Y is the mean displacement over that exposure (Eq. 2).
    Newton's method solves it, with shorter steps where one increases the error; ``|dY/dt| T_row`` is 0.02 for 5 px at
    30 Hz, and must stay below 1: rows do not pass content that moves along the scan as fast. The vibration is in
    row order, its batch dimensions lead; ``frame_start`` in s broadcasts to S, and other exposures in s than that of
    the sensor to (S, 1).
    """
    check_two_axes(vibration, "the displacement of a row")
    rows = scene_rows = scene_rows.to(torch.float64)
    nearby = torch.tensor([-1e-3, 0.0, 1e-3], dtype=torch.float64, device=rows.device)  # rows, for the derivative
    first = frame_start[..., None] + nearby * timing.row_time
    exposure = timing.exposure_time if exposure_time is None else exposure_time
    step = least = last_step = torch.zeros_like(frame_start)
    largest = 0.0  # px, step of Newton's method
    # of 71 motions with |dY/dt| T_row of 0.5 to 0.9, all need at most 11 steps; without halves, 11 fail
    for number in range(16):
        # 1. The error at the rows, and its derivative; the limit keeps steps finite near 0.
        rows = rows + step
        displacements = vibration.mean_displacement(torch.add(first, rows[..., None], alpha=timing.row_time), exposure)
        below, displacement, above = displacements.unbind(-2)
        slope = (above - below) / 2e-3
        error = scene_rows + displacement[..., 1] - rows
        newton = error / (1.0 - slope[..., 1].detach()).clamp(min=0.1)
        # 2. Each step is the square of the last one times a constant: end if the next one would be below 1e-6 px.
        size, change = error.detach().abs(), newton.detach()
        before, largest = largest, float(change.abs().max())
        if largest**3 <= 1e-6 * (before**2 + 1e-12):
            break
        # 3. Newton's step; half of the last step back, where that step has increased the error.
        step = newton
        if number > 0:
            worse, half = size > least, 0.5 * last_step
            size, step = torch.where(worse, least, size), torch.where(worse, -half, newton)
            change = torch.where(worse, half, change)
        least, last_step = size, change  # |error| before the step, and the step
    return rows + newton, displacement + slope * newton[..., None]


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
    """Offsets (2, n, m) px (x, y) from pixels of the restored frame to their recorded places, and weights (m, length).

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
    grid_displacement = motion.mean_displacement(torch.from_numpy(start + grid * timing.row_time), timing.exposure_time)
    spline = CubicSpline(grid, grid_displacement.detach().cpu().numpy())
    places = still
    for _ in range(_ROUNDS):  # the row of a place determines when it was recorded
        rows = places[along] if timing.readout_direction == "forward" else count - 1 - places[along]
        components = torch.from_numpy(spline(rows.clamp(grid[0], grid[-1])))
        before, places = places, still + displacement_at(components, x, y, motion.camera).movedim(-1, 0)
        if float((places[along] - before[along]).abs().max()) < _CLOSE:
            break
    return (places - pixels).numpy(), weights


def places_at_rest(motion: Motion, recorded: Array, starts: Array, exposure_time: float) -> Array:
    """Places s (N, 2) in px from the centre of content that was recorded at ``q = s + D(s, t)``.

    The places q (N, 2) were recorded in exposures from ``starts`` (N,) in s on.
    """
    components = motion.mean_displacement(torch.from_numpy(starts), exposure_time)
    still = q = torch.from_numpy(recorded)
    for _ in range(3):  # each multiplies the error by about the roll and zoom: 1e-4 px with 0.05 rad and 20 px
        still = q - displacement_at(components, still[:, 0], still[:, 1], motion.camera)
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
