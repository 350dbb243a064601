"""Detection at the limit: measure around the model, fit, repeat."""

import itertools
import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.detection.fit import fit_tones
from rsvib_torch.detection.inversion import vibration_of_fit
from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.result import OtherMotion
from rsvib_torch.detection.selection import find_tones, residual_of, robust_fit, significant_only, strongest_only
from rsvib_torch.detection.tones import ToneFit
from rsvib_torch.imaging.coupling import rows_showing
from rsvib_torch.registration.gradients import RowGradients, row_gradients, row_shifts
from rsvib_torch.registration.pattern import column_pattern
from rsvib_torch.registration.row_spectra import MARGIN, RowSpectra
from rsvib_torch.sensor import SensorTiming
from rsvib_torch.vibration import Vibration, blind_frequencies

__all__ = ["LARGEST_GROUP", "DirectFit", "refine_directly"]

_BLOCK = 8  # rows that give one measurement: tones up to 1 / (16 T_row) are told apart
_LAGS = 4  # blocks over which residuals may be correlated
LARGEST_GROUP = 8  # of a group that shares one mean scene
_LEAST_OVERLAP = 0.5  # of the frame that the frames of a group share
_MAJORITY = 0.7  # of the rows: clouds and things that move by themselves may cover the others
_SLANT_ROWS = 64  # rows whose halves are compared
_CLEANINGS = 2  # rounds of taking out what is fixed to the sensor
_NEAR = 0.05  # px: gradients of frames that were warped this well need not be taken again
_CONDITION = 1e-4  # least share of the product of the diagonal that a block's determinant must keep
_LEAST_GAIN = 0.02  # of the residual that a further tone must explain: the rows' noise is nearly white


@dataclass(frozen=True, eq=False)
class DirectFit:
    """What the direct method found.

    Attributes:
        measurements: Displacements of blocks of scene rows, measured around the fit.
        fit: The fit to them.
        other_motion: What the rows tell beside it.
    """

    measurements: Measurements
    fit: ToneFit
    other_motion: OtherMotion


@dataclass(frozen=True, eq=False)
class _Group:
    """Consecutive frames that share a scene: their spectra and when they were taken."""

    spectra: RowSpectra
    starts: Tensor  # (B, G) s


def groups_of(num_frames: int, most: int) -> list[range]:
    """Consecutive groups of at most ``most`` frames, each sharing one frame with the next, as even as can be."""
    count = max(1, math.ceil((num_frames - 1) / (most - 1)))
    ends = [round(i * (num_frames - 1) / count) for i in range(count + 1)]
    return [range(first, last + 1) for first, last in itertools.pairwise(ends)]


