"""The result of a slanted-edge measurement."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.checks import check_number

__all__ = ["FREQUENCIES", "MtfCurve", "transfer"]

FREQUENCIES = 101  # of the curve, 0 ... 1 cycle/px
_BISECTIONS = 50


def transfer(position: Tensor, lsf: Tensor, frequency: Tensor) -> Tensor:
    """Complex transfer of line spread functions (..., N) sampled evenly, (..., F); 1 at frequency 0."""
    ramps = torch.polar(torch.ones_like(frequency[:, None] * position), -2 * math.pi * frequency[:, None] * position)
    return (lsf.to(ramps.dtype) @ ramps.mT) / lsf.sum(-1, keepdim=True)


@dataclass(frozen=True)
class MtfCurve:
    """Modulation transfer function along the normal of an edge.

    ``MTF(f) = |int LSF(x) exp(-2 pi i f x) dx|`` with x in px along the normal, from the dark to the bright side.

    Attributes:
        frequency: (F,) 0 ... 1 cycles/px along the normal; 0.5 is the Nyquist frequency of a row of pixels.
        mtf: (F,) 1 at frequency 0.
        std: (F,) standard deviation of ``mtf`` that the noise of the pixels leaves.
        mtf50: () frequency at which the MTF first falls to 0.5; NaN where it does not up to 1 cycle/px.
        mtf50_std: () its standard deviation.
        angle: Degrees between the edge and the nearest image axis in the middle of the edge, positive where the
            edge runs clockwise of it (towards the right going up, towards the bottom going right).
        near_vertical: Whether the nearest axis is the vertical one: the MTF is then the horizontal one.
        position: (N,) px along the normal, evenly spaced, 0 at the edge.
        esf: (N,) edge spread function, 0 on the dark and 1 on the bright side.
        lsf: (N,) line spread function per px, the derivative of ``esf``.
        levels: (2,) values of the dark and the bright side at the middle of the edge.
        noise: () standard deviation of the noise of a pixel, root mean square over the ROI.
    """

    frequency: Tensor
    mtf: Tensor
    std: Tensor
    mtf50: Tensor
    mtf50_std: Tensor
    angle: float
    near_vertical: bool
    position: Tensor
    esf: Tensor
    lsf: Tensor
    levels: Tensor
    noise: Tensor

    def at(self, frequency: float | Tensor) -> Tensor:
        """MTF at frequencies of any shape, cycles/px, computed afresh from the line spread function.

        Args:
            frequency: 0 ... 1 cycles/px.

        Returns:
            float64 tensor in the shape of ``frequency``.

        Raises:
            ValueError: If a frequency is negative, above 1 or not finite.
        """
        if not isinstance(frequency, Tensor):
            check_number("frequency", frequency, at_least=0.0, at_most=1.0)
        wanted = torch.as_tensor(frequency, dtype=torch.float64, device=self.lsf.device)
        if not bool(((wanted >= 0) & (wanted <= 1)).all()):
            raise ValueError(f"frequency must lie within 0 ... 1 cycles/px, got {wanted.min():g} ... {wanted.max():g}")
        return transfer(self.position, self.lsf, wanted.flatten()).abs().view(wanted.shape)


def first_crossing(position: Tensor, lsf: Tensor, frequency: Tensor, mtf: Tensor, level: float) -> Tensor:
    """Frequency at which the MTF first falls to ``level``; NaN where it does not within ``frequency``."""
    below = mtf <= level
    if not bool(below.any()):
        return torch.full((), math.nan, dtype=mtf.dtype, device=mtf.device)
    index = int(below.to(torch.int8).argmax())
    low, high = frequency[index - 1], frequency[index]
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        above = transfer(position, lsf, middle[None]).abs()[0] > level
        low, high = torch.where(above, middle, low), torch.where(above, high, middle)
    return 0.5 * (low + high)
