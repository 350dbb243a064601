"""Stacks in TIFF and BigTIFF files, also compressed, and the metadata that a restoration copies to its output.

Tags that describe how pixels are stored are left to the writer. Of all others a table states whether they are copied;
those that are not are named, so that the user learns what is lost.
"""

import json
import math
import re
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import tifffile

from rsvib_torch.files.reading import Table
from rsvib_torch.frames.full_scale import check_dtype
from rsvib_torch.io.frame_reader import FrameError, FrameReader, check_held, contiguous_reader, readable_stack
from rsvib_torch.io.stack_info import Scope, StackInfo, Tag, attributes_of, fields_of_attributes
from rsvib_torch.numerics.tables import Array

_PHOTOMETRIC: tuple[int, ...] = (tifffile.PHOTOMETRIC.MINISBLACK, tifffile.PHOTOMETRIC.RGB)


class _Page(NamedTuple):
    """What the header of a page states."""

    kind: str  # size and type of the pixels, for comparisons and messages
    complete: bool  # whether its stored pixels lie within the file
    secondary: bool  # whether it is a thumbnail or a mask of another page


def _name(photometric: object) -> str:
    return getattr(photometric, "name", str(photometric))


def _kind(page: tifffile.TiffPage) -> str:
    """Size and type of the pixels of a page."""
    height, width = page.shape[:2] if page.axes == "YXS" else page.shape[-2:]
    channels = f", {page.samplesperpixel} channels," if len(page.shape) == 3 else ""
    meaning = "" if page.photometric in _PHOTOMETRIC else f" {_name(page.photometric)}"
    return f"{height} x {width} px{channels} {page.dtype}{meaning}"


def _pages(tif: tifffile.TiffFile) -> list[_Page]:
    """What the headers of all pages state, in a chain that must not leave the file or be circular.

    tifffile interprets one in 0.05 ms, and ends such a chain without an error.
    """
    pages: list[_Page] = []
    visited: set[int] = set()
    file = tif.filehandle
    for page in cast(Iterable[tifffile.TiffPage], tif.pages):
        if page.offset in visited:
            raise ValueError("its chain of pages runs in a circle")
        visited.add(page.offset)
        pages.append(_Page(_kind(page), _is_complete(page, file.size), bool(page.subfiletype & 0b101)))
    file.seek(tif.pages.next_page_offset or 0)
    if not pages or file.read(tif.tiff.offsetsize) != bytes(tif.tiff.offsetsize):
        raise ValueError(f"truncated: the header of page {len(pages)} lies beyond the end of the file")
    return pages


def _is_complete(page: tifffile.TiffPage | tifffile.TiffFrame | None, size: int) -> bool:
    """Whether the stored pixels of a page lie within a file of ``size`` bytes."""
    ends = [] if page is None else map(sum, zip(page.dataoffsets, page.databytecounts, strict=True))
    return max(ends, default=size + 1) <= size


# programs that state how the pages of a file are arranged, as tifffile names them
_PROGRAMS = (
    "shaped lsm mmstack ome imagej ndtiff fluoview stk sis svs scn qpi ndpi bif avs eer philips scanimage nih mdgel"
)


