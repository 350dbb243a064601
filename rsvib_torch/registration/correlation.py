"""Zero-mean normalised cross-correlation of bands by matrix products."""

import torch
from torch import Tensor

from rsvib_torch.registration.band_windows import take_windows

__all__ = ["correlate_bands", "correlate_profiles"]

_ROWS = 8  # of templates that are multiplied at a time: of more, most products are of rows that no lag brings together


def correlate_bands(
    first: Tensor,
    second: Tensor,
    places: Tensor,
    later_places: Tensor,
    *,
    size: tuple[int, int],
    reach: tuple[int, int],
) -> Tensor:
    """Zero-mean normalised cross-correlation of windows of one image with windows of another, at all lags.

    For one lag along the columns, the lags along the rows are the diagonal sums of the product of template and search
    rows: matrix products do the work. Means and energies of the search windows come from running sums.

    Args:
        first: (L, H, W) images the templates are cut from, roughly of zero mean.
        second: (L, H, V) images they are looked for in.
        places: (L, N, 2) int64, column and row of the first pixel of each template.
        later_places: (L, N, 2) int64, the same of its window at lag zero.
        size: Rows and columns of a template.
        reach: Lags along rows' axis and columns: -reach ... reach.

    Returns:
        (L, N, 2 reach[0] + 1, 2 reach[1] + 1) in -1 ... 1; 0 where a window is constant or leaves the image.
    """
    height, width = size
    template = take_windows(first, places[..., 1], places[..., 0], height, width).flatten(0, 1)
    search = take_windows(
        second,
        later_places[..., 1] - reach[0],
        later_places[..., 0] - reach[1],
        height + 2 * reach[0],
        width + 2 * reach[1],
    ).flatten(0, 1)
    lags_y, lags_x = 2 * reach[0] + 1, 2 * reach[1] + 1
    cross = template.new_zeros(len(template), lags_y, lags_x)
    for top in range(0, height, _ROWS):
        rows = template[:, top : top + _ROWS]
        own = search[:, top : top + rows.shape[1] + lags_y - 1]
        for lag in range(lags_x):
            product = rows @ own[..., lag : lag + width].transpose(-2, -1)  # (M, h, h + 2 reach)
            diagonals = product.as_strided(
                (len(product), rows.shape[1], lags_y), (product.stride(0), product.stride(1) + 1, 1)
            )
            cross[..., lag] += diagonals.sum(1)
    cross = cross.unflatten(0, places.shape[:2])

    total, energy = _window_sums(second, later_places, size, reach)
    template_total, template_energy = _window_sums(first, places, size, (0, 0))
    pixels = height * width
    cross = cross - template_total * total / pixels
    energy = energy - total.square() / pixels
    template_energy = template_energy - template_total.square() / pixels
    return _normalise(cross, energy, template_energy, pixels * second.square().mean((-2, -1))[:, None, None, None])


def _normalise(cross: Tensor, energy: Tensor, template_energy: Tensor, typical: Tensor) -> Tensor:
    """Correlation coefficient, 0 where either energy is nothing against the typical one or not known."""
    floor = 1e-7 * typical
    known = (energy > floor) & (template_energy > floor)
    scale = torch.where(known, energy * template_energy, 1.0).rsqrt()
    return torch.where(known, cross * scale, 0.0).clamp(-1.0, 1.0)


def _window_sums(
    images: Tensor, places: Tensor, size: tuple[int, int], reach: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Sums of the values and of their squares over windows at all lags, float64 (L, N, lags_y, lags_x).

    NaN where a window leaves the image.
    """
    height, width = size
    num_rows, num_columns = images.shape[-2:]
    device = images.device
    columns = places[..., 0, None] + torch.arange(-reach[1], reach[1] + 1, device=device)
    rows = places[..., 1, None] + torch.arange(-reach[0], reach[0] + 1, device=device)
    inside = ((rows >= 0) & (rows + height <= num_rows))[..., :, None] & (
        (columns >= 0) & (columns + width <= num_columns)
    )[..., None, :]
    rows, columns = rows.clamp(0, num_rows - height), columns.clamp(0, num_columns - width)
    low = int(columns.amin())
    extra = int(columns.amax()) - low
    columns = columns - low
    sums = []
    for power in (1, 2):
        inner = images[..., low : low + width]
        first = (inner.sum(-1) if power == 1 else torch.linalg.vecdot(inner, inner)).double()[..., None]
        change = images[..., low + width : low + width + extra] ** power - images[..., low : low + extra] ** power
        runs = torch.cat([first, first + change.cumsum(-1, dtype=torch.float64)], dim=-1)  # (L, H, extra + 1)
        table = torch.cat([torch.zeros_like(runs[:, :1]), runs.cumsum(1)], dim=1).flatten(1)
        step = extra + 1
        index = (rows * step)[..., :, None] + columns[..., None, :]
        flat = index.flatten(1)
        block = table.gather(1, flat + height * step) - table.gather(1, flat)
        sums.append(torch.where(inside, block.unflatten(1, index.shape[1:]), torch.nan))
    return sums[0], sums[1]


def correlate_profiles(template: Tensor, search: Tensor) -> Tensor:
    """Zero-mean normalised cross-correlation of profiles at all lags.

    Args:
        template: (..., w).
        search: (..., w + b).

    Returns:
        (..., b + 1) in -1 ... 1; 0 where a window is constant.
    """
    template = template.to(torch.float64)
    template = template - template.mean(-1, keepdim=True)
    windows = search.to(torch.float64).unfold(-1, template.shape[-1], 1)
    cross = (windows @ template[..., None])[..., 0]
    energy = windows.square().sum(-1) - windows.sum(-1).square() / template.shape[-1]
    typical = search.square().mean(-1, keepdim=True) * template.shape[-1]
    return _normalise(cross, energy, template.square().sum(-1, keepdim=True), typical)
