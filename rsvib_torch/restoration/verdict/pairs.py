"""Comparison of two frames of one scene: common part, the later one predicted from the earlier one, misfit.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from rsvib_torch.core.chunking import runs
from rsvib_torch.core.fourier import extended_length, spline_spectra
from rsvib_torch.core.splines import correlated
from rsvib_torch.frames.pixels import detailed_columns
from rsvib_torch.imaging.blur import form_rows
from rsvib_torch.imaging.trajectory import exposure_trajectory
from rsvib_torch.restoration.frame_motion import FrameMotion

__all__ = ["FramePair", "TooLittleInCommonError", "equally_bright", "misfit", "pairs_to_judge", "reblur", "shared_part"]

_SMOOTHING = 5.0  # px, standard deviation of the Gaussian in ``misfit``; displacements of up to about 10 px stay linear
_RIM = math.ceil(3 * _SMOOTHING) + 1  # px; half width of the kernels of ``misfit``
_ELEMENTS = {"cpu": 1 << 18}  # values of the kernels in ``reblur`` at a time; they fit into the cache (speed only)


class TooLittleInCommonError(ValueError):
    """Two frames share too little of the scene to be compared."""


@dataclass(frozen=True, eq=False)
class FramePair:
    """The common part of two raw frames and of their restored frames, (C, h, w) each.

    Attributes:
        earlier: Raw.
        later: Raw.
        restored: Restored from the earlier frame, or the one image of all frames.
        restored_later: Restored from the later frame; None where there is one image.
        predicted: The later raw frame, formed from ``restored``.
        changed_later: Change of the restored later frame by the motion of that frame.
        offset: (2,) px, root-mean-square displacement between the two frames by the motion, axes (x, y).
        ignore: (2, C, h, w) bool, pixels of the raw frames without data; they hold the values that the restored frames
            predict. None for none.
    """

    earlier: Tensor
    later: Tensor
    restored: Tensor
    restored_later: Tensor | None
    predicted: Tensor
    changed_later: Tensor
    offset: Tensor
    ignore: Tensor | None = None


def pairs_to_judge(count: int, joint: bool | int, most: int | None = None) -> list[tuple[int, int]]:
    """Pairs of ``count`` frames to compare, at most ``most`` of them, evenly spread."""
    middle = count // 2
    pairs = [(p, p + 1) for p in range(count - 1)]
    if joint is True:
        pairs = [(middle, p) for p in range(count) if p != middle]
    if most is None or len(pairs) <= most:
        return pairs
    chosen = torch.linspace(0, len(pairs) - 1, most, dtype=torch.float32, device="cpu").round().to(torch.int64).tolist()
    return [pairs[index] for index in chosen]


def shared_part(
    raw: Tensor,
    restored: Tensor,
    motion: FrameMotion,
    frames: tuple[int, int],
    columns: int | None,
    ignore: Tensor | None = None,
    *,
    margin: int = 4,
) -> FramePair:
    """Cut two frames to their common part; rows are those of the later one.

    Args:
        raw: (T, C, H, W) in row order.
        restored: (T, C, H, W), or (1, C, H, W) in the coordinates of the first of ``frames``.
        motion: Motion of the frames, batch of one.
        frames: Indices of the two frames.
        columns: Cut to so many columns, those with the most detail; None for all.
        ignore: Mask shaped like ``raw`` of pixels that were not measured.
        margin: px between the compared pixels and those outside the frame.

    Raises:
        TooLittleInCommonError: If the common part is smaller than the filters.
    """
    earlier, later = frames
    x, y = (int(step) for step in (motion.shift[0, later] - motion.shift[0, earlier]).tolist())
    height, width = (size - abs(step) for size, step in zip(raw.shape[-2:], (y, x), strict=True))
    moved = _displacement_of_rows(motion, frames, raw.shape[-2])
    rim_x, rim_y = (math.ceil(reach) + margin for reach in moved.abs().amax((0, 1)).tolist())
    if min(height - 2 * rim_y, width - 2 * rim_x) < 2 * _RIM + 3:
        raise TooLittleInCommonError(
            f"frames {earlier} and {later} have nothing in common, or too little: they lie ({x}, {y}) px apart"
        )
    before, after = (_overlap(step, raw.shape[-2:]) for step in ((y, x), (-y, -x)))
    first, second = raw[earlier][before], raw[later][after]
    single = len(restored) == 1
    still = restored[0 if single else earlier][before]
    still_later = still if single else restored[later][after]
    strip = slice(0, width)
    if columns is not None:
        detailed = detailed_columns(second[..., rim_x : width - rim_x], columns)
        strip = slice(detailed.start, detailed.stop + 2 * rim_x)
    cut = (..., slice(rim_y, height - rim_y), slice(rim_x, -rim_x))
    first, second, still, still_later = (image[..., strip] for image in (first, second, still, still_later))
    predicted, formed_later = reblur(torch.cat([still, still_later]), motion, later, first_row=max(y, 0)).chunk(2)
    if ignore is not None:
        masks = torch.stack([ignore[earlier][before], ignore[later][after]])[..., strip]
        first = torch.where(masks[0], reblur(still, motion, earlier, first_row=max(-y, 0)), first)
        second = torch.where(masks[1], predicted, second)
        ignore = masks[(slice(None), *cut)]
    return FramePair(
        first[cut],
        second[cut],
        still[cut],
        None if single else still_later[cut],
        predicted[cut],
        formed_later[cut] - still_later[cut],
        (moved[1] - moved[0]).square().mean(0).sqrt(),
        ignore,
    )


def equally_bright(pair: FramePair, noise: Tensor, *, block: int = 16) -> FramePair:
    """The pair with the earlier frame, and the images made of it, at the brightness and contrast of the later one.

    Gain and offset are the regression of the later frame on the predicted one, from means over squares of ``block`` px,
    which are large beside residual displacements. The noise power ``noise`` draws the gain towards 1.
    """
    side = min(block, *pair.later.shape[-2:])
    predicted, later = (
        torch.nn.functional.avg_pool2d(image[None], side)[0].to(torch.float64) for image in (pair.predicted, pair.later)
    )
    mean, target = (values.mean((-2, -1), keepdim=True) for values in (predicted, later))
    power = (predicted - mean).square().mean() + noise
    gain = (((predicted - mean) * (later - target)).mean() + noise) / power
    if float(gain) <= 0.0:
        return pair
    mean, target, gain = (value.to(pair.later.dtype) for value in (mean, target, gain))

    def adjusted(image: Tensor) -> Tensor:
        return torch.addcmul(target - gain * mean, image, gain)

    return replace(
        pair,
        earlier=adjusted(pair.earlier),
        restored=adjusted(pair.restored),
        predicted=adjusted(pair.predicted),
        changed_later=gain * pair.changed_later if pair.restored_later is None else pair.changed_later,
    )


def misfit(first: Tensor, second: Tensor, *, step: int = 4) -> tuple[Tensor, Tensor]:
    """Root-mean-square displacement between two images of one scene, along each axis.

    A displacement d changes brightness by ``d . grad f``, so that the mean squared difference is
    ``a + dx^2 fx^2 + dy^2 fy^2 + 2 dx dy fx fy``; white noise raises ``a`` only. Both images are smoothed, so that this
    holds for displacements up to about 10 px, and weighted least squares gives the means of dx^2 and dy^2.

    Args:
        first: (C, H, W), at least 35 px on a side.
        second: The same shape.
        step: px between the places that are used; after smoothing, neighbours are nearly equal.

    Returns:
        Misfit (2,) and its resolution (2,) in px, axes (x, y), float64; a misfit below the resolution cannot be
        distinguished from zero. For images without contrast 0 and infinity.
    """
    place = torch.arange(-_RIM, _RIM + 1, dtype=torch.float32, device=first.device)
    gaussian = torch.where(place.abs() < _RIM, torch.exp(-0.5 * (place / _SMOOTHING).double().square()), 0.0)
    gaussian = gaussian / gaussian.sum()
    kernels = torch.stack([gaussian, 0.5 * (gaussian.roll(1) - gaussian.roll(-1))]).to(first.dtype)
    mean, changed = (0.5 * (first + second), second - first)
    smooth, slope = correlated(torch.stack([mean, changed]), kernels, -1, step)
    along = correlated(slope[0], kernels[:1], -2, step)[0].flatten().to(torch.float64)
    (_, change), (across, _) = correlated(smooth, kernels, -2, step)
    across, change = (values.flatten().to(torch.float64) for values in (across, change))
    change = change.square()
    energy = along.square() + across.square()
    tiny = torch.finfo(torch.float64).tiny
    weight = (energy + energy.mean()).square().clamp(min=tiny).reciprocal()
    terms = torch.stack([torch.ones_like(along), along.square(), across.square(), 2 * along * across])
    normal = (terms * weight) @ terms.T
    scale = normal.diagonal().clamp(min=tiny).rsqrt()
    inverse = torch.linalg.pinv(normal * scale * scale[:, None], hermitian=True) * scale * scale[:, None]
    solution = inverse @ ((terms * weight) @ change)
    # the variance of a squared Gaussian is twice the square of its mean; values within the smoothing are correlated
    correlated_values = 4 * math.pi * (_SMOOTHING / step) ** 2
    scatter = (terms * weight.square()) @ terms.T * (correlated_values * 2.0 * solution[0].square())
    deviation = (inverse @ scatter @ inverse).diagonal()[1:3].clamp(min=0.0).sqrt()
    rounding = 1e-5 * torch.maximum(first.abs().amax(), second.abs().amax())
    has_contrast = energy.amax().sqrt() > rounding
    size, resolution = solution[1:3].clamp(min=0.0).sqrt(), (2.0 * deviation).sqrt()
    return size.where(has_contrast, 0.0), resolution.where(has_contrast, math.inf)


def reblur(scene: Tensor, motion: FrameMotion, frame: int, *, first_row: int = 0, degree: int = 5) -> Tensor:
    """Form one frame from a restored scene (Eq. 9), independently of the restoration method.

    Displacement along rows is a phase ramp, across rows a B-spline, the exposure a Gauss-Legendre sum.

    Args:
        scene: (C, H, W) in row order, in the coordinates in which frame ``frame`` is restored; it may be a part of
            the rows and columns, and is mirrored beyond.
        motion: Motion of the frames, batch of one.
        frame: Index of the frame to form.
        first_row: Row of the frame at row 0 of the scene.
        degree: Degree of the B-spline.

    Returns:
        The same part (C, H, W) of the frame.
    """
    height, width = scene.shape[-2:]
    rows = torch.arange(height, dtype=torch.float64, device=scene.device)
    starts = motion.frame_starts[frame] + (first_row + rows) * motion.timing.row_time
    displacement, node_weights = exposure_trajectory(motion.vibration[0], starts, motion.timing, "gauss")
    displacement = displacement - motion.shift[0, frame]
    reach = math.ceil(float(displacement[..., 0].abs().amax()))
    length = extended_length(width, reach)
    u = torch.fft.rfftfreq(length, dtype=torch.float64, device=scene.device)
    spectra = spline_spectra(scene, degree, length)

    place = rows[:, None] - displacement[..., 1]
    along = displacement[..., 0].to(scene.dtype)
    taps = degree + 1 + math.ceil(float((place.amax(-1) - place.amin(-1)).amax()))
    step = max(1, _ELEMENTS.get(scene.device.type, height * taps * len(u)) // (taps * len(u)))
    formed = [
        form_rows(spectra, place[part], along[part], node_weights, u.to(scene.dtype), degree)
        for part in runs(height, step)
    ]
    image: Tensor = torch.fft.irfft(torch.cat(formed, dim=-2), n=length)[..., :width]
    return image


def _overlap(step: tuple[int, int], size: Sequence[int]) -> tuple[Any, ...]:
    """Part of an image whose content is found ``step`` px further on in another image."""
    return (..., *(slice(max(-s, 0), n - max(s, 0)) for s, n in zip(step, size, strict=True)))


def _displacement_of_rows(motion: FrameMotion, frames: Sequence[int], num_rows: int) -> Tensor:
    """Mean displacement (2, R, 2) of the rows of two frames minus their shifts, in px."""
    rows = torch.arange(num_rows, dtype=torch.float64, device=motion.frame_starts.device)
    return motion.mean_displacement(rows.expand(1, len(motion.frame_starts), -1))[0, list(frames)]
