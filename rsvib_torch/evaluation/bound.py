"""Cramér-Rao bound of the parameters of a vibration: the smallest standard deviation of an unbiased estimate.

Invariant: the displacement depends on the row only (docs/architecture.md). With roll and zoom, the rows that show a
part of the scene are those of the middle column; derivatives by roll and zoom depend on the column.
"""

import math
from typing import Annotated, Literal

import torch
from pydantic import Field
from torch import Tensor
from torch.nn import functional

from rsvib_torch.checks.arguments import check_images, checks_arguments
from rsvib_torch.checks.values import Positive
from rsvib_torch.frames.prepare import frames_to_row_order
from rsvib_torch.imaging import rows_showing, simulate_frames
from rsvib_torch.motion.camera import displacement_factors
from rsvib_torch.motion.motion import ColumnMotion, Motion
from rsvib_torch.motion.timing import RowTiming, SensorTiming
from rsvib_torch.motion.vibration import Vibration, VibrationStd
from rsvib_torch.numerics.interpolation import extend_rows, fast_length, gauss_legendre

_MARGIN = 16  # px over which the scene closes to a period; 8 and 32 px change these bounds by less than 3e-5

BoundMethod = Literal["gradients", "random"]


# --- Information ---


def _sensitivity(motion: Vibration, times: Tensor) -> Tensor:
    """Derivatives (A, 3 K + 2, ...) of the components of the motion at ``times`` (...) by all of its parameters.

    Those are the amplitudes, frequencies and phases of the tones, image motion and image acceleration.
    """
    shape = (*motion.amplitude.shape, *(1,) * times.ndim)
    amplitude, frequency, phase = (one.view(shape) for one in (motion.amplitude, motion.frequency, motion.phase))
    angle = 2 * math.pi * frequency * times + phase
    by_phase = amplitude * angle.cos()
    polynomial = torch.stack([times, 0.5 * times.square()]).expand(len(amplitude), 2, *times.shape)
    return torch.cat([angle.sin(), by_phase * 2 * math.pi * times, by_phase, polynomial], 1)


