"""Scene prior estimated from the frames themselves."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rsvib_torch.core.chunking import runs
from rsvib_torch.core.fourier import extend_rows, squared_modulus, waves
from rsvib_torch.core.splines import mirrored
from rsvib_torch.imaging.trajectory import exposure_trajectory
from rsvib_torch.restoration.frame_motion import FrameMotion
from rsvib_torch.restoration.scene_model.row_kernel import interpolation_error, kernel_spectrum

__all__ = ["ORDER", "RowPrior", "autoregressive_prior", "brightness", "fit_prior"]

ORDER = 2  # rows that a row is predicted from
_PIECE = (64, 256)  # rows and columns of the pieces whose spectra are averaged
_MOST_PIECES = 128  # of a frame
_AT_A_TIME = {"cpu": 4}  # rows of pieces: they stay in the cache
_EVERY = 8  # rows of which one tells how bright a frame is
_STRIPS = 4  # of whole rows that say what their ends add to the spectrum
_BEYOND = 25.0  # times what pieces show: as much power of whole rows is that of their ends, and not chance
_SMOOTHING = 3  # neighbouring frequencies whose statistics are pooled
_ITERATIONS = 20
_FAINT, _LEAST = 0.5, 0.002  # of the noise: below, neighbours are pooled to start from; what is always started from
_ROUNDING = 1e-14  # of the squared modulus of a filter, a sum of terms around 1
# noise power over variance of e: above, the systems lose digits and nothing is gained; below, rows half a pixel apart
# from the scene's lose them in single precision. Long exposures see every place of the scene from many of its rows,
# and may go as much lower as the blur is longer than a px.
_STRONGEST, _WEAKEST = 1e3, 1e-4


@dataclass(frozen=True, eq=False)
class RowPrior:
    """For each horizontal frequency, how the coefficients of a scene row follow from those of the rows before it.

    ``c(s) = - a_1 c(s - 1) - ... - a_p c(s - p) + e(s)`` with white ``e``: a stationary autoregressive model, whose
    precision matrix is banded.

    Attributes:
        power: (U,) variance of a coefficient.
        reflections: (p, U) partial correlations, within -1 ... 1.
        blind: (U,) power of what the kernel between rows cannot follow, which counts as noise; (T, U) of each frame.
    """

    power: Tensor
    reflections: Tensor
    blind: Tensor

    @classmethod
    def smooth(cls, u: Tensor) -> "RowPrior":
        """Neighbouring rows are alike at all frequencies (U,), and the innovation has variance 1."""
        reflections = torch.stack([torch.full_like(u, 0.9), torch.zeros_like(u)])
        return cls(1 / (1 - reflections[0].square()), reflections, torch.zeros_like(u))

    def of(self, members: list[int]) -> "RowPrior":
        """The prior for restoring a scene from some of the frames: each is blind to what its own blur leaves."""
        return replace(self, blind=self.blind[members].mean(0))

    def filter(self) -> Tensor:
        """Coefficients 1, a_1 ... a_p of the filter that whitens, (p + 1, U)."""
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
        parts = [self.power.log()[None], self.reflections, torch.atleast_2d(self.blind).log()]
        stacked = torch.nn.functional.interpolate(torch.cat(parts)[None], count, mode="linear", align_corners=True)[0]
        power, reflections, blind = stacked.split([len(part) for part in parts])
        return RowPrior(power[0].exp(), reflections, blind.exp().reshape(*self.blind.shape[:-1], count))

    def precision(self, noise_power: Tensor, strength: float, reach: float = 0.0) -> Tensor:
        """Products ``a_k a_(k + d)`` of the filter in units of the data's noise, (p + 1, p + 1, U), 0 for k + d > p.

        The precision of interior rows d apart is the sum over k; the first and the last rows are predicted from
        fewer, and of row j only the first j + 1 products count.

        Args:
            noise_power: Power of the noise of data of weight 1.
            strength: Factor on the precision.
            reach: Distance in px along the rows that the scene moves in half an exposure.
        """
        a = self.filter()
        ratio = (noise_power + self.blind) * strength / self.innovation()
        ratio = ratio.clamp(_WEAKEST / (1 + reach), _STRONGEST)
        count = len(a)
        products = a.new_zeros(count, count, a.shape[1])
        for d in range(count):
            products[d, : count - d] = a[: count - d] * a[d:] * ratio
        return products


def _levinson(moments: Sequence[Tensor]) -> tuple[list[Tensor], list[Tensor], Tensor]:
    """Autoregressive model of p + 1 autocovariances (U,): partial correlations, filter and innovation's variance."""
    variance = moments[0].clamp(min=torch.finfo(moments[0].dtype).tiny)
    filter_, reflections = [torch.ones_like(variance)], []
    for lag in range(1, len(moments)):
        left = moments[lag]
        for k in range(1, lag):
            left = torch.addcmul(left, filter_[k], moments[lag - k])
        reflection = (left / variance).clamp(-0.9995, 0.9995)
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
    """Matrix (U, U) that pools what is known at frequencies (U,) over neighbouring ones, mirrored at both ends."""
    half = _SMOOTHING // 2
    kernel = torch.hann_window(_SMOOTHING + 2, periodic=False, dtype=u.dtype, device=u.device)[1:-1]
    near = torch.arange(len(u), device=u.device)[:, None] + torch.arange(-half, half + 1, device=u.device)
    taps = (kernel / kernel.sum()).expand(len(u), -1)
    return torch.zeros_like(u).expand(len(u), -1).scatter_add(1, mirrored(near, len(u)), taps)


