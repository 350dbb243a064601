"""Self-contained HTML pages: images as data URIs, and templates that escape all text."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import jinja2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from rsvib_torch.files.atomic import whole_file
from rsvib_torch.files.reading import Table
from rsvib_torch.report.plots import picture
from rsvib_torch.results.result_files import figure_png
from rsvib_torch.text import data_uri

PERCENTILES = (0.2, 99.8)  # of the values of the images; few saturated or dead pixels do not reduce the contrast
# Compression of the images. Size of a frame of 2048² px (noise 0.003) on the page, rms error in grey levels: grey
# 2.2 MB, 1.4; colour 2.7 MB, 1.7. With quality 85: 1.2 MB, 2.4 and 2.9. As PNG: 3.7 MB, 11 MB.
_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 95, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)
_MOST_PIXELS = 4096 * 4096  # a larger frame is reduced


@dataclass(frozen=True)
class Drawing:
    """A figure of a page."""

    png: bytes  # the image
    uri: str  # the same as a data URI
    width: int  # largest width on the page in px


@dataclass(frozen=True)
class Pictures:
    """Images of one part of frames in panels: one each that a divider separates, or two each that are shown in turn."""

    panels: tuple[tuple[str, tuple[str, ...]], ...]  # title of each panel, and data URIs of its images
    width: int  # width of the images in px
    height: int  # height of the images in px
    levels: tuple[float, float]  # values that are drawn black and white, full scale 1
    scale: float  # pixels of the images per pixel of the frame, 1 or less
    caption: str = ""  # description
    place: tuple[int, int] = (0, 0)  # row and column of the frame that the magnifier shows first
    frames: tuple[int, int] = (0, 0)  # numbers of the frames that are shown in turn


def drawing(figure: Figure) -> Drawing:
    """Render a figure as PNG."""
    png = figure_png(figure, dpi=140)
    return Drawing(png, data_uri(png, "image/png"), round(100 * figure.get_figwidth()))


def pictures(panels: Mapping[str, Sequence[Tensor]], *, most_pixels: int = _MOST_PIXELS) -> Pictures:
    """Encode images (H, W) or (C, H, W) of one shape with the same grey scale, reduced if they have too many pixels."""
    pixels = {name: [_pixels(image, most_pixels) for image in images] for name, images in panels.items()}
    first = next(iter(pixels.values()))[0]
    values = np.concatenate([image[np.isfinite(image)] for images in pixels.values() for image in images])
    low, high = np.percentile(values, PERCENTILES) if len(values) else (0.0, 1.0)
    encoded = tuple((name, tuple(_encoded(image, low, high) for image in images)) for name, images in pixels.items())
    height, width = first.shape[:2]
    return Pictures(encoded, width, height, (float(low), float(high)), width / next(iter(panels.values()))[0].shape[-1])


def _pixels(image: Tensor, most: int) -> NDArray[np.float32]:
    """Image as OpenCV has it, reduced by averaging to ``most`` pixels."""
    pixels: NDArray[np.float32] = picture(image).flip(-1).numpy()  # OpenCV: blue, green, red
    height, width = pixels.shape[:2]
    scale = (most / (height * width)) ** 0.5
    if scale < 1:
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        pixels = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.float32)
    return pixels


def _encoded(pixels: NDArray[np.float32], low: float, high: float) -> str:
    """Data URI of an image as JPEG."""
    grey_levels = np.nan_to_num((pixels - low) / max(high - low, 1e-6)).clip(0, 1) * 255
    encoded, content = cv2.imencode(".jpeg", grey_levels.round().astype(np.uint8), _JPEG)
    if not encoded:
        raise ValueError(f"OpenCV cannot encode an image of shape {pixels.shape}")
    return data_uri(content.tobytes(), "image/jpeg")


def write_page(path: Path, content: Table) -> None:
    """Write the page from the template of the package; text is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("rsvib_torch.report.html"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    text = environment.get_template("report.html").render(**content)
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")
