"""Shapes behind Gaussian optics: coverages between 0 and 1 without aliasing.

A straight edge blurred by a Gaussian is an error function of the signed distance; rectangles are products of such
edges.
"""

import math
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
