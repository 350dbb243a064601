"""What comes into detection: stacks of any kind become grey frames in row order, with the pixels that count."""

from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.frames.arrays import ArrayLike
from rsvib_torch.frames.pixels import detailed_columns, fill_with_means
from rsvib_torch.frames.prepare import prepare_frames
from rsvib_torch.motion.timing import SensorTiming

__all__ = ["GreyFrames", "grey_frames"]

_EVERY = 16  # rows of which one nearly always shows that a frame is not constant
_LEAST_FRAME = 0.1  # of the pixels of a frame


@dataclass(frozen=True, eq=False)
class GreyFrames:
    """Stacks at work.

    Attributes:
        images: (B, T, H, W) grey, in row order; pixels that were not measured are filled roughly.
        valid: (B, T, H, W) bool, pixels that count; None for all.
        batched: Whether the caller gave a batch.
    """

    images: Tensor
    valid: Tensor | None
    batched: bool

    def narrowed(self, columns: int) -> "GreyFrames":
        """So many neighbouring columns of each stack, those with the most detail."""
        if columns >= self.images.shape[-1]:
            return self
        parts = [detailed_columns(stack[0], columns) for stack in self.images]

        def cut(values: Tensor) -> Tensor:
            return torch.stack([stack[..., part] for stack, part in zip(values, parts, strict=True)])

        valid = None if self.valid is None else cut(self.valid)
        return GreyFrames(cut(self.images), None if valid is None or bool(valid.all()) else valid, self.batched)

    def one(self, index: int) -> "GreyFrames":
        """One stack out of the batch, as a batch of one."""
        part = slice(index, index + 1)
        valid = None if self.valid is None else self.valid[part]
        return GreyFrames(self.images[part], None if valid is None or bool(valid.all()) else valid, False)


def grey_frames(frames: ArrayLike, timing: SensorTiming, full_scale: float | None, ignore: object) -> GreyFrames:
    """Check stacks of frames and turn them to grey ones in row order.

    Args:
        frames: (T, H, W), (T, C, H, W) or (B, T, C, H, W), tensor or array; NaN marks pixels that were not measured.
        timing: The sensor.
        full_scale: Count that means 1.0, for integer frames.
        ignore: Bool tensor or array, broadcastable to (..., H, W) of the frames: True for pixels to leave out.

    Raises:
        TypeError: If frames are not numbers or ``ignore`` is not bool.
        ValueError: If there are fewer than two frames, a frame has no detail or hardly a pixel that counts, or
            ``ignore`` does not fit.
    """
    prepared = prepare_frames(frames, timing, full_scale=full_scale, ignore=ignore, minimum_frames=2)
    images, valid = prepared.images, None
    if prepared.missing is not None:
        missing = prepared.missing.any(2)
        share = 1.0 - missing.float().mean((-2, -1))
        if bool((share < _LEAST_FRAME).any()):
            where = (share < _LEAST_FRAME).nonzero()[0].tolist()
            raise ValueError(f"frame {where[-1]} has only {share[*where]:.1%} of pixels that count")
        images = fill_with_means(images, missing[:, :, None].expand(images.shape))
        valid = ~missing if bool(missing.any()) else None
    _check_detail(images)
    return GreyFrames(images.mean(2) if images.shape[2] > 1 else images[:, :, 0], valid, prepared.batched)


def _check_detail(frames: Tensor) -> None:
    """Raise ValueError for frames (B, T, C, H, W) of which one is constant."""
    flat = _flat(frames[..., ::_EVERY, :])
    if bool(flat.any()) and bool((flat := _flat(frames)).any()):
        where = flat.nonzero()[0].tolist()
        raise ValueError(f"frame {where[-1]} is constant: without detail there is nothing to register")


def _flat(frames: Tensor) -> Tensor:
    """(B, T) bool, frames whose pixels are all alike."""
    low, high = frames.amin((-3, -2, -1)), frames.amax((-3, -2, -1))
    return high - low <= 1e-6 * torch.maximum(low.abs(), high.abs())
