"""Fisher information about the parameters of a motion in frames of one unknown scene.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.core.banded_solver import solve_banded
from rsvib_torch.core.fourier import extend_rows, fast_length
from rsvib_torch.core.splines import bspline_coefficients, bspline_weights, mirrored, spread_taps
from rsvib_torch.imaging import exposure_nodes, exposure_trajectory, rows_showing
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import RowTiming

__all__ = [
    "Recording",
    "gradient_information",
    "projected_information",
    "random_information",
    "scale_of_information",
]

_DEGREE = 13  # of the spline across rows
_BAND = (0.35, 0.45)  # cycles per row, transition of the low-pass of the scene: the spline has aliases above
_MARGIN = 16  # columns over which the scene closes to a period
_RIDGE = 1e-10  # of the largest element, for scene rows outside all frames
_CHUNK = 1 << 17  # rows of all frames times frequencies worked on at a time


@dataclass(frozen=True, eq=False)
class Recording:
    """A still scene, the frames taken of it, and the parameters of the bound, in row order.

    Attributes:
        scene: (Hs, Ws) float64; frames are centred on it.
        timing: The sensor.
        motion: The motion.
        num_frames: Frames taken.
        size: (H, W) of the frames.
        axes: For each of the P parameters the axis (0: x, 1: y) whose displacement it changes.
        sensitivity: From times (...) to the derivatives (P, ...) of the displacement along that axis.
    """

    scene: Tensor
    timing: RowTiming
    motion: Motion
    num_frames: int
    size: tuple[int, int]
    axes: tuple[int, ...]
    sensitivity: Callable[[Tensor], Tensor]

    @property
    def origin(self) -> tuple[int, int]:
        """Scene pixel (row, column) of frame pixel (0, 0) at rest."""
        return (self.scene.shape[0] - self.size[0]) // 2, (self.scene.shape[1] - self.size[1]) // 2

    @property
    def starts(self) -> Tensor:
        """(T, R) s, exposure start of every row of every frame."""
        return self.timing.row_starts(self.num_frames, self.size[0], self.scene.device)

    def mean_sensitivity(self, starts: Tensor) -> Tensor:
        """Derivatives (P, ..., 2) of the mean displacement over exposures from ``starts`` (...) on."""
        times, weights = (value.to(starts.device) for value in exposure_nodes(self.timing, "gauss", 8))
        values = self.sensitivity(starts[..., None] + times) @ weights
        along = torch.tensor(self.axes, device=starts.device)[:, None] == torch.arange(2, device=starts.device)
        return values[..., None] * along.reshape(-1, *(1,) * starts.ndim, 2)

    def others_showing(self) -> tuple[Tensor, Tensor]:
        """Position of the content of each frame row in each frame q.

        Returns:
            Rows (T, R, q) and displacement along them (T, R, q) px.
        """
        starts, count = self.starts, self.num_frames
        rows = torch.arange(self.size[0], dtype=torch.float64, device=starts.device)
        content = rows - self.motion.mean_displacement(starts, self.timing.exposure_time)[..., 1]
        begin = self.timing.frame_starts(count, starts.device)
        found = rows_showing(content[..., None].expand(-1, -1, count), begin, self.timing, self.motion)
        own = torch.eye(count, dtype=torch.bool, device=starts.device)[:, None]
        found = torch.where(own, rows[:, None], found)  # exactly, so that the first and last rows stay inside
        moments = begin + found * self.timing.row_time
        return found, self.motion.mean_displacement(moments, self.timing.exposure_time)[..., 0]


def scale_of_information(recording: Recording) -> Tensor:
    """Approximate information (P,) of each parameter for a known scene and unit noise."""
    slope = recording.scene.diff(dim=0).square().mean() + recording.scene.diff(dim=1).square().mean()
    return recording.sensitivity(recording.starts).square().sum((1, 2)) * slope * recording.size[1]


def projected_information(recording: Recording) -> Tensor:
    """Information of the parameters when the scene is unknown, for unit noise.

    ``J = D' (1 - A (A' A)^-1 A') D``: D are the derivatives of the frames, A takes a scene to its frames, and the
    part of D that a scene could explain contains no information. The displacement along a row is a phase ramp, so that
    A is a banded matrix for each frequency along the row and the projection needs no iterations.
    The scene is taken as periodic along rows, and without detail above 0.4 cycles per row; only pixels count whose
    content is visible in another frame.

    Returns:
        Matrix (P, P).
    """
    place = _Places.of(recording)
    length = fast_length(recording.scene.shape[1] + 2 * _MARGIN)
    coefficients = bspline_coefficients(_within_band(recording.scene), _DEGREE, -2)
    spectra = torch.fft.rfft(extend_rows(coefficients, length, hold=0.0))
    u = torch.fft.rfftfreq(length, dtype=torch.float64, device=spectra.device)
    step = max(1, _CHUNK // place.first.numel())
    residuals = []
    for begin in range(0, len(u), step):
        part = slice(begin, begin + step)
        residuals.append(_unexplained(place, spectra[:, part], u[part]))
    columns = slice(recording.origin[1], recording.origin[1] + recording.size[1])
    images = torch.fft.irfft(torch.cat(residuals, dim=-1), n=length)[..., columns]  # (P, T, R, W)
    images = (images * _shown_twice(recording)).flatten(1)
    information: Tensor = images @ images.T
    return information


def _within_band(scene: Tensor) -> Tensor:
    """The scene without its finest detail across rows."""
    length = fast_length(len(scene) + 2 * _MARGIN)
    spectra = torch.fft.rfft(extend_rows(scene.T, length, hold=0.0))
    v = torch.fft.rfftfreq(length, dtype=scene.dtype, device=scene.device)
    low, high = _BAND
    share = 0.5 + 0.5 * torch.cos(math.pi * ((v - low) / (high - low)).clamp(0.0, 1.0))
    smooth: Tensor = torch.fft.irfft(spectra * share, n=length)[:, : len(scene)].T
    return smooth


@dataclass(frozen=True, eq=False)
class _Places:
    """Observation operator: coefficients of the scene for each row at the N nodes of its exposure.

    Attributes:
        first: (T, R) first scene row.
        taps: (T, R, N, J) weights of the scene rows from the first on.
        slopes: (T, R, N, J) their derivatives by the place.
        along: (T, R, N) displacement along the row in px.
        weights: (N,) of the nodes.
        sensitivity: (P, T, R, N) derivatives of the displacement.
        axes: As in ``Recording``.
    """

    first: Tensor
    taps: Tensor
    slopes: Tensor
    along: Tensor
    weights: Tensor
    sensitivity: Tensor
    axes: tuple[int, ...]

    @classmethod
    def of(cls, recording: Recording) -> "_Places":
        starts = recording.starts
        displacement, weights = exposure_trajectory(recording.motion, starts, recording.timing, "gauss")
        times, _ = exposure_nodes(recording.timing, "gauss", len(weights))
        rows = torch.arange(recording.size[0], dtype=torch.float64, device=starts.device)
        place = recording.origin[0] + rows[:, None] - displacement[..., 1]
        cell = place.floor()
        taps = bspline_weights(place - cell, _DEGREE)
        lower = bspline_weights(place - cell, _DEGREE - 1)
        slopes = functional.pad(lower, (1, 0)) - functional.pad(lower, (0, 1))
        first, taps = spread_taps(cell, taps)
        _, slopes = spread_taps(cell, slopes)
        sensitivity = recording.sensitivity(starts[..., None] + times.to(starts.device))
        return cls(
            first - _DEGREE // 2,
            taps,
            slopes,
            displacement[..., 0],
            weights,
            sensitivity,
            recording.axes,
        )


def _unexplained(place: _Places, spectra: Tensor, u: Tensor) -> Tensor:
    """Derivatives of the spectra of all rows less the part that a scene explains, (P, T, R, U)."""
    angle = (-2 * math.pi) * place.along[..., None] * u
    ramps = torch.polar(torch.ones_like(angle), angle) * place.weights[:, None]  # (T, R, N, U)
    reach = place.taps.shape[-1]
    source = place.first[..., None] + torch.arange(reach, device=u.device)  # (T, R, J)
    seen = spectra[mirrored(source, len(spectra))]
    along = (place.taps.to(seen.dtype) @ seen) * ramps * (-2j * math.pi * u)
    across = (place.slopes.to(seen.dtype) @ seen) * -ramps
    derivatives = torch.stack(
        [
            (sensitivity[..., None] * (along, across)[axis]).sum(-2)
            for axis, sensitivity in zip(place.axes, place.sensitivity, strict=True)
        ]
    )
    kernels = place.taps.to(ramps.dtype).transpose(-2, -1) @ ramps  # (T, R, J, U)
    base = (place.first - place.first.amin()).flatten()
    count = int(base.amax()) + reach
    kernels = kernels.flatten(0, 1)
    rows = derivatives.flatten(1, 2).transpose(0, 1)  # (T R, P, U)
    band = kernels.new_zeros(count, reach, len(u))
    right = kernels.new_zeros(count, *rows.shape[1:])
    for i in range(reach):
        right.index_add_(0, base + i, kernels[:, i, None].conj() * rows)
        for d in range(reach - i):
            band[:, d].index_add_(0, base + i, kernels[:, i + d].conj() * kernels[:, i])
    band[:, 0] += _RIDGE * band[:, 0].real.amax()
    solution = solve_banded(band, right)
    explained = sum(
        (kernels[:, i, None] * solution[base + i] for i in range(reach)), start=torch.zeros((), dtype=rows.dtype)
    )
    residual: Tensor = (rows - explained).transpose(0, 1).unflatten(1, place.first.shape)
    return residual


def _shown_twice(recording: Recording) -> Tensor:
    """(T, R, W) float64, 1 for pixels whose content is visible in another frame."""
    rows, shift = recording.others_showing()
    own = shift.diagonal(dim1=0, dim2=2).T  # (T, R)
    columns = torch.arange(recording.size[1], dtype=torch.float64, device=rows.device)
    place = columns - own[..., None, None] + shift[..., None]  # (T, R, q, W)
    inside = (place >= 0) & (place <= recording.size[1] - 1)
    inside &= ((rows >= 0) & (rows <= recording.size[0] - 1))[..., None]
    return (inside.sum(2) >= 2).double()


def gradient_information(recording: Recording) -> Tensor:
    """The information in closed form, row by row, for unit noise.

    ``J = sum_s sum_p (d_p - d)' M(s) (d_p - d)``: M(s) sums the gradient products of scene row s, d_p are the
    derivatives of its displacement in frame p and d their mean. For two frames this is half of what the derivatives
    of the offset give. Blur within the exposure and the extent of interpolation kernels are neglected.
    """
    return _row_information(recording, None)


def random_information(recording: Recording, noise: float) -> Tensor:
    """The information for a random Gaussian scene with the power spectrum S of this one, for noise of power N.

    Gradients are weighted by ``T S / (T S + N)``, which is small for frequencies below the noise. Otherwise as
    ``gradient_information``, in the same units.
    """
    return _row_information(recording, noise)


def _row_information(recording: Recording, noise: float | None) -> Tensor:
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
    products = _gradient_products(recording.scene, window.double(), noise, count)  # (S, 2, 2)
    sensitivity = recording.mean_sensitivity(moments)  # (P, S, T, 2)
    mean = (seen[..., None] * sensitivity).sum(2, keepdim=True) / seen.sum(1).clamp(min=1e-300)[:, None, None]
    shared = seen * ((seen > 0).sum(1, keepdim=True) > 1)
    relative = sensitivity - mean
    information: Tensor = torch.einsum("psta,st,sab,qstb->pq", relative, shared, products, relative)
    return information


def _gradient_products(scene: Tensor, window: Tensor, noise: float | None, num_frames: int) -> Tensor:
    """Sums (S, 2, 2) of the gradient products of each scene row over the columns in the window."""
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
    products = torch.einsum("asx,sx,bsx->sab", gradients, window, weighted)
    symmetric: Tensor = 0.5 * (products + products.transpose(-2, -1))
    return symmetric
