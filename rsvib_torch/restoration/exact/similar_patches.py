"""Colours of images from patches that resemble each other: a Gaussian model for each group of similar patches.

The patches x of a group have the mean m and the covariance C. Of each, the values y = A x + n are measured, those of
one colour per pixel or all, with noise of variance s^2. Expectation maximisation alternates between

    x = m + C A' (A C A' + s^2)^-1 (y - A m)

and the mean and covariance of the group, to which the covariance of the unknown part of x contributes. Patches of a
group lie at different places in the pattern of the colours, so that together they contain all colours
(Aguerrebere et al. 2017 for missing values, Lebrun et al. 2013 for noise).
"""

from itertools import product

import torch
from torch import Tensor
from torch.nn import functional

_PATCH = 4  # px; 3 px: -0.6 to -1.2 dB, 5 px: -0.3 to +0.1 dB in three times the time
_REACH = 7  # px to the patches that are compared; 10 px: -0.1 to +0.1 dB
_GROUP = 64  # patches; 48 or 96: -0.3 to +0.1 dB
# Variance that every patch has at least, in units of that of the images (1e-4: -0.1 to -0.5 dB), and of the sum of the
# variances of its group, for factors in single precision
_LEAST, _LEAST_OF_GROUP = 1e-5, 1e-6
_REFERENCES = 1024  # at a time: less memory


def similar_patches(
    images: Tensor, values: Tensor, measured: Tensor | None, level: Tensor | float, *, rounds: int, steps: int
) -> Tensor:
    """Colour images (N, C, H, W) whose groups of similar patches are Gaussian, from noisy or missing values.

    Groups are chosen again in each of the ``rounds``, from the images of the round before, and have ``steps`` of
    expectation maximisation. ``values`` have noise of standard deviation ``level``; the mask ``measured`` (C, H, W) has
    the same number at every pixel, and repeats every two rows and columns; None if all are measured.
    """
    if min(images.shape[-2:]) < _PATCH + _REACH:
        return images
    for _ in range(rounds):
        images = _round(images, values, measured, level, steps)
    return images


