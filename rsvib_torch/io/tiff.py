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

from rsvib_torch.io.blocks import BlockReader
from rsvib_torch.io.contiguous import ContiguousReader, InterleavedReader
from rsvib_torch.io.full_scale import check_dtype, known_full_scale
from rsvib_torch.io.stack_format import FrameReader
from rsvib_torch.io.stack_info import FrameError, StackInfo, readable_frame, readable_stack
from rsvib_torch.io.tiff_metadata import json_description, read_metadata, writer_options
from rsvib_torch.io.time_metadata import orientation_of, tiff_times

# Tags on which the decoded pixels of a page depend, besides their position: subfile type, width, length, bits,
# compression, photometric interpretation, fill order, samples, rows per strip, planar configuration, predictor, tile
# size, extra samples, sample format, image depth, tile depth
_LAYOUT = {254, 255, 256, 257, 258, 259, 262, 266, 277, 278, 284, 317, 322, 323, 338, 339, 32997, 32998}
_POSITIONS = {273: "offsets", 324: "offsets", 279: "counts", 325: "counts"}
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
_MAX_LAYOUTS = 1000  # of pages in a file; tifffile interprets each once, in about 1 ms


@dataclass(frozen=True)
class _Header:
    """What is compared of the header of a page: tifffile needs about 1 ms to interpret one, which is too long for all.

    Attributes:
        layout: Stored values of all tags on which the decoded pixels depend; equal for pages of the same kind.
        end: Position behind the stored pixels in bytes; None if it does not follow from the header.
    """

    layout: bytes
    end: int | None


class _Headers:
    """Reads the headers of all pages, in time and memory linear in the size of the file."""

    def __init__(self, path: Path) -> None:
        self._size = path.stat().st_size
        with path.open("rb") as self._file:
            head = self._bytes(0, 16)
            self._order = {b"II": "<", b"MM": ">"}.get(head[:2], "")
            version = struct.unpack(f"{self._order}H", head[2:4])[0] if self._order and len(head) >= 8 else 0
            if version not in (42, 43) or (version == 43 and len(head) < 16):
                raise ValueError("not a TIFF file" if self._size else "the file is empty")
            self._word = "Q" if version == 43 else "I"
            self.pages = list(self._chain(self._number(self._word, head[8:16] if version == 43 else head[4:8])))
        if not self.pages:
            raise ValueError("it contains no page")

    def _bytes(self, start: int, count: int) -> bytes:
        self._file.seek(min(start, self._size))
        return self._file.read(min(count, self._size))

    def _number(self, kind: str, data: bytes) -> int:
        return int(struct.unpack(f"{self._order}{kind}", data)[0])

    def _chain(self, offset: int) -> Iterator[_Header]:
        """Headers of the pages from ``offset`` on.

        Raises:
            ValueError: If the chain leaves the file, as in a truncated file, or is circular.
        """
        visited: set[int] = set()
        layouts: dict[bytes, bytes] = {}
        count_kind, entry = ("Q", 20) if self._word == "Q" else ("H", 12)
        word, count_size = struct.calcsize(self._word), struct.calcsize(count_kind)
        while offset:
            if offset in visited:
                raise ValueError("its chain of pages runs in a circle")
            visited.add(offset)
            field = self._bytes(offset, count_size)
            count = self._number(count_kind, field) if len(field) == count_size else self._size
            table = self._bytes(offset + count_size, entry * count + word)
            if len(table) < entry * count + word:
                raise ValueError(f"truncated: the header of page {len(visited) - 1} lies beyond the end of the file")
            header = self._header([table[start : start + entry] for start in range(0, entry * count, entry)])
            yield _Header(layouts.setdefault(header.layout, header.layout), header.end)  # equal layouts are one object
            if len(layouts) > _MAX_LAYOUTS:
                raise ValueError(f"its pages have more than {_MAX_LAYOUTS} different layouts")
            offset = self._number(self._word, table[-word:])

    def _header(self, entries: list[bytes]) -> _Header:
        layout = []
        positions: dict[str, NDArray[Any]] = {}
        for entry in entries:
            code, kind = struct.unpack_from(f"{self._order}HH", entry)
            if code in _LAYOUT:
                values = self._values(entry, kind, 1 << 10)  # bytes; more than 100 channels are not an image
                layout.append(struct.pack("HH", code, kind) + values + b";")
            elif code in _POSITIONS and kind in (3, 4, 13, 16, 18):
                data = self._values(entry, kind, self._size)
                positions[_POSITIONS[code]] = np.frombuffer(data, f"{self._order}u{_SIZES[kind]}").astype(object)
        offsets, counts = positions.get("offsets"), positions.get("counts")
        known = offsets is not None and counts is not None and 0 < len(offsets) == len(counts)
        return _Header(b"".join(layout), int(max(offsets + counts)) if known else None)  # type: ignore[operator]

    def _values(self, entry: bytes, kind: int, most: int) -> bytes:
        """Stored values of a tag, at most ``most`` bytes."""
        word = struct.calcsize(self._word)
        size = self._number(self._word, entry[4 : 4 + word]) * _SIZES.get(kind, 1)
        field = entry[4 + word :]
        return field[:size] if size <= word else self._bytes(self._number(self._word, field), min(size, most))


