"""Stacks in TIFF and BigTIFF files, also compressed."""

import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from rsvib_torch.io.contiguous import ContiguousReader, ContiguousWriter
from rsvib_torch.io.formats import FrameReader, StackFormat
from rsvib_torch.io.full_scale import check_dtype, known_full_scale
from rsvib_torch.io.stack_info import FrameError, StackInfo, readable_frame, readable_stack
from rsvib_torch.io.time_metadata import orientation_of, tiff_times

__all__ = ["FORMAT", "open_tiff", "write_tiff"]


def _check_page_chain(path: Path) -> None:
    """Raise a ``ValueError`` if the chain of page headers leaves the file, as in a truncated file, or is circular."""
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
        visited: set[int] = set()
        while offset:
            if offset in visited:
                raise ValueError("its chain of pages runs in a circle")
            visited.add(offset)
            file.seek(min(offset, size))
            field = file.read(struct.calcsize(count_format))
            count = struct.unpack(count_format, field)[0] if len(field) == struct.calcsize(count_format) else size
            following = offset + len(field) + entry * count
            file.seek(min(following, size))
            field = file.read(struct.calcsize(offset_format))
            if len(field) < struct.calcsize(offset_format):
                raise ValueError(f"truncated: the header of page {len(visited) - 1} lies beyond the end of the file")
            (offset,) = struct.unpack(offset_format, field)
    if not visited:
        raise ValueError("it contains no page")


def _complete_pages(tif: Any, size: int) -> list[bool]:
    """Whether the pixels of each page lie within the file of ``size`` bytes.

    Raises:
        ValueError: If the file cannot hold that many pixels, or more than half of the pages are incomplete.
    """
    declared, complete = 0, []
    for page in tif.pages:
        declared += int(page.nbytes)
        ends = (offset + count for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True))
        complete.append(max(ends, default=size + 1) <= size)
    largest_ratio = 5000  # of pixels to the size of the file; deflate reaches 1032
    if declared > largest_ratio * size:
        raise ValueError(f"its header states {declared} bytes of pixels, which {size} bytes cannot hold")
    if sum(complete) < 0.5 * len(complete):
        raise ValueError(f"truncated: pixels of page {complete.index(False)} lie beyond the end of the file")
    return complete


def _resolution(tif: Any) -> tuple[float, float, str] | None:
    """Pixels per unit, if the unit is one of length."""
    tags = tif.pages[0].tags
    unit = {2: "inch", 3: "centimeter"}.get(int(tags["ResolutionUnit"].value) if "ResolutionUnit" in tags else 0)
    if unit is None or "XResolution" not in tags or "YResolution" not in tags:
        return None
    (x, per_x), (y, per_y) = tags["XResolution"].value, tags["YResolution"].value
    return (x / per_x, y / per_y, unit) if min(x, per_x, y, per_y) > 0 else None


def _read_info(tif: Any) -> tuple[StackInfo, tuple[int, ...]]:
    """The stack, and the permutation of the stored axes into (ones, T, C, H, W)."""
    if len(tif.series) != 1:
        kinds = ", ".join(f"{tuple(series.keyframe.shape)} {series.dtype}" for series in tif.series)
        raise ValueError(f"frames of different size or kind: {kinds}")
    series = tif.series[0]
    photometric = series.keyframe.photometric
    if photometric not in (tifffile.PHOTOMETRIC.MINISBLACK, tifffile.PHOTOMETRIC.RGB):
        raise ValueError(f"pixels are {getattr(photometric, 'name', photometric)}; expected grey (black is 0) or RGB")
    check_dtype(series.dtype)
    axes, shape = series.get_axes(squeeze=False), series.get_shape(squeeze=False)
    rows, columns = axes.index("Y"), axes.index("X")
    channels = [i for i, axis in enumerate(axes) if axis in "SC" and shape[i] > 1]
    times = [i for i in range(len(axes)) if i not in (rows, columns, *channels) and shape[i] > 1]
    if len(channels) > 1 or len(times) > 1:
        raise ValueError(f"axes {axes} of sizes {tuple(shape)}; expected one axis of frames and one of channels")
    kept = (*times, *channels, rows, columns)
    ones = tuple(i for i in range(len(axes)) if i not in kept)
    stack = tuple(shape[i] for i in kept)
    # the JSON description that this package writes
    metadata = next((table for table in tif.shaped_metadata or () if isinstance(table, dict)), {})
    bits = tif.pages[0].bitspersample
    full_scale = None
    if "full_scale" in metadata:
        full_scale = float(metadata["full_scale"])
    elif isinstance(bits, int) and bits not in (8, 16, 32, 64) and tif.pages[0].dtype.kind == "u":
        full_scale = float(2**bits - 1)  # packed pixels, e.g. 4095 for 12 bits
    info = StackInfo(
        stack if times else (1, *stack),
        series.dtype.name,
        known_full_scale(series.dtype, full_scale),
        resolution=_resolution(tif),
        channels_last=bool(channels) and channels[0] > columns,
        orientation=orientation_of(tif.pages[0].tags.valueof("Orientation")),
        **tiff_times(tif, stack[0] if times else 1, metadata),
    )
    return info, (*ones, *kept)


