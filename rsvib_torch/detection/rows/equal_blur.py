"""Frames warped to the scene, those of a pair to the same blur where each is blurred in its own way."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.imaging.trajectory import exposure_trajectory, gauss_node_count, rows_showing
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import RowTiming
from rsvib_torch.registration.row_spectra import RowSpectra

__all__ = ["Shown", "blurred_unlike", "warp_to_same_blur"]

# kernels blur a scene alike whose paths differ by less in px, their second moments by less in px^2, and their third
# ones, which displace fine detail by 0.001 px, by less in px^3
_ALIKE = (0.5, 0.03, 0.0024)
_EVERY = 8  # rows of which one is looked at
_FEWER = 2 / 3  # nodes: 1e-3 of what is blurred twice is enough
_SLOPE = (2 / 3, -1 / 12)  # of neighbours one and two rows away, later less earlier: first derivative
_CURVATURE = (-5 / 2, 4 / 3, -1 / 12)  # of a row and its neighbours: second derivative
_NEIGHBOURS = 2

Warp = Callable[[slice], Tensor]  # some rows of the scene: frames warped to them, (B, G, s, U)


@dataclass(frozen=True, eq=False)
class Shown:
    """Where frames show places of the scene, (B, G, ...) each.

    Attributes:
        rows: Frame rows.
        shift: px, displacement along the rows to take out.
        moments: Exposure starts of those rows in seconds.
    """

    rows: Tensor
    shift: Tensor
    moments: Tensor

    @classmethod
    def of(cls, place: Tensor, left: Tensor, starts: Tensor, timing: RowTiming, motion: Motion) -> "Shown":
        """Scene rows ``place`` in frames that start at ``starts``, whose columns are moved by ``left`` px anyway."""
        rows = rows_showing(place, starts, timing, motion)
        moments = starts + rows * timing.row_time
        return cls(rows, motion.mean_displacement(moments, timing.exposure_time)[..., 0] - left, moments)


def _paths(moments: Tensor, timing: RowTiming, motion: Motion) -> tuple[Tensor, Tensor]:
    """Paths (B, G, S, N, 2) about their means during exposures from ``moments``, at nodes with weights (N,)."""
    count = math.ceil(_FEWER * gauss_node_count(motion, timing.exposure_time))
    path, weights = exposure_trajectory(motion, moments, timing, "gauss", count)
    weights = weights.to(path)
    return path - (path * weights[:, None]).sum(-2, keepdim=True), weights


def _moments(paths: Tensor, weights: Tensor) -> Tensor:
    """Second moments (B, G, S, 2, 2) of paths from ``_paths``."""
    return torch.einsum("bgsni,bgsnj,n->bgsij", paths, paths, weights)


def _unlike(moments: Tensor, timing: RowTiming, motion: Motion) -> Tensor:
    """(B,) whether frames whose rows are exposed from (B, G, S) s are blurred in ways of their own."""
    paths, weights = _paths(moments[..., ::_EVERY], timing, motion)
    third = torch.einsum("bgsn,bgsni->bgsi", paths.square().sum(-1) * weights, paths)
    looked_at = zip((paths, _moments(paths, weights), third), _ALIKE, strict=True)
    return torch.stack([(of.amax(1) - of.amin(1)).flatten(1).amax(1) > most for of, most in looked_at]).any(0)


def blurred_unlike(starts: Tensor, height: int, timing: RowTiming, motion: Motion) -> Tensor:
    """(B,) bool: whether frames of a height that start at (B, G) s are blurred in ways of their own."""
    rows = torch.arange(height, dtype=torch.float64, device=starts.device)
    return _unlike(starts[..., None] + rows * timing.row_time, timing, motion)


def warp_to_same_blur(
    spectra: RowSpectra, shown: Shown, place: Tensor, left: Tensor, timing: RowTiming, motion: Motion
) -> Warp:
    """What warps the frames of a group to some rows of the scene, those of a pair to the same blur.

    Where an exposure is long, each frame is blurred in its own way, and fine detail lies elsewhere than the mean
    displacements say. So each of two frames is blurred once more, as the other one is: both then show ``K_1 K_2 f`` of
    the scene f. That is the mean of frames warped along the other one's path, backwards.

    Kernels change from row to row, and such operators do not commute: what is taken from a distance y was blurred by
    other second moments M of the path, by ``y dM/ds`` to first order, which displaces detail by 0.01 px. So every
    node of the path is given what it is short of, ``y / 2 dM/ds`` times second derivatives of the image.

    Args:
        spectra: The frames of a group.
        shown: Where they show the scene rows.
        place: (B, 1, S) those scene rows.
        left: (B, 1, 1) px, displacement along the rows that is not taken out.
        timing: The sensor, in row order.
        motion: Of each stack (B).
    """

    def plain(part: slice) -> Tensor:
        return spectra.warped(shown.rows[..., part], shown.shift[..., part])

    if shown.rows.shape[1] != 2:
        return plain
    unlike = _unlike(shown.moments, timing, motion)
    if not bool(unlike.any()):
        return plain
    paths, weights = _paths(shown.moments, timing, motion)
    paths = paths * unlike[:, None, None, None, None]
    real = spectra.values.real.dtype
    change = 0.5 * torch.gradient(_moments(paths, weights), dim=2)[0].to(real)[..., None]
    x, y = paths.flip(1).unbind(-1)  # of the other frame
    starts = (shown.moments - shown.rows * timing.row_time)[..., None]
    nodes = Shown.of(place[..., None] - y, left[..., None] + x, starts, timing, motion)
    factors = torch.stack([weights.expand_as(y), weights * y], -1).to(real)
    along = (2j * math.pi * spectra.frequencies).to(spectra.values.dtype)
    count = place.shape[-1]

    def blurred(part: slice) -> Tensor:
        first, last, _ = part.indices(count)
        wide = slice(max(first - _NEIGHBOURS, 0), min(last + _NEIGHBOURS, count))
        inner = slice(first - wide.start, last - wide.start)
        shape = (*place.shape[:1], 2, wide.stop - wide.start, len(along))
        total, lever = (spectra.values.new_zeros(shape) for _ in range(2))
        for k in range(len(weights)):
            warped = torch.view_as_real(spectra.warped(nodes.rows[..., wide, k], nodes.shift[..., wide, k]))
            for image, factor in zip((total, lever), factors[:, :, wide, k, :, None, None].unbind(-3), strict=True):
                torch.view_as_real(image).addcmul_(warped, factor)
        slope, curvature = _derivatives(lever, inner)
        xx, xy, yy = (change[:, :, part, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
        result: Tensor = (
            total[:, :, inner] + (xx * along * lever[:, :, inner] + 2 * xy * slope) * along + yy * curvature
        )
        return result

    return blurred


def _derivatives(rows: Tensor, inner: slice) -> tuple[Tensor, Tensor]:
    """First and second derivatives across rows (B, G, S, U), of those in ``inner``; beyond the ends nothing changes."""
    place = torch.arange(inner.start, inner.stop, device=rows.device)

    def neighbour(step: int) -> Tensor:
        first, last = inner.start + step, inner.stop + step
        if first >= 0 and last <= rows.shape[2]:
            return rows[:, :, first:last]
        return rows.index_select(2, (place + step).clamp(0, rows.shape[2] - 1))

    slope, curvature = torch.zeros_like(neighbour(0)), _CURVATURE[0] * neighbour(0)
    for step in range(1, _NEIGHBOURS + 1):
        earlier, later = neighbour(-step), neighbour(step)
        slope += _SLOPE[step - 1] * (later - earlier)
        curvature += _CURVATURE[step] * (later + earlier)
    return slope, curvature
