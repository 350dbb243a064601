"""Reading and writing whole stacks: the file ending chooses the format."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from torch import Tensor

from rsvib_torch.core.checks import check_choice
from rsvib_torch.frames.arrays import ArrayLike, as_tensor
from rsvib_torch.io import hdf5, image_folder, npy, raw, tiff, video, zarr_store
from rsvib_torch.io.atomic import check_writable, place, workplace
from rsvib_torch.io.formats import FrameReader, StackFormat, find_format, target_format
from rsvib_torch.io.full_scale import check_full_scale, counts_to_frames, frames_to_counts, known_full_scale
from rsvib_torch.io.stack_info import StackInfo

__all__ = ["check_info_target", "check_stack_target", "open_stack", "read_stack", "read_stack_info", "write_stack"]

PathLike = str | os.PathLike[str]
BUILT_IN = (npy, hdf5, image_folder, raw, tiff, video, zarr_store)  # these modules enter themselves into the registry


def open_stack(path: PathLike) -> FrameReader:
    """Open a stack to read its frames one at a time; its ``close`` lets go of the file.

    Args:
        path: As in ``read_stack``.

    Raises:
        OSError: If the file cannot be opened.
        ModuleNotFoundError: If an optional package is missing, with the extra to install.
        ValueError: If it is not a readable stack. Single frames that are damaged are found when they are read.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist")
    return find_format(path).open(path)


def read_stack_info(path: PathLike) -> StackInfo:
    """Read shape, data type and full scale of a stack without its pixels.

    Args:
        path: As in ``read_stack``.

    Returns:
        What the file says of itself; ``full_scale`` is None where it does not say.

    Raises:
        OSError: If the file cannot be opened.
        ValueError: If it is not a readable stack.
    """
    reader = open_stack(path)
    reader.close()
    return reader.info


def read_stack(path: PathLike, *, full_scale: float | None = None) -> Tensor:
    """Read a stack of frames from a file.

    The ending chooses the format: TIFF (``.tif``, ``.tiff``; BigTIFF and compressed ones too), ``.npy`` with (H, W),
    (T, H, W) or (T, C, H, W), HDF5 (``.h5``, ``.hdf5``), Zarr v3 (``.zarr``), raw frames with a sidecar (``.raw``), a
    video (three channels always, RGB), a single ``.png``, or a folder of PNG or TIFF files in natural order (frame9
    before frame10). Colour images have their channels in the order of the file, RGB or RGBA.

    Integers become floats whose full scale is 1. ``full_scale`` given here comes first, then what ``write_stack``
    stated in the file, then 255 for ``uint8``; other integers do not say theirs (16 bits may hold 12-bit counts).
    Floats keep their values, whatever ``full_scale`` says, and may be NaN or infinite here: processing refuses them.

    Args:
        path: The file or folder.
        full_scale: Count that means 1.0.

    Returns:
        float32 frames, (T, H, W) or (T, C, H, W).

    Raises:
        OSError: If the file cannot be opened.
        ModuleNotFoundError: If an optional package is missing, with the extra to install.
        ValueError: If it is damaged, its frames differ in size, or the full scale is unknown or exceeded.
    """
    reader = open_stack(path)
    try:
        info = reader.info
        pixels = np.empty(info.shape, dtype=info.dtype)
        for index in range(len(pixels)):
            pixels[index] = reader.frame(index)
    finally:
        reader.close()
    return counts_to_frames(pixels, info.full_scale if full_scale is None else full_scale, str(path))


def check_info_target(
    path: Path, info: StackInfo, compression: str | None = None, *, try_folder: bool = True
) -> StackFormat:
    """The format that ``path`` is written in; raises what would be raised on writing.

    Args:
        path: The stack to write.
        info: What it is to hold.
        compression: As in ``write_stack``.
        try_folder: Whether to see if its folder is there and can be written to.
    """
    form = target_format(path)
    if not form.writable:
        raise ValueError(f"{path}: {form.name}s are only read; write .tif, .png, .npy or a folder of PNG files")
    if info.dtype not in form.dtypes:
        raise ValueError(f"{path}: {form.name} files hold {', '.join(form.dtypes)}; got dtype {info.dtype}")
    if len(info.shape) not in (3, 4) or min(info.shape) < 1:
        raise ValueError(f"frames must have shape (T, H, W) or (T, C, H, W), got {tuple(info.shape)}")
    if compression is not None:
        if not form.compressions:
            raise ValueError(f"{path}: compression is a choice for TIFF files only")
        check_choice("compression", compression, form.compressions)
    if form.check is not None:
        form.check(path, info)
    if form.kind == "tree" and path.exists() and not (path / "zarr.json").is_file():
        raise FileExistsError(f"cannot write {path}: something else of that name is there")
    if try_folder:
        check_writable(path, folder=form.kind != "file")
    elif form.kind == "file" and path.is_dir():
        raise IsADirectoryError(f"cannot write {path}: it is a folder")
    return form


