"""The point spread function of every row: batched sparse kernels, and transfer functions along the rows.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Literal

import torch
from torch import Tensor

from rsvib_torch.core.arguments import checks_arguments
from rsvib_torch.core.checks import check_choice
from rsvib_torch.core.free_memory import check_fits
from rsvib_torch.core.splines import bspline_weights, mirrored, spread_taps
from rsvib_torch.imaging.trajectory import Quadrature, exposure_trajectory
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import SensorTiming

__all__ = ["Interpolation", "RowPSF", "form_rows", "row_psf", "row_taps", "row_transfer", "trajectory_psf"]

Interpolation = Literal["linear", "cubic"]
SPLINE_DEGREES: dict[str, int] = {"linear": 1, "cubic": 3}


@dataclass(frozen=True, eq=False)
class RowPSF:
    """Kernels of all rows: ``g(r, c) = sum_jk weights[r, j, k] f(r - y_r - j, c - x_r - k)`` (Eqs. 38, 39).

    Every row has a small kernel at its own position, so that large displacements cost nothing. With cubic
    interpolation the kernel acts on the B-spline coefficients of the scene instead of its samples.

    Attributes:
        first_tap: (..., R, 2) int64, displacement (x_r, y_r) in px of the first tap of each row's kernel.
        weights: (..., R, KH, KW) float64, sums to 1 over the last two axes.
        degree: Degree of the interpolating spline, 1 (linear) or 3 (cubic).
    """

    _MADE_BY: ClassVar[str] = "row_psf"  # for errors about arguments

    first_tap: Tensor
    weights: Tensor
    degree: int

    def centroid(self) -> Tensor:
        """Mean displacement of each row in px, (..., R, 2), axes (x, y): the first moment of its kernel."""
        rows = torch.arange(self.weights.shape[-2], dtype=self.weights.dtype, device=self.weights.device)
        columns = torch.arange(self.weights.shape[-1], dtype=self.weights.dtype, device=self.weights.device)
        x = (self.weights.sum(-2) * columns).sum(-1)
        y = (self.weights.sum(-1) * rows).sum(-1)
        return torch.stack([x, y], dim=-1) + self.first_tap

    def dense(self) -> tuple[Tensor, tuple[int, int]]:
        """All kernels on one common grid, to plot them or to convolve whole frames.

        Returns:
            Kernels (..., R, KH', KW') and the displacement (x, y) in px of tap [0, 0].
        """
        start = self.first_tap.flatten(0, -2).amin(0)
        place = self.first_tap - start
        reach = place.flatten(0, -2).amax(0)
        height, width = (size + int(extra) for size, extra in zip(self.weights.shape[-2:], reach.flip(0), strict=True))
        rows = place[..., 1, None] + torch.arange(self.weights.shape[-2], device=place.device)
        columns = place[..., 0, None] + torch.arange(self.weights.shape[-1], device=place.device)
        index = rows[..., :, None] * width + columns[..., None, :]
        kernels = self.weights.new_zeros(*self.weights.shape[:-2], height * width)
        kernels = kernels.scatter(-1, index.flatten(-2), self.weights.flatten(-2))
        return kernels.unflatten(-1, (height, width)), (int(start[0]), int(start[1]))


def _axis_weights(displacement: Tensor, degree: int) -> tuple[Tensor, Tensor]:
    """First tap (..., R) and spline weights (..., R, N, K) of displacements (..., R, N) along one axis."""
    cell = displacement.detach().floor()
    first, weights = spread_taps(cell, bspline_weights(displacement - cell, degree))
    return first - degree // 2, weights


def _check_memory(displacement: Tensor, degree: int) -> None:
    """Raise a ``ValueError`` unless the kernels fit into the free memory; a GPU raises an error of its own."""
    if displacement.device.type != "cpu":
        return
    reach = (displacement.amax(-2) - displacement.amin(-2)).reshape(-1, 2)
    width, height = (int(size) + degree + 2 for size in reach.amax(0).tolist())
    needed = 8 * len(reach) * (height * width + displacement.shape[-2] * (height + width))
    if needed > 10**7:  # reading the free memory takes 0.5 ms, which would matter for small images
        check_fits(
            f"point spread functions of {len(reach)} rows, {height} x {width} px,",
            needed,
            "check amplitude (px), frequency (Hz) and exposure_rows",
        )


@checks_arguments
def row_psf(
    vibration: Motion,
    starts: Tensor,
    timing: SensorTiming,
    *,
    interpolation: Interpolation = "linear",
    quadrature: Quadrature = "midpoint",
    num_nodes: int | None = None,
) -> RowPSF:
    """Point spread function of every row (Eqs. 25-39 of Liu et al. 2023 with the defaults).

    Each node of the exposure is a displaced copy of the scene, interpolated with 2 x 2 (linear, Eqs. 26-34) or 4 x 4
    (cubic B-spline) taps; the kernel is their weighted mean (Eq. 39). Linear interpolation adds a blur that is not
    part of the image formation; cubic interpolation does not.

    Args:
        vibration: The motion.
        starts: Exposure starts of the rows in seconds, (..., R); batch dimensions of the vibration lead.
        timing: The sensor.
        interpolation: ``"linear"`` (the paper) or ``"cubic"``.
        quadrature: ``"midpoint"`` (the paper: N_e nodes) or ``"gauss"``.
        num_nodes: Number of nodes; by default N_e, or what the motion requires for ``"gauss"``.

    Returns:
        The kernels of all rows.

    Example:
        >>> from rsvib_torch import Vibration
        >>> timing = SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=512)
        >>> psf = row_psf(Vibration(2.0, 50.0), timing.row_starts(2, 512), timing)
        >>> psf.weights.shape[:2]
        torch.Size([2, 512])
    """
    if not starts.numel() or not bool(torch.isfinite(starts).all()):
        raise ValueError(f"starts must be finite times of at least one row (seconds), got shape {tuple(starts.shape)}")
    displacement, node_weights = exposure_trajectory(vibration, starts, timing, quadrature, num_nodes)
    return trajectory_psf(displacement, node_weights, interpolation=interpolation)


def trajectory_psf(displacement: Tensor, node_weights: Tensor, *, interpolation: Interpolation = "linear") -> RowPSF:
    """Point spread function of every row from the displacement at the nodes of its exposure (Eqs. 26-39).

    Args:
        displacement: (..., R, N, 2) px, axes (x, y).
        node_weights: (N,), sums to 1.
        interpolation: As in ``row_psf``.

    Returns:
        The kernels of all rows.
    """
    check_choice("interpolation", interpolation, tuple(SPLINE_DEGREES))
    degree = SPLINE_DEGREES[interpolation]
    _check_memory(displacement.detach(), degree)
    first_x, weights_x = _axis_weights(displacement[..., 0], degree)
    first_y, weights_y = _axis_weights(displacement[..., 1], degree)
    weights = (weights_y * node_weights[:, None]).transpose(-2, -1) @ weights_x
    return RowPSF(torch.stack([first_x, first_y], dim=-1), weights, degree)


def row_taps(places: Tensor, node_weights: Tensor, interpolate: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
    """Scene rows between which rows of frames are interpolated.

    Args:
        places: (..., R, N) scene rows at the nodes of the exposures.
        node_weights: (N,), sums to 1.
        interpolate: Weights (..., K) of K neighbouring rows at fractional positions (...).

    Returns:
        Integer part (..., R) of the lowest place of each row, int64, and weights (..., R, J, N) of J rows from there.
    """
    cell = places.detach().floor()
    first, taps = spread_taps(cell, interpolate(places - cell) * node_weights[:, None])
    return first, taps.transpose(-2, -1)


def row_transfer(taps: Tensor, along: Tensor, frequencies: Tensor) -> Tensor:
    """Kernels (..., R, J, U) of rows after a Fourier transform along them: ``sum_n taps exp(-2 pi i u x_n)``.

    Args:
        taps: (..., R, J, N) weights of J scene rows, as from ``row_taps``.
        along: (..., R, N) displacement x_n along the rows in px.
        frequencies: (U,) u in cycles per px.
    """
    angle = (-2 * math.pi) * along[..., None] * frequencies
    taps = taps.to(angle.dtype)
    return torch.complex(taps @ angle.cos(), taps @ angle.sin())


def form_rows(
    spectra: Tensor, places: Tensor, along: Tensor, node_weights: Tensor, frequencies: Tensor, degree: int
) -> Tensor:
    """Form rows of frames from the spectra of the rows of a scene, which is mirrored beyond its first and last row.

    Args:
        spectra: (..., S, U) of the B-spline coefficients of S scene rows.
        places: (T, R, N) scene rows at the nodes of the exposures of R rows of T frames.
        along: (T, R, N) displacement along the rows in px.
        node_weights: (N,), sums to 1.
        frequencies: (U,) in cycles per px.
        degree: Degree of the B-spline across rows.

    Returns:
        Spectra (..., T, R, U).
    """
    first, taps = row_taps(places, node_weights, partial(bspline_weights, degree=degree))
    source = first[..., None] - degree // 2 + torch.arange(taps.shape[-2], device=first.device)
    transfer = row_transfer(taps, along, frequencies).to(spectra.dtype)
    # sum over the taps of each row
    return (spectra[..., mirrored(source, spectra.shape[-2]), :] * transfer).sum(-2)
