"""What attributes of this package and metadata of other programs (HDF5, Zarr, TIFF, EXIF) state about a stack.

Functions for other programs return the fields of ``StackInfo`` that the metadata state, and none if they are ambiguous
or damaged, since frames can be read without them.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from itertools import pairwise
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np
from PIL import ExifTags, Image

from rsvib_torch.checks.arrays import channels_appear_last
from rsvib_torch.files.reading import Table
from rsvib_torch.io.full_scale import known_full_scale
from rsvib_torch.io.stack_info import StackInfo
from rsvib_torch.text import one_line

if TYPE_CHECKING:
    import tifffile

_SOFTWARE_CLOCK_ERROR = 5e-3  # s; times that acquisition software writes have jitter of milliseconds

_SECONDS = {
    **dict.fromkeys(("s", "sec", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "usec", "µs", "μs", "microsecond", "microseconds"), 1e-6),
    **dict.fromkeys(("ns", "nsec", "nanosecond", "nanoseconds"), 1e-9),
}


def _time_fields(times: Iterable[float | None], count: int, error: float, source: str) -> Table:
    """Fields of ``count`` times in seconds; none unless all are known and strictly increasing."""
    known = [time for time in times if time is not None and np.isfinite(time)]
    if len(known) != count or any(later <= earlier for earlier, later in pairwise(known)):
        return {}
    return {"frame_times": tuple(known), "time_error": error, "time_source": source}


def orientation_of(value: object) -> int:
    """The value of an orientation tag, 1 to 8; 1 (as stored) if it is anything else."""
    return int(value) if isinstance(value, int | np.integer) and value in range(1, 9) else 1


def camera_name(make: object, model: object) -> str | None:
    """Make and model of a camera as one name, with the make once (Canon, Canon EOS R5); None without a model."""
    maker, name = (one_line("" if text is None else str(text).replace("\0", " "), 60) for text in (make, model))
    repeated = name.casefold().startswith(maker.casefold())
    return None if not name else name if repeated else f"{maker} {name}"


def attributes_of(info: StackInfo) -> Table:
    """Attributes of an HDF5 dataset or Zarr array that state ``info``; unknown values are omitted."""
    times = info.frame_times
    stated: Table = {
        "axes": info.stored_axes,
        "full_scale": None if info.full_scale is None else float(info.full_scale),
        "frame_times": None if times is None else [float(time) for time in times],
        "frame_rate": None if times is not None or info.frame_rate is None else float(info.frame_rate),
        "orientation": None if info.orientation == 1 else info.orientation,
    }
    return {name: value for name, value in stated.items() if value is not None}


def info_from_attributes(attributes: Table, shape: tuple[int, ...], dtype: np.dtype) -> StackInfo:
    """A stored array as a stack; the attributes are those of ``attributes_of``."""
    axes = str(attributes.get("axes", {2: "HW", 3: "THW", 4: "TCHW"}.get(len(shape), "")))
    if len(axes) != len(shape) or axes not in ("HW", "THW", "TCHW", "THWC") or min(shape) < 1:
        raise ValueError(f"array of shape {shape} with axes {axes!r}; expected HW, THW, TCHW or THWC")
    if "axes" not in attributes and channels_appear_last(shape):
        raise ValueError(
            f"array of shape {shape} appears to have its channels last; store (T, C, H, W), or (T, H, W, C) with the "
            "attribute axes='THWC'"
        )
    if axes == "HW":
        shape = (1, *shape)
    elif axes == "THWC":
        shape = (shape[0], shape[3], shape[1], shape[2])
    times, rate = (attributes.get(name) for name in ("frame_times", "frame_rate"))
    full_scale = attributes.get("full_scale")
    return StackInfo(
        shape,
        dtype.name,
        known_full_scale(dtype, None if full_scale is None else float(full_scale)),
        channels_last=axes == "THWC",
        frame_times=None if times is None else tuple(np.asarray(times, dtype=np.float64).ravel().tolist()),
        frame_rate=None if rate is None else float(np.asarray(rate).item()),
        time_source="frame_times" if rate is None else "frame_rate",
        orientation=orientation_of(attributes.get("orientation")),
    )


def exif_fields(data: bytes) -> Table:
    """Orientation and camera of one image from its EXIF metadata."""
    exif = Image.Exif()
    try:
        exif.load(data)
    except Exception:  # damaged metadata raise errors of many types
        return {}
    tags = ExifTags.Base
    camera = camera_name(exif.get(tags.Make), exif.get(tags.Model))
    return {"orientation": orientation_of(exif.get(tags.Orientation)), "camera": camera}


def _ome_fields(text: str, count: int) -> Table:
    """Times of the planes (``DeltaT``) or their interval (``TimeIncrement``) in the OME-XML of an image."""
    pixels = ElementTree.fromstring(text).find(".//{*}Pixels")
    if pixels is None:
        return {}
    times: dict[int, float] = {}
    for plane in pixels.iterfind("{*}Plane"):
        unit = _SECONDS.get(plane.get("DeltaTUnit", "s").lower())
        if plane.get("TheC", "0") == "0" and plane.get("DeltaT") is not None and unit is not None:
            number = int(plane.get("TheT", "0")) + int(plane.get("TheZ", "0"))  # only one of them varies
            times[number] = unit * float(plane.get("DeltaT", ""))
    fields = _time_fields((times.get(i) for i in range(count)), count, _SOFTWARE_CLOCK_ERROR, "OME DeltaT")
    interval = float(pixels.get("TimeIncrement", "0")) * _SECONDS.get(pixels.get("TimeIncrementUnit", "s").lower(), 0.0)
    if not fields and interval > 0.0:
        fields = {"frame_rate": 1.0 / interval, "time_source": "OME TimeIncrement"}
    return fields


def tiff_times(tif: tifffile.TiffFile, count: int, metadata: Table) -> Table:
    """Times of ``count`` frames or frame rate of a TIFF file.

    They are stated by the ``metadata`` that this package writes, OME-XML, or ImageJ (``finterval``).
    """
    if len(metadata.get("frame_times", ())) == count:  # otherwise those of the first of several arrays
        return {"frame_times": tuple(float(time) for time in metadata["frame_times"])}
    if "frame_rate" in metadata:
        return {"frame_rate": float(metadata["frame_rate"]), "time_source": "frame_rate"}
    with suppress(Exception):  # damaged metadata raise errors of many types
        if tif.ome_metadata:
            return _ome_fields(tif.ome_metadata, count)
        imagej = tif.imagej_metadata or {}
        interval, unit = imagej.get("finterval"), _SECONDS.get(str(imagej.get("tunit", "s")).lower())
        if isinstance(interval, int | float) and interval > 0:
            return {"frame_rate": 1.0 / (unit * interval), "time_source": "ImageJ finterval"} if unit else {}
    return {}
