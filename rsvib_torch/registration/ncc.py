"""Band registration by zero-mean normalised cross-correlation (NCC), computed with matrix products."""

import torch
from torch import Tensor

from rsvib_torch.registration.bands import BINNING, LAGS, BandTask, fine_offsets, take_windows, whole_pixel_peak

__all__ = ["correlate_bands", "normalise", "register_ncc"]


def register_ncc(task: BandTask) -> tuple[Tensor, Tensor]:
    """Offsets and quality of bands: a search for whole pixels in binned columns, then the peak at full resolution.

    The contract is that of ``BAND_METHODS``.
    """
    width = task.width // BINNING
    factor = BINNING if width >= 64 else 1
    reach = -(-task.search // factor)
    width = task.width // factor
    binned = [
        take_windows(image, torch.zeros_like(left), left, image.shape[-2], columns * factor)[:, 0]
        .unflatten(-1, (columns, factor))
        .mean(-1)
        for image, left, columns in (
            (task.first, task.left[:, None], width),
            (task.second, (task.left + task.coarse[:, 0])[:, None] - reach * factor, width + 2 * reach),
        )
    ]
    places = task.places
    rows = places[..., 1]
    surface = correlate_bands(
        binned[0],
        binned[1],
        torch.stack([torch.zeros_like(rows), rows], -1),
        torch.stack([torch.full_like(rows, reach), rows + task.coarse[:, None, 1]], -1),
        size=(task.height, width),
        reach=(task.search, reach),
    )
    lag, inside = whole_pixel_peak(surface, factor)
    shift = task.start + lag
    moved = places + shift
    surface = correlate_bands(
        task.first, task.second, places, moved, size=(task.height, task.width), reach=(LAGS, LAGS)
    )
    inside &= (moved[..., 1] >= LAGS) & (moved[..., 1] + task.height + LAGS <= task.first.shape[-2])
    return fine_offsets(task, shift, surface, inside)


def correlate_bands(
    first: Tensor,
    second: Tensor,
    places: Tensor,
    later_places: Tensor,
    *,
    size: tuple[int, int],
    reach: tuple[int, int],
) -> Tensor:
    """Zero-mean normalised cross-correlation of windows of one image with windows of another.

    For one lag along the columns, the correlation at all lags across the rows consists of the diagonal sums of the
    matrix product of template and search rows. Means and energies of the search windows come from running sums.

    Args:
        first: (L, H, W) images the templates are cut from, roughly of zero mean.
        second: (L, H, V) images that are searched.
        places: (L, N, 2) int64, column and row of the first pixel of each template.
        later_places: (L, N, 2) int64, the same for the window at lag zero.
        size: Rows and columns of a template.
        reach: Lags -reach ... reach across the rows and along the columns.

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
    step = 8  # rows of templates per product: in products of more, most row pairs belong to no lag
    for top in range(0, height, step):
        rows = template[:, top : top + step]
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
    return normalise(cross, energy, template_energy, pixels * second.square().mean((-2, -1))[:, None, None, None])


def normalise(cross: Tensor, energy: Tensor, template_energy: Tensor, typical: Tensor) -> Tensor:
    """Correlation coefficient; 0 where an energy is NaN or below 1e-7 of the typical one (rounding of float32)."""
    floor = 1e-7 * typical
    textured = (energy > floor) & (template_energy > floor)
    scale = torch.where(textured, energy * template_energy, 1.0).rsqrt()
    return torch.where(textured, cross * scale, 0.0).clamp(-1.0, 1.0)


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
