"""Noise told from texture by motion blur: what the scene holds is blurred, row by row, and noise is not."""

import math

import torch
from torch import Tensor

from rsvib_torch.core.fourier import squared_modulus, waves
from rsvib_torch.imaging.trajectory import exposure_trajectory
from rsvib_torch.restoration.frame_motion import FrameMotion
from rsvib_torch.restoration.noise.single_frame import mostly_measured
from rsvib_torch.restoration.noise.squares import SIDE, cut_squares, spread_squares, tapered

__all__ = ["noise_beside_blur"]

_PIECES, _LEAST, _MOST = 64, 25, 256  # of a frame, of a frame of many, and of all, about
_EVERY = 8  # rows of a piece, of which the blur is looked at
_COARSE = 0.12  # cycles per px; below, scenes are so strong that they say nothing of noise
_BARE, _ENOUGH = 0.05, 0.02  # power that the blur lets through, in so many of the values
_FEWEST = 4  # pieces that a frame has to show
_ITERATIONS = 12
_STEP = 0.5  # of a power at most, downwards


@torch.no_grad()
def noise_beside_blur(frames: Tensor, motion: FrameMotion, stack: int, ignore: Tensor | None = None) -> Tensor | None:
    """Power of the white noise in frames whose scene is blurred, more here and less there.

    At frequency k, piece p of a frame has the power ``a_p T_pk S_k + noise``: T is what the blur of its rows lets
    through, S the spectrum of the scene, and a how much texture the piece has. Where T is near zero the noise lies
    bare, however dense the texture. Fisher scoring finds all of them together, for powers that scatter exponentially
    about their means (Whittle 1953).

    Args:
        frames: (T, C, H, W) in row order.
        motion: Motion of the batch of stacks.
        stack: Index of the stack in the batch.
        ignore: Boolean mask shaped like the frames: pieces with many such pixels do not count.

    Returns:
        Power (T,), float64, NaN for a frame that has too few pieces which count; None where blur hides too little of
        the scene to tell.
    """
    shape, device = frames.shape[-2:], frames.device
    if min(shape) < 2 * SIDE:
        return None
    counts = _counts(shape, min(max(_MOST // len(frames), _LEAST), _PIECES))
    rows, columns = spread_squares(shape, counts, device)
    u = torch.fft.rfftfreq(SIDE, dtype=torch.float64, device=device)
    v = torch.fft.fftfreq(SIDE, dtype=torch.float64, device=device)
    fine = _pooled(torch.hypot(u[:, None], v)) > _COARSE
    times = motion.frame_starts[:, None, None] + rows * motion.timing.row_time
    transfer = _pooled(_transfer(motion, stack, times[..., _EVERY // 2 :: _EVERY], u, v))[..., fine]
    if float((transfer < _BARE).double().mean()) < _ENOUGH:
        return None
    pieces = tapered(cut_squares(frames, rows, columns))  # (T, C, pieces, pieces, rows, columns)
    mean = motion.vibration[stack].mean_displacement(times, motion.timing.exposure_time)[..., 0]
    back = waves(mean, -u).to(frames.dtype.to_complex())  # neighbouring rows are to be alike as in the scene
    power = squared_modulus(torch.fft.fft(torch.fft.rfft(pieces) * back[:, None, :, None], dim=-2)).mean(1)
    power = _pooled(power.transpose(-2, -1).to(torch.float64))[..., fine]
    power, transfer = power.flatten(1, 2), transfer[:, :, None].expand_as(power).flatten(1, 2)
    usable = (power > 0).any(-1)
    if ignore is not None:
        lost = cut_squares(ignore.any(1), rows, columns).double().mean((-2, -1)).flatten(1)
        usable = usable & mostly_measured(lost, (-1,))
    enough = usable.sum(-1) >= min(_FEWEST, usable.shape[-1])
    noise = _score(power.where(enough[:, None, None], 1.0), transfer, usable | ~enough[:, None])
    return noise.masked_fill(~enough, math.nan)


def _score(power: Tensor, transfer: Tensor, usable: Tensor) -> Tensor:
    """Noise (T,) that explains powers (T, P, K) of pieces, of whose scene the blur lets ``transfer`` through.

    Only those pieces count for which ``usable`` (T, P) is true.
    """
    share = usable.to(power.dtype)[..., None]
    share = share / share.sum(-2, keepdim=True)

    def mean(values: Tensor) -> Tensor:
        return (share * values).sum(-2, keepdim=True)

    noise = mean(power).amin(-1, keepdim=True)
    texture = torch.ones_like(power[..., :1])
    scene = mean(power - noise).clamp(min=0.1 * noise) / mean(transfer)
    for _ in range(_ITERATIONS):
        shown = texture * transfer
        model = shown * scene + noise
        weight, rest = share / model.square(), power - model
        own, pull = (shown.square() * weight).sum(-2, keepdim=True), (shown * weight * rest).sum(-2, keepdim=True)
        both = (shown * weight).sum(-2, keepdim=True)
        # normal equations of scene and noise, the scene's eliminated
        pulled = (weight * rest).sum((-2, -1), keepdim=True) - (both * pull / own).sum(-1, keepdim=True)
        step = pulled / (weight.sum((-2, -1), keepdim=True) - (both.square() / own).sum(-1, keepdim=True))
        step = step.clamp(min=-_STEP * noise, max=noise)
        scene, noise = torch.maximum(scene + (pull - both * step) / own, _STEP * scene), noise + step
        full = transfer * scene
        model = texture * full + noise
        weight, rest = model.square().reciprocal(), power - model
        change = (full * weight * rest).sum(-1, keepdim=True) / (full.square() * weight).sum(-1, keepdim=True)
        texture = torch.maximum(texture + change, _STEP * texture)
        typical = mean(texture)
        texture, scene = texture / typical, scene * typical
    return noise[:, 0, 0]


def _counts(shape: torch.Size, most: int) -> list[int]:
    """Pieces along each axis, half overlapping where there are few."""
    counts = [2 * extent // SIDE - 1 for extent in shape]
    excess = max(1.0, math.sqrt(math.prod(counts) / most))
    return [max(1, round(count / excess)) for count in counts]


def _transfer(motion: FrameMotion, stack: int, times: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Power (..., U, V) that the blur of rows exposed from ``times`` (..., R) on lets through, weighed by the taper."""
    displacement, weights = exposure_trajectory(motion.vibration[stack], times, motion.timing, "gauss")
    along = waves(displacement[..., 0], u) * weights[:, None]
    across = waves(displacement[..., 1], v)
    share = torch.hann_window(2 * times.shape[-1] + 1, periodic=False, dtype=u.dtype, device=u.device)[1::2].square()
    seen = squared_modulus(along.transpose(-2, -1) @ across)
    return (seen * (share / share.sum())[:, None, None]).sum(-3)


def _pooled(values: Tensor) -> Tensor:
    """Mean over 2 x 2 neighbouring frequencies of (..., U, V), without the lowest and the highest u."""
    inner = values[..., 1 : (values.shape[-2] - 2) // 2 * 2 + 1, :]
    pooled: Tensor = inner.unflatten(-2, (-1, 2)).unflatten(-1, (-1, 2)).mean((-3, -1))
    return pooled
