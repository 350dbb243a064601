"""Conversion of arrays and lists of arrays to tensors, and the axis on which frames have their channels."""

import os
from collections.abc import Iterator, Sequence
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from rsvib_torch.checks.arguments import check_tensor
from rsvib_torch.checks.values import check_choice

ArrayLike = Tensor | np.ndarray
FramesLike = ArrayLike | Sequence[ArrayLike]
PathLike = str | os.PathLike[str]
FramesOrFiles = FramesLike | PathLike | Sequence[PathLike]
Channels = Literal["first", "last"] | None


def as_tensor(name: str, value: object) -> Tensor:
    """Return a tensor, array or nested list of numbers as a tensor of the same values and dtype; lists are stacked.

    The tensor shares the memory of an array if PyTorch supports its layout. Read-only arrays and arrays with negative
    strides or foreign byte order (FITS and TIFF files) are copied.
    """
    if isinstance(value, Tensor):
        return check_tensor(name, value)
    if isinstance(value, np.ma.MaskedArray):
        raise TypeError(f"{name} must not be a masked array; pass its data, and the mask as ignore=")
    if isinstance(value, (list, tuple)) and any(isinstance(item, (list, tuple)) or _is_array(item) for item in value):
        items = [as_tensor(f"{name}[{index}]", item) for index, item in enumerate(value)]
        kinds = [f"{tuple(item.shape)} {str(item.dtype).removeprefix('torch.')} on {item.device}" for item in items]
        for index, kind in enumerate(kinds):
            if kind != kinds[0]:
                raise ValueError(f"{name} must be alike, but {name}[{index}] is {kind} and {name}[0] is {kinds[0]}")
        return torch.stack(items)
    try:
        if _is_array(value):
            array = np.asarray(value)
            native = array if array.dtype.isnative else array.astype(array.dtype.newbyteorder("="))
            unsupported = any(stride < 0 or stride % native.itemsize for stride in native.strides)
            return torch.from_numpy(native.copy() if unsupported or not native.flags.writeable else native)
        return check_tensor(name, torch.as_tensor(value, device="cpu"))
    except (TypeError, ValueError, RuntimeError) as error:
        kind = f" of {value.dtype}" if isinstance(value, np.ndarray) else ""
        parts = value if isinstance(value, (list, tuple)) else [value]
        files = any(isinstance(part, (str, os.PathLike)) for part in parts)
        remedy = "; read files with read_stack" if files else "; pass a list" if isinstance(value, Iterator) else ""
        got = f"{type(value).__name__}{kind}{remedy}"
        raise TypeError(f"{name} must be a tensor or array of numbers, got {got}") from error


def _is_array(value: object) -> bool:
    """Whether NumPy can convert the value without interpreting its elements: arrays, data sets of files, images."""
    return hasattr(value, "__array__") or hasattr(value, "__array_interface__")


def channels_appear_last(shape: Sequence[int]) -> bool:
    """Whether the last axis is one of up to four channels of an image of more than four pixels along each axis."""
    return len(shape) >= 3 and shape[-1] <= 4 < min(shape[-3:-1])


def _check_frame_axis(name: str, shape: tuple[int, ...]) -> None:
    """Raise a ``ValueError`` if the frames appear to lie on another axis than the first, or second of a batch."""
    order: tuple[int, ...] | None = None
    if len(shape) == 3 and 4 * shape[2] <= min(shape[:2]):  # no camera has frames four times as high as wide
        order, found, otherwise = (2, 0, 1), "(H, W, T)", f"{shape[0]} frames of {shape[1]} x {shape[2]} px"
    elif len(shape) == 4 and shape[2] <= 4 < min(shape[:2]):
        order, found, otherwise = (3, 2, 0, 1), "(H, W, C, T)", f"{shape[0]} frames of {shape[2]} x {shape[3]} px"
    elif len(shape) == 5 and shape[1] == 3 and shape[2] > 4:
        order, found, otherwise = (0, 2, 1, 3, 4), "(B, C, T, H, W)", f"3 frames of {shape[2]} channels"
    if order is not None:
        raise ValueError(
            f"{name} of shape {shape} appear to be {found}: pass {name}.permute{order}, or "
            f'channels="first" if these are {otherwise}'
        )


def channel_axis(name: str, shape: Sequence[int], channels: Channels) -> int:
    """The axis of the channels: -1 if they are last, -3 if they come before the image axes or do not exist.

    Shapes are (T, H, W), (T, C, H, W) and (B, T, C, H, W); with ``channels="last"`` (T, H, W, C) and (B, T, H, W, C).
    Without ``channels``, a shape is refused that appears to have up to four channels last in an image of more than four
    pixels along each axis, or the frames on the last axis or behind three channels.
    """
    check_choice("channels", channels, (None, "first", "last"))
    shape = tuple(shape)
    appears_last = channels_appear_last(shape)
    appears_first = len(shape) >= 4 and channels_appear_last((*shape[-2:], shape[-3]))
    if len(shape) == 3 and appears_last and channels != "first":
        raise ValueError(
            f'{name} of shape {shape} appear to be one image (H, W, C): pass {name}[None] with channels="last"; '
            f"{name}.permute(2, 0, 1) if the frames lie on the last axis; or "
            f'channels="first" if these are {shape[0]} frames of {shape[1]} x {shape[2]} px'
        )
    if channels is None:
        _check_frame_axis(name, shape)
    if appears_last and channels is None:
        order = (0, 3, 1, 2) if len(shape) == 4 else (0, 1, 4, 2, 3)
        raise ValueError(
            f'{name} of shape {shape} appear to have their channels last: pass channels="last" or '
            f'{name}.permute{order}, or channels="first" if they have {shape[-3]} channels'
        )
    if appears_first and channels == "last":
        raise ValueError(
            f'{name} of shape {shape} appear to have their channels before the image axes: omit channels="last"'
        )
    return -1 if channels == "last" and len(shape) > 3 else -3
