"""Optics and pixels in front of a sensor, as a transfer function."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.core.checks import check_number

__all__ = ["Optics"]


@dataclass(frozen=True)
class Optics:
    """Transfer function of a lens and of square pixels.

    ``H(u, v) = exp(-2 pi^2 sigma^2 rho^2) D(rho / cutoff) sinc(pixel u) sinc(pixel v)``, ``rho^2 = u^2 + v^2``, with
    the transfer of a round diffraction-limited pupil ``D(s) = 2 (arccos s - s sqrt(1 - s^2)) / pi``, 0 beyond s = 1.

    Args:
        sigma: Gaussian blur in px, of aberrations.
        cutoff: Highest frequency that diffraction lets pass, cycles/px (pixel pitch over wavelength and f-number);
            None for no diffraction.
        pixel: Width of the light-sensitive square in px; 0 for none, as where a scene has been taken by pixels before.

    Example:
        >>> optics = Optics(sigma=0.5, pixel=1.0)
        >>> f"{optics.transfer(torch.tensor(0.5), torch.tensor(0.0)):.4f}"
        '0.1854'
    """

    sigma: float = 0.0
    cutoff: float | None = None
    pixel: float = 0.0

    def __post_init__(self) -> None:
        check_number("sigma", self.sigma, at_least=0.0)
        if self.cutoff is not None:
            check_number("cutoff", self.cutoff, above=0.0)
        check_number("pixel", self.pixel, at_least=0.0)

    def transfer(self, u: Tensor, v: Tensor) -> Tensor:
        """Transfer at frequencies to the right and down, cycles/px, in their broadcast shape."""
        squared = u.square() + v.square()
        transfer = torch.exp(-2 * (math.pi * self.sigma) ** 2 * squared)
        if self.cutoff is not None:
            s = (squared.sqrt() / self.cutoff).clamp(max=1.0)
            transfer = transfer * (2 / math.pi) * (s.arccos() - s * (1 - s.square()).sqrt())
        return transfer * torch.sinc(self.pixel * u) * torch.sinc(self.pixel * v)

    def apply(self, scene: Tensor) -> Tensor:
        """Scene (..., H, W) as seen through the optics, mirrored at its borders; same shape and dtype.

        Raises:
            TypeError: If the scene is not a floating-point tensor.
        """
        if not isinstance(scene, Tensor) or not scene.dtype.is_floating_point:
            raise TypeError("scene must be a floating-point tensor (..., H, W)")
        height, width = scene.shape[-2:]
        mirrored = torch.cat([scene, scene.flip(-1)], dim=-1)
        mirrored = torch.cat([mirrored, mirrored.flip(-2)], dim=-2)
        u = torch.fft.rfftfreq(2 * width, dtype=scene.dtype, device=scene.device)
        v = torch.fft.fftfreq(2 * height, dtype=scene.dtype, device=scene.device)[:, None]
        seen: Tensor = torch.fft.irfft2(torch.fft.rfft2(mirrored) * self.transfer(u, v), s=(2 * height, 2 * width))
        return seen[..., :height, :width].contiguous()
