"""Frames in PNG and JPEG files: what they state, and decoding and encoding of pixels.

Pillow reads headers and metadata and verifies PNG files; OpenCV decodes them: Pillow reduces 16-bit colours to 8 bits.
"""

import io
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile, putchunk

from rsvib_torch.io.full_scale import known_full_scale
from rsvib_torch.io.stack_info import StackInfo, readable_stack
from rsvib_torch.io.time_metadata import exif_fields

_FULL_SCALE = "full_scale"  # keyword of the text in a PNG file
_LARGEST_RATIO = 1100  # of pixels to bytes of a PNG file; deflate reaches 1032
_CHANNELS = {"1": 1, "L": 1, "I;16": 1, "P": 3, "RGB": 3, "LA": 4, "RGBA": 4}  # of a decoded PNG file, by mode
_LONGEST_HEADER = 2**24  # bytes before the pixels: EXIF data and previews have 64 KB each, colour profiles 3 MB
_PNG_HEADER = 8 + 25  # bytes of the signature and the chunk with the size


def image_info(path: Path) -> StackInfo:
    """The stack of one frame in a PNG or JPEG file."""
    is_png = path.suffix.lower() == ".png"
    with readable_stack(path, "PNG" if is_png else "JPEG"), path.open("rb") as file:
        head = file.read(_LONGEST_HEADER)  # Pillow would search a file of any size for it, at 20 MB/s
        file_size = file.seek(0, io.SEEK_END)
        image = PngImageFile(io.BytesIO(head)) if is_png else JpegImageFile(io.BytesIO(head))
        info = _png_info(image, head, file_size) if is_png else _jpeg_info(image)
        if file_size > 4 * np.dtype(info.dtype).itemsize * math.prod(info.shape) + _LONGEST_HEADER:
            raise ValueError(f"{file_size} bytes are too many for {image.width} x {image.height} px")
        return replace(info, **exif_fields(image.info.get("exif", b"")))


def _jpeg_info(image: Any) -> StackInfo:
    if image.mode not in ("L", "RGB"):
        raise ValueError(f"pixels are {image.mode}; expected grey or RGB")
    shape = (1, 3, image.height, image.width) if image.mode == "RGB" else (1, image.height, image.width)
    return StackInfo(shape, "uint8", 255.0, channels_last=image.mode == "RGB")


def _png_info(image: Any, head: bytes, file_size: int) -> StackInfo:
    if image.is_animated:
        raise ValueError("an animated PNG, of which only the first frame could be read; write its frames as files")
    dtype = np.dtype(np.uint16 if head[24] == 16 else np.uint8)  # bits of a value
    channels = _CHANNELS[image.mode]
    if "transparency" in image.info and channels == 3:  # one transparent value of a grey image is not decoded
        channels = 4
    if image.width * image.height * channels * dtype.itemsize > 8 * _LARGEST_RATIO * file_size:  # 1 bit is 1 byte
        raise ValueError(f"its header states {image.width} x {image.height} px, which {file_size} bytes cannot hold")
    shape = (1, image.height, image.width) if channels == 1 else (1, channels, image.height, image.width)
    stated = image.info.get(_FULL_SCALE)
    full_scale = known_full_scale(dtype, None if stated is None else float(stated))
    dpi, resolution = image.info.get("dpi"), None
    if dpi is not None and min(dpi) > 0:
        resolution = (round(dpi[0] / 0.0254) / 100.0, round(dpi[1] / 0.0254) / 100.0, "centimeter")
    return StackInfo(shape, dtype.name, full_scale, resolution=resolution, channels_last=channels > 1)


def decode_image(path: Path) -> NDArray[Any]:
    """Pixels of a PNG or JPEG file as stored, without its orientation: (H, W), or (C, H, W) in RGB or RGBA.

    Raises:
        ValueError: If the file is damaged.
    """
    is_png = path.suffix.lower() == ".png"
    with readable_stack(path, "PNG" if is_png else "JPEG"):
        data = path.read_bytes()
        if is_png:
            PngImageFile(io.BytesIO(data)).verify()  # checksums of all parts
            pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
            if pixels is None:
                raise ValueError("its pixels cannot be decoded")
        else:
            pixels = np.asarray(JpegImageFile(io.BytesIO(data)))
        if pixels.ndim == 2:
            return pixels
        return np.moveaxis(pixels[..., (2, 1, 0, 3)[: pixels.shape[-1]]] if is_png else pixels, -1, 0)


def encode_png(path: Path, frame: NDArray[Any], info: StackInfo) -> None:
    """Write one frame (H, W) or (C, H, W).

    Full scale, resolution and orientation are stored as chunks ``tEXt``, ``pHYs`` and ``eXIf``.
    """
    if frame.ndim == 3:
        frame = np.moveaxis(frame, 0, -1)[..., (2, 1, 0, 3)[: frame.shape[0]] if frame.shape[0] > 1 else (0,)]
    done, encoded = cv2.imencode(".png", np.ascontiguousarray(frame))
    if not done:
        raise ValueError(f"{path}: frames of shape {frame.shape} {frame.dtype} cannot be written as PNG")
    data = encoded.tobytes()
    with path.open("wb") as file:
        file.write(data[:_PNG_HEADER])
        if info.full_scale is not None:
            putchunk(file, b"tEXt", f"{_FULL_SCALE}\0{info.full_scale:.17g}".encode())
        if info.resolution is not None:
            per_metre = 100.0 if info.resolution[2] == "centimeter" else 100.0 / 2.54
            sizes = (round(value * per_metre).to_bytes(4, "big") for value in info.resolution[:2])
            putchunk(file, b"pHYs", *sizes, b"\1")
        if info.orientation != 1:
            exif = Image.Exif()
            exif[ExifTags.Base.Orientation] = info.orientation
            putchunk(file, b"eXIf", exif.tobytes().removeprefix(b"Exif\0\0"))
        file.write(data[_PNG_HEADER:])
