"""Slanted-edge measurement of the MTF (ISO 12233, e-SFR)."""

import math

import torch

from rsvib_torch.evaluation.mtf.edge_checks import as_real, check_edge, check_roi
from rsvib_torch.evaluation.mtf.edge_geometry import fit_edge, start_edge, straighten
from rsvib_torch.evaluation.mtf.edge_spread import fit_spread
from rsvib_torch.evaluation.mtf.mtf_curve import FREQUENCIES, MtfCurve, first_crossing
from rsvib_torch.frames.arrays import ArrayLike

__all__ = ["slanted_edge_mtf"]

_STEP = 1e-4  # cycles/px, for the slope of the curve


def slanted_edge_mtf(roi: ArrayLike) -> MtfCurve:
    """Measure the MTF across a slanted edge (ISO 12233, e-SFR).

    ``MTF(f) = |int LSF(x) exp(-2 pi i f x) dx|`` with the line spread function along the *normal* of the edge, pixel
    included: seen through optics of transfer T, an edge at an angle a has ``MTF = |T(f)| sinc(f cos a) sinc(f sin a)``.
    Edge (also slightly curved), blur and sides, whose brightness may change linearly, are fitted to all pixels at
    once; the edge spread function then departs from Gaussian optics as far as the pixels demand it, so there is
    neither binning nor window nor finite difference to correct for.

    Grey values must be linear in light: undo a gamma first. Their scale does not matter; integers are taken as
    counts. Light that is scattered farther than the ROI reaches is inferred where it falls off as diffraction's does,
    and counts as level of the sides otherwise.

    Args:
        roi: (h, w), tensor or NumPy array, at least 16 x 16 px, with one straight edge 2 ... 40 degrees from the
            vertical or horizontal that reaches from border to border, either side brighter.

    Returns:
        The curve up to 1 cycle/px, with MTF50, standard deviations, and the spread functions.

    Raises:
        TypeError: If the ROI does not hold real numbers.
        ValueError: If it is not one finite image, too small, shows no edge, the edge is not slanted or too near to
            45 degrees, comes too near to a border alongside it, or is clipped.

    Example:
        >>> y, x = torch.meshgrid(torch.arange(60.0) - 30, torch.arange(40.0) - 20, indexing="ij")
        >>> curve = slanted_edge_mtf(torch.special.ndtr((x + 0.1 * y) / 0.8))
        >>> f"{curve.angle:.2f} degrees, MTF50 {curve.mtf50:.4f}, at Nyquist {curve.at(0.5):.4f}"
        '5.71 degrees, MTF50 0.2354, at Nyquist 0.0438'
    """
    grey = as_real("roi", roi)
    values = check_roi(grey)
    limits = (0.0, 1.0)
    if not grey.dtype.is_floating_point:
        limits = (float(torch.iinfo(grey.dtype).min), float(torch.iinfo(grey.dtype).max))
    scatter, columns, near_vertical, mirrored = straighten(values)
    fit = fit_edge(scatter, start_edge(scatter, columns))
    room = check_edge(fit, scatter, columns, limits)
    spread = fit_spread(fit, scatter, room)

    frequency = torch.linspace(0, 1, FREQUENCIES, dtype=torch.float64, device=grey.device)
    mtf = spread.mtf(frequency)
    mtf50 = first_crossing(spread.mtf, frequency, mtf, 0.5)
    beside = spread.mtf(torch.stack([mtf50 - _STEP, mtf50 + _STEP]))
    mtf50_std = spread.std(mtf50[None])[0] * 2 * _STEP / (beside[1] - beside[0]).abs()
    turn = math.degrees(math.atan(float(spread.fit.slope(scatter))))
    return MtfCurve(
        frequency=frequency,
        mtf=mtf,
        std=spread.std(frequency),
        mtf50=mtf50,
        mtf50_std=mtf50_std,
        angle=turn if mirrored == near_vertical else -turn,
        near_vertical=near_vertical,
        position=spread.position,
        esf=spread.esf,
        lsf=spread.lsf,
        tail=spread.tail,
        far=spread.far,
        levels=spread.fit.sides[:, 0],
        noise=spread.noise,
    )