def _frames_in_group(motion: Vibration, starts: Tensor, size: tuple[int, int]) -> int:
    """How many frames of (H, W) px still share enough of the scene when the image moves."""
    moved = (motion.drift(starts[:, 1:]) - motion.drift(starts[:, :-1])).abs().amax((0, 1))
    extent = torch.tensor([size[1], size[0]], dtype=moved.dtype, device=moved.device)
    fraction = float((moved / extent).amax())
    return int(max(2, min(LARGEST_GROUP, 1 + (1 - _LEAST_OVERLAP) // max(fraction, 1e-9))))


def _warp(group: _Group, timing: SensorTiming, motion: Vibration) -> tuple[RowSpectra, Tensor, Tensor, Tensor]:
    """A group with what warps its frames back by a motion."""
    rows, shift, seen, _ = _place(group, timing, motion)
    return group.spectra, rows, shift, seen


def _place(group: _Group, timing: SensorTiming, motion: Vibration) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Where the frames of a group show the scene rows.

    Returns:
        Frame rows, displacement along the rows to take out and visibility, and exposure starts of
        those rows, (B, G, S) each.
    """
    height = group.spectra.height
    scene_rows = torch.arange(height, dtype=torch.float64, device=group.starts.device)
    starts = group.starts[..., None]
    # whole pixels of an image motion move the scene rows and columns that this group sees
    middle = group.starts.mean(-1, keepdim=True) + 0.5 * height * timing.row_time
    travelled = motion.drift(middle).round()[:, :, None]  # (B, 1, 1, 2)
    rows = rows_showing(scene_rows - travelled[..., 1], starts, timing, motion)
    moments = starts + rows * timing.row_time
    blocks = height // _BLOCK
    inside = ((rows >= MARGIN) & (rows <= height - 1 - MARGIN)).double()
    whole = inside[..., : blocks * _BLOCK].unflatten(-1, (blocks, _BLOCK)).amin(-1)
    seen = functional.pad(whole.repeat_interleave(_BLOCK, dim=-1), (0, height - blocks * _BLOCK))
    shift = motion.mean_displacement(moments, timing.exposure_time)[..., 0] - travelled[..., 0]
    return rows, shift, seen, moments


def _blocks(values: Tensor) -> Tensor:
    """Rows on axis 2 gathered in blocks on axes 2 and 3."""
    count = values.shape[2] // _BLOCK
    blocks: Tensor = values[:, :, : count * _BLOCK].unflatten(2, (count, _BLOCK))
    return blocks


def measure_group(
    group: _Group, timing: SensorTiming, motion: Vibration, gradients: RowGradients | None
) -> tuple[Measurements, RowGradients]:
    """Displacements of blocks of scene rows in the frames of a group, measured around a motion.

    The motion's own displacement is added to what remains, so that the measurements do not depend on it to first order.
    """
    rows, shift, seen, moments = _place(group, timing, motion)
    warped = group.spectra.warped(rows, shift)
    gradients = gradients or row_gradients(group.spectra, warped, rows, shift, seen)
    matrix, right = row_shifts(warped, gradients, seen)
    matrix = _blocks(matrix[:, None]).sum(3)[:, 0]  # (B, N, 2, 2)
    right = _blocks(right).sum(3)  # (B, G, N, 2)
    determinant = matrix[..., 0, 0] * matrix[..., 1, 1] - matrix[..., 0, 1].square()
    known = (determinant > _CONDITION * matrix[..., 0, 0] * matrix[..., 1, 1]) & (determinant > 0)
    eye = torch.eye(2, dtype=matrix.dtype, device=matrix.device)
    remaining = torch.linalg.solve(torch.where(known[..., None, None], matrix, eye)[:, None], right[..., None])[..., 0]
    remaining = torch.where(known[:, None, :, None], remaining, 0.0)
    block_moments = _blocks(moments).mean(3)
    around = motion.mean_displacement(block_moments, timing.exposure_time)
    measurements = Measurements(
        moments=block_moments.transpose(1, 2),
        displacements=(around + remaining).transpose(1, 2),
        seen=_blocks(seen)[..., 0].transpose(1, 2),
        information=torch.where(known[..., None, None], matrix, 0.0),
        exposure_time=timing.exposure_time,
    )
    return replace(measurements, displacements=measurements.relative(measurements.displacements)), gradients


def _join(parts: list[Measurements]) -> Measurements:
    """Measurements of all groups as one record; smaller groups get frames that see nothing."""
    most = max(part.moments.shape[-1] for part in parts)

    def padded(values: Tensor) -> Tensor:
        missing = most - values.shape[2]
        return (
            torch.cat([values, values[:, :, :1].expand(-1, -1, missing, *values.shape[3:])], 2) if missing else values
        )

    return replace(
        parts[0],
        moments=torch.cat([padded(part.moments) for part in parts], 1),
        displacements=torch.cat([padded(part.displacements) for part in parts], 1),
        seen=torch.cat([functional.pad(part.seen, (0, most - part.seen.shape[-1])) for part in parts], 1),
        information=torch.cat([part.information for part in parts], 1),
    )


def independent_fraction(measurements: Measurements, residual: Tensor) -> float:
    """Fraction of the blocks that are independent, from the correlation of neighbouring residuals.

    Where the model misses something, residuals of neighbours are alike; the variance of a mean is larger by
    ``1 + 2 sum rho(k)``.
    """
    scaled = residual * measurements.weights.sqrt()[:, :, None]
    energy = scaled.square().sum()
    total = sum((scaled[:, lag:] * scaled[:, :-lag]).sum() / energy for lag in range(1, _LAGS + 1))
    return 1.0 / max(1.0, 1.0 + 2.0 * float(total))


def _displacements(measurements: Measurements, motion: Vibration) -> Tensor:
    return motion.mean_displacement(measurements.moments, measurements.exposure_time)


def _settled(before: ToneFit, after: ToneFit) -> bool:
    """Whether a round changed coefficients and frequencies by less than half their standard deviations."""
    deviation = after.covariance.diagonal(dim1=-2, dim2=-1).unflatten(-1, (2, -1)).clamp(min=0.0).sqrt()
    parts = deviation[..., : 3 * after.frequencies.shape[-1]].unflatten(-1, (-1, 3))
    turn = 2 * math.pi * before.frequencies * (after.centre - before.centre)[:, None, None]
    change = (before.coefficients * torch.polar(torch.ones_like(turn), turn) - after.coefficients).abs()
    small = (change <= 0.5 * parts[..., :2].amax(-1)) & (
        (before.frequencies - after.frequencies).abs() <= 0.5 * parts[..., 2]
    )
    return bool((small | ~after.active).all())


def refine_directly(
    frames: Tensor,
    valid: Tensor | None,
    timing: SensorTiming,
    start: ToneFit,
    tones: int | None,
    iterations: int = 10,
) -> DirectFit:
    """Refine a detected motion on the images themselves.

    The frames of a group are warped to the scene with the motion, every row tells what it still misses in each frame
    and how well it knows it, and the motion is fitted again to those rows; image work and motion model meet only here.

    Args:
        frames: (B, T, H, W) grey, in row order.
        valid: (B, T, H, W) bool, pixels that count; None for all.
        timing: The sensor, in row order.
        start: The motion to start with, from the band offsets.
        tones: Number of tones of each axis; None to choose it from the rows.
        iterations: Rounds of measuring and fitting at most.

    Returns:
        The last measurements and the fit to them.
    """
    size = (frames.shape[-2], frames.shape[-1])
    starts = timing.frame_starts(frames.shape[1], frames.device).expand(len(frames), -1)
    frames = _standardised(frames, valid)
    fit, model = start, start.model
    motion, _ = vibration_of_fit(fit)
    members = groups_of(frames.shape[1], _frames_in_group(motion, starts, size))
    groups = [
        _Group(
            RowSpectra(frames[:, m.start : m.stop], None if valid is None else valid[:, m.start : m.stop]),
            starts[:, m.start : m.stop],
        )
        for m in members
    ]
    gradients: list[RowGradients | None] = [None] * len(groups)
    cleanings = _CLEANINGS
    search_at = 1  # the first round removes the error of the bands: then weak tones show
    interval = max(_BLOCK * timing.row_time, 0.5 * timing.exposure_time)  # the exposure averages out what is faster
    blind = blind_frequencies(timing, 0.5 / interval).to(frames.device)
    for step in range(iterations):
        measured = [measure_group(group, timing, motion, known) for group, known in zip(groups, gradients, strict=True)]
        gradients = [known for _, known in measured]
        measurements = _join([part for part, _ in measured])
        before, around = fit, motion
        if step == search_at:
            left = residual_of(measurements, fit)
            careful = replace(measurements, independent=independent_fraction(measurements, left))
            fit = find_tones(careful, interval, tones, model, _LEAST_GAIN, strongest_only(fit), blind)
        else:
            fit, _ = robust_fit(measurements, fit.frequencies, fit.active, model, residual_of(measurements, fit))
        motion, _ = vibration_of_fit(fit)
        if step == iterations - 1:
            break
        if step > search_at and _settled(before, fit):
            pattern = None
            if cleanings:
                leaves = [known.variance for known in gradients if known is not None]
                warps = [_warp(group, timing, motion) for group in groups]
                pattern = column_pattern([(*warp, left) for warp, left in zip(warps, leaves, strict=True)])
            if pattern is None:
                break
            cleanings, search_at = cleanings - 1, step + 1
            for group in groups:
                group.spectra.subtract(pattern)
            gradients = [None] * len(groups)
            continue
        change = measurements.relative(_displacements(measurements, motion) - _displacements(measurements, around))
        if float(change.abs().amax()) > _NEAR:
            gradients = [None] * len(groups)
    residual = residual_of(measurements, fit)
    weighed = measurements.reweighted(residual)
    share = independent_fraction(weighed, residual) * measurements.share_counted(residual)
    honest = replace(weighed, independent=share)
    fit = fit_tones(honest, fit.frequencies, fit.active, model)
    if tones is None:
        fit = significant_only(honest, fit)
    apart = OtherMotion(_unexplained(measurements, residual), _slant([g for g in gradients if g is not None]))
    return DirectFit(honest, fit, apart)


def _standardised(frames: Tensor, valid: Tensor | None) -> Tensor:
    """Frames of mean 0 and variance 1: brightness and contrast may differ from frame to frame."""
    if valid is None:
        centred = frames - frames.mean((-2, -1), keepdim=True)
        size = torch.linalg.vector_norm(centred, dim=(-2, -1), keepdim=True)
        return centred.mul_(math.sqrt(frames[0, 0].numel()) / size)
    weight = valid.to(frames.dtype)
    count = weight.sum((-2, -1), keepdim=True)
    centred = frames - (frames * weight).sum((-2, -1), keepdim=True) / count
    variance = (centred.square() * weight).sum((-2, -1), keepdim=True) / count
    return centred * variance.rsqrt()


def _unexplained(measured: Measurements, residual: Tensor) -> Tensor:
    """(B, 2) px, rms of residuals beyond their noise."""
    counts = (measured.weights > 0) & (measured.differences[..., None] > 0)
    spare = measured.differences[..., None].clamp(min=1.0)
    excess = residual.square().sum(2) / spare - 1 / measured.weights.clamp(min=1e-300)
    return trimmed_mean(torch.where(counts, excess, torch.nan)).clamp(min=0.0).sqrt()


def _slant(gradients: list[RowGradients]) -> Tensor:
    """(B, 2) px, rms difference between what the halves of the rows miss, beyond its noise."""
    excesses = []
    for known in gradients:
        rows = known.halves.shape[1] // _SLANT_ROWS * _SLANT_ROWS
        weight = torch.where(known.variance > 0, 1 / known.variance.clamp(min=1e-300), 0.0)[:, :rows, None, None]
        hxx, hxy, hyy, bx, by = (known.halves[:, :rows] * weight).unflatten(1, (-1, _SLANT_ROWS)).sum(2).unbind(-1)
        determinant = hxx * hyy - hxy.square()
        usable = determinant > _CONDITION * hxx * hyy
        safe = torch.where(usable, determinant, 1.0)
        missed = -torch.stack([hyy * bx - hxy * by, hxx * by - hxy * bx], -1) / safe[..., None]  # (B, N, halves, 2)
        noise = 2 * torch.stack([hyy, hxx], -1) / safe[..., None]  # of a difference of two frames
        both = usable.all(-1)[..., None]
        excess = (missed[:, :, 1] - missed[:, :, 0]).square() - noise.sum(2)
        excesses.append(torch.where(both, excess, torch.nan))
    return trimmed_mean(torch.cat(excesses, 1)).clamp(min=0.0).sqrt()


def trimmed_mean(values: Tensor) -> Tensor:
    """Mean (B, A) of the smaller ones of values (B, N, A), NaN left out: a few rows are not held against all."""
    ordered = values.sort(dim=1).values  # NaN come last
    count = ((~torch.isnan(values)).sum(1, keepdim=True) * _MAJORITY).ceil()
    place = torch.arange(values.shape[1], device=values.device)[None, :, None]
    counted = place < count
    return torch.where(counted, ordered, 0.0).sum(1) / count[:, 0].clamp(min=1)
