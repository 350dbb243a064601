"""Stacks in TIFF and BigTIFF files, also compressed."""

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from rsvib_torch.io.formats import StackFormat, register_format
from rsvib_torch.io.full_scale import check_dtype, known_full_scale
from rsvib_torch.io.placed import ArrayReader, PlacedReader, PlacedWriter, frame_to_file_order
from rsvib_torch.io.stack_info import FrameError, StackInfo

__all__ = ["create_tiff", "open_tiff", "write_tiff"]

_CHANNEL_AXES = "SC"
_LARGEST_RATIO = 5000  # pixel bytes per file byte; no lossless coder of images packs tighter
_LEAST_HELD = 0.5  # of the frames that the headers promise


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
            file.seek(min(offset, size))
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


def _pages_present(tif: Any, size: int) -> list[bool]:
    """Whether the pixels of each page lie within the file.

    Raises:
        ValueError: If there cannot be that many pixels.
    """
    declared, present = 0, []
    for page in tif.pages:
        declared += int(page.nbytes)
        ends = (offset + count for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True))
        present.append(max(ends, default=size + 1) <= size)
    if declared > _LARGEST_RATIO * size:
        raise ValueError(f"its header promises {declared} bytes of pixels, which {size} bytes cannot hold")
    return present


def _stated(tif: Any) -> dict[str, Any]:
    """What our own writer states in the JSON of the image description."""
    for metadata in tif.shaped_metadata or ():
        if isinstance(metadata, dict):
            return metadata
    return {}


def _stated_full_scale(tif: Any) -> float | None:
    """Full scale written by ``write_tiff``, or that of packed pixels (12 bits a pixel: 4095)."""
    if "full_scale" in _stated(tif):
        return float(_stated(tif)["full_scale"])
    bits = tif.pages[0].bitspersample
    if isinstance(bits, int) and bits not in (8, 16, 32, 64) and tif.pages[0].dtype.kind == "u":
        return float(2**bits - 1)
    return None


def _resolution(tif: Any) -> tuple[float, float, str] | None:
    """Pixels per unit, where the unit is one of length."""
    tags = tif.pages[0].tags
    unit = {2: "inch", 3: "centimeter"}.get(int(tags["ResolutionUnit"].value) if "ResolutionUnit" in tags else 0)
    if unit is None or "XResolution" not in tags or "YResolution" not in tags:
        return None
    (x, per_x), (y, per_y) = tags["XResolution"].value, tags["YResolution"].value
    return (x / per_x, y / per_y, unit) if min(x, per_x, y, per_y) > 0 else None


def _layout(tif: Any) -> tuple[tuple[int, ...], tuple[int, ...], np.dtype[Any], bool]:
    """Stack shape, the order of the stored axes that gives it, dtype, and whether channels go last."""
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
    last = bool(channels) and channels[0] > columns
    return (stack if times else (1, *stack)), (*ones, *kept), series.dtype, last


def _info(tif: Any) -> tuple[StackInfo, tuple[int, ...]]:
    shape, order, dtype, last = _layout(tif)
    check_dtype(dtype)
    times = _stated(tif).get("frame_times")
    times = None if times is None else tuple(float(time) for time in times)
    full_scale = known_full_scale(dtype, _stated_full_scale(tif))
    return StackInfo(shape, dtype.name, full_scale, times, _resolution(tif), last), order


def _name(path: Path) -> str:
    return f"{path}: not a readable TIFF stack"


@contextmanager
def _damage_named(path: Path) -> Iterator[None]:
    """Whatever a damaged file makes the decoder raise becomes one ``ValueError`` that names it."""
    try:
        yield
    except (MemoryError, FrameError):
        raise
    except Exception as error:
        raise ValueError(f"{_name(path)}: {' '.join(str(error).split())}") from error


class _PageReader:
    """Frames decoded page by page.

    Args:
        path: The file.
        tif: The open file.
        info: What it holds.
        order: Order of the stored axes that gives the stack.
        present: Whether the pixels of each page lie within the file.
    """

    def __init__(self, path: Path, tif: Any, info: StackInfo, order: tuple[int, ...], present: list[bool]) -> None:
        self.info = info
        self._path, self._tif, self._order, self._present = path, tif, order, present
        series = tif.series[0]
        self._shape = series.get_shape(squeeze=False)
        T = info.shape[0]
        self._pages, rest = divmod(len(series.pages), T)
        time = order[len(order) - len(info.shape)] if T > 1 else None
        first = all(self._shape[i] == 1 for i in range(time)) if time is not None else True
        if rest or not first or self._pages < 1:
            raise ValueError("its pages are not in the order of the frames")
        self._frame_shape = tuple(1 if i == time else size for i, size in enumerate(self._shape))

    def frame(self, index: int) -> NDArray[Any]:
        """Pixels of a frame as stored."""
        numbers = range(index * self._pages, (index + 1) * self._pages)
        if not all(self._present[number] for number in numbers):
            raise FrameError(f"{_name(self._path)}: truncated: pixels of frame {index} lie beyond the end of the file")
        try:
            pages = [self._tif.series[0].pages[number].asarray(maxworkers=1) for number in numbers]
        except MemoryError:
            raise
        except Exception as error:
            raise FrameError(
                f"{_name(self._path)}: frame {index} cannot be decoded: {' '.join(str(error).split())}"
            ) from error
        stored = np.stack(pages).reshape(self._frame_shape).transpose(self._order)
        return np.ascontiguousarray(stored.reshape(self.info.shape[1:]))

    def close(self) -> None:
        """Let go of the file."""
        self._tif.close()


