"""Reading and writing whole stacks: the file ending selects the format."""

import os
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rsvib_torch.core.atomic import check_writable, move_into_place, temporary_folder
from rsvib_torch.core.checks import check_choice
from rsvib_torch.core.progress import steps
from rsvib_torch.frames.arrays import Channels, FramesLike, as_tensor, channel_axis
from rsvib_torch.io import hdf5, image_folder, npy, raw, tiff, video, zarr_store
from rsvib_torch.io.formats import FrameReader, StackFormat, find_format, register_format, target_format
from rsvib_torch.io.frame_times import TimingWarning, timing_of_stack
from rsvib_torch.io.full_scale import (
    check_dtype,
    counts_to_frames,
    frames_to_counts,
    full_scale_of_counts,
    known_full_scale,
    required_full_scale,
)
from rsvib_torch.io.stack_info import StackInfo
from rsvib_torch.motion.timing import SensorTiming, check_timing

__all__ = [
    "FramesOrFiles",
    "PathLike",
    "check_info_target",
    "check_stack_target",
    "load_frames",
    "metadata_not_kept",
    "open_stack",
    "read_stack",
    "read_stack_info",
    "register_format",
    "write_frames",
    "write_stack",
]

PathLike = str | os.PathLike[str]
FramesOrFiles = FramesLike | PathLike | Sequence[PathLike]

for _form in (
    npy.FORMAT,
    hdf5.FORMAT,
    image_folder.JPEG_FORMAT,
    image_folder.PNG_FORMAT,
    image_folder.FOLDER_FORMAT,
    raw.FORMAT,
    tiff.FORMAT,
    video.FFV1_FORMAT,
    video.H264_FORMAT,
    video.READ_ONLY_FORMAT,
    zarr_store.FORMAT,
):
    register_format(_form)


