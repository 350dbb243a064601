"""Filling of missing pixels by local means, and the choice of columns with detail."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional


def fill_with_means(frames: Tensor, missing: Tensor) -> Tensor:
    """Replace missing pixels (..., H, W) by local means of the measured pixels.

    A pixel without a measured neighbour is interpolated between means of squares of 2, 4, 8, ... px, the smallest that
    contain measured pixels (pull-push algorithm, Gortler et al. 1996). Values of missing pixels are not used.

    Example:
        >>> frames = torch.tensor([[[1.0, 9.0, 3.0]]])
        >>> fill_with_means(frames, torch.tensor([[[False, True, False]]])).tolist()
        [[[1.0, 2.0, 3.0]]]
    """

    def filled(sums: Tensor, weights: Tensor) -> Tensor:
        around = (functional.avg_pool2d(values, 3, 1, 1) for values in (sums, weights))
        sums, weights = (torch.where(weights > 0, *pair) for pair in zip((sums, weights), around, strict=True))
        known, means = weights > 0, sums / weights.clamp(min=1e-30)
        if max(sums.shape[-2:]) == 1 or bool(known.all()):
            return means
        coarse = filled(*(functional.avg_pool2d(values, 2, ceil_mode=True) for values in (sums, weights)))
        return torch.where(known, means, functional.interpolate(coarse, sums.shape[-2:], mode="bilinear"))

    images, holes = frames.flatten(0, -3)[:, None], missing.flatten(0, -3)[:, None]
    result = filled(images.masked_fill(holes, 0.0), (~holes).to(frames.dtype))
    return torch.where(missing, result[:, 0].unflatten(0, frames.shape[:-2]), frames)


def enlarged(images: Tensor, scale: int) -> Tensor:
    """Images (..., H, W) on a grid of half pixels for ``scale=2``: pixel (i, j) becomes (2 i, 2 j).

    Cubic convolution between the pixels (Keys 1981); for ``scale=1`` the images.

    Example:
        >>> enlarged(torch.tensor([[[1.0, 2.0, 3.0, 4.0, 5.0]]]), 2)[0, 0, 2:8].tolist()
        [2.0, 2.5, 3.0, 3.5, 4.0, 4.5625]
    """
    if scale == 1:
        return images
    for _ in range(2):  # along the last axis, then along the other one
        count = images.shape[-1]
        place = torch.arange(-1, count + 2, device=images.device).clamp(0, count - 1)
        a, b, c, d = (images[..., place[first : first + count]] for first in range(4))
        between = (9 * (b + c) - (a + d)) / 16
        images = torch.stack([images, between], dim=-1).flatten(-2).transpose(-2, -1)
    return images


def smoothed(images: Tensor, weights: Sequence[float]) -> Tensor:
    """Images (..., H, W) after a filter of odd length along both axes, with mirrored boundaries.

    Sums of shifted images take half to a tenth of the time of ``conv2d``.
    """
    half = len(weights) // 2
    result = functional.pad(images.reshape(-1, *images.shape[-2:]), (half,) * 4, mode="reflect")
    for dim in (-1, -2):
        first, *others = (result.narrow(dim, lag, images.shape[dim]) for lag in range(len(weights)))
        result = first * weights[0]
        for shifted, weight in zip(others, weights[1:], strict=True):
            result.add_(shifted, alpha=weight)
    return result.view(images.shape)


def detailed_parts(images: Tensor, count: int) -> list[slice]:
    """The ``count`` neighbouring columns of each stack whose squared row differences in the first frame are largest.

    ``images`` are stacks (B, T, ..., H, W).

    Example:
        >>> image = torch.zeros(16, 12)
        >>> image[::2, 5:9] = 1
        >>> detailed_parts(image[None, None], 4)
        [slice(5, 9, None)]
    """
    width = images.shape[-1]
    if width <= count:
        return [slice(0, width)] * len(images)
    rows = slice(0, None, 4)  # a quarter of the rows is a sufficient sample
    first = images[:, 0]
    detail = (first[..., 1:, :][..., rows, :] - first[..., :-1, :][..., rows, :]).square()
    total = functional.pad(detail.flatten(1, -2).sum(1).to(torch.float64).cumsum(1), (1, 0))
    starts = (total[:, count:] - total[:, :-count]).argmax(1).tolist()
    return [slice(start, start + count) for start in starts]


def cut_columns(values: Tensor, parts: list[slice]) -> Tensor:
    """Columns of each stack (B, ..., W), equally many of all stacks."""
    return torch.stack([stack[..., part] for stack, part in zip(values, parts, strict=True)])


def cut_parts(images: Tensor, tops: Sequence[int], lefts: Sequence[int], size: tuple[int, int]) -> Tensor:
    """Parts (B, ..., h, w) of one size of images (B, ..., H, W), from row ``tops[b]`` and column ``lefts[b]`` on.

    Example:
        >>> cut_parts(torch.arange(12).view(2, 2, 3), [0, 1], [0, 2], (1, 1)).flatten().tolist()
        [0, 11]
    """
    height, width = size
    if len({*zip(tops, lefts, strict=True)}) == 1:
        return images[..., tops[0] : tops[0] + height, lefts[0] : lefts[0] + width]
    flat = images.flatten(1, -3) if images.ndim > 3 else images[:, None]
    stack, plane = (torch.arange(extent, device=images.device) for extent in flat.shape[:2])
    first = torch.tensor([tops, lefts], device=images.device)[..., None]
    rows, columns = (
        start + torch.arange(extent, device=images.device) for start, extent in zip(first, size, strict=True)
    )
    parts = flat[stack[:, None, None, None], plane[:, None, None], rows[:, None, :, None], columns[:, None, None]]
    return parts.view(*images.shape[:-2], height, width)
