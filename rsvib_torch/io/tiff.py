"""Stacks in TIFF and BigTIFF files, also compressed, and the metadata that a restoration copies to its output.

Tags that describe how pixels are stored are left to the writer. Of all others a table states whether they are copied;
those that are not are named, so that the user learns what is lost.
"""

import json
import math
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import tifffile

from rsvib_torch.files.reading import Table
from rsvib_torch.io.blocks import BlockReader, contiguous_reader
from rsvib_torch.io.full_scale import check_dtype, known_full_scale
from rsvib_torch.io.stack_info import FrameError, Scope, StackInfo, Tag, readable_stack
from rsvib_torch.io.stated_metadata import attributes_of, orientation_of, tiff_times
from rsvib_torch.numerics.tables import Array

_PHOTOMETRIC: tuple[int, ...] = (tifffile.PHOTOMETRIC.MINISBLACK, tifffile.PHOTOMETRIC.RGB)
_LOSSLESS = {1, 5, 8, 32946, 32773, 34925, 50000}  # none, LZW, Deflate (two codes), PackBits, LZMA, Zstandard
_LARGEST_RATIO = 5000  # of pixels to the size of the file; deflate reaches 1032


class _Page(NamedTuple):
    """What the header of a page states."""

    number: int  # in the file
    kind: str  # size and type of the pixels, for messages and comparisons
    nbytes: int  # of its decoded pixels
    complete: bool  # whether its stored pixels lie within the file
    secondary: bool  # whether it is a thumbnail or a mask of another page


def _name(photometric: object) -> str:
    return getattr(photometric, "name", str(photometric))


def _pages(tif: tifffile.TiffFile) -> list[_Page]:
    """What the headers of all pages state, in a chain that must not leave the file or be circular.

    tifffile interprets one in 0.05 ms, and ends such a chain without an error.
    """
    pages: list[_Page] = []
    visited: set[int] = set()
    file, kinds = tif.filehandle, {}
    for page in cast(Iterable[tifffile.TiffPage], tif.pages):
        if page.offset in visited:
            raise ValueError("its chain of pages runs in a circle")
        visited.add(page.offset)
        key = page.shape, page.axes, page.dtype, page.photometric
        if key not in kinds:
            shape = _with_channels_first(page.shape, page.axes)
            channels = f", {shape[0]} channels," if len(shape) == 3 else ""
            meaning = "" if page.photometric in _PHOTOMETRIC else f" {_name(page.photometric)}"
            kinds[key] = f"{' x '.join(map(str, shape[-2:]))} px{channels} {page.dtype}{meaning}"
        complete = _is_complete(page, file.size)
        pages.append(_Page(len(pages), kinds[key], int(page.nbytes), complete, bool(page.subfiletype & 0b101)))
    file.seek(tif.pages.next_page_offset or 0)
    if not pages or file.read(tif.tiff.offsetsize) != bytes(tif.tiff.offsetsize):
        raise ValueError(f"truncated: the header of page {len(pages)} lies beyond the end of the file")
    return pages


def _is_complete(page: tifffile.TiffPage | tifffile.TiffFrame | None, size: int) -> bool:
    """Whether the stored pixels of a page lie within a file of ``size`` bytes."""
    ends = [] if page is None else map(sum, zip(page.dataoffsets, page.databytecounts, strict=True))
    return max(ends, default=size + 1) <= size


def _with_channels_first(shape: tuple[int, ...], axes: str) -> tuple[int, ...]:
    """The shape of a page with channels before the image axes."""
    return (shape[2], *shape[:2]) if axes == "YXS" else shape


def _check_complete(complete: Sequence[bool], nbytes: int, size: int) -> None:
    """Raise a ``ValueError`` if a file cannot hold the pixels, or more than half of the pages are incomplete."""
    if nbytes > _LARGEST_RATIO * size:
        raise ValueError(f"its header states {nbytes} bytes of pixels, which {size} bytes cannot hold")
    if sum(complete) < 0.5 * len(complete):
        raise ValueError(f"truncated: pixels of page {complete.index(False)} lie beyond the end of the file")


def _resolution(tif: tifffile.TiffFile) -> tuple[float, float, str] | None:
    """Pixels per unit, if the unit is one of length."""
    tags = tif.pages.first.tags
    unit = {2: "inch", 3: "centimeter"}.get(int(tags.valueof("ResolutionUnit", 0)))
    (x, per_x), (y, per_y) = (tags.valueof(name, (0, 0)) for name in ("XResolution", "YResolution"))
    return (x / per_x, y / per_y, unit) if unit is not None and min(x, per_x, y, per_y) > 0 else None