def open_stack(path: PathLike) -> FrameReader:
    """Open a stack to read its frames one at a time; call ``close`` on the result.

    Args:
        path: As in ``read_stack``.

    Returns:
        An object with ``info``, ``frame(index)`` and ``close()``.

    Raises:
        OSError: If the file cannot be opened.
        ModuleNotFoundError: If an optional package is missing, with the extra to install.
        ValueError: If it is not a readable stack. Damage of single frames is detected when they are read.

    Example:
        >>> reader = open_stack("frames.tif")  # doctest: +SKIP
        >>> reader.frame(0).shape == reader.info.shape[1:]  # doctest: +SKIP
        True
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist")
    reader = find_format(path).open(path)
    reader.info = replace(reader.info, path=path)
    return reader


def read_stack_info(path: PathLike) -> StackInfo:
    """Read shape, data type and full scale of a stack without its pixels.

    Args:
        path: As in ``read_stack``.

    Returns:
        What the file states; unknown values are None.

    Raises:
        OSError: If the file cannot be opened.
        ModuleNotFoundError: If an optional package is missing, with the extra to install.
        ValueError: If it is not a readable stack.

    Example:
        >>> read_stack_info("frames.tif").shape  # doctest: +SKIP
        (8, 1024, 1024)
    """
    reader = open_stack(path)
    reader.close()
    return reader.info


def read_stack(path: PathLike | Sequence[PathLike], *, full_scale: float | None = None) -> Tensor:
    """Read a stack of frames from a file, or from several files one after another.

    The ending selects the format: TIFF (``.tif``, ``.tiff``; also BigTIFF and compressed), ``.npy`` with (H, W),
    (T, H, W) or (T, C, H, W), HDF5 (``.h5``, ``.hdf5``), Zarr v3 (``.zarr``), raw frames with a sidecar (``.raw``),
    video (``.mp4``, ``.mov``, ``.mkv``, ``.avi`` and others; grey or RGB, with 8 to 16 bits), a single ``.png`` or
    ``.jpg``, or a folder of PNG, TIFF or JPEG files in natural order (frame9 before frame10). Channels keep the order
    of the file, RGB or RGBA. Frames have the stored rows and columns: an orientation that the file states for display
    (``read_stack_info(path).orientation``) is not applied.

    Integers are divided by the full scale: ``full_scale`` if given, else the value stated in the file, else 255 for
    ``uint8``. The full scale of other integers is unknown (16 bits may hold 12-bit counts). Floats keep their values
    and may be NaN or infinite here.

    Args:
        path: The file or folder, or a list of them whose frames have the same shape, data type and full scale.
        full_scale: Count that corresponds to 1.0.

    Returns:
        float32 frames, (T, H, W) or (T, C, H, W); NaN at pixels that have the value of the tag GDAL_NODATA.

    Raises:
        OSError: If the file cannot be opened.
        ModuleNotFoundError: If an optional package is missing, with the extra to install.
        ValueError: If it is damaged, its frames differ in size, or the full scale is unknown or exceeded.

    Example:
        >>> frames = read_stack("frames.tif", full_scale=4095)  # doctest: +SKIP
    """
    paths = [path] if isinstance(path, (str, os.PathLike)) else list(path)
    pixels, info = _read_pixels(paths)
    return counts_to_frames(pixels, info.full_scale if full_scale is None else full_scale, str(paths[0]), info.nodata)


def _read_pixels(paths: Sequence[PathLike]) -> tuple[NDArray[Any], StackInfo]:
    """Pixels as stored of the frames of all files, (T, H, W) or (T, C, H, W), and what the first one states."""
    if not paths:
        raise ValueError("path must contain at least one file, got an empty list")
    parts: list[NDArray[Any]] = []
    infos: list[StackInfo] = []
    for path in paths:
        reader = open_stack(path)
        try:
            infos.append(reader.info)
            first, info = infos[0], infos[-1]
            if info.kind != first.kind:
                raise ValueError(f"frames of different size or kind: {paths[0]} is {first.kind}, {path} is {info.kind}")
            pixels = np.empty(info.shape, dtype=info.dtype)
            advance = steps(len(pixels), "frames")
            for index in range(len(pixels)):
                pixels[index] = reader.frame(index)
                advance()
        finally:
            reader.close()
        parts.append(pixels)
    return parts[0] if len(parts) == 1 else np.concatenate(parts), infos[0]


def _warn_of_unused_times(path: PathLike, timing: SensorTiming) -> None:
    """Warn if the times or the frame rate that a file states differ from the timing of the sensor."""
    check_timing(timing)
    if timing_of_stack(timing, read_stack_info(path)) is not timing:
        warnings.warn(
            f"{path}: the frame times of the file differ from equal intervals and are not used; pass "
            f"timing_from_first_frame(timing, read_stack_info({str(path)!r})) as timing",
            TimingWarning,
            stacklevel=2,
        )


def load_frames(
    frames: FramesOrFiles, full_scale: float | None, timing: SensorTiming | None = None
) -> tuple[FramesLike, float | None]:
    """Read frames that are given by the paths of their files; other frames are returned unchanged.

    Args:
        frames: Frames in memory, a path, or a list of paths.
        full_scale: Count that corresponds to 1.0, as in ``read_stack``.
        timing: The sensor; None if times are not used.

    Returns:
        The frames, integers as stored unless pixels have no data (NaN), and their full scale.

    Warns:
        TimingWarning: If a file states times or a frame rate that are not those of ``timing``.

    Example:
        >>> load_frames([[[0.5]]], None)
        ([[[0.5]]], None)
    """
    if isinstance(frames, (str, os.PathLike)):
        paths: list[PathLike] = [frames]
    elif isinstance(frames, (list, tuple)) and frames and all(isinstance(item, (str, os.PathLike)) for item in frames):
        paths = list(frames)
    else:
        return cast(FramesLike, frames), full_scale
    pixels, info = _read_pixels(paths)
    if timing is not None and len(paths) == 1:
        _warn_of_unused_times(paths[0], timing)
    full_scale = info.full_scale if full_scale is None else full_scale
    if pixels.dtype.kind == "f" or (info.nodata is not None and (pixels == pixels.dtype.type(info.nodata)).any()):
        return counts_to_frames(pixels, full_scale, str(paths[0]), info.nodata), None
    return pixels, full_scale_of_counts(pixels, full_scale, str(paths[0]))


def check_info_target(
    path: Path, info: StackInfo, compression: str | None = None, *, check_folder: bool = True
) -> StackFormat:
    """The format in which ``path`` is written; raises the error that writing would raise.

    Args:
        path: The stack to write.
        info: Its content.
        compression: As in ``write_stack``.
        check_folder: Whether to check that the folder exists and is writable.
    """
    form = target_format(path)
    if not form.writable:
        raise ValueError(
            f"{path}: {form.name} files can only be read; write .tif, .png, .npy, .mkv or a folder of PNG files"
        )
    if info.dtype not in form.dtypes:
        raise ValueError(f"{path}: {form.name} files hold {', '.join(form.dtypes)}; got dtype {info.dtype}")
    if len(info.shape) not in (3, 4) or min(info.shape) < 1:
        raise ValueError(f"frames must have shape (T, H, W) or (T, C, H, W), got {tuple(info.shape)}")
    if compression is not None:
        if not form.compressions:
            raise ValueError(f"{path}: compression={compression!r} is only available for TIFF files; omit it")
        check_choice("compression", compression, form.compressions)
    if form.check is not None:
        form.check(path, info)
    if form.kind == "tree" and path.exists() and not (path / form.marker).is_file():
        raise FileExistsError(f"cannot write {path}: it exists and is not a {form.name} stack; choose another name")
    if check_folder:
        check_writable(path, folder=form.kind != "file")
    elif form.kind == "file" and path.is_dir():
        raise IsADirectoryError(f"cannot write {path}: it is a folder")
    return form


def _info_to_write(info: StackInfo, like: StackInfo | None) -> StackInfo:
    """A stack with what is stated about the stack from which it was computed, except times that are not exact."""
    if like is None:
        return info
    kept = like.with_frames(info.shape[0])
    return replace(
        kept,
        shape=info.shape,
        dtype=info.dtype,
        full_scale=info.full_scale,
        frame_times=None if kept.time_error else kept.frame_times,
        time_error=0.0,
        metadata=like.metadata_for(info.shape, info.dtype),
    )


def check_stack_target(
    path: PathLike,
    shape: tuple[int, ...],
    *,
    dtype: str | None = None,
    full_scale: float | None = None,
    like: StackInfo | None = None,
) -> float | None:
    """Raise the error that ``write_stack`` would raise for frames of this shape, before they are computed.

    Args:
        path: The file or folder to write.
        shape: (T, H, W) or (T, C, H, W).
        dtype: As in ``write_stack``.
        full_scale: As in ``write_stack``.
        like: As in ``write_stack``.

    Returns:
        The full scale that would be used; None for floats.
    """
    kind = np.dtype(dtype or np.float32)
    if kind.kind == "f":
        full_scale = None
    elif full_scale is None:
        full_scale = known_full_scale(kind)
    check_info_target(Path(path), _info_to_write(StackInfo(tuple(shape), kind.name, full_scale), like))
    return None if kind.kind == "f" else required_full_scale(full_scale, kind, path)


def metadata_not_kept(
    like: StackInfo, path: PathLike, shape: tuple[int, ...], *, dtype: str | None = None
) -> tuple[str, ...]:
    """What a file states about its frames and the file with the restored frames will not state.

    Args:
        like: The stack that is restored.
        path: The stack to write.
        shape: Its shape, (T, H, W) or (T, C, H, W).
        dtype: Its data type; None for the same.

    Returns:
        Names of tags, ``"full scale"``, ``"resolution"``, ``"orientation"`` and ``"frame times"``.

    Example:
        >>> info = StackInfo((8, 1024, 1024), "uint16", 4095.0, resolution=(300.0, 300.0, "inch"))
        >>> metadata_not_kept(info, "restored.npy", (8, 1024, 1024))
        ('full scale', 'resolution')
        >>> metadata_not_kept(info, "restored.tif", (8, 1024, 1024))
        ()
    """
    keeps = target_format(Path(path)).keeps
    stated = like.full_scale not in (None, known_full_scale(np.dtype(like.dtype)))
    timed = like.frame_times is not None and not like.time_error
    lost = [name for name, tag in like.metadata_for(shape, dtype).items() if tag is None or "metadata" not in keeps]
    lost += ["full scale"] * (stated and "full_scale" not in keeps)
    lost += ["resolution"] * (like.resolution is not None and "resolution" not in keeps)
    lost += ["orientation"] * (like.orientation != 1 and "orientation" not in keeps)
    lost += ["frame times"] * (timed and not ("frame_times" in keeps and shape[0] == like.shape[0]))
    return tuple(lost)


def write_frames(
    form: StackFormat, path: Path, info: StackInfo, frames: Iterator[NDArray[Any]], compression: str | None
) -> None:
    """Write a complete stack, which is on the disk when the function returns.

    Args:
        form: Its format.
        path: Temporary name of the file or folder.
        info: Its content.
        frames: Pixels as stored, one frame at a time.
        compression: As in ``write_stack``.
    """
    if form.write_all is not None and (compression is not None or form.create is None):
        form.write_all(path, info, frames, compression)
        return
    assert form.create is not None
    writer = form.create(path, info, True)
    try:
        for index, frame in enumerate(frames):
            writer.write(index, frame)
        writer.sync()
    finally:
        writer.close()


def _counted(pixels: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """The frames of a stack, with a report of the progress."""
    advance = steps(len(pixels), "frames")
    for frame in pixels:
        yield frame
        advance()


def write_stack(
    path: PathLike,
    frames: FramesLike,
    *,
    channels: Channels = None,
    dtype: str | None = None,
    full_scale: float | None = None,
    compression: str | None = None,
    like: StackInfo | None = None,
) -> None:
    """Write a stack of frames: floats whose full scale is 1, or integer counts.

    The ending selects the format as in ``read_stack``; videos are written as FFV1 (``.mkv``, ``.avi``; without loss) or
    H.264 (``.mp4``, ``.mov``; 8 bits, with loss; also of floats). A path without an ending is a folder of PNG files
    (frame_0000.png ...), or of TIFF files if PNG does not support the data type. Integers are multiplied by the full
    scale, rounded and clipped to 0 ... full scale; all formats except ``.npy`` store the full scale. The file replaces
    an existing one when it is complete; after an error nothing has changed.

    Args:
        path: The file or folder to write.
        frames: (T, H, W) or (T, C, H, W): a tensor, an array or a list of these. Integers are counts.
        channels: ``"last"`` for frames (T, H, W, C). By default channels come before the image axes, and frames that
            appear to have them last are refused; ``"first"`` omits this check.
        dtype: NumPy name of the data type in the file, by default ``"float32"``, and for integers their own.
        full_scale: Count that corresponds to 1.0; 255 for ``"uint8"`` if not given, required for other integers. Floats
            keep their values.
        compression: ``"zlib"`` or ``"lzma"`` for TIFF files; None for no compression.
        like: The stack from which the frames were computed: its resolution, orientation, frame rate, channel order,
            metadata and, if the number of frames is the same, frame times are stored if the format supports them, and
            NaN as its nodata value; ``metadata_not_kept`` lists those that are not. If both files are videos, the
            presentation times of the frames and the audio are copied.

    Raises:
        OSError: If the file cannot be written.
        TypeError: If the frames are not a tensor or array of numbers.
        ValueError: If the format does not support them, or the full scale is unknown.

    Example:
        >>> write_stack("restored.tif", restored, dtype="uint16", full_scale=4095)  # doctest: +SKIP
    """
    path = Path(path)
    frames = as_tensor("frames", frames)
    if not frames.dtype.is_floating_point:
        stored = np.dtype(str(frames.dtype).removeprefix("torch."))
        check_dtype(stored)
        full_scale = required_full_scale(known_full_scale(stored, full_scale), stored, "frames")
        dtype = dtype or stored.name
        frames = frames.to(torch.float64) / full_scale  # exact for integers of 32 bits
    axis = channel_axis("frames", frames.shape, channels)
    frames = frames.movedim(axis, -3) if frames.ndim > 3 else frames
    full_scale = check_stack_target(path, tuple(frames.shape), dtype=dtype, full_scale=full_scale)
    nodata = None if like is None or dtype != like.dtype else like.nodata
    pixels = frames_to_counts(frames, np.dtype(dtype or np.float32), full_scale, nodata)
    info = _info_to_write(StackInfo(tuple(pixels.shape), pixels.dtype.name, full_scale), like)
    form = check_info_target(path, info, compression)
    with temporary_folder(path) as folder:
        part = folder / path.name
        write_frames(form, part, info, _counted(pixels), compression)
        if form.kind == "folder":
            path.parent.mkdir(parents=True, exist_ok=True)
        move_into_place(part, path, form.kind, form.companions)
