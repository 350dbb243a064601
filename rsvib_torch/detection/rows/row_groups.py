"""Frames in groups that share a scene, and what their rows tell of a motion: where images become measurements."""

import itertools
import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.rows.equal_blur import Shown, blurred_unlike, warp_to_same_blur
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import RowTiming
from rsvib_torch.registration.gradients import RowGradients, residual_products, row_equations, row_gradients
from rsvib_torch.registration.row_spectra import MARGIN, RowSpectra, chunks

__all__ = [
    "BLOCK",
    "LARGEST_GROUP",
    "FrameGroup",
    "frame_groups",
    "intervals_compared",
    "join_groups",
    "measure_group",
    "measure_groups",
    "stack_spectra",
    "warping",
]

BLOCK = 8  # rows that give one measurement: tones up to 1 / (16 T_row) are told apart
LARGEST_GROUP = 8  # of a group that shares one mean scene
_LEAST_OVERLAP = 0.5  # of the frame that the frames of a group share
_EVERY = 4  # rows of which one tells how bright a frame is
_CONDITION = 1e-4  # least share of the product of the diagonal that a block's determinant must keep


@dataclass(frozen=True, eq=False)
class FrameGroup:
    """Consecutive frames that share a scene: their spectra and when they were taken."""

    spectra: RowSpectra
    starts: Tensor  # (B, G) s


def _members(num_frames: int, most: int) -> list[range]:
    """Consecutive groups of at most ``most`` frames, each sharing one frame with the next, as even as can be."""
    count = max(1, math.ceil((num_frames - 1) / (most - 1)))
    ends = [round(i * (num_frames - 1) / count) for i in range(count + 1)]
    return [range(first, last + 1) for first, last in itertools.pairwise(ends)]


