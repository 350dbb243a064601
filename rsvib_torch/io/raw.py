"""Stacks of raw frames, described by a JSON file with ``.json`` appended to the name (the sidecar)."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from rsvib_torch.core.validation import Section, read_json, validate
from rsvib_torch.io.array_attributes import attributes_of, info_from_attributes
from rsvib_torch.io.blocks import BlockReader, contiguous_reader
from rsvib_torch.io.stack_info import StackInfo, readable_stack


class _Sidecar(Section):
    """Content of the sidecar."""

    format: Literal["rsvib raw"]
    version: Literal[1]
    shape: list[int]
    axes: Literal["THW", "TCHW", "THWC"]
    dtype: Literal["uint8", "int8", "uint16", "int16", "uint32", "int32", "float16", "float32", "float64"]
    byte_order: Literal["little", "big"] = "little"
    offset: int = Field(default=0, ge=0)
    full_scale: float | None = None
    frame_times: list[float] | None = None
    frame_rate: float | None = Field(default=None, gt=0.0)
    orientation: int = Field(default=1, ge=1, le=8)
    resolution: tuple[float, float, str] | None = Field(default=None, strict=False)


def _sidecar_path(path: Path) -> Path:
    return path.with_name(path.name + ".json")


def open_raw(path: Path) -> BlockReader:
    """Open a file of pixels whose layout its sidecar states."""
    beside = _sidecar_path(path)
    if not beside.exists():
        raise FileNotFoundError(f"{path}: raw frames need the sidecar {beside.name}, which does not exist")
    sidecar = validate(_Sidecar, read_json(beside, "sidecar of raw frames"), str(beside))
    attributes = sidecar.model_dump(include={"axes", "full_scale", "frame_times", "frame_rate", "orientation"})
    if sidecar.resolution is not None:
        attributes |= {"resolution": sidecar.resolution[:2], "resolution_unit": sidecar.resolution[2]}
    dtype = np.dtype(sidecar.dtype)
    with readable_stack(path, "raw"):
        info = info_from_attributes(attributes, tuple(sidecar.shape), dtype)
        return contiguous_reader(path, info, sidecar.offset, dtype.newbyteorder(sidecar.byte_order))


def write_raw(path: Path, info: StackInfo, frames: Iterator[NDArray[Any]], compression: str | None) -> None:
    """Write a file frame by frame, and its sidecar; arguments as in ``StackFormat.write``."""
    attributes = attributes_of(info)
    if "resolution_unit" in attributes:
        attributes["resolution"].append(attributes.pop("resolution_unit"))
    kind = {"format": "rsvib raw", "version": 1, "shape": info.stored_shape, "dtype": info.dtype}
    content = {**kind, "byte_order": "little", "offset": 0, **attributes}
    _sidecar_path(path).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    with path.open("wb") as file:
        for frame in frames:
            file.write(info.to_stored(frame).data)
