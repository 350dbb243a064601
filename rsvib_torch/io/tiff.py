"""Stacks in TIFF and BigTIFF files, also compressed."""

import math
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from rsvib_torch.io.contiguous import ContiguousReader, ContiguousWriter
from rsvib_torch.io.formats import FrameReader, StackFormat
from rsvib_torch.io.full_scale import check_dtype, known_full_scale
from rsvib_torch.io.stack_info import FrameError, StackInfo, readable_frame, readable_stack
from rsvib_torch.io.tiff_metadata import json_description, read_metadata, writer_options
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


@dataclass(frozen=True)
class _Page:
    """What the header of a page states.

    Attributes:
        number: Its number in the file.
        shape: (H, W) or (C, H, W).
        dtype: Data type.
        photometric: Meaning of the values.
        extent: As from ``_extent``.
        secondary: Whether it is a thumbnail or a mask of another page.
    """

    number: int
    shape: tuple[int, ...]
    dtype: Any
    photometric: Any
    extent: tuple[int, bool]
    secondary: bool

    @property
    def kind(self) -> str:
        """Size and type of the pixels, for messages and comparisons."""
        channels = f", {self.shape[0]} channels," if len(self.shape) == 3 else ""
        meaning = "" if self.photometric in _PHOTOMETRIC else f" {_name(self.photometric)}"
        return f"{self.shape[-2]} x {self.shape[-1]} px{channels} {self.dtype}{meaning}"


_PHOTOMETRIC = (tifffile.PHOTOMETRIC.MINISBLACK, tifffile.PHOTOMETRIC.RGB)


def _name(photometric: Any) -> str:
    return getattr(photometric, "name", str(photometric))


def _with_channels_first(values: Any, axes: str) -> Any:
    """Pixels, or the shape, of a page with channels before the image axes."""
    if axes != "YXS":
        return values
    return (values[2], *values[:2]) if isinstance(values, tuple) else np.moveaxis(values, -1, 0)


def _read_page(tif: Any, number: int, size: int) -> _Page:
    """Read the header of a page of a file of ``size`` bytes."""
    page = tif.pages[number]
    if page.axes not in ("YX", "YXS", "SYX"):
        raise ValueError(f"page {number} has shape {page.shape} (axes {page.axes}); expected an image")
    shape = _with_channels_first(page.shape, page.axes)
    secondary = bool(page.subfiletype & 0b101)
    return _Page(number, shape, page.dtype, page.photometric, _extent(page, size), secondary)


def _extent(page: Any, size: int) -> tuple[int, bool]:
    """Bytes of the decoded pixels of a page, and whether the stored ones lie within the file of ``size`` bytes."""
    ends = (offset + count for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True))
    return int(page.nbytes), max(ends, default=size + 1) <= size


def _complete_pages(extents: Sequence[tuple[int, bool]], size: int) -> list[bool]:
    """Whether the pixels of each page lie within the file of ``size`` bytes.

    Args:
        extents: Of all pages, as from ``_extent``.
        size: Bytes of the file.

    Raises:
        ValueError: If the file cannot hold that many pixels, or more than half of the pages are incomplete.
    """
    declared, complete = sum(nbytes for nbytes, _ in extents), [whole for _, whole in extents]
    largest_ratio = 5000  # of pixels to the size of the file; deflate reaches 1032
    if declared > largest_ratio * size:
        raise ValueError(f"its header states {declared} bytes of pixels, which {size} bytes cannot hold")
    if sum(complete) < 0.5 * len(complete):
        raise ValueError(f"truncated: pixels of page {complete.index(False)} lie beyond the end of the file")
    return complete


def _resolution(tif: Any) -> tuple[float, float, str] | None:
    """Pixels per unit, if the unit is one of length."""
    tags = tif.pages.first.tags
    unit = {2: "inch", 3: "centimeter"}.get(int(tags["ResolutionUnit"].value) if "ResolutionUnit" in tags else 0)
    if unit is None or "XResolution" not in tags or "YResolution" not in tags:
        return None
    (x, per_x), (y, per_y) = tags["XResolution"].value, tags["YResolution"].value
    return (x / per_x, y / per_y, unit) if min(x, per_x, y, per_y) > 0 else None


