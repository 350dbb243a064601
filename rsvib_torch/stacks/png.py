"""Stacks as PNG files: a folder of them, in natural order, or a single one."""

import re
import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsvib_torch.stacks.info import StackInfo
from rsvib_torch.stacks.scale import known_full_scale

__all__ = ["check_png_folder", "read_png", "read_png_info", "write_png", "write_png_folder"]

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 4, 6: 4}  # by colour type, as decoded
_LARGEST_RATIO = 1100  # pixel bytes per file byte: deflate reaches 1032
_FULL_SCALE_KEY = b"full_scale"


def _natural_key(path: Path) -> list[tuple[int, int, str]]:
    """Key that sorts frame9 before frame10."""
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts if part]


def _frame_files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    files = [f for f in path.iterdir() if f.suffix.lower() == ".png" and not f.name.startswith(".") and f.is_file()]
    if not files:
        raise ValueError(f"{path}: the folder holds no PNG files")
    return sorted(files, key=_natural_key)


def _chunks(data: bytes, path: Path) -> dict[bytes, bytes]:
    """The first chunk of each type; checksums and the end of the file are verified."""
    if data[:8] != _SIGNATURE:
        raise ValueError(f"{path}: not a PNG file")
    chunks: dict[bytes, bytes] = {}
    place = 8
    while b"IEND" not in chunks:
        length = struct.unpack(">I", data[place : place + 4])[0] if place + 12 <= len(data) else len(data)
        kind, end = data[place + 4 : place + 8], place + 12 + length
        if end > len(data):
            raise ValueError(f"{path}: truncated PNG file")
        if zlib.crc32(data[place + 4 : end - 4]) != struct.unpack(">I", data[end - 4 : end])[0]:
            raise ValueError(f"{path}: damaged PNG file (checksum of chunk {kind!r})")
        body = data[place + 8 : end - 4]
        if kind == b"tEXt" and body.startswith(_FULL_SCALE_KEY + b"\0"):
            chunks[_FULL_SCALE_KEY] = body[len(_FULL_SCALE_KEY) + 1 :]
        chunks.setdefault(kind, body)
        place = end
    return chunks


def _header(data: bytes, path: Path) -> StackInfo:
    """What one PNG file says of itself, as a stack of one frame."""
    chunks = _chunks(data, path)
    header = chunks.get(b"IHDR", b"")
    if len(header) != 13:
        raise ValueError(f"{path}: damaged PNG file (no header)")
    width, height, bits, colour = struct.unpack(">IIBB", header[:10])
    channels = 4 if b"tRNS" in chunks else _CHANNELS.get(colour, 0)
    if min(width, height, channels) < 1 or width * height * channels * bits // 8 > _LARGEST_RATIO * len(data):
        raise ValueError(f"{path}: its header promises {width} x {height} px, which {len(data)} bytes cannot hold")
    dtype = np.dtype(np.uint16 if bits == 16 else np.uint8)
    stated = None
    if _FULL_SCALE_KEY in chunks:
        try:
            stated = float(chunks[_FULL_SCALE_KEY])
        except ValueError as error:
            raise ValueError(f"{path}: full_scale in the file is {chunks[_FULL_SCALE_KEY]!r}, not a number") from error
    shape = (1, height, width) if channels == 1 else (1, channels, height, width)
    return StackInfo(shape, dtype.name, known_full_scale(dtype, stated))


def _common(infos: list[StackInfo], files: list[Path]) -> StackInfo:
    """The stack that the frames make together."""
    for info, file in zip(infos, files, strict=True):
        if info != infos[0]:
            raise ValueError(
                f"frames of different size or kind: {files[0].name} is {_describe(infos[0])}, "
                f"{file.name} is {_describe(info)}"
            )
    return StackInfo((len(infos), *infos[0].shape[1:]), infos[0].dtype, infos[0].full_scale)


def _describe(info: StackInfo) -> str:
    scale = "" if info.full_scale is None else f" with full scale {info.full_scale:g}"
    return f"{info.shape[1:]} {info.dtype}{scale}"


def read_png_info(path: Path) -> StackInfo:
    """What the headers of a PNG file, or of a folder of them, say."""
    files = _frame_files(path)
    return _common([_header(file.read_bytes(), file) for file in files], files)


def read_png(path: Path) -> tuple[NDArray[Any], StackInfo]:
    """Pixels as stored, (T, H, W) or (T, C, H, W) with channels RGB or RGBA."""
    files = _frame_files(path)
    infos, frames = [], []
    for file in files:
        data = file.read_bytes()
        infos.append(_header(data, file))
        _common(infos, files[: len(infos)])
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        if pixels is None:
            raise ValueError(f"{file}: the PNG file cannot be decoded")
        if pixels.ndim == 3:
            order = (2, 1, 0, 3)[: pixels.shape[-1]]
            pixels = np.moveaxis(pixels[..., order], -1, 0)
        frames.append(pixels)
    info = _common(infos, files)
    return np.stack(frames).reshape(info.shape), info


def write_png(path: Path, pixels: NDArray[Any], full_scale: float | None) -> None:
    """Write one frame (1, H, W) or (1, C, H, W); the full scale goes into a text chunk."""
    frame = pixels[0]
    if frame.ndim == 3:
        frame = np.moveaxis(frame, 0, -1)[..., (2, 1, 0, 3)[: frame.shape[0]] if frame.shape[0] > 1 else (0,)]
    done, encoded = cv2.imencode(".png", np.ascontiguousarray(frame))
    if not done:
        raise ValueError(f"{path}: frames of shape {pixels.shape} {pixels.dtype} cannot be written as PNG")
    data = encoded.tobytes()
    if full_scale is not None:
        body = b"tEXt" + _FULL_SCALE_KEY + b"\0" + f"{full_scale:.17g}".encode()
        chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
        start = 8 + 25  # signature and header
        data = data[:start] + chunk + data[start:]
    path.write_bytes(data)


def _frame_names(count: int) -> list[str]:
    digits = max(4, len(str(count - 1)))
    return [f"frame_{index:0{digits}d}.png" for index in range(count)]


def check_png_folder(path: Path, count: int) -> None:
    """Raise a ``ValueError`` if the folder holds PNG files that would mix with ``count`` new frames."""
    if path.is_dir():
        others = {f.name for f in path.iterdir() if f.suffix.lower() == ".png"} - set(_frame_names(count))
        if others:
            raise ValueError(f"{path}: the folder holds other PNG files, e.g. {min(others)}; choose another folder")


def write_png_folder(path: Path, pixels: NDArray[Any], full_scale: float | None) -> None:
    """Write frame_0000.png, frame_0001.png ... into a folder that exists."""
    for index, name in enumerate(_frame_names(len(pixels))):
        write_png(path / name, pixels[index : index + 1], full_scale)
