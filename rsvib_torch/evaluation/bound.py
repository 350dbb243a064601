"""Cramér-Rao bound of the parameters of a vibration: the smallest standard deviation of an unbiased estimate.

Invariant: the displacement depends on the row only (docs/architecture.md). With roll and zoom, the operator that forms
the frames is that of the middle column; derivatives by roll and zoom depend on the column.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal

import torch
from pydantic import Field
from torch import Tensor
from torch.nn import functional

from rsvib_torch.checks.arguments import check_images, checks_arguments
from rsvib_torch.checks.validation import Positive
from rsvib_torch.execution.chunking import runs
from rsvib_torch.frames.orientation import frames_to_row_order
from rsvib_torch.imaging import exposure_nodes, exposure_trajectory, rows_showing, simulate_frames
from rsvib_torch.imaging.blur import row_taps
from rsvib_torch.motion.field import ColumnMotion, displacement_factors
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import RowTiming, SensorTiming
from rsvib_torch.motion.vibration import Vibration, VibrationStd
from rsvib_torch.numerics.banded_solver import solve_halves
from rsvib_torch.numerics.fourier import extend_rows, fast_length, waves
from rsvib_torch.numerics.splines import bspline_coefficients, bspline_weights, mirrored
from rsvib_torch.restoration.scene_model.observation import Observation, RowKernels

_DEGREE = 13  # of the spline across rows; degree 9 changes bounds of a drawn scene by 0.2 %, 15 by 0.05 %
_MARGIN = 16  # px over which the scene closes to a period; 8 and 32 px change these bounds by less than 3e-5
_RIDGE = 1e-10  # of the largest element, for scene rows outside all frames; 1e-9, 1e-11: bounds change by 0.8 %
_CHUNK = 1 << 17  # rows of frames times frequencies, that are computed at once
# Derivative of an image of the scene by a component of the motion, less its sign: terms (field, derivative along x or y
# or none, factor) with the fields s, y s and x s of the scene s, e.g. for roll -y ds/dx + x ds/dy.
_DERIVATIVES = (
    ((0, "x", 1.0),),
    ((0, "y", 1.0),),
    ((1, "x", -1.0), (2, "y", 1.0)),
    ((2, "x", 1.0), (1, "y", 1.0), (0, "", -2.0)),
)

BoundMethod = Literal["projection", "gradients", "random"]
# axis, name of the field, tone
_Parameter = tuple[int, str, int]


# --- Information ---


@dataclass(frozen=True, eq=False)
class Recording:
    """A still scene, the frames taken of it, and the parameters of the bound, in row order."""

    scene: Tensor  # (Hs, Ws) float64; frames are centred on it
    timing: RowTiming  # the sensor
    motion: Motion  # the motion, with two components: with roll and zoom that of the middle column
    num_frames: int  # frames taken
    size: tuple[int, int]  # (H, W) of the frames
    axes: tuple[int, ...]  # for each of the P parameters the component of the motion (x, y, roll, zoom) that it changes
    sensitivity: Callable[[Tensor], Tensor]  # from times (...) to the derivatives (P, ...) of that component

    @property
    def origin(self) -> tuple[int, int]:
        """Scene pixel (row, column) of frame pixel (0, 0) at rest."""
        return (self.scene.shape[0] - self.size[0]) // 2, (self.scene.shape[1] - self.size[1]) // 2

    @property
    def starts(self) -> Tensor:
        """(T, R) s, exposure start of every row of every frame."""
        return self.timing.row_starts(self.num_frames, self.size[0], self.scene.device)

    def positions(self) -> tuple[Tensor, Tensor]:
        """Positions x (1, Ws) and y (Hs, 1) of the scene in px from the centre of the frames."""
        y, x = (
            torch.arange(count, dtype=torch.float64, device=self.scene.device) - first - 0.5 * (size - 1)
            for count, first, size in zip(self.scene.shape, self.origin, self.size, strict=True)
        )
        return x[None], y[:, None]

    def factors(self) -> Tensor:
        """(Hs, Ws, 2, A) displacements of the scene by unit components."""
        return displacement_factors(*self.positions(), max(self.axes) + 1)


def scale_of_information(recording: Recording) -> Tensor:
    """Approximate information (P,) of each parameter for a known scene and unit noise."""
    slope = recording.scene.diff(dim=0).square().mean() + recording.scene.diff(dim=1).square().mean()
    moved = recording.factors().square().sum(2).mean((0, 1))[list(recording.axes)]  # (P,) px^2 of a unit component
    return recording.sensitivity(recording.starts).square().sum((1, 2)) * moved * slope * recording.size[1]


def projected_information(recording: Recording, *, margin: int = _MARGIN) -> Tensor:
    """Information (P, P) of the parameters when the scene is unknown, for unit noise.

    ``J = D' (1 - A (A' A)^-1 A') D``: D are the derivatives of the frames, A takes a scene to its frames, and the part
    of D that a scene could explain contains no information. The displacement along a row is a phase ramp, so that A is
    a banded matrix for each frequency along the row and the projection needs no iterations. The scene is periodic along
    rows, ``margin`` px beyond its ends, without detail above 0.4 cycles/row; only pixels count whose content is visible
    in another frame.
    """
    length = fast_length(recording.scene.shape[1] + 2 * margin)
    scene = _within_band(recording.scene)
    if max(recording.axes) > 1:
        x, y = recording.positions()
        moments = torch.stack([torch.ones_like(scene), y.expand_as(scene), x.expand_as(scene)])
        fields = (scene - scene.mean()) * moments  # the mean has no derivatives; without it the borders are small
    else:
        fields = scene[None]
    spectra = torch.fft.rfft(extend_rows(bspline_coefficients(fields, _DEGREE, -2), length, hold=0.0))  # (F, Hs, U)
    displacement, weights = exposure_trajectory(recording.motion, recording.starts, recording.timing, "gauss")
    ones = weights.new_ones(recording.num_frames)
    kernels = _SplineKernels.of_rows(displacement, weights, ones, recording.size[0], margin=len(scene))
    observation = Observation(kernels, recording.size[0], length, torch.float64)
    normal = observation.normal(0).in_windows([slice(0, observation.count)])
    ridge = (_RIDGE * normal.left.abs().amax()).expand(1, 1, 1, 1)
    residuals = []
    for part in runs(len(observation.u), max(1, _CHUNK // recording.starts.numel())):
        u = observation.u[part]
        derivatives = _derivatives(recording, displacement, weights, spectra[..., part], u.to(spectra.device))
        data = derivatives.transpose(0, 1)[None]  # (1, T, P, R, U)
        right = observation.adjoint(data, part).flatten(2)
        explained = solve_halves(normal.at(u, ridge.expand(1, 1, 1, len(u))), right)
        residuals.append(data - observation.forward(explained[:, :, None], part))
    columns = slice(recording.origin[1], recording.origin[1] + recording.size[1])
    images = torch.fft.irfft(torch.cat(residuals, dim=-1)[0].transpose(0, 1), n=length)[..., columns]  # (P, T, R, W)
    images = (images * _shown_twice(recording)).flatten(1)
    return images @ images.T


def _within_band(scene: Tensor) -> Tensor:
    """The scene without its detail above 0.45 cycles per row, where the spline across rows has aliases."""
    low, high = 0.35, 0.45  # cycles per row, between which detail is attenuated
    length = fast_length(len(scene) + 2 * _MARGIN)
    spectra = torch.fft.rfft(extend_rows(scene.T, length, hold=0.0))
    v = torch.fft.rfftfreq(length, dtype=scene.dtype, device=scene.device)
    share = 0.5 + 0.5 * torch.cos(math.pi * ((v - low) / (high - low)).clamp(0.0, 1.0))
    return torch.fft.irfft(spectra * share, n=length)[:, : len(scene)].T


class _SplineKernels(RowKernels):
    """Kernels of rows that act on the coefficients of B-splines across rows."""

    interpolated = partial(bspline_weights, degree=_DEGREE)
    before = _DEGREE // 2


def _derivatives(recording: Recording, displacement: Tensor, weights: Tensor, spectra: Tensor, u: Tensor) -> Tensor:
    """Derivatives of the spectra of all rows by the parameters, (P, T, R, U).

    The ``displacement`` (T, R, N, 2) is that at the N nodes of the exposures, with ``weights`` (N,); ``spectra`` (F,
    Hs, U) are those of the coefficients of the fields.
    """
    times, _ = exposure_nodes(recording.timing, "gauss", len(weights))
    sensitivity = recording.sensitivity(recording.starts[..., None] + times.to(u.device))  # (P, T, R, N)
    place = recording.origin[0] + torch.arange(recording.size[0], device=u.device)[:, None] - displacement[..., 1]
    (first, value), (_, slope) = (
        row_taps(place, weights, partial(bspline_weights, degree=_DEGREE, derivative=order)) for order in (0, 1)
    )
    source = first[..., None] + torch.arange(value.shape[-2], device=u.device) - _DEGREE // 2  # (T, R, J)
    value, slope = (taps.mT.to(spectra.dtype) for taps in (value, slope))  # (T, R, N, J)
    ramps = waves(displacement[..., 0], u)  # (T, R, N, U)
    images: dict[tuple[int, str], Tensor] = {}  # at the nodes of the exposures, (T, R, N, U)
    for number, field in enumerate(spectra):
        seen = field[mirrored(source, len(field))]  # (T, R, J, U)
        images[number, ""] = (value @ seen) * ramps
        images[number, "x"] = images[number, ""] * (2j * math.pi * u)
        images[number, "y"] = (slope @ seen) * ramps
    by_component = [
        torch.stack([-factor * images[field, of] for field, of, factor in terms]).sum(0)
        for terms in _DERIVATIVES[: max(recording.axes) + 1]
    ]
    by_parameter = zip(recording.axes, sensitivity, strict=True)
    return torch.stack([(slope[..., None] * by_component[axis]).sum(-2) for axis, slope in by_parameter])


def _shown_twice(recording: Recording) -> Tensor:
    """(T, R, W) float64, 1 for pixels whose content is visible in another frame."""
    (height, width), timing, motion = recording.size, recording.timing, recording.motion
    starts, count = recording.starts, recording.num_frames
    own_rows = torch.arange(height, dtype=torch.float64, device=starts.device)
    content = own_rows - motion.mean_displacement(starts, timing.exposure_time)[..., 1]
    begin = timing.frame_starts(count, starts.device)
    # rows (T, R, q) of frame q that show the content of each frame row, and the displacement along them
    rows = rows_showing(content[..., None].expand(-1, -1, count), begin, timing, motion)
    own = torch.eye(count, dtype=torch.bool, device=starts.device)[:, None]
    rows = torch.where(own, own_rows[:, None], rows)  # exactly, so that the first and last rows stay inside
    shift = motion.mean_displacement(begin + rows * timing.row_time, timing.exposure_time)[..., 0]
    columns = torch.arange(width, dtype=torch.float64, device=starts.device)
    place = columns - shift.diagonal(dim1=0, dim2=2).T[..., None, None] + shift[..., None]  # (T, R, q, W)
    inside = (place >= 0) & (place <= width - 1)
    inside &= ((rows >= 0) & (rows <= height - 1))[..., None]
    return (inside.sum(2) >= 2).double()


def gradient_information(recording: Recording, noise: float | None = None) -> Tensor:
    """The information in closed form, row by row, for unit noise.

    ``J = sum_s sum_p (d_p - d)' M(s) (d_p - d)``: M(s) sums the gradient products of scene row s, d_p are the
    derivatives of its displacement in frame p and d their mean. Blur within the exposure and the extent of
    interpolation kernels are neglected. With the standard deviation of the ``noise``, gradients are weighted by ``T S /
    (T S + N)``: the scene is a random Gaussian one with the power spectrum S of this one, N is the power of the noise.
    Without it, the scene is unknown and deterministic.
    """
    timing, count = recording.timing, recording.num_frames
    (top, left), (height, width) = recording.origin, recording.size
    begin = timing.frame_starts(count, recording.scene.device)
    scene_rows = torch.arange(recording.scene.shape[0], dtype=torch.float64, device=begin.device)
    rows = rows_showing(scene_rows[:, None] - top, begin.expand(len(scene_rows), count), timing, recording.motion)
    moments = begin + rows * timing.row_time
    middle = moments + 0.5 * timing.exposure_time
    # rows of a frame per row of the scene
    density = 1 / (1 - recording.motion.velocity(middle)[..., 1] * timing.row_time)
    seen = ((rows >= 0) & (rows <= height - 1)) * density  # (S, T)
    shift = recording.motion.mean_displacement(moments, timing.exposure_time)[..., 0]
    low, high = (torch.where(seen > 0, shift, far) for far in (math.inf, -math.inf))
    columns = torch.arange(recording.scene.shape[1], dtype=torch.float64, device=begin.device) - left
    window = (columns >= -low.amin(1, keepdim=True)) & (columns <= width - 1 - high.amax(1, keepdim=True))
    factors = recording.factors()
    products = _gradient_products(recording.scene, factors, window.double(), noise, count)  # (S, A, A)
    times, weights = (value.to(begin.device) for value in exposure_nodes(timing, "gauss", 8))
    means = recording.sensitivity(moments[..., None] + times) @ weights  # over the exposures, (P, S, T)
    axes = functional.one_hot(torch.tensor(recording.axes, device="cpu"), factors.shape[-1]).to(means)
    sensitivity = means[..., None] * axes[:, None, None]
    mean = (seen[..., None] * sensitivity).sum(2, keepdim=True) / seen.sum(1).clamp(min=1e-300)[:, None, None]
    shared = seen * ((seen > 0).sum(1, keepdim=True) > 1)
    relative = sensitivity - mean
    return torch.einsum("psta,st,sab,qstb->pq", relative, shared, products, relative)


def _gradient_products(scene: Tensor, factors: Tensor, window: Tensor, noise: float | None, num_frames: int) -> Tensor:
    """Sums (S, A, A) of the products of the derivatives by the A components over the columns, weighted by a window.

    The scene is (S, W), the displacements by unit components are (S, W, 2, A); ``noise`` as in
    ``gradient_information``.
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


