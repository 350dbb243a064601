"""What a stack states of itself in the attributes of an array, the same in HDF5 and Zarr."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from rsvib_torch.io.full_scale import known_full_scale
from rsvib_torch.io.stack_info import StackInfo

__all__ = ["attributes_of", "info_from_attributes"]

_AXES = {2: "HW", 3: "THW", 4: "TCHW"}


def attributes_of(info: StackInfo) -> dict[str, Any]:
    """Attributes that say what ``info`` says; what is not known is left out."""
    stated: dict[str, Any] = {"axes": info.stored_axes}
    if info.full_scale is not None:
        stated["full_scale"] = float(info.full_scale)
    if info.frame_times is not None:
        stated["frame_times"] = [float(time) for time in info.frame_times]
    if info.resolution is not None:
        stated["resolution"] = [float(value) for value in info.resolution[:2]]
        stated["resolution_unit"] = info.resolution[2]
    return stated


def info_from_attributes(stated: Mapping[str, Any], shape: tuple[int, ...], dtype: np.dtype[Any]) -> StackInfo:
    """The stack that an array of this shape with these attributes is.

    Raises:
        ValueError: If they do not fit together.
    """
    axes = str(stated.get("axes", _AXES.get(len(shape), "")))
    if len(axes) != len(shape) or axes not in ("HW", "THW", "TCHW", "THWC") or min(shape) < 1:
        raise ValueError(f"array of shape {shape} with axes {axes!r}; expected HW, THW, TCHW or THWC")
    last = axes == "THWC"
    if axes == "HW":
        shape = (1, *shape)
    elif last:
        shape = (shape[0], shape[3], shape[1], shape[2])
    elif axes == "TCHW" and "axes" not in stated and shape[-1] <= 4 < shape[1]:
        raise ValueError(f"array has shape {shape}; channels go second, or attribute axes says 'THWC'")
    times = stated.get("frame_times")
    if times is not None:
        times = tuple(float(time) for time in np.asarray(times, dtype=np.float64).ravel())
    resolution = stated.get("resolution")
    if resolution is not None:
        x, y = (float(value) for value in resolution)
        resolution = (x, y, str(stated.get("resolution_unit", "centimeter")))
    scale = stated.get("full_scale")
    scale = known_full_scale(dtype, None if scale is None else float(scale))
    return StackInfo(shape, dtype.name, scale, times, resolution, last)
