"""Reading of stacks of frames: whole, frame by frame, and as the argument ``frames`` of a function."""

import math
import os
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rsvib_torch.checks.arguments import Channels, PathLike, checks_arguments
from rsvib_torch.execution.progress import steps
from rsvib_torch.files.reading import check_fits
from rsvib_torch.frames.entry_points import LoadedFrames
from rsvib_torch.frames.full_scale import counts_to_frames, required_full_scale
from rsvib_torch.io.formats import find_format
from rsvib_torch.io.frame_reader import FrameReader, part_reader
from rsvib_torch.io.frame_times import timing_from_first_frame
from rsvib_torch.io.stack_info import StackInfo, split_range
from rsvib_torch.numerics.tables import Array

_FRAME_COPIES = 24  # bytes per pixel of one frame while it is decoded and converted
_MAX_FRAMES = 10**7  # frames; reading that many frames of one pixel takes a minute


@checks_arguments
def open_stack(path: PathLike) -> FrameReader:
    """Open a stack to read its frames one at a time; call ``close`` on the result.

    ``path`` is as in ``read_stack``. Damage of single frames is detected when they are read.

    Example:
        >>> reader = open_stack("frames.tif")  # doctest: +SKIP
        >>> reader.info.shape, reader.frame(2).shape  # reads one frame  # doctest: +SKIP
        ((3, 64, 48), (64, 48))
        >>> reader.close()  # doctest: +SKIP
    """
    path, part = split_range(Path(path))
    reader = find_format(path).open(path)
    reader.info = replace(reader.info, path=path)
    if part is not None:
        reader = part_reader(reader, *part)
    if reader.info.shape[0] > _MAX_FRAMES:
        reader.close()
        raise ValueError(f"{path}: {reader.info.shape[0]} frames; a stack has at most {_MAX_FRAMES}, split the file")
    return reader


@checks_arguments
def read_stack_info(path: PathLike) -> StackInfo:
    """Read what a file states about its stack: shape, data type and full scale, without its pixels.

    ``path`` is as in ``read_stack``; unknown values are None.

    Example:
        >>> info = read_stack_info("frames.tif")  # doctest: +SKIP
        >>> info.shape, info.dtype, info.full_scale  # doctest: +SKIP
        ((3, 64, 48), 'uint16', 4095.0)
    """
    with closing(open_stack(path)) as reader:
        return reader.info


def channels_of(frames: Tensor) -> Channels:
    """The option ``channels`` of frames as ``read_stack`` returns them: files have any number of channels."""
    return "first" if frames.ndim == 4 else None


@checks_arguments
def read_stack(path: PathLike | Sequence[PathLike], *, full_scale: float | None = None) -> Tensor:
    """Read a stack of frames from a file, or from several files one after another.

    The ending selects the format: TIFF, ``.npy``, HDF5, video, images and others, all of which docs/stacks.md lists; a
    folder has PNG, TIFF or JPEG files in natural order (frame9 before frame10). Channels keep the order of the file,
    RGB or RGBA. Frames have the stored rows and columns: an orientation that the file states for display
    (``read_stack_info(path).orientation``) is not applied. ``"clip.mp4[100:200]"`` are frames 100 to 199.

    Integers are divided by the full scale: ``full_scale`` if given, else the value stated in the file, else 255 for
    ``uint8``. The full scale of other integers is unknown (16 bits may hold 12-bit counts). Floats keep their values
    and may be NaN or infinite here.

    Args:
        path: The file or folder, or a list of them whose frames have the same shape, data type and full scale.
        full_scale: Count that corresponds to 1.0.

    Returns:
        float32 frames, (T, H, W) or (T, C, H, W); NaN at pixels that have the value of the tag GDAL_NODATA.

    Raises:
        ValueError: If it is damaged, its frames differ in size, the full scale is unknown or exceeded, or the frames do
            not fit into the free memory.

    Example:
        >>> frames = read_stack("frames.tif", full_scale=4095)  # 12 bits in a 16-bit file  # doctest: +SKIP
        >>> frames.shape, float(frames.max()) <= 1.0  # doctest: +SKIP
        (torch.Size([3, 64, 48]), True)
    """
    paths = [path] if isinstance(path, (str, os.PathLike)) else list(path)
    return torch.from_numpy(_read_pixels(paths, full_scale, as_counts=False)[0])


def _read_pixels(
    paths: Sequence[PathLike], full_scale: float | None, *, as_counts: bool
) -> tuple[Array, float | None, StackInfo]:
    """Frames of all files, (T, H, W) or (T, C, H, W), their full scale, and what the first file states.

    Integers are returned as stored if wanted ``as_counts``, and the files have no nodata value: then NaN marks those
    pixels.
    """
    if not paths:
        raise ValueError("path must contain at least one file, got an empty list")
    parts: list[Array] = []
    infos: list[StackInfo] = []
    count = 0  # frames of all files
    for path in paths:
        with closing(open_stack(path)) as reader:
            info = reader.info
            infos.append(info)
            first = infos[0]
            if info.kind != first.kind:
                raise ValueError(f"frames of different size or kind: {paths[0]} is {first.kind}, {path} is {info.kind}")
            stated = first.full_scale if full_scale is None else full_scale
            stored = as_counts and info.is_integer and first.nodata is None
            dtype = np.dtype(info.dtype if stored else np.float32)
            count += info.shape[0]
            joined = count if len(paths) > 1 else 0  # the frames of all files are copied into one array
            frame_bytes = _FRAME_COPIES * math.prod(info.shape[1:])
            pixel_bytes = (info.shape[0] + joined) * math.prod(info.shape[1:]) * dtype.itemsize
            what = f"{path}: {info.shape[0]} frames of {info.shape[-2]} x {info.shape[-1]} px"
            remedy = "process the stack in windows (process_stack, rsvib run)"
            check_fits(what, pixel_bytes + frame_bytes + info.decoding_bytes, remedy)
            pixels = np.empty(info.shape, dtype)
            advance = steps(len(pixels), "frames")
            for index in range(len(pixels)):
                frame = reader.frame(index)
                pixels[index] = frame if stored else counts_to_frames(frame, stated, str(path), first.nodata)
                advance()
        parts.append(pixels)
    return parts[0] if len(parts) == 1 else np.concatenate(parts), stated, first


def read_frames(path: PathLike, indices: Sequence[int], full_scale: float | None = None) -> Tensor:
    """Frames of a stack by their numbers, as ``read_stack`` returns them."""
    with closing(open_stack(path)) as reader:
        info = reader.info
        pixels = np.empty((len(indices), *info.shape[1:]), info.dtype)
        for place, index in enumerate(indices):
            pixels[place] = reader.frame(index)
    return counts_to_frames(pixels, full_scale or info.full_scale, str(path), info.nodata)


def load_files(paths: Sequence[PathLike], full_scale: float | None) -> LoadedFrames:
    """Frames of files as the argument ``frames`` of a function, with the times of the first file."""
    pixels, full_scale, first = _read_pixels(paths, full_scale, as_counts=True)
    timed = partial(timing_from_first_frame, info=first)
    if pixels.dtype.kind == "f":
        return LoadedFrames(torch.from_numpy(pixels), None, timed)
    return LoadedFrames(pixels, required_full_scale(full_scale, pixels.dtype, paths[0]), timed)