def _info(
    tif: tifffile.TiffFile, shape: tuple[int, ...], dtype: np.dtype, photometric: object, *, channels_last: bool
) -> StackInfo:
    """A stack of that shape, with what the first page states."""
    if photometric not in _PHOTOMETRIC:
        raise ValueError(f"pixels are {_name(photometric)}; expected grey (black is 0) or RGB")
    check_dtype(dtype)
    metadata, bits = _json_description(tif), tif.pages.first.bitspersample
    full_scale = metadata.get("full_scale")
    if full_scale is None and isinstance(bits, int) and bits not in (8, 16, 32, 64) and dtype.kind == "u":
        full_scale = 2**bits - 1  # packed pixels, e.g. 4095 for 12 bits
    info = StackInfo(
        shape,
        dtype.name,
        known_full_scale(dtype, None if full_scale is None else float(full_scale)),
        resolution=_resolution(tif),
        channels_last=channels_last,
        orientation=orientation_of(tif.pages.first.tags.valueof("Orientation")),
        **tiff_times(tif, shape[0], metadata),
    )
    return replace(info, metadata=_metadata(tif, info))


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


def open_tiff(path: Path) -> BlockReader:
    """Open a TIFF file of one or many pages."""
    with readable_stack(path, "TIFF"), ExitStack() as opened:
        tif = opened.enter_context(tifffile.TiffFile(path))
        headers, size = _pages(tif), path.stat().st_size
        series = _series(tif, len(headers))
        # 1. The array of the file. Without an arrangement, every page is a frame, thumbnails and masks excepted.
        pages, offset = (tif.pages, None) if series is None else (series.pages, series.dataoffset)
        if series is None:
            frames = [page for page in headers if not page.secondary] or headers
            numbers, complete = [page.number for page in frames], [page.complete for page in frames]
            first = cast(tifffile.TiffPage, pages[numbers[0]])
            if first.dtype is None or first.axes not in ("YX", "YXS", "SYX"):
                raise ValueError(f"page {first.index} has shape {first.shape} (axes {first.axes}); expected an image")
            other = next((page for page in frames if page.kind != frames[0].kind), None)
            if other is not None:
                kinds = f"page {other.number} is {other.kind}, page {first.index} is {frames[0].kind}"
                raise ValueError(f"frames of different size or kind: {kinds}")
            axes, shape, dtype = f"T{first.axes}", (len(frames), *first.shape), first.dtype
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
        info = _info(tif, stack, dtype, first.photometric, channels_last=order["last"] is not None)
        if series is None and len(numbers) < len(headers):
            info = replace(info, metadata={**info.metadata, "thumbnails and masks": None})
        # 3. Its frames: one after another, or in one or several pages.
        if offset is not None:
            return contiguous_reader(path, info, offset, dtype.newbyteorder(tif.byteorder))
        _check_complete(complete, info.shape[0] * info.frame_bytes, size)
        over_pages = shape[: len(shape) - len(first.shape)]
        if math.prod(over_pages) != len(numbers) or (order["time"] and not over_pages):
            raise ValueError(f"axes {axes}: a page has several frames; expected one frame per page")
        of_frames = np.array(numbers).reshape(info.shape[0], -1).tolist()

        def read(first: int, _: int) -> Array:
            of_frame = [pages[number] for number in of_frames[first]]
            if not all(_is_complete(page, size) for page in of_frame):
                raise FrameError(f"{path}: truncated: pixels of frame {first} lie beyond the end of the file")
            stored = np.stack([page.asarray(maxworkers=1) for page in of_frame if page is not None])
            return (np.moveaxis(stored, -1, 1) if info.channels_last else stored).reshape(1, *info.shape[1:])

        return BlockReader(path, info, read, close=opened.pop_all().close)


# Metadata

_DESCRIPTION, _IMAGEJ_COUNTS, _IMAGEJ = 270, 50838, 50839  # codes of tags
_JSON = "JSON metadata"  # keys of the description that tifffile writes
_RESOLUTION = "resolution"  # without a unit of length, which ImageJ states in the description
# keys of that description for the reader only
_LAYOUT_KEYS = ("shape", "axes", "truncated", "full_scale", "frame_times", "frame_rate")
_IMAGEJ_KEY = "rsvib"  # of JSON in an ImageJ description: ImageJ uses the last description, so there is no other one