def _info(
    tif: Any, shape: tuple[int, ...], dtype: np.dtype[Any], photometric: Any, *, channels_last: bool
) -> StackInfo:
    """A stack of that shape, with what the first page states.

    Raises:
        ValueError: If the kind of its pixels is not supported.
    """
    if photometric not in _PHOTOMETRIC:
        raise ValueError(f"pixels are {_name(photometric)}; expected grey (black is 0) or RGB")
    check_dtype(dtype)
    metadata = json_description(tif)
    bits = tif.pages.first.bitspersample
    full_scale = None
    if "full_scale" in metadata:
        full_scale = float(metadata["full_scale"])
    elif isinstance(bits, int) and bits not in (8, 16, 32, 64) and dtype.kind == "u":
        full_scale = float(2**bits - 1)  # packed pixels, e.g. 4095 for 12 bits
    info = StackInfo(
        shape,
        dtype.name,
        known_full_scale(dtype, full_scale),
        resolution=_resolution(tif),
        channels_last=channels_last,
        orientation=orientation_of(tif.pages.first.tags.valueof("Orientation")),
        **tiff_times(tif, shape[0], metadata),
    )
    return replace(info, metadata=read_metadata(tif, info))


def _series_info(tif: Any, series: Any) -> tuple[StackInfo, tuple[int, ...]]:
    """The stack in a series of pages, and the permutation of the stored axes into (ones, T, C, H, W)."""
    axes, shape = series.get_axes(squeeze=False), series.get_shape(squeeze=False)
    rows, columns = axes.index("Y"), axes.index("X")
    channels = [i for i, axis in enumerate(axes) if axis in "SC" and shape[i] > 1]
    times = [i for i in range(len(axes)) if i not in (rows, columns, *channels) and shape[i] > 1]
    if len(channels) > 1 or len(times) > 1:
        raise ValueError(f"axes {axes} of sizes {tuple(shape)}; expected one axis of frames and one of channels")
    kept = (*times, *channels, rows, columns)
    ones = tuple(i for i in range(len(axes)) if i not in kept)
    stack = tuple(shape[i] for i in kept)
    last = bool(channels) and channels[0] > columns
    stack = stack if times else (1, *stack)
    return _info(tif, stack, series.dtype, series.keyframe.photometric, channels_last=last), (*ones, *kept)


class _ArrayReader(FrameReader):
    """Frames of an array in memory."""

    def __init__(self, info: StackInfo, pixels: NDArray[Any]) -> None:
        self.info, self._pixels = info, pixels

    def frame(self, index: int) -> NDArray[Any]:
        """Pixels of a frame as stored."""
        return np.array(self._pixels[index])


