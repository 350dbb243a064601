"""Stacks with one file per frame: folders of PNG, TIFF or JPEG files in natural order, or one PNG or JPEG file."""

import re
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsvib_torch.io.blocks import BlockReader
from rsvib_torch.io.images import decode_image, encode_png, image_info
from rsvib_torch.io.stack_info import DIFFERENT, FrameError, StackInfo, Tag
from rsvib_torch.io.tiff import open_tiff, storage_of, write_tiff
from rsvib_torch.io.time_metadata import merged_times

_PNG, _TIFF, _JPEG = (".png",), (".tif", ".tiff"), (".jpg", ".jpeg")
_KINDS = {"PNG": _PNG, "TIFF": _TIFF, "JPEG": _JPEG}
_ENDINGS = (*_PNG, *_TIFF, *_JPEG)
_PNG_TYPES = ("uint8", "uint16")


def _natural_key(path: Path) -> list[tuple[int, int, str]]:
    """Key that sorts frame9 before frame10."""
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts if part]


def _frame_files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    visible = [file for file in path.iterdir() if not file.name.startswith(".") and file.is_file()]
    files = {kind: [f for f in visible if f.suffix.lower() in endings] for kind, endings in _KINDS.items()}
    found = [kind for kind in files if files[kind]]
    if len(found) > 1:
        raise ValueError(f"{path}: the folder contains both {' and '.join(found)} files; expected one kind")
    if not found:
        raise ValueError(f"{path}: the folder contains no PNG, TIFF or JPEG files")
    return sorted(files[found[0]], key=_natural_key)


