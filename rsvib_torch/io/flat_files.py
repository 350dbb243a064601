"""Stacks of pixels one after another: NumPy ``.npy``, and raw frames with a JSON file beside them (the sidecar)."""

import json
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from rsvib_torch.checks.arrays import channels_appear_last
from rsvib_torch.checks.validation import options, read_json, validate
from rsvib_torch.io.blocks import BlockReader, contiguous_reader
from rsvib_torch.io.full_scale import check_dtype
from rsvib_torch.io.stack_info import StackInfo, readable_stack
from rsvib_torch.io.stated_metadata import attributes_of, info_from_attributes
from rsvib_torch.numerics.tables import Array


def open_npy(path: Path) -> BlockReader:
    """Open (H, W), (T, H, W) or (T, C, H, W). Pickled objects are refused."""
    with readable_stack(path, ".npy"):
        with path.open("rb") as file:
            head = BytesIO(file.read(1 << 14))  # bytes; NumPy accepts headers of up to 10,000
        first = np.lib.format.read_magic(head) == (1, 0)
        read_header = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
        shape, fortran_order, dtype = read_header(head)
        check_dtype(dtype)
        if channels_appear_last(shape):
            raise ValueError(f"array of shape {shape} appears to have its channels last; store (T, C, H, W)")
        info = info_from_attributes({}, shape, dtype)
        if fortran_order:  # all frames together: the pixels of a frame lie everywhere in the file
            frames: Array = np.load(path, mmap_mode="r", allow_pickle=False).reshape(info.shape)
            return BlockReader(path, info, lambda *_: np.ascontiguousarray(frames), info.shape[0], info.frame_bytes)
        return contiguous_reader(path, info, head.tell(), dtype)


def write_npy(path: Path, info: StackInfo, frames: Iterator[Array], compression: str | None) -> None:
    """Write a file frame by frame, channels second; arguments as in ``StackFormat.write``."""
    header = {"descr": np.lib.format.dtype_to_descr(np.dtype(info.dtype)), "fortran_order": False, "shape": info.shape}
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        for frame in frames:
            file.write(np.ascontiguousarray(frame).data)


def check_npy(path: Path, info: StackInfo) -> None:
    """Refuse a shape that would be read as another one."""
    if channels_appear_last(info.shape):
        raise ValueError(f"{path}: array of shape {info.shape} would be read as one with channels last; write .tif")


@options
class _Sidecar:
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


def open_raw(path: Path) -> BlockReader:
    """Open a file of pixels whose layout its sidecar states."""
    beside = path.with_name(f"{path.name}.json")
    if not beside.exists():
        raise FileNotFoundError(f"{path}: raw frames need the sidecar {beside.name}, which does not exist")
    sidecar = validate(_Sidecar, read_json(beside, "sidecar of raw frames"), str(beside))
    names = ("axes", "full_scale", "frame_times", "frame_rate", "orientation")
    attributes = {name: getattr(sidecar, name) for name in names}
    if sidecar.resolution is not None:
        attributes |= {"resolution": sidecar.resolution[:2], "resolution_unit": sidecar.resolution[2]}
    dtype = np.dtype(sidecar.dtype)
    with readable_stack(path, "raw"):
        info = info_from_attributes(attributes, tuple(sidecar.shape), dtype)
        return contiguous_reader(path, info, sidecar.offset, dtype.newbyteorder(sidecar.byte_order))


def write_raw(path: Path, info: StackInfo, frames: Iterator[Array], compression: str | None) -> None:
    """Write a file frame by frame, and its sidecar; arguments as in ``StackFormat.write``."""
    attributes = attributes_of(info)
    if "resolution_unit" in attributes:
        attributes["resolution"].append(attributes.pop("resolution_unit"))
    kind = {"format": "rsvib raw", "version": 1, "shape": info.stored_shape, "dtype": info.dtype}
    content = {**kind, "byte_order": "little", "offset": 0, **attributes}
    path.with_name(f"{path.name}.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    with path.open("wb") as file:
        for frame in frames:
            file.write(info.to_stored(frame).data)
