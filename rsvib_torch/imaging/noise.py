"""Noise of an image sensor."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.checks import check_number

__all__ = ["SensorNoise"]


@dataclass(frozen=True)
class SensorNoise:
    """Shot noise, read noise and quantisation of a sensor whose full scale is 1.

    Args:
        full_well: Electrons at full scale, for shot noise; None for none.
        read_noise: Standard deviation of the Gaussian noise as a fraction of full scale.
        bits: Bits of the converter (values are then clipped to 0 ... 1); None for none.

    Example:
        >>> SensorNoise(bits=1).apply(torch.tensor([[0.2, 0.7, 1.3]])).tolist()
        [[0.0, 1.0, 1.0]]
    """

    full_well: float | None = None
    read_noise: float = 0.0
    bits: int | None = None

    def __post_init__(self) -> None:
        if self.full_well is not None:
            check_number("full_well", self.full_well, above=0.0)
        check_number("read_noise", self.read_noise, at_least=0.0)
        if self.bits is not None and (isinstance(self.bits, bool) or self.bits != math.floor(self.bits)):
            raise TypeError(f"bits must be a whole number, got {self.bits!r}")
        if self.bits is not None:
            check_number("bits", self.bits, at_least=1, at_most=32)

    def apply(self, frames: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Return noisy frames of the same shape and dtype.

        Args:
            frames: Noise-free frames, full scale 1.
            generator: Source of randomness, on the device of the frames.
        """
        if self.full_well is not None:
            frames = torch.poisson(frames.clamp(min=0.0) * self.full_well, generator=generator) / self.full_well
        if self.read_noise > 0:
            noise = torch.randn(frames.shape, generator=generator, dtype=frames.dtype, device=frames.device)
            frames = frames + self.read_noise * noise
        if self.bits is not None:
            levels = 2.0**self.bits - 1
            frames = (frames.clamp(0.0, 1.0) * levels).round() / levels
        return frames
