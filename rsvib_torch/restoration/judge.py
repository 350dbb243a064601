"""Verdict on a restoration without the true scene: agreement between frames of one scene.

A restored frame, blurred by the motion of the next frame, should equal that next frame. The residual displacement
between the two and the estimated gain in PSNR determine the outcome of every pair of frames, see ``outcome_of_pair``.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.checks.arguments import ArrayLike, Channels, FramesOrFiles, as_tensor, checks_arguments
from rsvib_torch.checks.values import check_whole_number
from rsvib_torch.execution.parallel import at_once, runs
from rsvib_torch.execution.progress import steps
from rsvib_torch.frames.entry_points import load_frames
from rsvib_torch.frames.pixels import detailed_parts
from rsvib_torch.frames.prepare import PreparedFrames, prepare_frames, reasons_from_row_order
from rsvib_torch.imaging.blur import form_rows
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.motion import ColumnMotion, Motion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.numerics.interpolation import correlated, extended_length, spline_spectra
from rsvib_torch.numerics.tables import Array, table, tables, valid_mean
from rsvib_torch.restoration.frame_motion import (
    FrameMotion,
    frame_motion,
    joint_groups,
    motion_of_frames,
    vibration_to_undo,
)
from rsvib_torch.restoration.noise import noise_deviation
from rsvib_torch.restoration.restoration_verdict import (
    DISPLACEMENTS,
    LEVELS,
    Outcome,
    RestorationVerdict,
    outcome_of_pair,
)
from rsvib_torch.results.reason import Reason

_MAX_MISSING = 0.5  # share of the pixels of a pair without data, above which it is not judged
_STRIP = 160  # px, width of the strip of columns that is judged with roll or zoom: enough for the means of a pair
_MIN_NOISE = 1e-5  # of full scale; noise level assumed at least, rounding of float32 images
_SMOOTHING = 5.0  # px, standard deviation of the Gaussian in ``misfit``; displacements of up to about 10 px stay linear
_RIM = math.ceil(3 * _SMOOTHING) + 1  # px; half width of the kernels of ``misfit``
_MARGIN = 4  # px between the compared pixels and those outside the frame


class TooLittleInCommonError(ValueError):
    """Two frames share too little of the scene to be compared."""


@checks_arguments
def judge_restoration(
    frames: FramesOrFiles,
    restored: FramesOrFiles,
    timing: SensorTiming,
    vibration: Motion | DetectedVibration,
    *,
    joint: bool | int = False,
    full_scale: float | None = None,
    channels: Channels = None,
    ignore: ArrayLike | None = None,
    mosaic: str | None = None,
    most_pairs: int | None = None,
) -> RestorationVerdict:
    """Judge whether restored frames are better than raw ones, without the true scene.

    Every restored frame, blurred by the motion of the next one, should equal that next frame: a wrong vibration leaves
    a displacement between the two (``misfit_after``). Restored frames should agree with each other better than raw
    frames do, noise and ringing included (``predicted_gain``). The residual should be noise (``chi_square``). A
    vibration that displaces all frames alike (at a blind frequency) is not visible in these quantities; the outcome is
    then ``"unknown"``.

    Args:
        frames: Raw stack (T, H, W) or (T, C, H, W), at least two frames.
        restored: Result of ``restore``: one frame from each, or one image (1, ...) from all; with ``scale=2``, the
            points at the pixels are judged.
        timing: The sensor.
        vibration: The vibration that was undone, in image axes, or the detection that ``restore`` was given.
        joint: As in ``restore``.
        full_scale: As in ``restore``.
        channels: As in ``restore``, for both stacks.
        ignore: As in ``restore``; ignored pixels and NaN are not judged.
        mosaic: As in ``restore``; the smooth luminance is judged.
        most_pairs: Compare no more pairs than these, evenly spread over the stack; None for all.

    Returns:
        Verdict on each pair of neighbouring frames; on each frame with the middle one where there is one image. Frames
        may differ in brightness and contrast.

    Raises:
        ValueError: If there is one frame only, shapes differ, or two frames have too little in common.

    Example:
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import example_frames
        >>> frames, timing, vibration = example_frames()
        >>> wrong = rsv.Vibration(amplitude=[2.1, 1.6], frequency=[110.0, 90.0], phase=[3.6, 4.1])  # opposite phase
        >>> for candidate in (vibration, wrong):
        ...     restored = rsv.restore(frames, timing, candidate, check=False)
        ...     print(rsv.judge_restoration(frames, restored, timing, candidate).outcome)
        ('helps',)
        ('worse',)
    """
    prepared = prepare_frames(
        frames, timing, full_scale=full_scale, channels=channels, ignore=ignore, mosaic=mosaic, minimum_frames=2
    )
    if prepared.batched:
        raise ValueError(f"frames must be one stack (T, H, W) or (T, C, H, W), got shape {prepared.shape}")
    timing = prepared.image_timing
    count, height = prepared.images.shape[1], prepared.images.shape[-2]
    # 1. Restored images at the pixels of the frames; on the finer grid, these are every second point.
    loaded = load_frames(restored, full_scale)
    images = as_tensor("restored", loaded.frames)
    shapes = [prepared.restored_shape(1 if joint is True else count, scale) for scale in (1, 2)]
    if tuple(images.shape) not in shapes:
        raise ValueError(
            f"restored must have the shape {shapes[0]}, or {shapes[1]} with scale=2, got {tuple(images.shape)}"
        )
    step = 1 + shapes.index(tuple(images.shape))
    channels_last = images.ndim == 4 and prepared.channel_axis == -1
    images = images[:, ::step, ::step] if channels_last else images[..., ::step, ::step]
    # 2. The part of the vibration that was undone, and the verdict.
    vibration, _ = vibration_to_undo(vibration, timing, count, height)
    images = prepare_frames(
        images,
        timing,
        full_scale=loaded.full_scale or prepared.full_scale,
        channels=channels,
        allow_missing=False,
        name="restored",
    ).images
    return judge_prepared(prepared, images, vibration, joint=joint, most_pairs=most_pairs)


def judge_prepared(
    frames: PreparedFrames,
    restored: Tensor,
    vibration: Motion,
    *,
    joint: bool | int = False,
    most_pairs: int | None = None,
) -> RestorationVerdict:
    """``judge_restoration`` of one stack of prepared frames; restored ones (1, T, C, H, W) are in row order."""
    (verdict,) = judge_stacks(frames, restored, motion_of_frames(frames, vibration), joint=joint, most_pairs=most_pairs)
    if isinstance(verdict, TooLittleInCommonError):
        raise verdict
    return verdict


@torch.no_grad()
def judge_stacks(
    frames: PreparedFrames,
    restored: Tensor,
    motion: FrameMotion,
    stacks: Sequence[int] = (0,),
    *,
    joint: bool | int = False,
    most_pairs: int | None = None,
    columns: int | None = None,
) -> list[RestorationVerdict | TooLittleInCommonError]:
    """Verdicts on some stacks of a batch, or errors if two frames have too little in common.

    Restored frames (B, T, C, H, W), or (B, 1, C, H, W), are in row order, verdicts in image axes. Only the ``columns``
    with the most detail are used.
    """
    most = None if most_pairs is None else check_whole_number("most_pairs", most_pairs, at_least=1)
    pairs = pairs_to_judge(motion.shift.shape[1], joint, most)
    dtype = torch.promote_types(frames.images.dtype, restored.dtype)
    raw, still = (images.to(dtype) for images in frames.compared(restored))
    shared = len(joint_groups(raw.shape[1], joint)[0][0])  # frames from which one image is restored
    verdicts: list[RestorationVerdict | TooLittleInCommonError] = []
    advance = steps(len(stacks), "stacks")
    for stack in stacks:
        missing = None if frames.missing is None else frames.missing[stack]
        moves = [bound > 0 for bound in motion.bounds[stack]]
        advance()
        given = _judged_strip(_Stack(raw[stack], still[stack], missing, motion.of([stack])))
        try:
            judged = [_judge_pair(_common_part(given, *pair, columns), moves, shared) for pair in pairs]
        except TooLittleInCommonError as error:
            verdicts.append(error)
            continue
        # one result for all pairs, in image axes
        levels, displacements, outcomes, reasons = zip(*judged, strict=True)
        sizes = torch.from_numpy(np.stack(displacements, 1)).to(raw.device)  # (3, P, 2)
        sizes = sizes.flip(-1) if frames.image_timing.scan_axis == -1 else sizes
        of_levels = torch.tensor(levels, dtype=torch.float64, device=raw.device).unbind(-1)
        verdict = RestorationVerdict(
            **dict(zip(LEVELS, of_levels, strict=True)),
            **dict(zip(DISPLACEMENTS, sizes, strict=True)),
            outcome=outcomes,
            findings=tuple(reasons_from_row_order(of_pair, frames.image_timing) for of_pair in reasons),
        )
        verdicts.append(verdict)
    return verdicts


def pairs_to_judge(count: int, joint: bool | int, most: int | None = None) -> list[tuple[int, int]]:
    """Pairs of ``count`` frames to compare, at most ``most`` of them, evenly spread."""
    middle = count // 2
    pairs = [(p, p + 1) for p in range(count - 1)]
    if joint is True:
        pairs = [(middle, p) for p in range(count) if p != middle]
    if most is None or len(pairs) <= most:
        return pairs
    return [pairs[index] for index in np.rint(np.linspace(0, len(pairs) - 1, most)).astype(int)]


@dataclass(frozen=True, eq=False)
class _Stack:
    """Raw frames of a stack in row order, and the frames restored from them."""

    images: Tensor  # (T, C, H, W)
    restored: Tensor  # likewise, or (1, C, H, W) in the coordinates of the earlier frame of each pair
    missing: Tensor | None  # (T, C, H, W) bool, pixels without data
    motion: FrameMotion  # a batch of one


def _judged_strip(given: _Stack) -> _Stack:
    """The part of the frames by which their restoration is judged.

    With roll or zoom, this is a strip of columns: of those in the middle of both halves, the one with more detail.
    """
    motion, (height, width) = given.motion, given.images.shape[-2:]
    if motion.vibration.same_for_all_columns:
        motion.check_fits(width)
        return given
    strip = min(_STRIP, width // 2)
    halves = [slice(middle - strip // 2, middle - strip // 2 + strip) for middle in (width // 4, width - width // 4)]
    both = torch.cat([given.images[:1, ..., half] for half in halves], -1)
    (detailed,) = detailed_parts(both[None], strip)
    half = halves[0 if detailed.start < strip // 2 else 1]
    column = torch.tensor([half.start + 0.5 * (strip - width)], dtype=torch.float64, device=both.device)
    starts = tuple(motion.frame_starts.tolist())
    of_strip = ColumnMotion(motion.vibration, column, starts, motion.timing.row_time, height)
    return _Stack(
        given.images[..., half],
        given.restored[..., half],
        None if given.missing is None else given.missing[..., half],
        frame_motion(of_strip, motion.timing, motion.frame_starts, height),
    )


@dataclass(frozen=True, eq=False)
class FramePair:
    """The common part of two raw frames and of their restored frames, (C, h, w) each."""

    earlier: Tensor  # raw
    later: Tensor  # raw
    restored: Tensor  # restored from the earlier frame, or the one image of all frames
    restored_later: Tensor | None  # restored from the later frame; None where there is one image
    predicted: Tensor  # the later raw frame, formed from ``restored``
    changed_later: Tensor  # change of the restored later frame by the motion of that frame
    offset: Tensor  # (2,) px, root-mean-square displacement between the two frames by the motion, axes (x, y)
    # (2, C, h, w) bool, pixels of the raw frames without data; they hold the values that the restored frames predict
    missing: Tensor | None


def _common_part(given: _Stack, earlier: int, later: int, columns: int | None) -> FramePair:
    """Cut two frames to their common part; rows are those of the later one.

    Of the columns, those with the most detail are kept; None for all.
    """
    # 1. The displacement (y, x) in whole px of the content from the earlier to the later frame, and the displacement of
    # single rows beyond it, with a margin: so much at the ends of the common part is not compared.
    motion = given.motion.of([0], [earlier, later])
    displacement, node_weights = motion.exposures
    moved = (displacement[0] * node_weights[:, None]).sum(-2) - motion.shift[0][:, None]  # (2, R, 2)
    step, reach = table(torch.stack([motion.shift[0].diff(dim=0)[0], moved.abs().amax((0, 1))]).flip(-1))
    (down, right), (rim_y, rim_x) = step.astype(int).tolist(), (np.ceil(reach).astype(int) + _MARGIN).tolist()
    height, width = given.images.shape[-2] - abs(down), given.images.shape[-1] - abs(right)
    if min(height - 2 * rim_y, width - 2 * rim_x) < 2 * _RIM + 3:  # smaller than the filters
        raise TooLittleInCommonError(
            f"frames {earlier} and {later} have nothing in common, or too little: they lie ({right}, {down}) px apart"
        )
    top, left, later_top, later_left = max(-down, 0), max(-right, 0), max(down, 0), max(right, 0)
    if columns is not None:
        second = given.images[later, :, later_top : later_top + height, later_left + rim_x : later_left + width - rim_x]
        (detailed,) = detailed_parts(second[None, None], columns)
        left, later_left = left + detailed.start, later_left + detailed.start
        width = detailed.stop - detailed.start + 2 * rim_x

    def before(images: Tensor) -> Tensor:
        return images[..., top : top + height, left : left + width]

    def after(images: Tensor) -> Tensor:
        return images[..., later_top : later_top + height, later_left : later_left + width]

    # 2. Both restored frames with the motion of the later frame.
    single = len(given.restored) == 1
    first, second = before(given.images[earlier]), after(given.images[later])
    still = before(given.restored[0 if single else earlier])
    still_later = still if single else after(given.restored[later])
    predicted, formed_later = reblur(torch.stack([still, still_later]), motion, 1, later_top)
    # 3. Predicted values at missing pixels, and the part that is compared.
    inner = (..., slice(rim_y, height - rim_y), slice(rim_x, width - rim_x))
    missing = None
    if given.missing is not None:
        missing = torch.stack([before(given.missing[earlier]), after(given.missing[later])])
        first = torch.where(missing[0], reblur(still, motion, 0, top), first)
        second = torch.where(missing[1], predicted, second)
        missing = missing[inner]
    return FramePair(
        first[inner],
        second[inner],
        still[inner],
        None if single else still_later[inner],
        predicted[inner],
        formed_later[inner] - still_later[inner],
        moved.diff(dim=0)[0].square().mean(0).sqrt(),
        missing,
    )


def reblur(scene: Tensor, motion: FrameMotion, frame: int, first_row: int) -> Tensor:
    """Form a frame of a stack from restored scenes (..., h, w) (Eq. 9), independently of the restoration method.

    Scenes are in row order, in the coordinates in which the frame is restored, and their row 0 is ``first_row`` of the
    frame; they may be a part of the rows and columns, and are mirrored beyond.
    """
    # displacement of each row during its exposure
    degree, (height, width) = 5, scene.shape[-2:]
    rows = torch.arange(height, device=scene.device)
    displacement, node_weights = motion.exposures
    along, across = (displacement[0, frame, first_row + rows] - motion.shift[0, frame]).unbind(-1)
    place = rows[:, None] - across
    low, high = place.aminmax(dim=-1)
    reach, blur = torch.stack([along.abs().amax(), (high - low).amax()]).tolist()
    # spectra of the spline coefficients, and a few rows of the frame at a time
    length = extended_length(width, math.ceil(reach))
    u = torch.fft.rfftfreq(length, dtype=scene.dtype, device=scene.device)
    spectra, along = spline_spectra(scene, degree, length), along.to(scene.dtype)
    step = at_once(16 * (degree + 1 + math.ceil(blur)) * len(u), scene.device, cpu_bytes=2**25)
    formed = [form_rows(spectra, place[part], along[part], node_weights, u, degree) for part in runs(height, step)]
    return torch.fft.irfft(torch.cat(formed, dim=-2), n=length)[..., :width]


def _mean_square(difference: Tensor) -> Tensor:
    return difference.square().mean(dtype=torch.float64)


def _judge_pair(
    pair: FramePair, moves: list[bool], shared: int
) -> tuple[list[float], Array, Outcome, tuple[Reason, ...]]:
    """Verdict on a pair in row order: ``LEVELS``, ``DISPLACEMENTS`` (3, 2), the outcome and its reasons.

    ``moves`` are the axes with motion, ``shared`` the frames from which one image is restored.
    """
    # 1. Noise of the raw frames; frames that differ in brightness are made equal.
    raw = torch.stack([pair.earlier, pair.later])
    noise = float(valid_mean(np.square(noise_deviation(raw, pair.missing)).ravel(), 0))
    noise = max(0.0 if math.isnan(noise) else noise, _MIN_NOISE**2)
    pair = equally_bright(pair, noise)

    # 2. Displacement between the raw frames, and between the later one and its prediction. An image restored from both
    # frames lies between them, so that its distance from either is the smaller.
    widening = math.sqrt(2.0 * shared / (shared - 1.0)) if shared > 1 else 1.0
    sizes, resolutions = misfit(torch.stack([pair.earlier, pair.predicted]), pair.later.expand(2, *pair.later.shape))
    misfit_before, misfit_after = sizes[0], widening * sizes[1]
    resolution = np.minimum(resolutions[0], widening * resolutions[1])

    # 3. Means over the pixels, which are transferred together. The noise of two restored frames is independent and
    # vanishes in the product of the changes of the scene by the motion.
    unknown = torch.full((), math.nan, dtype=torch.float64, device=raw.device)
    means = [
        _mean_square(pair.later - pair.earlier),
        unknown if pair.restored_later is None else _mean_square(pair.restored_later - pair.restored),
        _mean_square(pair.later - pair.predicted),
        ((pair.predicted - pair.restored) * pair.changed_later).mean(dtype=torch.float64),
        torch.zeros_like(unknown) if pair.missing is None else pair.missing.any(0).double().mean(),
        *pair.offset,
    ]
    before, after, unexplained, change, missing, *offset = torch.stack(means).tolist()

    # 4. Error of the restored frames, from their difference and that of the later frame from its prediction, and of the
    # raw frames: the change of the scene by the motion, and noise.
    error = max(unexplained - noise, 0.0)
    error = float(np.fmax(error, 0.5 * after)) if shared == 1 else error + noise / shared
    gain = 10.0 * math.log10((max(change, 0.0) + noise) / max(error, _MIN_NOISE**2))

    # 5. The outcome; a gain of the opposite sign is not stated.
    axes = (misfit_before.tolist(), misfit_after.tolist(), resolution.tolist())
    outcome, reasons = outcome_of_pair(*axes, moves, offset, gain, one_image=pair.restored_later is None)
    contradicted = (outcome == "worse" and gain > 0) or (outcome in ("helps", "partly") and gain < 0)
    if missing > _MAX_MISSING:
        outcome, reasons = "unknown", (Reason("pixels_missing", None, missing, _MAX_MISSING),)
    levels = [before**0.5, after**0.5, noise**0.5, unexplained / noise, math.nan if contradicted else gain]
    return levels, np.stack([misfit_before, misfit_after, resolution]), outcome, reasons


def equally_bright(pair: FramePair, noise: float) -> FramePair:
    """The pair with the earlier frame, and the images made of it, at the brightness and contrast of the later one.

    Gain and offset are the regression of the later frame on the predicted one, from means over squares of 16 px, which
    are large beside residual displacements. The ``noise`` power draws the gain towards 1.
    """
    side = min(16, *pair.later.shape[-2:])
    means = functional.avg_pool2d(torch.stack([pair.predicted, pair.later]), side).flatten(2).double()  # (2, C, n)
    mean, target = means.mean(-1).unbind()
    predicted, later = means - means.mean(-1, keepdim=True)
    slope = ((predicted * later).mean() + noise) / (predicted.square().mean() + noise)
    if not bool(slope > 0):
        return pair  # frames that contradict each other keep their brightness
    offset = (target - slope * mean).to(pair.later.dtype)[:, None, None]
    gain = slope.to(pair.later.dtype)
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
