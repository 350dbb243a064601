"""Slanted-edge measurement of the MTF (ISO 12233, e-SFR), and its result."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import brentq
from torch import Tensor

from rsvib_torch.checks.arguments import ArrayLike, as_tensor, checks_arguments
from rsvib_torch.checks.values import check_number
from rsvib_torch.evaluation.edge_fit import Scatter, check_edge, check_roi, fit_edge
from rsvib_torch.evaluation.edge_spread import Tail, fit_spread
from rsvib_torch.numerics.tables import Array
from rsvib_torch.results.presentation import Result
from rsvib_torch.text import measured_text


@dataclass(frozen=True, repr=False)
class MtfCurve(
    Result,
    units={
        "frequency": "cycles/px",
        "mtf50": "cycles/px",
        "mtf50_std": "cycles/px",
        "angle": "degrees",
        "position": "px",
        "lsf": "1/px",
    },
    shapes={
        **dict.fromkeys(("frequency", "mtf", "std"), "F"),
        **dict.fromkeys(("position", "esf", "lsf"), "N"),
        "levels": "2",
    },
):
    """Modulation transfer function along the normal of an edge.

    ``MTF(f) = |int LSF(x) exp(-2 pi i f x) dx|`` with x in px along the normal, from the dark to the bright side.

    Attributes:
        frequency: (F,) 0 ... 1 cycles/px along the normal; 0.5 is the Nyquist frequency of a row of pixels.
        mtf: (F,) 1 at frequency 0.
        std: (F,) standard deviation of ``mtf`` due to the noise of the pixels.
        mtf50: () frequency at which the MTF first falls to 0.5; NaN where it does not up to 1 cycle/px.
        mtf50_std: () its standard deviation.
        angle: Degrees between the edge and the nearest image axis in the middle of the edge, positive where the
            edge runs clockwise of it (towards the right going up, towards the bottom going right).
        near_vertical: Whether the nearest axis is the vertical one: the MTF is then the horizontal one.
        position: (N,) px along the normal, evenly spaced, 0 at the edge.
        esf: (N,) edge spread function, 0 on the dark and 1 on the bright side.
        lsf: (N,) line spread function per px, the derivative of ``esf``.
        tail: Shape of its tail beyond ``position``.
        far: () amplitude of the tail in ``esf`` and ``lsf``.
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

    def summary(self) -> str:
        """MTF50, MTF at the Nyquist frequency, the edge, and the noise."""
        nyquist = int((self.frequency - 0.5).abs().argmin())
        edge = "vertical" if self.near_vertical else "horizontal"
        contrast = float(self.levels[1]) - float(self.levels[0])
        return "\n".join(
            [
                f"MTF50 {measured_text(self.mtf50, self.mtf50_std)} cycles/px",
                f"MTF {measured_text(self.mtf[nyquist], self.std[nyquist])} at the Nyquist frequency",
                f"edge {self.angle:.2f} degrees from the {edge} axis, contrast {contrast:.4g}",
                f"noise {measured_text(self.noise, digits=2)} (standard deviation of a pixel)",
            ]
        )

    @checks_arguments
    def at(self, frequency: float | Tensor) -> Tensor:
        """MTF at frequencies of any shape, cycles/px, computed from the line spread function."""
        if not isinstance(frequency, Tensor):
            check_number("frequency", frequency, at_least=0.0, at_most=1.0)
        wanted = torch.as_tensor(frequency, dtype=torch.float64, device=self.lsf.device)
        if not bool(((wanted >= 0) & (wanted <= 1)).all()):
            raise ValueError(f"frequency must lie within 0 ... 1 cycles/px, got {wanted.min():g} ... {wanted.max():g}")
        spread = (value.cpu().numpy() for value in (self.position, self.lsf, self.far, wanted.flatten()))
        return torch.from_numpy(np.abs(self.tail.transfer(*spread))).to(wanted).view(wanted.shape)


