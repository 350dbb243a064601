"""Displacement of the image within an exposure, sampled at quadrature nodes."""

import math
from typing import Literal

import torch
from torch import Tensor

from rsvib_torch.core.checks import check_choice
from rsvib_torch.core.quadrature import gauss_legendre
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import SensorTiming

__all__ = ["Quadrature", "exposure_nodes", "exposure_trajectory", "gauss_node_count"]

Quadrature = Literal["midpoint", "gauss"]
_MOST_NODES = 4096


def gauss_node_count(vibration: Motion, exposure_time: float) -> int:
    """Gauss-Legendre nodes that integrate the image over this motion to about 1e-6 of full scale.

    The integrand is ``exp(-2 pi i (u X(t) + v Y(t)))`` with frequencies up to half a cycle per pixel, so the count
    grows with the path length in px (two nodes a px) and with the vibration periods in the exposure.
    """
    path = float(vibration.displacement_within(exposure_time).amax())
    periods = float(vibration.periods_within(exposure_time).amax())
    count = 3 + math.ceil(2.0 * path) + math.ceil(4.0 * periods)
    if count > _MOST_NODES:
        raise ValueError(
            f"the image moves {path:.3g} px and through {periods:.3g} periods while a "
            f"row is exposed for {exposure_time:g} s, too much to follow; check frequency, amplitude and exposure"
        )
    return count


def exposure_nodes(
    timing: SensorTiming, quadrature: Quadrature = "midpoint", num_nodes: int | None = None
) -> tuple[Tensor, Tensor]:
    """Times within an exposure, from its start, with their weights.

    ``"midpoint"`` is Eq. (25): N_e samples at (i - 1/2) T_row, weight 1/N_e each (a fractional N_e is rounded up and
    the samples spread evenly). ``"gauss"`` takes Gauss-Legendre nodes, which give the same integral with far fewer.

    Returns:
        Times in seconds and weights that sum to 1, both float64 of shape (N,).
    """
    check_choice("quadrature", quadrature, ("midpoint", "gauss"))
    if quadrature == "gauss":
        nodes, weights = gauss_legendre(4 if num_nodes is None else num_nodes)
        return nodes * timing.exposure_time, weights
    count = math.ceil(timing.exposure_rows - 1e-9) if num_nodes is None else num_nodes
    times = (torch.arange(count, dtype=torch.float64) + 0.5) / count * timing.exposure_time
    return times, torch.full((count,), 1.0 / count, dtype=torch.float64)


def exposure_trajectory(
    vibration: Motion,
    starts: Tensor,
    timing: SensorTiming,
    quadrature: Quadrature = "midpoint",
    num_nodes: int | None = None,
) -> tuple[Tensor, Tensor]:
    """Displacement at the nodes of exposures that begin at ``starts``.

    Args:
        vibration: The motion, in row order.
        starts: Exposure starts in seconds, any shape S (batch dimensions of the vibration lead).
        timing: The sensor.
        quadrature: ``"midpoint"`` (Eq. 25) or ``"gauss"``.
        num_nodes: Number of nodes; by default N_e, or what the motion needs.

    Returns:
        Displacement (S, N, 2) in px, axes (x, y), and weights (N,), both float64.
    """
    if quadrature == "gauss" and num_nodes is None:
        num_nodes = gauss_node_count(vibration, timing.exposure_time)
    times, weights = exposure_nodes(timing, quadrature, num_nodes)
    starts = starts.to(dtype=torch.float64, device=vibration.device)
    times, weights = times.to(vibration.device), weights.to(vibration.device)
    return vibration.displacement(starts[..., None] + times), weights
