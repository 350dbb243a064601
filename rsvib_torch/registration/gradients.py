"""What every scene row tells of its place in each frame, once the frames are warped back by a known motion.

With s the scene and d the displacement that is still missing in a frame, the frame less the scene is ``-s' d`` plus
noise. The scene itself is unknown; the mean of the warped frames stands for it, and its gradient, cleaned by a Wiener
filter, weighs what remains: ``H = sum w g g^T`` and ``b = -sum w g e`` per row. Noise of the mean and noise of the
differences from it are independent, so that the sums have no bias from it, and the filter keeps them near the
Cramer-Rao bound.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.spectral import extend_rows, fast_length
from rsvib_torch.splines import bspline_coefficients, bspline_weights

__all__ = [
    "DEGREE",
    "MARGIN",
    "RowGradients",
    "RowSpectra",
    "inner_columns",
    "mean_over_frames",
    "row_gradients",
    "row_shifts",
]

DEGREE = 7  # of the spline across rows: what it smooths, and the noise it colours, lie above the pass band
MARGIN = 8  # px from the ends of rows and columns that do not count
_POWERS = 32  # of a turn, computed one by one
_EXTENSION = 32  # px that rows are continued by, so that their Fourier transform closes smoothly
_PASS_ROWS = (0.24, 0.34)  # cycles/px across rows: full weight below, none above
_PASS_COLUMNS = (0.40, 0.48)  # along rows, where interpolation is exact but detail near the limit may be aliased
_SLOWEST = 1 / 64  # cycles/px: shading and vignetting live below
_SMOOTH = 16  # values of the spectra that are averaged along each axis
_BLOCK = 16  # px, side of the blocks that are judged together
_LARGEST_NOISE = 9.0  # mean square of a block over the typical one before it loses weight
_LARGEST_SHIFT = 0.15  # px, part of a block's residual that the gradient excuses


class RowSpectra:
    """Fourier transforms along the rows of frames, of spline coefficients across rows.

    Args:
        frames: (B, T, H, W) in row order.
        valid: (B, T, H, W) bool, pixels that count; None for all.
    """

    def __init__(self, frames: Tensor, valid: Tensor | None = None) -> None:
        self.height, self.width = frames.shape[-2:]
        self.length = fast_length(self.width + 2 * _EXTENSION)
        coefficients = bspline_coefficients(frames, DEGREE, -2)
        self.values = torch.fft.rfft(extend_rows(coefficients, self.length))
        self.frequencies = torch.fft.rfftfreq(self.length, dtype=torch.float64, device=frames.device)
        self.valid = None
        if valid is not None and not bool(valid.all()):
            # what interpolation takes from a bad pixel does not count either
            spoilt = functional.max_pool2d((~valid).to(frames.dtype), 2 * (DEGREE // 2) + 1, 1, DEGREE // 2)
            self.valid = spoilt == 0

    def warped(self, rows: Tensor, shift: Tensor) -> Tensor:
        """Spectra (B, T, S, U) of frame rows at fractional places ``rows``, moved back by ``shift``, both (B, T, S)."""
        values = self.values
        cell = rows.floor()
        weights = bspline_weights(rows - cell, DEGREE).to(values.real.dtype)
        first = cell.to(torch.int64) - DEGREE // 2
        taps = torch.arange(DEGREE + 1, device=rows.device)
        frame = torch.arange(values[..., 0, 0].numel(), device=rows.device).reshape(values.shape[:2])
        index = frame[..., None, None] * self.height + (first[..., None] + taps).clamp(0, self.height - 1)
        flat = torch.view_as_real(values).reshape(-1, 2 * values.shape[-1])
        picked = functional.embedding_bag(
            index.flatten(0, 2), flat, per_sample_weights=weights.flatten(0, 2), mode="sum"
        )
        result: Tensor = torch.view_as_complex(picked.unflatten(-1, (-1, 2))).unflatten(0, rows.shape)
        return result * self.ramp(shift)

    def ramp(self, shift: Tensor) -> Tensor:
        """exp(2 pi i u shift) for all frequencies u (..., U), as products of few powers of one turn."""
        turn = 2 * math.pi * shift[..., None] / self.length
        coarse = torch.arange(0, len(self.frequencies), _POWERS, dtype=torch.float64, device=shift.device)
        fine = torch.arange(_POWERS, dtype=torch.float64, device=shift.device)
        first, second = (
            torch.polar(torch.ones_like(angle), angle).to(self.values.dtype) for angle in (turn * coarse, turn * fine)
        )
        ramp: Tensor = (first[..., None] * second[..., None, :]).flatten(-2)[..., : len(self.frequencies)]
        return ramp

    def subtract(self, pattern: Tensor) -> None:
        """Take a pattern (B, U) out of every row of every frame."""
        self.values = self.values - pattern[:, None, None].to(self.values.dtype)

    def warped_valid(self, rows: Tensor, shift: Tensor) -> Tensor | None:
        """(B, S, W) bool, pixels of the scene that count in all frames; None for all."""
        if self.valid is None:
            return None
        place = rows.round().to(torch.int64).clamp(0, self.height - 1)
        columns = torch.arange(self.width, device=rows.device)
        result = torch.ones(1, dtype=torch.bool, device=rows.device)
        for frame in range(rows.shape[1]):  # one at a time: indices take eight times the memory of the flags
            picked = self.valid[:, frame].gather(1, place[:, frame, :, None].expand(-1, -1, self.width))
            column = (columns + shift[:, frame, :, None].round().to(torch.int64)).clamp(0, self.width - 1)
            result = result & picked.gather(2, column)
        return result


@dataclass(frozen=True, eq=False)
class RowGradients:
    """Gradients of the scene as seen by the rows of a group of frames, ready to weigh residuals.

    Attributes:
        spectra: (B, S, 3, U) one-sided transforms of weight times gradient along x, along y, and detail of the scene.
        products: (B, S, 3, 3) float64 sums of their products; detail takes out changes of contrast.
        variance: (B, S) float64, noise variance of a pixel in a frame.
        halves: (B, S, 2, 5) float64, sums gx gx, gx gy, gy gy, gx e and gy e over the left and the right half of each
            row, with e what is left between the outer frames: halves that move apart are no vibration.
    """

    spectra: Tensor
    products: Tensor
    variance: Tensor
    halves: Tensor


def _pass(frequency: Tensor, limits: tuple[float, float]) -> Tensor:
    """1 below the first limit, 0 above the second, a half cosine between."""
    low, high = limits
    return 0.5 + 0.5 * torch.cos(math.pi * ((frequency.abs() - low) / (high - low)).clamp(0.0, 1.0))


def _wiener(mean: Tensor, noise: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Share (B, S, U) of the spectrum of the mean that is scene, within the pass band.

    Args:
        mean: (B, S, U) two-dimensional spectrum of the mean of the frames.
        noise: (B, S, U) spectrum of a difference with the noise of the mean.
        u: Frequencies along rows, cycles/px.
        v: Frequencies across rows, cycles/px.
    """

    def smooth(spectrum: Tensor) -> Tensor:
        power = torch.view_as_real(spectrum).square().sum(-1)
        return functional.avg_pool2d(power[:, None], _SMOOTH, ceil_mode=True)

    total, noise_power = smooth(mean), smooth(noise)
    share = (1 - noise_power / total.clamp(min=torch.finfo(total.dtype).tiny)).clamp(min=0.0)
    share = functional.interpolate(share, scale_factor=_SMOOTH, mode="nearest")[:, 0, : len(v), : len(u)]
    radius = u.square() + v[:, None].square()
    band = _pass(u, _PASS_COLUMNS) * _pass(v, _PASS_ROWS)[:, None] * (1 - torch.exp(-radius / _SLOWEST**2))
    return share * band.to(share.dtype)


