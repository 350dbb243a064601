"""Gaussian priors of a scene, fitted to the power spectra of pieces of the frames.

``RowPrior``, for scenes on the pixel grid, is an autoregressive model across rows. ``PolynomialPrior``, for scenes on a
grid of half pixels, has a precision that is a polynomial in the Laplacians of both axes.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import pi

import torch
from torch import Tensor

from rsvib_torch.core.chunking import runs
from rsvib_torch.core.fourier import extend_rows, squared_modulus, waves
from rsvib_torch.core.splines import mirrored
from rsvib_torch.imaging.trajectory import exposure_trajectory
from rsvib_torch.restoration.frame_motion import FrameMotion
from rsvib_torch.restoration.scene_model.observation import SCALE, interpolation_error, kernel_spectrum, spline_transfer

__all__ = [
    "ORDER",
    "ObservedSpectrum",
    "PolynomialPrior",
    "RowPrior",
    "autoregressive_prior",
    "brightness",
    "fit_polynomial_prior",
    "fit_prior",
    "observed_spectrum",
    "smeared",
]

ORDER = 2  # rows that a row is predicted from


@dataclass(frozen=True, eq=False)
class RowPrior:
    """Autoregressive model of the coefficients of the scene rows s, one for each horizontal frequency.

    ``c(s) = - a_1 c(s - 1) - ... - a_p c(s - p) + e(s)`` with white ``e``: a stationary process, whose precision
    matrix is banded.

    Attributes:
        power: (U,) variance of a coefficient over the number of columns: that of white noise of variance 1 is 1.
        reflections: (p, U) partial correlations, within -1 ... 1.
        interpolation_power: (U,) power of the interpolation error between rows, which counts as noise; (T, U) of each
            frame.
    """

    power: Tensor
    reflections: Tensor
    interpolation_power: Tensor

    @classmethod
    def smooth(cls, u: Tensor) -> "RowPrior":
        """Correlation 0.9 of neighbouring rows at all frequencies (U,), and innovations of variance 1."""
        reflections = torch.stack([torch.full_like(u, 0.9), torch.zeros_like(u)])
        return cls(1 / (1 - reflections[0].square()), reflections, torch.zeros_like(u))

    def of(self, members: list[int]) -> "RowPrior":
        """The prior for restoring a scene from some of the frames; the interpolation error depends on their blur."""
        return replace(self, interpolation_power=self.interpolation_power[members].mean(0))

    def filter(self) -> Tensor:
        """Coefficients 1, a_1 ... a_p of the whitening filter, (p + 1, U)."""
        filter_ = torch.ones_like(self.power)[None]
        for reflection in self.reflections:
            padded = torch.cat([filter_, torch.zeros_like(filter_[:1])])
            filter_ = padded - reflection * padded.flip(0)
        return filter_

    def innovation(self) -> Tensor:
        """Variance (U,) of e."""
        return self.power * (1 - self.reflections.square()).prod(0)

    def resampled(self, count: int) -> "RowPrior":
        """The prior at ``count`` frequencies spread over the same range."""
        parts = [self.power.log()[None], self.reflections, torch.atleast_2d(self.interpolation_power).log()]
        stacked = torch.nn.functional.interpolate(torch.cat(parts)[None], count, mode="linear", align_corners=True)[0]
        power, reflections, interpolation = stacked.split([len(part) for part in parts])
        return RowPrior(
            power[0].exp(), reflections, interpolation.exp().reshape(*self.interpolation_power.shape[:-1], count)
        )

    def precision(self, noise_power: Tensor, *, strength: float = 1.0, blur_reach: float = 0.0) -> Tensor:
        """Products ``a_k a_(k + d)`` of the filter in units of the data's noise, (p + 1, p + 1, U), 0 for k + d > p.

        The precision of interior rows at distance d is the sum over k. The first and the last rows are predicted from
        fewer rows: for row j it is the sum of the first j + 1 products.

        Args:
            noise_power: Variance of the noise of data of weight 1, () or (U,).
            strength: Factor on the precision.
            blur_reach: Of ``RowKernels``.
        """
        a = self.filter()
        ratio = (noise_power + self.interpolation_power) * strength / self.innovation()
        # noise power over variance of e. Above 1e3, the systems lose digits in single precision without a gain; below
        # 1e-4, rows displaced by half a pixel lose them. Long exposures observe every place from many rows, and allow
        # a bound lower by the length of the blur in px.
        ratio = ratio.clamp(1e-4 / (1 + blur_reach), 1e3)
        count = len(a)
        products = a.new_zeros(count, count, a.shape[1])
        for d in range(count):
            products[d, : count - d] = a[: count - d] * a[d:] * ratio
        return products


def _levinson(moments: Sequence[Tensor]) -> tuple[list[Tensor], list[Tensor], Tensor]:
    """Levinson recursion for p + 1 autocovariances (U,): partial correlations, filter, variance of the innovation."""
    variance = moments[0].clamp(min=torch.finfo(moments[0].dtype).tiny)
    filter_, reflections = [torch.ones_like(variance)], []
    for lag in range(1, len(moments)):
        error = moments[lag]
        for k in range(1, lag):
            error = torch.addcmul(error, filter_[k], moments[lag - k])
        reflection = (error / variance).clamp(-0.9995, 0.9995)
        inner = [torch.addcmul(filter_[k], reflection, filter_[lag - k], value=-1) for k in range(1, lag)]
        filter_ = [filter_[0], *inner, -reflection]
        variance = torch.addcmul(variance, variance * reflection, reflection, value=-1)
        reflections.append(reflection)
    return reflections, filter_, variance


def _pooled(power: Tensor) -> Tensor:
    """Means over 5 x 5 neighbouring frequencies of (U, V)."""
    u, v = (torch.arange(-2, extent + 2, device=power.device) for extent in power.shape)
    around = power[u.clamp(0, len(power) - 1)][:, v % power.shape[1]]
    return torch.nn.functional.avg_pool2d(around[None, None], 5, 1)[0, 0]


def _pooling(u: Tensor) -> Tensor:
    """Matrix (U, U) of a weighted mean over three neighbouring frequencies (U,), mirrored at both ends."""
    near = torch.arange(len(u), device=u.device)[:, None] + torch.arange(-1, 2, device=u.device)
    taps = u.new_tensor([0.25, 0.5, 0.25]).expand(len(u), -1)
    return torch.zeros_like(u).expand(len(u), -1).scatter_add(1, mirrored(near, len(u)), taps)


def autoregressive_prior(
    observed: Tensor,
    transfer: Tensor,
    aliases: Tensor,
    noise_power: Tensor,
    order: int = ORDER,
    iterations: int = 20,
) -> RowPrior:
    """Fit the prior to the power spectrum of blurred, noisy frames by expectation maximisation.

    Each step computes the expected power spectrum of the scene for the current model, the sum of the squared Wiener
    estimate and of its variance, and fits the autoregressive model to it (Yule-Walker equations).

    Args:
        observed: (U, V) power of the frames, horizontal frequencies by vertical ones.
        transfer: (U, V) squared transfer function of the blur.
        aliases: (T, U, V) power of the interpolation error of the kernel between rows, through the blur of each frame,
            for a wave of power 1.
        noise_power: Power of the noise in each value, shape (U, V) or ().
        order: Rows that a row is predicted from.
        iterations: Steps of expectation maximisation.

    Returns:
        The prior.
    """
    # cosines of the lags of autocovariances, and of the products a_k a_(k + d) of a filter
    v = torch.fft.fftfreq(observed.shape[-1], dtype=observed.dtype, device=observed.device)
    lags = torch.arange(order + 1, dtype=observed.dtype, device=observed.device)
    angles = 2 * torch.pi * v[:, None] * lags
    cosine = torch.cos(angles)
    both = torch.where(lags > 0, 2 * cosine, cosine).T

    def dot(first: Sequence[Tensor], second: Sequence[Tensor]) -> Tensor:
        total = first[0] * second[0]
        for one, other in zip(first[1:], second[1:], strict=True):
            total = torch.addcmul(total, one, other)
        return total

    through, pooling = transfer * observed, _pooling(observed[:, 0]) / len(v)
    excess = observed - noise_power
    # steps are small where the noise is stronger than the scene: below half of the noise power, the initial value is
    # pooled over neighbouring frequencies, as that of a single one depends on chance
    level = 0.5 * noise_power
    excess = torch.where(excess < level, _pooled(excess).minimum(level), excess)
    scene = torch.maximum(excess, 0.002 * noise_power) * transfer / (transfer.square() + 1e-2)
    for _ in range(iterations):
        # the model of the expected spectrum of the scene
        moments = (pooling @ (scene @ cosine)).unbind(-1)
        reflections, filter_, innovation = _levinson(moments)
        products = torch.stack([dot(filter_[: order + 1 - d], filter_[d:]) for d in range(order + 1)], -1)
        # squared modulus of the filter, whose terms are of order 1: at least their rounding error
        penalty = (products @ both).clamp(min=1e-14) * (noise_power / innovation[:, None])
        # the expected spectrum for this model: variance and square of the Wiener estimate
        gain = (penalty + transfer).reciprocal()
        scene = torch.addcmul(gain * noise_power, gain.square(), through)
    tiny = torch.finfo(scene.dtype).tiny
    return RowPrior(moments[0].clamp(min=tiny), torch.stack(reflections), (scene * aliases).mean(-1).clamp(min=tiny))


def brightness(frames: Tensor) -> Tensor:
    """Approximate mean of each image (..., H, W), from every eighth row."""
    return frames[..., ::8, :].mean((-2, -1))


@dataclass(frozen=True, eq=False)
class ObservedSpectrum:
    """Power spectra of pieces of the frames of a stack, whose rows were moved back by their displacement.

    Attributes:
        u: (U,) horizontal frequencies, cycles per px.
        v: (V,) vertical frequencies.
        power: (T, pieces, U, V) power per pixel: white noise of variance 1 has power 1.
        whole: (U, V) of whole rows with their boundary extension.
        displacement: (T, pieces, N, 2) px during the exposure of the middle row of each piece.
        node_weights: (N,).
        levels: (T,) standard deviation of the noise of each frame.
    """

    u: Tensor
    v: Tensor
    power: Tensor
    whole: Tensor
    displacement: Tensor
    node_weights: Tensor
    levels: Tensor

    def blur(self, alias_u: int = 0, alias_v: int = 0) -> Tensor:
        """Squared transfer functions (T, pieces, U, V) of the exposures at ``(u - alias_u, v - alias_v)``."""
        along = waves(self.displacement[..., 0], self.u - alias_u) * self.node_weights[:, None]
        return squared_modulus(along.transpose(-2, -1) @ waves(self.displacement[..., 1], self.v - alias_v))

    def weighted(self, transfer: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Observed power (U, V), weights (T, pieces, U, V) of sum 1, and power (U, V) of the noise.

        Args:
            transfer: Squared transfer function of each piece; pieces with a stronger one and less noise weigh more.
        """
        weight = transfer / self.levels.to(torch.float64).square()[:, None, None, None]
        total = weight.sum((0, 1)).clamp(min=torch.finfo(torch.float32).tiny)
        # power of whole rows above 25 times that of the pieces is due to the boundary extension and not to chance:
        # without it, regular patterns are lost near the ends of the rows
        observed = torch.maximum((weight * self.power).sum((0, 1)) / total, self.whole / 25.0)
        return observed, weight / total, transfer.sum((0, 1)) / total


