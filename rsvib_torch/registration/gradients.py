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

from rsvib_torch.registration.row_spectra import RowSpectra, chunks, differences, inner_columns
from rsvib_torch.registration.scene_detail import Compared, scene_detail

__all__ = ["RowGradients", "row_gradients", "row_pulls", "row_shifts"]

_BLOCK = 16  # px, side of the blocks that are judged together
_LARGEST_NOISE = 9.0  # mean square of a block over the typical one before it loses weight
_LARGEST_SHIFT = 0.15  # px, part of a block's residual that the gradient excuses


@dataclass(frozen=True, eq=False)
class RowGradients:
    """Gradients of the scene as seen by the rows of a group of frames, ready to weigh residuals.

    Attributes:
        images: (B, S, 3, L) weight times gradient along x, along y, and detail of the scene, without their means.
        products: (B, S, 3, 3) float64 sums of their products; detail takes out changes of contrast.
        pulls: (B, S, 3, G) float64 sums of their products with what the frames differ by that they were taken from; of
            two frames (B, S, 3, 1), from the first.
        variance: (B, S) float64, noise variance of a pixel in a frame.
        halves: (B, S, 2, 5) float64, sums gx gx, gx gy, gy gy, gx e and gy e over the left and the right half of each
            row, with e what is left between the outer frames: halves that move apart are no vibration.
    """

    images: Tensor
    products: Tensor
    pulls: Tensor
    variance: Tensor
    halves: Tensor


@dataclass(frozen=True, eq=False)
class _Rows:
    """Some rows of the scene as pixels.

    Attributes:
        planes: (B, s, 3 + G, L) gradients along x and y, detail, and what the frames differ by (``differences``).
        weight: (B, s, L) of the pixels.
        seen: (B, G, s), 1 where a frame sees the row.
    """

    planes: Tensor
    weight: Tensor
    seen: Tensor

    @property
    def images(self) -> Tensor:
        """Gradients along x and y, detail."""
        return self.planes[:, :, :3]

    @property
    def residual(self) -> Tensor:
        """What the frames differ by."""
        return self.planes[:, :, 3:]


