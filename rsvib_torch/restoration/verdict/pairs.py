"""Comparison of two frames of one scene: common part, the later one predicted from the earlier one, misfit.

Every function takes the frames of B stacks at a time.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.execution.chunking import at_once, runs
from rsvib_torch.frames.pixels import cut_parts, detailed_parts
from rsvib_torch.imaging.blur import form_rows
from rsvib_torch.numerics.fourier import extended_length, spline_spectra
from rsvib_torch.numerics.splines import correlated
from rsvib_torch.numerics.tables import Array, table, tables
from rsvib_torch.restoration.frame_motion import FrameMotion, MovingFrames

_SMOOTHING = 5.0  # px, standard deviation of the Gaussian in ``misfit``; displacements of up to about 10 px stay linear
_RIM = math.ceil(3 * _SMOOTHING) + 1  # px; half width of the kernels of ``misfit``
_MARGIN = 4  # px between the compared pixels and those outside the frame


class TooLittleInCommonError(ValueError):
    """Two frames share too little of the scene to be compared."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ComparedFrames(MovingFrames):
    """Raw frames of B stacks, and the frames restored from them."""

    restored: Tensor  # like the images, or (B, 1, C, H, W) in the coordinates of the earlier frame of each pair

    def of_stacks(self, stacks: list[int], frames: list[int] | None = None) -> "ComparedFrames":
        """Some of the stacks, and some of their frames; None for all."""
        count, members = self.images.shape[1], slice(None) if frames is None else frames

        def chosen(values: Tensor) -> Tensor:
            return values[stacks] if values.shape[1] < count else values[stacks][:, members]

        return replace(self.mapped(chosen), motion=self.motion.of(stacks, frames))

    @cached_property
    def moved(self) -> Tensor:
        """Mean displacement (B, T, R, 2) of the rows during their exposures, beyond the shift, in px."""
        displacement, node_weights = self.motion.exposures
        return (displacement * node_weights[:, None]).sum(-2) - self.motion.shift[:, :, None]


@dataclass(frozen=True, eq=False)
class FramePairs:
    """The common parts of two raw frames and of their restored frames, of each of B stacks, (B, C, h, w) each."""

    earlier: Tensor  # raw
    later: Tensor  # raw
    restored: Tensor  # restored from the earlier frame, or the one image of all frames
    restored_later: Tensor | None  # restored from the later frame; None where there is one image
    predicted: Tensor  # the later raw frame, formed from ``restored``
    changed_later: Tensor  # change of the restored later frame by the motion of that frame
    offset: Tensor  # (B, 2) px, root-mean-square displacement between the two frames by the motion, axes (x, y)
    # (B, 2, C, h, w) bool, pixels of the raw frames without data; they hold the values that the restored frames
    # predict. None for none
    ignore: Tensor | None = None


def pairs_to_judge(count: int, joint: bool | int, most: int | None = None) -> list[tuple[int, int]]:
    """Pairs of ``count`` frames to compare, at most ``most`` of them, evenly spread."""
    middle = count // 2
    pairs = [(p, p + 1) for p in range(count - 1)]
    if joint is True:
        pairs = [(middle, p) for p in range(count) if p != middle]
    if most is None or len(pairs) <= most:
        return pairs
    return [pairs[index] for index in np.rint(np.linspace(0, len(pairs) - 1, most)).astype(int)]


def overlaps(frames: ComparedFrames, pairs: list[tuple[int, int]]) -> tuple[Array, Array]:
    """Steps and rims (B, P, 2) of P pairs of frames of B stacks, in whole px along (rows, columns).

    The step is the displacement of the content from the earlier to the later frame, beyond that of single rows. The rim
    is the displacement of single rows, with a margin: so much at the ends of the common part is not compared.
    """
    earlier, later = np.array(pairs).T
    shift, reach = table(torch.stack([frames.motion.shift, frames.moved.abs().amax(-2)]).flip(-1))
    rims = np.ceil(np.maximum(reach[:, earlier], reach[:, later])).astype(np.int64) + _MARGIN
    return (shift[:, later] - shift[:, earlier]).astype(np.int64), rims


def is_enough(size: Sequence[int], steps: Array, rims: Array) -> Array:
    """Whether the common part of frames of ``size`` (rows, columns) is larger than the filters."""
    return (np.array(size) - abs(steps) - 2 * rims >= 2 * _RIM + 3).all(-1)


