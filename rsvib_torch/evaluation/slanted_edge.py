"""Slanted-edge measurement of the MTF (e-SFR of ISO 12233) by a fit to all pixels, and its result.

The edge spread function is that of Gaussian optics and a pixel plus a random departure: a sum of Gaussian bumps along
the normal of the edge, whose heights decay with the distance from it, and a tail that decays as slowly as diffraction
beyond the ROI. Their strength, width and decay are averaged over priors weighted by their restricted likelihood, so
that the departure shrinks to zero where the pixels agree with Gaussian optics.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq
from scipy.special import sici, softmax
from torch import Tensor

from rsvib_torch.checks.arguments import ArrayLike, as_tensor, checks_arguments
from rsvib_torch.checks.values import check_number
from rsvib_torch.evaluation.edge_fit import (
    ACROSS,
    BLUR,
    BRIGHT,
    DARK,
    PARAMETERS,
    Edge,
    check_edge,
    check_roi,
    fit_edge,
    gaussian_edge,
)
from rsvib_torch.numerics.tables import Array
from rsvib_torch.results.presentation import Result
from rsvib_torch.text import measured_text

# Lengths are in px for a line spread function of a standard deviation of up to 1 px, and in units of it beyond.
# of the bumps; wider ones (1.27) state 2.3 times too small deviations for edges with a halo
_WIDTHS = (0.28, 0.57)
_GROWTH = 10.0  # distance from the edge beyond which the width is proportional to it
_TAIL = 2.0  # width of the tail; with 4, noise-free MTF50 behind diffraction is wrong by up to 0.06 instead of 0.02 %
# distance and power of the decay of the heights: quadratic, or, with a tail, as slow as that of diffraction
_DECAYS = ((1.0, 2), (2.5, 2), (6.0, 2), (_TAIL, 1))
_STRENGTHS = np.array([0.0, *10.0 ** (0.5 * np.arange(-10, 0))])  # heights over the contrast
# standard deviations of the slopes of the sides across the edge over the contrast, per half ROI: even and uneven sides
_SHADINGS = (1e-6, 0.1)
_LEAST_WEIGHT = 1e-3  # of a prior, over that of the best


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
        lsf: (N,) line spread function per px, the derivative of ``esf``; beyond, it decays as the inverse square.
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
        points = torch.as_tensor(frequency, dtype=torch.float64, device=self.lsf.device)
        if not bool(((points >= 0) & (points <= 1)).all()):
            raise ValueError(f"frequency must lie within 0 ... 1 cycles/px, got {points.min():g} ... {points.max():g}")
        spread = (value.cpu().numpy() for value in (points.flatten(), self.position, self.lsf))
        return torch.from_numpy(np.abs(_transfer(*spread))).to(points).view(points.shape)


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
    # 1. Edge, and line spread function with the square roots of its covariance.
    check_roi(values)
    edge = fit_edge(values)
    edge, noise, position, posteriors = _fit_spread(edge, room=check_edge(edge, limits))
    gaussian = gaussian_edge(position, edge.sigma, edge.pixel)[1]
    weights = softmax([one.evidence for one in posteriors])  # of the priors
    spreads = np.stack([gaussian + one.lsf @ one.shape for one in posteriors])
    lsf = weights @ spreads
    # 2. MTF with its standard deviation: within the priors, and between them.
    frequency = np.linspace(0.0, 1.0, 101)
    mean = _transfer(frequency, position, lsf)
    mtf = np.abs(mean)
    ramps = np.real(_ramps(frequency, position) * np.exp(-1j * np.angle(mean)[:, None]))
    within = np.stack([np.square(ramps @ one.lsf @ one.root).sum(-1) for one in posteriors])
    between = np.square(np.abs(_transfer(frequency, position, spreads)) - mtf)
    std = np.sqrt(weights @ (within + between))
    # 3. Where the MTF first falls to one half.
    mtf50 = mtf50_std = math.nan
    below = np.flatnonzero(mtf <= 0.5)
    if len(below):
        step = 1e-4  # cycles/px, for the slope of the curve

        def above_half(at: float) -> float:
            return float(np.abs(_transfer(np.array([at]), position, lsf))[0]) - 0.5

        mtf50 = brentq(above_half, *frequency[below[0] - 1 : below[0] + 1], xtol=1e-15)
        slope = (above_half(mtf50 + step) - above_half(mtf50 - step)) / (2 * step)
        mtf50_std = float(np.interp(mtf50, frequency, std)) / abs(slope)

    def tensor(value: Array | float) -> Tensor:
        return torch.as_tensor(value, dtype=torch.float64, device=grey.device)

    return MtfCurve(
        frequency=tensor(frequency),
        mtf=tensor(mtf),
        std=tensor(std),
        mtf50=tensor(mtf50),
        mtf50_std=tensor(mtf50_std),
        angle=edge.angle,
        near_vertical=edge.near_vertical,
        position=tensor(position),
        esf=tensor(CubicSpline(position, lsf).antiderivative()(position) + lsf[0] * position[-1]),
        lsf=tensor(lsf),
        levels=tensor(edge.parameters[[DARK, BRIGHT]]),
        noise=tensor(noise),
    )


# --- Edge spread function ---


class _Bumps(NamedTuple):
    """Tail and Gaussian bumps (K,) along the normal of the edge, each as wide as the distance to its neighbours.

    The tail ``-x w / (x^2 + w^2)`` is that of the edge spread function of optics limited by diffraction.
    """

    centre: Array  # px
    width: Array  # px, standard deviation
    tail: float  # w in px

    @classmethod
    def within(cls, room: float, width: float, scale: float) -> "_Bumps":
        """Bumps up to ``room`` px beside the edge."""
        growth = _GROWTH * scale
        count = int(growth * math.asinh(room / growth) / width - 1.0)
        place = np.arange(-count, count + 1) * width / growth
        return cls(growth * np.sinh(place), width * np.cosh(place), _TAIL * scale)

    def fades(self, scale: float) -> Array:
        """Standard deviations (D, 1 + K) of the heights of tail and bumps by their decay, at strength 1."""
        fades = [(1 + (self.centre / (length * scale)) ** 2) ** (-0.5 * power) for length, power in _DECAYS]
        return np.column_stack([[float(power == 1) for _, power in _DECAYS], fades])

    def at(self, distance: Array) -> tuple[Array, Array]:
        """Values (N, 1 + K) and derivatives per px of tail and bumps at distances (N,) in px."""
        ratio = (distance[:, None] - self.centre) / self.width
        values, square = np.exp(-0.5 * ratio**2), distance**2 + self.tail**2
        tail, slope = -distance * self.tail / square, (distance**2 - self.tail**2) * self.tail / square**2
        return np.column_stack([tail, values]), np.column_stack([slope, -ratio / self.width * values])


class _Posterior(NamedTuple):
    """Edge and departure under one prior."""

    evidence: float  # logarithm of the restricted likelihood
    edge: Array  # (11,) step of the parameters of the edge
    shape: Array  # (2 + K,) step of the logarithm of the blur, and heights of tail and bumps
    root: Array  # (2 + K, S) square root of their covariance
    lsf: Array  # (N, 2 + K) derivatives of the line spread function by them


def _ramps(frequency: Array, position: Array) -> Array:
    """Factors (F, N) of a line spread function at evenly spaced positions -end ... end in its Fourier integral.

    Beyond them, it decays as that of diffraction: with the square of the distance.
    """
    step, end, turns = position[1] - position[0], position[-1], 2 * math.pi * frequency
    ramps = np.exp(-1j * turns[:, None] * position) * step
    # integral of cos(turns x) (end / x)^2 from the end to infinity; a half step of it is in the sum
    beyond = end * (np.cos(turns * end) + turns * end * (sici(turns * end)[0] - 0.5 * math.pi))
    ramps[:, [0, -1]] += (beyond - 0.5 * step * np.cos(turns * end))[:, None]
    return ramps


def _transfer(frequency: Array, position: Array, lsf: Array) -> Array:
    """Complex transfer (..., F) of line spread functions (..., N) at evenly spaced positions, 1 at frequency 0."""
    return lsf @ _ramps(frequency, position).T / (lsf @ _ramps(np.zeros(1), position)[0].real)[..., None]


def _posteriors(matrix: Array, right: Array, lsf: Array, fades: Array, contrast: float) -> list[_Posterior]:
    """Average over all priors of one set of bumps, from the normal equations of edge and heights.

    ``fades`` (D, 1 + K) are standard deviations of the heights at strength 1.
    """
    edge, rest, posteriors, best = slice(None, PARAMETERS), slice(PARAMETERS, None), [], -math.inf
    for shading in _SHADINGS:
        # elimination of edge and sides
        precision = matrix[edge, edge].copy()
        precision[ACROSS, ACROSS] += (shading * contrast) ** -2
        size = np.sqrt(np.diag(precision))
        scaled = precision / size / size[:, None] + 1e-13 * np.eye(PARAMETERS)
        free = np.linalg.inv(np.linalg.cholesky(scaled)).T / size[:, None]  # square root of the covariance
        follow = -free @ (free.T @ matrix[edge, rest])  # derivatives by the heights
        start = free @ (free.T @ right[edge])
        gram, alone = matrix[rest, rest] + matrix[rest, edge] @ follow, right[rest] - matrix[rest, edge] @ start
        evidence = 0.5 * right[edge] @ start + np.log(np.diag(free)).sum() - len(ACROSS) * math.log(shading)
        for fade in fades:
            # uncorrelated modes of the heights, which all strengths have in common
            values, vectors = np.linalg.eigh(fade[:, None] * gram * fade)
            values, modes = np.maximum(values, 0.0), fade[:, None] * vectors
            projected = modes.T @ alone
            for variance in _STRENGTHS**2:
                shrunk = variance / (1 + variance * values)
                total = evidence + 0.5 * (shrunk * projected**2 - np.log1p(variance * values)).sum()
                best = max(best, total)
                if total < best + math.log(_LEAST_WEIGHT):
                    continue
                root, heights = modes * np.sqrt(shrunk), modes @ (shrunk * projected)
                moved = start + follow @ heights
                of_shape = np.block([[follow[BLUR] @ root, free[BLUR]], [root, np.zeros((len(root), PARAMETERS))]])
                posteriors.append(_Posterior(total, moved, np.append(moved[BLUR], heights), of_shape, lsf))
    return posteriors


def _fit_spread(edge: Edge, room: float) -> tuple[Edge, float, Array, list[_Posterior]]:
    """Fit the edge spread function; ``room`` is the px between the edge and the nearer border alongside it.

    The result is the edge with its Gaussian blur, the standard deviation of the noise of a pixel, positions (N,) in px
    along the normal, and the departures from the line spread function of the Gaussian blur there.
    """
    scale = max(1.0, edge.width)
    bases = [_Bumps.within(room, width * scale, scale) for width in _WIDTHS]
    samples = 16  # per px
    count = math.ceil(samples * (2 * room + 10 * edge.width))
    position = np.arange(-count, count + 1) / samples
    departure = np.zeros_like(position)
    # Noise of rounding, if values are on steps: without it, errors of MTF50 of noise-free 8-bit edges reach 20 std.
    levels = np.unique(edge.roi)
    rounding = 0.0 if len(levels) > edge.roi.size // 4 else float(np.diff(levels).min()) / math.sqrt(12)
    floor = max(1e-6 * edge.contrast, rounding)
    for _ in range(3):
        # derivative of the line spread function by the logarithm of the blur
        change = 1e-3
        wider, narrower = (gaussian_edge(position, edge.sigma * math.exp(s * change), edge.pixel)[1] for s in (1, -1))
        by_blur = (wider - narrower) / (2 * change)
        # 1. Linear model of the pixels around the last line; the prior of the slopes is centred on 0.
        distance = edge.distance()[0]
        model, jacobian = edge.linearised(np.interp(distance, position, departure))
        residual = edge.roi.ravel() - model + jacobian[:, ACROSS] @ edge.parameters[ACROSS]
        posteriors: list[_Posterior] = []
        noise = 0.0
        for bumps in bases:
            # 2. Normal equations, and the noise that the narrowest bumps leave.
            dense = np.column_stack([jacobian, edge.contrasts()[:, None] * bumps.at(distance)[0]])
            matrix, right = dense.T @ dense, dense.T @ residual
            if not posteriors:
                size = np.sqrt(np.diag(matrix))
                damped = matrix / size / size[:, None] + 1e-9 * np.eye(len(size))
                explained = right / size @ np.linalg.solve(damped, right / size)
                freedom = max(len(residual) - len(size), 0.3 * len(residual))
                noise = math.sqrt(max((residual @ residual - explained) / freedom, floor**2))
            # 3. All parameters by their priors.
            lsf = np.column_stack([by_blur, bumps.at(position)[1]])
            posteriors += _posteriors(matrix / noise**2, right / noise**2, lsf, bumps.fades(scale), edge.contrast)
        best = max(one.evidence for one in posteriors)
        posteriors = [one for one in posteriors if one.evidence > best + math.log(_LEAST_WEIGHT)]
        weights = softmax([one.evidence for one in posteriors])
        # 4. Move edge and sides, and narrow or widen the Gaussian blur.
        departure = weights @ np.stack([one.lsf @ one.shape for one in posteriors])
        step = weights @ np.stack([one.edge for one in posteriors])
        step[ACROSS] -= edge.parameters[ACROSS]
        step[BLUR] = np.clip(step[BLUR], -0.5, 0.5)
        before, edge = edge, edge.moved(edge.parameters + step)
        if not edge.contrast > 0:  # that of an edge that a vibration has torn apart, for example
            raise ValueError("the pixels do not follow one edge between a dark and a bright side; choose another roi")
    return before, noise, position, posteriors
