"""Reading and writing whole stacks: the file ending selects the format."""

import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rsvib_torch.core.arguments import checks_arguments
from rsvib_torch.core.atomic import (
    check_kind,
    check_name,
    check_not_special,
    check_writable,
    make_folder,
    move_into_place,
    sync_tree,
    temporary_folder,
)
from rsvib_torch.core.checks import check_choice
from rsvib_torch.core.free_memory import check_fits
from rsvib_torch.core.outputs import check_outputs
from rsvib_torch.core.progress import steps
from rsvib_torch.core.reading import check_regular
from rsvib_torch.frames.arrays import Channels, FramesLike, as_tensor, channel_axis
from rsvib_torch.io import hdf5, image_folder, npy, raw, tiff, video, zarr_store
from rsvib_torch.io.formats import FORMATS, FrameReader, StackFormat, find_format, register_format, target_format
from rsvib_torch.io.frame_times import timing_from_first_frame
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
    "stack_files",
    "timing_of_files",
    "write_frames",
    "write_stack",
]

PathLike = str | os.PathLike[str]
_FRAME_COPIES = 24  # bytes per pixel of one frame while it is decoded and converted
_MAX_FRAMES = 10**7  # reading that many frames of one pixel takes a minute
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


@checks_arguments
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
        >>> import tempfile
        >>> import torch
        >>> import rsvib_torch as rsv
        >>> frames = torch.rand(3, 64, 48, generator=torch.Generator().manual_seed(0))
        >>> path = tempfile.mkdtemp() + "/frames.npy"
        >>> rsv.write_stack(path, frames)
        >>> reader = rsv.open_stack(path)
        >>> reader.info.shape, reader.frame(2).shape  # reads one frame
        ((3, 64, 48), (64, 48))
        >>> reader.close()
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist")
    check_regular(path)
    reader = find_format(path).open(path)
    reader.info = replace(reader.info, path=path)
    if reader.info.shape[0] > _MAX_FRAMES:
        reader.close()
        raise ValueError(f"{path}: {reader.info.shape[0]} frames; a stack has at most {_MAX_FRAMES}, split the file")
    return reader


@checks_arguments
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
        >>> import tempfile
        >>> import torch
        >>> import rsvib_torch as rsv
        >>> frames = torch.rand(3, 64, 48, generator=torch.Generator().manual_seed(0))
        >>> path = tempfile.mkdtemp() + "/frames.tif"
        >>> rsv.write_stack(path, frames, dtype="uint16", full_scale=4095)
        >>> info = rsv.read_stack_info(path)
        >>> info.shape, info.dtype, info.full_scale
        ((3, 64, 48), 'uint16', 4095.0)
    """
    reader = open_stack(path)
    reader.close()
    return reader.info


@checks_arguments
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
        ValueError: If it is damaged, its frames differ in size, the full scale is unknown or exceeded, or the frames do
            not fit into the free memory.

    Example:
        >>> import tempfile
        >>> import torch
        >>> import rsvib_torch as rsv
        >>> frames = torch.rand(3, 64, 48, generator=torch.Generator().manual_seed(0))
        >>> path = tempfile.mkdtemp() + "/frames.tif"
        >>> rsv.write_stack(path, frames, dtype="uint16", full_scale=4095)  # 12 bits in a 16-bit file
        >>> rsv.read_stack(path).shape, rsv.read_stack(path).max() <= 1.0  # the file states its full scale
        (torch.Size([3, 64, 48]), tensor(True))
    """
    paths = [path] if isinstance(path, (str, os.PathLike)) else list(path)
    return torch.from_numpy(_read_pixels(paths, full_scale, as_counts=False)[0])


