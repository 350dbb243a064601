"""Two frames of a stack cut to the scene that both show, with what restoration made of them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from rsvib_torch.frames.pixels import detailed_columns
from rsvib_torch.restoration.frame_motion import FrameMotion
from rsvib_torch.restoration.verdict.misfit import RIM
from rsvib_torch.restoration.verdict.outcome import TooLittleInCommonError
from rsvib_torch.restoration.verdict.reblur import reblur

__all__ = ["FramePair", "equally_bright", "pairs_to_judge", "shared_part"]

_BLOCK = 16  # px, large beside displacements: means of such squares tell how bright two frames are
_MARGIN = 4  # px between the pixels judged and what was made up


@dataclass(frozen=True, eq=False)
class FramePair:
    """Two raw frames and their restored ones where all show the same scene, (C, h, w) each.

    Attributes:
        earlier: Raw.
        later: Raw.
        restored: Of the earlier one, or the one image of all frames.
        restored_later: Of the later one; None where there is one image.
        predicted: The later raw frame, from ``restored``.
        changed_later: What the motion of the later frame does to its restored one.
        offset: (2,) px, root-mean-square displacement between the two that the motion predicts, axes (x, y).
        missing: (2, C, h, w) bool, pixels of the raw frames that were not measured: they hold what the restored ones
            predict; None for none.
    """

    earlier: Tensor
    later: Tensor
    restored: Tensor
    restored_later: Tensor | None
    predicted: Tensor
    changed_later: Tensor
    offset: Tensor
    missing: Tensor | None = None


def pairs_to_judge(count: int, joint: bool | int, most: int | None = None) -> list[tuple[int, int]]:
    """Pairs of ``count`` frames to compare, at most ``most`` of them, evenly spread."""
    middle = count // 2
    pairs = [(p, p + 1) for p in range(count - 1)]
    if joint is True:
        pairs = [(middle, p) for p in range(count) if p != middle]
    if most is None or len(pairs) <= most:
        return pairs
    chosen = torch.linspace(0, len(pairs) - 1, most).round().to(torch.int64).tolist()
    return [pairs[index] for index in chosen]


def shared_part(
    raw: Tensor,
    restored: Tensor,
    motion: FrameMotion,
    frames: tuple[int, int],
    columns: int | None,
    hidden: Tensor | None = None,
) -> FramePair:
    """Cut what two frames have in common; rows are those of the later one.

    Args:
        raw: (T, C, H, W) in row order.
        restored: (T, C, H, W), or (1, C, H, W) in the coordinates of the first of ``frames``.
        motion: Motion of the frames, batch of one.
        frames: Which two.
        columns: Cut to so many columns, those with the most detail; None for all.
        hidden: Mask shaped like ``raw`` of pixels that were not measured.

    Raises:
        TooLittleInCommonError: If hardly any scene is left.
    """
    earlier, later = frames
    x, y = (int(step) for step in (motion.shift[0, later] - motion.shift[0, earlier]).tolist())
    height, width = (size - abs(step) for size, step in zip(raw.shape[-2:], (y, x), strict=True))
    moved = _moved(motion, frames, raw.shape[-2])
    rim_x, rim_y = (math.ceil(reach) + _MARGIN for reach in moved.abs().amax((0, 1)).tolist())
    if min(height - 2 * rim_y, width - 2 * rim_x) < 2 * RIM + 3:
        raise TooLittleInCommonError(
            f"frames {earlier} and {later} have nothing in common, or too little: they lie ({x}, {y}) px apart"
        )
    before, after = (_same_scene(step, raw.shape[-2:]) for step in ((y, x), (-y, -x)))
    first, second = raw[earlier][before], raw[later][after]
    single = len(restored) == 1
    scene = restored[0 if single else earlier][before]
    other = scene if single else restored[later][after]
    strip = slice(0, width)
    if columns is not None:
        detailed = detailed_columns(second[..., rim_x : width - rim_x], columns)
        strip = slice(detailed.start, detailed.stop + 2 * rim_x)
    cut = (..., slice(rim_y, height - rim_y), slice(rim_x, -rim_x))
    first, second, scene, other = (image[..., strip] for image in (first, second, scene, other))
    formed = reblur(torch.cat([scene, other]), motion, later, first_row=max(y, 0))
    predicted, formed_later = (part[cut] for part in formed.chunk(2))
    missing = None
    if hidden is not None:
        lost = torch.stack([hidden[earlier][before], hidden[later][after]])[..., strip]
        formed_earlier = reblur(scene, motion, earlier, first_row=max(-y, 0))
        first = torch.where(lost[0], formed_earlier, first)
        second = torch.where(lost[1], formed.chunk(2)[0], second)
        missing = lost[(slice(None), *cut)]
    return FramePair(
        first[cut],
        second[cut],
        scene[cut],
        None if single else other[cut],
        predicted,
        formed_later - other[cut],
        (moved[1] - moved[0]).square().mean(0).sqrt(),
        missing,
    )


def equally_bright(pair: FramePair, noise: Tensor) -> FramePair:
    """The pair with the earlier frame, and what was made of it, as bright and as contrasty as the later one."""
    side = min(_BLOCK, *pair.later.shape[-2:])
    shown, seen = (
        torch.nn.functional.avg_pool2d(image[None], side)[0].to(torch.float64) for image in (pair.predicted, pair.later)
    )
    mean, target = (values.mean((-2, -1), keepdim=True) for values in (shown, seen))
    power = (shown - mean).square().mean() + noise
    gain = (((shown - mean) * (seen - target)).mean() + noise) / power
    if float(gain) <= 0.0:
        return pair
    mean, target, gain = (value.to(pair.later.dtype) for value in (mean, target, gain))

    def bright(image: Tensor) -> Tensor:
        return torch.addcmul(target - gain * mean, image, gain)

    single = pair.restored_later is None
    return replace(
        pair,
        earlier=bright(pair.earlier),
        restored=bright(pair.restored),
        predicted=bright(pair.predicted),
        changed_later=gain * pair.changed_later if single else pair.changed_later,
    )


def _same_scene(step: tuple[int, int], size: Sequence[int]) -> tuple[Any, ...]:
    """Part of an image whose content is found ``step`` px further on in another image."""
    return (..., *(slice(max(-s, 0), n - max(s, 0)) for s, n in zip(step, size, strict=True)))


def _moved(motion: FrameMotion, frames: Sequence[int], num_rows: int) -> Tensor:
    """Mean displacement (2, R, 2) of the rows of two frames beyond their shifts, in px."""
    rows = torch.arange(num_rows, dtype=torch.float64, device=motion.frame_starts.device)
    starts = motion.frame_starts[list(frames), None] + rows * motion.timing.row_time
    moved = motion.vibration.mean_displacement(starts[None], motion.timing.exposure_time)
    return (moved - motion.shift[:, list(frames), None])[0]
