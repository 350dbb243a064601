"""Grey frames in row order, as every detection and alignment uses them."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rsvib_torch.checks.arguments import FramesOrFiles
from rsvib_torch.frames.mosaic import are_mosaics, mosaic_free
from rsvib_torch.frames.orientation import frames_from_row_order, frames_to_row_order
from rsvib_torch.frames.pixels import cut_columns, detailed_parts
from rsvib_torch.frames.prepare import prepare_frames
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.options import MaskedInputOptions

_LEAST_VALID = 0.1  # of the pixels of a frame
# of the 3 x 3 pixels around a missing one that counts as measured: at the straight edge of a hole, 0.67 are
_MEASURED_AROUND = 0.7


@dataclass(frozen=True, eq=False)
class GreyFrames:
    """Stacks of frames as detection uses them."""

    images: Tensor  # (B, T, H, W) grey, in row order; missing pixels hold local means
    valid: Tensor | None  # (B, T, H, W) bool, False at missing pixels; None if there are none
    batched: bool  # whether the user gave a batch
    # the sensor in image orientation, with the frame times of the file if frames were given by a path
    timing: SensorTiming

    def _changed(self, change: Callable[[Tensor], Tensor]) -> "GreyFrames":
        """The stacks with a change of images and mask."""
        valid = None if self.valid is None else _unless_complete(change(self.valid))
        return replace(self, images=change(self.images), valid=valid)

    def narrowed(self, columns: int) -> "GreyFrames":
        """The given number of neighbouring columns of each stack, those with the most detail."""
        if columns >= self.images.shape[-1]:
            return self
        parts = detailed_parts(self.images, columns)
        return self._changed(lambda values: cut_columns(values, parts))

    def columns(self, part: slice) -> "GreyFrames":
        """Some neighbouring columns of each stack."""
        return self._changed(lambda values: values[..., part])

    def one(self, index: int) -> "GreyFrames":
        """One stack out of the batch, as a batch of one."""
        return replace(self._changed(lambda values: values[index : index + 1]), batched=False)

    def with_timing(self, timing: SensorTiming) -> "GreyFrames":
        """The same stacks in the row order of another timing."""
        turned = self._changed(lambda values: frames_to_row_order(frames_from_row_order(values, self.timing), timing))
        return replace(turned, timing=timing)


def _unless_complete(valid: Tensor) -> Tensor | None:
    """The mask of valid pixels; None if all are valid."""
    return None if bool(valid.all()) else valid


def grey_frames(
    frames: FramesOrFiles, timing: SensorTiming, given: MaskedInputOptions, *, timed: bool = True
) -> GreyFrames:
    """Read and check stacks of frames as ``prepare_frames`` does, and convert them to grey frames in row order.

    There must be at least two frames. Frames that are constant, have too few pixels that are not missing, or are copies
    of the one before are refused. ``timed``: whether the sensor has the times of the frames, or they are looked for.
    """
    prepared = prepare_frames(
        frames, timing, full_scale=given.full_scale, channels=given.channels, ignore=given.ignore, minimum_frames=2
    )
    if timed:
        prepared.timing.check_span(prepared.images.shape[1], prepared.images.shape[-2])
    images, valid = prepared.filled, None

    def of_stack(index: int) -> str:
        return f" of stack {index}" if prepared.batched else ""

    # registration needs measured pixels in every frame
    if prepared.missing is not None:
        valid = ~prepared.missing.any(2)
        fraction = valid.float().mean((-2, -1))
        small = (fraction < _LEAST_VALID).nonzero()
        if len(small):
            stack, frame = small[0].tolist()
            raise ValueError(
                f"frame {frame}{of_stack(stack)} has only {fraction[stack, frame]:.1%} of pixels with data, "
                f"{_LEAST_VALID:.0%} are needed; mark fewer pixels by NaN or ignore"
            )
        # single pixels are interpolated: the rows of a frame without one pixel in twenty could not be registered
        around = torch.nn.functional.avg_pool2d(valid.to(images.dtype), 3, 1, 1)
        valid = _unless_complete(valid | (around > _MEASURED_AROUND))
    # a frame without detail has no displacement
    for stack, frame in _constant(images).nonzero().tolist():
        place, remedy = f"{frame}{of_stack(stack)}", "leave out this stack" if prepared.batched else "remove this frame"
        raise ValueError(f"{constant_frame(place)}; {remedy}")
    # a copy of a frame was exposed at another time than its place in the stack states
    for stack, first in _repeated(images).nonzero().tolist():
        raise ValueError(
            f"frames {first} and {first + 1}{of_stack(stack)} are identical: one of them is a copy (video converters "
            "repeat frames), and its time is wrong; remove copies and state the times of the others in "
            "frame_start_times"
        )
    # all channels show the same displacement; the pattern of a colour mosaic does not move with the scene
    images = images.mean(2) if images.shape[2] > 1 else without_mosaic(images[:, :, 0])
    return GreyFrames(images, valid, prepared.batched, prepared.image_timing)


def without_mosaic(images: Tensor) -> Tensor:
    """Grey frames (B, T, H, W), of colour mosaics without the pattern of the colours, which does not move."""
    mosaic = are_mosaics(images[:, 0])
    if not bool(mosaic.any()):
        return images
    return torch.where(mosaic[:, None, None, None], mosaic_free(images), images)


def constant_frame(place: int | str) -> str:
    """Message for a frame whose pixels are equal."""
    return f"frame {place} is constant and cannot be registered"


def _constant(frames: Tensor) -> Tensor:
    """(B, T) bool, frames (B, T, C, H, W) with equal pixels, to rounding."""
    low, high = frames.amin((-3, -2, -1)), frames.amax((-3, -2, -1))
    return high - low <= 1e-6 * torch.maximum(low.abs(), high.abs())


def _repeated(frames: Tensor) -> Tensor:
    """(B, T - 1) bool: frames (B, T, C, H, W) that equal the next one; none in stacks whose frames are all equal."""
    equal = (frames[:, 1:] == frames[:, :-1]).flatten(2).all(-1)
    return equal & ~equal.all(-1, keepdim=True)
