"""Stacks in Zarr v3 arrays in a local folder."""

import math
import stat
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rsvib_torch.checks.values import needed_package
from rsvib_torch.io.blocks import BlockReader, array_reader
from rsvib_torch.io.full_scale import check_dtype
from rsvib_torch.io.stack_info import StackInfo, readable_stack
from rsvib_torch.io.stated_metadata import attributes_of, info_from_attributes
from rsvib_torch.numerics.tables import Array

_HEADER = "zarr.json"
_MAX_CHUNKS = 1 << 14  # per frame; each takes about 0.3 ms
_CONCURRENT = 10  # chunks that zarr decodes at the same time (async.concurrency)
_BUFFERS = 3  # of a chunk while it is decoded, at most; measured with gzip, zstd needs 2


def _zarr() -> Any:
    return needed_package("zarr", "reading and writing Zarr", "formats")


def _find_array(path: Path) -> Any:
    """The array of a folder, or of a group its only array or the one called ``frames``."""
    zarr = _zarr()
    node = zarr.open(store=str(path), mode="r", zarr_format=3)
    if isinstance(node, zarr.Array):
        return node
    arrays = dict(node.arrays())
    stacks = {name: arrays[name] for name in arrays if name == "frames"} or arrays
    if len(stacks) != 1:
        raise ValueError(f"expected one array of frames, or one called 'frames'; found {', '.join(stacks) or 'none'}")
    return next(iter(stacks.values()))


def _check_sizes(array: Any, info: StackInfo, folder: Path) -> None:
    """Raise a ``ValueError`` if the pixels cannot be in the folder, before memory is allocated for them."""
    chunk = int(np.prod(array.shards or array.chunks, dtype=object)) * array.dtype.itemsize
    held = 0
    for file in folder.rglob("*"):
        status = file.lstat()
        if not (stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)):
            raise ValueError(f"it contains {file.name}, which is not a regular file")
        held += status.st_size if stat.S_ISREG(status.st_mode) else 0
    largest_chunk = 1 << 30  # bytes, also of a frame
    largest_ratio = 100_000  # of pixels to stored bytes; chunks of constant frames are very small
    if max(chunk, info.frame_bytes) > largest_chunk or info.shape[0] * info.frame_bytes > largest_ratio * held:
        stated = f"{info.shape[0]} frames of {info.frame_bytes} bytes in chunks of {chunk}"
        raise ValueError(f"its header states {stated}, the folder holds {held} bytes")


def open_zarr(path: Path) -> BlockReader:
    """Open the array of a folder that has the shape of a stack."""
    _zarr()
    with readable_stack(path, "Zarr"):
        if not (path / _HEADER).is_file():
            raise ValueError(f"it contains no {_HEADER}; expected a Zarr v3 array")
        array = _find_array(path)
        check_dtype(array.dtype)
        info = info_from_attributes(dict(array.attrs), tuple(int(size) for size in array.shape), array.dtype)
        _check_sizes(array, info, path / array.path)
        chunk_frames = min(array.chunks[0], info.shape[0]) if array.ndim > 2 else 1
        chunks = math.prod(-(-size // part) for size, part in zip(array.shape[-2:], array.chunks[-2:], strict=True))
        if chunks > _MAX_CHUNKS:
            raise ValueError(f"a frame is divided into {chunks} chunks; expected at most {_MAX_CHUNKS}")
        chunk_bytes = math.prod(array.chunks) * array.dtype.itemsize
        return array_reader(path, info, array, chunk_frames, _BUFFERS * min(chunks, _CONCURRENT) * chunk_bytes)


_DIMENSIONS = {"T": "frame", "C": "channel", "H": "y", "W": "x"}


def write_zarr(path: Path, info: StackInfo, frames: Iterator[Array], compression: str | None) -> None:
    """Write a group with the array ``frames``, one chunk per frame, as ``xarray.open_zarr`` reads it."""
    group = _zarr().create_group(store=str(path), zarr_format=3)
    array = group.create_array(
        "frames",
        shape=info.stored_shape,
        chunks=(1, *info.stored_shape[1:]),
        dtype=info.dtype,
        fill_value=0,
        config={"write_empty_chunks": True},
        attributes=attributes_of(info),
        dimension_names=[_DIMENSIONS[axis] for axis in info.stored_axes],
    )
    if info.frame_times is not None:
        times = np.asarray(info.frame_times)
        group.create_array("time", data=times, dimension_names=["frame"], attributes={"units": "s"})
    for index, frame in enumerate(frames):
        array[index] = info.to_stored(frame)
    # copy the metadata of the arrays into the header of the group; xarray warns where it reads them one by one
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # other programs read the headers of the arrays, which remain
        _zarr().consolidate_metadata(str(path))
