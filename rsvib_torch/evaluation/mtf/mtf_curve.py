"""The result of a slanted-edge measurement."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.core.checks import check_number

__all__ = ["FREQUENCIES", "MtfCurve", "Tail", "first_crossing"]

FREQUENCIES = 101  # of the curve, 0 ... 1 cycle/px
_BISECTIONS = 50


@dataclass(frozen=True)
class Tail:
    """A part of an edge spread function that falls as slowly as diffraction's: ``-x w / (x^2 + w^2)``.

    Its transform is known in closed form, so that what lies beyond any samples need not be sampled.

    Args:
        width: w in px.
    """

    width: float

    def esf(self, distance: Tensor) -> Tensor:
        """Value at distances in px from the edge."""
        return -distance * self.width / (distance.square() + self.width**2)

    def lsf(self, distance: Tensor) -> Tensor:
        """Derivative of the value, per px."""
        squared, width = distance.square(), self.width
        return (squared - width**2) * width / (squared + width**2).square()

    def transfer(self, position: Tensor, lsf: Tensor, far: Tensor, frequency: Tensor) -> Tensor:
        """Complex transfer of line spread functions, 1 at frequency 0.

        Args:
            position: (N,) px, evenly spaced.
            lsf: (..., N), in which there is ``far`` of the tail.
            far: (...).
            frequency: (F,) cycles/px.

        Returns:
            (..., F).
        """
        angle = -2 * math.pi * frequency[:, None] * position
        ramps = torch.polar(torch.ones_like(angle), angle)
        sampled, step = self.lsf(position), position[1] - position[0]
        whole = -2 * (math.pi * self.width) * math.pi * frequency * torch.exp(-2 * math.pi * self.width * frequency)
        missing = whole / step - ramps @ sampled.to(ramps.dtype)
        total = lsf.sum(-1) - far * sampled.sum()
        return (lsf.to(ramps.dtype) @ ramps.mT + far[..., None] * missing) / total[..., None]


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
        tail: Shape of its tail, which goes on beyond ``position``.
        far: () how much of the tail there is in ``esf`` and ``lsf``.
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
    tail: Tail
    far: Tensor
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
        return self.tail.transfer(self.position, self.lsf, self.far, wanted.flatten()).abs().view(wanted.shape)


def first_crossing(curve: Callable[[Tensor], Tensor], frequency: Tensor, mtf: Tensor, level: float) -> Tensor:
    """Frequency at which the MTF ``curve`` first falls to ``level``; NaN where it does not within ``frequency``."""
    below = mtf <= level
    if not bool(below.any()):
        return torch.full((), math.nan, dtype=mtf.dtype, device=mtf.device)
    index = int(below.to(torch.int8).argmax())
    low, high = frequency[index - 1], frequency[index]
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        above = curve(middle[None])[0] > level
        low, high = torch.where(above, middle, low), torch.where(above, high, middle)
    return 0.5 * (low + high)
