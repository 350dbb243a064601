"""Input preparation, once for all entry points: from frames or files to floating-point images in row order, and back.

``prepare_frames`` is the only place that reads files given as frames, converts dtypes, applies the full scale, builds
masks, turns images and adds batch and channel axes; ``PreparedFrames.from_row_order`` is the way back. Two of the three
invariants (docs/architecture.md) begin here: rows lie on axis -2 in readout order, and images are float32 (float64 if
the user gave float64).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import torch
from torch import Tensor

from rsvib_torch.checks.arguments import (
    Channels,
    FramesLike,
    FramesOrFiles,
    as_tensor,
    channel_axis,
    check_pixels,
    other_axes,
)
from rsvib_torch.checks.values import check_number
from rsvib_torch.frames import pixels
from rsvib_torch.frames.entry_points import load_frames
from rsvib_torch.frames.full_scale import scaled_counts
from rsvib_torch.motion.timing import RowTiming, SensorTiming, check_timing, row_axes
from rsvib_torch.numerics.tables import Array
from rsvib_torch.options import MaskedInputOptions
from rsvib_torch.results.presentation import AXIS_NAMES
from rsvib_torch.results.reason import Reason


def frames_to_row_order(frames: Tensor, timing: SensorTiming) -> Tensor:
    """Turn frames (..., H, W) so that rows lie on axis -2 and row 0 is read first."""
    frames = frames.transpose(-2, -1) if timing.scan_axis == -1 else frames
    return frames.flip(-2) if timing.readout_direction == "reverse" else frames


def frames_from_row_order(frames: Tensor, timing: SensorTiming) -> Tensor:
    """Inverse of ``frames_to_row_order``."""
    frames = frames.flip(-2) if timing.readout_direction == "reverse" else frames
    return frames.transpose(-2, -1) if timing.scan_axis == -1 else frames


def offsets_from_row_order(offsets: Tensor, timing: SensorTiming) -> Tensor:
    """Turn displacements or offsets (..., A) in row order back to image axes (x, y) and, if A > 2, roll and zoom."""
    _, signs = row_axes(timing, offsets.shape[-1])
    if min(signs) < 0:  # a tensor of signs is a transfer to the GPU
        offsets = offsets * offsets.new_tensor(signs)
    return magnitudes_from_row_order(offsets, timing)


def magnitudes_from_row_order(values: Tensor, timing: SensorTiming, axis: int = -1) -> Tensor:
    """Turn values without a sign back to image axes: standard deviations, gains, residuals, verdicts.

    Values are (..., A) for ``axis=-1`` and (..., A, K) for ``axis=-2``, with components in row order, of any dtype.

    Example:
        >>> timing = SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=512, scan_axis="x")
        >>> magnitudes_from_row_order(Tensor([[1, 2, 3]]), timing).tolist()
        [[2.0, 1.0, 3.0]]
    """
    order, _ = row_axes(timing, values.shape[axis])
    if order == sorted(order):  # a tensor of places is a transfer to the GPU
        return values
    return values.index_select(axis, torch.tensor(order, device=values.device))


def reasons_from_row_order(reasons: Sequence[Reason], timing: SensorTiming) -> tuple[Reason, ...]:
    """Reasons with the names of their axes in the image."""
    order, _ = row_axes(timing, len(AXIS_NAMES))
    names = {AXIS_NAMES[axis]: name for axis, name in zip(order, AXIS_NAMES, strict=True)}
    return tuple(replace(one, axis=names.get(one.axis or "")) for one in reasons)


def findings_from_row_order(
    findings: Sequence[Sequence[Reason]], timing: SensorTiming
) -> tuple[tuple[Reason, ...], ...]:
    """Turn the reasons against each component back to image axes."""
    order, _ = row_axes(timing, len(findings))
    return tuple(reasons_from_row_order(findings[axis], timing) for axis in order)


Saturation = float | Literal["auto"] | None
# of full scale: the noise of simulated frames may exceed it by less, and frames of a greater bit depth reach twice it
_MOST_COUNTS = 1.1


@dataclass(frozen=True, eq=False)
class PreparedFrames:
    """Frames in the form that core code expects, with what is needed to return to the user's form."""

    images: Tensor  # (B, T, C, H, W) float32 or float64 in row order, full scale 1; 0 at missing pixels
    missing: Tensor | None  # bool of that shape, True at pixels without data; None if there are none
    # bool of that shape, True at pixels at or above the saturation level; None if there are none
    saturated: Tensor | None
    timing: RowTiming  # the sensor in row order
    # the sensor in image orientation, with the frame times of the file if frames were given by a path
    image_timing: SensorTiming
    shape: tuple[int, ...]  # shape of the user's frames
    channel_axis: int  # their axis of the channels, -3 or -1, if they have one
    dtype: torch.dtype  # Floating-point dtype of results for the user
    # count that means 1.0 in the user's frames, as given or stated by their file; None if not stated
    full_scale: float | None
    # (B, T, 1, H, W), colour that each pixel of a mosaic measures: 0 red, 1 green, 2 blue; None for frames whose
    # pixels measure all channels
    colours: Tensor | None = None
    lost: Tensor | None = None  # (B, T, H) bool, rows that were lost, which count as missing; None if there are none

    def lost_rows(self) -> dict[int, int]:
        """Number of lost rows of each frame that has some, in all stacks."""
        counts = [] if self.lost is None else self.lost.sum((0, 2)).tolist()
        return {frame: count for frame, count in enumerate(counts) if count}

    @property
    def batched(self) -> bool:
        """Whether the user gave a batch of stacks, with five axes."""
        return len(self.shape) == 5

    @cached_property
    def filled(self) -> Tensor:
        """The images with local means at missing pixels."""
        if self.missing is None:
            return self.images
        return (pixels.fill_with_means if self.colours is None else pixels.fill_by_colour)(self.images, self.missing)

    def compared(self, restored: Tensor) -> tuple[Tensor, Tensor]:
        """Raw frames and restored ones at their pixels, as they can be compared; of a mosaic, the smooth luminance."""
        points = restored.shape[-1] // self.images.shape[-1]
        restored = restored[..., ::points, ::points]
        if self.colours is None:
            return self.filled, restored
        return pixels.mosaic_free(self.filled), pixels.mosaic_free(pixels.luminance(restored))

    def from_row_order(self, images: Tensor) -> Tensor:
        """Images (B, T', C, H', W') in row order with the axes, orientation and dtype of the user's frames.

        On a finer grid, the first row lies at the first row of the frames in both orders: the row beyond the other end
        is repeated if the readout direction is reversed.
        """
        if images.shape[-2] > self.images.shape[-2] and self.image_timing.readout_direction == "reverse":
            images = torch.cat([images[..., :1, :], images[..., :-1, :]], dim=-2)
        turned = frames_from_row_order(images, self.image_timing)
        turned = turned if self.batched else turned[0]
        if len(self.shape) == 3 and self.colours is None:
            turned = turned[:, 0]
        else:
            turned = turned.movedim(-3, self.channel_axis)
        return turned.to(self.dtype)

    def restored_shape(self, count: int, scale: int) -> tuple[int, ...]:
        """Shape of ``count`` restored images of a stack with ``scale`` times the rows and columns, in image axes."""
        channels, height, width = self.images.shape[-3:]
        channels = channels if self.colours is None else 3
        restored = torch.empty(1, count, channels, scale * height, scale * width, device="meta")
        return tuple(self.from_row_order(restored).shape)


