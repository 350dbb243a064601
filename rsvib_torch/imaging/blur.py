"""The row-varying blur: point spread function and transfer function of every row, the operator and its exact adjoint.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn

from rsvib_torch.checks.arguments import check_broadcast, check_images, checked_methods, checks_arguments
from rsvib_torch.checks.values import check_choice
from rsvib_torch.execution.parallel import at_once, full_precision, outside_graphs, runs
from rsvib_torch.files.reading import check_fits
from rsvib_torch.imaging.trajectory import Quadrature, exposure_trajectory
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.numerics.interpolation import (
    bspline_coefficients,
    bspline_weights,
    mirrored,
    spread_taps,
)

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
        weights = self.weights
        rows, columns = (weights.new_ones(count).cumsum(0) - 1 for count in weights.shape[-2:])
        x, y = (weights.sum(-2) * columns).sum(-1), (weights.sum(-1) * rows).sum(-1)
        return torch.stack([x, y], dim=-1) + self.first_tap


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
        quadrature: ``"midpoint"`` (the paper: N_e nodes) or ``"gauss"``, with as many nodes as the motion requires.

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
    displacement, node_weights = exposure_trajectory(vibration, starts, timing, quadrature)
    return trajectory_psf(displacement, node_weights, interpolation=interpolation)


def trajectory_psf(displacement: Tensor, node_weights: Tensor, *, interpolation: Interpolation = "linear") -> RowPSF:
    """Point spread function of every row from displacements (..., R, N, 2) px at the nodes of exposures (Eqs. 26-39).

    The ``node_weights`` (N,) sum to 1; ``interpolation`` as in ``row_psf``.
    """
    check_choice("interpolation", interpolation, tuple(SPLINE_DEGREES))
    degree = SPLINE_DEGREES[interpolation]
    _check_memory(displacement.detach(), degree)
    interpolate = partial(bspline_weights, degree=degree)
    first_x, taps_x = row_taps(displacement[..., 0], torch.ones_like(node_weights), interpolate)
    first_y, taps_y = row_taps(displacement[..., 1], node_weights, interpolate)
    return RowPSF(torch.stack([first_x, first_y], dim=-1) - degree // 2, taps_y @ taps_x.mT, degree)


def row_taps(places: Tensor, node_weights: Tensor, interpolate: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
    """Integer part (..., R) of the lowest of the ``places`` (..., R, N) of a row, and weights (..., R, J, N) from it.

    ``interpolate`` returns the weights (..., K) of K neighbouring scene rows at fractional positions (...).
    """
    cell = places.detach().floor()
    first, taps = spread_taps(cell, interpolate(places - cell) * node_weights[:, None])
    return first, taps.transpose(-2, -1)


def row_transfer(taps: Tensor, along: Tensor, frequencies: Tensor) -> Tensor:
    """Kernels (..., R, J, U) of rows after a Fourier transform along them: ``sum_n taps exp(-2 pi i u x_n)``.

    The ``taps`` (..., R, J, N) are those of ``row_taps``; ``along`` (..., R, N) is the displacement x_n in px.
    """
    angle = ((-2 * math.pi) * along[..., None] * frequencies).flatten(0, -3)
    weights = taps.to(angle.dtype).flatten(0, -3)
    transfer = torch.complex(torch.bmm(weights, angle.cos()), torch.bmm(weights, angle.sin()))
    return transfer.view(*taps.shape[:-1], -1)


def form_frames(
    spectra: Tensor, place: Tensor, along: Tensor, node_weights: Tensor, degree: int, length: int, columns: slice
) -> Tensor:
    """Form frames (..., T, R, W) from the spectra of the rows of scenes, which are mirrored beyond their ends (Eq. 9).

    The ``spectra`` (..., 1, S, U) of one scene for all frames, or (..., T, S, U) of one for each of T frames, are those
    of B-spline coefficients, of ``degree`` across the rows, whose rows are extended to ``length``. At each node of its
    exposure, a row shows scene row ``place`` (T, R, N), displaced by ``along`` (T, R, N) px along the row. Of the rows,
    ``columns`` are returned.
    """
    u = torch.fft.rfftfreq(length, dtype=along.dtype, device=along.device)
    first, taps = row_taps(place, node_weights, partial(bspline_weights, degree=degree))
    source = first[..., None] + torch.arange(-(degree // 2), taps.shape[-2] - degree // 2, device=first.device)
    scenes, rows = spectra.shape[-3:-1]
    source = mirrored(source, rows) + rows * torch.arange(scenes, device=first.device)[:, None, None]
    formed = []
    for part in runs(source.shape[1], at_once(16 * taps.shape[-2] * len(u) * len(source), along.device)):
        transfer = row_transfer(taps[:, part], along[:, part], u).to(spectra.dtype)
        # sum over the taps of each row
        row_spectra = (spectra.flatten(-3, -2)[..., source[:, part], :] * transfer).sum(-2)
        formed.append(torch.fft.irfft(row_spectra, n=length)[..., columns])
    return torch.cat(formed, dim=-2)


def _gather_index(psf: RowPSF, tap: int, scene_size: tuple[int, int]) -> Tensor:
    """Flat scene index (..., R, W + KW - 1) of the pixels that kernel row ``tap`` of each row uses."""
    device, (height, width) = psf.weights.device, scene_size
    num_rows, kernel_width = psf.weights.shape[-3], psf.weights.shape[-1]
    rows = (height - num_rows) // 2 + torch.arange(num_rows, device=device) - psf.first_tap[..., 1] - tap
    columns = torch.arange(-(kernel_width - 1), width, device=device) - psf.first_tap[..., 0, None]
    return mirrored(rows, height)[..., None] * width + mirrored(columns, width)


def _coefficients(scene: Tensor, degree: int) -> Tensor:
    """B-spline coefficients along both axes."""
    return bspline_coefficients(bspline_coefficients(scene, degree, -1), degree, -2)


@outside_graphs
@full_precision
def blur_rows(scene: Tensor, psf: RowPSF) -> Tensor:
    """Form frames (..., R, W): every output row is the scene convolved with that row's kernel (Eq. 38).

    The output row selects the kernel: convolve, then take the row. Beyond its edges the scene is mirrored.

    Args:
        scene: (..., Hs, W), of which the frame shows the R rows in the middle; leading dimensions broadcast against
            those of the kernels.
        psf: Kernels of R rows.
    """
    size = (scene.shape[-2], scene.shape[-1])
    coefficients = _coefficients(scene, psf.degree)
    weights = psf.weights.to(scene.dtype)
    check_broadcast(scene=scene[..., 0, 0], psf=weights[..., 0, 0, 0])
    lead = torch.broadcast_shapes(scene.shape[:-2], weights.shape[:-3])
    flat = coefficients.flatten(-2).expand(*lead, -1)
    num_rows, kernel_height, kernel_width = weights.shape[-3:]
    frames = scene.new_zeros(*lead, num_rows, size[1])
    for tap in range(kernel_height):
        index = _gather_index(psf, tap, size)
        pixels = flat.gather(-1, index.flatten(-2).expand(*lead, -1)).unflatten(-1, index.shape[-2:])
        for column in range(kernel_width):
            frames = frames + weights[..., tap, column, None] * pixels.narrow(-1, kernel_width - 1 - column, size[1])
    return frames


@outside_graphs
@full_precision
def blur_rows_adjoint(frames: Tensor, psf: RowPSF, scene_shape: tuple[int, ...]) -> Tensor:
    """Apply the exact adjoint (transpose) of ``blur_rows`` to frames (..., R, W).

    Leading dimensions of ``scene_shape`` (..., Hs, W) that were broadcast are summed.
    """
    if len(scene_shape) < 2 or min(scene_shape) < 1:
        raise ValueError(f"scene_shape must be (..., height, width), all at least 1, got {tuple(scene_shape)}")
    weights, size = psf.weights.to(frames.dtype), (scene_shape[-2], scene_shape[-1])
    expected = (weights.shape[-3], size[1])
    if tuple(frames.shape[-2:]) != expected:
        raise ValueError(
            f"frames must have the rows of the kernels and the columns of scene_shape, {expected}, got shape "
            f"{tuple(frames.shape)}"
        )
    check_broadcast(frames=frames[..., 0, 0], psf=weights[..., 0, 0, 0])
    lead = torch.broadcast_shapes(frames.shape[:-2], weights.shape[:-3])
    summed = zip(reversed(scene_shape[:-2]), reversed(lead), strict=False)
    if len(scene_shape) - 2 > len(lead) or any(length not in (1, many) for length, many in summed):
        raise ValueError(f"scene_shape {tuple(scene_shape)} does not broadcast to the frames {(*lead, *size)}")
    flat = frames.new_zeros(*lead, math.prod(size))
    num_rows, kernel_height, kernel_width = weights.shape[-3:]
    for tap in range(kernel_height):
        pixels = frames.new_zeros(*lead, num_rows, size[1] + kernel_width - 1)
        for column in range(kernel_width):
            pixels.narrow(-1, kernel_width - 1 - column, size[1]).add_(weights[..., tap, column, None] * frames)
        index = _gather_index(psf, tap, size)
        flat = flat.scatter_add(-1, index.flatten(-2).expand(*lead, -1), pixels.flatten(-2))
    scene = flat.unflatten(-1, size).sum_to_size(scene_shape)
    # the transpose of the spline filter
    transpose = torch.func.vjp(lambda pixels: _coefficients(pixels, psf.degree), torch.zeros_like(scene))[1]
    back: Tensor = transpose(scene)[0]
    return back


@checked_methods
class RowVaryingBlur(nn.Module):
    """``blur_rows`` with fixed kernels as a module, with its adjoint.

    ``A`` and ``A_adjoint`` are the pair that solvers of linear inverse problems require, for example
    ``deepinv.physics.LinearPhysics(A=blur.A, A_adjoint=blur.A_adjoint)``.

    Args:
        psf: Kernels of all rows (kept as buffers).

    Example:
        >>> from rsvib_torch import SensorTiming, Vibration, row_psf
        >>> timing = SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=512)
        >>> psf = row_psf(Vibration(2.0, 50.0), timing.row_starts(1, 64)[0], timing)
        >>> blur = RowVaryingBlur(psf)
        >>> scene, frame = torch.rand(2, 1, 3, 64, 48, dtype=torch.float64)
        >>> torch.testing.assert_close((blur.A(scene) * frame).sum(), (scene * blur.A_adjoint(frame)).sum())
    """

    first_tap: Tensor
    weights: Tensor

    def __init__(self, psf: RowPSF) -> None:
        super().__init__()
        self.register_buffer("first_tap", psf.first_tap)
        self.register_buffer("weights", psf.weights)
        self.degree = psf.degree

    @property
    def psf(self) -> RowPSF:
        """The kernels."""
        return RowPSF(self.first_tap, self.weights, self.degree)

    def forward(self, scene: Tensor) -> Tensor:
        """Form frames (..., R, W) from a scene (..., Hs, W)."""
        check_images({"scene": scene}, {"scene": "... H W"})
        return blur_rows(scene, self.psf)

    def A(self, x: Tensor, **kwargs: object) -> Tensor:  # noqa: N802 - name that solvers use
        """``forward`` under the name that solvers use; their further keywords are ignored."""
        return self(x)

    def A_adjoint(  # noqa: N802 - name that solvers use
        self, y: Tensor, scene_shape: tuple[int, ...] | None = None, **kwargs: object
    ) -> Tensor:
        """``blur_rows_adjoint`` of frames (..., R, W), by default for scenes of their shape."""
        check_images({"y": y}, {"y": "... R W"})
        return blur_rows_adjoint(y, self.psf, tuple(y.shape) if scene_shape is None else scene_shape)
