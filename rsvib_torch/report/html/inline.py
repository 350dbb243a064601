"""Pictures as data URIs, of bounded size."""

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

__all__ = ["BeforeAfter", "Drawing", "before_after", "data_uri", "drawing"]

_DPI = 140
_JPEG_QUALITY = 85
_TAIL = 0.002  # of the values that may be lighter or darker than what is shown


@dataclass(frozen=True)
class Drawing:
    """A figure for a page.

    Attributes:
        name: Of the picture's file, without its ending.
        title: Heading.
        caption: What is to be seen.
        png: The picture.
        width: px on the page, at most.
    """

    name: str
    title: str
    caption: str
    png: bytes
    width: int

    @property
    def uri(self) -> str:
        """The picture as a data URI."""
        return data_uri(self.png, "image/png")


@dataclass(frozen=True)
class BeforeAfter:
    """Two pictures of the same place.

    Attributes:
        before: Data URI.
        after: Data URI.
        names: What they are called.
        caption: Where the place is.
        width: px of either picture.
        height: px of either picture.
    """

    before: str
    after: str
    names: tuple[str, str]
    caption: str
    width: int
    height: int


def data_uri(content: bytes, kind: str) -> str:
    """Bytes of a MIME type as a data URI."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def drawing(figure: Figure, name: str, title: str, caption: str) -> Drawing:
    """Render a figure for a page."""
    file = io.BytesIO()
    FigureCanvasAgg(figure).print_figure(file, dpi=_DPI, facecolor="white", format="png")
    return Drawing(name, title, caption, file.getvalue(), round(100 * figure.get_figwidth()))


def _colours(frame: Tensor) -> np.ndarray:
    """Frame (H, W) or (C, H, W) as (H, W) or, from three channels on, as (H, W, 3) in blue, green, red."""
    frame = frame.detach().float().cpu()
    if frame.ndim == 3:
        frame = frame[:3].flip(0).movedim(0, -1) if frame.shape[0] >= 3 else frame.mean(0)
    return frame.numpy()


def before_after(
    before: Tensor, after: Tensor, *, names: tuple[str, str], caption: str, longest: int = 1600, exact: bool = False
) -> BeforeAfter:
    """Two pictures in one range of grey.

    Args:
        before: (H, W) or (C, H, W), floating point.
        after: Same shape.
        names: What they are called.
        caption: Where the place is.
        longest: px, longest side; larger pictures are scaled down by averaging.
        exact: Whether every pixel is kept as it is (PNG), or compressed (JPEG).
    """
    pictures = [_colours(image) for image in (before, after)]
    height, width = pictures[0].shape[:2]
    scale = min(1.0, longest / max(height, width))
    if scale < 1:
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        pictures = [cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in pictures]
    values = np.concatenate([picture[np.isfinite(picture)] for picture in pictures])
    low, high = np.quantile(values, (_TAIL, 1 - _TAIL)) if len(values) else (0.0, 1.0)
    shown = [np.nan_to_num((picture - low) / max(high - low, 1e-6)).clip(0, 1) * 255 for picture in pictures]
    first, second = (_encoded(picture.round().astype(np.uint8), exact) for picture in shown)
    return BeforeAfter(first, second, names, caption, shown[0].shape[1], shown[0].shape[0])


def _encoded(picture: np.ndarray, exact: bool) -> str:
    options: Sequence[int] = () if exact else (cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY)
    done, content = cv2.imencode(".png" if exact else ".jpg", picture, options)
    if not done:
        raise ValueError(f"a picture of {picture.shape} px could not be encoded")
    return data_uri(content.tobytes(), "image/png" if exact else "image/jpeg")


def grey(frame: Tensor) -> Tensor:
    """Frame (H, W) or (C, H, W) as one grey (H, W), float64 on the CPU."""
    frame = frame.detach().to("cpu", torch.float64)
    return frame if frame.ndim == 2 else frame.mean(0)
