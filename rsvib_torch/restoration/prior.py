"""Scene prior estimated from the frames themselves."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.imaging.trajectory import exposure_trajectory
from rsvib_torch.restoration.motion import FrameMotion

__all__ = ["RowPrior", "autoregressive_prior", "fit_prior"]

_SEGMENT = 64  # rows of the pieces whose spectra are averaged

_SMOOTHING = 9  # neighbouring frequencies whose statistics are pooled
_ITERATIONS = 20
# noise power over variance of e: above, the systems lose digits and nothing is gained; below, rows half a pixel apart
# from the scene's lose them in single precision
_STRONGEST = 1e3
_WEAKEST = 1e-4


@dataclass(frozen=True, eq=False)
class RowPrior:
    """For each horizontal frequency, how a scene row follows from the two rows before it.

    ``f(s) = a_1 f(s - 1) + a_2 f(s - 2) + e(s)`` with white ``e``: a stationary autoregressive model of the scene
    across rows, whose precision matrix is banded.

    Attributes:
        power: (U,) variance of a row.
        correlation: (U,) correlation of neighbouring rows.
        partial: (U,) partial correlation of rows two apart.
    """

    power: Tensor
    correlation: Tensor
    partial: Tensor

    def whitening(self, noise_power: Tensor, frequencies: slice, count: int) -> Tensor:
        """Filter that turns scene rows into white noise of the data's noise power.

        Args:
            noise_power: Power of the noise, shape ().
            frequencies: Which of the U frequencies.
            count: Number of scene rows K.

        Returns:
            (K, 3, U') taps on rows s, s - 1 and s - 2; the first rows follow from fewer.
        """
        power, rho, partial = (part[frequencies] for part in (self.power, self.correlation, self.partial))
        first, second = 1 - rho.square(), 1 - partial.square()
        scales = [
            (noise_power / p).clamp(_WEAKEST, _STRONGEST).sqrt() for p in (power, power * first, power * first * second)
        ]
        one, zero = torch.ones_like(rho), torch.zeros_like(rho)
        rows = [
            torch.stack([one, zero, zero]) * scales[0],
            torch.stack([one, -rho, zero]) * scales[1],
            torch.stack([one, -rho * (1 - partial), -partial]) * scales[2],
        ]
        return torch.cat([rows[0][None], rows[1][None], rows[2].expand(count - 2, *rows[2].shape)])


def _smooth(moments: Tensor) -> Tensor:
    """Pool moments (L, U) over neighbouring frequencies."""
    half = _SMOOTHING // 2
    kernel = torch.hann_window(_SMOOTHING + 2, periodic=False, dtype=moments.dtype, device=moments.device)[1:-1]
    padded = torch.cat([moments[:, 1 : half + 1].flip(-1), moments, moments[:, -half - 1 : -1].flip(-1)], dim=-1)
    pooled: Tensor = torch.nn.functional.conv1d(padded[:, None], (kernel / kernel.sum())[None, None])[:, 0]
    return pooled


def autoregressive_prior(observed: Tensor, transfer: Tensor, noise_power: Tensor) -> RowPrior:
    """Fit the prior to the power spectrum of blurred, noisy frames by expectation maximisation.

    Each step adds what the blurred spectrum says about the scene's and what the noise leaves open, and fits the
    autoregressive model to the sum (Yule-Walker).

    Args:
        observed: (U, V) power of the frames, horizontal frequencies by vertical ones.
        transfer: (U, V) power that the blur lets through.
        noise_power: Power of the noise in each value, shape (U, V) or ().

    Returns:
        The prior.
    """
    v = torch.fft.fftfreq(observed.shape[-1], dtype=observed.dtype, device=observed.device)
    lags = torch.arange(3, dtype=observed.dtype, device=observed.device)
    waves = torch.cos(2 * torch.pi * v[:, None] * lags)
    scene = torch.maximum(observed - noise_power, 0.02 * noise_power) * transfer / (transfer.square() + 1e-2)
    for _ in range(_ITERATIONS):
        moments = _smooth((scene @ waves).T / len(v))
        power = moments[0].clamp(min=torch.finfo(observed.dtype).tiny)
        first = (moments[1] / power).clamp(-0.9995, 0.9995)
        partial = ((moments[2] / power - first.square()) / (1 - first.square())).clamp(-0.99, 0.99)
        prior = RowPrior(power, first, partial)
        whitener = 1 - torch.stack([first * (1 - partial), partial], -1).to(torch.complex128) @ torch.exp(
            -2j * torch.pi * lags[1:, None] * v
        ).to(torch.complex128)
        variance = power * (1 - first.square()) * (1 - partial.square())
        model = (variance[:, None] / whitener.abs().square()).to(observed.dtype)
        gain = model / (transfer * model + noise_power)
        scene = gain * noise_power + gain.square() * transfer * observed
    return prior


@torch.no_grad()
def fit_prior(frames: Tensor, motion: FrameMotion, stack: int, levels: Tensor, length: int) -> RowPrior:
    """Fit the prior to the frames of a stack.

    Rows are moved back by their displacement, so that neighbours correlate as in the scene; spectra of short pieces
    are averaged, each weighted by what its blur lets through and by the noise of its frame.

    Args:
        frames: (T, C, H, W) in row order.
        motion: Motion of the batch of stacks.
        stack: Index of the stack in the batch.
        levels: (T,) standard deviation of the noise of each frame.
        length: Length of the Fourier transform along rows.

    Returns:
        The prior for transforms of that length.
    """
    H, W = frames.shape[-2:]
    step = max(min(_SEGMENT, H) // 2, 1)
    size = min(_SEGMENT, H)
    window = torch.hann_window(W + 2, periodic=False, dtype=frames.dtype, device=frames.device)[1:-1]
    window = window * (length / window.square().sum()).sqrt()
    taper = torch.hann_window(size + 2, periodic=False, dtype=frames.dtype, device=frames.device)[1:-1]
    taper = taper / taper.square().sum().sqrt()
    u = torch.fft.rfftfreq(length, dtype=torch.float64, device=frames.device)
    v = torch.fft.fftfreq(size, dtype=torch.float64, device=frames.device)

    spectra = torch.fft.rfft((frames - frames.mean((-2, -1), keepdim=True)) * window, n=length)
    rows = torch.arange(H, dtype=torch.float64, device=frames.device)
    starts = motion.frame_starts[:, None] + rows * motion.timing.row_time
    vibration = motion.vibration[stack]
    mean = vibration.mean_displacement(starts, motion.timing.exposure_time)[..., 0]
    spectra = spectra * _ramps(mean, -u).to(spectra.dtype)[:, None]
    power = torch.fft.fft(spectra.unfold(2, size, step) * taper).abs().square().mean(1)  # (T, pieces, U, V)

    middles = torch.arange(power.shape[1], device=frames.device) * step + size // 2
    displacement, weights = exposure_trajectory(vibration, starts[:, middles], motion.timing, "gauss")
    along = _ramps(displacement[..., 0], u) * weights[:, None]
    across = _ramps(displacement[..., 1], v)
    transfer = (along.transpose(-2, -1).to(spectra.dtype) @ across.to(spectra.dtype)).abs().square()
    weight = transfer / levels.square()[:, None, None, None]
    total = weight.sum((0, 1)).clamp(min=torch.finfo(frames.dtype).tiny)
    observed = (weight * power).sum((0, 1)) / total
    noise_power = transfer.sum((0, 1)) / total * length
    return autoregressive_prior(observed, (weight * transfer).sum((0, 1)) / total, noise_power)


def _ramps(places: Tensor, frequencies: Tensor) -> Tensor:
    angle = (-2 * math.pi) * places[..., None] * frequencies
    return torch.polar(torch.ones_like(angle), angle)
