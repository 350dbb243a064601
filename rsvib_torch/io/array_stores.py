"""Stacks in arrays: a dataset of an HDF5 file, and NumPy files."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rsvib_torch.checks.values import needed_package
from rsvib_torch.files.reading import size_text
from rsvib_torch.io.frame_reader import FrameReader, check_held, contiguous_reader, readable_stack
from rsvib_torch.io.stack_info import StackInfo, attributes_of, info_of_array
from rsvib_torch.numerics.tables import Array

if TYPE_CHECKING:
    from h5py import Dataset, File, Group

_NAME = "frames"  # of the dataset that is written
# bytes, and in stacks: HDF5 decodes a chunk as a whole, and a chunk may exceed the stack, as that of a recording which
# ended early. One of 400 MB around a stack of 16 KB took 4 s and 400 MB until the first frame was read
_LARGEST_CHUNK, _CHUNK_RATIO = 2**26, 8
_MAX_MEMBERS = 10_000  # groups and datasets; each takes about 0.1 ms

_h5py = partial(needed_package, "h5py", "reading and writing HDF5", "formats")


def _find_dataset(file: File) -> Dataset:
    """The only dataset of frames, or the one called ``frames``, among members of the file itself."""
    h5py = _h5py()
    datasets: dict[str, Dataset] = {}
    members = itertools.count(1)

    def visit(name: str, member: Group | Dataset) -> None:
        if next(members) > _MAX_MEMBERS:
            raise ValueError(f"it has more than {_MAX_MEMBERS} members; expected a file with one stack of frames")
        if isinstance(member, h5py.Dataset) and member.ndim in (3, 4) and member.dtype.kind in "iuf":
            datasets[name] = member

    file.visititems(visit)  # every member once, without links
    if len(datasets) != 1 and _NAME not in datasets:
        names = ", ".join(sorted(datasets)) or "none"
        raise ValueError(f"expected one array of frames (T, H, W), or one called {_NAME!r}; found {names}")
    dataset = datasets.get(_NAME, next(iter(datasets.values())))
    if dataset.external or dataset.is_virtual:
        raise ValueError(f"its dataset {dataset.name} lies in other files; frames must be in the file itself")
    return dataset


def open_hdf5(path: Path) -> FrameReader:
    """Open the dataset of a file that has the shape of a stack."""
    h5py = _h5py()
    with readable_stack(path, "HDF5"), ExitStack() as opened:
        # 1. What the file states.
        with h5py.File(path, "r", locking=False) as file:
            dataset = _find_dataset(file)
            shape = tuple(int(size) for size in dataset.shape)
            info = info_of_array(shape, dataset.dtype, dict(dataset.attrs))
            check_held(info.shape[0] * info.frame_bytes, min(dataset.id.get_storage_size(), path.stat().st_size))
            chunk = math.prod(dataset.chunks or (1,)) * int(dataset.dtype.itemsize)
            if chunk > max(_LARGEST_CHUNK, _CHUNK_RATIO * info.shape[0] * info.frame_bytes):
                stack = f"a stack of {size_text(info.shape[0] * info.frame_bytes)}"
                raise ValueError(f"a chunk of {size_text(chunk)} holds {stack}; store it in chunks of a frame")
            name, sides = dataset.name, dataset.chunks or (1, *shape[1:])
        # 2. Frames. HDF5 keeps decoded chunks of several frames until the last of their frames was read; one chunk
        # besides: measured with gzip, lzf, shuffle and without compression.
        count = math.prod(-(-size // side) for size, side in zip(shape[1:], sides[1:], strict=True))
        kept = count * chunk if sides[0] > 1 else 0
        slots = min(100 * count + 421, 10**6)  # as HDF5 recommends
        dataset = opened.enter_context(h5py.File(path, "r", locking=False, rdcc_nbytes=kept, rdcc_nslots=slots))[name]

        info = replace(info, decoding_bytes=kept + chunk)
        return FrameReader(path, info, lambda index: np.asarray(dataset[index]), opened.pop_all().close)


def write_hdf5(path: Path, info: StackInfo, frames: Iterator[Array]) -> None:
    """Write a file with a contiguous dataset, frame by frame.

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


def write_npy(path: Path, info: StackInfo, frames: Iterator[Array]) -> None:
    """Write a file frame by frame, channels second."""
    header = {"descr": np.lib.format.dtype_to_descr(np.dtype(info.dtype)), "fortran_order": False, "shape": info.shape}
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        for frame in frames:
            file.write(np.ascontiguousarray(frame).data)