def shared_part(
    frames: ComparedFrames, pair: tuple[int, int], steps: Array, rims: Array, columns: int | None
) -> FramePairs:
    """Cut a ``pair`` of frames (indices) of each stack to their common part; rows are those of the later one.

    Steps and rims (B, 2) of the pair are from ``overlaps``. Of the columns, those with the most detail are kept; None
    for all.
    """
    raw, restored, ignore, motion, moved = frames.images, frames.restored, frames.ignore, frames.motion, frames.moved
    earlier, later = pair
    # the largest displacement of all stacks determines the size of the part
    height, width = (np.array(raw.shape[-2:]) - abs(steps).max(0)).tolist()
    rim_y, rim_x = rims.max(0).tolist()
    tops, lefts = (-steps).clip(0).T.tolist()
    later_tops, later_lefts = steps.clip(0).T.tolist()
    if columns is not None:
        second = cut_parts(raw[:, later], later_tops, later_lefts, (height, width))
        detailed = detailed_parts(second[:, None, ..., rim_x : width - rim_x], columns)
        lefts, later_lefts = (
            [left + part.start for left, part in zip(starts, detailed, strict=True)] for starts in (lefts, later_lefts)
        )
        width = detailed[0].stop - detailed[0].start + 2 * rim_x

    def before(images: Tensor) -> Tensor:
        return cut_parts(images, tops, lefts, (height, width))

    def after(images: Tensor) -> Tensor:
        return cut_parts(images, later_tops, later_lefts, (height, width))

    single = restored.shape[1] == 1
    first, second = before(raw[:, earlier]), after(raw[:, later])
    still = before(restored[:, 0 if single else earlier])
    still_later = still if single else after(restored[:, later])
    # both restored frames with the motion of the later frame
    scenes = still if single else torch.cat([still, still_later], 1)
    formed = reblur(scenes, motion, later, later_tops)
    predicted, formed_later = (formed, formed) if single else formed.chunk(2, 1)
    inner = (..., slice(rim_y, height - rim_y), slice(rim_x, width - rim_x))
    if ignore is not None:
        masks = torch.stack([before(ignore[:, earlier]), after(ignore[:, later])], 1)
        first = torch.where(masks[:, 0], reblur(still, motion, earlier, tops), first)
        second = torch.where(masks[:, 1], predicted, second)
        ignore = masks[inner]
    return FramePairs(
        first[inner],
        second[inner],
        still[inner],
        None if single else still_later[inner],
        predicted[inner],
        formed_later[inner] - still_later[inner],
        (moved[:, later] - moved[:, earlier]).square().mean(1).sqrt(),
        ignore,
    )


def equally_bright(pair: FramePairs, noise: Array) -> FramePairs:
    """The pairs with the earlier frame, and the images made of it, at the brightness and contrast of the later one.

    Gain and offset are the regression of the later frame on the predicted one, from means over squares of 16 px, which
    are large beside residual displacements. The noise power ``noise`` (B,) draws the gain towards 1.
    """
    side = min(16, *pair.later.shape[-2:])
    images = torch.stack([pair.predicted, pair.later])
    means = table(functional.avg_pool2d(images.flatten(0, 2)[:, None], side)).astype(np.float64)
    means = means.reshape(*images.shape[:3], -1)
    mean, target = levels = means.mean(-1)
    predicted, later = means - levels[..., None]
    slope = ((predicted * later).mean((1, 2)) + noise) / (np.square(predicted).mean((1, 2)) + noise)
    # frames that contradict each other keep their brightness
    related, slope = slope[:, None] > 0.0, slope[:, None]
    factors = np.hstack([np.where(related, slope, 1.0), np.where(related, target - slope * mean, 0.0)])
    of_images = torch.as_tensor(factors[..., None, None], dtype=images.dtype, device=images.device)
    gain, offset = of_images[:, :1], of_images[:, 1:]

    adjusted = {name: torch.addcmul(offset, getattr(pair, name), gain) for name in ("earlier", "restored", "predicted")}
    changed = gain * pair.changed_later if pair.restored_later is None else pair.changed_later
    return replace(pair, **adjusted, changed_later=changed)


