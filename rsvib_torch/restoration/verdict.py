"""Did restoration help? Judged without truth, by how well frames of one scene agree."""

from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.orientation import as_float_frames, time_axis
from rsvib_torch.restoration.motion import visible_pixels
from rsvib_torch.sensor import SensorTiming
from rsvib_torch.vibration import Vibration

__all__ = ["RestorationVerdict", "judge_restoration"]


@dataclass(frozen=True, eq=False)
class RestorationVerdict:
    """How far consecutive frames disagree where both show the scene, as root-mean-square pixel difference.

    Attributes:
        before: (P,) disagreement of the raw frames of each pair, moved onto each other by whole pixels.
        after: (P,) disagreement of the restored frames.
    """

    before: Tensor
    after: Tensor

    @property
    def helped(self) -> Tensor:
        """(P,) whether the restored frames agree better than the raw ones."""
        return self.after < self.before


def judge_restoration(
    frames: Tensor,
    restored: Tensor,
    timing: SensorTiming,
    vibration: Vibration,
    *,
    full_scale: float | None = None,
) -> RestorationVerdict:
    """Compare how well consecutive frames of a still scene agree before and after restoration.

    A vibration displaces frames differently; a right one, undone, brings them together, a wrong one drives them
    further apart. It says nothing about an axis that displaces all frames alike (a blind frequency), and frames
    restored jointly share their noise: judge frames restored one by one.

    Args:
        frames: Raw stack (T, H, W) or (T, C, H, W), at least two frames.
        restored: What ``restore`` made of it, one frame from each.
        timing: The sensor.
        vibration: The vibration that was undone, in image axes.
        full_scale: As in ``restore``.

    Returns:
        Disagreement of each of the T - 1 pairs.

    Raises:
        ValueError: If there is one frame only, shapes differ, or two frames have nothing in common.
    """
    raw = as_float_frames(frames, full_scale, minimum_frames=2)
    if raw.ndim == 5 or time_axis(raw) != 0:
        raise ValueError(f"frames must be one stack (T, H, W) or (T, C, H, W), got shape {tuple(raw.shape)}")
    if restored.shape != raw.shape:
        raise ValueError(f"restored must have the shape {tuple(raw.shape)} of the frames, got {tuple(restored.shape)}")
    height, width = raw.shape[-2:]
    mask, shift = visible_pixels(timing, vibration, (height, width), raw.shape[0])
    steps = (shift[1:] - shift[:-1]).round().to(torch.int64).tolist()
    before: list[Tensor] = []
    after: list[Tensor] = []
    for pair, (x, y) in enumerate(steps):
        if abs(x) >= width or abs(y) >= height:
            raise ValueError(f"frames {pair} and {pair + 1} have nothing in common: they lie ({x}, {y}) px apart")
        rows, columns = _overlap(y, height), _overlap(x, width)
        both = mask[pair][rows[0], columns[0]] & mask[pair + 1][rows[1], columns[1]]
        if not bool(both.any()):
            raise ValueError(f"frames {pair} and {pair + 1} have nothing in common")
        for images, found in ((raw, before), (restored, after)):
            change = images[pair + 1][..., rows[1], columns[1]] - images[pair][..., rows[0], columns[0]]
            found.append(change[..., both].square().mean().sqrt())
    return RestorationVerdict(torch.stack(before), torch.stack(after))


def _overlap(step: int, size: int) -> tuple[slice, slice]:
    """Slices of the earlier and the later frame that show the same scene, for content moved by ``step`` px."""
    return slice(max(-step, 0), size - max(step, 0)), slice(max(step, 0), size - max(-step, 0))