def _frame_numbers(files: list[Path]) -> tuple[int, ...] | None:
    """Number of frame intervals from the first file to each one, if the numbers in the names show that some are gone.

    Names must differ in one number, whose most common step is its smallest, and divides all steps: frame_0, frame_1,
    frame_3. Other names, e.g. with times in ms (frame_0, frame_33, frame_67), state nothing.
    """
    names = [re.split(r"(\d+)", file.stem) for file in files]
    if len(files) < 3 or any(len(name) != len(names[0]) or name[::2] != names[0][::2] for name in names):
        return None
    numbers = np.array([[int(part) for part in name[1::2]] for name in names], dtype=object)
    varying = [column for column in numbers.T if len(set(column)) > 1]
    if len(varying) != 1:
        return None
    steps = np.diff(varying[0])
    step = min(steps)
    if step < 1 or np.median(steps.astype(float)) != step or any(steps % step) or all(steps == step):
        return None
    return tuple(int(number - varying[0][0]) // step for number in varying[0])


def _read_info(file: Path) -> StackInfo:
    if file.suffix.lower() not in _TIFF:
        return image_info(file)
    reader = open_tiff(file)
    reader.close()
    if reader.info.shape[0] != 1:
        raise ValueError(f"{file}: expected one image per file, this file contains {reader.info.shape[0]}")
    return reader.info


def _read_frame(file: Path) -> NDArray[Any]:
    if file.suffix.lower() not in _TIFF:
        return decode_image(file)
    with closing(open_tiff(file)) as reader:
        return reader.frame(0)


def _without_position(info: StackInfo) -> StackInfo:
    """What must be the same in all files of a folder."""
    return replace(info, resolution=None, frame_times=None)


def open_images(path: Path) -> BlockReader:
    """Open the files of a folder, or one file; frames are decoded on access."""
    files = _frame_files(path)
    damaged: dict[int, ValueError] = {}
    first: tuple[StackInfo, Path] | None = None
    infos: list[StackInfo | None] = [None] * len(files)
    for index, file in enumerate(files):
        try:
            infos[index] = info = _read_info(file)
        except ValueError as error:
            damaged[index] = error
            continue
        if first is None:
            first = (info, file)
        if _without_position(info) != _without_position(first[0]):
            raise ValueError(
                f"frames of different size or kind: {first[1].name} is {first[0].kind}, {file.name} is {info.kind}"
            )
    if first is None or len(damaged) > len(files) // 2:
        raise next(iter(damaged.values()))
    of_files = [info.metadata for info in infos if info is not None]
    metadata: dict[str, Tag | None] = {}
    for name in dict.fromkeys(chain.from_iterable(of_files)):
        same = all(name in tags and tags[name] == of_files[0].get(name) for tags in of_files)
        metadata |= {name: of_files[0][name]} if same else {f"{name}{DIFFERENT}": None}
    stack = replace(first[0], frame_times=None, metadata=metadata).with_frames(len(files))
    if path.is_dir() and first[1].suffix.lower() in _TIFF:
        stack = replace(stack, files=tuple(files))

    def read(index: int, _: int) -> NDArray[Any]:
        try:
            if index in damaged:
                raise damaged[index]
            return _read_frame(files[index]).reshape(1, *stack.shape[1:])
        except ValueError as error:
            message = str(error) if str(error).startswith(str(files[index])) else f"{files[index]}: {error}"
            raise FrameError(message) from error

    return BlockReader(path, replace(stack, frame_numbers=_frame_numbers(files), **merged_times(infos)), read)


def _ending(info: StackInfo) -> str:
    return ".png" if info.dtype in _PNG_TYPES and info.files is None else ".tif"


def _frame_names(info: StackInfo) -> list[str]:
    if info.files is not None:
        return [file.name for file in info.files]
    digits = max(4, len(str(info.shape[0] - 1)))
    return [f"frame_{index:0{digits}d}{_ending(info)}" for index in range(info.shape[0])]


def _write_file(file: Path, info: StackInfo, frame: NDArray[Any], source: Path | None = None) -> None:
    """Write one frame of a stack; a TIFF file keeps what that of the input, ``source``, states."""
    one = replace(info.with_frames(1), frame_times=None, frame_rate=None, metadata={})
    if file.suffix.lower() in _PNG:
        encode_png(file, np.asarray(frame, dtype=info.dtype), one)
        return
    storage: dict[str, Any] = {}
    with suppress(ValueError):  # a damaged file, whose frame is written as one without data
        if source is not None:
            like, storage = _read_info(source), storage_of(source)
            times = None if like.time_error else like.frame_times
            one = replace(one, frame_times=times, metadata=like.metadata_for(one.shape, one.dtype))
            one = replace(one, resolution=like.resolution)
    write_tiff(file, one, iter([frame]), None, storage)


def write_image(path: Path, info: StackInfo, frames: Iterator[NDArray[Any]], compression: str | None) -> None:
    """Write a PNG file of one frame; arguments as in ``StackFormat.write``."""
    _write_file(path, info, next(frames))


def write_folder(path: Path, info: StackInfo, frames: Iterator[NDArray[Any]], compression: str | None) -> None:
    """Write a folder with one file per frame; arguments as in ``StackFormat.write``."""
    path.mkdir()
    sources = info.files or [None] * info.shape[0]
    for name, source, frame in zip(_frame_names(info), sources, frames, strict=True):
        _write_file(path / name, info, frame, source)


def _check_channels(path: Path, info: StackInfo) -> None:
    if _ending(info) == ".png" and len(info.shape) == 4 and info.shape[1] not in (1, 3, 4):
        raise ValueError(f"{path}: PNG files hold 1, 3 or 4 channels, got {info.shape[1]}; write .tif")


def check_image(path: Path, info: StackInfo) -> None:
    """Refuse a stack that is not one frame of a PNG file."""
    _check_channels(path, info)
    if info.shape[0] != 1:
        raise ValueError(f"{path}: a PNG file holds one frame, got {info.shape[0]}; write a folder")


def check_folder(path: Path, info: StackInfo) -> None:
    """Refuse a folder that contains images of other stacks."""
    _check_channels(path, info)
    if path.is_dir():
        images = {f.name for f in path.iterdir() if f.suffix.lower() in _ENDINGS and not f.name.startswith(".")}
        others = images - set(_frame_names(info))
        if others:
            kind = next(kind for kind, endings in _KINDS.items() if Path(min(others)).suffix.lower() in endings)
            raise ValueError(
                f"{path}: the folder contains other {kind} files, e.g. {min(others)}; choose another folder"
            )