def row_gradients(spectra: RowSpectra, warped: Tensor, rows: Tensor, shift: Tensor, seen: Tensor) -> RowGradients:
    """Gradients of the scene, its noise, and the weight of every pixel, from frames warped by a motion.

    Args:
        spectra: The frames of a group.
        warped: (B, G, S, U) their rows warped to the scene, from ``RowSpectra.warped``.
        rows: (B, G, S) frame rows that show the S scene rows, in each frame.
        shift: (B, G, S) px, displacement along the rows to be taken out of each.
        seen: (B, G, S) float64, 1 where a frame sees the row.

    Returns:
        The gradients.
    """
    mean = mean_over_frames(warped, seen)
    frames = seen.sum(1)
    spare = (frames - 1).clamp(min=0.0)
    # the difference of the outer frames has twice the noise of a frame
    outer = _outer_difference(warped, seen) * (0.5 / frames.clamp(min=1.0)).sqrt().to(warped.real.dtype)[..., None]
    u = spectra.frequencies
    v = torch.fft.fftfreq(rows.shape[-1], dtype=torch.float64, device=u.device)
    whole = torch.fft.fft(mean, dim=-2)
    scene = whole * _wiener(whole, torch.fft.fft(outer, dim=-2), u, v)
    along, across = (2j * math.pi * u).to(scene.dtype), (2j * math.pi * v).to(scene.dtype)[:, None]
    detail = torch.fft.ifft(torch.stack([scene, scene * across], dim=2), dim=1)  # (B, S, 2, U)
    detail = torch.stack([detail[:, :, 0] * along, detail[:, :, 1], detail[:, :, 0]], dim=2)
    images = mean.real.new_ones(*mean.shape[:2], 4, spectra.width)  # brightness last
    images[:, :, :3] = torch.fft.irfft(detail, n=spectra.length)[..., : spectra.width]
    difference = (warped - mean[:, None]).transpose(1, 2)
    residual = torch.fft.irfft(difference, n=spectra.length)[..., : spectra.width]  # (B, S, G, W)
    residual = residual * seen.transpose(1, 2)[..., None].to(residual.dtype)

    weight = inner_columns(spectra.width, shift, images) * (spare > 0)[..., None].to(images.dtype)  # (B, S, W)
    valid = spectra.warped_valid(rows, shift)
    if valid is not None:
        weight = weight * valid
    weighted, left, products = _explain(images, residual, weight)
    energy = left.square().sum(2) / spare.clamp(min=1.0)[..., None].to(left.dtype)
    trust = _trust(energy, images[:, :, :2].square().sum(2), weight)
    if bool((trust < 1).any()):
        weight = weight * trust
        weighted, left, products = _explain(images, residual, weight)
    square = (left.square() * weight[:, :, None]).sum((2, 3), dtype=torch.float64)
    variance = square / ((products[..., 3, 3] - 4).clamp(min=1.0) * spare.clamp(min=1.0))
    mean_images = products[..., :3, 3:] / products[..., 3:, 3:].clamp(min=1e-6)
    centred = weighted[:, :, :3] - weight[:, :, None] * mean_images.to(weight.dtype)
    return RowGradients(
        spectra=torch.fft.rfft(centred, n=spectra.length) * _one_sided(spectra.length, centred),
        products=products[..., :3, :3] - mean_images * products[..., 3:, :3],
        variance=variance,
        halves=_halves(weighted, images, left, seen),
    )


