"""Stacks in arrays: a dataset of an HDF5 file, a Zarr v3 array in a local folder, and NumPy files."""

from __future__ import annotations

import itertools
import math
import stat
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from rsvib_torch.checks.values import Value, needed_package
from rsvib_torch.io.frame_reader import FrameReader, contiguous_reader, readable_stack
from rsvib_torch.io.stack_info import StackInfo
from rsvib_torch.io.stated_metadata import attributes_of, info_of_array
from rsvib_torch.numerics.tables import Array

if TYPE_CHECKING:
    from h5py import Dataset, File, Group
    from zarr import Array as ZarrArray
    from zarr.core.metadata import ArrayV3Metadata

    Stored: TypeAlias = Dataset | ZarrArray[ArrayV3Metadata]

_NAME = "frames"  # of the array that is written
_MAX_MEMBERS = 10_000  # groups and datasets of HDF5; each takes about 0.1 ms
_HEADER = "zarr.json"
_MAX_CHUNKS = 1 << 14  # of Zarr per frame; each takes about 0.3 ms
_CONCURRENT = 10  # chunks that zarr decodes at the same time (async.concurrency)
_BUFFERS = 3  # of a chunk while zarr decodes it, at most; measured with gzip, zstd needs 2


def _only(arrays: Mapping[str, Value]) -> Value:
    """The only one of arrays by their names, or the one called ``frames``."""
    stacks = {_NAME: arrays[_NAME]} if _NAME in arrays else arrays
    if len(stacks) != 1:
        names = ", ".join(sorted(stacks)) or "none"
        raise ValueError(f"expected one array of frames, or one called {_NAME!r}; found {names}")
    return next(iter(stacks.values()))


def _info(array: Stored) -> StackInfo:
    return info_of_array(tuple(int(size) for size in array.shape), array.dtype, dict(array.attrs))


def _reader(
    path: Path, info: StackInfo, array: Stored, more_bytes: int, close: Callable[[], None] = lambda: None
) -> FrameReader:
    """Reader of an array, (T, ...) or a single frame, with the frames of a chunk together."""

    def read(first: int, last: int) -> Array:
        return np.asarray(array[first:last]) if array.ndim > 2 else np.asarray(array[...])[None]

    return FrameReader(path, info, read, array.chunks[0] if array.chunks and array.ndim > 2 else 1, more_bytes, close)


# HDF5

_h5py = partial(needed_package, "h5py", "reading and writing HDF5", "formats")


def _find_dataset(file: File) -> Dataset:
    """The only dataset of frames, or the one called ``frames``, among members of the file itself."""
    h5py = _h5py()
    found: dict[str, Dataset] = {}
    members = itertools.count(1)

    def visit(name: str, member: Group | Dataset) -> None:
        if next(members) > _MAX_MEMBERS:
            raise ValueError(f"it has more than {_MAX_MEMBERS} members; expected a file with one stack of frames")
        if isinstance(member, h5py.Dataset) and member.ndim in (2, 3, 4) and member.dtype.kind in "iuf":
            found[name] = member

    file.visititems(visit)  # every member once, without links
    stacks = {name: member for name, member in found.items() if member.ndim > 2 or name == _NAME}
    dataset = _only(stacks or found)
    if dataset.external or dataset.is_virtual:
        raise ValueError(f"its dataset {dataset.name} lies in other files; frames must be in the file itself")
    return dataset


def _check_dataset(dataset: Dataset, file_size: int) -> int:
    """Size of a chunk in bytes; a ``ValueError`` if the pixels cannot be in the file, before memory is allocated."""
    stored = dataset.id.get_storage_size()
    needed = int(np.prod(dataset.shape, dtype=object)) * dataset.dtype.itemsize
    compressed = dataset.compression or dataset.id.get_create_plist().get_nfilters()
    largest_ratio = 5000 if compressed else 1  # of pixels to stored bytes; gzip reaches 1032
    if stored > file_size or needed > largest_ratio * stored:
        raise ValueError(f"its header states {needed} bytes of pixels, the file holds {stored}")
    chunk: int = math.prod(dataset.chunks or (1,)) * int(dataset.dtype.itemsize)
    if chunk > max(needed, 1 << 26):  # 64 MiB are accepted even if the stack is smaller
        raise ValueError(f"its chunks of {chunk} bytes are larger than the stack of {needed}")
    return chunk


def open_hdf5(path: Path) -> FrameReader:
    """Open the dataset of a file that has the shape of a stack."""
    h5py = _h5py()
    with readable_stack(path, "HDF5"), ExitStack() as opened:
        file = opened.enter_context(h5py.File(path, "r", locking=False))
        dataset = _find_dataset(file)
        info = _info(dataset)
        chunk = _check_dataset(dataset, path.stat().st_size)
        # one decoded chunk besides the block; measured with gzip, lzf, shuffle and without compression
        return _reader(path, info, dataset, chunk, opened.pop_all().close)


