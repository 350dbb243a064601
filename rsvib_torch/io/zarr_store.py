"""Stacks in Zarr v3 arrays of a local folder."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsvib_torch.core.validation import read_json
from rsvib_torch.io.attributes import attributes_of, info_from_attributes
from rsvib_torch.io.formats import StackFormat, needed_package, register_format
from rsvib_torch.io.full_scale import check_dtype
from rsvib_torch.io.placed import frame_from_file_order, frame_to_file_order
from rsvib_torch.io.stack_info import FrameError, StackInfo

__all__ = ["create_zarr", "open_zarr"]

_CODECS = {"bytes", "transpose", "blosc", "gzip", "zstd", "crc32c", "sharding_indexed"}
_LARGEST_CHUNK = 1 << 30  # bytes
_LARGEST_RATIO = 100_000  # pixel bytes per stored byte: empty frames pack tight


def _zarr() -> Any:
    return needed_package("zarr", "reading and writing Zarr", "formats")


def _array_folder(path: Path) -> Path:
    """The array itself, or the only one of a group."""
    if read_json(path / "zarr.json", "Zarr v3 array").get("node_type") != "group":
        return path
    arrays = [
        folder
        for folder in sorted(path.iterdir())
        if not folder.is_symlink()
        and (folder / "zarr.json").is_file()
        and read_json(folder / "zarr.json", "Zarr v3 array").get("node_type") == "array"
    ]
    named = [folder for folder in arrays if folder.name == "frames"] or arrays
    if len(named) != 1:
        names = ", ".join(folder.name for folder in named)
        raise ValueError(f"expected one array of frames, or one called 'frames'; found {names or 'none'}")
    return named[0]


def _check_codecs(codecs: Any) -> None:
    """Only codecs of the Zarr specification: others may run code of their own."""
    for codec in codecs:
        name = codec.get("name") if isinstance(codec, dict) else codec
        if name not in _CODECS:
            raise ValueError(f"codec {name!r} is none of the Zarr v3 specification")
        if name == "sharding_indexed":
            _check_codecs(codec["configuration"]["codecs"])


class ZarrReader:
    """Frames of a Zarr array."""

    def __init__(self, path: Path, array: Any, info: StackInfo) -> None:
        self.info = info
        self._path, self._array = path, array

    def frame(self, index: int) -> NDArray[Any]:
        """Pixels of a frame as stored."""
        try:
            stored = np.asarray(self._array[index] if self._array.ndim > 2 else self._array[...])
        except MemoryError:
            raise
        except Exception as error:
            raise FrameError(f"{self._path}: frame {index} cannot be read: {' '.join(str(error).split())}") from error
        frame = frame_from_file_order(stored, self.info)
        return frame.astype(frame.dtype.newbyteorder("="), copy=False)

    def close(self) -> None:
        """Let go of the store."""


def _opened(path: Path) -> ZarrReader:
    zarr = _zarr()
    folder = _array_folder(path)
    header = read_json(folder / "zarr.json", "Zarr v3 array")
    if header.get("zarr_format") != 3 or header.get("node_type") != "array":
        raise ValueError("expected a Zarr v3 array")
    _check_codecs(header["codecs"])
    array = zarr.open_array(store=str(folder), mode="r", zarr_format=3)
    check_dtype(array.dtype)
    info = info_from_attributes(dict(array.attrs), tuple(int(size) for size in array.shape), array.dtype)
    chunk = int(np.prod(array.shards or array.chunks, dtype=object)) * array.dtype.itemsize
    frame = int(np.prod(info.shape[1:], dtype=object)) * array.dtype.itemsize
    held = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    if max(chunk, frame) > _LARGEST_CHUNK or info.shape[0] * frame > _LARGEST_RATIO * held:
        raise ValueError(
            f"its header promises {info.shape[0]} frames of {frame} bytes in chunks of {chunk}, it holds {held} bytes"
        )
    return ZarrReader(path, array, info)


def open_zarr(path: Path) -> ZarrReader:
    """Open a Zarr v3 array, or the only one (or the one called ``frames``) of a group."""
    _zarr()
    if not (path / "zarr.json").is_file():
        raise ValueError(f"{path}: not a readable Zarr stack: there is no zarr.json (Zarr v3) in it")
    try:
        return _opened(path)
    except MemoryError:
        raise
    except Exception as error:
        raise ValueError(f"{path}: not a readable Zarr stack: {' '.join(str(error).split())}") from error


class ZarrWriter:
    """Frames of a Zarr array, one chunk each."""

    def __init__(self, array: Any, info: StackInfo) -> None:
        self._array, self._info = array, info

    def write(self, index: int, frame: NDArray[Any]) -> None:
        """Write the chunk of a frame."""
        self._array[index] = frame_to_file_order(frame, self._info)

    def sync(self) -> None:
        """Nothing is kept back."""

    def close(self) -> None:
        """Nothing is left to do."""


def create_zarr(path: Path, info: StackInfo, fresh: bool) -> ZarrWriter:
    """Make a Zarr v3 array, or go on with one."""
    zarr = _zarr()
    if not fresh:
        for torn in path.rglob("*.partial"):  # what the store leaves of a chunk when the process is killed
            torn.unlink()
        return ZarrWriter(zarr.open_array(store=str(path), mode="r+", zarr_format=3), info)
    array = zarr.create_array(
        store=str(path),
        shape=info.stored_shape,
        chunks=(1, *info.stored_shape[1:]),
        dtype=info.dtype,
        fill_value=0,
        zarr_format=3,
        config={"write_empty_chunks": True},
        attributes=attributes_of(info),
        dimension_names=list(info.stored_axes),
    )
    return ZarrWriter(array, info)


register_format(StackFormat("zarr", (".zarr",), open_zarr, create_zarr, kind="tree"))