def _frames_in_group(motion: Motion, starts: Tensor, size: tuple[int, int]) -> int:
    """How many frames of (H, W) px still share enough of the scene when the image moves."""
    moved = (motion.drift(starts[:, 1:]) - motion.drift(starts[:, :-1])).abs().amax((0, 1))
    extent = torch.tensor([size[1], size[0]], dtype=moved.dtype, device=moved.device)
    fraction = float((moved / extent).amax())
    return int(max(2, min(LARGEST_GROUP, 1 + (1 - _LEAST_OVERLAP) // max(fraction, 1e-9))))


def intervals_compared(timing: RowTiming, num_frames: int, largest_group: int, device: torch.device) -> Tensor:
    """Times (M,) in seconds between frames that are compared with each other, in groups of so many at most."""
    starts = timing.frame_starts(num_frames, device)
    return torch.cat([starts[step:] - starts[:-step] for step in range(1, min(num_frames, largest_group))])


def stack_spectra(frames: Tensor, valid: Tensor | None) -> RowSpectra:
    """Spectra of grey frames (B, T, H, W) in row order, all of one brightness and contrast.

    Args:
        frames: The frames.
        valid: (B, T, H, W) bool, pixels that count; None for all.
    """
    return RowSpectra(frames, valid, *_level_and_contrast(frames, valid))


def frame_groups(spectra: RowSpectra, timing: RowTiming, motion: Motion, *, alike: bool = False) -> list[FrameGroup]:
    """Frames in groups that share enough of the scene when it moves by ``motion``.

    Args:
        spectra: Of all frames, from ``stack_spectra``.
        timing: The sensor, in row order.
        motion: Of each stack (B).
        alike: Go in pairs where exposures blur each frame in its own way: only two can be blurred alike. Pairs tell
            of a tone; a free motion needs all frames that see a place.
    """
    stacks, count = spectra.values.shape[:2]
    starts = timing.frame_starts(count, spectra.values.device).expand(stacks, -1)
    most = _frames_in_group(motion, starts, (spectra.height, spectra.width))
    if alike:
        most = 2 if bool(blurred_unlike(starts, spectra.height, timing, motion).any()) else most
    parts = [slice(member.start, member.stop) for member in _members(count, most)]
    return [FrameGroup(spectra.part(part), starts[:, part]) for part in parts]


def warping(
    group: FrameGroup, timing: RowTiming, motion: Motion, every: int
) -> tuple[RowSpectra, Tensor, Tensor, Tensor]:
    """A group with what warps every so many rows (a part of a block) of its frames back by a motion."""
    place, left = _place(group, timing, motion)
    shown = Shown.of(place[..., ::every], left, group.starts[..., None], timing, motion)
    return group.spectra, shown.rows, shown.shift, _seen(shown.rows, group.spectra.height, BLOCK // every)


def _place(group: FrameGroup, timing: RowTiming, motion: Motion) -> tuple[Tensor, Tensor]:
    """Scene rows (B, 1, S) that a group sees, and px (B, 1, 1) that the columns it sees have moved by."""
    scene_rows = torch.arange(group.spectra.height, dtype=torch.float64, device=group.starts.device)
    # whole pixels of an image motion move both
    middle = group.starts.mean(-1, keepdim=True) + 0.5 * group.spectra.height * timing.row_time
    travelled = motion.drift(middle).round()[:, :, None]  # (B, 1, 1, 2)
    return scene_rows - travelled[..., 1], travelled[..., 0]


def _seen(rows: Tensor, height: int, block: int = BLOCK) -> Tensor:
    """(B, G, S) float64, 1 for blocks of scene rows that lie well inside the frames that show them at ``rows``."""
    blocks = rows.shape[-1] // block
    inside = ((rows >= MARGIN) & (rows <= height - 1 - MARGIN)).double()
    whole = inside[..., : blocks * block].unflatten(-1, (blocks, block)).amin(-1)
    return functional.pad(whole.repeat_interleave(block, dim=-1), (0, rows.shape[-1] - blocks * block))


def _blocks(values: Tensor) -> Tensor:
    """Rows on axis 2 gathered in blocks on axes 2 and 3."""
    count = values.shape[2] // BLOCK
    blocks: Tensor = values[:, :, : count * BLOCK].unflatten(2, (count, BLOCK))
    return blocks


def measure_group(
    group: FrameGroup, timing: RowTiming, motion: Motion, gradients: RowGradients | None
) -> tuple[Measurements, RowGradients]:
    """Displacements of blocks of scene rows in the frames of a group, measured around a motion.

    The motion's own displacement is added to what remains, so that the measurements do not depend on it to first order.
    """
    place, left = _place(group, timing, motion)
    shown = Shown.of(place, left, group.starts[..., None], timing, motion)
    seen = _seen(shown.rows, group.spectra.height)
    warp = warp_to_same_blur(group.spectra, shown, place, left, timing, motion)
    warped = ((run, warp(run)) for run in group.spectra.runs(place.shape[-1], 2))
    if gradients is None:
        gradients = row_gradients(group.spectra, warped, shown.rows, shown.shift, seen)
        products = gradients.residual_products
    else:
        products = residual_products(warped, gradients, seen)
    matrix, right = row_equations(products, gradients, seen)
    matrix = _blocks(matrix[:, None]).sum(3)[:, 0]  # (B, N, 2, 2)
    right = _blocks(right).sum(3)  # (B, G, N, 2)
    determinant = matrix[..., 0, 0] * matrix[..., 1, 1] - matrix[..., 0, 1].square()
    known = (determinant > _CONDITION * matrix[..., 0, 0] * matrix[..., 1, 1]) & (determinant > 0)
    eye = torch.eye(2, dtype=matrix.dtype, device=matrix.device)
    remaining = torch.linalg.solve(torch.where(known[..., None, None], matrix, eye)[:, None], right[..., None])[..., 0]
    remaining = torch.where(known[:, None, :, None], remaining, 0.0)
    block_moments = _blocks(shown.moments).mean(3)
    around = motion.mean_displacement(block_moments, timing.exposure_time)
    measurements = Measurements(
        moments=block_moments.transpose(1, 2),
        displacements=(around + remaining).transpose(1, 2),
        seen=_blocks(seen)[..., 0].transpose(1, 2),
        information=torch.where(known[..., None, None], matrix, 0.0),
        exposure_time=timing.exposure_time,
    )
    return replace(measurements, displacements=measurements.relative(measurements.displacements)), gradients


def join_groups(parts: list[Measurements]) -> Measurements:
    """Measurements of all groups as one record; smaller groups get frames that see nothing."""
    most = max(part.moments.shape[-1] for part in parts)

    def padded(values: Tensor) -> Tensor:
        return functional.pad(values, (0, 0) * (values.ndim - 3) + (0, most - values.shape[2]))

    def repeated(moments: Tensor) -> Tensor:
        return torch.cat([moments, moments[:, :, :1].expand(-1, -1, most - moments.shape[2])], 2)

    return replace(
        parts[0],
        moments=torch.cat([repeated(part.moments) for part in parts], 1),
        displacements=torch.cat([padded(part.displacements) for part in parts], 1),
        seen=torch.cat([padded(part.seen) for part in parts], 1),
        information=torch.cat([part.information for part in parts], 1),
    )


def measure_groups(groups: list[FrameGroup], timing: RowTiming, motion: Motion) -> Measurements:
    """``measure_group`` of all groups, with gradients of their own, as one record."""
    return join_groups([measure_group(group, timing, motion, None)[0] for group in groups])


def _level_and_contrast(frames: Tensor, valid: Tensor | None) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation (B, T, 1, 1) of the pixels of each frame that count."""
    if valid is None:  # some rows tell them well enough
        frames = frames[..., ::_EVERY, :]
        weight, level = None, frames.mean((-2, -1), keepdim=True)
        count = level.new_tensor(frames[0, 0].numel())
    else:
        weight = valid.to(frames.dtype)
        count = weight.sum((-2, -1), keepdim=True)
        level = (frames * weight).sum((-2, -1), keepdim=True) / count
    square = torch.zeros_like(level)
    for part in chunks(frames.shape[-2], 2 * frames.element_size() * frames[..., 0, :].numel(), 1, frames.device):
        centred = frames[..., part, :] - level
        centred = centred if weight is None else centred.mul_(weight[..., part, :])
        square += centred.square_().sum((-2, -1), keepdim=True)
    return level, (square / count).sqrt()
