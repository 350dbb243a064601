"""Metadata of TIFF files that are copied from the input of a restoration to its output.

Tags that describe how pixels are stored are left to the writer. Of all others a table states whether they are copied;
those that are not are named, so that the user learns what is lost.
"""

import json
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, cast

import tifffile

from rsvib_torch.files.reading import Table
from rsvib_torch.io.stack_info import Scope, StackInfo, Tag

_DESCRIPTION, _IMAGEJ_COUNTS, _IMAGEJ = 270, 50838, 50839  # codes of tags
_JSON = "JSON metadata"  # keys of the description that tifffile writes
_RESOLUTION = "resolution"  # without a unit of length, which ImageJ states in the description
# keys of that description for the reader only
_LAYOUT_KEYS = ("shape", "axes", "truncated", "full_scale", "frame_times", "frame_rate")
_IMAGEJ_KEY = "rsvib="  # line of an ImageJ description: ImageJ uses the last description, so that there is no other one

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


def json_description(tif: tifffile.TiffFile) -> Table:
    """What tifffile or this package states in the description of the first page; empty if there is nothing."""
    page = tif.pages.first
    lines = [line for line in page.description.splitlines() if line.startswith(_IMAGEJ_KEY)]
    return _parsed(page.shaped_description or (lines[0].removeprefix(_IMAGEJ_KEY) if lines else ""))


def _parsed(text: str) -> Table:
    with suppress(ValueError):
        values = json.loads(text)
        return values if isinstance(values, dict) else {}
    return {}


def read_metadata(tif: tifffile.TiffFile, info: StackInfo) -> dict[str, Tag | None]:
    """Metadata of a TIFF file by name; None for those that cannot be copied to the file that this package writes.

    Descriptions of the arrangement of its pages (OME, ImageJ) are copied only if those of the output will be the same.
    """
    numbers = sorted({1, len(tif.pages) - 1})  # a sample: values differ in all pages or in none
    others = [cast(tifffile.TiffPage, tif.pages.get(number)) for number in numbers if 0 < number < len(tif.pages)]
    found: dict[str, Tag | None] = {}
    for tag in tif.pages.first.tags:
        private = tag.code >= _FIRST_PRIVATE and tag.code not in _STORAGE
        if tag.code == _DESCRIPTION or not (tag.code in _COPIED or private or tag.code == _SUBIFDS):
            continue
        name = tag.name if not tag.name.isdecimal() else f"tag {tag.name}"
        values = [_value(page.tags.get(tag.code)) for page in (tif.pages.first, *others)]
        if tag.code not in _COPIED or values[0] is None:
            found[name] = None
        elif any(value not in (None, values[0]) for value in values[1:]):
            found[f"{name} (differs between pages)"] = None
        else:
            found[name] = Tag(tag.code, int(tag.dtype), tag.count, values[0], None in values[1:], _COPIED[tag.code])
    x, y, unit = (_value(tif.pages.first.tags.get(code)) for code in (282, 283, 296))
    rational = all(isinstance(scale, tuple) and len(scale) == 2 and min(scale) > 0 for scale in (x, y))
    if rational and unit == 1 and (x, y) != ((1, 1), (1, 1)):
        found[_RESOLUTION] = Tag(282, 5, 2, (x, y), False, "image")
    same_pages = info.axes == "THW" or (info.channels_last and info.shape[1] in (3, 4))
    return found | _descriptions(tif, others, info.shape[0] if same_pages else -1)


def _value(tag: tifffile.TiffTag | None) -> Any:
    """The value of a tag, None if it is missing, damaged or a structure of its own."""
    value = None
    with suppress(Exception):  # any type, from a damaged file
        value = None if tag is None else tag.value
    parts = value if isinstance(value, tuple) else (value,)
    return value if all(isinstance(part, (int, float, str, bytes)) for part in parts) else None


def _descriptions(tif: tifffile.TiffFile, others: Sequence[tifffile.TiffPage], frames: int) -> dict[str, Tag | None]:
    """Descriptions of the first page; ``frames`` of the file that will be written as the same pages."""
    first = tif.pages.first
    found: dict[str, Tag | None] = {}
    written = {key: value for key, value in _parsed(first.shaped_description or "").items() if key not in _LAYOUT_KEYS}
    if written:
        alike = all(_parsed(page.shaped_description or "").items() >= written.items() for page in others)
        alike |= all(not page.shaped_description for page in others)
        name = _JSON if alike else f"{_JSON} (differs between pages)"
        found[name] = _text(json.dumps(written), "file") if alike else None
    text = _free_text(first)
    if first.is_imagej:
        kept = "".join(f"{line}\n" for line in text.splitlines() if not line.startswith(_IMAGEJ_KEY))
        found["ImageJ metadata"] = _text(kept, "stack") if frames > 0 else None
        if _IMAGEJ in first.tags:
            values = first.tags[_IMAGEJ].value
            known = frames > 0 and isinstance(values, dict)
            found["ImageJ overlays and labels"] = Tag(_IMAGEJ, 1, 0, values, True, "stack") if known else None
    elif first.is_ome:
        single = frames == len(tif.pages) and "FileName=" not in text
        found["OME-XML"] = _text(text, "stack") if single else None
    elif text and any(_free_text(page) not in ("", text) for page in others):
        found["ImageDescription (differs between pages)"] = None
    elif text:
        found["ImageDescription"] = _text(text, "file")
    return found


def _free_text(page: tifffile.TiffPage) -> str:
    """The description of a page that is not that of tifffile."""
    texts = (page.description, page.description1)
    return next((text for text in texts if text and text != page.shaped_description), "")


def _text(text: str, scope: Scope) -> Tag:
    return Tag(_DESCRIPTION, 2, 0, text, True, scope)


def writer_options(info: StackInfo, description: Mapping[str, object]) -> Table:
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
            extratags += tifffile.imagej_metadata_tag(tag.value, "<" if sys.byteorder == "little" else ">")
        elif tag.code == _DESCRIPTION:
            options["description"] = tag.value.encode()
        else:
            value = tag.value.encode() if isinstance(tag.value, str) else tag.value
            extratags.append((tag.code, tag.dtype, tag.count, value, tag.first_page))
    if info.metadata.get("ImageJ metadata") is not None:
        values = {key: value for key, value in description.items() if key != "axes"}
        line = f"{_IMAGEJ_KEY}{json.dumps(values)}\n" if values else ""
        options.update(metadata=None, description=options["description"] + line.encode())
    return options
