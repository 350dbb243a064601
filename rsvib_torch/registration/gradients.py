"""What every scene row tells of its place in each frame, once the frames are warped back by a known motion.

With s the scene and d the displacement that is still missing in a frame, the frame less the scene is ``-s' d`` plus
noise. The scene itself is unknown; the mean of the warped frames stands for it, and its gradient, cleaned by a Wiener
filter, weighs what remains: ``H = sum w g g^T`` and ``b = -sum w g e`` per row. Noise of the mean and noise of the
differences from it are independent, so that the sums have no bias from it, and the filter keeps them near the
Cramer-Rao bound.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.registration.row_spectra import RowSpectra, chunks, inner_columns, mean_over_frames
from rsvib_torch.registration.scene_detail import scene_detail

__all__ = ["RowGradients", "row_gradients", "row_shifts"]

_BLOCK = 16  # px, side of the blocks that are judged together
_LARGEST_NOISE = 9.0  # mean square of a block over the typical one before it loses weight
_LARGEST_SHIFT = 0.15  # px, part of a block's residual that the gradient excuses


@dataclass(frozen=True, eq=False)
class RowGradients:
    """Gradients of the scene as seen by the rows of a group of frames, ready to weigh residuals.

    Attributes:
        spectra: (B, S, 3, U) one-sided transforms, over their length, of weight times gradient along x, along y, and
            detail of the scene; what has no partner is halved.
        products: (B, S, 3, 3) float64 sums of their products; detail takes out changes of contrast.
        variance: (B, S) float64, noise variance of a pixel in a frame.
        halves: (B, S, 2, 5) float64, sums gx gx, gx gy, gy gy, gx e and gy e over the left and the right half of each
            row, with e what is left between the outer frames: halves that move apart are no vibration.
    """

    spectra: Tensor
    products: Tensor
    variance: Tensor
    halves: Tensor


@dataclass(frozen=True, eq=False)
class _Rows:
    """Some rows of the scene as pixels.

    Attributes:
        images: (B, s, 3, L) gradients along x and y, detail.
        residual: (B, s, G, L) what the frames differ by from their mean; of two frames the first alone, (B, s, 1, L),
            since the other differs by the opposite.
        weight: (B, s, L) of the pixels.
        seen: (B, G, s), 1 where a frame sees the row.
    """

    images: Tensor
    residual: Tensor
    weight: Tensor
    seen: Tensor


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
    length, width = spectra.length, spectra.width
    detail, across = scene_detail(warped, seen, spectra.frequencies)
    along = (2j * math.pi * spectra.frequencies).to(warped.dtype)
    inner = functional.pad(inner_columns(width, shift, warped.real), (0, length - width))
    valid = spectra.warped_valid(rows, shift)

    def pixels(part: slice) -> _Rows:
        own = detail[:, part]
        images = torch.fft.irfft(torch.stack([own * along, across[:, part], own], dim=2), n=length)
        visible = seen[:, :, part]
        frames = slice(1) if seen.shape[1] == 2 else slice(None)
        mean = mean_over_frames(warped[:, :, part], visible)
        difference = (warped[:, frames, part] - mean[:, None]).transpose(1, 2)
        residual = torch.fft.irfft(difference, n=length)
        residual *= visible[:, frames].transpose(1, 2)[..., None].to(residual.dtype)
        weight = inner * (visible.sum(1) > 1)[..., None].to(inner.dtype)
        if valid is not None:
            weight = weight * functional.pad(valid[:, part], (0, length - width))
        return _Rows(images, residual, weight, visible)

    parts = chunks(rows.shape[-1], 4 * length * len(rows) * (8 + 2 * rows.shape[1]), _BLOCK, rows.device)
    # written where they belong: memory for so much takes as long as the transforms
    transforms = warped.new_empty(*detail.shape[:2], 3, detail.shape[-1])
    results, energies = [], []
    for part in parts:
        some = pixels(part)
        found, energy = _explained_rows(some, spectra, transforms[:, part])
        results.append(found)
        energies.append(_blocks_of(some, energy))
    trust = _trust(*(torch.cat(values, 1) for values in zip(*energies, strict=True)))
    for place, part in enumerate(parts):
        own = trust[:, part.start // _BLOCK : -(-part.stop // _BLOCK)]
        if bool((own < 1).any()):
            some = pixels(part)
            spread = own.repeat_interleave(_BLOCK, 1).repeat_interleave(_BLOCK, 2)
            weight = some.weight * spread[:, : some.weight.shape[1], :length]
            results[place], _ = _explained_rows(replace(some, weight=weight), spectra, transforms[:, part])
    return RowGradients(transforms, *(torch.cat(values, 1) for values in zip(*results, strict=True)))


def _explained_rows(rows: _Rows, spectra: RowSpectra, out: Tensor) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    """What ``RowGradients`` tell of some rows, and the energy (B, s, L) that brightness, contrast and a shift leave.

    Args:
        rows: The rows.
        spectra: Of the frames.
        out: (B, s, 3, U) for the transforms of their images; products, variance and halves are returned.
    """
    weighted, left, products, pull = _explain(rows.images, rows.residual, rows.weight)
    spare = (rows.seen.sum(1) - 1).clamp(min=1.0)
    copies = rows.seen.shape[1] / left.shape[2]
    energy = left.square().sum(2) * copies
    square = (energy * rows.weight).sum(-1).double()
    variance = square / ((products[..., 3, 3] - 4).clamp(min=1.0) * spare)
    mean_images = products[..., :3, 3:] / products[..., 3:, 3:].clamp(min=1e-6)
    halves = _halves(weighted, rows, left, (products, pull), spectra.width // 2)
    centred = weighted.addcmul_(rows.weight[:, :, None], mean_images.to(rows.weight.dtype), value=-1)
    torch.fft.rfft(centred, norm="forward", out=out)
    _one_sided(out, spectra.length)
    centred_products = products[..., :3, :3] - mean_images * products[..., 3:, :3]
    return (centred_products, variance, halves), energy / spare[..., None].to(energy.dtype)


def _explain(images: Tensor, residual: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Take out of each row what brightness, contrast and a shift of it explain.

    Args:
        images: (B, S, 3, W) gradients along x and y, detail.
        residual: (B, S, G or 1, W).
        weight: (B, S, W).

    Returns:
        Weighted images, what is left of the residual, the products (B, S, 4, 4) of the images and ones, and those
        (B, S, G or 1, 4) with what is left; products in float64.
    """
    weighted = images * weight[:, :, None]
    products = weight.new_empty(*weight.shape[:2], 4, 4, dtype=torch.float64)
    products[..., :3, :3] = torch.matmul(weighted, images.transpose(-2, -1))
    products[..., :3, 3] = products[..., 3, :3] = weighted.sum(-1)
    products[..., 3, 3] = weight.sum(-1)
    with_ones = torch.matmul(residual, weight[..., None])
    right = torch.cat([torch.matmul(residual, weighted.transpose(-2, -1)), with_ones], dim=-1).double()
    known = (products.diagonal(dim1=-2, dim2=-1) > 0).all(-1)[..., None]
    scale = torch.where(known, products.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt(), 0.0)
    eye = torch.eye(4, dtype=scale.dtype, device=scale.device)
    unit = products * scale[..., :, None] * scale[..., None, :] + torch.where(known, 1e-6, 1.0)[..., None] * eye
    solution = torch.linalg.solve(unit, (right * scale[..., None, :]).transpose(-2, -1)).transpose(-2, -1)
    solution = solution * scale[..., None, :]
    explained = solution.to(images.dtype)
    left = torch.matmul(explained[..., :3], images).add_(explained[..., 3:])
    return weighted, torch.sub(residual, left, out=left), products, right - solution @ products