def prepare_frames(
    frames: FramesOrFiles,
    timing: SensorTiming,
    *,
    full_scale: float | None = None,
    channels: Channels = None,
    ignore: object = None,
    saturation: Saturation = None,
    minimum_frames: int = 1,
    allow_missing: bool = True,
    mosaic: str | None = None,
    name: str = "frames",
) -> PreparedFrames:
    """Read and check frames; turn them into floating-point images (B, T, C, H, W) in row order, with their masks.

    ``full_scale``, ``channels``, ``ignore``, ``saturation`` and ``mosaic`` are as in ``MaskedInputOptions`` and
    ``RestorationOptions``. Without ``allow_missing`` NaN is refused. Errors contain the ``name`` of the argument.

    Example:
        >>> timing = SensorTiming(row_time=2e-5, exposure_rows=20, frame_rows=512, scan_axis="x")
        >>> prepared = prepare_frames(torch.zeros(2, 48, 64, dtype=torch.uint8), timing)
        >>> tuple(prepared.images.shape), prepared.images.dtype, prepared.missing
        ((1, 2, 1, 64, 48), torch.float32, None)
        >>> tuple(prepared.from_row_order(prepared.images).shape)
        (2, 48, 64)
    """
    check_timing(timing)
    # files: their pixels as stored, with the full scale and the times that they state
    loaded = load_frames(frames, full_scale)
    full_scale = loaded.full_scale
    if loaded.timed is not None:
        timing = loaded.timed(timing)
    given = as_tensor(name, loaded.frames)
    axis = channel_axis(name, given.shape, channels)
    in_memory = loaded.frames is frames  # files state which axis has the channels
    usual = (1, 3, 4) if given.ndim == 4 else (1, 2, 3, 4)  # two images of (T, 2, H, W) may be two of a batch
    if given.ndim > 3 and channels is None and in_memory and given.shape[-3] not in usual:
        raise other_axes(name, tuple(given.shape))
    # missing pixels become 0 and are marked, so that all further steps compute with finite numbers
    missing = _missing_pixels(given, ignore, allow_missing, axis)
    if missing is not None:
        if bool(missing.all()):
            raise ValueError(f"{name} have no pixel with data: all are NaN or in ignore")
        given = given.masked_fill(missing, 0)
    # full scale 1, in float32 or float64
    images = as_float_frames(given, full_scale, channels=channels, minimum_frames=minimum_frames, name=name)
    saturated = _saturated_pixels(given, saturation, full_scale)
    dtype = given.dtype if given.dtype.is_floating_point else images.dtype

    # a batch of stacks with channels, whose rows lie on axis -2 in readout order
    def in_row_order(values: Tensor) -> Tensor:
        values = values[:, None] if values.ndim == 3 else values.movedim(axis, -3)
        return frames_to_row_order(values if values.ndim == 5 else values[None], timing)

    images = in_row_order(images)
    row_timing = timing.in_row_order()
    row_timing.check_rows(images.shape[-2])
    missing, saturated = (None if mask is None else in_row_order(mask) for mask in (missing, saturated))
    lost = _lost_rows(images, missing)
    if lost is not None:
        of_rows = lost[:, :, None, :, None].expand(images.shape)
        missing = of_rows if missing is None else missing | of_rows
        images = images.masked_fill(of_rows, 0)
    colours = None
    if mosaic is not None:
        pixels.check_mosaic(mosaic, frames_from_row_order(images, timing).shape, name)
        size = images.shape[-2:] if timing.scan_axis == -2 else images.shape[:-3:-1]
        pattern = frames_to_row_order(pixels.colours_of(mosaic, *size), timing)
        colours = pattern.to(images.device).expand(images.shape)
    return PreparedFrames(
        images, missing, saturated, row_timing, timing, tuple(given.shape), axis, dtype, full_scale, colours, lost
    )