def mean_over_frames(warped: Tensor, seen: Tensor) -> Tensor:
    """Mean (B, S, U) over the frames that see a row."""
    share = (seen / seen.sum(1, keepdim=True).clamp(min=1.0)).to(warped.real.dtype)
    parts = torch.view_as_real(warped)
    mean = parts[:, 0] * share[:, 0, :, None, None]
    for frame in range(1, warped.shape[1]):
        mean = torch.addcmul(mean, parts[:, frame], share[:, frame, :, None, None])
    return torch.view_as_complex(mean)


def _outer_difference(warped: Tensor, seen: Tensor) -> Tensor:
    """Last less first frame (B, S, U) that see a row; 0 where fewer than two do."""
    count = seen.shape[1]
    order = torch.arange(count, device=seen.device)[:, None]
    first = torch.where(seen > 0, order, count).amin(1).clamp(max=count - 1)
    last = torch.where(seen > 0, order, -1).amax(1).clamp(min=0)
    pick = [warped.gather(1, i[:, None, :, None].expand(-1, 1, -1, warped.shape[-1]))[:, 0] for i in (first, last)]
    return (pick[1] - pick[0]) * (last > first)[..., None]


def inner_columns(width: int, shift: Tensor, like: Tensor) -> Tensor:
    """(1, 1, W) weight of columns that all frames of the group show, falling to 0 over a few px."""
    edge = math.ceil(float(shift.abs().amax())) + MARGIN
    place = torch.arange(width, dtype=like.dtype, device=like.device)
    inside = torch.minimum(place, width - 1 - place) - edge
    return (inside / MARGIN).clamp(0.0, 1.0)[None, None]