@checks_arguments
def slanted_edge_mtf(roi: ArrayLike) -> MtfCurve:
    """Measure the MTF across a slanted edge (ISO 12233, e-SFR).

    ``MTF(f) = |int LSF(x) exp(-2 pi i f x) dx|`` with the line spread function along the *normal* of the edge, pixel
    aperture included: with optics of transfer T, an edge at an angle a has ``MTF = |T(f)| sinc(f cos a) sinc(f sin
    a)``. Edge (also slightly curved), blur and sides, whose brightness may change linearly, are fitted to all pixels at
    once; the edge spread function then departs from that of Gaussian optics as far as the pixels require. There is no
    binning, window or finite difference to correct for.

    Grey values must be linear in light: undo a gamma first. Their scale does not matter; integers are counts. Light
    scattered beyond the ROI is estimated if it decays like diffraction, and is part of the level of the sides
    otherwise.

    Args:
        roi: (h, w), tensor or NumPy array, at least 16 x 16 px, with one straight edge 2 ... 40 degrees from the
            vertical or horizontal that reaches from border to border, either side brighter.

    Returns:
        The curve up to 1 cycle/px, with MTF50, standard deviations, and the spread functions.

    Raises:
        ValueError: If it is not one finite image, too small, contains no edge, the edge is not slanted or too close to
            45 degrees or to a border alongside it, or is clipped.

    Example:
        >>> y, x = torch.meshgrid(torch.arange(60.0) - 30, torch.arange(40.0) - 20, indexing="ij")
        >>> curve = slanted_edge_mtf(torch.special.ndtr((x + 0.1 * y) / 0.8))
        >>> f"{curve.angle:.2f} degrees, MTF50 {curve.mtf50:.4f}, at Nyquist {curve.at(0.5):.4f}"
        '5.71 degrees, MTF50 0.2354, at Nyquist 0.0438'
    """
    grey = as_tensor("roi", roi)
    if grey.dtype == torch.bool or grey.dtype.is_complex:
        raise TypeError(f"roi must hold real numbers, got {grey.dtype}")
    values, limits = grey.detach().to("cpu", torch.float64).numpy(), (0.0, 1.0)
    if not grey.dtype.is_floating_point:
        limits = (float(torch.iinfo(grey.dtype).min), float(torch.iinfo(grey.dtype).max))
    # 1. Edge and spread functions.
    check_roi(values)
    fit = fit_edge(Scatter.of(values))
    spread = fit_spread(fit, room=check_edge(fit, limits))
    # 2. MTF, and where it first falls to one half.
    frequency = np.linspace(0.0, 1.0, 101)
    mtf, mtf50 = spread.mtf(frequency), math.nan
    below = np.flatnonzero(mtf <= 0.5)
    if len(below):
        around = frequency[below[0] - 1 : below[0] + 1]
        mtf50 = brentq(lambda f: spread.mtf(np.array([f]))[0] - 0.5, *around, xtol=1e-15)
    step = 1e-4  # cycles/px, for the slope of the curve
    low, high = spread.mtf(np.array([mtf50 - step, mtf50 + step]))
    mtf50_std = spread.std(np.array([mtf50]))[0] * 2 * step / abs(high - low)

    def tensor(value: Array | float) -> Tensor:
        return torch.as_tensor(value, dtype=torch.float64, device=grey.device)

    return MtfCurve(
        frequency=tensor(frequency),
        mtf=tensor(mtf),
        std=tensor(spread.std(frequency)),
        mtf50=tensor(mtf50),
        mtf50_std=tensor(mtf50_std),
        angle=spread.fit.angle,
        near_vertical=fit.scatter.near_vertical,
        position=tensor(spread.position),
        esf=tensor(spread.esf),
        lsf=tensor(spread.lsf),
        tail=spread.tail,
        far=tensor(spread.far),
        levels=tensor(spread.fit.sides[:, 0]),
        noise=tensor(spread.noise),
    )
