"""Self-contained HTML pages: images as data URIs, and templates that escape all text."""

import base64
import io
import os
from dataclasses import dataclass
from typing import Any

import cv2
import jinja2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from rsvib_torch.core.atomic import whole_file
from rsvib_torch.report.plots import picture

__all__ = ["BeforeAfter", "Drawing", "before_after", "data_uri", "drawing", "write_page"]


@dataclass(frozen=True)
class Drawing:
    """A figure of a page.

    Attributes:
        name: File name of the image without its ending.
        title: Heading.
        caption: Description.
        png: The image.
        width: Largest width on the page in px.
    """

    name: str
    title: str
    caption: str
    png: bytes
    width: int

    @property
    def uri(self) -> str:
        """The image as a data URI."""
        return data_uri(self.png, "image/png")


@dataclass(frozen=True)
class BeforeAfter:
    """Two images of the same part of a frame.

    Attributes:
        before: Data URI.
        after: Data URI.
        names: Titles of the two images.
        caption: Description.
        width: Width of either image in px.
        height: Height of either image in px.
    """

    before: str
    after: str
    names: tuple[str, str]
    caption: str
    width: int
    height: int


def data_uri(content: bytes, kind: str) -> str:
    """Data URI of bytes of a MIME type."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def drawing(figure: Figure, name: str, title: str, caption: str) -> Drawing:
    """Render a figure as PNG."""
    file = io.BytesIO()
    FigureCanvasAgg(figure).print_figure(file, dpi=140, facecolor="white", format="png")
    return Drawing(name, title, caption, file.getvalue(), round(100 * figure.get_figwidth()))


def before_after(
    before: Tensor, after: Tensor, *, names: tuple[str, str], caption: str, longest: int = 1600, exact: bool = False
) -> BeforeAfter:
    """Encode two images with the same grey scale.

    The grey scale covers all but the darkest and the brightest 0.2 % of the values of both images.

    Args:
        before: (H, W) or (C, H, W), floating point.
        after: Same shape.
        names: Titles of the two images.
        caption: Description.
        longest: Largest side in px; larger images are reduced by averaging.
        exact: Encode without loss (PNG) instead of as JPEG.
    """
    images = [picture(image).flip(-1).numpy() for image in (before, after)]  # OpenCV: blue, green, red
    height, width = images[0].shape[:2]
    scale = longest / max(height, width)
    if scale < 1:
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        images = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in images]
    values = np.concatenate([image[np.isfinite(image)] for image in images])
    low, high = np.quantile(values, (0.002, 0.998)) if len(values) else (0.0, 1.0)
    uris = []
    for image in images:
        grey_levels = np.nan_to_num((image - low) / max(high - low, 1e-6)).clip(0, 1) * 255
        quality = () if exact else (cv2.IMWRITE_JPEG_QUALITY, 85)
        encoded, content = cv2.imencode(".png" if exact else ".jpg", grey_levels.round().astype(np.uint8), quality)
        if not encoded:
            raise ValueError(f"OpenCV cannot encode an image of shape {image.shape}")
        uris.append(data_uri(content.tobytes(), "image/png" if exact else "image/jpeg"))
    return BeforeAfter(uris[0], uris[1], names, caption, images[0].shape[1], images[0].shape[0])


def write_page(
    path: str | os.PathLike[str], template: str, content: dict[str, Any], *folders: str | os.PathLike[str]
) -> None:
    """Write a page atomically.

    Args:
        path: The file to write.
        template: Name of the template.
        content: Values of its variables; text is escaped.
        folders: Folders that are searched for templates, besides that of the package.

    Raises:
        OSError: If the file cannot be written.
    """
    loaders = [jinja2.PackageLoader("rsvib_torch.report.html"), *(jinja2.FileSystemLoader(f) for f in folders)]
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader(loaders),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    text = environment.get_template(template).render(**content)
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")
