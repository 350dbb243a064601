"""Raw frames one after another, with a small JSON file beside them that says what they are."""

import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from rsvib_torch.core.validation import Section, read_json, validate
from rsvib_torch.io.formats import StackFormat, register_format
from rsvib_torch.io.full_scale import known_full_scale
from rsvib_torch.io.placed import PlacedReader, PlacedWriter
from rsvib_torch.io.stack_info import StackInfo

__all__ = ["create_raw", "open_raw", "sidecar"]


class _Sidecar(Section):
    """Keys of the file beside the frames."""

    format: Literal["rsvib raw"]
    version: Literal[1]
    shape: list[int]
    axes: Literal["THW", "TCHW", "THWC"]
    dtype: Literal["uint8", "int8", "uint16", "int16", "uint32", "int32", "float16", "float32", "float64"]
    byte_order: Literal["little", "big"] = "little"
    offset: int = Field(default=0, ge=0)
    full_scale: float | None = None
    frame_times: list[float] | None = None
    resolution: tuple[float, float, str] | None = Field(default=None, strict=False)


def sidecar(path: Path) -> Path:
    """The file that says what the frames of ``path`` are: its name with ``.json`` added."""
    return path.with_name(path.name + ".json")


def _read_sidecar(path: Path) -> tuple[StackInfo, int, np.dtype[Any]]:
    beside = sidecar(path)
    if not beside.exists():
        raise FileNotFoundError(f"{path}: raw frames need {beside.name} beside them, which does not exist")
    content = validate(_Sidecar, read_json(beside, "sidecar of raw frames"), str(beside))
    if len(content.shape) != len(content.axes) or min(content.shape) < 1:
        raise ValueError(f"{beside}: shape: expected {len(content.axes)} positive sizes, got {content.shape}")
    last = content.axes == "THWC"
    T, *rest = content.shape
    shape = (T, rest[2], rest[0], rest[1]) if last else (T, *rest)
    times = None if content.frame_times is None else tuple(content.frame_times)
    dtype = np.dtype(content.dtype).newbyteorder(content.byte_order)
    scale = known_full_scale(np.dtype(content.dtype), content.full_scale)
    return StackInfo(shape, content.dtype, scale, times, content.resolution, last), content.offset, dtype


def open_raw(path: Path) -> PlacedReader:
    """Open raw frames."""
    info, offset, dtype = _read_sidecar(path)
    try:
        return PlacedReader(path, info, offset, dtype)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def create_raw(path: Path, info: StackInfo, fresh: bool) -> PlacedWriter:
    """Make a file of raw frames with its sidecar, or go on with one."""
    if not fresh:
        return PlacedWriter(path, info, 0)
    content = {
        "format": "rsvib raw",
        "version": 1,
        "shape": list(info.stored_shape),
        "axes": info.stored_axes,
        "dtype": info.dtype,
        "byte_order": "little",
        "offset": 0,
        "full_scale": info.full_scale,
        "frame_times": None if info.frame_times is None else list(info.frame_times),
        "resolution": None if info.resolution is None else list(info.resolution),
    }
    sidecar(path).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    path.write_bytes(b"")
    return PlacedWriter(path, info, 0).reserve()


register_format(StackFormat("raw", (".raw",), open_raw, create_raw, companions=(".json",)))
