"""Edge spread function of any shape: Gaussian optics and square pixels plus a random departure.

The departure from the Gaussian model is a smooth random function of the distance from the edge: a cubic B-spline with
Gaussian-process priors, and a tail beyond the ROI, as light scattered that far reduces the contrast within the ROI. Its
strength, smoothness and reach are averaged over priors weighted by their restricted likelihood, so that it shrinks to
zero where the pixels agree with the Gaussian model.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import block_diag
from scipy.sparse import csr_array, diags_array

from rsvib_torch.evaluation.edge_fit import BLUR, BRIGHT, DARK, PARAMETERS, SLOPES, EdgeFit, gaussian_edge
from rsvib_torch.numerics.tables import Array

# Coefficients of the departure follow the parameters of ``EdgeFit``: first that of the tail, then those of the splines.
_TAIL = PARAMETERS
# standard deviations of the sides' slopes over the contrast, per half ROI: none, or some. Without the first, errors of
# the MTF behind diffraction are 1.8 times as large (12 edges with even sides)
_SHADINGS = (1e-12, 0.1)
_STRENGTHS = np.array([0.0, *(10.0 ** (0.5 * k) for k in range(-10, 0))])  # of the departure over the contrast


# --- Departure from the Gaussian model and its priors ---


@dataclass(frozen=True)
class Tail:
    """Part of an edge spread function that decays as slowly as diffraction: ``-x w / (x^2 + w^2)``.

    Its Fourier transform has a closed form, so that it need not be sampled to infinity.
    """

    width: float  # w in px

    def esf(self, distance: Array) -> Array:
        """Value at distances in px from the edge."""
        return -distance * self.width / (distance**2 + self.width**2)

    def lsf(self, distance: Array) -> Array:
        """Derivative of the value, per px."""
        return (distance**2 - self.width**2) * self.width / (distance**2 + self.width**2) ** 2

    def transfer(self, position: Array, lsf: Array, far: Array, frequency: Array) -> Array:
        """Complex transfer (..., F) of line spread functions (..., N) at evenly spaced positions, 1 at frequency 0.

        The functions contain the tail times ``far`` (...); positions are in px, frequencies (F,) in cycles/px.
        """
        ramps = np.exp(-2j * math.pi * frequency[:, None] * position)
        sampled, step = self.lsf(position), position[1] - position[0]
        whole = -2 * (math.pi * self.width) * math.pi * frequency * np.exp(-2 * math.pi * self.width * frequency)
        missing = whole / step - ramps @ sampled
        total = lsf.sum(-1) - far * sampled.sum()
        return (lsf @ ramps.T + np.multiply.outer(far, missing)) / total[..., None]


@dataclass(frozen=True)
class Departure:
    """Tail and cubic B-splines, evenly spaced in ``u = stretch asinh(distance / stretch)``."""

    half: int  # splines on either side of the one in the middle
    step: float  # between them in u
    stretch: float  # px
    tail: Tail  # beyond them

    @classmethod
    def within(cls, room: float, width: float) -> "Departure":
        """For an edge with ``room`` px on either side and a line spread function of standard deviation ``width``."""
        stretch = 10.0 * max(1.0, width)
        reach = stretch * math.asinh(room / stretch)
        step = max(0.25, 2 * reach / 220)  # px at the edge; at most 220 splines
        return cls(max(int(reach / step) - 2, 2), step, stretch, Tail(2.0 * max(1.0, width)))

    @property
    def place(self) -> Array:
        """(K,) values of u in the middle of the splines."""
        return self.step * np.arange(-self.half, self.half + 1)

    @property
    def distance(self) -> Array:
        """(K,) px from the edge to the middle of each spline."""
        return self.stretch * np.sinh(self.place / self.stretch)

    def splines(self, distance: Array) -> tuple[csr_array, csr_array]:
        """Values and derivatives per px of the splines at distances (N,), (N, K)."""
        u = self.stretch * np.arcsinh(distance / self.stretch)
        # even knots far enough for all distances; the spline in the middle of 2 m + 1 knots is number m - 2
        most = max(math.ceil(np.abs(u).max() / self.step) + 4, self.half + 2)
        knots = self.step * np.arange(-most, most + 1)
        used = slice(most - 2 - self.half, most - 1 + self.half)
        values, quadratic = (csr_array(BSpline.design_matrix(u, knots, degree)) for degree in (3, 2))
        density = diags_array(1 / (np.hypot(1, distance / self.stretch) * self.step))
        return values[:, used], density @ (quadratic[:, :-1] - quadratic[:, 1:])[:, used]

    def prior_roots(self, width: float) -> Array:
        """Square roots (P, 1 + K, 1 + K) of prior covariances of tail and splines, at strength 1 in the middle.

        Lengths are in px for a line spread function of a standard deviation ``width`` of up to 1 px.
        """
        smoothness = (0.4, 0.8, 1.8)  # correlation lengths of the departures
        decay = (1.0, 2.5, 6.0)  # of a quadratic decay of departures; one more prior decays linearly, as the tail
        scale, distance = max(1.0, width), self.distance
        roots = []
        for length in smoothness:
            smooth = np.exp(-0.5 * (np.subtract.outer(self.place, self.place) / (scale * length)) ** 2)
            for reach, power in (*((scale * reach, 2) for reach in decay), (self.tail.width, 1)):
                fade = (1 + (distance / reach) ** 2) ** (-0.5 * power)
                prior = smooth * np.outer(fade, fade) + 1e-9 * np.eye(len(distance))
                # only the slowest decay has a tail beyond the ROI
                roots.append(block_diag(1.0 if power == 1 else 1e-6, np.linalg.cholesky(prior)))
        return np.stack(roots)


# --- Posterior ---


@dataclass(frozen=True)
class _Posterior:
    """Parameters of edge and sides, tail and splines for every prior of at least 0.1 % of the best weight."""

    weights: Array  # (A,) of the priors
    parameters: Array  # (A, 11 + 1 + K) under each of them
    roots: Array  # (A, 11 + 1 + K, S) square roots of their covariances
    used: Array  # (P,) priors of the departure with weight

    @property
    def mean(self) -> Array:
        """Parameters (11 + 1 + K) over all priors."""
        return self.weights @ self.parameters


def _normal_equations(dense: Array, sparse: csr_array, residual: Array) -> tuple[Array, Array]:
    """Normal equations of ``residual = [dense, sparse] @ parameters``: matrix, right side."""
    mixed = sparse.T @ dense
    matrix = np.block([[dense.T @ dense, mixed.T], [mixed, (sparse.T @ sparse).toarray()]])
    return matrix, np.concatenate([dense.T @ residual, sparse.T @ residual])


def _transposed(matrices: Array) -> Array:
    return matrices.swapaxes(-1, -2)


def _posterior(matrix: Array, right: Array, roots: Array, contrast: float) -> _Posterior:
    """Average over priors, each weighted by its restricted likelihood, for noise of variance 1.

    ``matrix`` and ``right`` are the normal equations of all parameters, ``roots`` (P, 1 + K, 1 + K) square roots of the
    prior covariances of the departure at strength 1.
    """
    edge, rest = slice(None, PARAMETERS), slice(PARAMETERS, None)
    strength = _STRENGTHS[:, None] ** 2
    shading = np.array(_SHADINGS) * contrast
    # elimination of edge and sides, with the priors of the slopes in the first dimension
    precision = np.repeat(matrix[None, edge, edge], len(shading), 0)
    precision[:, SLOPES, SLOPES] += shading[:, None] ** -2
    size = np.sqrt(np.diagonal(precision, axis1=1, axis2=2))
    size = np.maximum(size, 1e-12 * math.sqrt(np.diag(matrix)[edge].max()))[..., None]
    precision = precision / size / _transposed(size) + 1e-13 * np.eye(PARAMETERS)
    # root of the covariance of edge and sides alone
    free = _transposed(np.linalg.inv(np.linalg.cholesky(precision))) / size
    follow = -free @ (_transposed(free) @ matrix[edge, rest])
    start = free @ (_transposed(free) @ right[edge, None])
    gram = matrix[rest, rest] + matrix[rest, edge] @ follow
    volume = np.log(np.diagonal(free, axis1=1, axis2=2)).sum(1)
    evidence = 0.5 * (right[edge] @ start)[:, 0] + volume - 2 * np.log(shading)
    # modes of tail and splines, which all strengths have in common
    values, vectors = np.linalg.eigh(_transposed(roots) @ gram[:, None] @ roots)
    values, modes = np.maximum(values, 0.0)[:, :, None], roots @ vectors
    projected = _transposed(_transposed(modes) @ (right[rest, None] - matrix[rest, edge] @ start)[:, None])
    shrunk = strength / (1 + strength * values)  # variances (shadings, P, strengths, 1 + K) of the modes
    gain = 0.5 * (shrunk * projected**2 - np.log1p(strength * values)).sum(-1)
    weight = gain + evidence[:, None, None]
    weight = np.exp(weight - weight.max())
    kept = weight > 1e-3
    of, prior, _ = kept.nonzero()
    root = modes[of, prior] * np.sqrt(shrunk[kept])[:, None]
    departure = modes[of, prior] @ (shrunk * projected)[kept][..., None]
    parameters = np.concatenate([start[of] + follow[of] @ departure, departure], axis=1)[..., 0]
    of_edge = np.concatenate([follow[of] @ root, free[of]], axis=-1)
    of_rest = np.pad(root, ((0, 0), (0, 0), (0, PARAMETERS)))
    all_roots = np.concatenate([of_edge, of_rest], axis=-2)
    return _Posterior(weight[kept] / weight[kept].sum(), parameters, all_roots, kept.any((0, 2)))


# --- Fit and result ---


@dataclass(frozen=True)
class Spread:
    """Edge and line spread function with their uncertainty."""

    fit: EdgeFit  # edge, Gaussian blur and sides without the departure
    position: Array  # (N,) px
    esf: Array  # (N,) edge spread function
    lsf: Array  # (N,) its derivative
    tail: Tail  # shape of the tail beyond ``position``
    far: Array  # () amplitude of the tail in ``esf`` and ``lsf``
    alternatives: Array  # (A, N) line spread functions by prior
    alternative_far: Array  # (A,) amplitude of the tail in each
    weights: Array  # (A,) of the alternatives
    basis: Array  # (N, R) derivatives of the line spread function by blur, tail and splines
    roots: Array  # (A, R, S) square roots of the covariance of these parameters, by prior
    noise: float  # standard deviation of the noise of a pixel

    def mtf(self, frequency: Array) -> Array:
        """MTF at frequencies (F,)."""
        return np.abs(self.tail.transfer(self.position, self.lsf, self.far, frequency))

    def std(self, frequency: Array) -> Array:
        """Standard deviation of the MTF at frequencies (F,)."""
        mean = self.tail.transfer(self.position, self.lsf, self.far, frequency)
        mtf, phase = np.abs(mean), np.angle(mean)
        ramps = np.cos(2 * math.pi * frequency[:, None] * self.position + phase[:, None]) / self.lsf.sum()
        within = np.square(ramps @ self.basis @ self.roots).sum(-1)
        others = self.tail.transfer(self.position, self.alternatives, self.alternative_far, frequency)
        between = np.square(np.abs(others) - mtf)
        return np.sqrt(self.weights @ (within + between))


def _quantisation(values: Array) -> float:
    """Standard deviation of rounding to steps; 0 for values that are not on steps.

    Without it, the error of MTF50 of noise-free 8-bit edges is up to 20 standard deviations.
    """
    levels = np.unique(values)
    return 0.0 if len(levels) > len(values) // 4 else np.diff(levels).min() / math.sqrt(12)


def _noise(residual: Array, bright: Array, parameters: int, floor: float) -> Array:
    """Standard deviation of the noise of every pixel: a variance linear in the grey value (shot noise)."""
    freedom = len(residual) / max(len(residual) - parameters, 0.3 * len(residual))
    share = np.stack([1 - bright, bright])
    variances = freedom * (share @ residual**2) / share.sum(1)
    return np.sqrt(np.maximum(variances @ share, floor**2))


def fit_spread(fit: EdgeFit, room: float) -> Spread:
    """Fit the edge spread function without assuming a shape.

    ``room`` is the distance in px from the edge to the nearer of the ROI's borders alongside it.
    """
    scatter, departure = fit.scatter, Departure.within(room, fit.width)
    roots = departure.prior_roots(fit.width)
    tail, splines = 0.0, np.zeros(2 * departure.half + 1)  # mean of the departure
    noise = np.ones_like(scatter.value)
    for count in range(3):
        # 1. Linear model of the pixels around the last estimate.
        model, jacobian = fit.linearised()
        distance, by_line = fit.distance()
        values, slopes = departure.splines(distance)
        dark, bright = fit.sides @ scatter.across.T
        contrast = bright - dark
        steeper = slopes @ splines + departure.tail.lsf(distance) * tail
        jacobian[:, :BLUR] += (contrast * steeper)[:, None] * by_line
        dense = np.column_stack([jacobian, contrast * departure.tail.esf(distance)])
        sparse = diags_array(contrast) @ values
        # the prior of the slopes is centred on 0, not on their last estimate
        residual = scatter.value - model + jacobian[:, SLOPES] @ fit.parameters[SLOPES]
        # 2. Noise, from a fit of all parameters, with slight damping.
        if count == 0:
            matrix, right = _normal_equations(dense, sparse, residual)
            size = np.sqrt(np.diag(matrix))
            size = np.maximum(size, 1e-12 * size.max())
            scaled = matrix / size / size[:, None] + 1e-9 * np.eye(len(size))
            plain = np.linalg.solve(scaled, right / size) / size
            unexplained = residual - dense @ plain[: _TAIL + 1] - sparse @ plain[_TAIL + 1 :]
            floor = max(1e-6 * fit.contrast, _quantisation(scatter.value))
            noise = _noise(unexplained, np.clip((model - dark) / contrast, 0.0, 1.0), len(plain), floor)
        # 3. All parameters by their priors.
        weighted = (dense / noise[:, None], diags_array(1 / noise) @ sparse, residual / noise)
        found = _posterior(*_normal_equations(*weighted), roots, fit.contrast)
        roots = roots[found.used]
        step, tail, splines = found.mean[:_TAIL], found.mean[_TAIL], found.mean[_TAIL + 1 :]
        step[SLOPES] -= fit.parameters[SLOPES]
        before, fit = fit, fit.moved(step)
        if not fit.contrast > 0:  # that of an edge that a vibration has torn apart, for example
            raise ValueError("the pixels do not follow one edge between a dark and a bright side; choose another roi")
    return _sampled(before, found, departure, noise)


def _sampled(fit: EdgeFit, found: _Posterior, departure: Departure, noise: Array) -> Spread:
    """Spread functions on an even grid."""
    span = max(departure.distance[-1] + 3 * departure.step, 8.0 * fit.width)
    samples = 16  # per px
    count = math.ceil(samples * (span + 2.0))
    position = np.arange(-count, count + 1) / samples
    esf, lsf, _ = gaussian_edge(position, fit.sigma, fit.slope)
    # derivatives of both by log sigma, tail and splines
    change = 1e-3
    wider, narrower = (gaussian_edge(position, fit.sigma * math.exp(sign * change), fit.slope) for sign in (1, -1))
    by_tail = departure.tail.esf(position), departure.tail.lsf(position)
    esf_basis, lsf_basis = (
        np.column_stack([(more - less) / (2 * change), tail, splines.toarray()])
        for more, less, tail, splines in zip(wider, narrower, by_tail, departure.splines(position), strict=False)
    )
    shrink = fit.contrast / (fit.contrast + found.mean[BRIGHT] - found.mean[DARK])
    used = [BLUR, *range(_TAIL, len(found.mean))]  # parameters that change the shape
    basis, alternatives = shrink * lsf_basis, found.parameters[:, used]
    return Spread(
        fit,
        position,
        esf + shrink * (esf_basis @ found.mean[used]),
        lsf + basis @ found.mean[used],
        departure.tail,
        np.asarray(shrink * found.mean[_TAIL]),
        lsf + alternatives @ basis.T,
        shrink * found.parameters[:, _TAIL],
        found.weights,
        basis,
        found.roots[:, used],
        math.sqrt(np.square(noise).mean()),
    )
