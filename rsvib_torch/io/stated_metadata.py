"""What attributes of arrays, descriptions of TIFF files, and EXIF metadata state about a stack."""

from pathlib import Path

import numpy as np
from PIL import ExifTags, Image

from rsvib_torch.checks.arguments import channels_appear_last
from rsvib_torch.files.reading import Table
from rsvib_torch.io.full_scale import check_dtype, known_full_scale
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
    """Attributes of an array in a file, or keys of a TIFF description, that state ``info``, without unknown values."""
    times = info.frame_times
    stated: Table = {
        "full_scale": None if info.full_scale is None else float(info.full_scale),
        "frame_times": None if times is None else [float(time) for time in times],
        "frame_rate": None if times is not None or info.frame_rate is None else float(info.frame_rate),
        "orientation": None if info.orientation == 1 else info.orientation,
    }
    return {name: value for name, value in stated.items() if value is not None}


def fields_of_attributes(attributes: Table, count: int, dtype: np.dtype) -> Table:
    """Fields of ``StackInfo`` of ``count`` frames that the attributes state, as ``attributes_of`` writes them."""
    full_scale, rate = (attributes.get(name) for name in ("full_scale", "frame_rate"))
    times = np.asarray(attributes.get("frame_times", ()), dtype=np.float64).ravel().tolist()
    return {
        "full_scale": known_full_scale(dtype, None if full_scale is None else float(full_scale)),
        "frame_times": tuple(times) if len(times) == count else None,
        "frame_rate": None if rate is None else float(np.asarray(rate).item()),
        "orientation": orientation_of(attributes.get("orientation")),
    }


def info_of_array(shape: tuple[int, ...], dtype: np.dtype, attributes: Table | None = None) -> StackInfo:
    """An array (H, W), (T, H, W) or (T, C, H, W) in a file as a stack."""
    check_dtype(dtype)
    if len(shape) not in (2, 3, 4) or min(shape) < 1:
        raise ValueError(f"array of shape {shape}; expected (H, W), (T, H, W) or (T, C, H, W)")
    if channels_appear_last(shape):
        raise ValueError(f"array of shape {shape} appears to have its channels last; store (T, C, H, W)")
    stack = shape if len(shape) > 2 else (1, *shape)
    return StackInfo(stack, dtype.name, **fields_of_attributes(attributes or {}, stack[0], dtype))


def check_array(path: Path, info: StackInfo) -> None:
    """Refuse a shape that would be read as another one."""
    if channels_appear_last(info.shape):
        raise ValueError(f"{path}: array of shape {info.shape} would be read as one with channels last; write .tif")


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
