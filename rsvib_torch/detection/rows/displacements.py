"""Displacements of scene rows, measured in images that are warped by a known motion.

Frames are compared in groups that contain the same part of the scene. The frames of a group are warped to the scene by
the motion, and their blur is equalised if their exposures differ in it. ``registration.gradients`` then gives the
residual displacement of every scene row in every frame and its information matrix, which are summed over
``BLOCK_ROWS`` rows. This is where images become measurements.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.detection.measurements import Measurements, trimmed_mean
from rsvib_torch.detection.rows.warping import (
    Positions,
    differently_blurred,
    exposure_paths,
    moments,
    reach_of_blur,
    warp_to_scene,
)
from rsvib_torch.execution.parallel import chunks, runs
from rsvib_torch.motion.motion import ColumnStrips, Motion
from rsvib_torch.motion.timing import RowTiming
from rsvib_torch.numerics.interpolation import extend_rows, fast_length
from rsvib_torch.numerics.tables import Array, table, tables, tensor
from rsvib_torch.registration.gradients import BLOCK, RowGradients, residual_products, row_equations, row_gradients
from rsvib_torch.registration.row_spectra import EVERY, RowSpectra, column_pattern, inner_columns, overlapping

BLOCK_ROWS = 8  # rows of one measurement; tones up to 1 / (16 T_row) are resolved
_MIN_OVERLAP = 0.5  # part of a frame that all frames of a group contain
MAX_GROUP_FRAMES = 8  # frames with one mean scene; more lower the noise of that scene by less than 1 / 16


@dataclass(frozen=True, eq=False)
class FrameGroups:
    """M groups of G consecutive frames; those of a group are compared, and its last frame is the first of the next.

    The groups of all stacks are measured as one batch (B M), group after group of each stack.
    """

    spectra: RowSpectra  # spectra of the F = M (G - 1) + 1 frames of B stacks
    starts: Tensor  # (B, F) s, exposure starts of their first rows
    count: int = 1  # number M of groups

    @property
    def size(self) -> int:
        """Number G of frames of a group."""
        return (self.starts.shape[1] - 1) // self.count + 1

    @property
    def starts_of_groups(self) -> Tensor:
        """(B M, G) s."""
        return overlapping(self.starts, self.count)

    def motion_of_groups(self, motion: Motion) -> Motion:
        """The motion (B) for each group (B M)."""
        return motion if self.count == 1 else motion.mapped(lambda values: values.repeat_interleave(self.count, 0))

    def stacks(self, index: Tensor) -> "FrameGroups":
        """The groups of some stacks; the frames are copied."""
        return replace(self, spectra=self.spectra.stacks(index), starts=self.starts[index])


# Groups of frames


def compared_intervals(timing: RowTiming, num_frames: int, max_group_frames: int = MAX_GROUP_FRAMES) -> Array:
    """Times (M,) in seconds between all frames that are compared with each other in groups of limited size."""
    starts = table(timing.frame_starts(num_frames))
    return np.concatenate([starts[step:] - starts[:-step] for step in range(1, min(num_frames, max_group_frames))])


def stack_spectra(frames: Tensor, valid: Tensor | None, strips: ColumnStrips | None = None) -> RowSpectra:
    """Spectra of grey frames (B, T, H, W) in row order, each frame with mean 0 and standard deviation 1.

    Pixels are missing where ``valid`` is False. Those of ``strips`` (B S) are computed instead of those of whole rows.
    """
    if valid is None:
        sample = frames[..., ::4, :].flatten(-2)  # a copy: two passes take a tenth of the time of torch.var_mean
        level = sample.mean(-1)[..., None, None]
        variance = (sample - level[..., 0]).square_().mean(-1)[..., None, None]
    else:
        weight = valid / valid.sum((-2, -1), keepdim=True)
        level = (frames * weight).sum((-2, -1), keepdim=True)
        variance = ((frames - level).square_() * weight).sum((-2, -1), keepdim=True)
    contrast = torch.where(variance > 0, variance.sqrt(), 1.0)  # detail may lie between the rows that are sampled
    if strips is not None:  # all strips of a frame with the level and contrast of the frame, because they are joined
        frames, valid = strips.cut(frames), None if valid is None else strips.cut(valid)
        level, contrast = (values.repeat_interleave(len(strips.firsts), 0) for values in (level, contrast))
    return RowSpectra(frames, valid, level, contrast)


def frame_groups(
    spectra: RowSpectra,
    timing: RowTiming,
    motion: Motion,
    *,
    pairs: Literal["never", "different", "very different"] = "never",
    one_at_a_time: bool = False,
) -> list[FrameGroups]:
    """Frames in groups of at most ``MAX_GROUP_FRAMES`` that have half of a frame in common in spite of an image motion.

    ``pairs``: whether to form pairs if exposures blur the frames differently, or very differently: only the blur of two
    frames can then be equalised. As many groups as fit in the cache are measured together, unless ``one_at_a_time``.
    """
    stacks, count = spectra.values.shape[:2]
    starts = timing.frame_starts(count, spectra.values.device).expand(stacks, -1)
    travelled = (motion.drift(starts[:, 1:]) - motion.drift(starts[:, :-1])).abs().amax((0, 1))
    fraction = float((travelled / travelled.new_tensor([spectra.width, spectra.height])).amax())
    max_frames = int(max(2, min(MAX_GROUP_FRAMES, 1 + (1 - _MIN_OVERLAP) // max(fraction, 1e-9))))
    if pairs != "never":
        different, very_different = differently_blurred(starts, spectra.height, timing, motion)
        max_frames = 2 if bool((different if pairs == "different" else very_different).any()) else max_frames
    num_groups = max(1, math.ceil((count - 1) / (max_frames - 1)))
    # Groups of equal size follow each other, so that they are measured together.
    steps_of_group, longer = divmod(count - 1, num_groups)
    parts, first_frame = [], 0
    for groups, size in ((longer, steps_of_group + 2), (num_groups - longer, steps_of_group + 1)):
        bytes_of_group = 4 * stacks * spectra.length * (4 + size) * 4 * BLOCK  # four rows of blocks, ``row_gradients``
        for batch in runs(groups, 1) if one_at_a_time else chunks(groups, bytes_of_group, starts.device):
            frames = slice(first_frame, first_frame + (batch.stop - batch.start) * (size - 1) + 1)
            parts.append(FrameGroups(spectra.part(frames), starts[:, frames], batch.stop - batch.start))
            first_frame = frames.stop - 1
    return parts


# Measurements


def measure_group(
    group: FrameGroups, timing: RowTiming, motion: Motion, gradients: RowGradients | None = None
) -> tuple["MeasuredGroup", RowGradients]:
    """Displacements of blocks of scene rows in the frames of groups, measured around a motion of each stack.

    The measurements do not depend on the motion to first order. The gradients (B M) of the scene are computed unless
    those of a motion that differs by much less than a pixel are given; they are returned for the next call.
    """
    spectra, motion = group.spectra.in_groups(group.count), group.motion_of_groups(motion)
    margin = reach_of_blur(spectra.height, timing, motion)
    positions = Positions.of(group.starts_of_groups, spectra.height, timing, motion, margin=margin)
    visible = positions.visible(spectra.height, BLOCK_ROWS)
    warp = warp_to_scene(spectra, positions, timing, motion)
    runs_of_rows = spectra.runs(positions.rows.shape[-1], 2)
    if gradients is None:
        valid, size = spectra.warped_valid(positions.rows, positions.shift), (spectra.width, spectra.length)
        gradients = row_gradients(warp, runs_of_rows, positions.shift, visible, size, valid)
        products = gradients.residual_products
    else:
        products = residual_products(warp, runs_of_rows, gradients, visible)
    return _measured_group(group, timing, motion, positions.exposure_starts, visible, gradients, products), gradients


def measure_strips(
    group: FrameGroups,
    timing: RowTiming,
    motion: Motion,
    strip_motion: Motion,
    strips: ColumnStrips,
    factors: Callable[[Tensor, Tensor], Tensor],
    gradients: RowGradients | None = None,
) -> tuple["MeasuredGroup", RowGradients]:
    """``measure_group`` for a motion (B) with roll or zoom, from frames (B S) that are cut into S strips of columns.

    Every strip is warped by the motion ``strip_motion`` (B S) of its middle. Strips are joined with weights that are
    linear between the middles, which displaces the columns between them by the interpolated amount, to first order.
    Rows of full width then measure all A components of the motion at once. ``factors`` are the displacements (..., 2,
    A) by unit components at positions x and y in px from the centre.
    """
    spectra, count = group.spectra, len(strips.firsts)
    margin = reach_of_blur(spectra.height, timing, strip_motion)
    positions = Positions.of(group.starts, spectra.height, timing, strip_motion, margin=margin)

    def by_strip(values: Tensor) -> Tensor:
        return values.unflatten(0, (-1, count))

    visible = by_strip(positions.visible(spectra.height, BLOCK_ROWS)).amin(1)
    warp = warp_to_scene(spectra, positions, timing, strip_motion)
    runs_of_rows = spectra.runs(positions.rows.shape[-1], 2)
    length = fast_length(strips.frame_width + 64)

    def joined(run: slice) -> Tensor:
        pixels = torch.fft.irfft(warp(run), n=spectra.length)[..., : spectra.width]
        return torch.fft.rfft(extend_rows(strips.joined(pixels), length, hold=0.0))

    if gradients is None:
        valid = spectra.warped_valid(positions.rows, positions.shift)
        x = torch.arange(length, device=visible.device) - 0.5 * (strips.frame_width - 1)
        x = x - by_strip(positions.columns)[:, 0]  # (B, 1, L)
        y = by_strip(positions.scene_rows)[:, 0, 0, :, None] - 0.5 * (spectra.height - 1)
        # a lens may displace invisible rows by any amount
        largest_shift = by_strip(positions.shift).abs().amax(1) * (visible > 0)
        gradients = row_gradients(
            joined,
            runs_of_rows,
            largest_shift,
            visible,
            (strips.frame_width, length),
            None if valid is None else strips.joined(valid.to(spectra.values.real.dtype)) > 0.999,
            factors=lambda part: factors(x, y[:, part]),
        )
        products = gradients.residual_products
    else:
        products = residual_products(joined, runs_of_rows, gradients, visible)
    starts = by_strip(positions.exposure_starts).mean(1)
    return _measured_group(group, timing, motion, starts, visible, gradients, products), gradients


@dataclass(frozen=True, eq=False)
class MeasuredGroup:
    """Displacements of N blocks of rows of groups of G frames, as ``Measurements`` on the device of the frames."""

    exposure_starts: Tensor  # (B, N, G) s
    displacements: Tensor  # (B, N, G, A) px, up to the displacement of the scene
    visible: Tensor  # (B, N, G), 1 where a frame contains the block, else 0
    information: Tensor  # (B, N, A, A) px^-2


def _measured_group(
    group: FrameGroups,
    timing: RowTiming,
    motion: Motion,
    exposure_starts: Tensor,
    visible: Tensor,
    gradients: RowGradients,
    products: Tensor,
) -> MeasuredGroup:
    """Measurements of blocks of rows (B M, G, S) around a motion (B M) from ``RowGradients.residual_products``."""
    residual, information = _block_solutions(*row_equations(products, gradients, visible))
    exposure_starts = _in_blocks(exposure_starts).mean(3)
    # a fit of frames with a wrong timing may place rows at any distance; they are invisible, but their times would make
    # the record, and with it the frequency grid, as long (18 GB)
    frame_starts = group.starts_of_groups[: len(exposure_starts), :, None]
    height_time = group.spectra.height * timing.row_time
    exposure_starts = exposure_starts.clamp(frame_starts - height_time, frame_starts + 2 * height_time)
    around = motion.mean_displacement(exposure_starts, timing.exposure_time)
    return MeasuredGroup(
        exposure_starts=_by_stack(exposure_starts.transpose(1, 2), group.count),
        displacements=_by_stack((around + residual).transpose(1, 2), group.count),
        visible=_by_stack(_in_blocks(visible)[..., 0].transpose(1, 2), group.count),
        information=_by_stack(information, group.count),
    )


def _by_stack(values: Tensor, groups: int) -> Tensor:
    """Values (B M, N, ...) of M groups of each stack as (B, M N, ...)."""
    return values.unflatten(0, (-1, groups)).flatten(1, 2)


def _block_solutions(information: Tensor, right_side: Tensor) -> tuple[Tensor, Tensor]:
    """Displacements (B, G, N, A) of blocks and their information (B, N, A, A); both 0 if rows do not determine them."""
    information = _in_blocks(information[:, None]).sum(3)[:, 0]
    right_side = _in_blocks(right_side).sum(3)
    xx, yy = information[..., 0, 0], information[..., 1, 1]
    determinant = xx * yy - information[..., 0, 1].square()
    measured = (determinant > 1e-4 * xx * yy) & (determinant > 0)
    if (axes := information.shape[-1]) > 2:
        size = information.diagonal(dim1=-2, dim2=-1)
        measured = measured & (size > 1e-12 * size.amax(-1, keepdim=True)).all(-1)
        unit = torch.where(measured[..., None], size, 1.0).rsqrt()
        normal = torch.where(measured[..., None, None], information * unit[..., None] * unit[..., None, :], 0.0)
        measured = measured & (torch.linalg.eigvalsh(normal)[..., 0] > 1e-6)  # detail in one place: no roll
    eye = torch.eye(axes, dtype=information.dtype, device=information.device)
    regular = torch.where(measured[..., None, None], information, eye)
    solution = torch.linalg.solve(regular[:, None], right_side[..., None])[..., 0]
    solution = torch.where(measured[:, None, :, None], solution, 0.0)
    return solution, torch.where(measured[..., None, None], information, 0.0)


def _in_blocks(values: Tensor) -> Tensor:
    """Rows on axis 2 as blocks of ``BLOCK_ROWS`` rows on axes 2 and 3; the remaining rows are left out."""
    count = values.shape[2] // BLOCK_ROWS
    return values[:, :, : count * BLOCK_ROWS].unflatten(2, (count, BLOCK_ROWS))


def joined_groups(parts: list[MeasuredGroup], exposure_time: float, groups: int = 1) -> Measurements:
    """Measurements of all groups as one record; smaller groups get frames in which no row is visible."""
    arrays = tables(*(value for part in parts for value in vars(part).values()))
    starts, displacements, visible, information = (arrays[number::4] for number in range(4))
    size = max(part.shape[2] for part in starts)

    def joined(values: list[Array], mode: Literal["constant", "edge"] = "constant") -> Array:
        padded = [
            np.pad(part, [(0, 0), (0, 0), (0, size - part.shape[2]), (0, 0)][: part.ndim], mode=mode) for part in values
        ]
        return np.concatenate(padded, 1)

    measurements = Measurements(
        joined(starts, "edge"),
        joined(displacements),
        joined(visible),
        np.concatenate(information, 1),
        exposure_time,
        groups=groups,
    )
    return replace(measurements, displacements=measurements.relative(measurements.displacements))


def column_pattern_of(groups: list[FrameGroups], timing: RowTiming, motion: Motion, row_variance: Array) -> Tensor:
    """``column_pattern`` of every fourth row of all groups, whose rows have residual variances (B, M, S)."""
    parts = []
    ends = np.cumsum([group.count for group in groups])[:-1]
    for group, group_variance in zip(groups, np.split(row_variance[..., ::EVERY], ends, 1), strict=True):
        height, group_motion = group.spectra.height, group.motion_of_groups(motion)
        positions = Positions.of(group.starts_of_groups, height, timing, group_motion, EVERY)
        visible = positions.visible(height, BLOCK_ROWS // EVERY)
        variance = tensor(group_variance).flatten(0, 1).to(visible.device)
        parts.append((group.spectra.in_groups(group.count), positions.rows, positions.shift, visible, variance))
    return column_pattern(parts)


SUMMED_ROWS = 64  # rows of a sum from which the displacements of parts of the rows are computed


def differential_motion(gradients: list[RowGradients], stacks: int, *, uniform: bool = True) -> Array:
    """(B, 2) px, rms difference of the displacements of the halves of the rows, by rotation or parallax; no noise.

    ``uniform``: whether to include the part that all rows have in common, which a slow roll also causes.
    """
    return _rms_of_contrasts(gradients, stacks, [[-1.0, 1.0]], uniform=uniform)


def uneven_motion(gradients: list[RowGradients], stacks: int) -> Array:
    """(B, 2) px, part of the displacements of quarters of the rows that roll and zoom cannot cause; without noise."""
    quadratic, cubic = [0.5, -0.5, -0.5, 0.5], [value / math.sqrt(20) for value in (-1.0, 3.0, -3.0, 1.0)]
    return _rms_of_contrasts(gradients, stacks, [quadratic, cubic])


def _rms_of_contrasts(
    gradients: list[RowGradients], stacks: int, part_weights: list[list[float]], *, uniform: bool = True
) -> Array:
    """(B, 2) px, root of the trimmed mean of the sum of squared contrasts between the parts of the rows; without noise.

    The gradients are those of all groups of B ``stacks``. A contrast is a sum of the parts with ``part_weights``. Noise
    also scatters the mean, and two standard deviations are subtracted: without that, of 48 axes of pairs of 192 rows
    with noise of 0.025, 11 seemed to roll.
    """
    estimates = []
    for group_gradients in gradients:
        residual, noise, regular = displacements_of_parts(group_gradients, len(part_weights[0]))
        contrast_weights = residual.new_tensor(part_weights)
        variance, contrast = contrast_weights.square() @ noise, contrast_weights @ residual
        if not uniform and contrast.shape[1] > 2:  # roll within the frame looks uniform in fewer sums of rows
            contrast = contrast - contrast.where(regular[..., None, None], torch.nan).nanmedian(1, keepdim=True).values
        excess = (contrast.square() - variance).sum(2)
        values = torch.cat([excess, 2 * variance.square().sum(2)], -1)  # and the variance of the excess
        values = torch.where(regular[..., None], values, torch.nan)
        estimates.append(_by_stack(values, len(values) // stacks))
    blocks = table(torch.cat(estimates, 1))
    mean_excess, mean_variance = np.split(trimmed_mean(blocks), 2, -1)
    count = np.maximum((~np.isnan(blocks[..., :2])).sum(1), 1)
    return np.sqrt(np.maximum(mean_excess - 2 * np.sqrt(mean_variance / count), 0.0))


def displacements_of_parts(gradients: RowGradients, parts: int = 4) -> tuple[Tensor, Tensor, Tensor]:
    """Displacements (B, N, parts, 2) in px of parts of the rows from first to last frame, from sums over 64 rows.

    The other results are the variance of their noise, and (B, N) whether all parts have structure along both axes.
    """
    sums, rows = gradients.quarters.unflatten(2, (parts, -1)).sum(3), SUMMED_ROWS
    count = sums.shape[1] // rows * rows
    weight = torch.where(gradients.variance > 0, 1 / gradients.variance.clamp(min=1e-300), 0.0)[:, :count, None, None]
    hxx, hxy, hyy, bx, by = (sums[:, :count] * weight).unflatten(1, (-1, rows)).sum(2).unbind(-1)
    determinant = hxx * hyy - hxy.square()
    regular = determinant > 1e-4 * hxx * hyy
    safe = torch.where(regular, determinant, 1.0)[..., None]
    residual = torch.stack([hyy * bx - hxy * by, hxx * by - hxy * bx], -1) / safe
    noise = 2 * torch.stack([hyy, hxx], -1) / safe  # of a difference of two frames
    return residual, noise, regular.all(-1)


# Contradictions of the exposure time

_SCATTER_ROWS = 32  # px, rows whose errors of interpolation count as one
# standard deviation of the ratio that residuals do not show: relative, by the second order (ratios of 1.05 to 1.22
# were right behind exposures with paths of 1 to 8 px), and that of the difference over the detail
_OF_RATIO, _OF_DETAIL = 0.1, 0.0007
_LOWEST, _HIGHEST = 1 / 64, 0.15  # cycles/px; shading lies below, and a blur of 2 px is expanded to 20 % above
# px^2, second moment of a path beyond which the second order is not an approximation: right stacks with exposures
# stated 0.5 to 2 times the true one have up to 2.5; with 29, a right ratio was measured as 0.16 +- 0.06
_LARGEST_MOMENT = 8.0


def blur_ratio(groups: list[FrameGroups], timing: RowTiming, motion: Motion) -> Tensor:
    """Difference of the blur of neighbouring frames, relative to that of the exposure time and the motion.

    An exposure blurs a row to second order by ``1 + M : grad grad / 2`` with the second moments M of the path. The
    difference of two warped frames is fitted by ``ratio (M_2 - M_1) : grad grad m / 2 + gain m``, m their mean. The
    offsets determine the motion, so that ``ratio = (T_e / stated T_e)^2`` for slow tones. Only coarse detail is
    compared, along and across rows: interpolation errors of fine detail increase the ratio. Three blocks of two rows
    are averaged with the weights 1/4, 1/2, 1/4.

    Returns:
        (B, 3): ratio, its standard deviation, and the size of the expected difference relative to m.
    """
    group_sums = (_products_of_blur(group, timing, group.motion_of_groups(motion)) for group in groups)
    parts, counts, moments_of_groups = zip(*group_sums, strict=True)
    # Least squares. The variance is that of the residuals, 8/3 of it because values share blocks, or by the scatter
    # of the scores of parts if that is larger: errors of interpolation are alike in neighbouring rows.
    products, count = torch.cat(parts, 1), torch.stack(counts).sum(0).clamp(min=1.0)  # (B, M, 3, 3) of M parts
    total = products.sum(1)
    normal, right_side, square = total[:, :2, :2], total[:, :2, 2], total[:, 2, 2]
    scale = normal.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).sqrt()
    outer = scale[:, :, None] * scale[:, None]
    inverse = torch.linalg.inv(normal / outer + 1e-9 * torch.eye(2, dtype=torch.float32, device="cpu").to(normal))
    inverse = inverse / outer
    solution = (inverse @ right_side[..., None])[..., 0]
    variance = 8 / 3 * inverse[:, 0, 0] * (square - (solution * right_side).sum(-1)).clamp(min=0.0) / count
    scores = products[:, :, :2, 2] - (products[:, :, :2, :2] @ solution[:, None, :, None])[..., 0]
    scatter = (scores @ inverse[:, 0, :, None]).square().sum((1, 2))
    ratio, size = solution[:, 0], scale[:, 0] / scale[:, 1]
    unknown = (_OF_RATIO * ratio).square() + (_OF_DETAIL / size.clamp(min=1e-12)).square()
    unknown = unknown.where(torch.stack(moments_of_groups).amax(0) < _LARGEST_MOMENT, math.inf)
    return torch.stack([ratio, (torch.maximum(variance, scatter) + unknown).sqrt(), size], -1)


def _products_of_blur(group: FrameGroups, timing: RowTiming, motion: Motion) -> tuple[Tensor, Tensor, Tensor]:
    """Sums (B, M, 3, 3) over M parts of the products of expected difference, mean and measured difference of frames.

    The motion is that of each group. The other results are the number of independent values, and the largest second
    moment in px^2, (B,) each.
    """
    block = 2
    # 1. Coarse detail of the warped frames, and the second moments of the paths.
    positions = Positions.of(group.starts_of_groups, group.spectra.height, timing, motion)
    u = group.spectra.frequencies
    low = slice(int((u <= _LOWEST).sum()), int((u < _HIGHEST).sum()))
    low_spectra = group.spectra.band(low).in_groups(group.count)

    def averaged(values: Tensor) -> Tensor:
        rows = values.shape[2] // block
        blocks: Tensor = values[:, :, : rows * block].unflatten(2, (rows, block)).mean(3)
        return 0.5 * blocks[:, :, 1:-1] + 0.25 * (blocks[:, :, :-2] + blocks[:, :, 2:])

    spectra = averaged(low_spectra.warped(positions.rows, positions.shift))
    second = averaged(moments(*exposure_paths(positions.exposure_starts, timing, motion), 2))
    visible = averaged(positions.visible(group.spectra.height, BLOCK_ROWS))
    in_both = (visible[:, 1:] * visible[:, :-1] == 1).double()
    mean, difference = 0.5 * (spectra[:, 1:] + spectra[:, :-1]), spectra[:, 1:] - spectra[:, :-1]
    weight = in_both.unfold(2, 5, 1).amin(-1)

    # 2. The expected difference. Derivatives across rows are of fourth order, from two neighbours on each side.
    rows = mean.shape[2] - 4
    above_2, above, centre, below, below_2 = (mean.narrow(2, row, rows) for row in range(5))
    by_x = (2j * math.pi * u[low]).to(mean.dtype)
    by_y = 8 / 12 * (below - above) - 1 / 12 * (below_2 - above_2)
    by_yy = 16 / 12 * (below + above) - 1 / 12 * (below_2 + above_2) - 30 / 12 * centre
    change = (0.5 * (second[:, 1:] - second[:, :-1]))[:, :, 2:-2, None].to(by_x.dtype)
    expected = (change[..., 0, 0] * by_x.square()) * centre
    expected += (2 * change[..., 0, 1] / block * by_x) * by_y
    expected += (change[..., 1, 1] / block**2) * by_yy

    # 3. Its products with the mean and with the measured difference, in the columns that all frames contain: beyond
    # them, frames continue without detail, which seemed to be a blur of up to 0.02 of the detail.
    images = torch.stack([expected, centre, difference[:, :, 2:-2]], -2)
    samples = 2 * low.stop
    place = torch.arange(samples, device=u.device) * group.spectra.length // samples
    inner = inner_columns(group.spectra.width, positions.shift, u)
    inner = functional.pad(inner, (0, group.spectra.length - group.spectra.width))[..., place]
    values = torch.fft.irfft(functional.pad(images, (low.start, 1)), n=samples, norm="ortho")
    values = values * inner[:, :, None, None].to(values.dtype)
    row_products = (values @ values.mT).double()  # (B M, G - 1, S, 3, 3)
    sums = row_products, weight, inner.mean(-1), second.abs().amax((2, 3, 4))
    row_products, weight, share, moment = (_by_stack(values, group.count) for values in sums)
    row_products *= weight[..., None, None]
    length = min(_SCATTER_ROWS // block, row_products.shape[2])
    part_products = row_products[:, :, : row_products.shape[2] // length * length].unflatten(2, (-1, length)).sum(3)
    return part_products.flatten(1, 2), 2 * images.shape[-1] * share.mean(1) * weight.sum((1, 2)), moment.amax(1)