def as_float_frames(
    frames: FramesLike,
    full_scale: float | None = None,
    *,
    channels: Channels = None,
    minimum_frames: int = 1,
    name: str = "frames",
) -> Tensor:
    """Check a stack of frames, and convert it to float32 with full scale 1; float64 is kept.

    Frames are (T, H, W), (T, C, H, W) or (B, T, C, H, W), a tensor, array or list of these. Floating-point frames keep
    their values. 8-bit integers have full scale 255; the full scale of other integers must be given, because a 16-bit
    file may hold 12-bit counts.

    Example:
        >>> as_float_frames(torch.full((2, 4, 4), 255, dtype=torch.uint8)).max().item()
        1.0
    """
    frames = as_tensor(name, frames)
    axis = channel_axis(name, frames.shape, channels)
    count = frames.shape[1 if frames.ndim == 5 else 0]
    if count < minimum_frames:
        grey = f" of {frames.shape[axis]} channels; grey frames are (T, H, W), in TIFF pages"
        images = grey if frames.ndim == 4 else ""
        raise ValueError(f"at least {minimum_frames} frames are needed, got {count}{images}")
    if min(frames.shape) == 0:
        raise ValueError(f"{name} must not be empty, got shape {tuple(frames.shape)}")
    if frames.dtype.is_floating_point:
        check_pixels(name, frames)
        return frames if frames.dtype == torch.float64 else frames.to(torch.float32)
    return scaled_counts(frames, full_scale, name, most=_MOST_COUNTS)