@dataclass(frozen=True)
class _Page:
    """What the header of a page states.

    Attributes:
        number: Its number in the file; of pages of the same layout, that of the first.
        shape: (H, W) or (C, H, W).
        dtype: Data type.
        photometric: Meaning of the values.
        nbytes: Size of its decoded pixels in bytes.
        secondary: Whether it is a thumbnail or a mask of another page.
    """

    number: int
    shape: tuple[int, ...]
    dtype: Any
    photometric: Any
    nbytes: int
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


def _read_page(tif: Any, number: int) -> _Page:
    """Interpret the header of a page."""
    page = tif.pages[number]
    if page.axes not in ("YX", "YXS", "SYX"):
        raise ValueError(f"page {number} has shape {page.shape} (axes {page.axes}); expected an image")
    shape = _with_channels_first(page.shape, page.axes)
    secondary = bool(page.subfiletype & 0b101)
    return _Page(number, shape, page.dtype, page.photometric, int(page.nbytes), secondary)


def _complete_pages(tif: Any, headers: Sequence[_Header], numbers: Sequence[int], size: int) -> list[bool]:
    """Whether the stored pixels of pages lie within the file of ``size`` bytes.

    Args:
        tif: The open file.
        headers: Headers of all pages.
        numbers: The pages.
        size: Bytes of the file.

    Raises:
        ValueError: If the file cannot hold that many pixels, or more than half of the pages are incomplete.
    """
    decoded: dict[bytes, int] = {}  # bytes of the pixels of a page, by layout
    declared, complete = 0, []
    for number in numbers:
        header = headers[number]
        if header.layout not in decoded:
            decoded[header.layout] = int(tif.pages[number].nbytes)
        declared += decoded[header.layout]
        end = header.end
        if end is None:
            page = tif.pages[number]
            ends = (offset + count for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True))
            end = max(ends, default=size + 1)
        complete.append(end <= size)
    largest_ratio = 5000  # of pixels to the size of the file; deflate reaches 1032
    if declared > largest_ratio * size:
        raise ValueError(f"its header states {declared} bytes of pixels, which {size} bytes cannot hold")
    if sum(complete) < 0.5 * len(complete):
        raise ValueError(f"truncated: pixels of page {numbers[complete.index(False)]} lie beyond the end of the file")
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


def _all_series(tif: Any) -> Sequence[Any]:
    """The series of pages of a file, with their axes of length 1: an option from tifffile 2026.5.2 on."""
    series: Sequence[Any] = tif.series(squeeze=False) if callable(tif.series) else tif.series
    return series


def _axes_of(series: Any) -> tuple[str, tuple[int, ...]]:
    """Axes of a series and their sizes, those of length 1 included."""
    if hasattr(series, "get_axes"):  # before tifffile 2026.5.2
        return series.get_axes(squeeze=False), series.get_shape(squeeze=False)
    return series.axes, series.shape


def _series_info(tif: Any, series: Any) -> tuple[StackInfo, tuple[int, ...]]:
    """The stack in a series of pages, and the permutation of the stored axes into (ones, T, C, H, W)."""
    axes, shape = _axes_of(series)
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


class _WholeReader(BlockReader):
    """All frames of a compressed file whose pages are not in the order of the frames, decoded together."""

    def __init__(self, path: Path, tif: Any, info: StackInfo, order: tuple[int, ...]) -> None:
        super().__init__(path, info, info.shape[0], info.shape[0] * info.frame_bytes)  # a copy if axes are reordered
        self._tif, self._order = tif, order

    def read_block(self, first: int, last: int) -> NDArray[Any]:
        """All frames, (T, H, W) or (T, C, H, W)."""
        series = _all_series(self._tif)[0]
        pixels: NDArray[Any] = series.asarray(maxworkers=1).reshape(_axes_of(series)[1])
        return pixels.transpose(self._order).reshape(self.info.shape)

    def close(self) -> None:
        """Close the file."""
        self._block = None
        self._tif.close()