def _read_pixels(
    paths: Sequence[PathLike], full_scale: float | None, *, as_counts: bool
) -> tuple[NDArray[Any], float | None]:
    """Frames of all files, (T, H, W) or (T, C, H, W), and their full scale.

    Args:
        paths: The files.
        full_scale: As in ``read_stack``.
        as_counts: Whether integers are returned as stored instead of as float32; those of files with a nodata value
            are always float32, with NaN where pixels have no data.
    """
    if not paths:
        raise ValueError("path must contain at least one file, got an empty list")
    parts: list[NDArray[Any]] = []
    first: StackInfo | None = None
    count = 0  # frames of all files
    for path in paths:
        reader = open_stack(path)
        try:
            info = reader.info
            first = first or info
            if info.kind != first.kind:
                raise ValueError(f"frames of different size or kind: {paths[0]} is {first.kind}, {path} is {info.kind}")
            stated = first.full_scale if full_scale is None else full_scale
            stored = as_counts and info.is_integer and first.nodata is None
            dtype = np.dtype(info.dtype if stored else np.float32)
            count += info.shape[0]
            joined = count if len(paths) > 1 else 0  # the frames of all files are copied into one array
            frame_bytes = _FRAME_COPIES * math.prod(info.shape[1:])
            check_fits(
                f"{path}: {info.shape[0]} frames of {info.shape[-2]} x {info.shape[-1]} px",
                (info.shape[0] + joined) * math.prod(info.shape[1:]) * dtype.itemsize
                + frame_bytes
                + info.decoding_bytes,
                "process the stack in windows (iterate_stack, process_stack, rsvib run)",
            )
            pixels = np.empty(info.shape, dtype)
            advance = steps(len(pixels), "frames")
            for index in range(len(pixels)):
                frame = reader.frame(index)
                pixels[index] = frame if stored else counts_to_frames(frame, stated, str(path), first.nodata)
                advance()
        finally:
            reader.close()
        parts.append(pixels)
    return parts[0] if len(parts) == 1 else np.concatenate(parts), stated


def load_frames(frames: FramesOrFiles, full_scale: float | None) -> tuple[FramesLike, float | None]:
    """Read frames that are given by the paths of their files; other frames are returned unchanged.

    Args:
        frames: Frames in memory, a path, or a list of paths.
        full_scale: Count that corresponds to 1.0, as in ``read_stack``.

    Returns:
        The frames, integers as stored unless the file has a nodata value, and their full scale.

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
    pixels, full_scale = _read_pixels(paths, full_scale, as_counts=True)
    if pixels.dtype.kind == "f":
        return torch.from_numpy(pixels), None
    return pixels, full_scale_of_counts(pixels, full_scale, str(paths[0]))


def timing_of_files(frames: FramesOrFiles, timing: SensorTiming) -> SensorTiming:
    """The timing of frames that may be given by the path of their file, with the frame times that the file states.

    Args:
        frames: Frames in memory, a path, or a list of paths.
        timing: The sensor.

    Warns:
        TimingWarning: As ``timing_from_first_frame``, if the file states another frame rate than the sensor has.

    Raises:
        TypeError: If ``timing`` is not a ``SensorTiming``.
    """
    check_timing(timing)
    if isinstance(frames, (str, os.PathLike)):
        return timing_from_first_frame(timing, read_stack_info(frames))
    return timing


def stack_files(path: PathLike) -> list[Path]:
    """The paths that a stack occupies: its file or folder, and the files beside it (sidecars).

    Example:
        >>> [path.name for path in stack_files("frames.raw")]
        ['frames.raw', 'frames.raw.json']
    """
    path = Path(path)
    form = FORMATS.get(path.suffix.lower())
    return [path, *(path.with_name(path.name + ending) for ending in (() if form is None else form.companions))]


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
    check_name(path)
    check_not_special(path)
    form = target_format(path)
    if not form.writable:
        raise ValueError(
            f"{path}: {form.name} files can only be read; write .tif, .png, .npy, .mkv or a folder of PNG files"
        )
    if info.dtype not in form.dtypes:
        raise ValueError(f"{path}: {form.name} files hold {', '.join(form.dtypes)}; got dtype {info.dtype}")
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
    else:
        check_kind(path, folder=form.kind != "file")
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
    if len(shape) not in (3, 4) or min(shape) < 1:
        raise ValueError(f"frames must have shape (T, H, W) or (T, C, H, W), got {tuple(shape)}")
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
        sync_tree(path)
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


@checks_arguments
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
            presentation times of the frames and the audio are copied. Its file must not be ``path``.

    Raises:
        OSError: If the file cannot be written.
        TypeError: If the frames are not a tensor or array of numbers.
        ValueError: If the format does not support them, the full scale is unknown, or ``path`` is the file of ``like``.

    Example:
        >>> import tempfile
        >>> import torch
        >>> import rsvib_torch as rsv
        >>> frames = torch.rand(3, 64, 48, generator=torch.Generator().manual_seed(0))
        >>> path = tempfile.mkdtemp() + "/frames.tif"
        >>> rsv.write_stack(path, frames, dtype="uint16", full_scale=4095)
        >>> bool((rsv.read_stack(path) - frames).abs().max() <= 0.51 / 4095)  # rounded to counts
        True
    """
    path = Path(path)
    if like is not None and like.path is not None:
        check_outputs(stack_files(path), stack_files(like.path))
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
            make_folder(path.parent)
        move_into_place(part, path, form.kind, form.companions)
