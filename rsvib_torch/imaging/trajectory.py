"""Motion during exposures: quadrature nodes within an exposure, and the frame rows that show given scene rows.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from typing import Literal

import torch
from torch import Tensor

from rsvib_torch.checks.values import check_choice, check_whole_number
from rsvib_torch.motion.field import check_two_axes
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import RowTiming, SensorTiming
from rsvib_torch.numerics.splines import gauss_legendre

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


def exposure_nodes(
    timing: SensorTiming, quadrature: Quadrature = "midpoint", num_nodes: int | None = None
) -> tuple[Tensor, Tensor]:
    """Times within an exposure, from its start, with their weights.

    ``"midpoint"`` is Eq. (25): N_e samples at (i - 1/2) T_row, weight 1/N_e each (a fractional N_e is rounded up and
    the samples are spread evenly). ``"gauss"`` uses Gauss-Legendre nodes, which give the same integral with far fewer.

    Returns:
        Times in seconds and weights that sum to 1, both float64 of shape (N,).
    """
    check_choice("quadrature", quadrature, ("midpoint", "gauss"))
    if num_nodes is not None:
        check_whole_number("num_nodes", num_nodes, at_least=1, at_most=10_000)  # as many rows as an exposure has
    if quadrature == "gauss":
        nodes, weights = gauss_legendre(4 if num_nodes is None else num_nodes)
        return nodes * timing.exposure_time, weights
    count = math.ceil(timing.exposure_rows - 1e-9) if num_nodes is None else num_nodes
    times = (torch.arange(count, dtype=torch.float64, device="cpu") + 0.5) / count * timing.exposure_time
    return times, torch.full((count,), 1.0 / count, dtype=torch.float64, device="cpu")


def exposure_trajectory(
    vibration: Motion,
    starts: Tensor,
    timing: SensorTiming,
    quadrature: Quadrature = "midpoint",
    num_nodes: int | None = None,
) -> tuple[Tensor, Tensor]:
    """Displacement (S, N, 2) in px at the nodes of exposures from ``starts`` S in s on, and weights (N,) of the nodes.

    Batch dimensions of the vibration lead. There are N_e midpoints (Eq. 25) by default, or ``gauss_node_count`` nodes.

    Raises:
        ValueError: If the motion has roll or zoom, see ``motion.field``.
    """
    check_two_axes(vibration, "the displacement of a row")
    if quadrature == "gauss" and num_nodes is None:
        num_nodes = gauss_node_count(vibration, timing.exposure_time)
    times, weights = exposure_nodes(timing, quadrature, num_nodes)
    times, weights = times.to(vibration.device), weights.to(vibration.device)
    return vibration.path(starts, times), weights


def rows_showing(scene_rows: Tensor, frame_start: Tensor, timing: RowTiming, vibration: Motion) -> Tensor:
    """Frame rows r(s) that show scene rows s of shape S: the solution of ``r = s + Y(t(r))``, float64.

    Row r is exposed from ``frame_start + r T_row`` on, and Y is the mean displacement over that exposure (Eq. 2).
    Newton's method; ``|dY/dt| T_row`` is 0.02 for 5 px at 30 Hz, and must stay below 1: content that moves along the
    scan as fast as the rows is never passed. The vibration is in row order, its batch dimensions lead; ``frame_start``
    in s broadcasts to S.
    """
    return rows_and_displacement(scene_rows, frame_start, timing, vibration)[0]


def rows_and_displacement(
    scene_rows: Tensor, frame_start: Tensor, timing: RowTiming, vibration: Motion
) -> tuple[Tensor, Tensor]:
    """``rows_showing``, and the mean displacement (S, 2) of these rows in px."""
    check_two_axes(vibration, "the displacement of a row")
    scene_rows = scene_rows.to(torch.float64)
    rows = scene_rows + torch.zeros_like(frame_start)
    near = torch.tensor([-1e-3, 0.0, 1e-3], dtype=torch.float64, device=rows.device)  # rows, for the derivative
    for iteration in range(8):
        starts = frame_start[..., None] + (rows[..., None] + near) * timing.row_time
        before, displacement, after = vibration.mean_displacement(starts, timing.exposure_time).unbind(-2)
        # the limit keeps steps finite near slope 1
        remaining = (1.0 - (after - before)[..., 1].detach() / 2e-3).clamp(min=0.1)
        step = (scene_rows + displacement[..., 1] - rows) / remaining
        rows = rows + step
        # a step of 1e-5 px would be followed by one of its square, far below any measurement
        if iteration > 0 and bool((step.abs() < 1e-5).all()):
            break
    return rows, displacement
