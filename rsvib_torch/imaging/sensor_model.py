"""Optics in front of a sensor as a transfer function, and the noise of the sensor."""

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Annotated

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from rsvib_torch.checks.arguments import as_numbers, check_broadcast, check_images, check_pixels, checked_methods
from rsvib_torch.checks.values import NotNegative, Positive, check_number, described, options
from rsvib_torch.options import OpticsOptions

_LEAST_RESPONSE = 0.1  # of the camera, below which the gain does not increase: 0.02 and 0.2 lose up to 5 and 3 dB


@options
@checked_methods
class Optics(OpticsOptions):
    """Transfer function of a lens and of square pixels.

    ``H(u, v) = exp(-2 pi^2 sigma^2 rho^2) D(rho / cutoff) sinc(pixel u) sinc(pixel v)``, ``rho^2 = u^2 + v^2``, with
    the transfer of a round diffraction-limited pupil ``D(s) = 2 (arccos s - s sqrt(1 - s^2)) / pi``, 0 beyond s = 1.
    A measured MTF is a further factor, interpolated linearly in rho from 1 at 0. The fields are those of
    ``OpticsOptions``.

    Example:
        >>> optics = Optics(sigma=0.5, pixel=1.0)
        >>> f"{optics.transfer(torch.tensor(0.5), torch.tensor(0.0)):.4f}"
        '0.1854'
    """

    def __post_init__(self) -> None:
        if self.mtf is not None:
            object.__setattr__(self, "mtf", _checked_mtf(self.mtf))  # lists of numbers, which can be compared

    def transfer(self, u: Tensor, v: Tensor) -> Tensor:
        """Transfer function at horizontal and vertical frequencies in cycles/px, in their broadcast shape."""
        check_broadcast(u=u, v=v)
        u, v = (frequency if frequency.dtype.is_floating_point else frequency.double() for frequency in (u, v))
        squared = u.square() + v.square()
        transfer = torch.exp(-2 * (math.pi * self.sigma) ** 2 * squared)
        if self.cutoff is not None:
            s = (squared.sqrt() / self.cutoff).clamp(max=1.0)
            transfer = transfer * (2 / math.pi) * (s.arccos() - s * (1 - s.square()).sqrt())
        if self.mtf is not None:
            rho = squared.sqrt().detach().cpu().numpy()
            transfer = transfer * torch.as_tensor(np.interp(rho, *_checked_mtf(self.mtf), right=0.0)).to(transfer)
        return transfer * torch.sinc(self.pixel * u) * torch.sinc(self.pixel * v)

    def apply(self, scene: Tensor) -> Tensor:
        """Scene (..., H, W) as imaged by the optics, with mirrored boundaries; same shape and dtype."""
        check_images({"scene": scene}, {"scene": "... H W"})
        return filtered(scene, self.transfer)


def filtered(images: Tensor, transfer: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """Images (..., H, W) after a filter, a function of frequencies in cycles per point, with mirrored boundaries."""
    height, width = images.shape[-2:]
    wide = images.to(torch.promote_types(images.dtype, torch.float32))  # there is no FFT of 16 bits on the CPU
    mirrored = torch.cat([wide, wide.flip(-1)], dim=-1)
    mirrored = torch.cat([mirrored, mirrored.flip(-2)], dim=-2)
    u = torch.fft.rfftfreq(2 * width, dtype=wide.dtype, device=images.device)
    v = torch.fft.fftfreq(2 * height, dtype=wide.dtype, device=images.device)[:, None]
    image: Tensor = torch.fft.irfft2(torch.fft.rfft2(mirrored) * transfer(u, v), s=(2 * height, 2 * width))
    return image[..., :height, :width].to(images.dtype).contiguous()


def sharpened(images: Tensor, optics: Optics | None, scale: int) -> Tensor:
    """Restored frames (..., S H, S W) with the response of target optics instead of that of a camera.

    The target are pixels of the grid behind a Gaussian of half a pixel: MTF 0.19 at the Nyquist frequency.
    The restored frames are the posterior mean of the scene after the optics of the camera, and that of what follows by
    a linear filter is the filtered one, so that the prior limits the gain of noise. The filter is ``max(1, H_target /
    max(H_camera, 0.1))``: frequencies that the camera transmits better are not changed. Without ``optics``, none are.
    """
    if optics is None:
        return images

    target = Optics(sigma=0.5 / scale, pixel=1.0 / scale)

    def gain(u: Tensor, v: Tensor) -> Tensor:
        response = optics.transfer(scale * u, scale * v).clamp(min=_LEAST_RESPONSE)
        return (target.transfer(scale * u, scale * v) / response).clamp(min=1.0)

    return filtered(images, gain)


def _checked_mtf(mtf: object) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Frequencies, the first of which is 0, and values of a measured MTF."""
    if not isinstance(mtf, (tuple, list)) or len(mtf) != 2:
        raise TypeError(f"mtf must be a pair (frequencies, values), got {described(mtf)}")
    frequencies, values = (as_numbers(f"mtf[{index}]", part).flatten().tolist() for index, part in enumerate(mtf))
    if len(frequencies) != len(values) or not frequencies:
        raise ValueError(
            f"mtf must have one value for each frequency, got {len(frequencies)} frequencies and {len(values)} values"
        )
    for name, number in [("a frequency", f) for f in frequencies] + [("a value", v) for v in values]:
        check_number(f"{name} of mtf", number, at_least=0.0)
    if frequencies[0] > 0.0:
        frequencies, values = [0.0, *frequencies], [1.0, *values]
    for low, high in pairwise(frequencies):
        if high <= low:
            raise ValueError(f"the frequencies of mtf must increase, but {high:g} follows {low:g} cycles/px")
    return tuple(frequencies), tuple(values)


@options
@checked_methods
class SensorNoise:
    """Shot noise, read noise and quantisation of a sensor whose full scale is 1.

    A pixel with irradiance f has the value ``Poisson(F f) / F + read noise`` with the full well F, then quantised.

    Example:
        >>> SensorNoise(bits=1).apply(torch.tensor([[0.2, 0.7, 1.3]])).tolist()
        [[0.0, 1.0, 1.0]]
    """

    full_well: Positive | None = Field(
        default=None, description="Electrons at full scale, for shot noise; None for no shot noise."
    )
    read_noise: NotNegative = Field(
        default=0.0, description="Standard deviation of the Gaussian noise as a fraction of full scale."
    )
    bits: Annotated[int, Field(ge=1, le=32)] | None = Field(
        default=None,
        description="Bits of the converter (values are then clipped to 0 ... 1); None for no quantisation.",
    )

    def apply(self, frames: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Return noisy frames of the same shape and dtype.

        Args:
            frames: Noise-free frames, full scale 1.
            generator: Source of randomness, on the device of the frames.

        Raises:
            ValueError: If a pixel is NaN or infinite.
        """
        check_images({"frames": frames}, {"frames": "..."})
        check_pixels("frames", frames)
        if self.full_well is not None:
            frames = torch.poisson(frames.clamp(min=0.0) * self.full_well, generator=generator) / self.full_well
        if self.read_noise > 0:
            noise = torch.randn(frames.shape, generator=generator, dtype=frames.dtype, device=frames.device)
            frames = frames + self.read_noise * noise
        if self.bits is not None:
            levels = 2.0**self.bits - 1
            frames = (frames.clamp(0.0, 1.0) * levels).round() / levels
        return frames
