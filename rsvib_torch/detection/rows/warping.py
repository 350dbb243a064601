"""Frames of a group warped to the rows of the scene by a motion, with equal blur.

Exposures blur the frames of a group differently, which displaces fine detail by more or less than the mean displacement
of the row. Blurs that differ little are equalised by derivatives of the images, others in pairs of frames by the path
of the other exposure.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.imaging.trajectory import exposure_trajectory, gauss_node_count, rows_showing
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import RowTiming
from rsvib_torch.numerics.interpolation import correlated
from rsvib_torch.numerics.tables import Array
from rsvib_torch.registration.row_spectra import MARGIN, RowSpectra


@dataclass(frozen=True, eq=False)
class Positions:
    """Rows of the frames of a group that contain the scene rows."""

    scene_rows: Tensor  # (B, 1, S) scene rows s
    columns: Tensor  # (B, 1, 1) px, displacement along the rows that all frames of the group keep
    rows: Tensor  # (B, G, S) frame rows that contain the scene rows
    shift: Tensor  # (B, G, S) px, displacement along the rows that the warp removes
    exposure_starts: Tensor  # (B, G, S) s, exposure starts of the frame rows
    beyond: Tensor  # (2, B, G, S + 2 M) rows and shift, also of M scene rows before the first and behind the last one

    @classmethod
    def of(
        cls, starts: Tensor, height: int, timing: RowTiming, motion: Motion, step: int = 1, margin: int = 0
    ) -> "Positions":
        """Positions of every ``step``-th scene row that the middle of a group of frames contains, M is the margin."""
        rows = torch.arange(-step * margin, height + step * margin, step, dtype=torch.float64, device=starts.device)
        # an image motion carries the group away from the first frame: rows and columns follow it by whole pixels
        middle = starts.mean(-1, keepdim=True) + 0.5 * height * timing.row_time
        travelled = motion.drift(middle).round()[:, :, None]  # (B, 1, 1, 2)
        scene_rows, columns = rows - travelled[..., 1], travelled[..., 0]
        frame_rows, displacement = rows_showing(scene_rows, starts[..., None], timing, motion)
        beyond = torch.stack([frame_rows, displacement[..., 0] - columns])
        inner = slice(margin, len(rows) - margin)
        rows, shift = beyond[..., inner].unbind()
        begin = torch.add(starts[..., None], rows, alpha=timing.row_time)
        return cls(scene_rows[..., inner], columns, rows, shift, begin, beyond)

    def visible(self, height: int, block: int) -> Tensor:
        """(B, G, S) float64, 1 for blocks of scene rows that lie inside a frame of ``height`` rows, else 0."""
        blocks = self.rows.shape[-1] // block
        inside = ((self.rows >= MARGIN) & (self.rows <= height - 1 - MARGIN)).double()
        inside_blocks = inside[..., : blocks * block].unflatten(-1, (blocks, block)).amin(-1)
        return functional.pad(inside_blocks.repeat_interleave(block, dim=-1), (0, self.rows.shape[-1] - blocks * block))


# Blur of exposures


def exposure_paths(exposure_starts: Tensor, timing: RowTiming, motion: Motion) -> tuple[Tensor, Tensor]:
    """Paths (B, G, S, N, 2) in px about their means during exposures from ``exposure_starts``, and weights (N,)."""
    # half of the nodes of the restoration: images are blurred twice, and amplitudes of seven recordings are the same to
    # 1e-5 px as with two thirds
    count = math.ceil(0.5 * gauss_node_count(motion, timing.exposure_time))
    path, weights = exposure_trajectory(motion, exposure_starts, timing, "gauss", count)
    weights = weights.to(path)
    return path - (path * weights[:, None]).sum(-2, keepdim=True), weights


def moments(paths: Tensor, weights: Tensor, order: int) -> Tensor:
    """Moments (B, G, S, 2, ...) of an order in px^order of ``exposure_paths``."""
    powers = weights[:, None] * paths
    for axes in range(1, order):  # products with the path along a further axis
        powers = powers[..., None] * paths[(..., *[None] * axes, slice(None))]
    return powers.sum(3)


# px, px^2 and px^3: differences of paths and of their second and third moments up to which blur counts as equal; the
# third moments displace fine detail by 0.001 px
_EQUAL = (0.5, 0.03, 0.0024)
# the same for blur that derivatives equalise: amplitudes of recordings without noise change by 5e-5 px and less against
# pairs (2e-4 px at 0.2 and 0.03); 16 frames of 512 x 512 px with two tones take 0.78 of the time
_NEARLY_EQUAL = (math.inf, 0.1, 0.008)


def differently_blurred(starts: Tensor, height: int, timing: RowTiming, motion: Motion) -> tuple[Tensor, Tensor]:
    """(B,) bool each: frames from ``starts`` (B, G) on are blurred differently; so much that only pairs equalise it."""
    rows = torch.arange(0, height, 8, dtype=torch.float64, device=starts.device)
    return _differences(*exposure_paths(starts[..., None] + rows * timing.row_time, timing, motion))


def _differences(paths: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """``differently_blurred`` of paths from ``exposure_paths``."""
    orders = [values.flatten(3) for values in (paths, moments(paths, weights, 2), moments(paths, weights, 3))]
    values = torch.cat(orders, -1)
    ranges = (values.amax(1) - values.amin(1)).amax(1)
    sizes = [order.shape[-1] for order in orders]
    limits = torch.from_numpy(np.repeat([_EQUAL, _NEARLY_EQUAL], sizes, -1)).to(ranges)
    different, very_different = (ranges[:, None] > limits).any(-1).unbind(-1)
    return different, very_different


# Warp


def reach_of_blur(height: int, timing: RowTiming, motion: Motion) -> int:
    """Margin of ``Positions`` beyond which no path of an exposure reaches."""
    # the path of a fit that diverges may have any length
    return 2 + math.ceil(min(height, float(motion.displacement_within(timing.exposure_time)[..., 1].max())))


def _between_rows(positions: Positions, away: Tensor) -> tuple[Tensor, Tensor]:
    """Frame rows and shifts (B, G, S, N) of scene rows that are ``away`` (B, G, S, N) px from every scene row.

    Cubic interpolation between whole scene rows has an error of 1e-5 px for 3 px and periods of 60 rows. An exact
    solution takes a tenth to a third of the time of a detection with long exposures.
    """
    count = positions.rows.shape[-1]
    margin = (positions.beyond.shape[-1] - count) // 2
    scene_place = torch.arange(margin, margin + count, dtype=away.dtype, device=away.device)
    place = away.clamp(2 - margin, margin - 2) + scene_place[:, None]
    cell = place.floor()
    # the cubic polynomials (columns) by powers (rows) that are 1 at one of the places -1, 0, 1, 2 and 0 at the others
    cubic = place.new_tensor([[0, 6, 0, 0], [-2, -3, 6, -1], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6
    powers = torch.arange(4, device=away.device)
    weights = (place - cell)[..., None] ** powers @ cubic  # (B, G, S, N, 4)
    index = (cell.long()[..., None] + (powers - 1)).flatten(2)
    neighbours = positions.beyond.gather(3, index.expand(2, -1, -1, -1)).view(2, *weights.shape)
    rows, shift = (neighbours * weights).sum(-1).unbind(0)
    return rows, shift


def warp_to_scene(
    spectra: RowSpectra, positions: Positions, timing: RowTiming, motion: Motion
) -> Callable[[slice], Tensor]:
    """Function that warps frames of groups (B, G) to a slice of the scene rows (B, G, s, U), with equal blur."""
    paths, weights = exposure_paths(positions.exposure_starts, timing, motion)
    different, very_different = _differences(paths[:, :, ::8], weights)
    if not bool(different.any()):
        return lambda part: spectra.warped(positions.rows[..., part], positions.shift[..., part])
    paths = paths * different[:, None, None, None, None]
    if positions.rows.shape[1] > 2 or not bool(very_different.any()):
        return _warp_with_mean_moments(spectra, positions, paths, weights)
    return _warp_along_paths(spectra, positions, paths, weights)


def _warp_with_mean_moments(
    spectra: RowSpectra, positions: Positions, paths: Tensor, weights: Tensor
) -> Callable[[slice], Tensor]:
    """``warp_to_scene`` by derivatives of the frames.

    A frame is ``f = (1 + M_2 : grad grad / 2 - M_3 : grad grad grad / 6) s`` of the scene s, to third order, with the
    moments M of its path. The difference of the moments from their means over the group is added.
    """
    by_x = (2j * math.pi * spectra.frequencies).to(spectra.values.dtype)
    group_second, group_third = moments(paths, weights, 2), moments(paths, weights, 3)
    second = (group_second.mean(1, keepdim=True) - group_second) / 2
    third = (group_third - group_third.mean(1, keepdim=True)) / 6
    # the derivatives of a frame contain those of its moments, which change from row to row: to third order along y
    change = second[..., 1, :, None, None] * torch.gradient(group_second, dim=2)[0][..., None, :, :]
    third = third - (change + change.transpose(-3, -2) + change.transpose(-3, -1)) / 3
    second, third = (values[..., None, None].to(by_x.real) for values in (second, third))

    def warped(part: slice) -> Tensor:
        index = _with_neighbours(part, positions, _REACH)
        images = spectra.warped(positions.rows[..., index], positions.shift[..., index])
        by_y, by_yy, by_yyy = _across_rows(torch.view_as_real(images), _FILTERS)
        images = images[:, :, _REACH:-_REACH]
        pixels = torch.view_as_real(images)
        xx, xy, yy = (second[:, :, part, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
        xxx, xxy, xyy, yyy = (third[:, :, part, i, j, k] for i, j, k in ((0, 0, 0), (0, 0, 1), (0, 1, 1), (1, 1, 1)))
        total = images * by_x  # Horner's scheme in the derivative along the rows
        total_values = torch.view_as_real(total)
        total_values.mul_(xxx).addcmul_(by_y, xxy, value=3).addcmul_(pixels, xx)
        total.mul_(by_x)
        total_values.addcmul_(by_y, xy, value=2).addcmul_(by_yy, xyy, value=3)
        total.mul_(by_x)
        total_values.addcmul_(by_yy, yy).addcmul_(by_yyy, yyy).add_(pixels)
        return total

    return warped


def _warp_along_paths(
    spectra: RowSpectra, positions: Positions, paths: Tensor, weights: Tensor
) -> Callable[[slice], Tensor]:
    """``warp_to_scene`` of pairs: each frame is blurred once more, along the path of the other.

    Both frames are then ``K_1 K_2 s`` of the scene s. Blurring along a path is the mean of copies that are warped along
    it. Kernels change from row to row, and such operators do not commute: a copy from a distance y was blurred by
    second moments M of the path that differ by ``y dM/ds`` to first order, which displaces detail by 0.01 px. Each node
    of the path is therefore corrected by ``y / 2 dM/ds`` times second derivatives of the image.
    """
    by_x = (2j * math.pi * spectra.frequencies).to(spectra.values.dtype)
    slope = torch.gradient(moments(paths, weights, 2), dim=2)[0][..., None, None].to(by_x.real) / 2
    x, y = paths.flip(1).unbind(-1)  # of the other frame
    node_rows, node_shift = _between_rows(positions, -y)
    node_rows, node_shift = node_rows.movedim(-1, 0), (node_shift - x).movedim(-1, 0)  # (N, B, G, S)
    factors = torch.stack([weights.expand_as(y), weights * y]).to(by_x.real).movedim(-1, 0)[..., None, None]

    def warped(part: slice) -> Tensor:
        index = _with_neighbours(part, positions, _SHORT_REACH)
        totals = by_x.new_zeros(2, *positions.rows.shape[:2], len(index), len(by_x))
        totals_values = torch.view_as_real(totals)
        copies = spectra.warped_copies(node_rows[..., index], node_shift[..., index])
        for copy, factor in zip(copies, factors[..., index, :, :], strict=True):
            totals_values.addcmul_(torch.view_as_real(copy), factor)
        mean, moment = totals  # of the copies, and of y times them
        by_y, by_yy = _across_rows(torch.view_as_real(moment), _SHORT_FILTERS)
        xx, xy, yy = (slope[:, :, part, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
        inner = slice(_SHORT_REACH, -_SHORT_REACH)
        total = moment[:, :, inner] * by_x
        total_values = torch.view_as_real(total)
        total_values.mul_(xx).addcmul_(by_y, xy, value=2)
        total.mul_(by_x).add_(mean[:, :, inner])
        total_values.addcmul_(by_yy, yy)
        return total

    return warped


def _with_neighbours(part: slice, positions: Positions, reach: int) -> Tensor:
    """Indices of scene rows, with the neighbours of the first and of the last within reach."""
    count = positions.rows.shape[-1]
    first, last, _ = part.indices(count)
    return torch.arange(first - reach, last + reach, device=positions.rows.device).clamp_(0, count - 1)


def _derivative_filters(reach: int) -> Array:
    """(3, 2 ``reach`` + 1) weights of rows that give the first three derivatives across rows.

    They are least-squares fits to ``(2 pi i v)^k`` up to 0.38 cycles per px, with relative errors of 3 % and less for
    detail of 3 to 10 px. Differences of fourth order have an error of a third at 4 px in the third derivative, which
    changed amplitudes by 0.0001 px.
    """
    place, angle = np.arange(-reach, reach + 1), 2 * math.pi * np.linspace(0.0, 0.38, 200)[:, None]
    filters = []
    for order in (1, 2, 3):
        weight = 1 / (0.3 + angle**order)
        system, target = weight * np.exp(1j * angle * place), (weight * (1j * angle) ** order)[:, 0]
        parts = np.concatenate([system.real, system.imag]), np.concatenate([target.real, target.imag])
        filters.append(np.linalg.lstsq(*parts)[0])
    return np.stack(filters)


_REACH, _SHORT_REACH = 5, 2  # rows to either side
_FILTERS = _derivative_filters(_REACH)
# differences of fourth order: enough for corrections, and each run of rows has fewer neighbours
_SHORT_FILTERS = np.array([[1.0, -8.0, 0.0, 8.0, -1.0], [-1.0, 16.0, -30.0, 16.0, -1.0]]) / 12


def _across_rows(images: Tensor, filters: Array) -> tuple[Tensor, ...]:
    """Derivatives (B, G, s, U, 2) across rows of images (B, G, s + R - 1, U, 2), by filters (K, R)."""
    derivatives = correlated(images.flatten(3), torch.from_numpy(filters).to(images), 2)
    return derivatives.unflatten(-1, images.shape[3:]).unbind(0)
