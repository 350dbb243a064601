"""Strips of columns for motions with roll or zoom, in which the displacement depends on the row only.

Restoration methods require a displacement that depends on the row only. With roll or zoom it changes slowly along a
row. Frames are then restored in strips of columns that overlap by half, each by the ``ColumnMotion`` of its middle, and
added up with triangular weights: between two middles, the displacement is interpolated linearly.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from rsvib_torch.frames.column_strips import ColumnStrips
from rsvib_torch.frames.pixels import detailed_columns
from rsvib_torch.motion.field import ColumnMotion, largest_in_frame, largest_slope
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import RowTiming
from rsvib_torch.restoration.frame_motion import FrameMotion, frame_motion

__all__ = ["judged_strip", "restore_in_strips"]

# px, difference of the displacements of neighbouring strips; frames of 384 x 384 px with roll of 0.5 px at their ends
# are restored to 53.77 dB, with 0.16 px to 53.83 dB in 1.2 times the time, with 0.25 px to 53.61 dB
_SLIDE = 0.2
_PITCHES = (48, 160)  # px, bounds on the distance of the strips: narrow ones cost time, wide ones memory
# px of a strip without weight, beyond the displacement; the restoration is not exact near its ends. With 24 px, the
# restored frames of 384 x 384 px have at most 0.02 dB more, with exposures of 20 to 400 rows
_MARGIN = 8


def _strips(motion: Motion, size: tuple[int, int], first: float, last: float) -> tuple[ColumnStrips, float]:
    """Strips for frames of (height, width), for a motion (B) between two times in seconds.

    Returns:
        The strips, and the standard deviation in px of the displacement of their columns about that of their middle.
    """
    reached = motion.largest_displacement(first, last)
    slope = float(largest_slope(reached, size[1], size[0], motion.camera).amax())
    narrowest, widest = _PITCHES
    pitch = min(max(_SLIDE / max(slope, 1e-9), narrowest), widest)
    moving = torch.cat([motion.largest_oscillation()[..., :2], reached[..., 2:]], -1)
    along = float(largest_in_frame(moving, size[1], size[0], motion.camera)[..., 0].amax())
    strips = ColumnStrips.of(size[1], pitch, _MARGIN + math.ceil(along))
    centres = (first + 0.5 * (strips.width - 1) for first in strips.firsts)
    distance = max(abs(centre - middle) for centre, middle in zip(centres, strips.middles, strict=True))
    return strips, slope * math.hypot(strips.width / math.sqrt(12), distance)


def restore_in_strips(
    method: Callable[..., Tensor],
    images: Tensor,
    motion: Motion,
    timing: RowTiming,
    options: Mapping[str, Any],
    *,
    pass_strips: bool = False,
) -> Tensor:
    """Frames restored by a method, in strips of columns if the motion has roll or zoom.

    Args:
        method: A restoration method, see the contract above ``METHODS``.
        images: (B, T, C, H, W) in row order.
        motion: (B) in row order.
        timing: The sensor.
        options: Options of the method; masks shaped like the images are cut as well.
        pass_strips: Whether the method has the option ``strips``, see ``RestorationMethod``.

    Returns:
        Restored frames as from the method.
    """
    count, (height, width) = images.shape[1], images.shape[-2:]
    if motion.same_for_all_columns:
        of_frames = frame_motion(motion, timing, count, height)
        of_frames.check_fits(height, width)
        return method(images, of_frames, **options)
    starts = timing.frame_starts(count).tolist()
    end = starts[-1] + height * timing.row_time + timing.exposure_time
    strips, neglected = _strips(motion, (height, width), starts[0], end)
    of_strips = ColumnMotion.of_columns(motion, strips.columns, timing, count, height)
    cut = {
        name: strips.cut(value) if isinstance(value, Tensor) and value.shape[-2:] == images.shape[-2:] else value
        for name, value in options.items()
    }
    of_frames = frame_motion(of_strips, timing, count, height)
    of_frames = replace(of_frames, neglected=neglected)
    of_frames.check_fits(height, width)
    if pass_strips:
        cut["strips"] = len(strips.firsts)
    restored = method(strips.cut(images), of_frames, **cut)
    return strips.finer(restored.shape[-1] // strips.width).joined(restored)


def judged_strip(
    raw: Tensor, restored: Tensor, hidden: Tensor | None, motion: Motion, timing: RowTiming, *, columns: int = 160
) -> tuple[Tensor, Tensor, Tensor | None, FrameMotion]:
    """The part of the frames of a stack by which their restoration is judged, and its motion.

    With roll or zoom, this is a strip of columns: of those in the middle of both halves, the one with more detail.

    Args:
        raw: (T, C, H, W) in row order.
        restored: (T, C, H, W) or (1, C, H, W); of a finer grid, the points at the pixels are judged.
        hidden: Mask shaped like ``raw`` of pixels that were not measured.
        motion: (1) in row order.
        timing: The sensor.
        columns: Width of the strip.
    """
    count, (height, width) = len(raw), raw.shape[-2:]
    points = restored.shape[-1] // width
    restored = restored[..., ::points, ::points]
    if motion.same_for_all_columns:
        of_frames = frame_motion(motion, timing, count, height)
        of_frames.check_fits(height, width)
        return raw, restored, hidden, of_frames
    strip = min(columns, width // 2)
    halves = [slice(middle - strip // 2, middle - strip // 2 + strip) for middle in (width // 4, width - width // 4)]
    both = torch.cat([raw[0][..., half] for half in halves], -1)
    half = halves[0 if detailed_columns(both, strip).start < strip // 2 else 1]
    column = torch.tensor([half.start + 0.5 * (strip - 1) - 0.5 * (width - 1)], dtype=torch.float64)
    of_strip = ColumnMotion.of_columns(motion, column, timing, count, height)
    masked = None if hidden is None else hidden[..., half]
    return raw[..., half], restored[..., half], masked, frame_motion(of_strip, timing, count, height)
