"""Frames in PNG files: decoding, encoding, and what the file states."""

import io
import struct
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

from rsvib_torch.core.text import quoted
from rsvib_torch.io.full_scale import known_full_scale
from rsvib_torch.io.stack_info import StackInfo
from rsvib_torch.io.time_metadata import exif_fields

_FULL_SCALE_KEY = b"full_scale"
_LARGEST_CHUNK = 2**26  # bytes; those besides the pixels, such as colour profiles, have up to 3 MB


def _chunks(file: BinaryIO, path: Path, last: bytes) -> dict[bytes, bytes]:
    """The first chunk of each type before ``last``; checksums and the end of the file are verified."""
    if file.read(8) != b"\x89PNG\r\n\x1a\n":
        raise ValueError(f"{path}: not a PNG file")
    chunks: dict[bytes, bytes] = {}
    while True:
        head = file.read(8)
        length, kind = struct.unpack(">I4s", head) if len(head) == 8 else (0, b"")
        if kind == last and last != b"IEND":
            return chunks
        if length > _LARGEST_CHUNK and kind != b"IDAT":
            raise ValueError(f"{path}: damaged PNG file (a chunk {kind!r} of {length} bytes)")
        body = file.read(length + 4)  # and its checksum
        if len(body) < length + 4:
            raise ValueError(f"{path}: truncated PNG file")
        body, checksum = body[:-4], struct.unpack(">I", body[-4:])[0]
        if zlib.crc32(body, zlib.crc32(kind)) != checksum:
            raise ValueError(f"{path}: damaged PNG file (checksum of chunk {kind!r})")
        if kind == b"tEXt" and body.startswith(_FULL_SCALE_KEY + b"\0"):
            chunks[_FULL_SCALE_KEY] = body[len(_FULL_SCALE_KEY) + 1 :]
        chunks.setdefault(kind, body)
        if kind == b"IEND":
            return chunks


def _resolution(chunks: dict[bytes, bytes]) -> tuple[float, float, str] | None:
    body = chunks.get(b"pHYs", b"")
    if len(body) != 9 or body[8] != 1:
        return None
    x, y = struct.unpack(">II", body[:8])  # pixels per metre
    return (x / 100.0, y / 100.0, "centimeter") if min(x, y) > 0 else None


def _info(chunks: dict[bytes, bytes], size: int, path: Path, *, largest_ratio: int = 1100) -> StackInfo:
    """The frame that a header states; ``largest_ratio`` of pixels to bytes of the file: deflate reaches 1032."""
    header = chunks.get(b"IHDR", b"")
    if len(header) != 13:
        raise ValueError(f"{path}: damaged PNG file (no header)")
    width, height, bits, colour = struct.unpack(">IIBB", header[:10])
    channels = {0: 1, 2: 3, 3: 3, 4: 4, 6: 4}.get(colour, 0)  # of the decoded image, by colour type
    if b"tRNS" in chunks and colour != 0:  # one transparent value of a grey image is not decoded
        channels = 4
    if b"acTL" in chunks:
        raise ValueError(
            f"{path}: an animated PNG, of which only the first frame could be read; write its frames as files"
        )
    if min(width, height, channels) < 1 or width * height * channels * bits // 8 > largest_ratio * size:
        raise ValueError(f"{path}: its header states {width} x {height} px, which {size} bytes cannot hold")
    if size > 2 * width * height * channels * bits + _LARGEST_CHUNK:
        raise ValueError(f"{path}: {size} bytes are too many for {width} x {height} px, as its header states")
    dtype = np.dtype(np.uint16 if bits == 16 else np.uint8)
    stated = None
    if _FULL_SCALE_KEY in chunks:
        try:
            stated = float(chunks[_FULL_SCALE_KEY])
        except ValueError as error:
            raise ValueError(
                f"{path}: full_scale in the file is {quoted(chunks[_FULL_SCALE_KEY])}, not a number"
            ) from error
    shape = (1, height, width) if channels == 1 else (1, channels, height, width)
    full_scale = known_full_scale(dtype, stated)
    return StackInfo(shape, dtype.name, full_scale, resolution=_resolution(chunks), channels_last=channels > 1)


def png_info(path: Path) -> StackInfo:
    """The stack of one frame in a PNG file."""
    with path.open("rb") as file:
        chunks = _chunks(file, path, b"IDAT")
    return replace(_info(chunks, path.stat().st_size, path), **exif_fields(chunks.get(b"eXIf", b"")))


def decode_png(path: Path) -> NDArray[Any]:
    """Pixels of a PNG file, (H, W) or (C, H, W) with channels RGB or RGBA."""
    png_info(path)
    data = path.read_bytes()
    _chunks(io.BytesIO(data), path, b"IEND")
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ValueError(f"{path}: the PNG file cannot be decoded ({error.err})") from error
    if pixels is None:
        raise ValueError(f"{path}: the PNG file cannot be decoded")
    if pixels.ndim == 3:
        order = (2, 1, 0, 3)[: pixels.shape[-1]]
        pixels = np.moveaxis(pixels[..., order], -1, 0)
    return np.asarray(pixels)


def encode_png(path: Path, frame: NDArray[Any], info: StackInfo) -> None:
    """Write one frame (H, W) or (C, H, W).

    Full scale, resolution and orientation are stored as chunks ``tEXt``, ``pHYs`` and ``eXIf``.
    """
    if frame.ndim == 3:
        frame = np.moveaxis(frame, 0, -1)[..., (2, 1, 0, 3)[: frame.shape[0]] if frame.shape[0] > 1 else (0,)]
    done, encoded = cv2.imencode(".png", np.ascontiguousarray(frame))
    if not done:
        raise ValueError(f"{path}: frames of shape {frame.shape} {frame.dtype} cannot be written as PNG")
    data, added = encoded.tobytes(), b""
    if info.full_scale is not None:
        added += _chunk(b"tEXt", _FULL_SCALE_KEY + b"\0" + f"{info.full_scale:.17g}".encode())
    if info.resolution is not None:
        per_metre = 100.0 if info.resolution[2] == "centimeter" else 100.0 / 2.54
        x, y = (round(value * per_metre) for value in info.resolution[:2])
        added += _chunk(b"pHYs", struct.pack(">IIB", x, y, 1))
    if info.orientation != 1:
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = info.orientation
        added += _chunk(b"eXIf", exif.tobytes().removeprefix(b"Exif\0\0"))
    start = 8 + 25  # after signature and header
    path.write_bytes(data[:start] + added + data[start:])


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