# --- Bound ---


def _parameters(motion: Vibration, acceleration: bool) -> list[_Parameter]:
    """Unknown parameters: those of all tones of non-zero amplitude, and the image motion of all axes."""
    parameters: list[_Parameter] = []
    for axis in range(motion.num_axes):
        for tone in range(motion.amplitude.shape[-1]):
            if float(motion.amplitude[axis, tone]) > 0:
                parameters += [(axis, name, tone) for name in ("amplitude", "frequency", "phase")]
        parameters += [(axis, "image_motion", 0)]
        parameters += [(axis, "image_acceleration", 0)] if acceleration else []
    return parameters


def _sensitivity(motion: Vibration, parameter: _Parameter, times: Tensor) -> Tensor:
    """Derivative of a component of the motion at ``times`` by a parameter."""
    axis, name, tone = parameter
    if name == "image_motion":
        return times
    if name == "image_acceleration":
        return 0.5 * times.square()
    amplitude, frequency, phase = (value[axis, tone] for value in (motion.amplitude, motion.frequency, motion.phase))
    angle = 2 * math.pi * frequency * times + phase
    if name == "amplitude":
        return angle.sin()
    return amplitude * angle.cos() * (2 * math.pi * times if name == "frequency" else 1.0)


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
    method: BoundMethod = "projection",
    acceleration: bool = False,
) -> VibrationStd:
    """Cramér-Rao bound of the parameters of a vibration, for white Gaussian noise and an unknown scene.

    No unbiased estimate has a smaller standard deviation. With D the derivatives of the frames by the parameters and A
    the operator that forms the frames, ``J = D' (1 - A (A' A)^-1 A') D / noise^2`` is the information if the scene is
    unknown too, and the bound is the root of the diagonal of its inverse. All parameters are unknown together:
    amplitude, frequency and phase (at the time origin) of all tones of an amplitude above 0, and the image motion, of
    all axes of the motion. ``docs/bound.md`` has the derivation.

    Args:
        scene: (H, W) noise-free still scene, floating point, full scale 1, larger than the frames.
        timing: The sensor.
        vibration: The true motion, in image axes (not a batch).
        num_frames: Frames taken of the scene.
        noise: Standard deviation of the noise of a pixel as a fraction of full scale.
        frame_size: (height, width) of the frames, as in ``simulate_frames``.
        method: ``"projection"``, exact for an unknown deterministic scene; ``"gradients"``, its closed approximation
            row by row, several times faster; or ``"random"``, the same for a random Gaussian scene with the power
            spectrum of this one: larger if part of the spectrum is below the noise.
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
    motion = vibration.to_row_order(timing).to(scene.device)
    parameters = _parameters(motion, acceleration)
    frames = frames_to_row_order(frames, timing)
    recording = Recording(
        scene=frames_to_row_order(scene.double(), timing),
        timing=timing.in_row_order(),
        motion=_of_middle_column(motion, timing.in_row_order(), num_frames, frames.shape[-2]),
        num_frames=num_frames,
        size=(frames.shape[-2], frames.shape[-1]),
        axes=tuple(axis for axis, _, _ in parameters),
        sensitivity=lambda times: torch.stack([_sensitivity(motion, p, times) for p in parameters]),
    )
    if method == "projection":
        information = projected_information(recording)
    else:
        information = gradient_information(recording, noise if method == "random" else None)
    deviations = noise * _deviations(information, scale_of_information(recording))

    std = {name: torch.zeros_like(motion.amplitude) for name in ("amplitude", "frequency", "phase")}
    std |= {name: torch.zeros_like(motion.image_motion) for name in ("image_motion", "image_acceleration")}
    for (axis, name, tone), deviation in zip(parameters, deviations, strict=True):
        std[name][(axis, tone) if std[name].ndim == 2 else axis] = deviation
    std["period"] = std["frequency"] / torch.where(motion.frequency > 0, motion.frequency, 1.0).square()
    return VibrationStd(**std).from_row_order(timing)


def _of_middle_column(motion: Vibration, timing: RowTiming, num_frames: int, num_rows: int) -> Motion:
    """Motion with two components, of the middle column if there are roll and zoom.

    Roll shows the content of one scene row in different frame rows, by 1 px at 1 mrad and 1000 px from the centre.
    Their times then differ by a row time, which changes the information by less than a thousandth.
    """
    if motion.num_axes == 2:
        return motion
    middle = torch.zeros(1, dtype=torch.float64, device=motion.device)
    return ColumnMotion.of_columns(motion.expanded(1), middle, timing, num_frames, num_rows)[0]
