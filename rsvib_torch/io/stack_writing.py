"""Writing of stacks of frames, and checks of the file before frames are computed."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from rsvib_torch.checks.arguments import Channels, FramesLike, PathLike, as_tensor, channel_axis, checks_arguments
from rsvib_torch.files.atomic import check_outputs, check_target, whole
from rsvib_torch.frames.full_scale import check_dtype, frames_to_counts, known_full_scale, required_full_scale
from rsvib_torch.io.formats import FORMATS, StackFormat, target_format
from rsvib_torch.io.stack_info import DIFFERENT, StackInfo, split_range
from rsvib_torch.numerics.tables import Array
from rsvib_torch.text import quoted


def stack_files(path: PathLike) -> list[Path]:
    """The file or folder of a stack, or of frames of it, for ``check_outputs``."""
    return [split_range(Path(path))[0]]


def check_info_target(path: Path, info: StackInfo, *, parent_exists: bool = True) -> StackFormat:
    """The format in which ``path`` is written, or the error of writing; ``parent_exists`` as in ``check_target``."""
    form = target_format(path)
    check_target(path, form.kind, parent_exists=parent_exists)
    if info.dtype not in form.dtypes:
        raise ValueError(f"{path}: {form.name} files hold {', '.join(form.dtypes)}; got dtype {info.dtype}")
    if form.check is not None:
        form.check(path, info)
    if info.is_integer:
        required_full_scale(info.full_scale, np.dtype(info.dtype), path)
    return form


def _planned(shape: tuple[int, ...], dtype: str | None, full_scale: float | None, like: StackInfo | None) -> StackInfo:
    """A stack to write, with what ``like`` states except times that are not exact."""
    if len(shape) not in (3, 4) or min(shape) < 1:
        raise ValueError(f"frames must have shape (T, H, W) or (T, C, H, W), got {tuple(shape)}")
    try:
        kind = np.dtype(dtype or np.float32)
    except TypeError:
        raise TypeError(f"dtype must be a data type of NumPy such as 'uint16', got {quoted(dtype)}") from None
    full_scale = known_full_scale(kind) if kind.kind == "f" or full_scale is None else full_scale
    info = StackInfo(tuple(shape), kind.name, full_scale)
    if like is None:
        return info
    kept = like.with_shape(info.shape)
    times = None if kept.time_error else kept.frame_times
    return replace(kept, dtype=info.dtype, full_scale=full_scale, frame_times=times, time_error=0.0)


def metadata_not_kept(like: StackInfo, path: PathLike, shape: tuple[int, ...]) -> tuple[str, ...]:
    """What a file states about its frames and the file ``path`` with the restored frames will not state.

    ``shape`` is that of the restored frames. The result has names of tags, ``"full scale"``, ``"orientation"`` and
    ``"frame times"``.

    Example:
        >>> info = StackInfo((8, 1024, 1024), "uint16", 4095.0, orientation=6)
        >>> metadata_not_kept(info, "restored.npy", (8, 1024, 1024))
        ('full scale', 'orientation')
        >>> metadata_not_kept(info, "restored.tif", (8, 1024, 1024))
        ()
    """
    form, kept = target_format(Path(path)), like.with_shape(shape)
    in_files = form.kind == "folder" and kept.files is not None  # TIFF files like those of the input
    keeps = FORMATS[".tif"].keeps if in_files else form.keeps
    stated = like.full_scale not in (None, known_full_scale(np.dtype(like.dtype)))
    lost = [name for name, tag in kept.metadata.items() if tag is None or "metadata" not in keeps]
    if in_files and shape[-2:] == like.shape[-2:]:  # otherwise a georeference is lost
        lost = [name for name in lost if not name.endswith(DIFFERENT)]
    timed = like.frame_times is not None and not like.time_error
    others = {"full_scale": stated, "orientation": like.orientation != 1, "frame_times": timed}
    here = [name for name in keeps if getattr(kept, name) is not None]  # other numbers of frames have other times
    return (*lost, *(name.replace("_", " ") for name, has in others.items() if has and name not in here))


def write_frames(form: StackFormat, path: Path, info: StackInfo, frames: Iterable[Array]) -> None:
    """Write a stack from its frames as stored; it gets its name when it is complete and on the disk."""
    assert form.write is not None
    with whole(path, form.kind, parent_exists=False) as part:
        form.write(part, info, iter(frames))


@checks_arguments
def write_stack(
    path: PathLike,
    frames: FramesLike,
    *,
    channels: Channels = None,
    dtype: str | None = None,
    full_scale: float | None = None,
    like: StackInfo | None = None,
) -> None:
    """Write a stack of frames: floats whose full scale is 1, or integer counts.

    The ending selects the format as in ``read_stack``; videos are written as FFV1 (``.mkv``; without loss) or
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
        like: The stack from which the frames were computed: its metadata, and of as many frames their times, are
            stored as far as the format supports them (``metadata_not_kept``), and NaN as its nodata value. Between
            videos, the presentation times of the frames and the audio are copied. Its file must not be ``path``. A
            video without times has 25 frames per second: ``like=StackInfo(..., frame_rate=rate)`` states another rate.

    Raises:
        OSError: If the file cannot be written.
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
        full_scale = required_full_scale(full_scale, stored, "frames")
        dtype = dtype or stored.name
        frames = frames.to(torch.float64) / full_scale  # exact for integers of 32 bits
    axis = channel_axis("frames", frames.shape, channels)
    frames = frames.movedim(axis, -3) if frames.ndim > 3 else frames
    info = _planned(tuple(frames.shape), dtype, full_scale, like)
    form = check_info_target(path, info)
    nodata = None if like is None or dtype != like.dtype else like.nodata
    pixels = frames_to_counts(frames, np.dtype(info.dtype), info.full_scale, nodata)
    write_frames(form, path, info, pixels)