def _round(images: Tensor, values: Tensor, measured: Tensor | None, level: Tensor | float, steps: int) -> Tensor:
    """Images whose overlapping patches are the means of their posteriors in all groups that contain them."""
    # 1. All patches, as vectors (N patches, n), and the places of the pattern with the values measured at each.
    count, _, height, width = images.shape
    rows, columns = height - _PATCH + 1, width - _PATCH + 1  # of patches
    period = 1 if measured is None else 2
    patches, given = (functional.unfold(part, _PATCH).mT.flatten(0, 1) for part in (images.detach(), values))
    size = patches.shape[-1]
    if measured is None:
        known = torch.arange(size, device=images.device)[None]
    else:
        masks = functional.unfold(measured[None].to(images.dtype), _PATCH)[0].mT.unflatten(0, (rows, columns))
        known = masks[:period, :period].flatten(0, 1).nonzero()[:, 1].view(period**2, -1)
    first = torch.arange(count, device=images.device) * (rows * columns)
    least = (_LEAST * images.detach().var()).clamp(min=1e-20)  # of constant images 0
    # 2. The group of each reference patch, and the posterior of its patches; sums over the groups of a patch.
    total, weight = torch.zeros_like(patches), patches.new_zeros(len(patches))
    starts, places = _references(height, images.device), _references(width, images.device)
    for reference_rows in starts.split(max(1, _REFERENCES // (count * len(places)))):
        group = _similar(images.detach(), reference_rows, places, period)
        group = (group + first[:, None, None, None]).flatten(0, 1)  # (references, phases, patches)
        result = _posterior(patches[group], given[group], known, level, least, steps)
        total = total.index_add(0, group.flatten(), result.flatten(0, -2))
        weight += torch.bincount(group.flatten(), minlength=len(weight))

    # 3. Mean over the groups and over the patches that contain a pixel.
    def joined(parts: Tensor) -> Tensor:
        return functional.fold(parts.unflatten(0, (count, -1)).mT, (height, width), _PATCH)

    return joined(total) / joined(weight[:, None].expand(-1, size))


def _references(size: int, device: torch.device) -> Tensor:
    """First rows or columns of patches that cover ``size`` px, even if it is."""
    starts = torch.arange(0, size - _PATCH + 1, _PATCH, device=device)
    return starts if size % _PATCH == 0 else torch.cat([starts, starts.new_tensor([size - _PATCH])])


def _similar(images: Tensor, starts: Tensor, places: Tensor, period: int) -> Tensor:
    """Numbers (N, references, period^2, patches) of the patches nearest to those at rows and columns of references.

    Patches of each place in a pattern of a period are chosen separately.
    """
    # 1. The rows that contain the references, and the same with their surroundings, infinite outside of the image.
    height, width = images.shape[-2:]
    begin, end = int(starts[0]), int(starts[-1]) + _PATCH
    part = images[..., begin:end, :]
    ends = (max(0, begin - _REACH), min(height, end + _REACH))
    above, below = begin - ends[0], ends[1] - end
    wide = functional.pad(
        images[..., ends[0] : ends[1], :], (_REACH, _REACH, _REACH - above, _REACH - below), value=torch.inf
    )
    # 2. For each place in the pattern, the distances of the patches at all moves that lead to it, and the nearest ones.
    numbers = []
    for phase in product(range(period), repeat=2):
        moves = [
            move
            for move in product(range(-_REACH, _REACH + 1), repeat=2)
            if all((step - place) % period == 0 for step, place in zip(move, phase, strict=True))
        ]
        distances = []
        for down, right in moves:
            top, left = _REACH + down, _REACH + right
            moved = wide[..., top : top + part.shape[-2], left : left + width]
            difference = (moved - part).square().sum(-3)
            distance = functional.avg_pool2d(difference, _PATCH, stride=1)
            distances.append(distance[..., starts - begin, :][..., places].flatten(1))
        nearest = torch.stack(distances, -1).topk(_GROUP // period**2, dim=-1, largest=False).indices
        move = torch.tensor(moves, device=images.device)[nearest]  # (N, references, patches, 2)
        base = torch.cartesian_prod(starts, places)
        place = base[:, None] + move
        numbers.append(place[..., 0] * (width - _PATCH + 1) + place[..., 1])
    return torch.stack(numbers, dim=2)


def _posterior(
    patches: Tensor, values: Tensor, known: Tensor, level: Tensor | float, least: Tensor, steps: int
) -> Tensor:
    """Patches (G, Q, k, n) of G groups, of which the values ``known`` (Q, m) are measured at each place Q."""
    groups, phases, count, size = patches.shape
    values = values.gather(-1, known[:, None].expand(groups, phases, count, -1))
    unknown = patches.new_zeros(size, size)
    result = patches
    for step in range(steps):
        mean, covariance, factor, gain = _model(result, unknown, known, level, least)
        with torch.set_grad_enabled(torch.is_grad_enabled() and step == steps - 1):
            innovation = (values - mean[:, known][:, :, None]).mT
            innovation = torch.linalg.solve_triangular(factor, innovation, upper=False)
            result = mean[:, None, None] + innovation.mT @ gain
        rows = gain.flatten(1, 2)
        unknown = covariance - rows.mT @ rows / phases
    return result


@torch.no_grad()
def _model(
    patches: Tensor, unknown: Tensor, known: Tensor, level: Tensor | float, least: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Mean (G, n) and covariance C (G, n, n) of groups, L of A C A' + s^2 = L L' and L^-1 A C for each place."""
    groups, phases, count, _ = patches.shape
    mean = patches.mean((1, 2))
    deviation = (patches - mean[:, None, None]).flatten(1, 2)
    covariance = deviation.mT @ deviation / (phases * count) + unknown
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    variance.add_(least + _LEAST_OF_GROUP * variance.sum(-1, keepdim=True))
    rows = covariance[:, known]  # (G, Q, m, n)
    square = rows.gather(-1, known[:, None].expand(groups, phases, known.shape[-1], -1))
    square.diagonal(dim1=-2, dim2=-1).add_(level**2)
    factor = torch.linalg.cholesky(square)
    return mean, covariance, factor, torch.linalg.solve_triangular(factor, rows, upper=False)
