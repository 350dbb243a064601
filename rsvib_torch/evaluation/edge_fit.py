"""Edge of a ROI: model of a blurred edge, its fit to all pixels, and checks that it can be measured."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.polynomial.legendre import legder, legval, legvander
from scipy.optimize import least_squares
from scipy.special import ndtr

from rsvib_torch.numerics.tables import Array

PARAMETERS = 11  # of ``EdgeFit``
BLUR, DARK, BRIGHT = 4, 5, 8  # log blur, and values of the sides in the middle of the ROI, among them
SLOPES = [6, 9]  # slopes of the two sides across the edge


def gaussian_edge(distance: Array, sigma: float, slope: float) -> tuple[Array, Array, Array]:
    """Edge and line spread function of Gaussian optics and square pixels, and the derivative of the first by sigma.

    The pixel, projected on the normal of the edge, is the convolution of two boxes, as wide as the cosine and the sine
    of the edge's angle. With the error function of the optics it is a second difference of its second integral, ``J(x)
    = ((x^2 + sigma^2) Phi(x / sigma) + sigma x phi(x / sigma)) / 2``. Distances are in px along the normal, positive on
    the bright side; ``slope`` is the tangent of the angle between edge and pixel.
    """
    wide = 0.5 / math.hypot(1.0, slope)
    narrow = wide * abs(slope)
    # evaluated on the dark side: on the bright side, differences of large numbers lose precision
    ends = np.array([wide + narrow, wide - narrow, narrow - wide, -wide - narrow])
    x = ends - np.abs(distance)[:, None]
    below, density = ndtr(x / sigma), np.exp(-0.5 * (x / sigma) ** 2) / math.sqrt(2 * math.pi)
    signs = np.array([1, -1, -1, 1]) / (4 * wide * narrow)
    value = 0.5 * ((x**2 + sigma**2) * below + sigma * x * density) @ signs
    by_distance, by_sigma = (x * below + sigma * density) @ signs, sigma * below @ signs
    bright = distance > 0
    return np.where(bright, 1 - value, value), by_distance, np.where(bright, -by_sigma, by_sigma)


# --- Fit ---


@dataclass(frozen=True)
class Scatter:
    """Pixels (N,) of a ROI turned so that the edge is near-vertical and brightens to the right."""

    value: Array  # grey values
    x: Array  # columns from the middle of the ROI, px
    y: Array  # rows from the middle of the ROI, px
    half: tuple[float, float]  # half width and half height of the ROI in px
    columns: int  # of the turned ROI
    near_vertical: bool  # whether the edge was near-vertical before the ROI was turned
    mirrored: bool  # whether the ROI was mirrored

    @classmethod
    def of(cls, roi: Array) -> "Scatter":
        """Turn a ROI so that its edge is near-vertical and brightens to the right."""
        soft = _means(roi)
        near_vertical = bool(np.square(np.diff(soft, axis=1)).mean() >= np.square(np.diff(soft, axis=0)).mean())
        roi = roi if near_vertical else roi.T
        quarter = roi.shape[1] // 4 + 1
        mirrored = bool(roi[:, :quarter].mean() > roi[:, -quarter:].mean())
        roi = roi[:, ::-1] if mirrored else roi
        half = (0.5 * (roi.shape[1] - 1), 0.5 * (roi.shape[0] - 1))
        y, x = np.indices(roi.shape, dtype=np.float64).reshape(2, -1)
        return cls(roi.flatten(), x - half[0], y - half[1], half, roi.shape[1], near_vertical, mirrored)

    def along(self, y: Array) -> tuple[Array, Array]:
        """Legendre polynomials (N, 4) along the edge, and their slopes per px."""
        u = y / self.half[1]
        return legvander(u, 3), legval(u, legder(np.eye(4))).T / self.half[1]

    @property
    def across(self) -> Array:
        """Regressors (N, 3) of the brightness of a side: value in the middle, slopes to the right and down."""
        return np.stack([np.ones_like(self.x), self.x / self.half[0], self.y / self.half[1]], axis=1)


@dataclass(frozen=True)
class EdgeFit:
    """Edge, blur and sides: 11 parameters, as in ``linearised``."""

    parameters: Array
    scatter: Scatter

    @property
    def sigma(self) -> float:
        """Gaussian blur of the optics in px, from 0.05 to 60."""
        return math.exp(self.parameters[BLUR])

    @property
    def sides(self) -> Array:
        """(2, 3) dark and bright side: value in the middle, slopes to the right and down per half ROI."""
        return self.parameters[DARK:].reshape(2, 3)

    @property
    def contrast(self) -> float:
        """Bright minus dark in the middle of the ROI."""
        return float(self.parameters[BRIGHT] - self.parameters[DARK])

    @property
    def width(self) -> float:
        """Standard deviation of the line spread function in px."""
        return math.sqrt(self.sigma**2 + 1 / 12)  # with the variance of a pixel aperture

    @property
    def slope(self) -> float:
        """Columns per row in the middle of the edge."""
        return float((self.scatter.along(np.zeros(1))[1] @ self.parameters[:BLUR])[0])

    @property
    def angle(self) -> float:
        """Degrees between the edge and the nearest image axis in the middle of the edge, positive clockwise."""
        turn = math.degrees(math.atan(self.slope))
        return turn if self.scatter.mirrored == self.scatter.near_vertical else -turn

    def distance(self) -> tuple[Array, Array]:
        """Distance of every pixel along the normal, and its derivatives (N, 4) by the line."""
        values, slopes = self.scatter.along(self.scatter.y)
        line = self.parameters[:BLUR]
        slope, aside = slopes @ line, self.scatter.x - values @ line
        cosine = 1 / np.hypot(1, slope)
        derivative = -values * cosine[:, None] - slopes * (aside * slope * cosine**3)[:, None]
        return aside * cosine, derivative

    def linearised(self) -> tuple[Array, Array]:
        """Model value (N,), and derivatives (N, 11) by line, log sigma, dark and bright side."""
        distance, by_line = self.distance()
        esf, lsf, by_sigma = gaussian_edge(distance, self.sigma, self.slope)
        regressors = self.scatter.across
        dark, bright = self.sides @ regressors.T
        jacobian = np.column_stack(
            [
                ((bright - dark) * lsf)[:, None] * by_line,
                (bright - dark) * by_sigma * self.sigma,
                (1 - esf)[:, None] * regressors,
                esf[:, None] * regressors,
            ]
        )
        return dark + (bright - dark) * esf, jacobian

    def moved(self, step: Array) -> "EdgeFit":
        """The fit after a step of its parameters, of which that of the blur is limited."""
        parameters = self.parameters + step
        blur = self.parameters[BLUR] + np.clip(step[BLUR], -1.0, 1.0)
        parameters[BLUR] = np.clip(blur, *_BLUR_LIMITS)
        return EdgeFit(parameters, self.scatter)


# part of the range of the values of a region by which its sides differ at least; otherwise the start of the fit is not
# finite
_LEAST_STEP = 1e-3
_BLUR_LIMITS = np.log([0.05, 60.0])  # of log px


def _start_edge(scatter: Scatter) -> EdgeFit:
    """Start of the fit, from the sum of every row: robust to noise."""
    columns = scatter.columns
    image = scatter.value.reshape(-1, columns)
    few = max(2, columns // 12)
    low, high = image[:, :few].mean(), image[:, -few:].mean()
    if high - low < _LEAST_STEP * np.ptp(image):
        raise ValueError("no edge: both sides of the roi are equally bright; choose a part with a single edge")
    dark = ((high - image) / (high - low)).mean(1) * columns  # columns of each row
    rows = scatter.along(scatter.y[::columns])[0][:, :2]
    line = np.linalg.lstsq(rows, dark - 0.5 * columns)[0]
    return EdgeFit(np.array([*line, 0, 0, math.log(1.5), low, 0, 0, high, 0, 0]), scatter)


def fit_edge(scatter: Scatter) -> EdgeFit:
    """Least-squares fit of edge, Gaussian blur and sides to all pixels."""
    start = _start_edge(scatter).parameters
    lowest, highest = np.full((2, PARAMETERS), [[-np.inf], [np.inf]])
    lowest[BLUR], highest[BLUR] = _BLUR_LIMITS
    found = least_squares(
        lambda parameters: EdgeFit(parameters, scatter).linearised()[0] - scatter.value,
        start,
        lambda parameters: EdgeFit(parameters, scatter).linearised()[1],
        bounds=(lowest, highest),
        x_scale="jac",
        **dict.fromkeys(("ftol", "xtol", "gtol"), 1e-12),
        max_nfev=100,
    )
    return EdgeFit(found.x, scatter)


# --- Checks ---


def _means(image: Array) -> Array:
    """Means of all squares of 5 x 5 px."""
    return sliding_window_view(image, (5, 5)).mean((-2, -1))


def check_roi(roi: Array) -> None:
    """Check the shape and the values of a ROI in float64."""
    if roi.ndim != 2:
        raise ValueError(f"roi must be one grey image (h, w), got shape {roi.shape}")
    if min(roi.shape) < 16:
        raise ValueError(f"roi must be at least 16 x 16 px, got {roi.shape[0]} x {roi.shape[1]}")
    invalid = int((~np.isfinite(roi)).sum())
    if invalid:
        raise ValueError(f"roi must be finite, got {invalid} pixels that are NaN or infinite")
    if np.ptp(roi) <= 1e-9 * np.abs(roi).max():
        raise ValueError(f"roi shows no edge: all pixels are {roi[0, 0]:g}")


def check_edge(fit: EdgeFit, limits: tuple[float, float]) -> float:
    """Raise if the ROI does not contain one measurable slanted edge, of values within ``limits``.

    The result is the smallest distance in px between the edge and a border of the turned ROI beside it.
    """
    scatter, contrast = fit.scatter, fit.contrast
    residual, distance = scatter.value - fit.linearised()[0], fit.distance()[0]
    explained = 1 - residual.var() / scatter.value.var()
    if not explained >= 0.5 or not contrast > 0:
        raise ValueError(
            f"roi shows no edge: a straight edge explains {100 * max(explained, 0.0):.0f} % of the variance, "
            "expected at least 50 %"
        )
    angle = abs(fit.angle)
    if not 2.0 <= angle <= 40.0:
        problem = "not slanted enough" if angle < 2.0 else "too close to 45 degrees"
        raise ValueError(f"the edge is {problem}: {angle:.2f} degrees from the nearest image axis, expected 2 ... 40")
    rays = distance.reshape(-1, scatter.columns)
    crossed = abs(fit.slope) * len(rays)
    if crossed < 1:
        raise ValueError(
            f"the edge crosses {crossed:.2f} px over {len(rays)} px of length, expected at least 1: "
            "use a longer roi or a larger angle"
        )
    room = float(min(-rays[:, 0].max(), rays[:, -1].min()))
    wanted = max(4.0, 3.0 * fit.width)
    if room < wanted:
        raise ValueError(
            f"the edge comes within {max(room, 0.0):.1f} px of the border of the roi, expected at least {wanted:.1f} px"
        )
    _check_clipping(fit, distance, limits)
    # patches of 5 x 5 px of the sides, and the standard deviation of their mean residual due to noise
    patches = np.abs(_means(np.where(np.abs(distance) > 4 * fit.width + 2, residual, 0.0).reshape(rays.shape)))
    steps = np.abs(np.diff(residual.reshape(rays.shape), axis=1))
    noise = np.median(steps) / 0.954 / 5  # 0.954: median absolute difference of two standard normal numbers
    worst = patches.max()
    if worst > 0.1 * contrast + 6 * noise:
        row, column = np.unravel_index(patches.argmax(), patches.shape)
        raise ValueError(
            f"roi shows more than one edge: {100 * worst / contrast:.0f} % of its contrast near "
            f"{row + 2} px along and {column + 2} px across the edge, expected even sides"
        )
    return room


def _check_clipping(fit: EdgeFit, distance: Array, limits: tuple[float, float]) -> None:
    """Raise if a tenth of the pixels of a side have one extreme value although noise would exceed it."""
    value, far = fit.scatter.value, np.abs(distance) > 4 * fit.width
    sides = [value[(distance < 0) & far], value[(distance > 0) & far]]
    if min(map(len, sides)) == 0:
        return
    extremes = (value.min(), value.max())
    shares = [(side == extreme).mean() for side, extreme in zip(sides, extremes, strict=True)]
    least_noise = 1e-3 * fit.contrast
    at_limits = (extremes[0] <= limits[0], extremes[1] >= limits[1])
    for index, name in enumerate(("dark", "bright")):
        extreme, share = extremes[index], shares[index]
        has_noise = np.sqrt(np.square(sides[index] - extreme).mean()) > least_noise
        only_this = shares[1 - index] < 0.1 * share and sides[1 - index].std() > least_noise
        is_black = index == 0 and at_limits[0]  # without light there is no noise
        if share >= 0.1 and ((at_limits[index] and has_noise) or (only_this and not is_black)):
            raise ValueError(
                f"the {name} side of the edge is clipped: {100 * share:.0f} % of its pixels are exactly {extreme:g}"
            )
