"""What the attributes of a stored array state about a stack: HDF5 datasets, Zarr arrays, sidecars of raw frames."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from rsvib_torch.checks.arrays import channels_appear_last
from rsvib_torch.files.reading import Table
from rsvib_torch.io.full_scale import known_full_scale
from rsvib_torch.io.stack_info import StackInfo
from rsvib_torch.io.time_metadata import orientation_of, times_of_attributes


def attributes_of(info: StackInfo) -> Table:
    """Attributes of an HDF5 dataset or Zarr array that state ``info``; unknown values are omitted."""
    attributes: Table = {"axes": info.stored_axes}
    if info.full_scale is not None:
        attributes["full_scale"] = float(info.full_scale)
    if info.frame_times is not None:
        attributes["frame_times"] = [float(time) for time in info.frame_times]
    elif info.frame_rate is not None:
        attributes["frame_rate"] = float(info.frame_rate)
    if info.orientation != 1:
        attributes["orientation"] = info.orientation
    if info.resolution is not None:
        attributes["resolution"] = [float(value) for value in info.resolution[:2]]
        attributes["resolution_unit"] = info.resolution[2]
    return attributes


def info_from_attributes(attributes: Mapping[str, Any], shape: tuple[int, ...], dtype: np.dtype) -> StackInfo:
    """A stored array as a stack; the attributes are those of ``attributes_of``, or times of other programs."""
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
    if attributes.get("frame_times") is not None:
        stated: Table = {"frame_times": tuple(np.asarray(attributes["frame_times"], dtype=np.float64).ravel().tolist())}
    else:
        stated = times_of_attributes(attributes, shape[0])
    resolution = attributes.get("resolution")
    if resolution is not None:
        x, y = (float(value) for value in resolution)
        resolution = (x, y, str(attributes.get("resolution_unit", "centimeter")))
    full_scale = attributes.get("full_scale")
    return StackInfo(
        shape,
        dtype.name,
        known_full_scale(dtype, None if full_scale is None else float(full_scale)),
        resolution=resolution,
        channels_last=axes == "THWC",
        orientation=orientation_of(attributes.get("orientation")),
        **stated,
    )
