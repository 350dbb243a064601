"""Pixels of frames: filling by local means, filters, the choice of columns with detail, and colour mosaics.

In a mosaic every pixel measures one colour, behind filters that repeat every two pixels.
"""

import math
from collections.abc import Sequence
from typing import get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from rsvib_torch.checks.values import check_choice
from rsvib_torch.options import Mosaic


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


def cut_parts(
    images: Tensor,
    members: Sequence[NDArray[np.int64]],
    tops: NDArray[np.int64],
    lefts: NDArray[np.int64],
    size: tuple[int, int],
) -> Tensor:
    """Parts (N, ..., h, w) of one size of some ``members`` (N,) of images, from row ``tops`` and column ``lefts`` on.

    Example:
        >>> images = torch.arange(12).view(2, 2, 3)
        >>> cut_parts(images, [np.array([0, 1])], np.array([0, 1]), np.array([0, 2]), (1, 1)).flatten().tolist()
        [0, 11]
    """
    # one strided view of each part, which takes a tenth of the time of an index
    strides, lead = images.stride(), len(members)
    steps = (*strides[:lead], *strides[-2:])
    firsts: list[int] = (np.stack([*members, tops, lefts], 1) @ np.array(steps)).tolist()
    shape, start = (*images.shape[lead:-2], *size), int(images.storage_offset())
    return torch.stack([images.as_strided(shape, strides[lead:], start + first) for first in firsts])


_LUMINANCE = (0.25, 0.5, 0.25)  # shares of red, green and blue in a mosaic


def check_mosaic(pattern: object, shape: tuple[int, ...], name: str = "frames") -> None:
    """Raise a ``ValueError`` unless frames (T, H, W) or (..., C, H, W) can be a mosaic of the pattern."""
    check_choice("mosaic", pattern, get_args(Mosaic))
    if len(shape) > 3 and shape[-3] != 1:
        raise ValueError(
            f"mosaic={pattern!r} is for raw frames (T, H, W) or (T, 1, H, W), but {name} have {shape[-3]} channels; "
            "omit mosaic for colour frames"
        )
    if shape[-2] % 2 or shape[-1] % 2:
        raise ValueError(
            f"mosaic={pattern!r} repeats every 2 x 2 px, but {name} have {shape[-2]} x {shape[-1]} px; cut them to "
            "even numbers of rows and columns"
        )