def _blocks_of(rows: _Rows, energy: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Means over blocks of what is left of some rows, of the square of their gradient, and of what counts."""
    used = (rows.weight > 0).to(energy.dtype)
    slope = rows.images[:, :, :2].square().sum(2)
    values = torch.stack([energy * used, slope * used, used], dim=1)
    mean, slope, share = functional.avg_pool2d(values, _BLOCK, ceil_mode=True).unbind(1)
    return mean, slope, share


def _trust(energy: Tensor, slope: Tensor, share: Tensor) -> Tensor:
    """Weight in 0 ... 1 of blocks whose residual neither noise nor a small shift explains.

    Things that move by themselves, clouds and parallax leave such blocks.
    """
    used = share > 0
    mean, slope = energy / share.clamp(min=1e-6), slope / share.clamp(min=1e-6)
    typical = torch.where(used, mean, torch.nan).flatten(1).nanmedian(1).values[:, None, None]
    ratio = mean / (_LARGEST_NOISE * typical + _LARGEST_SHIFT**2 * slope).clamp(min=1e-30)
    return 1 / (1 + (ratio - 1).clamp(min=0.0).square())


def _halves(weighted: Tensor, rows: _Rows, left: Tensor, whole: tuple[Tensor, Tensor], middle: int) -> Tensor:
    """Sums over the halves of each row, as in ``RowGradients.halves``.

    Args:
        weighted: (B, S, 3, W) images.
        rows: What they belong to.
        left: What is left of the residual.
        whole: Products of the images, and with what is left, over all columns.
        middle: Column where the right half begins.
    """
    of_left, of_images = left[..., :middle].transpose(-2, -1), rows.images[:, :, :2, :middle].transpose(-2, -1)
    own = weighted[:, :, :2, :middle]
    sums = []
    for products, pulls in (
        (torch.matmul(own, of_images).double(), torch.matmul(own, of_left).double()),
        (whole[0][..., :2, :2], whole[1][..., :2].transpose(-2, -1)),
    ):
        change = pulls[..., -1] - pulls[..., 0] if pulls.shape[-1] > 1 else -2 * pulls[..., 0]
        sums.append(torch.cat([products.flatten(-2)[..., [0, 1, 3]], change], dim=-1))
    both = (rows.seen[:, 0] * rows.seen[:, -1])[..., None, None]
    return torch.stack([sums[0], sums[1] - sums[0]], dim=-2) * both


def _one_sided(spectra: Tensor, length: int) -> Tensor:
    """Spectra (..., U) of length L, of which products summed over all frequencies are half those of the pixels.

    Frequency 0, and the highest of an even length, have no partner (Parseval).
    """
    spectra[..., 0] *= 0.5
    if length % 2 == 0:
        spectra[..., -1] *= 0.5
    return spectra


def row_shifts(warped: Iterable[Tensor], gradients: RowGradients, seen: Tensor) -> tuple[Tensor, Tensor]:
    """Normal equations of the displacement that every row still misses in each frame.

    Args:
        warped: Rows (B, G, s, U) of a group of frames warped to the scene, from ``RowSpectra.warped``: S rows in all,
            one run of them after the other.
        gradients: Gradients of the scene, from this motion or one near to it.
        seen: (B, G, S) float64, 1 where a frame sees the row.

    Returns:
        Matrix (B, S, 2, 2) and right-hand sides (B, G, S, 2), axes (x, y), float64: their quotient is the displacement
        in px relative to the mean over the group, the matrix its inverse covariance in one frame. Both are 0 for rows
        that fewer than two frames see or that have no detail.
    """
    weighted, parts, first = torch.view_as_real(gradients.spectra).flatten(-2), [], 0
    for run in warped:
        own = weighted[:, first : first + run.shape[2]]
        parts.append(torch.matmul(torch.view_as_real(run).flatten(-2).transpose(1, 2), own.transpose(-2, -1)))
        first += run.shape[2]
    right = 2.0 * torch.cat(parts, 1).transpose(1, 2).double()  # (B, G, S, 3)
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
