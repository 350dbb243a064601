"""Self-contained HTML pages: images as data URIs, and templates that escape all text."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import jinja2
import numpy as np
from markupsafe import Markup, escape
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from rsvib_torch.files.atomic import whole_file
from rsvib_torch.files.reading import Table
from rsvib_torch.report.plots import picture
from rsvib_torch.results.result_files import figure_png
from rsvib_torch.text import data_uri

GreyLevels = tuple[float, float]  # values that are drawn black and white, full scale 1
PERCENTILES = (0.2, 99.8)  # of the values of the images; few saturated or dead pixels do not reduce the contrast
# Compression of the images that can be magnified. Size of a frame of 2048² px (noise 0.003) on the page, rms error in
# grey levels: grey 2.2 MB, 1.4; colour 2.7 MB, 1.7. With quality 85: 1.2 MB, 2.4 and 2.9. As PNG: 3.7 MB, 11 MB.
_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 95, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)
_FULL_PIXELS = 2048 * 2048  # a larger frame is reduced, and its part of this size is added at full resolution


@dataclass(frozen=True)
class Drawing:
    """A figure of a page."""

    png: bytes  # the image
    uri: str  # the same as a data URI
    width: int  # largest width on the page in px


@dataclass(frozen=True)
class BeforeAfter:
    """Two images of the same part of a frame, or one."""

    images: tuple[str, ...]  # data URIs of the image before, and after if there is one
    names: tuple[str, ...]  # their titles
    caption: str  # description
    width: int  # width of either image in px
    height: int  # height of either image in px
    levels: GreyLevels  # values that are drawn black and white
    left: int = 0  # column of the frame at the left edge
    top: int = 0  # row of the frame at the upper edge
    scale: float = 1.0  # pixels of the image per pixel of the frame, 1 or less
    full: "BeforeAfter | None" = None  # a part of the frame at full resolution; None where ``scale`` is 1
    # row and column of the frame that the magnifier shows first; None for its centre
    place: tuple[int, int] | None = None


@dataclass(frozen=True)
class Blink:
    """Two consecutive frames for each of several panels, which a page shows in turn."""

    panels: tuple[tuple[str, tuple[str, str]], ...]  # title of each panel, and data URIs of its two images
    frames: tuple[int, int]  # numbers of the two frames
    caption: str  # description
    width: int  # width of the images in px
    height: int  # height of the images in px


def drawing(figure: Figure) -> Drawing:
    """Render a figure as PNG."""
    png = figure_png(figure, dpi=140)
    return Drawing(png, data_uri(png, "image/png"), round(100 * figure.get_figwidth()))


def _pixels(image: Tensor, longest: int | None = None) -> NDArray[np.float32]:
    """Image (H, W) or (C, H, W) as OpenCV has it, reduced by averaging if a side exceeds ``longest``."""
    pixels: NDArray[np.float32] = picture(image).flip(-1).numpy()  # OpenCV: blue, green, red
    height, width = pixels.shape[:2]
    scale = 1.0 if longest is None else longest / max(height, width)
    if scale < 1:
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        pixels = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.float32)
    return pixels


def _grey_levels(images: Sequence[NDArray[np.float32]]) -> GreyLevels:
    """``PERCENTILES`` of the values of images that are not missing."""
    values = np.concatenate([image[np.isfinite(image)] for image in images])
    low, high = np.percentile(values, PERCENTILES) if len(values) else (0.0, 1.0)
    return float(low), float(high)


def _encoded(pixels: NDArray[np.float32], levels: GreyLevels, exact: bool) -> str:
    """Data URI of an image: PNG if ``exact``, else JPEG."""
    low, high = levels
    grey_levels = np.nan_to_num((pixels - low) / max(high - low, 1e-6)).clip(0, 1) * 255
    kind = "png" if exact else "jpeg"
    encoded, content = cv2.imencode(f".{kind}", grey_levels.round().astype(np.uint8), () if exact else _JPEG)
    if not encoded:
        raise ValueError(f"OpenCV cannot encode an image of shape {pixels.shape}")
    return data_uri(content.tobytes(), f"image/{kind}")


def before_after(
    *images: Tensor,
    names: tuple[str, ...],
    caption: str,
    longest: int = 1600,
    exact: bool = False,
    full_at: tuple[int, int] | None = None,
) -> BeforeAfter:
    """Encode two images (H, W) or (C, H, W) of one shape, or one, with the same grey scale.

    Images with a side above ``longest`` px are reduced by averaging; around the row and column ``full_at`` they are
    kept at full resolution beside the reduced ones, and not reduced at all up to 2048² px. ``exact``: PNG, not JPEG.
    """
    height, width = images[0].shape[-2:]
    if full_at is not None and height * width <= _FULL_PIXELS:
        longest = max(height, width)
    reduced = [_pixels(image, longest) for image in images]
    levels, full = _grey_levels(reduced), None

    def pair(pixels: Sequence[NDArray[np.float32]], text: str = "", **place: Any) -> BeforeAfter:
        uris = tuple(_encoded(image, levels, exact) for image in pixels)
        return BeforeAfter(uris, names, text, pixels[0].shape[1], pixels[0].shape[0], levels, **place)

    if full_at is not None and longest < max(height, width):
        columns = min(width, max(2048, _FULL_PIXELS // height))
        rows = min(height, _FULL_PIXELS // columns)
        top, left = (
            min(max(0, place - size // 2), whole - size)
            for place, size, whole in zip(full_at, (rows, columns), (height, width), strict=True)
        )
        parts = [_pixels(image[..., top : top + rows, left : left + columns]) for image in images]
        full = pair(parts, left=left, top=top)
    return pair(reduced, caption, scale=reduced[0].shape[1] / width, full=full, place=full_at)


def blink(
    stacks: Sequence[tuple[Tensor, Tensor]], *, names: Sequence[str], frames: tuple[int, int], caption: str
) -> Blink:
    """Encode two consecutive frames (H, W) or (C, H, W) for each panel with the same grey scale."""
    pixels = [[_pixels(image) for image in pair] for pair in stacks]
    levels = _grey_levels([image for pair in pixels for image in pair])
    encoded = [(_encoded(first, levels, False), _encoded(second, levels, False)) for first, second in pixels]
    height, width = pixels[0][0].shape[:2]
    return Blink(tuple(zip(names, encoded, strict=True)), frames, caption, width, height)


def _explained(text: str, terms: Mapping[str, str]) -> Markup:
    """HTML of a text in which terms refer to their explanations, which the page lists."""
    if not terms:
        return escape(text)
    pattern = re.compile(rf"\b({'|'.join(map(re.escape, sorted(terms, key=len, reverse=True)))})\b")
    parts = pattern.split(text)  # texts and terms in turn
    reference = Markup('<span class="term" tabindex="0" aria-describedby="term-{}">{}</span>')
    return Markup().join(
        reference.format(part.replace(" ", "-"), part) if index % 2 else escape(part)
        for index, part in enumerate(parts)
    )


def write_page(path: Path, content: Table) -> None:
    """Write the page from the template of the package; text is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("rsvib_torch.report.html"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["explained"] = _explained
    text = environment.get_template("report.html").render(**content)
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")