class _SeriesReader:
    """Frames decoded page by page; arguments as from ``_series_info`` and ``_complete_pages``.

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


class _PageReader:
    """Frames of a file in which every page is a frame, thumbnails and masks excepted.

    Raises:
        ValueError: If the pages differ in size or kind.
    """

    def __init__(self, path: Path, tif: Any) -> None:
        size = path.stat().st_size
        pages = [_read_page(tif, number, size) for number in range(len(tif.pages))]
        pages = [page for page in pages if not page.secondary] or pages
        first = pages[0]
        for page in pages:
            if page.kind != first.kind:
                raise ValueError(
                    f"frames of different size or kind: page {page.number} is {page.kind}, page {first.number} is "
                    f"{first.kind}"
                )
        self._path, self._tif, self._numbers = path, tif, [page.number for page in pages]
        self._complete = _complete_pages([page.extent for page in pages], size)
        last = tif.pages[first.number].axes == "YXS"
        info = _info(tif, (len(pages), *first.shape), first.dtype, first.photometric, channels_last=last)
        lost = {"thumbnails and masks": None} if len(pages) < len(tif.pages) else {}
        self.info = replace(info, metadata={**info.metadata, **lost})

    def frame(self, index: int) -> NDArray[Any]:
        """Pixels of a frame as stored."""
        if not self._complete[index]:
            raise FrameError(f"{self._path}: truncated: pixels of frame {index} lie beyond the end of the file")
        with readable_frame(self._path, index):
            page = self._tif.pages[self._numbers[index]]
            return np.ascontiguousarray(_with_channels_first(page.asarray(maxworkers=1), page.axes))

    def close(self) -> None:
        """Close the file."""
        self._tif.close()


def _check_one_page_per_frame(shape: tuple[int, ...], axes: str, pages: int) -> None:
    """Raise a ``ValueError`` if an array of several pages, one of several in a file, has other axes than frames."""
    if pages > 1 and (shape[0] != pages or axes[:1] in ("C", "S")):
        raise ValueError(
            f"it contains several arrays, of which the first has shape {tuple(shape)} (axes {axes or 'unknown'}); "
            "expected one array, or one frame per page"
        )


def _series_of_all_frames(tif: Any) -> Any | None:
    """The series of pages in which the file arranges all its frames; None if every page is a frame.

    Raises:
        ValueError: If there are several series of another arrangement.
    """
    metadata = json_description(tif)
    if "shape" in metadata:  # series of pages that were written one by one would take quadratic time
        shape = tuple(metadata["shape"])
        pages = math.prod(shape) // math.prod(tif.pages.first.shape)
        if pages < len(tif.pages):
            _check_one_page_per_frame(shape, metadata.get("axes", ""), pages)
            return None
    tif.pages.useframes = len(tif.pages) > 1
    try:
        series = tif.series
    except RuntimeError:  # pages differ
        return None
    if len(series) == 1 and series[0].kind not in ("uniform", "generic"):
        return series[0]
    for one in series:
        _check_one_page_per_frame(one.shape, one.axes, len(one.pages))
    return None


def open_tiff(path: Path) -> FrameReader:
    """Open a TIFF file of one or many pages."""
    with readable_stack(path, "TIFF"):
        _check_page_chain(path)
        tif = tifffile.TiffFile(path)
        reader: FrameReader | None = None
        try:
            series = _series_of_all_frames(tif)
            if series is None:
                tif.pages.useframes = False
                reader = _PageReader(path, tif)
                return reader
            info, order = _series_info(tif, series)
            in_order = tuple(sorted(order))
            frame_by_frame = order == in_order or (
                info.channels_last and (*order[:-3], *order[-2:], order[-3]) == in_order
            )
            if series.dataoffset is not None and frame_by_frame:
                return ContiguousReader(path, info, series.dataoffset, series.dtype.newbyteorder(tif.byteorder))
            size = path.stat().st_size
            complete = _complete_pages([_extent(page, size) for page in tif.pages], size)
            try:
                reader = _SeriesReader(path, tif, info, order, complete)
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
    description: dict[str, object] = {"axes": axes}
    if info.full_scale is not None:
        description["full_scale"] = info.full_scale
    if info.frame_times is not None:
        description["frame_times"] = list(info.frame_times)
    elif info.frame_rate is not None:
        description["frame_rate"] = info.frame_rate
    options = {"photometric": "rgb" if colour else "minisblack", **writer_options(info, description)}
    if axes == "TSYX":
        options["planarconfig"] = "separate"
    if info.orientation != 1:
        options["extratags"].append(("Orientation", "H", 1, info.orientation, False))
    if info.resolution is not None:
        options["resolution"] = info.resolution[:2]
        options["resolutionunit"] = info.resolution[2].upper()
    return stored, {"shape": stored.stored_shape, "dtype": info.dtype, **options}


def _create(path: Path, info: StackInfo, fresh: bool) -> ContiguousWriter:
    stored, options = _layout(info)
    if fresh:
        tifffile.imwrite(path, data=None, **options)
    with tifffile.TiffFile(path) as tif:
        offset = int(tif.pages.first.dataoffsets[0])
    return ContiguousWriter(path, stored, offset, fresh=fresh)


def write_tiff(path: Path, info: StackInfo, frames: Iterator[NDArray[Any]], compression: str | None) -> None:
    """Write a TIFF file frame by frame; arguments as in ``StackFormat.write_all``."""
    stored, options = _layout(info)
    pages = (stored.to_stored(frame) for frame in frames)
    if stored.stored_axes == "TCHW":
        pages = (plane for frame in pages for plane in frame)
    tifffile.imwrite(path, data=pages, compression=compression, maxworkers=1, **options)


FORMAT = StackFormat(
    "tiff",
    (".tif", ".tiff"),
    open_tiff,
    _create,
    write_tiff,
    compressions=("zlib", "lzma"),
    keeps=("full_scale", "frame_times", "orientation", "resolution", "metadata"),
)