def misfit(first: Tensor, second: Tensor) -> tuple[Array, Array]:
    """Root-mean-square displacement between two images (..., C, H, W) of one scene along each axis, and its resolution.

    A displacement d changes brightness by ``d . grad f``, so that the mean squared difference is ``a + dx^2 fx^2 + dy^2
    fy^2 + 2 dx dy fx fy``; white noise raises ``a`` only. Both images are smoothed, so that this holds for
    displacements up to about 10 px, and weighted least squares gives the means of dx^2 and dy^2. Images have at least
    35 px on a side. The results (..., 2) are in px, axes (x, y), float64; a misfit below the resolution cannot be
    distinguished from zero. They are 0 and infinity for images without contrast.
    """
    step = 4  # px between the places that are used, as neighbours are nearly equal
    # Gaussian and its derivative; gradients of the mean image, and the smoothed difference
    place = np.arange(-_RIM, _RIM + 1)
    gaussian = np.where(abs(place) < _RIM, np.exp(-0.5 * (place / _SMOOTHING) ** 2), 0.0)
    gaussian = gaussian / gaussian.sum()
    taps = np.stack([gaussian, 0.5 * (np.roll(gaussian, 1) - np.roll(gaussian, -1))])
    kernels = torch.as_tensor(taps, dtype=first.dtype, device=first.device)
    images = torch.stack([0.5 * (first + second), second - first])
    filtered = correlated(correlated(images, kernels, -1, step), kernels, -2, step)  # (across, along, image, ...)
    # along: Gaussian across and its derivative along the rows, of the mean image; across likewise; change: smoothed
    maps = filtered.flatten(0, 2)[[0b010, 0b100, 0b001]].flatten(-3).to(torch.float64)
    along, across, change = maps.unbind()
    # normal equations of weighted least squares for the four terms
    tiny = torch.finfo(torch.float64).tiny
    terms = [torch.ones_like(along), along.square(), across.square(), 2 * along * across]
    energy = terms[1] + terms[2]
    weight = (energy + energy.mean(-1, keepdim=True)).square().clamp(min=tiny).reciprocal()
    data = torch.stack([*terms, change.square()], -2)
    weighted = data[..., :4, :] * weight[..., None, :]
    largest = torch.maximum(first.abs().amax((-3, -2, -1)), second.abs().amax((-3, -2, -1)))
    data = torch.cat([data, weighted], -2)
    products, strongest, brightest = tables(
        torch.bmm(weighted.flatten(0, -3), data.flatten(0, -3).mT), energy.amax(-1), largest
    )
    normal, right, scatter = np.split(products.reshape(*strongest.shape, *products.shape[1:]), (4, 5), -1)
    # small tables on the CPU; those of images without contrast may overflow
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        scale = np.maximum(np.diagonal(normal, axis1=-2, axis2=-1), tiny) ** -0.5
        scale = scale[..., None, :] * scale[..., None]
        inverse = np.linalg.pinv(normal * scale, hermitian=True) * scale
        solution = (inverse @ right)[..., 0]
        # the variance of a squared Gaussian is twice the square of its mean; values within the smoothing are correlated
        correlated_values = 4 * math.pi * (_SMOOTHING / step) ** 2
        scatter = scatter * (correlated_values * 2.0 * solution[..., :1, None] ** 2)
        variance = np.diagonal(inverse @ scatter @ inverse, axis1=-2, axis2=-1)[..., 1:3].clip(0.0)
    size, resolution = solution[..., 1:3].clip(0.0) ** 0.5, (2.0 * variance**0.5) ** 0.5
    # rounding is no contrast
    has_contrast = (np.sqrt(strongest) > 1e-5 * brightest)[..., None]
    return np.where(has_contrast, size, 0.0), np.where(has_contrast, resolution, math.inf)


def reblur(scenes: Tensor, motion: FrameMotion, frame: int, first_rows: list[int]) -> Tensor:
    """Form one frame of each stack from restored scenes (Eq. 9), independently of the restoration method.

    The scenes (B, C, H, W) are in row order, in the coordinates in which frame ``frame`` is restored; they may be a
    part of the rows and columns, and are mirrored beyond. Row 0 of a scene is at its row of ``first_rows`` of the
    frame.
    """
    # displacement of each row during its exposure
    degree, count, (height, width) = 5, len(scenes), scenes.shape[-2:]
    rows, stacks = torch.arange(height, device=scenes.device), torch.arange(count, device=scenes.device)
    first = torch.tensor(first_rows, device=scenes.device)[:, None]
    displacement, node_weights = motion.exposures
    moved = displacement[stacks[:, None], frame, first + rows] - motion.shift[:, frame, None, None]
    along, across = moved.unbind(-1)
    place = rows[:, None] - across
    low, high = place.aminmax(dim=-1)
    reach, blur = torch.stack([along.abs().amax(), (high - low).amax()]).tolist()
    # spectra of the spline coefficients, the scenes one below the other
    length = extended_length(width, math.ceil(reach))
    u = torch.fft.rfftfreq(length, dtype=scenes.dtype, device=scenes.device)
    spectra = spline_spectra(scenes, degree, length).transpose(0, 1).flatten(1, 2)
    # a few rows of all scenes at a time
    kernel_bytes = 16 * count * (degree + 1 + math.ceil(blur)) * len(u)
    step = at_once(kernel_bytes, scenes.device, cpu_bytes=2**25)
    along = along.to(scenes.dtype)
    formed = [
        form_rows(spectra, place[:, part], along[:, part], node_weights, u, degree, num_scenes=count)
        for part in runs(height, step)
    ]
    image: Tensor = torch.fft.irfft(torch.cat(formed, dim=-2), n=length)[..., :width]
    return image.transpose(0, 1)