def write_hdf5(path: Path, info: StackInfo, frames: Iterator[Array], compression: str | None) -> None:
    """Write a file with a contiguous dataset, frame by frame; arguments as in ``StackFormat.write``.

    HDF5 writes the header only: it ends the process if the disk is full when a file with pixels is closed.
    """
    h5py = _h5py()
    with h5py.File(path, "w", locking=False, libver="v110") as file:
        layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        layout.set_layout(h5py.h5d.CONTIGUOUS)
        layout.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
        layout.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
        kind = np.dtype(info.dtype).newbyteorder("<")
        dataset = file.create_dataset(_NAME, info.shape, kind, dcpl=layout, track_times=False)
        dataset.attrs.update(attributes_of(info))
        offset = int(dataset.id.get_offset())
    with path.open("r+b") as pixels:
        pixels.seek(offset)
        for frame in frames:
            pixels.write(np.ascontiguousarray(frame, kind).data)


# Zarr

_zarr = partial(needed_package, "zarr", "reading and writing Zarr", "formats")


def _check_sizes(array: Stored, info: StackInfo, folder: Path) -> None:
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


def open_zarr(path: Path) -> FrameReader:
    """Open the array of a folder, or of a group its only array or the one called ``frames``."""
    zarr = _zarr()
    with readable_stack(path, "Zarr"):
        if not (path / _HEADER).is_file():
            raise ValueError(f"it contains no {_HEADER}; expected a Zarr v3 array")
        node = zarr.open(store=str(path), mode="r", zarr_format=3)
        array = node if isinstance(node, zarr.Array) else _only(dict(node.arrays()))
        info = _info(array)
        _check_sizes(array, info, path / array.path)
        chunks = math.prod(-(-size // part) for size, part in zip(array.shape[-2:], array.chunks[-2:], strict=True))
        if chunks > _MAX_CHUNKS:
            raise ValueError(f"a frame is divided into {chunks} chunks; expected at most {_MAX_CHUNKS}")
        chunk_bytes = math.prod(array.chunks) * array.dtype.itemsize
        return _reader(path, info, array, _BUFFERS * min(chunks, _CONCURRENT) * chunk_bytes)


_DIMENSIONS = {"T": "frame", "C": "channel", "H": "y", "W": "x"}


def write_zarr(path: Path, info: StackInfo, frames: Iterator[Array], compression: str | None) -> None:
    """Write a group with the array ``frames``, one chunk per frame, as ``xarray.open_zarr`` reads it."""
    group = _zarr().create_group(store=str(path), zarr_format=3)
    array = group.create_array(
        _NAME,
        shape=info.shape,
        chunks=(1, *info.shape[1:]),
        dtype=info.dtype,
        fill_value=0,
        config={"write_empty_chunks": True},
        attributes=attributes_of(info),
        dimension_names=[_DIMENSIONS[axis] for axis in info.axes],
    )
    if info.frame_times is not None:
        times = np.asarray(info.frame_times)
        group.create_array("time", data=times, dimension_names=["frame"], attributes={"units": "s"})
    for index, frame in enumerate(frames):
        array[index] = np.asarray(frame, info.dtype)
    # copy the metadata of the arrays into the header of the group; xarray warns where it reads them one by one
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # other programs read the headers of the arrays, which remain
        _zarr().consolidate_metadata(str(path))


def open_npy(path: Path) -> FrameReader:
    """Open (H, W), (T, H, W) or (T, C, H, W). Pickled objects are refused."""
    with readable_stack(path, ".npy"):
        with path.open("rb") as file:
            head = BytesIO(file.read(1 << 14))  # bytes; NumPy accepts headers of up to 10,000
        first = np.lib.format.read_magic(head) == (1, 0)
        read_header = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
        shape, fortran_order, dtype = read_header(head)
        info = info_of_array(shape, dtype)
        if fortran_order:  # the pixels of a frame lie everywhere in the file
            raise ValueError("the array has Fortran order; store numpy.ascontiguousarray(array)")
        return contiguous_reader(path, info, head.tell(), dtype)


def write_npy(path: Path, info: StackInfo, frames: Iterator[Array], compression: str | None) -> None:
    """Write a file frame by frame, channels second; arguments as in ``StackFormat.write``."""
    header = {"descr": np.lib.format.dtype_to_descr(np.dtype(info.dtype)), "fortran_order": False, "shape": info.shape}
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        for frame in frames:
            file.write(np.ascontiguousarray(frame).data)