def row_gradients(
    spectra: RowSpectra, warped: Iterable[tuple[slice, Tensor]], rows: Tensor, shift: Tensor, seen: Tensor
) -> RowGradients:
    """Gradients of the scene, its noise, and the weight of every pixel, from frames warped by a motion.

    Args:
        spectra: The frames of a group.
        warped: Runs of the S rows of the scene with the frames warped to them, (B, G, s, U) from ``RowSpectra.warped``.
        rows: (B, G, S) frame rows that show the S scene rows, in each frame.
        shift: (B, G, S) px, displacement along the rows to be taken out of each.
        seen: (B, G, S) float64, 1 where a frame sees the row.

    Returns:
        The gradients.
    """
    length, width = spectra.length, spectra.width
    compared = Compared.of(warped, seen)
    detail, across = scene_detail(compared, spectra.frequencies)
    along = (2j * math.pi * spectra.frequencies).to(detail.dtype)
    inner = functional.pad(inner_columns(width, shift, detail.real), (0, length - width))
    valid = spectra.warped_valid(rows, shift)
    parts = chunks(rows.shape[-1], 4 * length * len(rows) * (4 + rows.shape[1]), _BLOCK, rows.device)
    memory = inner.new_empty(len(rows), parts[0].stop, 3 + (1 if rows.shape[1] == 2 else rows.shape[1]), length)

    def pixels(part: slice) -> _Rows:
        own, visible = detail[:, part].contiguous(), seen[:, :, part]
        spectra = [own * along, across[:, part], own, *compared.differences[:, :, part].unbind(1)]
        planes = memory[:, : own.shape[1]]
        for place, one in enumerate(spectra):
            planes[:, :, place] = torch.fft.irfft(one, n=length)
        weight = inner * (visible.sum(1) > 1)[..., None].to(inner.dtype)
        if valid is not None:
            weight = weight * functional.pad(valid[:, part], (0, length - width))
        return _Rows(planes, weight, visible)

    images = inner.new_empty(len(rows), rows.shape[-1], 3, length)
    results, energies = [], []
    for part in parts:
        some = pixels(part)
        found, blocks = _explained_rows(some, width // 2, images[:, part])
        results.append(found)
        energies.append(blocks)
    trust = _trust(*(torch.cat(values, 1) for values in zip(*energies, strict=True)))
    doubtful = (trust < 1).any(-1).any(0).tolist()
    for place, part in enumerate(parts):
        within = slice(part.start // _BLOCK, -(-part.stop // _BLOCK))
        if any(doubtful[within]):
            some = pixels(part)
            spread = trust[:, within].repeat_interleave(_BLOCK, 1).repeat_interleave(_BLOCK, 2)
            weight = some.weight * spread[:, : some.weight.shape[1], :length]
            results[place], _ = _explained_rows(replace(some, weight=weight), width // 2, images[:, part])
    sums, solution, square = (torch.cat(values, 1) for values in zip(*results, strict=True))
    products, right = _products(sums.sum(2))
    means = _means(products)
    return RowGradients(
        images,
        products=products[..., :3, :3] - means * products[..., 3:, :3],
        pulls=right[..., :3, :] - means * right[..., 3:, :],
        variance=square / (products[..., 3, 3] - 4).clamp(min=1.0),
        halves=_halves(sums, solution, seen),
    )


def _explained_rows(rows: _Rows, middle: int, out: Tensor) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """What some rows tell.

    Args:
        rows: The rows.
        middle: Column where the right half begins.
        out: (B, s, 3, L) for the images of ``RowGradients``.

    Returns:
        Products from ``_sums_of_halves``, the factors that explain the rows, and the weighted sum (B, s) of the squares
        of what is left, in one frame; and what ``_trust`` asks for.
    """
    weighted = torch.mul(rows.images, rows.weight[:, :, None], out=out)
    sums = _sums_of_halves(weighted, rows, middle)
    products, right = _products(sums.sum(2))
    solution = _explanation(products, right.transpose(-2, -1))
    factors = solution.to(weighted.dtype)
    explained = torch.matmul(factors[..., :3], rows.images).add_(factors[..., 3:])
    energy = torch.sub(rows.residual, explained, out=explained).square_().sum(2) * rows.weight
    spare = (rows.seen.sum(1) - 1).clamp(min=1.0) * (explained.shape[2] / rows.seen.shape[1])
    energy /= spare[..., None].to(energy.dtype)
    slope = (weighted[:, :, 0] * rows.planes[:, :, 0]).addcmul_(weighted[:, :, 1], rows.planes[:, :, 1])
    blocks = _sum_of_blocks(energy), _sum_of_blocks(slope), _sum_of_blocks(rows.weight)
    means = _means(products).to(weighted.dtype)
    for image, mean, weight in zip(weighted, means, rows.weight, strict=True):
        # as a product of matrices: several times faster than with a factor for each row
        image.baddbmm_(mean, weight[:, None], alpha=-1)
    return (sums, solution, energy.sum(-1).double()), blocks


def _products(sums: Tensor) -> tuple[Tensor, Tensor]:
    """Products (B, s, 4, 4) of images and ones, and (B, s, 4, G) with what the frames differ by, of whole rows."""
    return torch.cat([sums[..., :3], sums[..., -1:]], -1), sums[..., 3:-1]


def _means(products: Tensor) -> Tensor:
    """Weighted means (B, s, 3, 1) of the images."""
    means: Tensor = products[..., :3, 3:] / products[..., 3:, 3:].clamp(min=1e-6)
    return means


def _sums_of_halves(weighted: Tensor, rows: _Rows, middle: int) -> Tensor:
    """Products (B, s, 2, 4, 4 + G) float64 over both halves of each row of weighted images and ones.

    Those with the images, with what the frames differ by, and with ones.

    Args:
        weighted: (B, s, 3, L) images.
        rows: What they belong to.
        middle: Column where the right half begins.
    """
    sums = weighted.new_empty(*weighted.shape[:2], 2, 4, 1 + rows.planes.shape[2], dtype=torch.float64)
    for half, columns in enumerate((slice(0, middle), slice(middle, None))):
        images, weight = weighted[..., columns], rows.weight[..., columns]
        seen = rows.planes[..., columns].transpose(-2, -1)
        own = sums[:, :, half]
        own[..., :3, :-1] = torch.matmul(images, seen)
        own[..., 3:, :-1] = torch.matmul(weight[:, :, None], seen)
        own[..., :3, -1] = own[..., 3, :3]
        own[..., 3, -1] = weight.sum(-1)
    return sums


def _explanation(products: Tensor, right: Tensor) -> Tensor:
    """Factors (B, s, G, 4) of images and ones that explain most of what the frames differ by.

    Args:
        products: (B, s, 4, 4) of the images and ones.
        right: (B, s, G, 4) of what the frames differ by with them.
    """
    known = (products.diagonal(dim1=-2, dim2=-1) > 0).all(-1)[..., None]
    scale = torch.where(known, products.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt(), 0.0)
    eye = torch.eye(4, dtype=scale.dtype, device=scale.device)
    unit = products * scale[..., :, None] * scale[..., None, :] + torch.where(known, 1e-6, 1.0)[..., None] * eye
    solution = torch.linalg.solve(unit, (right * scale[..., None, :]).transpose(-2, -1)).transpose(-2, -1)
    factors: Tensor = solution * scale[..., None, :]
    return factors


def _sum_of_blocks(values: Tensor) -> Tensor:
    """Sums (B, N, M) over blocks of values (B, s, L); the last ones of either axis may be smaller."""
    rows, columns = values.shape[1:]
    rest = -rows % _BLOCK, -columns % _BLOCK
    if rest[0]:
        values = functional.pad(values, (0, 0, 0, rest[0]))
    strips = values.unflatten(1, (-1, _BLOCK)).sum(2)
    sums: Tensor = functional.pad(strips, (0, rest[1])).unflatten(2, (-1, _BLOCK)).sum(3)
    return sums


def _trust(energy: Tensor, slope: Tensor, share: Tensor) -> Tensor:
    """Weight in 0 ... 1 of blocks whose residual neither noise nor a small shift explains.

    Things that move by themselves, clouds and parallax leave such blocks.

    Args:
        energy: (B, N, M) weighted sum over each block of what is left.
        slope: The same of the square of the gradient.
        share: Sum of the weights.
    """
    used = share > 0
    mean, slope = energy / share.clamp(min=1e-6), slope / share.clamp(min=1e-6)
    typical = torch.where(used, mean, torch.nan).flatten(1).nanmedian(1).values[:, None, None]
    ratio = mean / (_LARGEST_NOISE * typical + _LARGEST_SHIFT**2 * slope).clamp(min=1e-30)
    return 1 / (1 + (ratio - 1).clamp(min=0.0).square())


def _halves(sums: Tensor, solution: Tensor, seen: Tensor) -> Tensor:
    """Sums over the halves of each row, as in ``RowGradients.halves``.

    Args:
        sums: From ``_sums_of_halves``.
        solution: (B, s, G, 4) what explains the rows.
        seen: (B, G, S), 1 where a frame sees the row.
    """
    images, ones = solution[:, :, None].transpose(-2, -1).split((3, 1), dim=-2)
    pulls = sums[..., :2, 3:-1] - sums[..., :2, :3] @ images - sums[..., :2, -1:] @ ones  # (B, s, 2, 2, G)
    change = pulls[..., -1] - pulls[..., 0] if pulls.shape[-1] > 1 else -2 * pulls[..., 0]
    own = torch.stack([sums[..., 0, 0], sums[..., 0, 1], sums[..., 1, 1]], dim=-1)
    return torch.cat([own, change], dim=-1) * (seen[:, 0] * seen[:, -1])[..., None, None]


def row_pulls(warped: Iterable[tuple[slice, Tensor]], gradients: RowGradients, seen: Tensor) -> Tensor:
    """Products (B, S, 3, G) of gradients with what frames differ by, as ``RowGradients.pulls``.

    Args:
        warped: As in ``row_gradients``, one run after the other.
        gradients: Gradients of the scene, from a motion near to that of the rows.
        seen: (B, G, S) float64, 1 where a frame sees the row.
    """
    length, parts = gradients.images.shape[-1], []
    for part, run in warped:
        left = torch.fft.irfft(differences(run, seen[:, :, part]).transpose(1, 2), n=length)
        parts.append(torch.matmul(gradients.images[:, part], left.transpose(-2, -1)))
    return torch.cat(parts, 1).double()


def row_shifts(pulls: Tensor, gradients: RowGradients, seen: Tensor) -> tuple[Tensor, Tensor]:
    """Normal equations of the displacement that every row still misses in each frame.

    Args:
        pulls: Those of the gradients, or from ``row_pulls``.
        gradients: Gradients of the scene.
        seen: (B, G, S) float64, 1 where a frame sees the row.

    Returns:
        Matrix (B, S, 2, 2) and right-hand sides (B, G, S, 2), axes (x, y), float64: their quotient is the displacement
        in px relative to the mean over the group, the matrix its inverse covariance in one frame. Both are 0 for rows
        that fewer than two frames see or that have no detail.
    """
    right = -(torch.cat([pulls, -pulls], -1) if seen.shape[1] == 2 else pulls).permute(0, 3, 1, 2)  # (B, G, S, 3)
    products = gradients.products
    detail = products[..., 2, 2]
    safe = detail.clamp(min=1e-300)
    known = (detail > 0) & (gradients.variance > 0)
    # contrast that differs from frame to frame is taken out of the rows' say
    matrix = products[..., :2, :2] - products[..., :2, 2:] * products[..., 2:, :2] / safe[..., None, None]
    right = right[..., :2] - products[:, None, :, :2, 2] * (right[..., 2:] / safe[:, None, :, None])
    factor = torch.where(known, 1 / torch.where(known, gradients.variance, 1.0), 0.0)
    return matrix * factor[..., None, None], right * factor[:, None, :, None]
