"""What the attributes of HDF5 and Zarr arrays and EXIF metadata state about a stack."""

import numpy as np
from PIL import ExifTags, Image

from rsvib_torch.checks.arrays import channels_appear_last
from rsvib_torch.files.reading import Table
from rsvib_torch.io.full_scale import known_full_scale
from rsvib_torch.io.stack_info import StackInfo
from rsvib_torch.text import one_line


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
