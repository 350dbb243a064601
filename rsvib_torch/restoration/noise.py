"""Noise level of every frame of a stack: three estimators, and the order in which they are preferred.

``noise_levels`` (at the end of the file) is the entry. ``estimate_noise`` measures single images and counts fine
texture as noise; the other estimators separate noise from texture by a second frame, or by the floor of the power
spectrum.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Sequence
from statistics import NormalDist

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rsvib_torch.execution.parallel import at_once, runs
from rsvib_torch.frames.pixels import cut_parts
from rsvib_torch.numerics.interpolation import squared_modulus
from rsvib_torch.numerics.tables import Array, constant, median, quantile, table, tables, valid_mean, without_nan
from rsvib_torch.restoration.frame_motion import FrameMotion
from rsvib_torch.restoration.observation import RowKernels
from rsvib_torch.restoration.scene_prior import cut_pieces, sample_rows, spread_starts, taper

# Squares for power spectra, and which parts of images count

_SIDE = 64  # px; side of the squares whose power spectra are computed


def _cut_squares(images: Tensor, counts: Sequence[int]) -> Tensor:
    """Squares (..., n, m, _SIDE, _SIDE) of images (..., H, W), n x m of which are spread evenly over the image."""
    tops, lefts = (spread_starts(extent, _SIDE, count) for extent, count in zip(images.shape[-2:], counts, strict=True))
    return cut_pieces(images, tops, lefts, (_SIDE, _SIDE))


def _mostly_measured(missing: Tensor, dims: tuple[int, ...]) -> Tensor:
    """Parts of images that count, by the share of their pixels that is missing.

    A part counts up to a tenth; if all parts of an image along ``dims`` miss more, those that miss least count.
    """
    return (missing <= missing.amin(dims, keepdim=True).clamp(min=0.1)) & (missing < 1)


# Single images: the quietest blocks of a high-pass residual


def estimate_noise(frames: Tensor, ignore: Tensor | None = None) -> Tensor:
    """Standard deviation of white noise in each image.

    The outer product of two differences of eighth order passes the corner of the spectrum, where optics pass least.
    The 15 % quantile of its energy in blocks of 16 x 16 px excludes blocks with texture. A scene that has texture up to
    the corner everywhere counts as noise. Of large images, strips spread over all rows are used.

    Args:
        frames: (..., H, W).
        ignore: Boolean mask of the same shape of pixels without noise of their own. Blocks with many of them do not
            count.

    Returns:
        Standard deviation, shape (...), in the unit of the frames; NaN for an image without a usable block.

    Example:
        >>> import torch
        >>> noise = torch.randn(200, 300, generator=torch.Generator().manual_seed(0))
        >>> round(estimate_noise(0.1 * noise).item(), 2)
        0.1
    """
    return torch.as_tensor(noise_deviation(frames, ignore), dtype=frames.dtype, device=frames.device)


def noise_deviation(frames: Tensor, ignore: Tensor | None) -> Array:
    """``estimate_noise`` as an array."""
    shape = (frames.shape[-2], frames.shape[-1])
    orders = [min(8, (extent - 1) // 2 + 1, extent - 1) for extent in shape]
    inner = [extent - order for extent, order in zip(shape, orders, strict=True)]
    block = min(16, *inner)
    height, width = (extent // block * block for extent in inner)
    stride = max(1, height * width // (block**2 * 2048))  # 2048 blocks determine the quantile well enough

    def blocks_of(images: Tensor) -> Tensor:
        """Blocks (..., n, m, rows, columns), with the neighbours that differences need."""
        inside = images[..., : height + orders[0], : width + orders[1]]
        return inside.unfold(-2, block + orders[0], stride * block).unfold(-2, block + orders[1], block)

    # energy of the differences along both axes, relative to that of white noise of variance 1
    down, along = (constant(_differences, block, order, dtype=frames.dtype, device=frames.device) for order in orders)
    images = frames.reshape(-1, *shape)
    pixels = height * width // stride
    parts = []
    for part in runs(len(images), at_once(16 * pixels, frames.device, cpu_bytes=2**26)):
        blocks = blocks_of(images[part])
        differences = (blocks.reshape(-1, blocks.shape[-1]) @ along.T).view(-1, blocks.shape[-2], block)
        energy = torch.bmm(down.expand(len(differences), -1, -1), differences).square_().mean((-2, -1))
        parts.append(energy.view(len(blocks), -1))
    energy = torch.cat(parts)
    if ignore is not None:
        missing = blocks_of(ignore.to(frames.dtype)).mean((-2, -1))
        energy = energy.masked_fill(~_mostly_measured(missing, (-2, -1)).view(energy.shape), math.nan)
    powers = table(energy).reshape(*frames.shape[:-2], -1)
    powers = powers / math.prod(math.comb(2 * order, order) for order in orders)
    # Means of squares of pure noise scatter, so that their low quantile lies below the true mean, by as much as that of
    # a chi-squared variable (Wilson and Hilferty 1931).
    share = 0.15
    variance = min(2.0 * math.prod(_correlation_area(difference) for difference in orders) / (9.0 * block**2), 0.2)
    expected = (1.0 - variance + NormalDist().inv_cdf(share) * variance**0.5) ** 3
    few = (~np.isnan(powers)).sum(-1) < 8  # too few blocks for a quantile
    return np.sqrt(np.where(few, valid_mean(powers, -1), quantile(powers, share, -1) / expected))


def _differences(count: int, order: int) -> Array:
    """Matrix (count, count + order) of differences of neighbours."""
    return np.diff(np.eye(count + order), order, axis=0)


def _correlation_area(order: int) -> float:
    """Sum of the squared autocorrelation of differenced white noise over all lags."""
    total = math.comb(2 * order, order)
    return sum((math.comb(2 * order, order + lag) / total) ** 2 for lag in range(-order, order + 1))


# Two frames: the residual after the scene that explains both best is subtracted

_MIN_SIDE = 64  # px that two frames must share along each axis, or the whole frame if it is smaller
_MAX_MISSING = 0.1  # share of the compared pixels


@torch.no_grad()
def noise_of_frame_pair(frames: Tensor, motion: FrameMotion, ignore: Tensor | None, high_pass: Tensor) -> Tensor:
    """Noise power (B, T) of each frame from the two middle ones of its stack that have content.

    The least-squares scene of both frames leaves a residual without texture. What texture adds to ``high_pass`` is
    measured as the difference between that estimate and the residual, and assumed equal in all frames. NaN for stacks
    in which fewer than two frames have content, or too many of the compared pixels are missing. Frames (B, T, C, H, W)
    have local means at pixels to ``ignore``, and ``high_pass`` is NaN for frames without content.
    """
    result = torch.full_like(high_pass, math.nan)
    size = frames.shape[-2], frames.shape[-1]
    least = max(min(_MIN_SIDE, *size), 8)
    # the two frames of each stack, and the displacement (y, x) of the content between them
    shifts, known = motion.shift.flip(-1).cpu().numpy().astype(int), (~high_pass.isnan()).cpu().numpy()
    pairs = {}
    for stack, usable in enumerate(known):
        (numbers,) = usable.nonzero()
        members = numbers[(len(numbers) - 1) // 2 :][:2]
        if len(members) == 2:
            step = shifts[stack, members[1]] - shifts[stack, members[0]]
            if min(size - abs(step)) >= least:
                pairs[stack] = members, step
    if not pairs:
        return result
    # rows and columns of the scene that both frames of all stacks contain: at least as many as needed
    common = size - np.abs([step for _, step in pairs.values()]).max(0)
    num_rows, columns = min(common[0], 256), common[1]  # from the middle: more rows hardly lower the variance
    stacks = list(pairs)
    members = np.stack([members for members, _ in pairs.values()])  # (S, 2)
    steps = np.stack([step for _, step in pairs.values()])
    firsts = np.stack([(-steps).clip(0), steps.clip(0)], 1)  # (S, 2, axes)
    tops, lefts = firsts[..., 0] + ((size[0] - abs(steps[:, :1])) - num_rows) // 2, firsts[..., 1]

    def shared(values: Tensor) -> Tensor:
        places = zip(members.T, tops.T, lefts.T, strict=True)
        parts = [
            cut_parts(values, (np.array(stacks), frame), top, left, (num_rows, columns)) for frame, top, left in places
        ]
        return torch.stack(parts, 1)

    images, ignored = shared(frames), None if ignore is None else shared(ignore)
    measured_share = torch.ones_like(high_pass[stacks, 0])
    if ignored is not None:
        measured_share = 1.0 - ignored.any(1).to(images.dtype).mean((1, 2, 3))
    # noise of both frames, and texture that the high-pass estimate counts as noise
    stack_of, member_of, top_of = (torch.as_tensor(values, device=frames.device) for values in (stacks, members, tops))
    rows = top_of[..., None] + torch.arange(num_rows, device=frames.device)
    displacement, node_weights = motion.exposures
    moved = displacement[stack_of[:, None, None], member_of[..., None], rows]
    moved = moved - motion.shift[stack_of[:, None], member_of][:, :, None, None]
    noise = _residual_power(images, moved, node_weights) / measured_share
    alone = estimate_noise(images, ignored).square().mean(-1)
    texture = (alone.mean(1) - noise).clamp(min=0.0)[:, None]
    # neither frame has more noise than both together; blur may leave one of them more texture than the other
    known_power, noise = high_pass[stacks], noise[:, None]
    upper = 2.0 * noise + (known_power - alone.amax(1, keepdim=True)).clamp(min=0.0)
    estimate = torch.maximum(known_power - texture, 0.5 * torch.minimum(known_power, noise)).minimum(upper)
    too_few = (measured_share < 1.0 - _MAX_MISSING)[:, None]
    result[stacks] = estimate.masked_fill(too_few, math.nan)
    return result


def _residual_power(images: Tensor, displacement: Tensor, node_weights: Tensor) -> Tensor:
    """Residual power (S,) per degree of freedom of pairs of images (S, 2, C, R, W) minus their least-squares scene.

    Only 24 horizontal frequencies of the upper half are used, where scenes are weakest. A weak smoothness prior fills
    in rows of the scene that neither frame contains. ``displacement`` (S, 2, R, N, 2) is that of the rows during their
    exposures, in the coordinates of the scene.
    """
    num_rows, width = images.shape[-2:]
    moved = displacement.flatten(0, 1)
    kernels = RowKernels.of_rows(moved, node_weights, moved.new_ones(len(moved)), num_rows, margin=4 * _MIN_SIDE)
    count = min(24, width // 4)
    chosen = np.linspace(width // 4, width // 2, count, dtype=np.float32).astype(np.int64)
    sample = sample_rows(images, kernels, chosen)
    # correlation 0.9 of neighbouring rows of the scene, of weight 1e-4 beside the data
    products = torch.tensor([[1.0, 0.9**2], [-0.9, 0.0]], dtype=torch.float64, device=images.device)
    power, rest = sample.unexplained(1e-4 * products[:, :, None, None].expand(-1, -1, len(images), count))
    return torch.as_tensor(power[0].sum(-1) / rest[0].sum(-1), dtype=images.dtype, device=images.device)


# One frame: noise is white, the spectrum of a scene falls

_SECTORS = 6  # directions, with one power law each


def _pooled(values: Tensor) -> Tensor:
    """Mean over 2 x 2 neighbouring frequencies of (..., U, V), without the lowest and the highest u."""
    inner = values[..., 1 : (values.shape[-2] - 2) // 2 * 2 + 1, :]
    return inner.unflatten(-2, (-1, 2)).unflatten(-1, (-1, 2)).mean((-3, -1))


def noise_of_spectral_floor(frames: Tensor, ignore: Tensor | None, high_pass: Tensor) -> Tensor:
    """Noise power (B, T) of each frame from ``noise_floor``; NaN if it is not clearly lower than ``high_pass``."""
    floor = noise_floor(frames, ignore).mean(-1).to(high_pass.dtype)
    # a noise level that is far too low amplifies noise more than one that is too high blurs
    bounded = torch.maximum(floor, high_pass / 9.0)
    # of two values that differ by less, the floor is the less accurate one
    return torch.where(floor < high_pass / 1.25, bounded, math.nan)


@torch.no_grad()
def noise_floor(frames: Tensor, ignore: Tensor | None = None) -> Tensor:
    """Power (...) of the white noise below the texture of each image (..., H, W), from its power spectrum.

    At frequency f in direction d the power is ``n + c_d f^(-a_d) exp(-b f^2)``: a power law for the scene in every
    direction, Gaussian optics, and one floor. Fisher scoring estimates all of them, for powers with exponential
    distributions about their means (Whittle 1953). The floor is uncertain if texture exceeds it up to the highest
    frequencies. Squares with many pixels to ``ignore`` do not count. NaN for an image of less than one square, or
    without a usable one.
    """
    height, width = frames.shape[-2:]
    images = frames.reshape(-1, height, width)
    if min(height, width) < _SIDE:
        return images.new_full(frames.shape[:-2], math.nan, dtype=torch.float64)
    power = _pooled(_spectrum(images, None if ignore is None else ignore.reshape(images.shape)).mT)  # (N, U, V)
    u = _pooled(torch.fft.rfftfreq(_SIDE, dtype=torch.float64, device=frames.device)[:, None].expand(-1, 2))
    v = torch.fft.fftfreq(_SIDE, dtype=torch.float64, device=frames.device).unflatten(0, (-1, 2)).mean(-1)
    frequency, direction = torch.hypot(u, v), torch.atan2(v, u)
    used = frequency > 0.2  # cycles per px; spectra are steeper than the power law below
    sector = ((direction[used] / math.pi + 0.5) * _SECTORS).long().clamp(0, _SECTORS - 1)
    return _fit_floor(power[:, used], frequency[used], sector).reshape(frames.shape[:-2])


def _spectrum(images: Tensor, ignore: Tensor | None) -> Tensor:
    """Mean power (N, V, U) of squares of images (N, H, W); the power of white noise is its variance."""
    counts = [min(2 * extent // _SIDE - 1, 6) for extent in images.shape[-2:]]
    squares = _cut_squares(images, counts).flatten(1, 2)
    window = constant(taper, _SIDE, dtype=squares.dtype, device=squares.device)
    tapered = (squares - squares.mean((-2, -1), keepdim=True)) * window * window[:, None]
    power = squared_modulus(torch.fft.rfft2(tapered)).to(torch.float64)
    if ignore is None:
        return power.mean(1)
    missing = _cut_squares(ignore, counts).double().mean((-2, -1)).flatten(1)
    usable = _mostly_measured(missing, (-1,))
    return (power * usable[..., None, None]).sum(1) / usable.sum(1)[:, None, None]


def _fit_floor(power: Tensor, frequency: Tensor, sector: Tensor) -> Tensor:
    """Floor (N,) of powers (N, K) by Fisher scoring of ``n + c_d f^(-a_d) exp(-b f^2)`` in the logarithms of n and c.

    The frequencies f (K,) are in cycles per px, ``sector`` (K,) is the direction d, and the exponents a have a weak
    prior, 3 with a standard deviation of 8.
    """
    # start from half of the lowest power as floor, and from half of the mean power of each sector as scene
    inside = torch.nn.functional.one_hot(sector, _SECTORS).to(torch.float64)  # (K, D)
    frequency = frequency / 0.4  # in units of a typical one, so that levels and exponents are nearly independent
    scale = power.mean(-1, keepdim=True)
    power = (power / scale).nan_to_num(nan=1.0)
    low = power.amin(-1, keepdim=True).clamp(min=1e-9)
    typical = ((power @ inside) / inside.sum(0)).clamp(min=1e-9)
    log_level, exponent = (0.5 * typical).log(), torch.full_like(typical, 2.0)
    parameters = torch.cat([(0.5 * low).log(), torch.zeros_like(low), log_level, exponent], dim=-1)
    expected = parameters.new_tensor([0.0] * (2 + _SECTORS) + [3.0] * _SECTORS)
    prior = parameters.new_tensor([1e-3] * (2 + _SECTORS) + [8.0**-2] * _SECTORS)
    log_frequency, square = frequency.log(), frequency.square()
    for _ in range(16):
        # expected power, and the derivatives of its logarithm
        floor, blur, log_level, exponent = parameters.split([1, 1, _SECTORS, _SECTORS], dim=-1)
        scene = (log_level[:, sector] - exponent[:, sector] * log_frequency - blur * square).exp()
        model = floor.exp() + scene
        share = scene / model
        parts = share[..., None] * inside
        slope = torch.cat(
            [(floor.exp() / model)[..., None], -(share * square)[..., None], parts, -parts * log_frequency[:, None]],
            dim=-1,
        )
        # step of bounded size
        normal = slope.transpose(-2, -1) @ slope + torch.diag(prior)
        gradient = (slope.transpose(-2, -1) @ (power / model - 1.0)[..., None])[..., 0]
        gradient[:, 1:] += ((expected - parameters) * prior)[:, 1:]
        parameters = parameters + torch.linalg.solve(normal, gradient).clamp(-0.7, 0.7)
        parameters[:, 1].clamp_(min=0.0)  # optics attenuate
    return parameters[:, 0].exp() * scale[:, 0]


# Choice of the estimator


@torch.no_grad()
def noise_levels(frames: Tensor, motion: FrameMotion, ignore: Tensor | None = None) -> Tensor:
    """Standard deviation (B, T) of the noise of each frame of B stacks, in its unit; 0 without any content.

    ``estimate_noise`` counts fine texture as noise, which makes it an upper bound; two frames of a stack lower it, or
    else the spectral floor of each. A frame without content, or with too few measured pixels, has the median noise
    power of the others. The frames (B, T, C, H, W) are in row order, with local means at pixels to ``ignore``.
    """
    alone = valid_mean(np.square(noise_deviation(frames, ignore)), -1)
    alone[_constant(frames)] = math.nan
    high_pass = torch.as_tensor(alone, dtype=frames.dtype, device=frames.device)
    estimated = table(noise_of_frame_pair(frames, motion, ignore, high_pass))
    single = np.isnan(estimated).all(1, keepdims=True)
    if single.any():
        estimated = np.where(single, table(noise_of_spectral_floor(frames, ignore, high_pass)), estimated)
    # a frame that neither can estimate keeps its upper bound, NaN included
    power = np.minimum(alone, without_nan(estimated, math.inf))
    power = without_nan(np.where(np.isnan(power), median(power, 1, keepdims=True), power), 0.0)
    return torch.as_tensor(np.sqrt(power), dtype=frames.dtype, device=frames.device)


def _constant(frames: Tensor) -> NDArray[np.bool_]:
    """Frames (B, T) whose values, in every eighth row, are equal to within rounding: they hold not even noise."""
    low, high = tables(*frames[..., ::8, :].flatten(2).aminmax(dim=-1))
    return high - low <= 1e-6 * np.maximum(-low, high)