def autoregressive_prior(
    observed: Tensor, transfer: Tensor, aliases: Tensor, noise_power: Tensor, order: int = ORDER
) -> RowPrior:
    """Fit the prior to the power spectrum of blurred, noisy frames by expectation maximisation.

    Each step adds what the blurred spectrum says about the scene's and what the noise leaves open, and fits the
    autoregressive model to the sum (Yule-Walker).

    Args:
        observed: (U, V) power of the frames, horizontal frequencies by vertical ones.
        transfer: (U, V) power that the blur lets through.
        aliases: (T, U, V) power of what the kernel between rows cannot follow, through the blur of each frame, of a
            wave of power 1.
        noise_power: Power of the noise in each value, shape (U, V) or ().
        order: Rows that a row is predicted from.

    Returns:
        The prior.
    """
    v = torch.fft.fftfreq(observed.shape[-1], dtype=observed.dtype, device=observed.device)
    lags = torch.arange(order + 1, dtype=observed.dtype, device=observed.device)
    angles = 2 * torch.pi * v[:, None] * lags
    cosine = torch.cos(angles)
    both = torch.where(lags > 0, 2 * cosine, cosine).T  # of the products a_k a_(k + d) of a filter

    def dot(first: Sequence[Tensor], second: Sequence[Tensor]) -> Tensor:
        total = first[0] * second[0]
        for one, other in zip(first[1:], second[1:], strict=True):
            total = torch.addcmul(total, one, other)
        return total

    through, pooling = transfer * observed, _pooling(observed[:, 0]) / len(v)
    excess = observed - noise_power
    # where noise outweighs the scene, steps are small, and should not have to begin from what chance has left over
    level = _FAINT * noise_power
    excess = torch.where(excess < level, _pooled(excess).minimum(level), excess)
    scene = torch.maximum(excess, _LEAST * noise_power) * transfer / (transfer.square() + 1e-2)
    for _ in range(_ITERATIONS):
        moments = (pooling @ (scene @ cosine)).unbind(-1)
        reflections, filter_, innovation = _levinson(moments)
        products = torch.stack([dot(filter_[: order + 1 - d], filter_[d:]) for d in range(order + 1)], -1)
        against = (products @ both).clamp(min=_ROUNDING) * (noise_power / innovation[:, None])  # of the noise
        gain = (against + transfer).reciprocal()
        scene = torch.addcmul(gain * noise_power, gain.square(), through)
    tiny = torch.finfo(scene.dtype).tiny
    return RowPrior(moments[0].clamp(min=tiny), torch.stack(reflections), (scene * aliases).mean(-1).clamp(min=tiny))


def brightness(frames: Tensor) -> Tensor:
    """About the mean of each image (..., H, W): some rows tell it well enough to be taken off."""
    return frames[..., ::_EVERY, :].mean((-2, -1))


