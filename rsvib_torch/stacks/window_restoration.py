"""Frames of one window restored with what was detected in them, and judged."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from rsvib_torch.frames.prepare import prepare_frames
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.restoration import RestorationVerdict, TooLittleInCommonError, trusted_vibration
from rsvib_torch.restoration.restore import restore_prepared
from rsvib_torch.restoration.verdict.judge import judge_prepared
from rsvib_torch.restoration.verdict.trust import Detected

__all__ = ["RestoredFrames", "restore_trusted"]


@dataclass(frozen=True, eq=False)
class RestoredFrames:
    """Frames to write, and what is known of them.

    Attributes:
        frames: Restored, or as taken.
        restored: Which of the two.
        left_alone: A sentence for each axis whose vibration was not undone.
        verdict: Whether restoration helps; None where frames could not be compared.
        moves: Whether there was a vibration to undo.
    """

    frames: Tensor
    restored: bool
    left_alone: tuple[str, ...]
    verdict: RestorationVerdict | None
    moves: bool


def restore_trusted(
    frames: Tensor,
    timing: SensorTiming,
    detected: Detected,
    options: Mapping[str, Any],
    *,
    force: bool = False,
    first_frames: int | None = None,
    most_pairs: int | None = None,
) -> RestoredFrames:
    """Restore frames with the part of a detection that is known well enough, and judge whether that helps.

    Args:
        frames: Stack (T, H, W) or (T, C, H, W) whose full scale is 1.
        timing: The sensor.
        detected: What was detected in them.
        options: Options of ``restore``.
        force: Keep restored frames even where they are judged no better than raw.
        first_frames: Restore no more than these.
        most_pairs: Compare no more pairs of frames.

    Returns:
        Restored frames, or those that came in where there is nothing to undo, or undoing it does not help.
    """
    rows = frames.shape[-1 if timing.scan_axis == -1 else -2]
    vibration, left_alone = trusted_vibration(detected, timing, len(frames), rows)
    frames = frames if first_frames is None else frames[:first_frames]
    if not bool(vibration.moving_axes().any()):
        return RestoredFrames(frames, False, left_alone, None, False)
    chosen = {name: value for name, value in options.items() if name not in ("method", "saturation")}
    prepared = prepare_frames(frames, timing, saturation=options.get("saturation", "auto"))
    restored = restore_prepared(prepared, vibration, options.get("method", "exact"), chosen)
    verdict = None
    with suppress(TooLittleInCommonError):
        if len(frames) > 1:
            joint = options.get("joint", False)
            verdict = judge_prepared(prepared, restored, vibration, joint=joint, most_pairs=most_pairs)
    keep = verdict is None or verdict.overall != "worse" or force
    return RestoredFrames(prepared.from_row_order(restored) if keep else frames, keep, left_alone, verdict, True)
