"""Band registration by phase correlation."""

import torch
from torch import Tensor

from rsvib_torch.registration.bands import BINNING, LAGS, BandTask, fine_offsets, take_windows, whole_pixel_peak

__all__ = ["register_phase"]


def register_phase(task: BandTask) -> tuple[Tensor, Tensor]:
    """Offsets and quality of bands by phase correlation under a Hann window that moves with the scene.

    The cross-power spectrum is whitened where it exceeds the noise, and low-passed, so that samples at whole pixels
    determine its peak. The contract is that of ``BAND_METHODS``.
    """
    places = task.places
    num_rows = task.first.shape[-2]
    # search for whole pixels: these windows contain the band's content at every lag of the search range
    tall = task.height + 2 * task.search
    factor = BINNING
    width = task.width // factor * factor
    up = torch.tensor([0, task.search], device=places.device)
    pair = [
        take_windows(image, place[..., 1], place[..., 0], tall, width).unflatten(-1, (-1, factor)).mean(-1)
        for image, place in ((task.first, places - up), (task.second, places + task.start - up))
    ]
    still = torch.zeros_like(task.start, dtype=task.first.dtype)
    surface = _phase_surface(pair[0], pair[1], still, (task.search, -(-task.search // factor) + 1), (1.0, 1.0 * factor))
    lag, valid = whole_pixel_peak(surface, factor)
    shift, fraction = task.start + lag, still
    template = take_windows(task.first, places[..., 1], places[..., 0], task.height, task.width)
    for _ in range(2):  # the window follows the content: to a whole pixel, then to a fraction
        moved = places + shift
        inside = (moved[..., 1] >= 0) & (moved[..., 1] + task.height <= num_rows)
        window = take_windows(task.second, moved[..., 1], moved[..., 0], task.height, task.width)
        surface = _phase_surface(template, window, fraction, (LAGS, LAGS), (1.0, 1.0))
        offsets, quality = fine_offsets(task, shift, surface, valid & inside)
        best = torch.where(torch.isfinite(offsets), offsets, shift.to(offsets.dtype))
        shift = best.round().long()
        fraction = (best - shift).to(task.first.dtype)
    return offsets, quality


def _hann(size: int, shift: Tensor) -> Tensor:
    """Hann windows (M, size) over ``size`` pixels, displaced by ``shift`` (M,) px."""
    places = torch.arange(1, size + 1, dtype=shift.dtype, device=shift.device) - shift[:, None]
    return torch.sin(torch.pi * places.clamp(0, size + 1) / (size + 1)).square()


def _phase_surface(
    first: Tensor, second: Tensor, fraction: Tensor, reach: tuple[int, int], pixel: tuple[float, float]
) -> Tensor:
    """Phase correlation of windows (L, N, h, w) at the lags -reach ... reach: (L, N, lags_y, lags_x).

    Args:
        first: Windows of the earlier frames.
        second: Windows of the later frames.
        fraction: (L, N, 2) px, shift (x, y) of the Hann window of the second.
        reach: Lags across the rows and along the columns.
        pixel: Size of the windows' pixels across the rows and along the columns, in px.
    """
    shape = first.shape[:2]
    first, second, fraction = first.flatten(0, 1), second.flatten(0, 1), fraction.flatten(0, 1)
    height, width = first.shape[-2:]
    spectra = []
    for image, shift in ((first, torch.zeros_like(fraction)), (second, fraction)):
        window = _hann(height, shift[:, 1])[:, :, None] * _hann(width, shift[:, 0])[:, None]
        level = (image * window).sum((-2, -1), keepdim=True) / window.sum((-2, -1), keepdim=True)
        spectra.append(torch.fft.rfft2((image - level) * window))
    cross = spectra[1] * spectra[0].conj()
    magnitude = cross.abs()
    v = torch.fft.fftfreq(height, dtype=first.dtype, device=first.device)
    u = torch.fft.rfftfreq(width, dtype=first.dtype, device=first.device)
    high = (u > 0.4)[None] & (v.abs() > 0.25)[:, None]  # cycles/px: noise only, after the Gaussian of 1 px
    noise = (magnitude * high).sum((-2, -1), keepdim=True) / high.sum()
    low_pass = torch.exp(-((v[:, None] / pixel[0]).square() + (u / pixel[1]).square()) / (2 * 0.15**2))
    twice = torch.full_like(u, 2.0)  # rfft stores one half of the spectrum
    twice[0] = 1.0
    if width % 2 == 0:
        twice[-1] = 1.0
    weight = low_pass * twice / (magnitude + 10.0 * noise + torch.finfo(first.dtype).tiny)
    full = (magnitude * weight).sum((-2, -1))
    transforms = []
    for size, frequency in ((reach[0], v), (reach[1], u)):
        angle = (
            2
            * torch.pi
            * torch.arange(-size, size + 1, dtype=frequency.dtype, device=first.device)[:, None]
            * frequency
        )
        transforms.append(torch.polar(torch.ones_like(angle), angle))
    surface: Tensor = (transforms[0] @ ((cross * weight) @ transforms[1].T)).real
    surface = surface / full.clamp(min=torch.finfo(first.dtype).tiny)[:, None, None]
    lags: Tensor = surface.unflatten(0, shape)
    return lags