_OF_THE_FILE = (
    "DocumentName Make Model DateTime Artist HostComputer XMP Copyright ExposureTime FNumber IPTCNAA InterColorProfile "
    "GDAL_METADATA GDAL_NODATA GEO_METADATA"
)
_OF_THE_IMAGE = (
    "ModelPixelScaleTag IntergraphMatrixTag ModelTiepointTag ModelTransformationTag GeoKeyDirectoryTag "
    "GeoDoubleParamsTag GeoAsciiParamsTag RPCCoefficientTag"
)
_COPIED: dict[int, Scope] = {
    **{tifffile.TIFF.TAGS[name]: "file" for name in _OF_THE_FILE.split()},
    **{tifffile.TIFF.TAGS[name]: "image" for name in _OF_THE_IMAGE.split()},
    **dict.fromkeys(range(65000, 65536), "file"),  # reusable range: values of the writing program
}
_FIRST_PRIVATE = 32768
# Tags of stored pixels: all below the private range that are not copied, except references to other images; and these.
_STORAGE = {32995, 32996, 32997, 32998, _IMAGEJ_COUNTS, _IMAGEJ}
_SUBIFDS = 330


def _json_description(tif: tifffile.TiffFile) -> Table:
    """What tifffile or this package states in the description of the first page; empty if there is nothing."""
    return _parsed(tif.pages.first.shaped_description or str((tif.imagej_metadata or {}).get(_IMAGEJ_KEY, "")))


def _parsed(text: str) -> Table:
    with suppress(ValueError):
        values = json.loads(text)
        return values if isinstance(values, dict) else {}
    return {}


def _metadata(tif: tifffile.TiffFile, info: StackInfo) -> dict[str, Tag | None]:
    """Metadata of a TIFF file by name; None for those that cannot be copied to the file that this package writes.

    Descriptions of the arrangement of its pages (OME, ImageJ) are copied only if those of the output will be the same.
    """
    first = tif.pages.first
    numbers = sorted({1, len(tif.pages) - 1})  # a sample: values differ in all pages or in none
    others = [cast(tifffile.TiffPage, tif.pages.get(number)) for number in numbers if 0 < number < len(tif.pages)]
    found: dict[str, Tag | None] = {}

    def add(name: str, values: Sequence[object], code: int, dtype: int, count: int, scope: Scope) -> None:
        """Add the values of the first page and of the others, in which they may be missing."""
        if any(value not in (None, values[0]) for value in values[1:]):
            found[f"{name} (differs between pages)"] = None
        else:
            once = code == _DESCRIPTION or None in values[1:]
            found[name] = None if values[0] is None else Tag(code, dtype, count, values[0], once, scope)

    for tag in first.tags:
        name = tag.name if not tag.name.isdecimal() else f"tag {tag.name}"
        if tag.code in _COPIED:
            values = [_value(page.tags.get(tag.code)) for page in (first, *others)]
            add(name, values, tag.code, int(tag.dtype), tag.count, _COPIED[tag.code])
        elif (tag.code >= _FIRST_PRIVATE and tag.code not in _STORAGE) or tag.code == _SUBIFDS:
            found[name] = None
    x, y, unit = (_value(first.tags.get(code)) for code in (282, 283, 296))
    rational = all(isinstance(scale, tuple) and len(scale) == 2 and min(scale) > 0 for scale in (x, y))
    if rational and unit == 1 and (x, y) != ((1, 1), (1, 1)):
        found[_RESOLUTION] = Tag(282, 5, 2, (x, y), False, "image")
    # Descriptions of all pages together are valid if the same pages will be written.
    same = info.axes == "THW" or (info.channels_last and info.shape[1] in (3, 4))
    stated, text = [_stated(page) for page in (first, *others)], _free_text(first)
    if stated[0]:
        add(_JSON, stated, _DESCRIPTION, 2, 0, "file")
    imagej = dict(tif.imagej_metadata or {})
    if imagej:
        imagej.pop(_IMAGEJ_KEY, None)
        imagej["axes"] = f"{'Z' if 'slices' in imagej else 'T'}YX" + "S" * (first.axes == "YXS")
        dtypes = ("uint8", "uint16", "int16", "float32") if info.axes == "THW" else ("uint8",)  # of ImageJ
        add("ImageJ metadata", [imagej if same and info.dtype in dtypes else None], _IMAGEJ, 1, 0, "stack")
    elif first.is_ome:
        single = same and info.shape[0] == len(tif.pages) and "FileName=" not in text
        add("OME-XML", [text if single else None], _DESCRIPTION, 2, 0, "stack")
    elif text:
        add("ImageDescription", [text, *(_free_text(page) or None for page in others)], _DESCRIPTION, 2, 0, "file")
    return found