def observed_spectrum(frames: Tensor, motion: FrameMotion, stack: int, levels: Tensor, length: int) -> ObservedSpectrum:
    """Power spectra of pieces of 64 x 256 px of the frames of a stack.

    Rows are moved back by their displacement, so that neighbours correlate as in the scene.

    Args:
        frames: (T, C, H, W) in row order.
        motion: Motion of the batch of stacks.
        stack: Index of the stack in the batch.
        levels: (T,) standard deviation of the noise of each frame.
        length: Length of the Fourier transform along rows.
    """
    # places of the pieces, their taper and frequencies
    size = [min(piece, whole) for piece, whole in zip((64, 256), frames.shape[-2:], strict=True)]
    starts = _spread_pieces(frames.shape[-2:], size)  # rows, columns
    tops, lefts = (begin.tolist() for begin in starts)
    rows = (starts[0][:, None] + torch.arange(size[0], device="cpu")).to(frames.device)
    tapers = [
        torch.hann_window(extent + 2, periodic=False, dtype=frames.dtype, device=frames.device)[1:-1] for extent in size
    ]
    tapers = [taper / taper.square().sum().sqrt() for taper in tapers]
    u = torch.fft.rfftfreq(size[1], dtype=torch.float64, device=frames.device)
    v = torch.fft.fftfreq(size[0], dtype=torch.float64, device=frames.device)

    # phases that move rows back by their displacement, and the taper across rows
    vibration = motion.vibration[stack]
    times = motion.frame_starts[:, None] + rows.flatten().to(torch.float64) * motion.timing.row_time
    mean = vibration.mean_displacement(times, motion.timing.exposure_time)[..., 0]
    back = waves(mean, -u).to(frames.dtype.to_complex()).unflatten(1, rows.shape)  # (T, pieces, rows, U)
    back = back * tapers[0][:, None]
    # power of the pieces, mean over channels
    bright = brightness(frames)[..., None, None, None]
    step = 4 if frames.device.type == "cpu" else len(tops)  # rows of pieces at a time, which stay in the cache
    powers = []
    for chosen in runs(len(tops), step):
        strips = [frames[..., top : top + size[0], :] for top in tops[chosen]]
        pieces = torch.stack([strip[..., left : left + size[1]] for strip in strips for left in lefts], dim=2)
        pieces = pieces.unflatten(2, (-1, len(lefts)))  # (T, C, n, n, rows, columns)
        spectra = torch.fft.rfft(pieces.sub_(bright[..., None]).mul_(tapers[1])).mul_(back[:, None, chosen, None])
        powers.append(squared_modulus(torch.fft.fft(spectra, dim=-2)).mean((1, 3)).transpose(-2, -1))
    power = torch.cat(powers, dim=1).to(torch.float64)  # (T, pieces, U, V)
    # power of a few strips of whole rows with their boundary extension
    few = torch.linspace(0, len(tops) - 1, min(4, len(tops)), device=rows.device, dtype=torch.float32).round().long()
    strips_of_rows = (frames[..., rows[few], :] - bright) * tapers[0][:, None]  # (T, C, n, rows, W)
    whole = _power_of_rows(strips_of_rows, length, len(u)) / length

    # blur of the middle row of each piece
    displacement, weights = exposure_trajectory(
        vibration, times.unflatten(1, rows.shape)[..., size[0] // 2], motion.timing, "gauss"
    )
    return ObservedSpectrum(u, v, power, whole, displacement, weights, levels)


def fit_prior(frames: Tensor, motion: FrameMotion, stack: int, levels: Tensor, length: int) -> RowPrior:
    """Fit the prior to the frames of a stack: to their ``observed_spectrum``, whose arguments it has.

    Returns:
        The prior for transforms of that length.
    """
    spectrum = observed_spectrum(frames, motion, stack, levels, length)
    v = spectrum.v
    transfer = smeared(spectrum.blur() * kernel_spectrum(v).square())
    aliases = torch.zeros_like(transfer[:, 0])
    for cycle in (-1, 1):  # all others together have less than 4 % of their power
        aliases = aliases + spectrum.blur(alias_v=-cycle).mean(1) * interpolation_error(v, [cycle])
    observed, weight, noise = spectrum.weighted(transfer)
    passed = (weight * transfer).sum((0, 1))
    prior = autoregressive_prior(observed, passed, aliases, noise)
    return prior.resampled(length // 2 + 1)


def smeared(transfer: Tensor) -> Tensor:
    """Transfer function (..., U, V) of tapered pieces: the taper mixes neighbouring frequencies."""
    count = transfer.shape[-2]
    near = torch.arange(-1, count + 1, device=transfer.device)
    wide = transfer[..., mirrored(near, count), :]
    between = wide[..., :-2, :] + wide[..., 2:, :]
    return (2.0 / 3.0) * transfer + (1.0 / 6.0) * between


def _power_of_rows(strips: Tensor, length: int, count: int) -> Tensor:
    """Power (U, V) of whole rows with their boundary extension, pooled to U frequencies along them.

    Rows are not moved back by their displacement: it does not matter at the low frequencies of the extension.

    Args:
        strips: (T, C, n, R, W), tapered across their rows.
        length: Period of the rows.
        count: U.
    """
    power = squared_modulus(torch.fft.fft(torch.fft.rfft(extend_rows(strips, length)), dim=-2))
    return torch.nn.functional.adaptive_avg_pool1d(power.mean((0, 1, 2)), count).T.to(torch.float64)


def _spread_pieces(shape: torch.Size, size: list[int]) -> list[Tensor]:
    """First rows and columns of at most 128 pieces spread evenly over the frame, overlapping by half if possible."""
    counts = [-(-2 * (whole - extent) // extent) + 1 for whole, extent in zip(shape, size, strict=True)]
    excess = max(1.0, math.sqrt(counts[0] * counts[1] / 128))
    counts = [max(1, round(count / excess)) for count in counts]
    return [
        torch.linspace(0, whole - extent, count, dtype=torch.float32, device="cpu").round().to(torch.int64)
        for whole, extent, count in zip(shape, size, counts, strict=True)
    ]


# Degree 6 instead of 4: 0.6 to 1.0 dB for eight frames of scenes with little detail beyond half a cycle per px, -0.4 dB
# for one with much; 8 gains less than 0.2 dB more (drawn scenes of three sharpnesses, noise 0.002).
_DEGREE = 6
_POWERS = [(m, n) for m in range(_DEGREE + 1) for n in range(_DEGREE + 1 - m)]  # of the Laplacians across and along
_MAX_LAPLACIAN = 4.0  # of one axis, at half a cycle per grid point
# Square pixels transmit sin(pi u) / (pi u), 0 at one cycle per px. Along the rows the prior has this factor, at least
# the square root of the first number. Across them, the polynomial has the factor ``1 + 10 (lambda / 4)^4``, which rises
# like the inverse. Frames do not contain it, as the alias of half a cycle per px is below it: without, the spectrum
# near one cycle per px is estimated 100 times too large (sharp optics, noise 0.002, 8 frames: 0.5 to 5 dB).
_LEAST_PIXEL, _RISE, _RISE_POWER = 0.005, 10.0, 4


def _laplacian(frequencies: Tensor) -> Tensor:
    """Discrete Laplacian on the grid, at frequencies in cycles per px."""
    return 2 - 2 * torch.cos(2 * pi / SCALE * frequencies)


def _pixel(u: Tensor) -> Tensor:
    """Squared transfer function of a pixel along the row."""
    return torch.sinc(u).square().clamp(min=_LEAST_PIXEL)


def _rising_powers(device: torch.device) -> Tensor:
    """Coefficients (p + 1, p + 1) of ``lambda^m (1 + 10 (lambda / 4)^4)``; terms of a degree above p have degree p."""
    powers = torch.eye(_DEGREE + 1, dtype=torch.float64, device=device)
    for m in range(_DEGREE + 1):
        high = min(m + _RISE_POWER, _DEGREE)
        powers[m, high] += _RISE * _MAX_LAPLACIAN ** (m - high)
    return powers


@dataclass(frozen=True, eq=False)
class PolynomialPrior:
    """Power spectrum ``sinc(u)^2 b(v)^2 / sum_mn a_mn lambda(v)^m lambda(u)^n`` of the scene, a_mn >= 0.

    lambda is the discrete Laplacian on the grid, sinc the transfer function of a pixel and b that of the cubic
    B-spline: without b it is the spectrum of the coefficients of the scene.

    Attributes:
        coefficients: (p + 1, p + 1) a_mn, in px^-2 over squared units of the frames, float64.
        period: L, period of the rows in px.
    """

    coefficients: Tensor
    period: int

    def of(self, members: list[int]) -> "PolynomialPrior":
        """The prior for restoring a scene from some of the frames."""
        return self

    def precision(self, noise_power: Tensor, *, strength: float = 1.0, blur_reach: float = 0.0) -> Tensor:
        """Factors q_m of ``sum_m q_m(u - a) T^m`` in units of the data's noise, (p + 1, 2, U), float64.

        Args:
            noise_power: Variance of the noise of data of weight 1.
            strength: Factor on the precision.
            blur_reach: Of ``RowKernels``.
        """
        u = torch.fft.rfftfreq(self.period, dtype=torch.float64, device=noise_power.device)
        u = torch.stack([u, u - 1])
        # bounds as for ``RowPrior.precision``: below, the elimination in single precision loses digits. The upper one
        # must not bound the precision at half a cycle per px, where one coefficient of degree 6 has 1/4096 of its
        # largest value: 1e3 lost 1.1 dB in soft scenes; 1e6 and single precision differ from double by -79 dB at most
        m, n = torch.meshgrid(*(torch.arange(_DEGREE + 1, device=u.device),) * 2, indexing="ij")
        a = self.coefficients * (noise_power.to(torch.float64) * strength / SCALE)
        a = a.minimum(1e6 / _MAX_LAPLACIAN ** (m + n))
        a[0, 0] += 1e-5 / (1 + blur_reach)
        powers = _laplacian(u) ** torch.arange(_DEGREE + 1, device=u.device)[:, None, None]
        return torch.einsum("mn,nau->mau", a, powers) / _pixel(u)


@torch.no_grad()
def fit_polynomial_prior(
    frames: Tensor, motion: FrameMotion, stack: int, levels: Tensor, length: int, iterations: int = 60
) -> PolynomialPrior:
    """Fit the prior to the frames of a stack, whose spectrum is blurred and aliased.

    The expected power of a frame at (u, v) is that of the noise plus that of the scene, through the blur of the
    exposure, at (u - a, v - b) for all aliases within 1 cycle per px. Observed powers are distributed like chi-squared
    around it (Whittle likelihood): scoring for the logarithms of a_mn.

    Args:
        frames: (T, C, H, W) in row order.
        motion: Motion of the batch of stacks.
        stack: Index of the stack in the batch.
        levels: (T,) standard deviation of the noise of each frame.
        length: Length of the Fourier transform along rows.
        iterations: Largest number of steps.
    """
    spectrum = observed_spectrum(frames, motion, stack, levels, length)
    u, v = spectrum.u[:, None], spectrum.v
    observed, weight, noise = spectrum.weighted(smeared(spectrum.blur()))
    # transfer function and powers of the Laplacians at each alias
    gains, features = [], []
    rising, order = _rising_powers(frames.device), torch.arange(_DEGREE + 1, device=frames.device)
    for alias_u in (0, 1):
        for alias_v in (-1, 0, 1):
            beyond = (v - alias_v).abs() > 1
            along, across = u - alias_u, (v - alias_v).clamp(-1, 1)
            blur = (weight * smeared(spectrum.blur(alias_u, alias_v))).sum((0, 1)).masked_fill(beyond, 0.0)
            gains.append(blur * _pixel(along) * spline_transfer(across).square())
            rows = _laplacian(across)[:, None] ** order @ rising.T
            features.append(torch.stack([rows[:, m] * _laplacian(along) ** n for m, n in _POWERS], dim=-1))
    gain, feature = torch.stack(gains), torch.stack(features)  # (aliases, U, V), (aliases, U, V, powers)
    # frequencies within the taper of zero contain the mean
    used = (u > 1.5 * (u[1] - u[0])) | (v.abs() > 1.5 / len(v))
    # start from a white spectrum of the mean level
    middle = (observed - noise).clamp(min=0.01 * noise)[used].log().mean().exp()
    logs = torch.full((len(_POWERS),), -float(middle.log()), dtype=torch.float64, device=frames.device)
    for _ in range(iterations):
        # expected power of the frames, and its derivative with respect to the logarithms
        terms = feature * logs.exp()
        polynomial = terms.sum(-1)
        scene = gain / polynomial
        expected = scene.sum(0) + noise
        slope = ((scene / polynomial)[..., None] * terms).sum(0) / -expected[..., None]
        jacobian, residual = slope[used], (observed / expected - 1)[used]
        normal = jacobian.T @ jacobian
        # damped: powers that do not matter for the spectrum have a singular matrix
        normal.diagonal().add_(1e-3 * normal.diagonal().mean())
        step = torch.linalg.solve(normal, jacobian.T @ residual).clamp(-1, 1)
        logs = logs + step
        if bool(step.abs().max() < 1e-2):
            break
    coefficients = torch.zeros(_DEGREE + 1, _DEGREE + 1, dtype=torch.float64, device=frames.device)
    for (m, n), log in zip(_POWERS, logs, strict=True):
        coefficients[m, n] = log.exp()
    return PolynomialPrior(rising.T @ coefficients, length)
