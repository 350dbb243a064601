"""Edge of a ROI: model of a blurred edge, its fit to all pixels, and checks that it can be measured."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.optimize import least_squares
from scipy.special import ndtr

from rsvib_torch.numerics.tables import Array

# Parameters of an edge: polynomial of the line (4), logarithm of the blur in px, dark and bright side (3 each)
BLUR, DARK, BRIGHT, PARAMETERS = 4, 5, 8, 11
ACROSS = [DARK + 1, BRIGHT + 1]  # slopes of the two sides across the edge
_BLUR_LIMITS = np.log([0.05, 60.0])  # logarithms of px; a pixel hides less blur, and a ROI does not contain more


def gaussian_edge(distance: Array, sigma: float, width: float) -> tuple[Array, Array, Array]:
    """Edge and line spread function of Gaussian optics and a pixel, and the derivative of the first by sigma.

    Distances (N,) are in px along the normal, positive on the bright side; ``width`` is that of the pixel along it.
    """
    ends = (distance[:, None] + np.array([0.5, -0.5]) * width) / sigma
    below, density = ndtr(ends), np.exp(-0.5 * ends**2) / math.sqrt(2 * math.pi)
    between = np.array([1, -1]) / width
    return sigma * (ends * below + density) @ between, below @ between, density @ between


@dataclass(frozen=True, eq=False)
class Edge:
    """A ROI turned so that its edge is near-vertical and brightens to the right, and the parameters of the edge."""

    roi: Array  # (h, w)
    near_vertical: bool  # whether the edge was near-vertical before the ROI was turned
    mirrored: bool  # whether the ROI was mirrored
    parameters: Array  # (11,) lines and sides are polynomials of the place in the ROI, which is -1 ... 1

    @property
    def sigma(self) -> float:
        """Gaussian blur of the optics in px, from 0.05 to 60."""
        return math.exp(self.parameters[BLUR])

    @property
    def width(self) -> float:
        """Standard deviation of the line spread function in px."""
        return math.sqrt(self.sigma**2 + 1 / 12)  # with the variance of a pixel aperture

    @property
    def contrast(self) -> float:
        """Bright minus dark in the middle of the ROI."""
        return float(self.parameters[BRIGHT] - self.parameters[DARK])

    @property
    def slope(self) -> float:
        """Columns per row in the middle of the edge."""
        return float(self.parameters[1]) * 2 / (len(self.roi) - 1)

    @property
    def pixel(self) -> float:
        """Width of a pixel along the normal in px; its smaller width along the edge is a part of the blur."""
        return 1 / math.hypot(1.0, self.slope)

    @property
    def angle(self) -> float:
        """Degrees between the edge and the nearest image axis in the middle of the edge, positive clockwise."""
        turn = math.degrees(math.atan(self.slope))
        return turn if self.mirrored == self.near_vertical else -turn

    def across(self) -> Array:
        """Regressors (N, 3) of the brightness of a side: 1, and the place of the pixel across and along the edge."""
        row, column = np.meshgrid(*(np.linspace(-1.0, 1.0, count) for count in self.roi.shape), indexing="ij")
        return np.stack([np.ones(row.size), column.ravel(), row.ravel()], axis=1)

    def distance(self) -> tuple[Array, Array]:
        """Distance (N,) of every pixel along the normal in px, and its derivatives (N, 4) by the line."""
        half_height, half_width = (0.5 * (count - 1) for count in self.roi.shape)
        (_, column, row), powers = self.across().T, np.arange(4)
        values = row[:, None] ** powers
        slopes = powers * row[:, None] ** np.maximum(powers - 1, 0) / half_height
        line = self.parameters[:BLUR]
        slope, aside = slopes @ line, column * half_width - values @ line
        cosine = 1 / np.hypot(1, slope)
        return aside * cosine, -values * cosine[:, None] - slopes * (aside * slope * cosine**3)[:, None]

    def contrasts(self) -> Array:
        """Bright minus dark (N,) at every pixel."""
        dark, bright = self.parameters[DARK:].reshape(2, 3) @ self.across().T
        return bright - dark

    def moved(self, parameters: Array) -> "Edge":
        """The same ROI with an edge of other parameters."""
        return replace(self, parameters=parameters)

    def linearised(self, departure: Array | float = 0.0) -> tuple[Array, Array]:
        """Model value (N,) with Gaussian optics, and derivatives (N, 11) by the parameters.

        The line spread function of the pixels (N,) that is the derivative by the line may have a ``departure``.
        """
        distance, by_line = self.distance()
        esf, lsf, by_sigma = gaussian_edge(distance, self.sigma, self.pixel)
        across = self.across()
        dark, bright = self.parameters[DARK:].reshape(2, 3) @ across.T
        contrast = bright - dark
        line = (contrast * (lsf + departure))[:, None] * by_line
        blur = contrast * by_sigma * self.sigma
        jacobian = np.column_stack([line, blur, (1 - esf)[:, None] * across, esf[:, None] * across])
        return dark + contrast * esf, jacobian


# --- Fit ---


def fit_edge(roi: Array) -> Edge:
    """Least-squares fit of edge, Gaussian blur and sides to all pixels of a ROI (h, w)."""
    # 1. Turn the ROI.
    soft = _means(roi)
    near_vertical = bool(np.square(np.diff(soft, axis=1)).mean() >= np.square(np.diff(soft, axis=0)).mean())
    roi = roi if near_vertical else roi.T
    quarter = roi.shape[1] // 4 + 1
    mirrored = bool(roi[:, :quarter].mean() > roi[:, -quarter:].mean())
    roi = np.ascontiguousarray(roi[:, ::-1] if mirrored else roi)
    # 2. Start from the sum of every row, which is robust to noise.
    height, width = roi.shape
    few = max(2, width // 12)
    low, high = roi[:, :few].mean(), roi[:, -few:].mean()
    least = 1e-3  # of the range of the values; otherwise the start is not finite
    if high - low < least * np.ptp(roi):
        raise ValueError("no edge: both sides of the roi are equally bright; choose a part with a single edge")
    place = ((high - roi) / (high - low)).mean(1) * width - 0.5 * width  # columns of each row
    line = np.polynomial.polynomial.polyfit(np.linspace(-1.0, 1.0, height), place, 1)
    start = Edge(roi, near_vertical, mirrored, np.array([*line, 0, 0, math.log(1.5), low, 0, 0, high, 0, 0]))
    # 3. Fit all parameters.
    limits = np.full((2, PARAMETERS), [[-np.inf], [np.inf]])
    limits[:, BLUR] = _BLUR_LIMITS
    solution = least_squares(
        lambda parameters: start.moved(parameters).linearised()[0] - roi.ravel(),
        start.parameters,
        lambda parameters: start.moved(parameters).linearised()[1],
        bounds=tuple(limits),
        x_scale="jac",
        **dict.fromkeys(("ftol", "xtol", "gtol"), 1e-12),
        max_nfev=100,
    )
    return start.moved(solution.x)


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


def check_edge(edge: Edge, limits: tuple[float, float]) -> float:
    """Raise if the ROI does not contain one measurable slanted edge, of values within ``limits``.

    The result is the smallest distance in px between the edge and a border of the turned ROI beside it.
    """
    distance, contrast = edge.distance()[0].reshape(edge.roi.shape), edge.contrast
    residual = edge.roi - edge.linearised()[0].reshape(edge.roi.shape)
    explained = 1 - residual.var() / edge.roi.var()
    if not explained >= 0.5 or not contrast > 0:
        raise ValueError(
            f"roi shows no edge: a straight edge explains {100 * max(explained, 0.0):.0f} % of the variance, "
            "expected at least 50 %"
        )
    angle = abs(edge.angle)
    if not 2.0 <= angle <= 40.0:
        problem = "not slanted enough" if angle < 2.0 else "too close to 45 degrees"
        raise ValueError(f"the edge is {problem}: {angle:.2f} degrees from the nearest image axis, expected 2 ... 40")
    crossed = abs(edge.slope) * len(edge.roi)
    if crossed < 1:
        raise ValueError(
            f"the edge crosses {crossed:.2f} px over {len(edge.roi)} px of length, expected at least 1: "
            "use a longer roi or a larger angle"
        )
    room = float(min(-distance[:, 0].max(), distance[:, -1].min()))
    needed = max(4.0, 3.0 * edge.width)
    if room < needed:
        raise ValueError(
            f"the edge comes within {max(room, 0.0):.1f} px of the border of the roi, expected at least {needed:.1f} px"
        )
    far = np.abs(distance) > 4 * edge.width
    _check_clipping(edge.roi[(distance < 0) & far], edge.roi[(distance > 0) & far], contrast, limits)
    # patches of 5 x 5 px of the sides, and the standard deviation of their mean residual due to noise
    patches = np.abs(_means(np.where(np.abs(distance) > 4 * edge.width + 2, residual, 0.0)))
    noise = np.median(np.abs(np.diff(residual, axis=1))) / 0.954 / 5  # 0.954: median of |a - b| of normal numbers
    worst = patches.max()
    if worst > 0.1 * contrast + 6 * noise:
        row, column = np.unravel_index(patches.argmax(), patches.shape)
        raise ValueError(
            f"roi shows more than one edge: {100 * worst / contrast:.0f} % of its contrast near "
            f"{row + 2} px along and {column + 2} px across the edge, expected even sides"
        )
    return room


def _check_clipping(dark: Array, bright: Array, contrast: float, limits: tuple[float, float]) -> None:
    """Raise if a tenth of the pixels of a side have one extreme value although noise would exceed it."""
    if not len(dark) or not len(bright):
        return
    ends, sides = (dark.min(), bright.max()), (dark, bright)
    shares = [(side == end).mean() for side, end in zip(sides, ends, strict=True)]
    least_noise = 1e-3 * contrast
    at_limits = (ends[0] <= limits[0], ends[1] >= limits[1])
    for index, name in enumerate(("dark", "bright")):
        has_noise = np.sqrt(np.square(sides[index] - ends[index]).mean()) > least_noise
        only_this = shares[1 - index] < 0.1 * shares[index] and sides[1 - index].std() > least_noise
        is_black = index == 0 and at_limits[0]  # without light there is no noise
        if shares[index] >= 0.1 and ((at_limits[index] and has_noise) or (only_this and not is_black)):
            raise ValueError(
                f"the {name} side of the edge is clipped: {100 * shares[index]:.0f} % of its pixels are exactly "
                f"{ends[index]:g}"
            )