def _missing_pixels(frames: Tensor, ignore: object, allow_missing: bool, axis: int) -> Tensor | None:
    """Mask of the frames' shape, with channels on ``axis``, of ignored and NaN pixels; None if there are none."""
    missing = None
    if allow_missing and frames.dtype.is_floating_point and bool(frames.sum().isnan()):
        missing = frames.isnan()
    if ignore is None:
        return missing
    mask = as_tensor("ignore", ignore).to(frames.device)
    if mask.dtype != torch.bool:
        raise TypeError(f"ignore must be a bool tensor, got {mask.dtype}")
    if mask.shape != frames.shape:
        planes = tuple((frames if frames.ndim < 4 else frames.select(axis, 0)).shape)
        try:
            mask = mask.expand(planes)
        except RuntimeError as error:
            raise ValueError(
                f"ignore {tuple(mask.shape)} does not fit the frames: ignore must be a boolean mask of shape "
                f"{tuple(frames.shape)}, or one that broadcasts to {planes}"
            ) from error
        mask = (mask if frames.ndim < 4 else mask.unsqueeze(axis)).expand(frames.shape)
    return mask if missing is None else mask | missing


def _saturated_pixels(frames: Tensor, saturation: Saturation, full_scale: float | None) -> Tensor | None:
    """Mask of the pixels at the saturation level or above, in the unit of the user's frames; None if there are none."""
    if saturation == "auto":
        saturation = None if frames.dtype.is_floating_point else largest_count(frames, full_scale or 255.0)
    if saturation is None:
        return None
    mask = frames >= check_number("saturation", saturation, above=0.0)
    if bool(mask.all()):
        raise ValueError("every pixel is saturated")
    return mask if bool(mask.any()) else None


def largest_count(frames: Tensor, full_scale: float) -> float:
    """The count that saturated pixels have: full scale, or the last multiple of the step of the counts up to it.

    A camera of 12 bits, stored left-aligned in 16, has counts that are multiples of 16, of at most 65520. Images of
    less than 6 bits are drawings or thresholds, whose brightest level is not saturated.
    """
    counts = frames.to(torch.int32 if frames.dtype.itemsize < 4 else torch.int64)  # others have no bitwise operations
    largest = int(counts.max())
    step = largest & -largest  # the largest power of two that divides it
    aligned = 63 * step <= largest <= full_scale < largest + step and not bool((counts & (step - 1)).any())
    return largest if aligned else full_scale


# of the mean contrast of the rows of a frame, above which a row has detail: noise of a dark sky has less
_LEAST_CONTRAST = 0.25
# rows. A saturated sky or road, the sky between stars and a drawn chart have rows of one value in every frame, and the
# motion of the scene displaces them by less: of 12 such stacks, up to 85 rows of a frame counted as lost without this
_SCENE_MOVES = 32