def colours_of(pattern: str, height: int, width: int) -> Tensor:
    """Colour of every pixel, (height, width) int64: 0 red, 1 green, 2 blue; of a pattern such as ``"RGGB"``.

    Example:
        >>> colours_of("RGGB", 2, 4).tolist()
        [[0, 1, 0, 1], [1, 2, 1, 2]]
    """
    tile = torch.tensor(["RGB".index(colour) for colour in pattern], device="cpu").view(2, 2)
    return tile.repeat(height // 2, width // 2)


def colour_frames(frames: Tensor, pattern: str) -> Tensor:
    """Frames (T, 3, H, W) from a mosaic (T, H, W) or (T, 1, H, W) by ``interpolated_colours``; NaN stays NaN."""
    mosaic = frames.unsqueeze(-3) if frames.ndim == 3 else frames
    missing = mosaic.isnan()
    colours = colours_of(pattern, *frames.shape[-2:]).to(frames.device).expand(mosaic.shape)
    filled = fill_by_colour(mosaic, missing) if bool(missing.any()) else mosaic
    return interpolated_colours(filled, colours).masked_fill(missing, torch.nan)


def measures(colours: Tensor) -> Tensor:
    """Mask (..., 3, H, W) of the colour that each pixel measures, from colours (..., 1, H, W)."""
    return colours == torch.arange(3, device=colours.device)[:, None, None]


def fill_by_colour(frames: Tensor, missing: Tensor) -> Tensor:
    """``fill_with_means`` of a mosaic (..., 1, H, W), separately for the four places of the pattern."""
    holes = functional.pixel_unshuffle(missing.to(frames.dtype), 2) > 0.5
    return functional.pixel_shuffle(fill_with_means(functional.pixel_unshuffle(frames, 2), holes), 2)


def are_mosaics(images: Tensor) -> Tensor:
    """``is_mosaic`` of images of which few are: a part of the pixels is enough to exclude most others."""
    mosaic = is_mosaic(images, blocks=32, least=1.5)
    return mosaic & is_mosaic(images) if bool(mosaic.any()) else mosaic


def is_mosaic(images: Tensor, *, blocks: int | None = None, least: float = 3.0) -> Tensor:
    """Whether images (B, H, W) are mosaics of colours: (B,) bool.

    Chequered differences of a mosaic have the same sign where the colour is the same. Their mean square over blocks of
    16 x 16 px, relative to that of a white spectrum near 1/2 cycle per px, is 7 to 35 in mosaics (three photographs,
    drawn scenes, one with a tenth of the colour) and at most 0.9 in grey images (nine photographs, drawn scenes,
    noise). Of many ``blocks`` along an axis, so many are used, evenly spread; None for all. With 32 the mean is within
    a fifth of that of all in mosaics of eight photographs of 1 to 22 Mpx, and at most 0.7 in the grey photographs, but
    0.3 to 4.6 instead of 0.7 in a resolution chart. These differences vanish where red and blue together are twice
    green: then columns and rows alternate alike, and the mean product of both, relative to a white spectrum, is 22 to
    93 in mosaics (three photographs, the chart) and at most 0.03 in grey images.
    """
    size = 16
    if min(images.shape[-2:]) < size + 2:
        return torch.zeros(len(images), dtype=torch.bool, device=images.device)
    rows, columns = (  # even steps, so that the colours of all blocks have the same places
        max(size, 0 if blocks is None else (length - 2) // blocks // 2 * 2) for length in images.shape[-2:]
    )
    parts = images.unfold(-2, size + 2, rows).unfold(-2, size + 2, columns)
    along_x, along_y = parts.diff(n=2, dim=-1), parts.diff(n=2, dim=-2)
    sign = 1 - 2 * (torch.arange(size, device=images.device) % 2)
    of_columns, of_rows, of_both = (
        (high.square().mean((-4, -3, -2, -1)), (high * pattern).mean((-2, -1)))
        for high, pattern in (
            (along_x[..., 1:-1, :], sign),
            (along_y[..., 1:-1], sign[:, None]),
            (along_x.diff(n=2, dim=-2), sign * sign[:, None]),
        )
    )

    def exceed(one: tuple[Tensor, Tensor], other: tuple[Tensor, Tensor], white: float) -> Tensor:
        """Whether means of blocks agree; ``white`` is their mean square in white noise, relative to its differences."""
        return (one[1] * other[1]).mean((-2, -1)).abs() > least * white * (one[0] * other[0]).sqrt()

    return exceed(of_both, of_both, (8 / 3 / size) ** 2) | exceed(of_columns, of_rows, 8 / 3 / size**2)


def mosaic_free(images: Tensor) -> Tensor:
    """Images (..., H, W) without what repeats every two pixels: binomial filter of nine pixels along both axes.

    In a mosaic the colours are modulated on 1/2 cycle per px along either axis and both; this pattern does not move
    with the scene. Detail of strong colour appears near these frequencies, and moves in other directions: of 28 axes of
    colourful scenes of 128 px, the rms error of the amplitude is 1.8, 1.1 and 0.9 standard deviations with five, seven
    and nine pixels, the largest 7.3, 3.3 and 2.3.
    """
    return smoothed(images, tuple(math.comb(8, place) / 2**8 for place in range(9)))


def luminance(colours: Tensor) -> Tensor:
    """Mean (..., 1, H, W) of colours (..., 3, H, W) with their shares in a mosaic."""
    return torch.einsum("c,...chw->...hw", colours.new_tensor(_LUMINANCE), colours).unsqueeze(-3)


def interpolated_colours(frames: Tensor, colours: Tensor) -> Tensor:
    """Colour images (..., 3, H, W) from a mosaic (..., 1, H, W) by linear filters.

    The differences of the colours from a smooth luminance are interpolated from the pixels of each colour; measured
    values are kept.
    """
    weights = (0.25, 0.5, 0.25)
    measured = measures(colours)
    difference = (frames - smoothed(frames, weights)) * measured
    difference = smoothed(difference, weights) / smoothed(measured.to(frames.dtype), weights).expand_as(difference)
    measured_difference = (difference * measured).sum(-3, keepdim=True)
    return frames - measured_difference + difference