def _explain(images: Tensor, residual: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Take out of each row what brightness, contrast and a shift of it explain.

    Args:
        images: (B, S, 4, W) gradients along x and y, detail, ones.
        residual: (B, S, G, W).
        weight: (B, S, W).

    Returns:
        Weighted images, what is left of the residual, and the products (B, S, 4, 4) float64 of the images.
    """
    weighted = images * weight[:, :, None]
    products = torch.matmul(weighted, images.transpose(-2, -1)).double()
    right = torch.matmul(residual, weighted.transpose(-2, -1)).double()  # (B, S, G, 4)
    known = (products.diagonal(dim1=-2, dim2=-1) > 0).all(-1)[..., None]
    scale = torch.where(known, products.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt(), 0.0)
    eye = torch.eye(4, dtype=scale.dtype, device=scale.device)
    unit = products * scale[..., :, None] * scale[..., None, :] + torch.where(known, 1e-6, 1.0)[..., None] * eye
    solution = torch.linalg.solve(unit, (right * scale[..., None, :]).transpose(-2, -1)).transpose(-2, -1)
    solution = (solution * scale[..., None, :]).to(images.dtype)
    return weighted, residual - torch.matmul(solution, images), products


def _trust(energy: Tensor, gradient: Tensor, weight: Tensor) -> Tensor:
    """Weight (B, S, W) in 0 ... 1 of blocks whose residual neither noise nor a small shift explains.

    Things that move by themselves, clouds and parallax leave such blocks.
    """
    rows, columns = energy.shape[-2:]

    def blocks(values: Tensor) -> Tensor:
        return functional.avg_pool2d((values * (weight > 0))[:, None], _BLOCK, ceil_mode=True)[:, 0]

    share = functional.avg_pool2d((weight > 0).to(energy.dtype).expand_as(energy)[:, None], _BLOCK, ceil_mode=True)[
        :, 0
    ]
    used = share > 0
    mean, slope = blocks(energy) / share.clamp(min=1e-6), blocks(gradient) / share.clamp(min=1e-6)
    typical = torch.where(used, mean, torch.nan).flatten(1).nanmedian(1).values[:, None, None]
    ratio = mean / (_LARGEST_NOISE * typical + _LARGEST_SHIFT**2 * slope).clamp(min=1e-30)
    trust = 1 / (1 + (ratio - 1).clamp(min=0.0).square())
    return functional.interpolate(trust[:, None], scale_factor=_BLOCK, mode="nearest")[:, 0, :rows, :columns]


def _halves(weighted: Tensor, images: Tensor, left: Tensor, seen: Tensor) -> Tensor:
    """Sums over the halves of each row, as in ``RowGradients.halves``."""
    both = (seen[:, 0] * seen[:, -1])[..., None]
    change = left[:, :, -1:] - left[:, :, :1]
    middle = left.shape[-1] // 2
    sums = []
    for half in (slice(None, middle), slice(middle, None)):
        own = weighted[:, :, :2, half]
        products = torch.matmul(own, images[:, :, :2, half].transpose(-2, -1)).flatten(-2)[..., [0, 1, 3]]
        sums.append(torch.cat([products, torch.matmul(own, change[..., half].transpose(-2, -1))[..., 0]], dim=-1))
    return torch.stack(sums, dim=-2).double() * both[..., None]


def _one_sided(length: int, like: Tensor) -> Tensor:
    """Weights (U,) that make a sum of products over the frequencies of ``rfft`` that over the pixels (Parseval)."""
    weight = torch.full((length // 2 + 1,), 2.0 / length, dtype=like.dtype, device=like.device)
    weight[0] *= 0.5
    if length % 2 == 0:
        weight[-1] *= 0.5
    return weight


def row_shifts(warped: Tensor, gradients: RowGradients, seen: Tensor) -> tuple[Tensor, Tensor]:
    """Normal equations of the displacement that every row still misses in each frame.

    Args:
        warped: (B, G, S, U) rows of a group of frames warped to the scene, from ``RowSpectra.warped``.
        gradients: Gradients of the scene, from this motion or one near to it.
        seen: (B, G, S) float64, 1 where a frame sees the row.

    Returns:
        Matrix (B, S, 2, 2) and right-hand sides (B, G, S, 2), axes (x, y), float64: their quotient is the displacement
        in px relative to the mean over the group, the matrix its inverse covariance in one frame. Both are 0 for rows
        that fewer than two frames see or that have no detail.
    """
    weighted = torch.view_as_real(gradients.spectra).flatten(-2)
    seen_by = torch.matmul(torch.view_as_real(warped).flatten(-2).transpose(1, 2), weighted.transpose(-2, -1))
    right = seen_by.transpose(1, 2).double()  # (B, G, S, 3)
    share = (seen / seen.sum(1, keepdim=True).clamp(min=1.0))[..., None]
    right = seen[..., None] * ((share * right).sum(1, keepdim=True) - right)
    products = gradients.products
    detail = products[..., 2, 2]
    safe = detail.clamp(min=1e-300)
    known = (detail > 0) & (gradients.variance > 0)
    # contrast that differs from frame to frame is taken out of the rows' say
    matrix = products[..., :2, :2] - products[..., :2, 2:] * products[..., 2:, :2] / safe[..., None, None]
    right = right[..., :2] - products[:, None, :, :2, 2] * (right[..., 2:] / safe[:, None, :, None])
    factor = torch.where(known, 1 / torch.where(known, gradients.variance, 1.0), 0.0)
    return matrix * factor[..., None, None], right * factor[:, None, :, None]
