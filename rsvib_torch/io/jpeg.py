"""Frames in JPEG files, which can only be read."""

import io
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from rsvib_torch.io.stack_info import StackInfo
from rsvib_torch.io.time_metadata import exif_fields

_LONGEST_HEADER = 2**24  # bytes before the pixels: EXIF data and a preview have 64 KB each, colour profiles 3 MB


def _open(path: Path) -> Image.Image:
    with path.open("rb") as file:
        head = io.BytesIO(file.read(_LONGEST_HEADER))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the memory is checked before reading
            Image.open(head, formats=("JPEG",))  # Pillow would search a file of any size for the header, at 20 MB/s
            image = Image.open(path, formats=("JPEG",))
    except (OSError, ValueError, Image.DecompressionBombError) as error:
        raise ValueError(f"{path}: not a JPEG file") from error
    if image.mode not in ("L", "RGB"):
        mode = image.mode
        image.close()
        raise ValueError(f"{path}: pixels are {mode}; expected grey or RGB")
    return image


def jpeg_info(path: Path) -> StackInfo:
    """The stack of one frame in a JPEG file."""
    with _open(path) as image:
        colour = image.mode == "RGB"
        shape = (1, 3, image.height, image.width) if colour else (1, image.height, image.width)
        info = StackInfo(shape, "uint8", 255.0, channels_last=colour)
        return replace(info, **exif_fields(image.info.get("exif", b"")))


def decode_jpeg(path: Path) -> NDArray[Any]:
    """Pixels of a JPEG file as stored, without its orientation: (H, W), or (3, H, W) in RGB."""
    with _open(path) as image:
        try:
            pixels = np.asarray(image)
        except OSError as error:
            raise ValueError(f"{path}: the JPEG file cannot be decoded ({error})") from error
    return pixels if pixels.ndim == 2 else np.moveaxis(pixels, -1, 0)