def _value(tag: tifffile.TiffTag | None) -> Any:
    """The value of a tag, None if it is missing, damaged or a structure of its own."""
    value = None
    with suppress(Exception):  # any type, from a damaged file
        value = None if tag is None else tag.value
    parts = value if isinstance(value, tuple) else (value,)
    return value if all(isinstance(part, (int, float, str, bytes)) for part in parts) else None


def _stated(page: tifffile.TiffPage) -> str | None:
    """What the JSON description of a page states besides the layout; None if there is nothing."""
    parsed = _parsed(page.shaped_description or "")
    stated = {key: parsed[key] for key in sorted(parsed) if key not in _LAYOUT_KEYS}
    return json.dumps(stated) if stated else None


def _free_text(page: tifffile.TiffPage) -> str:
    """The description of a page that is not that of tifffile."""
    texts = (page.description, page.description1)
    return next((text for text in texts if text and text != page.shaped_description), "")


def _writer_options(info: StackInfo, description: Mapping[str, object]) -> Table:
    """Options of ``tifffile.imwrite`` that store the metadata of a stack, and a description as JSON."""
    extratags: list[tuple[object, ...]] = []
    options: Table = {"metadata": dict(description), "extratags": extratags}
    for name, tag in info.metadata.items():
        if tag is None:
            continue
        if name == _JSON:
            options["metadata"] = {**json.loads(tag.value), **options["metadata"]}
        elif name == _RESOLUTION:
            options.update(resolution=tag.value, resolutionunit="NONE")
        elif tag.code == _IMAGEJ:
            own = {key: value for key, value in description.items() if key != "axes"}
            options.update(imagej=True, metadata={**tag.value, **({_IMAGEJ_KEY: json.dumps(own)} if own else {})})
        elif tag.code == _DESCRIPTION:
            options["description"] = tag.value.encode()
        else:
            value = tag.value.encode() if isinstance(tag.value, str) else tag.value
            extratags.append((tag.code, tag.dtype, tag.count, value, tag.first_page))
    return options


# Writing


def _layout(info: StackInfo) -> tuple[StackInfo, Table]:
    """The stack as it is stored, and options of ``tifffile.imwrite``: three or four channels are stored last (RGB)."""
    colour = info.axes == "TCHW" and info.shape[1] in (3, 4)
    stored = replace(info, channels_last=colour)
    axes = "TYX" if info.axes == "THW" else "TYXS" if colour else "TSYX" if info.shape[1] > 1 else "TCYX"
    plain = replace(info, orientation=1, resolution=None)  # those are tags
    description = {**attributes_of(plain), "axes": axes}
    options = {"photometric": "rgb" if colour else "minisblack", **_writer_options(info, description)}
    if axes == "TSYX":
        options["planarconfig"] = "separate"
    if info.orientation != 1:
        options["extratags"].append(("Orientation", "H", 1, info.orientation, False))
    if info.resolution is not None:
        options["resolution"] = info.resolution[:2]
        options["resolutionunit"] = info.resolution[2].upper()
    return stored, {"shape": stored.stored_shape, "dtype": info.dtype, **options}


def storage_of(path: Path) -> Table:
    """Tiles and compression of a TIFF file as options of ``write_tiff``; zlib replaces a compression with loss."""
    with readable_stack(path, "TIFF"), tifffile.TiffFile(path) as tif:
        page = tif.pages.first
        tiles = {"tile": (page.tilelength, page.tilewidth)} if page.is_tiled else {}
        if page.compression not in _LOSSLESS:
            return {**tiles, "compression": "zlib"}
        return {**tiles, "compression": page.compression, "predictor": page.predictor}


def write_tiff(
    path: Path, info: StackInfo, frames: Iterator[Array], compression: str | None, storage: Mapping[str, object] = {}
) -> None:
    """Write a TIFF file frame by frame; arguments as in ``StackFormat.write``, and from ``storage_of``."""
    stored, options = _layout(info)
    pages = (stored.to_stored(frame) for frame in frames)
    if stored.stored_axes == "TCHW":
        pages = (plane for frame in pages for plane in frame)
    # an iterator would have to yield the tiles
    data = np.stack(list(pages)).reshape(stored.stored_shape) if "tile" in storage else pages
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".* truncating ImageJ file")  # from 4 GB on, as ImageJ does: only one header
        tifffile.imwrite(path, data=data, maxworkers=1, **{"compression": compression, **storage, **options})
