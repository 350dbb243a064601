"""Stacks with one file per frame: folders of PNG, TIFF or JPEG files in natural order, or one PNG or JPEG file.

Pillow reads headers and metadata and verifies PNG files; OpenCV decodes them: Pillow reduces 16-bit colours to 8 bits.
"""

import io
import re
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import replace
from itertools import chain, zip_longest
from pathlib import Path

import cv2
import numpy as np
from PIL import ExifTags, Image
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile, putchunk

from rsvib_torch.frames.full_scale import known_full_scale
from rsvib_torch.io.frame_reader import FrameReader, check_held, readable_stack
from rsvib_torch.io.stack_info import DIFFERENT, StackInfo, Tag, exif_fields
from rsvib_torch.io.tiff import open_tiff, write_tiff
from rsvib_torch.numerics.tables import Array

_PNG, _TIFF, _JPEG = (".png",), (".tif", ".tiff"), (".jpg", ".jpeg")
_KINDS = {"PNG": _PNG, "TIFF": _TIFF, "JPEG": _JPEG}
_PNG_TYPES = ("uint8", "uint16")
_FULL_SCALE = "full_scale"  # keyword of the text in a PNG file
_CHANNELS = {"1": 1, "L": 1, "I;16": 1, "P": 3, "RGB": 3, "LA": 4, "RGBA": 4}  # of decoded pixels, by mode
_LONGEST_HEADER = 2**24  # bytes before the pixels: EXIF data and previews have 64 KB each, colour profiles 3 MB
_PNG_HEADER = 8 + 25  # bytes of the signature and the chunk with the size


def _open_image(path: Path) -> FrameReader:
    """Open a PNG, JPEG or TIFF file of one frame."""
    if path.suffix.lower() in _TIFF:
        reader = open_tiff(path)
        if reader.info.shape[0] != 1:
            reader.close()
            raise ValueError(f"{path}: expected one image per file, this file contains {reader.info.shape[0]}")
        return reader
    is_png = path.suffix.lower() in _PNG
    with readable_stack(path, "PNG" if is_png else "JPEG"), path.open("rb") as file:
        head = file.read(_LONGEST_HEADER)  # Pillow would search a file of any size for it, at 20 MB/s
        file_size = file.seek(0, io.SEEK_END)
        image = PngImageFile(io.BytesIO(head)) if is_png else JpegImageFile(io.BytesIO(head))
        if isinstance(image, PngImageFile) and image.is_animated:
            raise ValueError("an animated PNG, of which only the first frame could be read; write its frames as files")
        if image.mode not in _CHANNELS:
            raise ValueError(f"pixels are {image.mode}; expected grey{', RGB or RGBA' if is_png else ' or RGB'}")
        channels, dtype = _CHANNELS[image.mode], np.dtype(np.uint16 if is_png and head[24] == 16 else np.uint8)
        if "transparency" in image.info and channels == 3:  # one transparent value of a grey image is not decoded
            channels = 4
        size, nbytes = f"{image.width} x {image.height} px", image.width * image.height * channels * dtype.itemsize
        check_held(nbytes, file_size)
        if file_size > 4 * nbytes + _LONGEST_HEADER:
            raise ValueError(f"{file_size} bytes are too many for {size}")
        shape = (1, image.height, image.width) if channels == 1 else (1, channels, image.height, image.width)
        stated = image.info.get(_FULL_SCALE)
        full_scale = known_full_scale(dtype, None if stated is None else float(stated))
        info = StackInfo(shape, dtype.name, full_scale, **exif_fields(image.info.get("exif", b"")))
    return FrameReader(path, info, lambda _: _decoded(path, is_png))


def _decoded(path: Path, is_png: bool) -> Array:
    """Pixels of a PNG or JPEG file as stored, without its orientation: (H, W), or (C, H, W) in RGB or RGBA."""
    data = path.read_bytes()
    if not is_png:
        pixels = np.asarray(JpegImageFile(io.BytesIO(data)))
        return pixels if pixels.ndim == 2 else np.moveaxis(pixels, -1, 0)
    PngImageFile(io.BytesIO(data)).verify()  # checksums of all parts
    stored = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if stored is None:
        raise ValueError("its pixels cannot be decoded")
    return stored if stored.ndim == 2 else np.moveaxis(stored[..., (2, 1, 0, 3)[: stored.shape[-1]]], -1, 0)


def _write_png(path: Path, frame: Array, info: StackInfo) -> None:
    """Write one frame (H, W) or (C, H, W), with full scale and orientation in chunks of their own."""
    if frame.ndim == 3:
        frame = np.moveaxis(frame, 0, -1)[..., (2, 1, 0, 3)[: frame.shape[0]] if frame.shape[0] > 1 else (0,)]
    is_encoded, encoded = cv2.imencode(".png", np.ascontiguousarray(frame))
    if not is_encoded:
        raise ValueError(f"{path}: frames of shape {frame.shape} {frame.dtype} cannot be written as PNG")
    data = encoded.tobytes()
    with path.open("wb") as file:
        file.write(data[:_PNG_HEADER])
        if info.full_scale is not None:
            putchunk(file, b"tEXt", f"{_FULL_SCALE}\0{info.full_scale:.17g}".encode())
        if info.orientation != 1:
            exif = Image.Exif()
            exif[ExifTags.Base.Orientation] = info.orientation
            putchunk(file, b"eXIf", exif.tobytes().removeprefix(b"Exif\0\0"))
        file.write(data[_PNG_HEADER:])


def _images_in(folder: Path) -> dict[str, list[Path]]:
    """The images in a folder by their kind, without hidden files."""
    files = [file for file in folder.iterdir() if not file.name.startswith(".") and file.is_file()]
    kinds = {kind: [f for f in files if f.suffix.lower() in endings] for kind, endings in _KINDS.items()}
    return {kind: images for kind, images in kinds.items() if images}


