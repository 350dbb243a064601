"""Stacks in HDF5 files: one dataset of frames with attributes."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rsvib_torch.checks.values import needed_package
from rsvib_torch.files.reading import Table
from rsvib_torch.io.blocks import BlockReader, array_reader
from rsvib_torch.io.full_scale import check_dtype
from rsvib_torch.io.stack_info import StackInfo, readable_stack
from rsvib_torch.io.stated_metadata import attributes_of, info_from_attributes, time_attributes, times_of_attributes
from rsvib_torch.numerics.tables import Array

if TYPE_CHECKING:
    import h5py

_DATASET = "frames"  # name of the dataset that is written
_MAX_MEMBERS = 10_000  # groups and datasets; each takes about 0.1 ms


def _h5py() -> Any:
    return needed_package("h5py", "reading and writing HDF5", "formats")


def _find_dataset(file: h5py.File) -> h5py.Dataset:
    """The only dataset of frames, or the one called ``frames``; links and external data are not followed."""
    h5py = _h5py()
    found: list[Any] = []
    members = itertools.count(1)

    def visit(_: str, member: Any) -> None:
        if next(members) > _MAX_MEMBERS:
            raise ValueError(f"it has more than {_MAX_MEMBERS} members; expected a file with one stack of frames")
        if isinstance(member, h5py.Dataset) and member.ndim in (2, 3, 4) and member.dtype.kind in "iuf":
            found.append(member)

    file.visititems(visit)  # every member once, without links
    if not isinstance(file.get(_DATASET, getlink=True, default=h5py.HardLink()), h5py.HardLink):
        raise ValueError(f"its dataset {_DATASET!r} is a link; frames must be in the file itself")
    named = [member for member in found if member.name == f"/{_DATASET}"]
    stacks = named or [member for member in found if member.ndim > 2] or found
    if len(stacks) != 1:
        names = ", ".join(sorted(member.name for member in stacks))
        raise ValueError(f"expected one dataset of frames, or one called {_DATASET!r}; found {names or 'none'}")
    if _is_outside(stacks[0]):
        raise ValueError(f"its dataset {stacks[0].name} lies in other files; frames must be in the file itself")
    return stacks[0]


def _is_outside(dataset: h5py.Dataset) -> bool:
    """Whether the values of a dataset lie in other files or datasets."""
    return bool(dataset.external or dataset.is_virtual)


def _check_sizes(dataset: h5py.Dataset, file_size: int) -> int:
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


def _times_beside(file: h5py.File, dataset: h5py.Dataset, count: int) -> Table:
    """Times and frame rate in datasets beside the frames, or in attributes of their group or of the file."""
    h5py = _h5py()
    found: Table = {}
    for group in (file, dataset.parent):
        found |= time_attributes(group.attrs)
        for name in time_attributes(dict.fromkeys(group)):
            member = group[name] if isinstance(group.get(name, getlink=True), h5py.HardLink) else None
            if not isinstance(member, h5py.Dataset) or _is_outside(member):
                continue
            if member.shape in ((), (1,), (count,)) and member.dtype.kind in "iuf":
                found[name] = member[...]
                found |= {f"{name}_units": member.attrs[key] for key in ("unit", "units") if key in member.attrs}
    return times_of_attributes(found, count)


def open_hdf5(path: Path) -> BlockReader:
    """Open the dataset of a file that has the shape of a stack."""
    h5py = _h5py()
    with readable_stack(path, "HDF5"), ExitStack() as opened:
        file = opened.enter_context(h5py.File(path, "r", locking=False))
        dataset = _find_dataset(file)
        check_dtype(dataset.dtype)
        info = info_from_attributes(dict(dataset.attrs), tuple(dataset.shape), dataset.dtype)
        chunk = _check_sizes(dataset, path.stat().st_size)
        if info.frame_times is None and info.frame_rate is None:
            info = replace(info, **_times_beside(file, dataset, info.shape[0]))
        # one decoded chunk besides the block; measured with gzip, lzf, shuffle and without compression
        chunk_frames = dataset.chunks[0] if dataset.chunks and dataset.ndim > 2 else 1
        return array_reader(path, info, dataset, chunk_frames, chunk, opened.pop_all().close)


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
        dataset = file.create_dataset(_DATASET, info.stored_shape, kind, dcpl=layout, track_times=False)
        dataset.attrs.update(attributes_of(info))
        offset = int(dataset.id.get_offset())
    with path.open("r+b") as pixels:
        pixels.seek(offset)
        for frame in frames:
            pixels.write(info.to_stored(frame).data)