def _lost_rows(images: Tensor, missing: Tensor | None) -> Tensor | None:
    """(B, T, H) bool, rows that were lost on the way from the camera; None for none.

    They have one value, where the frames before and after have detail and no row of one value nearby, unless most rows
    of a frame have one value.
    """
    # The first columns show in a part of the time that there is no row of one value.
    possible = (images[..., :8] == images[..., :1]).all(-1).any()
    if images.shape[1] < 2 or not bool(possible):
        return None
    low, high = images.aminmax(dim=-1)
    contrast = (high - low).amax(2)
    constant, has_detail = contrast == 0, contrast > _LEAST_CONTRAST * contrast.mean(-1, keepdim=True)
    nearby = torch.nn.functional.max_pool1d(constant.float(), 2 * _SCENE_MOVES + 1, 1, _SCENE_MOVES) > 0
    shown = has_detail & ~nearby
    lost = constant & (constant.float().mean(-1, keepdim=True) < 0.5)
    lost[:, 1:] &= shown[:, :-1]
    lost[:, :-1] &= shown[:, 1:]
    if missing is not None:
        lost &= ~missing.all(-1).all(2)
    return lost if bool(lost.any()) else None


def text_of_lost_rows(lost: Mapping[int, int]) -> str:
    """A sentence about the number of lost rows of each frame."""
    first, last = min(lost), max(lost)
    of = f"frame {first}" if first == last else f"{len(lost)} frames from {first} to {last}"
    rows = f"rows of one value in {of} ({sum(lost.values())} in all), where the frames before and after have detail"
    return f"{rows}, count as pixels without data, which restoration fills"


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
        parts = pixels.detailed_parts(self.images, columns)
        return self._changed(lambda values: pixels.cut_columns(values, parts))

    def columns(self, part: slice) -> "GreyFrames":
        """Some neighbouring columns of each stack."""
        return self._changed(lambda values: values[..., part])

    def only(self, where: Array) -> "GreyFrames":
        """The stacks with data only ``where`` (B, T, H, W) is true."""
        chosen = torch.from_numpy(where).to(self.images.device)
        return replace(self, valid=chosen if self.valid is None else self.valid & chosen)

    def one(self, index: int) -> "GreyFrames":
        """One stack out of the batch, as a batch of one."""
        return replace(self._changed(lambda values: values[index : index + 1]), batched=False)

    def some(self, where: Array) -> "GreyFrames":
        """The stacks ``where`` (B,) is true."""
        return self if where.all() else self._changed(lambda values: values[torch.from_numpy(where).to(values.device)])

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
    for stack, frame in is_constant(images.amin((2, 3, 4)), images.amax((2, 3, 4))).nonzero().tolist():
        place, remedy = f"{frame}{of_stack(stack)}", "leave out this stack" if prepared.batched else "remove this frame"
        raise ValueError(f"{constant_frame(place)}; {remedy}")
    # a copy of a frame was exposed at another time than its place in the stack states
    equal = (images[:, 1:] == images[:, :-1]).flatten(2).all(-1)
    for stack, first in (equal & ~equal.all(-1, keepdim=True)).nonzero().tolist():
        raise ValueError(
            f"frames {first} and {first + 1}{of_stack(stack)} are identical: one of them is a copy (video converters "
            "repeat frames), and its time is wrong; use frames without copies, e.g. NAME[0:100] of a file, or follow a "
            "video from frame to frame (process_video, rsvib run --video)"
        )
    # all channels show the same displacement; the pattern of a colour mosaic does not move with the scene
    images = images.mean(2) if images.shape[2] > 1 else without_mosaic(images[:, :, 0])
    return GreyFrames(images, valid, prepared.batched, prepared.image_timing)


def without_mosaic(images: Tensor) -> Tensor:
    """Grey frames (B, T, H, W), of colour mosaics without the pattern of the colours, which does not move."""
    mosaic = pixels.are_mosaics(images[:, 0])
    if not bool(mosaic.any()):
        return images
    return torch.where(mosaic[:, None, None, None], pixels.mosaic_free(images), images)


def constant_frame(place: int | str) -> str:
    """Message for a frame whose pixels are equal."""
    return f"frame {place} is constant and cannot be registered"


def is_constant(low: Tensor, high: Tensor) -> Tensor:
    """Whether the pixels between the lowest and the highest one are equal, to rounding."""
    return high - low <= 1e-6 * torch.maximum(low.abs(), high.abs())