class _SeriesReader:
    """Frames decoded page by page; arguments as from ``_series_info`` and ``_complete_pages``.

    Raises:
        ValueError: If a frame is not a sequence of pages.
    """

    def __init__(self, path: Path, tif: Any, info: StackInfo, order: tuple[int, ...], complete: list[bool]) -> None:
        self.info = info
        self._path, self._tif, self._order, self._complete = path, tif, order, complete
        series, T = _all_series(tif)[0], info.shape[0]
        _, shape = _axes_of(series)
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
            pages = [_all_series(self._tif)[0].pages[number].asarray(maxworkers=1) for number in numbers]
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

    def __init__(self, path: Path, tif: Any, headers: Sequence[_Header]) -> None:
        kinds: dict[bytes, _Page] = {}
        for number, header in enumerate(headers):
            if header.layout not in kinds:
                kinds[header.layout] = _read_page(tif, number)
        primary = {layout for layout, page in kinds.items() if not page.secondary} or set(kinds)
        numbers = [number for number, header in enumerate(headers) if header.layout in primary]
        first = kinds[headers[numbers[0]].layout]
        for page in (kinds[layout] for layout in kinds if layout in primary):
            if page.kind != first.kind:
                raise ValueError(
                    f"frames of different size or kind: page {page.number} is {page.kind}, page {first.number} is "
                    f"{first.kind}"
                )
        self._path, self._tif, self._numbers = path, tif, numbers
        self._complete = _complete_pages(tif, headers, numbers, path.stat().st_size)
        last = tif.pages[first.number].axes == "YXS"
        info = _info(tif, (len(numbers), *first.shape), first.dtype, first.photometric, channels_last=last)
        lost = {"thumbnails and masks": None} if len(numbers) < len(headers) else {}
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


# programs that state how the pages of a file are arranged, as tifffile names them
_ARRANGED = (
    *("shaped", "lsm", "mmstack", "ome", "imagej", "ndtiff", "fluoview", "stk", "sis", "svs", "scn", "qpi", "ndpi"),
    *("bif", "avs", "eer", "philips", "scanimage", "nih", "mdgel"),
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
    if not any(getattr(tif, f"is_{kind}", False) for kind in _ARRANGED):
        return None  # the series of all pages takes 0.3 ms per page
    tif.pages.useframes = len(tif.pages) > 1
    try:
        series = tif.series
    except RuntimeError:  # pages differ
        return None
    if len(series) == 1 and series[0].kind not in ("uniform", "generic"):
        return _all_series(tif)[0]
    for one in series:
        _check_one_page_per_frame(one.shape, one.axes, len(one.pages))
    return None


def open_tiff(path: Path) -> FrameReader:
    """Open a TIFF file of one or many pages."""
    with readable_stack(path, "TIFF"):
        headers = _Headers(path).pages
        tif = tifffile.TiffFile(path)
        reader: FrameReader | None = None
        try:
            series = _series_of_all_frames(tif)
            if series is None:
                tif.pages.useframes = False
                reader = _PageReader(path, tif, headers)
                return reader
            info, order = _series_info(tif, series)
            in_order = tuple(sorted(order))
            frame_by_frame = order == in_order or (
                info.channels_last and (*order[:-3], *order[-2:], order[-3]) == in_order
            )
            if series.dataoffset is not None:
                dtype = series.dtype.newbyteorder(tif.byteorder)
                if frame_by_frame:
                    return ContiguousReader(path, info, series.dataoffset, dtype)
                shape, axes = (1, *_axes_of(series)[1]), (0, *(axis + 1 for axis in order))
                return InterleavedReader(path, info, series.dataoffset, dtype, shape, axes)
            complete = _complete_pages(tif, headers, range(len(headers)), path.stat().st_size)
            try:
                reader = _SeriesReader(path, tif, info, order, complete)
            except ValueError:
                if not all(complete):
                    raise
                reader = _WholeReader(path, tif, info, order)
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


def write_tiff(path: Path, info: StackInfo, frames: Iterator[NDArray[Any]], compression: str | None) -> None:
    """Write a TIFF file frame by frame; arguments as in ``StackFormat.write``."""
    stored, options = _layout(info)
    pages = (stored.to_stored(frame) for frame in frames)
    if stored.stored_axes == "TCHW":
        pages = (plane for frame in pages for plane in frame)
    tifffile.imwrite(path, data=pages, compression=compression, maxworkers=1, **options)