def check_stack_target(
    path: PathLike, shape: tuple[int, ...], *, dtype: str | None = None, full_scale: float | None = None
) -> float | None:
    """Raise what ``write_stack`` would raise for frames of this shape, before there are any.

    Args:
        path: The file or folder to write.
        shape: (T, H, W) or (T, C, H, W).
        dtype: As in ``write_stack``.
        full_scale: As in ``write_stack``.

    Returns:
        The full scale that would be used; None for floats.
    """
    kind = np.dtype(dtype or np.float32)
    check_info_target(Path(path), StackInfo(tuple(shape), kind.name, None))
    if kind.kind == "f":
        return None
    scale = known_full_scale(kind) if full_scale is None else check_full_scale(full_scale, kind)
    if scale is None:
        raise ValueError(f"full_scale must be stated to write {kind} frames, e.g. 4095 for 12-bit counts")
    return scale


def write_stack(
    path: PathLike,
    frames: ArrayLike,
    *,
    dtype: str | None = None,
    full_scale: float | None = None,
    compression: str | None = None,
    like: StackInfo | None = None,
) -> None:
    """Write a stack of frames whose full scale is 1.

    The ending chooses the format as in ``read_stack``; a path without one is a folder of PNG files (frame_0000.png
    ...), or of TIFF files where PNG cannot hold the type. Integers are scaled by the full scale, rounded and clipped to
    0 ... full scale, so that 12-bit counts come back as 12-bit counts; all formats but ``.npy`` state the full scale
    for the next reader. The file appears whole or not at all.

    Args:
        path: The file or folder to write.
        frames: (T, H, W) or (T, C, H, W), floating point.
        dtype: NumPy name of the type in the file, by default ``"float32"``.
        full_scale: Count to write for 1.0; 255 for ``"uint8"`` if not given, to be stated for other integers. Floats
            keep their values.
        compression: ``"zlib"`` or ``"lzma"`` for TIFF files; None for none.
        like: The stack that the frames come from, whose resolution, order of channels and, if it has as many frames,
            frame times are kept as far as the format has room for them.

    Raises:
        OSError: If the file cannot be written.
        TypeError: If the frames are not a floating-point tensor.
        ValueError: If the format cannot hold them, or the full scale is not stated.
    """
    path = Path(path)
    frames = as_tensor("frames", frames)
    if not frames.dtype.is_floating_point:
        raise TypeError(f"frames must be a floating-point tensor whose full scale is 1, got {frames.dtype}")
    full_scale = check_stack_target(path, tuple(frames.shape), dtype=dtype, full_scale=full_scale)
    pixels = frames_to_counts(frames, np.dtype(dtype or np.float32), full_scale)
    info = StackInfo(tuple(pixels.shape), pixels.dtype.name, full_scale)
    if like is not None:
        times = like.frame_times if like.shape[0] == info.shape[0] and not like.times_of_playback else None
        info = replace(info, frame_times=times, resolution=like.resolution, channels_last=like.channels_last)
    form = check_info_target(path, info, compression)
    with workplace(path) as work:
        part = work / path.name
        if form.create is None or (compression is not None and form.write_all is not None):
            assert form.write_all is not None
            form.write_all(part, info, iter(pixels), compression)
        else:
            writer = form.create(part, info, True)
            try:
                for index, frame in enumerate(pixels):
                    writer.write(index, frame)
            finally:
                writer.close()
        if form.kind == "folder":
            path.parent.mkdir(parents=True, exist_ok=True)
        place(part, path, form.kind, form.companions)
