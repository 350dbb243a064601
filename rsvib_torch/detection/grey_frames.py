"""What comes into detection: stacks of any kind become grey frames in row order, with the pixels that count."""

from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.frames.arrays import ArrayLike, as_tensor
from rsvib_torch.frames.columns import detailed_columns
from rsvib_torch.frames.missing import fill_roughly
from rsvib_torch.frames.orientation import as_float_frames, frames_to_row_order
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
    images = as_float_frames(frames, full_scale, minimum_frames=2, nan_is_missing=True)
    valid = _valid_pixels(images, ignore)
    images = frames_to_row_order(images, timing)
    batched = images.ndim == 5
    images = images if batched else images[None] if images.ndim == 4 else images[None, :, None]
    if valid is not None:
        valid = frames_to_row_order(valid, timing)
        valid = valid if batched else valid[None]
        share = valid.float().mean((-2, -1))
        if bool((share < _LEAST_FRAME).any()):
            where = (share < _LEAST_FRAME).nonzero()[0].tolist()
            raise ValueError(f"frame {where[-1]} has only {share[*where]:.1%} of pixels that count")
        images = fill_roughly(images, ~valid[:, :, None].expand(images.shape))
    _check_detail(images)
    return GreyFrames(images.mean(-3) if images.shape[-3] > 1 else images[:, :, 0], valid, batched)


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


def _valid_pixels(frames: Tensor, ignore: object) -> Tensor | None:
    """Pixels (..., T, H, W) that count, in image orientation; None where all do."""
    if ignore is None and not bool(torch.isnan(frames.sum())):
        return None
    missing = torch.isnan(frames)
    missing = missing if frames.ndim == 3 else missing.any(-3)
    if ignore is not None:
        mask = as_tensor("ignore", ignore).to(frames.device)
        if mask.dtype != torch.bool:
            raise TypeError(f"ignore must be a bool tensor, got {mask.dtype}")
        try:
            missing = missing | mask
        except RuntimeError as error:
            raise ValueError(f"ignore {tuple(mask.shape)} does not fit frames {tuple(missing.shape)}") from error
    return ~missing if bool(missing.any()) else None
