"""Stacks in HDF5 files: one dataset of frames with attributes."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsvib_torch.io.attributes import attributes_of, info_from_attributes
from rsvib_torch.io.formats import StackFormat, needed_package, register_format
from rsvib_torch.io.full_scale import check_dtype
from rsvib_torch.io.placed import PlacedReader, PlacedWriter, frame_from_file_order
from rsvib_torch.io.stack_info import FrameError, StackInfo

__all__ = ["create_hdf5", "open_hdf5"]

_NAME = "frames"  # of our own dataset
_LARGEST_RATIO = 5000  # pixel bytes per stored byte of compressed data


def _h5py() -> Any:
    return needed_package("h5py", "reading and writing HDF5", "formats")


def _dataset(file: Any) -> Any:
    """The one dataset of frames; what lies in other files is not followed."""
    h5py = _h5py()
    found = []

    def look(group: Any, depth: int) -> None:
        for name in group:
            link = group.get(name, getlink=True)
            if not isinstance(link, h5py.HardLink):
                if name == _NAME:
                    raise ValueError(f"its dataset {name!r} is a link; frames must be in the file itself")
                continue
            member = group[name]
            if isinstance(member, h5py.Group) and depth < 4:
                look(member, depth + 1)
            elif isinstance(member, h5py.Dataset) and member.ndim in (2, 3, 4) and member.dtype.kind in "iuf":
                found.append(member)

    look(file, 0)
    own = [member for member in found if member.name == f"/{_NAME}"]
    stacks = own or [member for member in found if member.ndim > 2] or found
    if len(stacks) != 1:
        names = ", ".join(sorted(member.name for member in stacks))
        raise ValueError(f"expected one dataset of frames, or one called {_NAME!r}; found {names or 'none'}")
    if stacks[0].external or stacks[0].is_virtual:
        raise ValueError(f"its dataset {stacks[0].name} lies in other files; frames must be in the file itself")
    return stacks[0]


class Hdf5Reader:
    """Frames of a dataset that is stored in chunks."""

    def __init__(self, path: Path, file: Any, dataset: Any, info: StackInfo) -> None:
        self.info = info
        self._path, self._file, self._dataset = path, file, dataset

    def frame(self, index: int) -> NDArray[Any]:
        """Pixels of a frame as stored."""
        try:
            stored = self._dataset[index] if self._dataset.ndim > 2 else self._dataset[()]
        except (OSError, RuntimeError, ValueError) as error:
            raise FrameError(f"{self._path}: frame {index} cannot be read: {' '.join(str(error).split())}") from error
        frame = frame_from_file_order(stored, self.info)
        return frame.astype(frame.dtype.newbyteorder("="), copy=False)

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()


def _checked(path: Path, file: Any) -> Hdf5Reader | PlacedReader:
    dataset = _dataset(file)
    check_dtype(dataset.dtype)
    info = info_from_attributes(dict(dataset.attrs), tuple(dataset.shape), dataset.dtype)
    stored = dataset.id.get_storage_size()
    needed = int(np.prod(dataset.shape, dtype=object)) * dataset.dtype.itemsize
    plain = not dataset.compression and not dataset.id.get_create_plist().get_nfilters()
    if stored > path.stat().st_size or needed > (1 if plain else _LARGEST_RATIO) * stored:
        raise ValueError(f"its header promises {needed} bytes of pixels, the file holds {stored}")
    offset = dataset.id.get_offset()
    if dataset.chunks is None and offset is not None:
        return PlacedReader(path, info, int(offset), dataset.dtype)
    chunk = int(np.prod(dataset.chunks or (1,), dtype=object)) * dataset.dtype.itemsize
    if chunk > max(needed, 1 << 26):
        raise ValueError(f"its chunks of {chunk} bytes are larger than the stack of {needed}")
    return Hdf5Reader(path, file, dataset, info)


def open_hdf5(path: Path) -> Hdf5Reader | PlacedReader:
    """Open the one dataset of frames of an HDF5 file, or the one called ``frames``."""
    h5py = _h5py()
    with path.open("rb"):
        pass  # a file that may not be read is an OSError of its own
    file = None
    try:
        file = h5py.File(path, "r", locking=False)
        reader = _checked(path, file)
    except MemoryError:
        raise
    except Exception as error:
        if file is not None:
            file.close()
        raise ValueError(f"{path}: not a readable HDF5 stack: {' '.join(str(error).split())}") from error
    if isinstance(reader, PlacedReader):
        file.close()
    return reader


def create_hdf5(path: Path, info: StackInfo, fresh: bool) -> PlacedWriter:
    """Make an HDF5 file with the dataset ``frames`` in one piece, or go on with one."""
    h5py = _h5py()
    if fresh:
        with h5py.File(path, "w", locking=False, libver="v110") as file:
            space = h5py.h5s.create_simple(info.stored_shape)
            layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
            layout.set_layout(h5py.h5d.CONTIGUOUS)
            layout.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
            layout.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
            layout.set_obj_track_times(False)
            kind = h5py.h5t.py_create(np.dtype(info.dtype).newbyteorder("<"))
            made = h5py.h5d.create(file.id, _NAME.encode(), kind, space, layout)
            h5py.Dataset(made).attrs.update(attributes_of(info))
    with h5py.File(path, "r", locking=False) as file:
        offset = int(file[_NAME].id.get_offset())
    writer = PlacedWriter(path, info, offset)
    return writer.reserve() if fresh else writer


register_format(StackFormat("hdf5", (".h5", ".hdf5", ".hdf"), open_hdf5, create_hdf5))
