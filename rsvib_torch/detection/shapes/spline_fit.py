"""A motion of any shape as a spline in time: fit to measured rows, with its smoothness and power spectrum estimated.

A penalised spline (P-spline) whose smoothness maximises the marginal likelihood gives a first estimate; then the power
spectrum of the motion is estimated by expectation maximisation, which yields realistic uncertainties of the components
that the differences between frames do not determine.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy import linalg, sparse
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.execution.parallel import runs
from rsvib_torch.numerics.interpolation import gauss_legendre, spline_taps
from rsvib_torch.numerics.tables import Array, table, tensor

_SECOND = (1.0, -2.0, 1.0)  # second difference


@dataclass(frozen=True, eq=False)
class SplineFit:
    """Cubic spline ``sum_n c_n B((t - start) / spacing - n + 1)`` of each axis."""

    coefficients: Array  # (A, N) float64 px, with mean 0
    start: float  # time of the first knot in seconds
    spacing: float  # seconds between knots
    covariances: list[Array]  # (N, N) float64 px^2 of the coefficients of each axis; none while iterating

    @property
    def knots(self) -> Array:
        """(N,) s, times of the coefficients."""
        return self.start + (np.arange(self.coefficients.shape[-1]) - 1.0) * self.spacing

    def std_at(self, times: Array) -> Array:
        """(..., A) px, standard deviations of the motion at times (...) in s."""
        index, weights = spline_taps(times.ravel(), self.start, self.spacing, self.coefficients.shape[-1])
        return np.sqrt(self._variances(index, weights[:, None]))[:, 0].reshape(*times.shape, -1)

    def std_of_visible(self, measured: Measurements) -> tuple[Array, Array]:
        """(A,) px, rms standard deviations of scene rows less their mean over the frames, and of this mean."""
        visible = measured.visible[0]
        in_several = visible.sum(-1) > 1
        visible, times = visible[in_several], measured.exposure_starts[0][in_several] + 0.5 * measured.exposure_time
        first = np.where(visible > 0, times, np.inf).min(1, keepdims=True)
        times, count = np.where(visible > 0, times, first), self.coefficients.shape[-1]
        index, weights = spline_taps(times, self.start, self.spacing, count)
        sums = np.zeros((2, len(self.coefficients)))
        for batch in runs(len(visible), 256):  # (256, G, 4 G, 4 G) at a time
            frames = visible[batch].shape[1]
            frame_weights = np.eye(frames)[:, :, None] * weights[batch, None]  # (n, G, G, 4)
            frame_weights = frame_weights.reshape(-1, frames, 4 * frames)
            share = visible[batch] / visible[batch].sum(1, keepdims=True)
            mean = (share[:, :, None] * frame_weights).sum(1, keepdims=True)
            indices = index[batch].reshape(-1, 4 * frames)
            visible_variances = self._variances(indices, frame_weights - mean) * visible[batch, :, None]
            sums += np.stack([values.sum((0, 1)) for values in (visible_variances, self._variances(indices, mean))])
        return np.sqrt(sums[0] / visible.sum()), np.sqrt(sums[1] / len(visible))

    def _variances(self, index: Array, weights: Array) -> Array:
        """Variances (S, F, A) of sums of ``weights`` (S, F, M) times coefficients ``index`` (S, M)."""
        covariances = [covariance[index[:, :, None], index[:, None]] for covariance in self.covariances]
        return np.maximum(np.stack([((weights @ covariance) * weights).sum(-1) for covariance in covariances], -1), 0.0)


def fit_spline(
    measurements: Measurements, spacing: float, record: tuple[float, float], report_times: Array | None = None
) -> SplineFit:
    """Fit a spline with knots at a spacing in seconds to the measurements of one stack (B = 1), each axis by itself.

    Minimises ``sum w (d - relative(D))^2 + lambda |D''|^2``; lambda maximises the marginal likelihood. Rows are
    compared within groups of frames only, so that the normal matrix is banded. ``record`` is start and end in seconds.
    With ``report_times`` (S,) in s, over which the motion has mean 0, its uncertainty is estimated as well, and for
    splines of up to 800 knots also its power spectrum.
    """
    first, last = record
    count = math.ceil((last - first) / spacing) + 3
    visible, exposure_time, mean = measurements.visible[0], measurements.exposure_time, None
    if report_times is not None:
        index, weights = spline_taps(report_times, first, spacing, count)
        mean = np.bincount(index.ravel(), weights.ravel(), count) / len(report_times)
    coefficients, covariances = [], []
    for axis in range(measurements.displacements.shape[-1]):
        # 1. The coefficients that each displacement depends on, which is a mean over the exposure and a band.
        average = measurements.average_times[min(axis, 1)] + exposure_time
        nodes, shares = (table(values) for values in gauss_legendre(3 + math.ceil(2 * average / spacing)))
        begin = measurements.exposure_starts[0] + 0.5 * (exposure_time - average)
        index, weights = spline_taps(begin[..., None] + average * nodes, first, spacing, count)  # (R, G, Q, 4)
        index, weights = index.reshape(*visible.shape, -1), (shares[:, None] * weights).reshape(*visible.shape, -1)
        # 2. The normal equations.
        row_weights = measurements.inverse_variances[0, :, axis]
        values = measurements.displacements[0, ..., axis] * visible
        weighted, energy = row_weights[:, None] * values, float((row_weights[:, None] * np.square(values)).sum())
        right_side = np.bincount(index.ravel(), (weights * weighted[..., None]).ravel(), count)
        band = _normal_band(index, weights, visible, row_weights, count)
        # 3. Their solution.
        num_measurements = max(float(measurements.num_measurements[0, axis]), 1.0)
        value, covariance = _solved_spline(band, right_side, energy, num_measurements, mean)
        coefficients.append(value - value.mean())
        covariances += [] if covariance is None else [covariance]
    return SplineFit(np.stack(coefficients), first, spacing, covariances)


def _normal_band(index: Array, weights: Array, visible: Array, row_weights: Array, count: int) -> Array:
    """Lower band (D, N) of the normal matrix of N = ``count`` coefficients for values relative to their group.

    The value of a row in a frame depends on the coefficients ``index`` (R, G, M) by the factors ``weights``.
    ``visible`` (R, G) is 1 where a frame contains the row, else 0; ``row_weights`` (R,) are those of the rows.
    """
    number, frames = visible.shape
    value = np.arange(visible.size)
    # 1. Values of the rows in all frames as functions of the coefficients, less their mean over the frames.
    places = (value.repeat(index.shape[-1]), index.ravel())
    values = sparse.csr_array(((weights * visible[..., None]).ravel(), places), shape=(visible.size, count))
    values.eliminate_zeros()
    expand_rows = sparse.csr_array((visible.ravel(), (value, value // frames)), shape=(visible.size, number))
    mean = sparse.diags_array(1 / np.maximum(visible.sum(1), 1.0)) @ (expand_rows.T @ values)
    relative = values - expand_rows @ mean
    # 2. The weighted products of the columns.
    normal = (relative.T @ sparse.diags_array(row_weights.repeat(frames)) @ relative).tocoo()
    below = normal.row >= normal.col
    band = np.zeros((int((normal.row - normal.col).max(initial=0)) + 1, count))
    band[(normal.row - normal.col)[below], normal.col[below]] = normal.data[below]
    return band


def _solved_spline(
    band: Array, right_side: Array, energy: float, num_measurements: float, mean: Array | None
) -> tuple[Array, Array | None]:
    """Coefficients (N,) of a smooth spline, and their covariance (N, N).

    ``energy`` is the weighted sum of the squared displacements, of which ``num_measurements`` are independent.
    ``mean`` (N,) are the weights of the mean of the motion, which has no variance; None for no covariance.
    """
    count = len(right_side)
    rounding = 1e-12 * energy  # error of the sums that make the residual energy
    scale = band[0].mean() + 1e-300
    bend = np.zeros((max(3, len(band)), count))  # of the squared second differences
    for j, factor_j in enumerate(_SECOND):
        for i, factor_i in enumerate(_SECOND[j:]):
            bend[i, j : j + count - 2] += factor_i * factor_j
    base = np.pad(band, [(0, len(bend) - len(band)), (0, 0)])
    base[0, count // 2] += scale  # the mean is undetermined

    def solution(smoothness: float) -> tuple[Array, Array]:
        """Coefficients and banded Cholesky factor of the normal matrix."""
        factor = linalg.cholesky_banded(base + smoothness * scale * bend, lower=True, check_finite=False)
        return linalg.cho_solve_banded((factor, True), right_side, check_finite=False), factor

    def evidence(smoothness: float) -> float:
        """Logarithm of the marginal likelihood."""
        coefficients, factor = solution(smoothness)
        residual = max(energy - float(right_side @ coefficients), rounding) + 1e-300
        logarithm = 2 * float(np.log(factor[0]).sum()) - (count - 2) * math.log(smoothness)
        return -0.5 * (num_measurements * math.log(residual / num_measurements) + logarithm)

    decade = max((10.0**power for power in range(-8, 5)), key=evidence)
    smoothness = max((decade * 10 ** (step / 3) for step in (0, -2, -1, 1, 2)), key=evidence)
    coefficients, _ = solution(smoothness)
    noise = max(energy - float(right_side @ coefficients), rounding) / num_measurements
    if mean is None:
        return coefficients, None
    if count <= 800 and noise > 0:  # the cost grows with knots^3, 20 times
        solved = _fit_with_spectrum(_dense(band), tensor(right_side), noise, smoothness * float(scale))
        coefficients, covariance = map(table, solved)
    else:
        factor = torch.linalg.cholesky(_dense(base + smoothness * scale * bend))
        covariance = noise * table(torch.cholesky_inverse(factor))
    # covariance of c - (mean . c) instead of c
    mean_covariance = covariance @ mean
    return coefficients, covariance - mean_covariance - mean_covariance[:, None] + mean @ mean_covariance


def _dense(band: Array) -> Tensor:
    """The symmetric matrix (N, N) of a lower band (D, N)."""
    lower = sparse.dia_array((band, -np.arange(len(band))), shape=(band.shape[1],) * 2).toarray()
    return tensor(lower + np.tril(lower, -1).T)


def _fit_with_spectrum(normal: Tensor, right_side: Tensor, noise: float, smoothness: float) -> tuple[Tensor, Tensor]:
    """Coefficients (N,) of a spline and their covariance (N, N), with the power of each frequency estimated.

    A motion with a resonance has more power there than the smoothness penalty assumes, and may have more in
    undetermined components of similar frequency. The coefficients are a straight line and cosines, ``c = sum_j a_j
    cos(w_j (n + 1/2))`` with a_j of variance s_j. Expectation maximisation alternates between a for given s, and s_j =
    mean of ``a_j^2 + var(a_j)`` over neighbouring frequencies, relative to the penalty.

    ``normal`` (N, N) and ``right_side`` (N,) are the normal equations, ``noise`` is the variance of measurements of
    unit weight, and ``smoothness`` the weight of squared second differences to start with.
    """
    count = len(right_side)
    margin = max(10, count // 16)  # knots beyond the record, as cosines have zero slope at their ends
    length = count + 2 * margin
    order, place = tensor(np.arange(float(length))), tensor(np.arange(float(count)))
    angle = math.pi / length * order
    waves = torch.cos(angle * (place[:, None] + margin + 0.5)) * math.sqrt(2 / length)
    line = place - place.mean()
    columns = torch.cat([waves, (line / line.norm())[:, None]], 1)
    matrix = columns.mT @ normal @ columns / noise
    target = columns.mT @ right_side / noise
    expected = noise / smoothness * (2 * torch.sin(0.5 * angle[1:])) ** -4
    window = torch.exp(-0.5 * ((order[1:, None] - order[1:]) / 2.0) ** 2)  # standard deviation: one cycle in the record
    window = window / window.sum(1, keepdim=True)
    anchor = (1e-9 * matrix.diagonal().mean()).expand(1)  # makes the undetermined mean 0
    power = expected
    for _ in range(20):
        posterior_precision = matrix + torch.diag(torch.cat([anchor, anchor + 1 / power, anchor]))
        covariance = torch.cholesky_inverse(torch.linalg.cholesky(posterior_precision))
        amplitude = covariance @ target
        second_moment = amplitude[1:-1].square() + covariance.diagonal()[1:-1]
        power = (window @ (second_moment / expected)) * expected
    return columns @ amplitude, columns @ covariance @ columns.mT
