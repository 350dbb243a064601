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
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from rsvib_torch.checks.arguments import ArrayLike, Channels, FramesOrFiles, as_tensor, checks_arguments
from rsvib_torch.checks.values import check_whole_number
from rsvib_torch.execution.parallel import at_once, runs
from rsvib_torch.execution.progress import steps
from rsvib_torch.frames.entry_points import load_frames
from rsvib_torch.frames.pixels import cut_columns, cut_parts, detailed_parts
from rsvib_torch.frames.prepare import PreparedFrames, prepare_frames, reasons_from_row_order
from rsvib_torch.imaging.blur import form_rows
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.motion import ColumnMotion, Motion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.numerics.interpolation import correlated, extended_length, spline_spectra
from rsvib_torch.numerics.tables import Array, table, tables, take_stacks, valid_mean, without_nan
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
_NEAR = 8  # px around missing pixels within which the restored frame is a guess
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
    # 1. The pairs of frames of all stacks, and what they have in common.
    most = None if most_pairs is None else check_whole_number("most_pairs", most_pairs, at_least=1)
    pairs = pairs_to_judge(motion.shift.shape[1], joint, most)
    dtype = torch.promote_types(frames.images.dtype, restored.dtype)
    raw, still = (images.to(dtype) for images in frames.compared(restored))
    given = _judged_strip(_JudgedFrames(raw, still, frames.missing, motion))
    numbers = np.array([(stack, *pair) for stack in stacks for pair in pairs], np.int64).reshape(-1, 3)
    detailed = None if columns is None else detailed_parts(given.images, columns)
    common = _common_parts(given.motion, numbers, given.images.shape[-2:])

    # 2. Pairs whose common parts have the same size are judged together, as many as the memory allows.
    shared = len(joint_groups(raw.shape[1], joint)[0][0])  # frames from which one image is restored
    advance = steps(len(numbers), "pairs of frames")
    judged: dict[int, _PairVerdict] = {}
    sizes, group = np.unique(np.concatenate([common.size, common.rim], 1), axis=0, return_inverse=True)
    for number, size in enumerate(sizes):
        members = np.flatnonzero(common.is_enough & (group == number))
        pair_bytes = 64 * raw.shape[2] * int(size[:2].prod())
        for part in runs(len(members), at_once(pair_bytes, raw.device, cpu_bytes=2**26)):
            some = members[part]
            verdicts_of_pairs = _judge_pairs(given, take_stacks([common], some), shared, detailed)
            judged |= zip(some.tolist(), verdicts_of_pairs, strict=True)
            advance(len(some))

    # 3. One verdict for all pairs of a stack, in image axes.
    verdicts: list[RestorationVerdict | TooLittleInCommonError] = []
    for first in range(0, len(numbers), len(pairs)):
        of_stack = range(first, first + len(pairs))
        apart = [number for number in of_stack if number not in judged]
        if apart:
            (earlier, later), (down, right) = common.frames[apart[0]], common.step[apart[0]]
            height, width = given.images.shape[-2:]
            verdicts.append(
                TooLittleInCommonError(
                    f"frames {earlier} and {later} have nothing in common, or too little: they lie ({right}, {down}) "
                    f"px apart, in frames of {width} x {height} px whose rows move"
                )
            )
            continue
        levels, displacements, outcomes, reasons = zip(*(judged[number] for number in of_stack), strict=True)
        moved = torch.from_numpy(np.stack(displacements, 1)).to(raw.device)  # (3, P, 2)
        moved = moved.flip(-1) if frames.image_timing.scan_axis == -1 else moved
        of_levels = torch.tensor(np.array(levels), dtype=torch.float64, device=raw.device).unbind(-1)
        verdict = RestorationVerdict(
            **dict(zip(LEVELS, of_levels, strict=True)),
            **dict(zip(DISPLACEMENTS, moved, strict=True)),
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
class _JudgedFrames:
    """Raw frames of B stacks in row order, and the frames restored from them."""

    images: Tensor  # (B, T, C, H, W)
    restored: Tensor  # likewise, or (B, 1, C, H, W) in the coordinates of the earlier frame of each pair
    missing: Tensor | None  # (B, T, C, H, W) bool, pixels without data
    motion: FrameMotion


def _judged_strip(given: _JudgedFrames) -> _JudgedFrames:
    """The part of the frames by which their restoration is judged.

    With roll or zoom, this is a strip of columns: of those in the middle of both halves, the one with more detail.
    """
    motion, (height, width) = given.motion, given.images.shape[-2:]
    if motion.vibration.same_for_all_columns:
        motion.check_fits(width)
        return given
    strip = min(_STRIP, width // 2)
    halves = [slice(middle - strip // 2, middle - strip // 2 + strip) for middle in (width // 4, width - width // 4)]
    both = torch.cat([given.images[:, :1, ..., half] for half in halves], -1)
    chosen = [halves[0 if detailed.start < strip // 2 else 1] for detailed in detailed_parts(both, strip)]
    middles = [half.start + 0.5 * (strip - width) for half in chosen]
    columns = torch.tensor(middles, dtype=torch.float64, device=both.device)
    starts = tuple(motion.frame_starts.tolist())
    of_strips = ColumnMotion(motion.vibration, columns, starts, motion.timing.row_time, height)
    return _JudgedFrames(
        cut_columns(given.images, chosen),
        cut_columns(given.restored, chosen),
        None if given.missing is None else cut_columns(given.missing, chosen),
        frame_motion(of_strips, motion.timing, motion.frame_starts, height),
    )


@dataclass(frozen=True, eq=False)
class _CommonParts:
    """What N pairs of frames have in common."""

    stack: NDArray[np.int64]  # (N,)
    frames: NDArray[np.int64]  # (N, 2) the earlier and the later one
    moves: NDArray[np.bool_]  # (N, 2) whether the axis (x, y) moves in this stack
    step: NDArray[np.int64]  # (N, 2) displacement (y, x) in whole px of the content from the earlier to the later frame
    size: NDArray[np.int64]  # (N, 2) rows and columns of the part
    rim: NDArray[np.int64]  # (N, 2) rows and columns at its ends that are not compared

    @property
    def is_enough(self) -> NDArray[np.bool_]:
        """(N,) whether the compared part is larger than the filters."""
        enough: NDArray[np.bool_] = (self.size - 2 * self.rim).min(1) >= 2 * _RIM + 3
        return enough


def _common_parts(motion: FrameMotion, pairs: NDArray[np.int64], shape: torch.Size) -> _CommonParts:
    """Common parts of pairs (N, 3) of a stack, an earlier and a later frame of it, in frames of a shape."""
    stack, frames, extent = pairs[:, 0], pairs[:, 1:], np.array(shape)
    # rows are displaced by so much beyond the content of their frame, axes (y, x)
    moved = _mean_places(motion)
    shift, reach = (values[stack[:, None], frames][..., ::-1] for values in tables(motion.shift, moved.abs().amax(-2)))
    step = (shift[:, 1] - shift[:, 0]).astype(np.int64)
    # sizes change in steps, so that many pairs have the same
    unit = np.clip(extent // 32, _MARGIN, 4 * _MARGIN)
    rim = np.ceil((reach.max(1) + _MARGIN) / unit).astype(np.int64) * unit
    size = extent + -abs(step) // unit * unit
    return _CommonParts(stack, frames, np.array(motion.bounds)[stack, :2] > 0, step, size, rim)


def _mean_places(motion: FrameMotion) -> Tensor:
    """Mean displacement (B, T, R, 2) in px of every row during its exposure, beyond the shift of its frame."""
    displacement, node_weights = motion.exposures
    return (displacement * node_weights[:, None]).sum(-2) - motion.shift[:, :, None]


@dataclass(frozen=True, eq=False)
class FramePairs:
    """The common parts of N pairs of raw frames and of their restored frames, (N, C, h, w) each."""

    earlier: Tensor  # raw
    later: Tensor  # raw
    restored: Tensor  # restored from the earlier frame, or the one image of all frames
    restored_later: Tensor | None  # restored from the later frame; None where there is one image
    predicted: Tensor  # the later raw frame, formed from ``restored``
    changed_later: Tensor  # change of the restored later frame by the motion of that frame
    # (N, 2, C, h, w) bool, pixels of the raw frames without data; they hold the values that the restored frames predict
    missing: Tensor | None


def _cut_pairs(given: _JudgedFrames, common: _CommonParts, detailed: list[slice] | None) -> FramePairs:
    """Cut pairs of frames to their common parts, which have one size; rows are those of the later frame.

    Of the columns, the ``detailed`` ones of each stack are kept; None for all.
    """
    (height, width), (rim_y, rim_x) = common.size[0].tolist(), common.rim[0].tolist()
    (earlier, later), single = common.frames.T, given.restored.shape[1] == 1
    first, second = (-common.step).clip(0), common.step.clip(0)  # row and column of the part in both frames

    def cut(images: Tensor, frame: NDArray[np.int64], place: NDArray[np.int64]) -> Tensor:
        return cut_parts(images, (common.stack, frame), place[:, 0], place[:, 1], (height, width))

    # 1. Columns with the most detail, which lie in the part.
    if detailed is not None:
        part_width, width = width, min(width, detailed[0].stop - detailed[0].start + 2 * rim_x)
        starts = np.array([columns.start for columns in detailed])[common.stack] - rim_x
        inside = np.clip(starts, second[:, 1], second[:, 1] + part_width - width) - second[:, 1]
        first[:, 1] += inside
        second[:, 1] += inside
    # 2. Both restored frames with the motion of the later frame.
    raw, raw_later = cut(given.images, earlier, first), cut(given.images, later, second)
    still = cut(given.restored, np.zeros_like(earlier) if single else earlier, first)
    still_later = still if single else cut(given.restored, later, second)
    both = torch.stack([still, still_later], 1)
    predicted, formed_later = reblur(both, given.motion, common.stack, later, second[:, 0]).unbind(1)
    # 3. Predicted values at missing pixels, and the part that is compared.
    inner = (..., slice(rim_y, height - rim_y), slice(rim_x, width - rim_x))
    missing, compared_later = None, still_later
    if given.missing is not None:
        missing = torch.stack([cut(given.missing, earlier, first), cut(given.missing, later, second)], 1)
        of_earlier = reblur(still[:, None], given.motion, common.stack, earlier, first[:, 0])[:, 0]
        raw = torch.where(missing[:, 0], of_earlier, raw)
        # what was restored near missing pixels of the earlier frame is a guess, which the later frame does not confirm
        near = functional.max_pool2d(missing[:, 0].to(raw.dtype), 2 * _NEAR + 1, 1, _NEAR) > 0
        raw_later = torch.where(missing[:, 1] | (near & (not single)), predicted, raw_later)
        compared_later = torch.where(near, still, still_later)
        missing = missing[inner]
    return FramePairs(
        raw[inner],
        raw_later[inner],
        still[inner],
        None if single else compared_later[inner],
        predicted[inner],
        (formed_later - still_later)[inner],
        missing,
    )


def reblur(
    scenes: Tensor,
    motion: FrameMotion,
    stack: NDArray[np.int64],
    frame: NDArray[np.int64],
    first_row: NDArray[np.int64],
) -> Tensor:
    """Form frames of stacks from restored scenes (N, ..., h, w) (Eq. 9), independently of the restoration method.

    Scenes are in row order, in the coordinates in which the frame (N,) of the stack (N,) is restored, and their row 0
    is ``first_row`` (N,) of that frame; they may be a part of the rows and columns, and are mirrored beyond.
    """
    # displacement of each row during its exposure
    degree, (height, width) = 5, scenes.shape[-2:]
    displacement, node_weights = motion.exposures
    members = displacement[stack[:, None], frame[:, None], first_row[:, None] + np.arange(height)]
    along, across = (members - motion.shift[stack, frame][:, None, None]).unbind(-1)
    place = torch.arange(height, device=scenes.device)[:, None] - across
    low, high = place.aminmax(dim=-1)
    reach, blur = torch.stack([along.abs().amax(), (high - low).amax()]).tolist()
    # spectra of the spline coefficients (..., N, h, U), and a few rows of the frames at a time
    length = extended_length(width, math.ceil(reach))
    u = torch.fft.rfftfreq(length, dtype=scenes.dtype, device=scenes.device)
    spectra, along = spline_spectra(scenes.movedim(0, -3), degree, length), along.to(scenes.dtype)
    step = at_once(16 * (degree + 1 + math.ceil(blur)) * len(u) * len(scenes), scenes.device)
    formed = [
        form_rows(spectra, place[:, part], along[:, part], node_weights, u, degree) for part in runs(height, step)
    ]
    return torch.fft.irfft(torch.cat(formed, dim=-2), n=length)[..., :width].movedim(-3, 0)


def _mean(values: Tensor) -> Tensor:
    """Mean (N,) over the pixels of N pairs (N, C, h, w)."""
    return values.mean((1, 2, 3), dtype=torch.float64)


_PairVerdict = tuple[Array, Array, Outcome, tuple[Reason, ...]]  # ``LEVELS``, ``DISPLACEMENTS`` (3, 2), the rest


def _judge_pairs(
    given: _JudgedFrames, common: _CommonParts, shared: int, detailed: list[slice] | None
) -> list[_PairVerdict]:
    """Verdicts on pairs of frames in row order, whose common parts have one size.

    ``shared`` are the frames from which one image is restored.
    """
    # 1. Noise of the raw frames; frames that differ in brightness are made equal.
    pairs = _cut_pairs(given, common, detailed)
    raw = torch.stack([pairs.earlier, pairs.later], 1)
    noise = valid_mean(np.square(noise_deviation(raw, pairs.missing)).reshape(len(raw), -1), 1)
    noise = np.maximum(without_nan(noise, 0.0), _MIN_NOISE**2)
    pairs = equally_bright(pairs, torch.as_tensor(noise, device=raw.device))

    # 2. Displacement between the raw frames, and between the later one and its prediction. An image restored from both
    # frames lies between them, so that its distance from either is the smaller.
    widening = np.array([1.0, math.sqrt(2.0 * shared / (shared - 1.0)) if shared > 1 else 1.0])[:, None, None]
    both = torch.stack([pairs.earlier, pairs.predicted])
    sizes, resolutions = (values * widening for values in misfit(both, pairs.later.expand_as(both)))
    displacements = np.stack([*sizes, resolutions.min(0)], 1)  # (N, 3, 2)

    # 3. Means over the pixels, which are transferred together. The noise of two restored frames is independent and
    # vanishes in the product of the changes of the scene by the motion.
    later = pairs.restored if pairs.restored_later is None else pairs.restored_later
    moved = _mean_places(given.motion)[common.stack[:, None], common.frames].diff(dim=1)[:, 0]  # (N, R, 2)
    means = [
        _mean((pairs.later - pairs.earlier).square()),
        _mean((later - pairs.restored).square()),
        _mean((pairs.later - pairs.predicted).square()),
        _mean((pairs.predicted - pairs.restored) * pairs.changed_later),
        torch.zeros_like(moved[:, 0, 0]) if pairs.missing is None else _mean(pairs.missing.any(1).double()),
        *moved.square().mean(1).sqrt().unbind(-1),
    ]
    before, after, unexplained, change, missing, *offset = table(torch.stack(means))
    if pairs.restored_later is None:
        after = np.full_like(after, math.nan)

    # 4. Error of the restored frames, from their difference and that of the later frame from its prediction, and of the
    # raw frames: the change of the scene by the motion, and noise.
    error = (unexplained - noise).clip(0.0)
    error = np.fmax(error, 0.5 * after) if shared == 1 else error + noise / shared
    gain = 10.0 * np.log10((change.clip(0.0) + noise) / error.clip(_MIN_NOISE**2))

    # 5. The outcomes; a gain of the opposite sign is not stated.
    verdicts: list[_PairVerdict] = []
    levels = np.stack([np.sqrt(before), np.sqrt(after), np.sqrt(noise), unexplained / noise, gain], 1)
    for n, (one, moves, between) in enumerate(zip(displacements, common.moves, np.stack(offset, 1), strict=True)):
        single = pairs.restored_later is None
        misfits_of_pair, after_of_pair, resolution = one.tolist()
        outcome, reasons = outcome_of_pair(
            misfits_of_pair,
            after_of_pair,
            resolution,
            moves.tolist(),
            between.tolist(),
            float(gain[n]),
            one_image=single,
        )
        if (outcome == "worse" and gain[n] > 0) or (outcome in ("helps", "partly") and gain[n] < 0):
            levels[n, -1] = math.nan
        if missing[n] > _MAX_MISSING:
            outcome, reasons = "unknown", (Reason("pixels_missing", None, float(missing[n]), _MAX_MISSING),)
        verdicts.append((levels[n], one, outcome, reasons))
    return verdicts


def equally_bright(pairs: FramePairs, noise: Tensor) -> FramePairs:
    """The pairs with the earlier frame, and the images made of it, at the brightness and contrast of the later one.

    Gain and offset are the regression of the later frame on the predicted one, from means over squares of 16 px, which
    are large beside residual displacements. The ``noise`` power (N,) draws the gain towards 1. Frames that contradict
    each other keep their brightness.
    """
    side = min(16, *pairs.later.shape[-2:])
    both = torch.stack([pairs.predicted, pairs.later]).flatten(0, 1)
    means = functional.avg_pool2d(both, side).flatten(2).double().unflatten(0, (2, -1))  # (2, N, C, n)
    mean, target = means.mean(-1).unbind()
    predicted, later = means - means.mean(-1, keepdim=True)
    slope = ((predicted * later).mean((1, 2)) + noise) / (predicted.square().mean((1, 2)) + noise)
    agrees = slope > 0
    offset = torch.where(agrees[:, None], target - slope[:, None] * mean, 0.0).to(pairs.later.dtype)[..., None, None]
    gain = torch.where(agrees, slope, 1.0).to(pairs.later.dtype)[:, None, None, None]
    adjusted = {
        name: torch.addcmul(offset, getattr(pairs, name), gain) for name in ("earlier", "restored", "predicted")
    }
    changed = gain * pairs.changed_later if pairs.restored_later is None else pairs.changed_later
    return replace(pairs, **adjusted, changed_later=changed)


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
