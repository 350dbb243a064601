"""Noise of an image sensor, and the pattern that is fixed to it."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.core.checks import check_number, check_whole_number

__all__ = ["SensorNoise"]


@dataclass(frozen=True)
class SensorNoise:
    """Shot noise, read noise, fixed pattern and quantisation of a sensor whose full scale is 1.

    A pixel that is hit by the light f yields ``Poisson(F f (1 + p)) / F + c + r + read noise``, then rounded, with the
    full well F, its own gain error p and the offsets c and r of its column and row: p, c and r are Gaussian, drawn
    once from ``pattern_seed``, and stay with the sensor from frame to frame, whatever the motion.

    Args:
        full_well: Electrons at full scale, for shot noise; None for none.
        read_noise: Standard deviation of the Gaussian noise as a fraction of full scale.
        bits: Bits of the converter (values are then clipped to 0 ... 1); None for none.
        gain_spread: Standard deviation of the pixels' gain (photo response non-uniformity), as a fraction.
        column_offset: Standard deviation of the columns' offsets as a fraction of full scale.
        row_offset: Standard deviation of the rows' offsets as a fraction of full scale.
        pattern_seed: Seed of the fixed pattern: one sensor.

    Example:
        >>> SensorNoise(bits=1).apply(torch.tensor([[0.2, 0.7, 1.3]])).tolist()
        [[0.0, 1.0, 1.0]]
    """

    full_well: float | None = None
    read_noise: float = 0.0
    bits: int | None = None
    gain_spread: float = 0.0
    column_offset: float = 0.0
    row_offset: float = 0.0
    pattern_seed: int = 0

    def __post_init__(self) -> None:
        if self.full_well is not None:
            check_number("full_well", self.full_well, above=0.0)
        check_number("read_noise", self.read_noise, at_least=0.0)
        if self.bits is not None and (isinstance(self.bits, bool) or self.bits != math.floor(self.bits)):
            raise TypeError(f"bits must be a whole number, got {self.bits!r}")
        if self.bits is not None:
            check_number("bits", self.bits, at_least=1, at_most=32)
        for name in ("gain_spread", "column_offset", "row_offset"):
            check_number(name, getattr(self, name), at_least=0.0, at_most=1.0)
        check_whole_number("pattern_seed", self.pattern_seed, at_least=0)

    def fixed_pattern(self, height: int, width: int) -> tuple[Tensor, Tensor]:
        """Gain and offset of every pixel, float64 (height, width), the same at every call.

        Args:
            height: Rows of the sensor.
            width: Columns of the sensor.
        """
        generator = torch.Generator().manual_seed(self.pattern_seed)
        columns, rows, pixels = (
            torch.randn(shape, generator=generator, dtype=torch.float64)
            for shape in ((1, width), (height, 1), (height, width))
        )
        return 1 + self.gain_spread * pixels, self.column_offset * columns + self.row_offset * rows

    def apply(self, frames: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Return noisy frames of the same shape and dtype.

        Args:
            frames: Noise-free frames (..., H, W) of the whole sensor, full scale 1.
            generator: Source of randomness, on the device of the frames.
        """
        patterned = self.gain_spread > 0 or self.column_offset > 0 or self.row_offset > 0
        if patterned:
            gain, offset = (part.to(frames) for part in self.fixed_pattern(*frames.shape[-2:]))
            frames = frames * gain
        if self.full_well is not None:
            frames = torch.poisson(frames.clamp(min=0.0) * self.full_well, generator=generator) / self.full_well
        if patterned:
            frames = frames + offset
        if self.read_noise > 0:
            noise = torch.randn(frames.shape, generator=generator, dtype=frames.dtype, device=frames.device)
            frames = frames + self.read_noise * noise
        if self.bits is not None:
            levels = 2.0**self.bits - 1
            frames = (frames.clamp(0.0, 1.0) * levels).round() / levels
        return frames