def _information(
    scene: Tensor,
    size: tuple[int, int],
    num_frames: int,
    timing: RowTiming,
    motion: Vibration,
    unknown: Tensor,
    noise: float | None,
) -> tuple[Tensor, Tensor]:
    """Information (P, P) of the parameters row by row, for unit noise, and approximately (P,) for a known scene.

    ``unknown`` marks the parameters among those of ``_sensitivity``.

    ``J = sum_s sum_p (d_p - d)' M(s) (d_p - d)``: M(s) sums the gradient products of row s of the scene (Hs, Ws), d_p
    are the derivatives of its displacement in frame p and d their mean. Blur within the exposure and the extent of
    interpolation kernels are neglected. With the standard deviation of the ``noise``, gradients are weighted by ``T S /
    (T S + N)``: the scene is a random Gaussian one with the power spectrum S of this one, N is the power of the noise.
    Without it, the scene is unknown and deterministic. Frames of a ``size`` (H, W) are centred on the scene.
    """
    (height, width), device = size, scene.device
    top, left = ((whole - part) // 2 for whole, part in zip(scene.shape, size, strict=True))
    y, x = (torch.arange(count, dtype=torch.float64, device=device) for count in scene.shape)
    axes = unknown.nonzero()[:, 0]

    def sensitivity(times: Tensor) -> Tensor:
        """From times (...) to the derivatives (P, ...) of the component that each parameter changes."""
        return _sensitivity(motion, times)[unknown]

    # rows (S, T) of the frames that show each row of the scene, and how many of them per row of the scene: dr / ds
    displacement = _of_middle_column(motion, timing, num_frames, height)
    begin = timing.frame_starts(num_frames, device)
    rows, _ = rows_showing(y[:, None] - top, begin.expand(len(y), num_frames), timing, displacement)
    moments = begin + rows * timing.row_time
    visible = ((rows >= 0) & (rows <= height - 1)) * torch.gradient(rows, dim=0)[0]

    # products of the gradients over the columns that all frames show
    shift = displacement.mean_displacement(moments, timing.exposure_time)[..., 0]
    low, high = (torch.where(visible > 0, shift, far) for far in (math.inf, -math.inf))
    window = (x - left >= -low.amin(1, keepdim=True)) & (x - left <= width - 1 - high.amax(1, keepdim=True))
    from_centre = (x - left - 0.5 * (width - 1))[None], (y - top - 0.5 * (height - 1))[:, None]
    factors = displacement_factors(*from_centre, motion.num_axes)  # (Hs, Ws, 2, A)
    products = _gradient_products(scene, factors, window.double(), noise, num_frames)  # (S, A, A)

    # derivatives (P, S, T, A) of the displacement by the parameters, averaged over the exposures, without their mean
    nodes, weights = (value.to(device) for value in gauss_legendre(8))
    times = nodes * timing.exposure_time
    of_axis = functional.one_hot(axes, factors.shape[-1]).to(weights)
    derivatives = (sensitivity(moments[..., None] + times) @ weights)[..., None] * of_axis[:, None, None]
    mean = (visible[..., None] * derivatives).sum(2, keepdim=True) / visible.sum(1).clamp(min=1e-300)[:, None, None]
    relative = derivatives - mean
    shared = visible * ((visible > 0).sum(1, keepdim=True) > 1)
    # summed over rows s of the scene, frames t, and components a and b
    information = torch.einsum("psta,st,sab,qstb->pq", relative, shared, products, relative)

    slope = scene.diff(dim=0).square().mean() + scene.diff(dim=1).square().mean()
    unit = factors.square().sum(2).mean((0, 1))[axes]  # (P,) px^2 of a unit component
    starts = timing.row_starts(num_frames, height, device)
    return information, sensitivity(starts).square().sum((1, 2)) * unit * slope * width


def _gradient_products(scene: Tensor, factors: Tensor, window: Tensor, noise: float | None, num_frames: int) -> Tensor:
    """Sums (S, A, A) of the products of the derivatives by the A components over the columns, weighted by a window.

    The scene is (S, W), the displacements by unit components are (S, W, 2, A); ``noise`` as in
    ``_information``.
    """
    lengths = [fast_length(size + 2 * _MARGIN) for size in scene.shape]
    closed = extend_rows(extend_rows(scene, lengths[1], hold=0.0).T, lengths[0], hold=0.0).T
    spectrum = torch.fft.fft2(closed - closed.mean())
    v, u = (torch.fft.fftfreq(n, dtype=torch.float64, device=scene.device) for n in lengths)
    slopes = torch.stack([2j * math.pi * u * spectrum, 2j * math.pi * v[:, None] * spectrum])

    def images(spectra: Tensor) -> Tensor:
        values: Tensor = torch.fft.ifft2(spectra).real
        return values[:, : scene.shape[0], : scene.shape[1]]

    gradients = images(slopes)
    weighted = gradients
    if noise is not None:
        size = 9  # frequencies along each axis, over which the power spectrum is averaged
        power = functional.pad(spectrum.abs().square()[None, None], (size // 2,) * 4, mode="circular")
        power = num_frames * functional.avg_pool2d(power, size, 1)[0, 0]
        weighted = images(slopes * (power / (power + noise**2 * spectrum.numel())))
    derivatives, weighted = (torch.einsum("isx,sxia->asx", values, factors) for values in (gradients, weighted))
    products = torch.einsum("asx,sx,bsx->sab", derivatives, window, weighted)
    return 0.5 * (products + products.transpose(-2, -1))


def _of_middle_column(motion: Vibration, timing: RowTiming, num_frames: int, num_rows: int) -> Motion:
    """Motion with two components, of the middle column if there are roll and zoom.

    Roll shows the content of one scene row in different frame rows, by 1 px at 1 mrad and 1000 px from the centre.
    Their times then differ by a row time, which changes the information by less than a thousandth.
    """
    if motion.num_axes == 2:
        return motion
    middle = torch.zeros(1, dtype=torch.float64, device=motion.device)
    return ColumnMotion.of_columns(motion.expanded(1), middle, timing, num_frames, num_rows)[0]


# --- Bound ---


def _deviations(information: Tensor, typical: Tensor) -> Tensor:
    """Square roots of the diagonal of the inverse; infinite where there is no information.

    Eigenvalues below 1e-8 of the information (P,) for a known scene count as zero.
    """
    scale = typical.clamp(min=1e-300).rsqrt()
    values, vectors = torch.linalg.eigh(information * scale[:, None] * scale)
    least = 1e-8
    blind = values < least
    shares = vectors.square()
    variance = shares @ torch.where(blind, 0.0, 1 / values.clamp(min=least))
    variance = torch.where(shares @ blind.double() > least, math.inf, variance)
    return variance.sqrt() * scale


@checks_arguments
def cramer_rao_bound(
    scene: Tensor,
    timing: SensorTiming,
    vibration: Vibration,
    num_frames: Annotated[int, Field(ge=2)] = 2,
    *,
    noise: Positive,
    frame_size: tuple[int, int] | None = None,
    method: BoundMethod = "gradients",
    acceleration: bool = False,
) -> VibrationStd:
    """Cramér-Rao bound of the parameters of a vibration, for white Gaussian noise and an unknown scene.

    No unbiased estimate has a smaller standard deviation. Each row of the scene contributes the information in the
    differences of its displacement between the frames, weighted by its gradients; the bound is the root of the diagonal
    of the inverse. All parameters are unknown together: amplitude, frequency and phase (at the time origin) of all
    tones of an amplitude above 0, and the image motion, of all axes of the motion. ``docs/bound.md`` has the
    derivation.

    Args:
        scene: (H, W) noise-free still scene, floating point, full scale 1, larger than the frames.
        timing: The sensor.
        vibration: The true motion, in image axes (not a batch).
        num_frames: Frames taken of the scene.
        noise: Standard deviation of the noise of a pixel as a fraction of full scale.
        frame_size: (height, width) of the frames, as in ``simulate_frames``.
        method: ``"gradients"``, for an unknown deterministic scene, row by row; or ``"random"``, the same for a random
            Gaussian scene with the power spectrum of this one: larger if part of the spectrum is below the noise.
        acceleration: Whether the image acceleration is unknown as well (else it is known).

    Returns:
        Standard deviations in the layout of ``detection.std``: infinite without information (amplitude and phase
        at a blind frequency), 0 for tones of amplitude 0 and for a known acceleration.

    Example:
        >>> timing = SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=512)
        >>> scene = torch.rand(128, 96, generator=torch.Generator().manual_seed(0))
        >>> bound = cramer_rao_bound(scene, timing, Vibration(0.5, 700.0), noise=0.01, frame_size=(90, 60))
        >>> bool((bound.amplitude < 0.05).all())
        True
    """
    check_images({"scene": scene}, {"scene": "H W"})
    if vibration.camera is not None:
        raise ValueError("the bound is not defined with a camera: pass the vibration without camera=")
    # the simulation checks the sizes and the motion
    frames = simulate_frames(scene.double(), timing, vibration, num_frames, frame_size=frame_size)
    size = frames_to_row_order(frames, timing).shape[-2:]
    motion = vibration.to_row_order(timing).to(scene.device)
    # the parameters of the tones of an amplitude above 0, and the image motion
    others = torch.tensor([True, acceleration], device=scene.device).expand(motion.num_axes, 2)
    unknown = torch.cat([(motion.amplitude > 0).repeat(1, 3), others], 1)
    still = frames_to_row_order(scene.double(), timing)
    level = noise if method == "random" else None
    information, typical = _information(
        still, (size[0], size[1]), num_frames, timing.in_row_order(), motion, unknown, level
    )
    deviations = torch.zeros(unknown.shape, dtype=torch.float64, device=scene.device)
    deviations[unknown] = noise * _deviations(information, typical)
    amplitude, frequency, phase, others = deviations.split([*3 * [motion.amplitude.shape[1]], 2], 1)
    period = frequency / torch.where(motion.frequency > 0, motion.frequency, 1.0).square()
    return VibrationStd(amplitude, frequency, period, phase, *others.unbind(1)).from_row_order(timing)