def fit_prior(frames: Tensor, motion: FrameMotion, stack: int, levels: Tensor, length: int) -> RowPrior:
    """Fit the prior to the frames of a stack.

    Rows are moved back by their displacement, so that neighbours correlate as in the scene; spectra of pieces are
    averaged, each weighted by what its blur lets through and by the noise of its frame.

    Args:
        frames: (T, C, H, W) in row order.
        motion: Motion of the batch of stacks.
        stack: Index of the stack in the batch.
        levels: (T,) standard deviation of the noise of each frame.
        length: Length of the Fourier transform along rows.

    Returns:
        The prior for transforms of that length.
    """
    size = [min(piece, whole) for piece, whole in zip(_PIECE, frames.shape[-2:], strict=True)]
    starts = _spread_pieces(frames.shape[-2:], size)  # rows, columns
    tops, lefts = (begin.tolist() for begin in starts)
    rows = (starts[0][:, None] + torch.arange(size[0])).to(frames.device)
    tapers = [
        torch.hann_window(extent + 2, periodic=False, dtype=frames.dtype, device=frames.device)[1:-1] for extent in size
    ]
    tapers = [taper / taper.square().sum().sqrt() for taper in tapers]
    u = torch.fft.rfftfreq(size[1], dtype=torch.float64, device=frames.device)
    v = torch.fft.fftfreq(size[0], dtype=torch.float64, device=frames.device)

    vibration = motion.vibration[stack]
    times = motion.frame_starts[:, None] + rows.flatten() * motion.timing.row_time
    mean = vibration.mean_displacement(times, motion.timing.exposure_time)[..., 0]
    back = waves(mean, -u).to(frames.dtype.to_complex()).unflatten(1, rows.shape)  # (T, pieces, rows, U)
    back = back * tapers[0][:, None]
    bright = brightness(frames)[..., None, None, None]
    step = _AT_A_TIME.get(frames.device.type, len(tops))
    found = []
    for chosen in runs(len(tops), step):
        strips = [frames[..., top : top + size[0], :] for top in tops[chosen]]
        pieces = torch.stack([strip[..., left : left + size[1]] for strip in strips for left in lefts], dim=2)
        pieces = pieces.unflatten(2, (-1, len(lefts)))  # (T, C, n, n, rows, columns)
        spectra = torch.fft.rfft(pieces.sub_(bright[..., None]).mul_(tapers[1])).mul_(back[:, None, chosen, None])
        found.append(squared_modulus(torch.fft.fft(spectra, dim=-2)).mean((1, 3)).transpose(-2, -1))
    power = torch.cat(found, dim=1).to(torch.float64) * length  # (T, pieces, U, V)
    few = torch.linspace(0, len(tops) - 1, min(_STRIPS, len(tops)), device=rows.device).round().to(torch.int64)
    strips_of_rows = (frames[..., rows[few], :] - bright) * tapers[0][:, None]  # (T, C, n, rows, W)
    whole = _power_of_rows(strips_of_rows, length, len(u))

    displacement, weights = exposure_trajectory(
        vibration, times.unflatten(1, rows.shape)[..., size[0] // 2], motion.timing, "gauss"
    )
    along = waves(displacement[..., 0], u) * weights[:, None]
    across = waves(displacement[..., 1], v)
    transfer = squared_modulus(along.transpose(-2, -1) @ across) * kernel_spectrum(v).square()
    transfer = _smeared(transfer)
    aliases = torch.zeros_like(transfer[:, 0])
    for cycle in (-1, 1):  # all others together are less than 4 % of these
        beyond = across * waves(displacement[..., 1], v.new_tensor([cycle]))
        blurred = squared_modulus(along.transpose(-2, -1) @ beyond).mean(1)
        aliases = aliases + blurred * interpolation_error(v, [cycle])
    weight = transfer / levels.to(torch.float64).square()[:, None, None, None]
    total = weight.sum((0, 1)).clamp(min=torch.finfo(torch.float32).tiny)
    observed = torch.maximum((weight * power).sum((0, 1)) / total, whole / _BEYOND)
    noise_power = transfer.sum((0, 1)) / total * length
    passed = (weight * transfer).sum((0, 1)) / total
    prior = autoregressive_prior(observed, passed, aliases, noise_power)
    return prior.resampled(length // 2 + 1)


def _smeared(transfer: Tensor) -> Tensor:
    """Transfer (..., U, V) as pieces show it, whose taper mixes neighbouring frequencies: nowhere quite zero."""
    count = transfer.shape[-2]
    near = torch.arange(-1, count + 1, device=transfer.device)
    wide = transfer[..., mirrored(near, count), :]
    between = wide[..., :-2, :] + wide[..., 2:, :]
    return (2.0 / 3.0) * transfer + (1.0 / 6.0) * between


def _power_of_rows(strips: Tensor, length: int, count: int) -> Tensor:
    """Power (U, V) of whole rows with what they go on by beyond their ends, pooled to U frequencies along them.

    What ends add lies at low frequencies, where a displacement hardly turns phases: rows are left where they are.

    Args:
        strips: (T, C, n, R, W), tapered across their rows.
        length: Period of the rows.
        count: U.
    """
    power = squared_modulus(torch.fft.fft(torch.fft.rfft(extend_rows(strips, length)), dim=-2))
    return torch.nn.functional.adaptive_avg_pool1d(power.mean((0, 1, 2)), count).T.to(torch.float64)


def _spread_pieces(shape: torch.Size, size: list[int]) -> list[Tensor]:
    """First rows and first columns of pieces spread evenly over the frame, overlapping by half if they are few."""
    counts = [-(-2 * (whole - extent) // extent) + 1 for whole, extent in zip(shape, size, strict=True)]
    excess = max(1.0, math.sqrt(counts[0] * counts[1] / _MOST_PIECES))
    counts = [max(1, round(count / excess)) for count in counts]
    return [
        torch.linspace(0, whole - extent, count).round().to(torch.int64)
        for whole, extent, count in zip(shape, size, counts, strict=True)
    ]