def _series(tif: tifffile.TiffFile, count: int) -> tifffile.TiffPageSeries | None:
    """The array as which the ``count`` pages of a file are arranged; None if every page is a frame."""
    metadata, arrays = _json_description(tif), list[tuple[tuple[int, ...], str, int]]()
    if "shape" in metadata:  # series of pages that were written one by one would take quadratic time
        shape = tuple(metadata["shape"])
        arrays.append((shape, metadata.get("axes", ""), math.prod(shape) // math.prod(tif.pages.first.shape)))
    if not arrays or arrays[0][2] >= count:
        if not tif.flags & set(_PROGRAMS.split()):
            return None  # the series of all pages takes 0.3 ms per page
        tif.pages.useframes = count > 1
        try:
            series = tif.series() if callable(tif.series) else tif.series  # a method from tifffile 2026.5.2 on
        except RuntimeError:  # pages differ
            return None
        if len(series) == 1 and series[0].kind not in ("uniform", "generic"):
            return series[0]
        arrays = [(one.shape, one.axes, len(one.pages)) for one in series]
    for shape, axes, pages in arrays:
        if pages > 1 and (shape[0] != pages or axes[:1] in ("C", "S")):
            raise ValueError(
                f"it contains several arrays, of which the first has shape {tuple(shape)} (axes {axes or 'unknown'}); "
                "expected one array, or one frame per page"
            )
    return None


def _info(tif: tifffile.TiffFile, shape: tuple[int, ...], dtype: np.dtype, photometric: object) -> StackInfo:
    """A stack of that shape, with what the first page states."""
    if photometric not in _PHOTOMETRIC:
        raise ValueError(f"pixels are {_name(photometric)}; expected grey (black is 0) or RGB")
    check_dtype(dtype)
    metadata, bits = _json_description(tif), tif.pages.first.bitspersample
    if isinstance(bits, int) and bits not in (8, 16, 32, 64) and dtype.kind == "u":
        metadata = {"full_scale": 2**bits - 1, **metadata}  # packed pixels, e.g. 4095 for 12 bits
    metadata["orientation"] = tif.pages.first.tags.valueof("Orientation")
    return StackInfo(shape, dtype.name, metadata=_metadata(tif), **fields_of_attributes(metadata, shape[0], dtype))


def open_tiff(path: Path) -> FrameReader:
    """Open a TIFF file of one or many pages."""
    with readable_stack(path, "TIFF"), ExitStack() as opened:
        tif = opened.enter_context(tifffile.TiffFile(path))
        headers, size = _pages(tif), path.stat().st_size
        series = _series(tif, len(headers))
        # 1. The array of the file. Without an arrangement, every page is a frame, thumbnails and masks excepted.
        pages, offset = (tif.pages, None) if series is None else (series.pages, series.dataoffset)
        if series is None:
            numbers = [number for number, page in enumerate(headers) if not page.secondary] or [*range(len(headers))]
            complete = [headers[number].complete for number in numbers]
            first = cast(tifffile.TiffPage, pages[numbers[0]])
            if first.dtype is None or first.axes not in ("YX", "YXS", "SYX"):
                raise ValueError(f"page {first.index} has shape {first.shape} (axes {first.axes}); expected an image")
            other = next((number for number in numbers if headers[number].kind != _kind(first)), None)
            if other is not None:
                kinds = f"page {other} is {headers[other].kind}, page {first.index} is {_kind(first)}"
                raise ValueError(f"frames of different size or kind: {kinds}")
            axes, shape, dtype = f"T{first.axes}", (len(numbers), *first.shape), first.dtype
        else:
            first, axes, shape, dtype = series.keyframe, series.axes, series.shape, series.dtype
            numbers, complete = list(range(len(pages))), [_is_complete(page, size) for page in pages]
        # 2. The stack: an axis of frames, one of channels, and the image; axes of length 1 mean nothing.
        sizes = [(axis, size) for axis, size in zip(axes, shape, strict=True) if size > 1 or axis in "YX"]
        axes, shape = "".join(axis for axis, _ in sizes), tuple(size for _, size in sizes)
        order = re.fullmatch("(?P<time>[^SCYX])?([SC])?YX(?P<last>[SC])?", axes)
        if order is None or (order[2] and order["last"]):
            raise ValueError(f"axes {axes} of sizes {shape}; expected an axis of frames, one of channels, and YX")
        stack = shape if order["time"] else (1, *shape)
        stack = (stack[0], stack[3], *stack[1:3]) if order["last"] else stack
        info, channels_last = _info(tif, stack, dtype, first.photometric), order["last"] is not None
        if series is None and len(numbers) < len(headers):
            info = replace(info, metadata={**info.metadata, "thumbnails and masks": None})
        # 3. Its frames: one after another, or in one or several pages.
        if offset is not None:
            stored_dtype = dtype.newbyteorder(tif.byteorder)
            return contiguous_reader(path, info, offset, stored_dtype, channels_last=channels_last)
        check_held(info.shape[0] * info.frame_bytes, size)
        if sum(complete) < 0.5 * len(complete):
            raise ValueError(f"truncated: pixels of page {complete.index(False)} lie beyond the end of the file")
        over_pages = shape[: len(shape) - len(first.shape)]
        if math.prod(over_pages) != len(numbers) or (order["time"] and not over_pages):
            raise ValueError(f"axes {axes}: a page has several frames; expected one frame per page")
        of_frames = np.array(numbers).reshape(info.shape[0], -1).tolist()

        def read(index: int) -> Array:
            of_frame = [pages[number] for number in of_frames[index]]
            if not all(_is_complete(page, size) for page in of_frame):
                raise FrameError(f"{path}: truncated: pixels of frame {index} lie beyond the end of the file")
            stored = np.stack([page.asarray(maxworkers=1) for page in of_frame if page is not None])
            return (np.moveaxis(stored, -1, 1) if channels_last else stored).reshape(info.shape[1:])

        return FrameReader(path, info, read, opened.pop_all().close)


# Metadata

_DESCRIPTION = 270  # code of a tag
_RESOLUTION = {282, 283, 296}  # codes of x, y and unit; tifffile writes them by options
# keys of the description as JSON, which are for the reader only
_LAYOUT_KEYS = {"shape", "axes", "truncated", "full_scale", "frame_times", "frame_rate"}

_OF_THE_FILE = (
    "ImageDescription DocumentName Make Model DateTime Artist HostComputer XMP Copyright ExposureTime FNumber IPTCNAA "
    "InterColorProfile GDAL_METADATA GDAL_NODATA GEO_METADATA"
)
_OF_THE_IMAGE = (
    "XResolution YResolution ResolutionUnit ModelPixelScaleTag IntergraphMatrixTag ModelTiepointTag "
    "ModelTransformationTag GeoKeyDirectoryTag GeoDoubleParamsTag GeoAsciiParamsTag RPCCoefficientTag"
)
_COPIED: dict[int, Scope] = {
    **{tifffile.TIFF.TAGS[name]: "file" for name in _OF_THE_FILE.split()},
    **{tifffile.TIFF.TAGS[name]: "image" for name in _OF_THE_IMAGE.split()},
    **dict.fromkeys(range(65000, 65536), "file"),  # reusable range: values of the writing program
}
_FIRST_PRIVATE = 32768
# Tags of stored pixels: all below the private range that are not copied, except references to other images; and these,
# of which the last two belong to the description of ImageJ.
_STORAGE = {32995, 32996, 32997, 32998, 50838, 50839}
_SUBIFDS = 330


def _json_description(tif: tifffile.TiffFile) -> Table:
    """What tifffile or this package states in the description of the first page; empty if there is nothing."""
    with suppress(ValueError):
        values = json.loads(tif.pages.first.shaped_description or "")
        return values if isinstance(values, dict) else {}
    return {}


def _metadata(tif: tifffile.TiffFile) -> dict[str, Tag | None]:
    """Metadata of a TIFF file by name; None for those that are not copied to the file that this package writes."""
    first = tif.pages.first
    numbers = sorted({1, len(tif.pages) - 1})  # a sample: values differ in all pages or in none
    others = [cast(tifffile.TiffPage, tif.pages.get(number)) for number in numbers if 0 < number < len(tif.pages)]
    tags: dict[str, Tag | None] = {}
    for tag in first.tags:
        name = tag.name if not tag.name.isdecimal() else f"tag {tag.name}"
        if tag.code in _RESOLUTION and _value(first, 282) in (None, (1, 1)):
            continue  # not stated
        if tag.code in _COPIED:
            value, *rest = (_value(page, tag.code) for page in (first, *others))
            if any(other not in (None, value) for other in rest):
                tags[f"{name} (differs between pages)"] = None
            elif value is not None:
                once = None in rest or tag.code == _DESCRIPTION
                tags[name] = Tag(tag.code, int(tag.dtype), tag.count, value, once, _COPIED[tag.code])
            elif tag.code != _DESCRIPTION or tag.value not in ("", first.shaped_description):
                tags[name] = None
        elif (tag.code >= _FIRST_PRIVATE and tag.code not in _STORAGE) or tag.code == _SUBIFDS:
            tags[name] = None
    if not _json_description(tif).keys() <= _LAYOUT_KEYS:
        tags["JSON metadata"] = None
    return tags


def _value(page: tifffile.TiffPage, code: int) -> Any:
    """The value of a tag, None if it is missing, damaged, a structure of its own, or a description of pixels."""
    if code == _DESCRIPTION:
        texts = () if page.is_ome or page.is_imagej else (page.description, page.description1)
        return next((text for text in texts if text and text != page.shaped_description), None)
    value = None
    with suppress(Exception):  # any type, from a damaged file
        value = page.tags.valueof(code)
    parts = value if isinstance(value, tuple) else (value,)
    return value if all(isinstance(part, (int, float, str, bytes)) for part in parts) else None


# Writing


def write_tiff(path: Path, info: StackInfo, frames: Iterator[Array]) -> None:
    """Write a TIFF file frame by frame."""
    # Three or four channels are stored last (RGB), others as planes of a page.
    colour = info.axes == "TCHW" and info.shape[1] in (3, 4)
    axes = "TYX" if info.axes == "THW" else "TYXS" if colour else "TSYX" if info.shape[1] > 1 else "TCYX"
    # Metadata: full scale and times as JSON, all others as tags.
    tags = {tag.code: tag for tag in info.metadata.values() if tag is not None}
    extratags: list[tuple[object, ...]] = []
    if info.orientation != 1:
        extratags.append(("Orientation", "H", 1, info.orientation, False))
    for tag in tags.values():
        value = tag.value.encode() if isinstance(tag.value, str) else tag.value
        if tag.code not in (_DESCRIPTION, *_RESOLUTION):
            extratags.append((tag.code, tag.dtype, tag.count, value, tag.first_page))
    options: Table = {"extratags": extratags}
    options["metadata"] = {**attributes_of(replace(info, orientation=1)), "axes": axes}
    options |= {"photometric": "rgb" if colour else "minisblack"} | ({"planarconfig": 2} if axes == "TSYX" else {})
    if _DESCRIPTION in tags:
        options["description"] = tags[_DESCRIPTION].value.encode()
    if tags.keys() >= _RESOLUTION:
        x, y, unit = (tags[code].value for code in sorted(_RESOLUTION))
        options |= {"resolution": (x, y), "resolutionunit": unit}
    shape = (info.shape[0], *info.shape[2:], info.shape[1]) if colour else info.shape
    pages = (np.ascontiguousarray(np.moveaxis(f, 0, -1) if colour else f, info.dtype) for f in frames)
    if len(shape) == 4 and not colour:
        pages = (plane for frame in pages for plane in frame)
    tifffile.imwrite(path, data=pages, maxworkers=1, shape=shape, dtype=info.dtype, **options)