def _frame_files(path: Path) -> list[Path]:
    """The files of a folder in natural order (frame9 before frame10), or one file."""
    if not path.is_dir():
        return [path]
    images = _images_in(path)
    if len(images) > 1:
        raise ValueError(f"{path}: the folder contains both {' and '.join(images)} files; expected one kind")
    if not images:
        raise ValueError(f"{path}: the folder contains no PNG, TIFF or JPEG files; convert a Zarr store to HDF5")

    def parts(file: Path) -> list[tuple[int, int, str]]:
        split = re.split(r"(\d+)", file.name)
        return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in split if part]

    return sorted(next(iter(images.values())), key=parts)


def _frame_numbers(files: list[Path]) -> tuple[int, ...] | None:
    """Number of frame intervals from the first file to each one, if the numbers in the names show that some are gone.

    Names must differ in one number, whose most common step is its smallest, and divides all steps: frame_0, frame_1,
    frame_3. Other names, e.g. with times in ms (frame_0, frame_33, frame_67), state nothing.
    """
    parts = zip_longest(*(re.split(r"(\d+)", file.stem) for file in files))
    varying = [texts for texts in parts if len(set(texts)) > 1]
    if len(files) < 3 or len(varying) != 1 or not all((text or "").isdecimal() for text in varying[0]):
        return None
    numbers = np.array([int(text) for text in varying[0]], dtype=object)
    steps = np.diff(numbers)
    step = min(steps)
    if step < 1 or np.median(steps.astype(float)) != step or any(steps % step) or all(steps == step):
        return None
    return tuple(((numbers - numbers[0]) // step).tolist())


def open_images(path: Path) -> FrameReader:
    """Open the files of a folder, or one file; frames are decoded on access."""
    files = _frame_files(path)
    infos: dict[Path, StackInfo] = {}
    damaged: list[ValueError] = []
    # 1. What each file states; all must be of one kind.
    for file in files:
        try:
            with closing(_open_image(file)) as reader:
                infos[file] = info = replace(reader.info, frame_times=None)
        except ValueError as error:
            damaged.append(error)
            continue
        first, stack = next(iter(infos.items()))
        if info != stack:
            kinds = f"{first.name} is {stack.kind}, {file.name} is {info.kind}"
            raise ValueError(f"frames of different size or kind: {kinds}")
    if len(damaged) > len(files) // 2 or not infos:
        raise damaged[0]
    # 2. Metadata that are the same in all files.
    of_files = [info.metadata for info in infos.values()]
    metadata: dict[str, Tag | None] = {}
    for name in dict.fromkeys(chain.from_iterable(of_files)):
        same = len({repr(tags.get(name, DIFFERENT)) for tags in of_files}) == 1  # arrays have no single equality
        metadata |= {name: of_files[0][name]} if same else {f"{name}{DIFFERENT}": None}
    stack = replace(stack, metadata=metadata).with_frames(len(files))
    if path.is_dir() and files[0].suffix.lower() in _TIFF:
        stack = replace(stack, files=tuple(files))

    def read(index: int) -> Array:
        with closing(_open_image(files[index])) as reader:
            return reader.frame(0)

    return FrameReader(path, replace(stack, frame_numbers=_frame_numbers(files)), read)


def _ending(info: StackInfo) -> str:
    return ".png" if info.dtype in _PNG_TYPES and info.files is None else ".tif"


def _frame_names(info: StackInfo) -> list[str]:
    if info.files is not None:
        return [file.name for file in info.files]
    digits = max(4, len(str(info.shape[0] - 1)))
    return [f"frame_{index:0{digits}d}{_ending(info)}" for index in range(info.shape[0])]


def _write_file(file: Path, info: StackInfo, frame: Array, source: Path | None = None) -> None:
    """Write one frame of a stack; a TIFF file keeps what that of the input, ``source``, states."""
    one = replace(info.with_frames(1), frame_times=None, frame_rate=None, metadata={})
    if file.suffix.lower() in _PNG:
        _write_png(file, np.asarray(frame, dtype=info.dtype), one)
        return
    with suppress(ValueError):  # a damaged file, whose frame is written as one without data
        if source is not None:
            with closing(_open_image(source)) as reader:
                like = reader.info
            times = None if like.time_error else like.frame_times
            one = replace(one, frame_times=times, metadata=like.with_shape(one.shape).metadata)
    write_tiff(file, one, iter([frame]))


def write_images(path: Path, info: StackInfo, frames: Iterator[Array]) -> None:
    """Write a PNG file of one frame, or a folder with one file per frame."""
    if path.suffix:
        _write_file(path, info, next(frames))
        return
    for name, source, frame in zip(_frame_names(info), info.files or [None] * info.shape[0], frames, strict=True):
        _write_file(path / name, info, frame, source)


def check_images(path: Path, info: StackInfo) -> None:
    """Refuse what PNG files cannot hold, several frames in one file, and a folder with images of other stacks."""
    if _ending(info) == ".png" and len(info.shape) == 4 and info.shape[1] not in (1, 3, 4):
        raise ValueError(f"{path}: PNG files hold 1, 3 or 4 channels, got {info.shape[1]}; write .tif")
    if path.suffix and info.shape[0] != 1:
        raise ValueError(f"{path}: a PNG file holds one frame, got {info.shape[0]}; write a folder")
    if path.is_dir():
        for kind, files in _images_in(path).items():
            others = {file.name for file in files} - set(_frame_names(info))
            if others:
                problem = f"other {kind} files, e.g. {min(others)}"
                raise ValueError(f"{path}: the folder contains {problem}; choose another folder")
