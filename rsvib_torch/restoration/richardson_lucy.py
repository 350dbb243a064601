"""Restoration by Richardson-Lucy iterations: what was never negative stays so."""

from collections.abc import Sequence

import torch
from torch import Tensor

from rsvib_torch.core.checks import check_whole_number
from rsvib_torch.frames.pixels import fill_with_means
from rsvib_torch.imaging.blur import RowVaryingBlur
from rsvib_torch.imaging.psf import RowPSF, row_psf
from rsvib_torch.restoration.dewarp import restore_dewarp
from rsvib_torch.restoration.frame_motion import FrameMotion
from rsvib_torch.restoration.joint_groups import joint_groups

__all__ = ["restore_richardson_lucy"]

_LEAST = 1e-4  # of the mean: values that start lower would stay there for long
_SEEN = 0.1  # of a pixel: what all pixels together see less of stays as it started


def restore_richardson_lucy(
    frames: Tensor,
    motion: FrameMotion,
    *,
    joint: bool | int = False,
    iterations: int = 20,
    ignore: Tensor | None = None,
) -> Tensor:
    """Restore frames by Richardson-Lucy iterations on the row-varying blur.

    ``c <- c K^T(m g / K c) / K^T m`` climbs to the most probable scene for Poisson counts g of the pixels m that were
    measured (Richardson 1972; Lucy 1974). The unknowns c are cubic B-spline coefficients of the scene: splines are
    positive, so that the scene is, and they do not blur as linear interpolation does. Every step conserves the flux.
    It starts from the frames with their geometry undone; fewer iterations amplify less noise. Several frames of one
    scene add what they see, ``sum K^T(m g / K c) / sum K^T m``, and start from their mean.

    Args:
        frames: (B, T, C, H, W) in row order; negative values count as 0.
        motion: Motion of the frames.
        joint: ``True``: one image from all frames, in the coordinates of the middle one (the time axis keeps length
            1); a number K: every frame from K neighbouring ones; ``False``: every frame from itself. Where image
            motion moves frames, only what they have in common with the restored one is joined.
        iterations: How many.
        ignore: Boolean mask shaped like the frames of pixels that do not count.

    Returns:
        Restored frames of the same shape, or (B, 1, C, H, W); nowhere negative.
    """
    iterations = check_whole_number("iterations", iterations, at_least=1)
    B, T, _, H, W = frames.shape
    groups = joint_groups(T, joint)
    starts = motion.row_starts(torch.arange(H, dtype=torch.float64, device=frames.device))
    psf = row_psf(motion.vibration, starts.expand(B, T, H), motion.timing, interpolation="cubic", quadrature="gauss")
    weights = psf.weights.to(frames.dtype)[:, :, None]
    measured = torch.ones_like(frames)
    if ignore is not None:
        frames, measured = fill_with_means(frames, ignore), (~ignore).to(frames.dtype)
    counts = frames.clamp(min=0.0)
    upright, shift = restore_dewarp(frames, motion), motion.shift.to(torch.int64)
    # degree 1: the kernels act on the coefficients themselves
    if all(members == [reference] for members, reference in groups):
        kernels = RowPSF((psf.first_tap - shift[:, :, None])[:, :, None, None], weights[:, :, None], 1)
        alone = _climb(counts.unsqueeze(2), measured.unsqueeze(2), upright.unsqueeze(2), kernels, iterations)
        return _at_pixels(alone.squeeze(2))
    restored = []
    for stack in range(B):
        for members, reference in groups:
            first = psf.first_tap[stack, members] - shift[stack, reference]
            kernels = RowPSF(first[:, None], weights[stack, members], 1)
            elsewhere = torch.tensor([member != reference for member in members], device=frames.device)
            beyond = elsewhere[:, None, None, None] & _looking_beyond(kernels, W)
            start = _mean_of_shared(upright[stack, members], (shift[stack, members] - shift[stack, reference]).tolist())
            restored.append(
                _climb(counts[stack, members], measured[stack, members] * ~beyond, start, kernels, iterations)
            )
    return _at_pixels(torch.cat(restored).unflatten(0, (B, len(groups))))


def _climb(counts: Tensor, measured: Tensor, start: Tensor, kernels: RowPSF, iterations: int) -> Tensor:
    """Coefficients (..., 1, C, H, W), like ``start``, of the scene that frames (..., M, C, H, W) show."""
    blur, size = RowVaryingBlur(kernels, origin=(0, 0)), tuple(start.shape)
    tiny = torch.finfo(counts.dtype).tiny
    counts = counts * measured
    total, pixels = (values.sum((-4, -2, -1), keepdim=True) for values in (counts, measured))
    mean = (total / pixels.clamp(min=1.0)).clamp(min=tiny)
    sensitivity = blur.adjoint(measured, size)
    seen = sensitivity > _SEEN
    scene = torch.maximum(start, _LEAST * mean)
    for _ in range(iterations):
        ratio = counts / blur(scene).clamp(min=tiny)
        scene = torch.where(seen, scene * blur.adjoint(ratio, size) / sensitivity.clamp(min=tiny), scene)
    return scene


def _looking_beyond(kernels: RowPSF, width: int) -> Tensor:
    """Pixels (..., R, W) that also show what lies beyond a scene of R rows and W columns, where it is mirrored."""
    inside = torch.ones((), dtype=torch.bool, device=kernels.first_tap.device)
    num_rows = kernels.weights.shape[-3]
    places = torch.arange(num_rows, device=inside.device)[:, None], torch.arange(width, device=inside.device)
    for axis, place, length in ((1, places[0], num_rows), (0, places[1], width)):
        used = (kernels.weights != 0).any(-2 if axis == 0 else -1)
        last_tap = (used * torch.arange(used.shape[-1], device=used.device)).amax(-1)
        nearest = place - kernels.first_tap[..., axis, None]
        inside = inside & (nearest < length) & (nearest >= last_tap[..., None])
    return ~inside


def _mean_of_shared(upright: Tensor, apart: Sequence[Sequence[int]]) -> Tensor:
    """Mean (1, C, H, W), pixel by pixel, of those frames that show it.

    Args:
        upright: Frames (M, C, H, W) without distortion.
        apart: By how many px (x, y) their content lies beyond that of the mean.
    """
    height, width = upright.shape[-2:]
    total, number = torch.zeros_like(upright[:1]), torch.zeros_like(upright[:1])
    for image, (x, y) in zip(upright, apart, strict=True):
        here = (..., _shared(height, y), _shared(width, x))
        total[here] += image[..., _shared(height, -y), _shared(width, -x)]
        number[here] += 1.0
    return total / number


def _shared(length: int, step: int) -> slice:
    """Part of an axis whose content is found ``step`` px further on in another image of that length."""
    return slice(max(-step, 0), max(length - step, 0))


def _at_pixels(coefficients: Tensor) -> Tensor:
    """Cubic B-splines with mirrored ends at the pixels, (..., H, W)."""
    for dim in (-2, -1):
        length = coefficients.shape[dim]
        before = coefficients.narrow(dim, min(1, length - 1), 1)
        after = coefficients.narrow(dim, max(length - 2, 0), 1)
        padded = torch.cat([before, coefficients, after], dim)
        sides = padded.narrow(dim, 0, length) + padded.narrow(dim, 2, length)
        coefficients = (4.0 * coefficients + sides) / 6.0
    return coefficients
