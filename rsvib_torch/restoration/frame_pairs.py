"""Pairs of frames of one scene: what both contain, the later frame predicted from the earlier one, and how they differ.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rsvib_torch.frames.pixels import cut_columns, detailed_parts
from rsvib_torch.imaging.blur import form_frames
from rsvib_torch.motion.motion import ColumnMotion
from rsvib_torch.numerics.interpolation import correlated, extended_length, spline_spectra
from rsvib_torch.numerics.tables import Array, table, tables
from rsvib_torch.restoration.frame_motion import FrameMotion, MovingFrames, frame_motion

_STRIP = 160  # px, width of the strip of columns that is judged with roll or zoom: enough for the means of a pair
_SMOOTHING = 5.0  # px, standard deviation of the Gaussian in ``misfit``; displacements of up to about 10 px stay linear
_RIM = math.ceil(3 * _SMOOTHING) + 1  # px; half width of the kernels of ``misfit``
_MARGIN = 4  # px between the compared pixels and those outside the frame


def judged_columns(moving: MovingFrames, restored: Tensor, count: int | None) -> tuple[MovingFrames, Tensor]:
    """Frames and restored frames in the columns by which the restoration is judged: ``count`` or more, None for all.

    These are the columns with the most detail, and as many beside them as move into them. With roll or zoom, they are a
    strip in the middle of one half of the frames.
    """
    motion, (height, width) = moving.motion, moving.images.shape[-2:]
    if motion.vibration.same_for_all_columns:
        motion.check_fits(width)
        widest = int(np.ptp(table(motion.shift)[..., 0], axis=1).max())
        beside = 2 * (motion.displacement_bound() + 4 * _MARGIN) + widest
        if count is None or count + beside >= width:
            return moving, restored
        chosen = detailed_parts(moving.images, count + beside)
    else:
        strip = min(_STRIP, width // 2)
        halves = [slice(place - strip // 2, place - strip // 2 + strip) for place in (width // 4, width - width // 4)]
        both = torch.cat([moving.images[:, :1, ..., half] for half in halves], -1)
        chosen = [halves[0 if detailed.start < strip // 2 else 1] for detailed in detailed_parts(both, strip)]
        middles = [half.start + 0.5 * (strip - width) for half in chosen]
        columns = torch.tensor(middles, dtype=torch.float64, device=both.device)
        starts = tuple(motion.frame_starts.tolist())
        of_strips = ColumnMotion(motion.vibration, columns, starts, motion.timing.row_time, height)
        motion = frame_motion(of_strips, motion.timing, motion.frame_starts, height)
    cut = replace(moving.mapped(lambda values: cut_columns(values, chosen)), motion=motion)
    return cut, cut_columns(restored, chosen)


@dataclass(frozen=True, eq=False)
class CommonParts:
    """What N pairs of frames have in common."""

    stack: NDArray[np.int64]  # (N,)
    frames: NDArray[np.int64]  # (N, 2) the earlier and the later one
    moves: NDArray[np.bool_]  # (N, 2) whether the axis (x, y) moves in this stack
    step: NDArray[np.int64]  # (N, 2) displacement (y, x) in whole px of the content from the earlier to the later frame
    size: NDArray[np.int64]  # (N, 2) rows and columns of the part
    rim: NDArray[np.int64]  # (N, 2) rows and columns at its ends that are not compared

    @property
    def firsts(self) -> NDArray[np.int64]:
        """(N, 2, 2) first row and column of the part in either frame."""
        return np.stack([(-self.step).clip(0), self.step.clip(0)], 1)

    @property
    def is_enough(self) -> NDArray[np.bool_]:
        """(N,) whether the compared part is larger than the filters."""
        enough: NDArray[np.bool_] = (self.size - 2 * self.rim).min(1) >= 2 * _RIM + 3
        return enough


def common_parts(motion: FrameMotion, pairs: NDArray[np.int64], shape: torch.Size) -> CommonParts:
    """Common parts of pairs (N, 3) of a stack, an earlier and a later frame of it, in frames of a shape."""
    stack, frames, extent = pairs[:, 0], pairs[:, 1:], np.array(shape)
    # rows are displaced by so much beyond the content of their frame, axes (y, x)
    reached = motion.mean_displacement.abs().amax(-2)
    shift, reach = (values[stack[:, None], frames][..., ::-1] for values in tables(motion.shift, reached))
    step = (shift[:, 1] - shift[:, 0]).astype(np.int64)
    # sizes change in steps, so that many pairs have the same
    unit = np.clip(extent // 32, _MARGIN, 4 * _MARGIN)
    rim = np.ceil((reach.max(1) + _MARGIN) / unit).astype(np.int64) * unit
    size = extent + -abs(step) // unit * unit
    return CommonParts(stack, frames, np.array(motion.bounds)[stack, :2] > 0, step, size, rim)


def reblur(
    scenes: Tensor,
    motion: FrameMotion,
    stack: NDArray[np.int64],
    frame: NDArray[np.int64],
    first_row: NDArray[np.int64],
) -> Tensor:
    """Form frames of stacks from restored scenes (N, ..., h, w) (Eq. 9), independently of the restoration method.

    Scenes are in row order, in the coordinates in which the frame (N,) of the stack (N,) is restored, and their row 0
    is ``first_row`` (N,) of that frame; they may be a part of the rows and columns, and are mirrored beyond.
    """
    # displacement of each row during its exposure
    degree, (height, width) = 5, scenes.shape[-2:]
    displacement, node_weights = motion.exposures
    rows = np.arange(height)
    members = displacement[stack[:, None], frame[:, None], first_row[:, None] + rows]
    along, across = (members - motion.shift[stack, frame][:, None, None]).unbind(-1)
    place = torch.from_numpy(rows).to(across.device)[:, None] - across
    # spectra of the spline coefficients (..., N, h, U), and frames
    length = extended_length(width, math.ceil(float(along.abs().amax())))
    spectra, along = spline_spectra(scenes.movedim(0, -3), degree, length), along.to(scenes.dtype)
    return form_frames(spectra, place, along, node_weights, degree, length, slice(0, width)).movedim(-3, 0)


def misfit(first: Tensor, second: Tensor) -> tuple[Array, Array]:
    """Root-mean-square displacement between two images (..., C, H, W) of one scene along each axis, and its resolution.

    A displacement d changes brightness by ``d . grad f``, so that the mean squared difference is ``a + dx^2 fx^2 + dy^2
    fy^2 + 2 dx dy fx fy``; white noise raises ``a`` only. Both images are smoothed, so that this holds for
    displacements up to about 10 px, and weighted least squares gives the means of dx^2 and dy^2. Images have at least
    35 px on a side. The results (..., 2) are in px, axes (x, y), float64; a misfit below the resolution cannot be
    distinguished from zero. They are 0 and infinity for images without contrast.
    """
    step = 4  # px between the places that are used, as neighbours are nearly equal
    # Gaussian and its derivative; gradients of the mean image, and the smoothed difference
    place = np.arange(-_RIM, _RIM + 1)
    gaussian = np.where(abs(place) < _RIM, np.exp(-0.5 * (place / _SMOOTHING) ** 2), 0.0)
    gaussian = gaussian / gaussian.sum()
    taps = np.stack([gaussian, 0.5 * (np.roll(gaussian, 1) - np.roll(gaussian, -1))])
    kernels = torch.as_tensor(taps, dtype=first.dtype, device=first.device)
    images = torch.stack([0.5 * (first + second), second - first])
    filtered = correlated(correlated(images, kernels, -1, step), kernels, -2, step)  # (across, along, image, ...)
    # along: Gaussian across and its derivative along the rows, of the mean image; across likewise; change: smoothed
    maps = filtered.flatten(0, 2)[[0b010, 0b100, 0b001]].flatten(-3).to(torch.float64)
    along, across, change = maps.unbind()
    # normal equations of weighted least squares for the four terms
    tiny = torch.finfo(torch.float64).tiny
    terms = [torch.ones_like(along), along.square(), across.square(), 2 * along * across]
    energy = terms[1] + terms[2]
    weight = (energy + energy.mean(-1, keepdim=True)).square().clamp(min=tiny).reciprocal()
    data = torch.stack([*terms, change.square()], -2)
    weighted = data[..., :4, :] * weight[..., None, :]
    largest = torch.maximum(first.abs().amax((-3, -2, -1)), second.abs().amax((-3, -2, -1)))
    data = torch.cat([data, weighted], -2)
    products, strongest, brightest = tables(
        torch.bmm(weighted.flatten(0, -3), data.flatten(0, -3).mT), energy.amax(-1), largest
    )
    normal, right, scatter = np.split(products.reshape(*strongest.shape, *products.shape[1:]), (4, 5), -1)
    # small tables on the CPU; those of images without contrast may overflow
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        scale = np.maximum(np.diagonal(normal, axis1=-2, axis2=-1), tiny) ** -0.5
        scale = scale[..., None, :] * scale[..., None]
        inverse = np.linalg.pinv(normal * scale, hermitian=True) * scale
        solution = (inverse @ right)[..., 0]
        # the variance of a squared Gaussian is twice the square of its mean; values within the smoothing are correlated
        correlated_values = 4 * math.pi * (_SMOOTHING / step) ** 2
        scatter = scatter * (correlated_values * 2.0 * solution[..., :1, None] ** 2)
        variance = np.diagonal(inverse @ scatter @ inverse, axis1=-2, axis2=-1)[..., 1:3].clip(0.0)
    size, resolution = solution[..., 1:3].clip(0.0) ** 0.5, (2.0 * variance**0.5) ** 0.5
    # rounding is no contrast
    has_contrast = (np.sqrt(strongest) > 1e-5 * brightest)[..., None]
    return np.where(has_contrast, size, 0.0), np.where(has_contrast, resolution, math.inf)
