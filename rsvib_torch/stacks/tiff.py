"""Stacks in TIFF files."""

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from rsvib_torch.stacks.info import StackInfo
from rsvib_torch.stacks.scale import check_dtype, known_full_scale

__all__ = ["read_tiff", "read_tiff_info", "write_tiff"]

_CHANNEL_AXES = "SC"
_LARGEST_RATIO = 5000  # pixel bytes per file byte; no lossless coder of images packs tighter


def _check_page_chain(path: Path) -> None:
    """Follow the chain of page headers to its end: a chain that leaves the file is a truncated file."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(16)
        order = {b"II": "<", b"MM": ">"}.get(head[:2])
        version = struct.unpack(f"{order}H", head[2:4])[0] if order and len(head) >= 8 else 0
        if version not in (42, 43) or (version == 43 and len(head) < 16):
            raise ValueError("not a TIFF file" if size else "the file is empty")
        big = version == 43
        offset_format, count_format, entry = (f"{order}Q", f"{order}Q", 20) if big else (f"{order}I", f"{order}H", 12)
        (offset,) = struct.unpack(offset_format, head[8:16] if big else head[4:8])
        seen: set[int] = set()
        while offset:
            if offset in seen:
                raise ValueError("its chain of pages runs in a circle")
            seen.add(offset)
            file.seek(offset)
            field = file.read(struct.calcsize(count_format))
            count = struct.unpack(count_format, field)[0] if len(field) == struct.calcsize(count_format) else size
            following = offset + len(field) + entry * count
            file.seek(min(following, size))
            field = file.read(struct.calcsize(offset_format))
            if len(field) < struct.calcsize(offset_format):
                raise ValueError(f"truncated: the header of page {len(seen) - 1} lies beyond the end of the file")
            (offset,) = struct.unpack(offset_format, field)
    if not seen:
        raise ValueError("it holds no page")


def _check_pixels_present(tif: Any, size: int) -> None:
    """Raise a ``ValueError`` if any page's pixels lie beyond the end of the file or cannot be that many."""
    declared = 0
    for index, page in enumerate(tif.pages):
        declared += int(page.nbytes)
        ends = (offset + count for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True))
        if max(ends, default=size + 1) > size:
            raise ValueError(f"truncated: pixels of page {index} lie beyond the end of the file")
    if declared > _LARGEST_RATIO * size:
        raise ValueError(f"its header promises {declared} bytes of pixels, which {size} bytes cannot hold")


def _stated_full_scale(tif: Any) -> float | None:
    """Full scale written by ``write_tiff``, or that of packed pixels (12 bits a pixel: 4095)."""
    for metadata in tif.shaped_metadata or ():
        if "full_scale" in metadata:
            return float(metadata["full_scale"])
    bits = tif.pages[0].bitspersample
    if isinstance(bits, int) and bits not in (8, 16, 32, 64) and tif.pages[0].dtype.kind == "u":
        return float(2**bits - 1)
    return None


def _layout(tif: Any) -> tuple[tuple[int, ...], tuple[int, ...], np.dtype[Any]]:
    """Stack shape, the order of the stored axes that gives it, and dtype."""
    if len(tif.series) != 1:
        kinds = ", ".join(f"{tuple(series.keyframe.shape)} {series.dtype}" for series in tif.series)
        raise ValueError(f"frames of different size or kind: {kinds}")
    series = tif.series[0]
    photometric = series.keyframe.photometric
    if photometric not in (tifffile.PHOTOMETRIC.MINISBLACK, tifffile.PHOTOMETRIC.RGB):
        raise ValueError(f"pixels are {getattr(photometric, 'name', photometric)}; expected grey (black is 0) or RGB")
    axes, shape = series.get_axes(squeeze=False), series.get_shape(squeeze=False)
    rows, columns = axes.index("Y"), axes.index("X")
    channels = [i for i, axis in enumerate(axes) if axis in _CHANNEL_AXES and shape[i] > 1]
    times = [i for i in range(len(axes)) if i not in (rows, columns, *channels) and shape[i] > 1]
    if len(channels) > 1 or len(times) > 1:
        raise ValueError(f"axes {axes} of sizes {tuple(shape)}; expected one axis of frames and one of channels")
    kept = (*times, *channels, rows, columns)
    ones = tuple(i for i in range(len(axes)) if i not in kept)
    stack = tuple(shape[i] for i in kept)
    return (stack if times else (1, *stack)), (*ones, *kept), series.dtype


def _info(tif: Any) -> tuple[StackInfo, tuple[int, ...]]:
    shape, order, dtype = _layout(tif)
    check_dtype(dtype)
    _check_pixels_present(tif, tif.filehandle.size)
    return StackInfo(shape, dtype.name, known_full_scale(dtype, _stated_full_scale(tif))), order


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The open file; whatever a damaged file makes the decoder raise becomes one ``ValueError`` that names it."""
    with path.open("rb"):
        pass  # a file that may not be read is an OSError of its own
    try:
        _check_page_chain(path)
        with tifffile.TiffFile(path) as tif:
            yield tif
    except MemoryError:
        raise
    except Exception as error:
        raise ValueError(f"{path}: not a readable TIFF stack: {' '.join(str(error).split())}") from error


def read_tiff_info(path: Path) -> StackInfo:
    """What the headers of a TIFF file say."""
    with _opened(path) as tif:
        return _info(tif)[0]


def read_tiff(path: Path) -> tuple[NDArray[Any], StackInfo]:
    """Pixels as stored, (T, H, W) or (T, C, H, W)."""
    with _opened(path) as tif:
        info, order = _info(tif)
        stored: NDArray[Any] = tif.series[0].asarray(squeeze=False)
        return stored.transpose(order).reshape(info.shape), info


def write_tiff(path: Path, pixels: NDArray[Any], full_scale: float | None) -> None:
    """Write one page a frame; the full scale goes into the JSON of the image description."""
    axes, layout = "TYX", dict[str, Any](photometric="minisblack")
    if pixels.ndim == 4 and pixels.shape[1] in (3, 4):
        pixels, axes, layout = np.moveaxis(pixels, 1, -1), "TYXS", {"photometric": "rgb"}
    elif pixels.ndim == 4:
        axes, layout = "TSYX", {"photometric": "minisblack", "planarconfig": "separate"}
    metadata: dict[str, object] = {"axes": axes}
    if full_scale is not None:
        metadata["full_scale"] = full_scale
    tifffile.imwrite(path, np.ascontiguousarray(pixels), metadata=metadata, **layout)