class _ArrayReader(FrameReader):
    """Frames of an array in memory."""

    def __init__(self, info: StackInfo, pixels: NDArray[Any]) -> None:
        self.info, self._pixels = info, pixels

    def frame(self, index: int) -> NDArray[Any]:
        """Pixels of a frame as stored."""
        return np.array(self._pixels[index])


class _PageReader:
    """Frames decoded page by page; arguments as from ``_read_info`` and ``_complete_pages``.

    Raises:
        ValueError: If a frame is not a sequence of pages.
    """

    def __init__(self, path: Path, tif: Any, info: StackInfo, order: tuple[int, ...], complete: list[bool]) -> None:
        self.info = info
        self._path, self._tif, self._order, self._complete = path, tif, order, complete
        series, T = tif.series[0], info.shape[0]
        shape = series.get_shape(squeeze=False)
        self._pages, rest = divmod(len(series.pages), T)
        time = order[len(order) - len(info.shape)] if T > 1 else None
        if rest or self._pages < 1 or (time is not None and any(size > 1 for size in shape[:time])):
            raise ValueError("its pages are not in the order of the frames")
        self._frame_shape = tuple(1 if i == time else size for i, size in enumerate(shape))

    def frame(self, index: int) -> NDArray[Any]:
        """Pixels of a frame as stored."""
        numbers = range(index * self._pages, (index + 1) * self._pages)
        if not all(self._complete[number] for number in numbers):
            raise FrameError(f"{self._path}: truncated: pixels of frame {index} lie beyond the end of the file")
        with readable_frame(self._path, index):
            pages = [self._tif.series[0].pages[number].asarray(maxworkers=1) for number in numbers]
            stored = np.stack(pages).reshape(self._frame_shape).transpose(self._order)
            return np.ascontiguousarray(stored.reshape(self.info.shape[1:]))

    def close(self) -> None:
        """Close the file."""
        self._tif.close()


def open_tiff(path: Path) -> FrameReader:
    """Open a TIFF file of one or many pages."""
    with readable_stack(path, "TIFF"):
        _check_page_chain(path)
        tif = tifffile.TiffFile(path)
        reader: FrameReader | None = None
        try:
            tif.pages.useframes = len(tif.pages) > 1
            info, order = _read_info(tif)
            series = tif.series[0]
            in_order = tuple(sorted(order))
            frame_by_frame = order == in_order or (
                info.channels_last and (*order[:-3], *order[-2:], order[-3]) == in_order
            )
            if series.dataoffset is not None and frame_by_frame:
                return ContiguousReader(path, info, series.dataoffset, series.dtype.newbyteorder(tif.byteorder))
            complete = _complete_pages(tif, path.stat().st_size)
            try:
                reader = _PageReader(path, tif, info, order, complete)
            except ValueError:
                if not all(complete):
                    raise
                pixels: NDArray[Any] = series.asarray(squeeze=False, maxworkers=1)
                return _ArrayReader(info, pixels.transpose(order).reshape(info.shape))
            return reader
        finally:
            if reader is None:
                tif.close()


def _layout(info: StackInfo) -> tuple[StackInfo, dict[str, Any]]:
    """The stack as it is stored, and options of ``tifffile.imwrite``: three or four channels are stored last (RGB)."""
    colour = info.axes == "TCHW" and info.shape[1] in (3, 4)
    stored = replace(info, channels_last=colour)
    axes = "TYX" if info.axes == "THW" else "TYXS" if colour else "TSYX" if info.shape[1] > 1 else "TCYX"
    metadata: dict[str, object] = {"axes": axes}
    if info.full_scale is not None:
        metadata["full_scale"] = info.full_scale
    if info.frame_times is not None:
        metadata["frame_times"] = list(info.frame_times)
    elif info.frame_rate is not None:
        metadata["frame_rate"] = info.frame_rate
    options: dict[str, Any] = {"photometric": "rgb" if colour else "minisblack", "metadata": metadata}
    if axes == "TSYX":
        options["planarconfig"] = "separate"
    if info.orientation != 1:
        options["extratags"] = [("Orientation", "H", 1, info.orientation, True)]
    if info.resolution is not None:
        options["resolution"] = info.resolution[:2]
        options["resolutionunit"] = info.resolution[2].upper()
    return stored, {"shape": stored.stored_shape, "dtype": info.dtype, **options}


def _create(path: Path, info: StackInfo, fresh: bool) -> ContiguousWriter:
    stored, options = _layout(info)
    if fresh:
        tifffile.imwrite(path, data=None, **options)
    with tifffile.TiffFile(path) as tif:
        offset = int(tif.series[0].dataoffset or 0)
    return ContiguousWriter(path, stored, offset, reserve=fresh)


def write_tiff(path: Path, info: StackInfo, frames: Iterator[NDArray[Any]], compression: str | None) -> None:
    """Write a TIFF file frame by frame; arguments as in ``StackFormat.write_all``."""
    stored, options = _layout(info)
    pages = (stored.to_stored(frame) for frame in frames)
    if stored.stored_axes == "TCHW":
        pages = (plane for frame in pages for plane in frame)
    tifffile.imwrite(path, data=pages, compression=compression, maxworkers=1, **options)


FORMAT = StackFormat("tiff", (".tif", ".tiff"), open_tiff, _create, write_tiff, compressions=("zlib", "lzma"))
