"""What the mean of warped frames tells of the scene: all of it that stands above the noise, by a Wiener filter."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.core.fourier import fast_length
from rsvib_torch.registration.row_spectra import chunks, combined, differences, mean_over_frames

__all__ = ["Compared", "scene_detail"]

_PASS_ROWS = (0.24, 0.34)  # cycles/px across rows: full weight below, none above
_PASS_COLUMNS = (0.40, 0.48)  # along rows, where interpolation is exact but detail near the limit may be aliased
_SLOWEST = 1 / 64  # cycles/px: shading and vignetting live below
_SMOOTH = 16  # values of the spectra that are averaged along each axis
_SOME = 4  # along rows, of which one tells the noise
_SAME_PLACE = 128  # complex values: what lies a multiple apart shares a few places of a cache


@dataclass(frozen=True, eq=False)
class Compared:
    """What the frames of a group show of a scene together, and what they differ by: spectra along its S rows.

    Attributes:
        mean: (B, R, U), over the frames that see a row; R - S rows of zeros follow, so that transforms across rows are
            fast, and their values for one frequency along rows do not all lie at the same place of a cache.
        noise: (B, R, U / 4), a difference of two frames with the noise of their mean, at every fourth frequency.
        differences: (B, G, S, U), or (B, 1, S, U) of two frames, as from ``differences``.
    """

    mean: Tensor
    noise: Tensor
    differences: Tensor

    @classmethod
    def of(cls, warped: Iterable[tuple[slice, Tensor]], seen: Tensor) -> "Compared":
        """From frames warped to the scene.

        Args:
            warped: Runs of the S rows with what is seen of them, (B, G, s, U): each is forgotten while it is still in
                the cache.
            seen: (B, G, S) float64, 1 where a frame sees the row.
        """
        whole: list[Tensor] = []
        count = seen.shape[2]
        counts = (_transformed(count), _transformed(count), count)
        for rows, run in warped:
            visible = seen[:, :, rows]
            different = differences(run, visible)
            # of two frames what they differ by is just that
            noise = different[:, 0, :, ::_SOME] if run.shape[1] == 2 else _noise_of_mean(run[..., ::_SOME], visible)
            of_run = (mean_over_frames(run, visible), noise, different)
            if not whole:
                sizes = zip(of_run, counts, strict=True)
                whole = [one.new_empty(*one.shape[:-2], size, one.shape[-1]) for one, size in sizes]
            for all_rows, one in zip(whole, of_run, strict=True):
                all_rows[..., rows, :] = one
        for all_rows in whole:
            all_rows[..., count:, :] = 0
        return cls(*whole)


def scene_detail(compared: Compared, u: Tensor) -> tuple[Tensor, Tensor]:
    """Detail of the scene and its gradient across rows, from the mean of the frames.

    Args:
        compared: The frames of a group.
        u: (U,) frequencies along rows, cycles/px.

    Returns:
        Spectra (B, R, U) each, px^-1 the latter; those of the rows lie side by side in memory.
    """
    # transforms across rows leave the rows side by side in memory, and all that follows runs along them
    whole, noise = (torch.fft.fft(rows, dim=-2).transpose(-2, -1) for rows in (compared.mean, compared.noise))
    v = torch.fft.fftfreq(whole.shape[-1], dtype=torch.float64, device=u.device)
    torch.view_as_real(whole).mul_(_wiener(whole, noise, u, v)[..., None])
    detail = torch.fft.ifft(whole)
    whole *= (2j * math.pi * v).to(whole.dtype)
    return detail.transpose(-2, -1), torch.fft.ifft(whole).transpose(-2, -1)


def _transformed(rows: int) -> int:
    """Rows that a transform across so many is taken of."""
    length = fast_length(rows)
    return length if length % _SAME_PLACE else fast_length(length + 1)


def _pass(frequency: Tensor, limits: tuple[float, float]) -> Tensor:
    """1 below the first limit, 0 above the second, a half cosine between."""
    low, high = limits
    return 0.5 + 0.5 * torch.cos(math.pi * ((frequency.abs() - low) / (high - low)).clamp(0.0, 1.0))


def _wiener(mean: Tensor, noise: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Share (B, U, S) of the spectrum of the mean that is scene, within the pass band.

    Args:
        mean: (B, U, S) two-dimensional spectrum of the mean of the frames.
        noise: (B, U / 4, S) spectrum of a difference with the noise of the mean, at every fourth frequency.
        u: Frequencies along rows, cycles/px.
        v: Frequencies across rows, cycles/px.
    """
    total, noise_power = _smoothed(mean, _SMOOTH), _smoothed(noise, _SMOOTH // _SOME)
    share = (1 - noise_power / total.clamp(min=torch.finfo(total.dtype).tiny)).clamp(min=0.0)
    # all but the slowest, 1 - exp(-(u^2 + v^2) / slowest^2), within the pass band
    along, across = _pass(u, _PASS_COLUMNS), _pass(v, _PASS_ROWS)
    slow_along, slow_across = along * torch.exp(-((u / _SLOWEST) ** 2)), across * torch.exp(-((v / _SLOWEST) ** 2))
    along, across, slow_along, slow_across = (x.to(share.dtype) for x in (along, across, slow_along, slow_across))
    passed = torch.outer(along, across).addr_(slow_along, slow_across, alpha=-1)
    blocks = share[:, :, None, :, None].expand(-1, -1, _SMOOTH, -1, _SMOOTH).flatten(3).flatten(1, 2)
    return blocks[:, : len(u), : len(v)] * passed


def _smoothed(spectrum: Tensor, frequencies: int) -> Tensor:
    """Mean power (B, U / frequencies, S / 16) of blocks of a spectrum (B, U, S), up to a factor."""
    parts = torch.view_as_real(spectrum).flatten(-2)
    blocks = []
    for part in chunks(parts.shape[1], 4 * parts.shape[2] * len(parts), frequencies, parts.device):
        power = parts[:, part].square()
        whole = power.shape[1] // frequencies * frequencies
        blocks.append(power[:, :whole].unflatten(1, (-1, frequencies)).mean(2))
        if whole < power.shape[1]:
            blocks.append(power[:, whole:].mean(1, keepdim=True))
    return functional.avg_pool1d(torch.cat(blocks, 1), 2 * _SMOOTH, ceil_mode=True)


def _noise_of_mean(warped: Tensor, seen: Tensor) -> Tensor:
    """Difference (B, S, U) of the outer frames that see a row, with the noise of their mean; 0 where one alone does."""
    count = seen.shape[1]
    order = torch.arange(count, device=seen.device)[:, None]
    first = torch.where(seen > 0, order, count).amin(1, keepdim=True)
    last = torch.where(seen > 0, order, -1).amax(1, keepdim=True)
    sign = ((order == last).double() - (order == first).double()) * (last > first)
    # the difference of two frames has twice the noise of a frame
    return combined(warped, sign * (0.5 / seen.sum(1, keepdim=True).clamp(min=1.0)).sqrt())
