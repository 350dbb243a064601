"""Slanted-edge measurement of the MTF (ISO 12233, e-SFR), and its result."""

import math
from dataclasses import dataclass

import torch
from scipy.optimize import brentq
from torch import Tensor

from rsvib_torch.checks.arguments import ArrayLike, as_tensor, checks_arguments
from rsvib_torch.checks.values import check_number
from rsvib_torch.evaluation.mtf.edge import check_edge, check_roi, fit_edge, straighten
from rsvib_torch.evaluation.mtf.spread import Tail, fit_spread
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
        return self.tail.transfer(self.position, self.lsf, self.far, wanted.flatten()).abs().view(wanted.shape)


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
    values = check_roi(grey)
    limits = (0.0, 1.0)
    if not grey.dtype.is_floating_point:
        limits = (float(torch.iinfo(grey.dtype).min), float(torch.iinfo(grey.dtype).max))
    scatter = straighten(values)
    fit = fit_edge(scatter)
    spread = fit_spread(fit, scatter, room=check_edge(fit, scatter, limits))

    frequency = torch.linspace(0, 1, 101, dtype=torch.float64, device=grey.device)
    mtf = spread.mtf(frequency)
    below = (mtf <= 0.5).nonzero()
    crossing = math.nan
    if len(below):
        around = frequency[int(below[0]) - 1 : int(below[0]) + 1].tolist()
        crossing = brentq(lambda f: float(spread.mtf(frequency.new_tensor([f]))) - 0.5, *around, xtol=1e-15)
    mtf50 = frequency.new_tensor(crossing)
    step = 1e-4  # cycles/px, for the slope of the curve
    beside = spread.mtf(torch.stack([mtf50 - step, mtf50 + step]))
    mtf50_std = spread.std(mtf50[None])[0] * 2 * step / (beside[1] - beside[0]).abs()
    return MtfCurve(
        frequency=frequency,
        mtf=mtf,
        std=spread.std(frequency),
        mtf50=mtf50,
        mtf50_std=mtf50_std,
        angle=spread.fit.angle(scatter),
        near_vertical=scatter.near_vertical,
        position=spread.position,
        esf=spread.esf,
        lsf=spread.lsf,
        tail=spread.tail,
        far=spread.far,
        levels=spread.fit.sides[:, 0],
        noise=spread.noise,
    )
