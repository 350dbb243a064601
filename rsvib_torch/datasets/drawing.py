"""Shapes behind Gaussian optics: coverages between 0 and 1 without aliasing.

A straight edge blurred by a Gaussian is an error function of the signed distance. Rectangles and bars are products and
sums of such edges and exact; curved edges are nearly so.
"""

import math
from collections.abc import Callable
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from rsvib_torch.files.reading import Table

Size = Annotated[int, Field(ge=64)]  # rows or columns of a scene
Blur = Annotated[float, Field(ge=0.4)]  # px; a narrower blur cannot be sampled
FLOAT: Table = {"dtype": torch.float32, "device": "cpu"}  # drawn scenes do not depend on defaults of PyTorch


def edge(distance: Tensor, sigma: float) -> Tensor:
    """Coverage at a signed distance (px, positive inside) from a straight edge."""
    return 0.5 + 0.5 * torch.erf(distance / (math.sqrt(2.0) * sigma))


def rotated(x: Tensor, y: Tensor, angle: float | Tensor) -> tuple[Tensor, Tensor]:
    """Coordinates along axes that are turned by ``angle`` (rad)."""
    turn = torch.as_tensor(angle, dtype=x.dtype, device=x.device)
    cosine, sine = turn.cos(), turn.sin()
    return x * cosine + y * sine, y * cosine - x * sine


def rectangle(x: Tensor, y: Tensor, half_width: float | Tensor, half_height: float | Tensor, sigma: float) -> Tensor:
    """Coverage of the rectangle ``|x| <= half_width, |y| <= half_height``."""
    across = edge(x + half_width, sigma) - edge(x - half_width, sigma)
    return across * (edge(y + half_height, sigma) - edge(y - half_height, sigma))


def disc(x: Tensor, y: Tensor, radius: float, sigma: float) -> Tensor:
    """Coverage of a disc; its curvature over the width of the blur is neglected."""
    return edge(radius - torch.hypot(x, y), sigma)


def bars(cycles: Tensor, frequency: Tensor | float, count: int, sigma: float) -> Tensor:
    """Coverage of ``count`` bars, half a cycle wide each, from 0 to ``count - 1/2`` cycles, with a blur in px.

    The frequency in cycles/px is constant for a bar group and varies along the bars for a wedge.
    """
    coverage = torch.zeros_like(cycles)
    for index in range(2 * count):
        step = edge((cycles - 0.5 * index) / frequency, sigma)
        coverage = coverage - step if index % 2 else coverage + step
    return coverage


def sectors(x: Tensor, y: Tensor, count: int, sigma: float) -> Tensor:
    """Coverage of a star of ``count`` sectors; valid where the radius exceeds ``count / pi`` px (Nyquist)."""
    frequency = count / (2 * math.pi * torch.hypot(x, y).clamp(min=1e-3))
    cycles = torch.remainder(torch.atan2(y, x) * (count / (2 * math.pi)), 1.0) + 2.0
    return bars(cycles, frequency, 6, sigma).clamp(0.0, 1.0)


def smoothed(image: Tensor, sigma: float) -> Tensor:
    """Image blurred by a Gaussian, periodic at its borders (a product of Fourier transforms)."""
    transfer = torch.exp(-2 * (math.pi * sigma) ** 2 * _squared_frequencies(*image.shape[-2:]))
    return torch.fft.irfft2(torch.fft.rfft2(image) * transfer, s=image.shape[-2:])


def _squared_frequencies(height: int, width: int) -> Tensor:
    """Squares of the frequencies of ``rfft2``, in cycles/px."""
    return torch.fft.fftfreq(height, **FLOAT)[:, None].square() + torch.fft.rfftfreq(width, **FLOAT).square()


def fractal_texture(
    height: int, width: int, generator: torch.Generator, *, exponent: float, longest: float, sigma: float
) -> Tensor:
    """Random texture of zero mean and unit variance whose amplitude spectrum falls as ``frequency^-exponent``.

    The exponent is 0 for white noise and 1 for natural scenes. The spectrum is flat beyond the wavelength ``longest``
    in px, and the optics blur by ``sigma`` px.
    """
    white = torch.randn(height, width, generator=generator, **FLOAT)
    squared = _squared_frequencies(height, width)
    shape = (squared + longest**-2) ** (-0.5 * exponent) * torch.exp(-2 * (math.pi * sigma) ** 2 * squared)
    shape[0, 0] = 0.0
    texture: Tensor = torch.fft.irfft2(torch.fft.rfft2(white) * shape, s=(height, width))
    return texture / texture.std()


class Canvas:
    """An image to paint on, one shape after another, each within its own window."""

    def __init__(self, image: Tensor, sigma: float) -> None:
        self.image = image
        self.sigma = sigma

    def transposed(self) -> "Canvas":
        """The same image with x and y exchanged."""
        return Canvas(self.image.T, self.sigma)

    def paint(
        self,
        centre: tuple[float, float],
        reach: float | tuple[float, float],
        tone: float,
        coverage: Callable[[Tensor, Tensor], Tensor],
    ) -> None:
        """Paint a tone over the image.

        The window has the half size ``reach`` (x, y) in px around the centre (column, row). ``coverage`` is a function
        of the coordinates x (1, w) and y (h, 1) in px from the centre.
        """
        halves = reach if isinstance(reach, tuple) else (reach, reach)
        places = []
        for middle, half, size in zip(centre, halves, reversed(self.image.shape), strict=True):
            pad = half + 5 * self.sigma
            places.append(slice(max(math.floor(middle - pad), 0), min(math.ceil(middle + pad) + 1, size)))
        window = self.image[places[1], places[0]]
        columns, rows = (torch.arange(place.start, place.stop, device="cpu") for place in places)
        window += coverage(columns[None] - centre[0], rows[:, None] - centre[1]) * (tone - window)
