"""Noise of frames with motion blur: the blur attenuates the scene, row by row, and leaves noise as it is.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math

import torch
from torch import Tensor

from rsvib_torch.core.fourier import squared_modulus, waves
from rsvib_torch.imaging.trajectory import exposure_trajectory
from rsvib_torch.restoration.frame_motion import FrameMotion
from rsvib_torch.restoration.noise.squares import SIDE, cut_squares, mostly_measured, spread_squares, tapered

__all__ = ["noise_of_blurred_frames"]


@torch.no_grad()
def noise_of_blurred_frames(
    frames: Tensor,
    motion: FrameMotion,
    stack: int,
    ignore: Tensor | None = None,
    high_pass: Tensor | None = None,
    *,
    min_frequency: float = 0.12,
    max_transfer: float = 0.05,
    min_share: float = 0.02,
    row_step: int = 8,
) -> Tensor:
    """Noise power of each frame from its motion blur.

    At frequency k, square p of a frame has the power ``a_p T_pk S_k + noise``: T is the power transfer of the blur of
    its rows, S the spectrum of the scene, and a the strength of the texture in the square. Where T is near zero, the
    power is that of the noise, whatever the texture. Fisher scoring estimates a, S and the noise together, for powers
    with exponential distributions about their means (Whittle 1953).

    Args:
        frames: As in ``ESTIMATORS``, and likewise the next four.
        motion: Motion of the batch.
        stack: Index in the batch.
        ignore: Pixels that were not measured; squares with many of them do not count.
        high_pass: Not used.
        min_frequency: Cycles per px; below, scenes are too strong to be informative about noise.
        max_transfer: T below which the blur counts as blocking the scene.
        min_share: Share of such values of T below which the estimator does not apply.
        row_step: T is computed for one of so many rows.

    Returns:
        (T,), float64; NaN for a frame with fewer than four usable squares, for all frames if the estimator does not
        apply.
    """
    shape, device = frames.shape[-2:], frames.device
    nothing = torch.full((len(frames),), math.nan, dtype=torch.float64, device=device)
    if min(shape) < 2 * SIDE:
        return nothing
    counts = _square_counts(shape, min(max(256 // len(frames), 25), 64))
    rows, columns = spread_squares(shape, counts, device)
    u = torch.fft.rfftfreq(SIDE, dtype=torch.float64, device=device)
    v = torch.fft.fftfreq(SIDE, dtype=torch.float64, device=device)
    used = _pooled(torch.hypot(u[:, None], v)) > min_frequency
    times = motion.frame_starts[:, None, None] + rows * motion.timing.row_time
    transfer = _pooled(_power_transfer(motion, stack, times[..., row_step // 2 :: row_step], u, v))[..., used]
    if float((transfer < max_transfer).double().mean()) < min_share:
        return nothing
    squares = tapered(cut_squares(frames, rows, columns))  # (T, C, n, m, rows, columns)
    mean = motion.vibration[stack].mean_displacement(times, motion.timing.exposure_time)[..., 0]
    unshift = waves(mean, -u).to(frames.dtype.to_complex())  # aligns neighbouring rows along the row axis
    power = squared_modulus(torch.fft.fft(torch.fft.rfft(squares) * unshift[:, None, :, None], dim=-2)).mean(1)
    power = _pooled(power.transpose(-2, -1).to(torch.float64))[..., used]
    power, transfer = power.flatten(1, 2), transfer[:, :, None].expand_as(power).flatten(1, 2)
    usable = (power > 0).any(-1)
    if ignore is not None:
        missing = cut_squares(ignore.any(1), rows, columns).double().mean((-2, -1)).flatten(1)
        usable = usable & mostly_measured(missing, (-1,))
    enough = usable.sum(-1) >= min(4, usable.shape[-1])
    noise = _fit_noise(power.where(enough[:, None, None], 1.0), transfer, usable | ~enough[:, None])
    return noise.masked_fill(~enough, math.nan)


def _fit_noise(
    power: Tensor, transfer: Tensor, usable: Tensor, *, iterations: int = 12, max_decrease: float = 0.5
) -> Tensor:
    """Noise power (T,) by Fisher scoring of ``texture_p transfer_pk scene_k + noise``.

    Args:
        power: (T, P, K) of P squares at K frequencies.
        transfer: (T, P, K).
        usable: (T, P) bool, squares that count.
        iterations: Scoring steps, each for scene and noise first, then for the texture.
        max_decrease: Largest relative decrease of a parameter in one step; keeps the powers positive.
    """
    share = usable.to(power.dtype)[..., None]
    share = share / share.sum(-2, keepdim=True)

    def mean(values: Tensor) -> Tensor:
        return (share * values).sum(-2, keepdim=True)

    noise = mean(power).amin(-1, keepdim=True)
    texture = torch.ones_like(power[..., :1])
    scene = mean(power - noise).clamp(min=0.1 * noise) / mean(transfer)
    for _ in range(iterations):
        by_scene = texture * transfer  # derivative of the model with respect to the scene
        model = by_scene * scene + noise
        weight, residual = share / model.square(), power - model
        curvature = (by_scene.square() * weight).sum(-2, keepdim=True)
        gradient = (by_scene * weight * residual).sum(-2, keepdim=True)
        mixed = (by_scene * weight).sum(-2, keepdim=True)
        # normal equations of scene and noise with the scene eliminated
        reduced = (weight * residual).sum((-2, -1), keepdim=True) - (mixed * gradient / curvature).sum(-1, keepdim=True)
        step = reduced / (weight.sum((-2, -1), keepdim=True) - (mixed.square() / curvature).sum(-1, keepdim=True))
        step = step.clamp(min=-max_decrease * noise, max=noise)
        scene = torch.maximum(scene + (gradient - mixed * step) / curvature, max_decrease * scene)
        noise = noise + step
        by_texture = transfer * scene
        model = texture * by_texture + noise
        weight, residual = model.square().reciprocal(), power - model
        change = (by_texture * weight * residual).sum(-1, keepdim=True)
        change = change / (by_texture.square() * weight).sum(-1, keepdim=True)
        texture = torch.maximum(texture + change, max_decrease * texture)
        typical = mean(texture)
        texture, scene = texture / typical, scene * typical
    return noise[:, 0, 0]


def _square_counts(shape: torch.Size, most: int) -> list[int]:
    """Squares along each axis, about ``most`` in all; they overlap by half if that is fewer."""
    counts = [2 * extent // SIDE - 1 for extent in shape]
    excess = max(1.0, math.sqrt(math.prod(counts) / most))
    return [max(1, round(count / excess)) for count in counts]


def _power_transfer(motion: FrameMotion, stack: int, times: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Power transfer (..., U, V) of the blur of rows exposed from ``times`` (..., R) on, weighted by the window."""
    displacement, weights = exposure_trajectory(motion.vibration[stack], times, motion.timing, "gauss")
    along = waves(displacement[..., 0], u) * weights[:, None]
    across = waves(displacement[..., 1], v)
    window = torch.hann_window(2 * times.shape[-1] + 1, periodic=False, dtype=u.dtype, device=u.device)[1::2].square()
    transfer = squared_modulus(along.transpose(-2, -1) @ across)
    return (transfer * (window / window.sum())[:, None, None]).sum(-3)


def _pooled(values: Tensor) -> Tensor:
    """Mean over 2 x 2 neighbouring frequencies of (..., U, V), without the lowest and the highest u."""
    inner = values[..., 1 : (values.shape[-2] - 2) // 2 * 2 + 1, :]
    pooled: Tensor = inner.unflatten(-2, (-1, 2)).unflatten(-1, (-1, 2)).mean((-3, -1))
    return pooled