def _whole_in_memory(tif: Any, info: StackInfo, order: tuple[int, ...]) -> ArrayReader:
    stored: NDArray[Any] = tif.series[0].asarray(squeeze=False, maxworkers=1)
    return ArrayReader(info, stored.transpose(order).reshape(info.shape))


def _in_frame_order(order: tuple[int, ...], last: bool) -> bool:
    """Whether stored axes are those of a stack one after another, frame by frame."""
    return order == tuple(sorted(order)) or (last and (*order[:-3], *order[-2:], order[-3]) == tuple(sorted(order)))


def open_tiff(path: Path) -> ArrayReader | PlacedReader | _PageReader:
    """Open a TIFF file of one or many pages."""
    with path.open("rb"):
        pass  # a file that may not be read is an OSError of its own
    with _damage_named(path):
        _check_page_chain(path)
        tif = tifffile.TiffFile(path)
        try:
            tif.pages.useframes = len(tif.pages) > 1
            info, order = _info(tif)
            series, size = tif.series[0], path.stat().st_size
            if series.dataoffset is not None and _in_frame_order(order, info.channels_last):
                dtype = series.dtype.newbyteorder(tif.byteorder)
                reader = PlacedReader(path, info, series.dataoffset, dtype, _name(path))
                tif.close()
                return reader
            present = _pages_present(tif, size)
            if sum(present) < _LEAST_HELD * len(present):
                index = present.index(False)
                raise ValueError(f"truncated: pixels of page {index} lie beyond the end of the file")
            try:
                return _PageReader(path, tif, info, order, present)
            except ValueError:
                if not all(present):
                    raise
                reader_of_all = _whole_in_memory(tif, info, order)
            tif.close()
            return reader_of_all
        except BaseException:
            tif.close()
            raise


def _written_layout(info: StackInfo) -> tuple[StackInfo, dict[str, Any]]:
    """How a stack is laid out in the file: three or four channels go last, as other programs expect."""
    colour = info.axes == "TCHW" and info.shape[1] in (3, 4)
    stored = StackInfo(info.shape, info.dtype, info.full_scale, info.frame_times, info.resolution, colour)
    axes = "TYX" if info.axes == "THW" else "TYXS" if colour else "TSYX" if info.shape[1] > 1 else "TCYX"
    metadata: dict[str, object] = {"axes": axes}
    if info.full_scale is not None:
        metadata["full_scale"] = info.full_scale
    if info.frame_times is not None:
        metadata["frame_times"] = list(info.frame_times)
    options: dict[str, Any] = {"photometric": "rgb" if colour else "minisblack", "metadata": metadata}
    if axes == "TSYX":
        options["planarconfig"] = "separate"
    if info.resolution is not None:
        options["resolution"] = info.resolution[:2]
        options["resolutionunit"] = info.resolution[2].upper()
    return stored, {"shape": stored.stored_shape, "dtype": info.dtype, **options}


def create_tiff(path: Path, info: StackInfo, fresh: bool) -> PlacedWriter:
    """Make a TIFF file with one page a frame, or go on with one; the full scale is in the image description."""
    stored, options = _written_layout(info)
    if fresh:
        tifffile.imwrite(path, data=None, **options)
    with tifffile.TiffFile(path) as tif:
        offset = int(tif.series[0].dataoffset or 0)
    writer = PlacedWriter(path, stored, offset)
    return writer.reserve() if fresh else writer


def write_tiff(path: Path, info: StackInfo, frames: Iterator[NDArray[Any]], compression: str | None) -> None:
    """Write a compressed TIFF file frame by frame."""
    stored, options = _written_layout(info)
    pages = (frame_to_file_order(frame, stored) for frame in frames)
    if info.axes == "TCHW" and not stored.channels_last:
        pages = (plane for frame in pages for plane in frame)
    tifffile.imwrite(path, data=pages, compression=compression, maxworkers=1, **options)


register_format(
    StackFormat("tiff", (".tif", ".tiff"), open_tiff, create_tiff, write_tiff, compressions=("zlib", "lzma"))
)
