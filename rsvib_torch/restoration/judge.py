"""Verdict on a restoration without the true scene: agreement between frames of one scene.

A restored frame, blurred by the motion of the next frame, should equal that next frame. The residual displacement
between the two and the estimated gain in PSNR determine the outcome of every pair of frames, see ``outcome_of_pair``.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

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
from rsvib_torch.frames.pixels import cut_parts
from rsvib_torch.frames.prepare import PreparedFrames, prepare_frames, reasons_from_row_order
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.numerics.tables import Array, table, take_stacks, valid_mean, without_nan
from rsvib_torch.restoration.frame_motion import (
    FrameMotion,
    MovingFrames,
    joint_groups,
    motion_of_frames,
    vibration_to_undo,
)
from rsvib_torch.restoration.frame_pairs import (
    CommonParts,
    common_parts,
    judged_columns,
    misfit,
    reblur,
)
from rsvib_torch.restoration.noise import noise_deviation
from rsvib_torch.restoration.restoration_verdict import DISPLACEMENTS, Outcome, RestorationVerdict, outcome_of_pair
from rsvib_torch.results.reason import Reason

_NEAR = 8  # px around missing pixels within which the restored frame is a guess
_MIN_NOISE = 1e-5  # of full scale; noise level assumed at least, rounding of float32 images
_MAX_MISSING = 0.5  # share of the pixels of a pair without data, above which it is not judged


class TooLittleInCommonError(ValueError):
    """Two frames share too little of the scene to be compared."""


class PairVerdict(NamedTuple):
    """Verdict on one pair of frames, in row order."""

    gain: float  # dB
    displacements: Array  # (3, 2), ``DISPLACEMENTS``
    outcome: Outcome
    reasons: tuple[Reason, ...]


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
    frames do, noise and ringing included (``predicted_gain``). A vibration that displaces all frames alike (at a
    blind frequency) is not visible in these quantities; the outcome is then ``"unknown"``.

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
    # 1. Restored images at the pixels of the frames; on the finer grid, these are every second point.
    loaded = load_frames(restored, full_scale)
    images = as_tensor("restored", loaded.frames)
    shapes = [prepared.restored_shape(1 if joint is True else prepared.images.shape[1], scale) for scale in (1, 2)]
    if tuple(images.shape) not in shapes:
        raise ValueError(
            f"restored must have the shape {shapes[0]}, or {shapes[1]} with scale=2, got {tuple(images.shape)}"
        )
    step = 1 + shapes.index(tuple(images.shape))
    channels_last = images.ndim == 4 and prepared.channel_axis == -1
    images = images[:, ::step, ::step] if channels_last else images[..., ::step, ::step]
    # 2. The part of the vibration that was undone, and the verdict.
    vibration, _ = vibration_to_undo(vibration, timing)
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
    motion = motion_of_frames(frames, vibration)
    (verdict,) = judge_stacks(frames, restored, motion, joint=joint, most_pairs=most_pairs)
    if isinstance(verdict, TooLittleInCommonError):
        raise verdict
    return verdict.to(restored.device)


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
    """Verdicts on some stacks of a batch, on the CPU, or errors if two frames have too little in common.

    Restored frames (B, T, C, H, W), or (B, 1, C, H, W), are in row order. Only the ``columns`` with the most detail are
    used.
    """
    # 1. The pairs of frames of all stacks, and what they have in common.
    most = None if most_pairs is None else check_whole_number("most_pairs", most_pairs, at_least=1)
    pairs = pairs_to_judge(motion.shift.shape[1], joint, most)
    dtype = torch.promote_types(frames.images.dtype, restored.dtype)
    raw, still = (images.to(dtype) for images in frames.compared(restored))
    moving, still = judged_columns(MovingFrames(raw, motion, frames.missing), still, columns)
    numbers = np.array([(stack, *pair) for stack in stacks for pair in pairs], np.int64).reshape(-1, 3)
    common = common_parts(moving.motion, numbers, moving.images.shape[-2:])

    # 2. Pairs whose common parts have the same size are judged together, as many as the memory allows.
    shared = len(joint_groups(raw.shape[1], joint)[0][0])  # frames from which one image is restored
    advance = steps(int(common.is_enough.sum()), "pairs of frames")
    judged: dict[int, PairVerdict] = {}
    sizes, group = np.unique(np.concatenate([common.size, common.rim], 1), axis=0, return_inverse=True)
    for number, size in enumerate(sizes):
        members = np.flatnonzero(common.is_enough & (group == number))
        pair_bytes = 64 * raw.shape[2] * int(size[:2].prod())
        for part in runs(len(members), at_once(pair_bytes, raw.device, cpu_bytes=2**26)):
            some = members[part]
            verdicts_of_pairs = _judge_pairs(moving, still, take_stacks([common], some), shared)
            judged |= zip(some.tolist(), verdicts_of_pairs, strict=True)
            advance(len(some))

    # 3. The verdicts on all pairs of each stack.
    verdicts: list[RestorationVerdict | TooLittleInCommonError] = []
    for of_stack in np.arange(len(numbers)).reshape(-1, len(pairs)).tolist():
        unjudged = [number for number in of_stack if number not in judged]
        if unjudged:
            (earlier, later), (down, right) = common.frames[unjudged[0]], common.step[unjudged[0]]
            height, width = moving.images.shape[-2:]
            verdicts.append(
                TooLittleInCommonError(
                    f"frames {earlier} and {later} have nothing in common, or too little: they lie ({right}, {down}) "
                    f"px apart, in frames of {width} x {height} px whose rows move"
                )
            )
        else:
            verdicts.append(_joined([judged[number] for number in of_stack], frames.image_timing))
    return verdicts


def _joined(pairs: list[PairVerdict], timing: SensorTiming) -> RestorationVerdict:
    """One verdict from those on all pairs of a stack, in image axes."""
    gains, displacements, outcomes, reasons = zip(*pairs, strict=True)
    joined = torch.from_numpy(np.stack(displacements, 1))  # (3, P, 2)
    joined = joined.flip(-1) if timing.scan_axis == -1 else joined
    return RestorationVerdict(
        **dict(zip(DISPLACEMENTS, joined, strict=True)),
        predicted_gain=torch.tensor(gains, dtype=torch.float64, device="cpu"),
        outcome=outcomes,
        findings=tuple(reasons_from_row_order(of_pair, timing) for of_pair in reasons),
    )


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
class FramePairs:
    """The common parts of N pairs of raw frames and of their restored frames, (N, C, h, w) each.

    The earlier frame, and the images made of it, have the brightness and contrast of the later one.
    """

    earlier: Tensor  # raw
    later: Tensor  # raw
    restored: Tensor  # restored from the earlier frame, or the one image of all frames
    restored_later: Tensor | None  # restored from the later frame; None where there is one image
    predicted: Tensor  # the later raw frame, formed from ``restored``
    changed_later: Tensor  # change of the restored later frame by the motion of that frame
    missing: Array  # (N,) share of the pixels without data
    noise: Array  # (N,) power of the noise of the raw frames


def cut_pairs(moving: MovingFrames, restored: Tensor, common: CommonParts) -> FramePairs:
    """Cut pairs of frames, and those restored from them, to their common parts, which have one size.

    Restored frames are as the images of the given ones, or (B, 1, C, H, W) in the coordinates of the earlier frame of
    each pair. Rows are those of the later frame. Pixels of the raw frames without data hold what the restored frames
    predict.
    """
    (height, width), (rim_y, rim_x) = common.size[0].tolist(), common.rim[0].tolist()
    (earlier, later), single = common.frames.T, restored.shape[1] == 1
    first, second = common.firsts[:, 0], common.firsts[:, 1]

    def cut(images: Tensor, frame: NDArray[np.int64], place: NDArray[np.int64]) -> Tensor:
        return cut_parts(images, (common.stack, frame), place[:, 0], place[:, 1], (height, width))

    # 1. Both restored frames with the motion of the later frame.
    raw, raw_later = cut(moving.images, earlier, first), cut(moving.images, later, second)
    still = cut(restored, np.zeros_like(earlier) if single else earlier, first)
    still_later = still if single else cut(restored, later, second)
    stills = torch.stack([still, still_later], 1)
    predicted, formed_later = reblur(stills, moving.motion, common.stack, later, second[:, 0]).unbind(1)
    changed = formed_later - still_later
    # 2. Predicted values at missing pixels, and the part that is compared.
    inner = (..., slice(rim_y, height - rim_y), slice(rim_x, width - rim_x))
    missing, share = None, np.zeros(len(raw))
    if moving.ignore is not None:
        missing = torch.stack([cut(moving.ignore, earlier, first), cut(moving.ignore, later, second)], 1)
        of_earlier = reblur(still[:, None], moving.motion, common.stack, earlier, first[:, 0])[:, 0]
        raw = torch.where(missing[:, 0], of_earlier, raw)
        # what was restored near missing pixels of the earlier frame is a guess, which the later frame does not confirm
        near = functional.max_pool2d(missing[:, 0].to(raw.dtype), 2 * _NEAR + 1, 1, _NEAR) > 0
        raw_later = torch.where(missing[:, 1] | (near & (not single)), predicted, raw_later)
        still_later = torch.where(near, still, still_later)
        missing = missing[inner]
        share = table(missing.any(1).double().mean((1, 2, 3)))
    images = [values[inner] for values in (raw, still, predicted, raw_later, still_later, changed)]
    raw, still, predicted, raw_later, still_later, changed = images
    # 3. Noise of the raw frames. The earlier one, and what is made of it, at the brightness and contrast of the later
    # one: gain and offset of the regression of the later frame on the predicted one, by means over squares of 16 px,
    # which are large beside residual displacements. Noise draws the gain towards 1, and frames that contradict each
    # other keep their brightness.
    deviation = noise_deviation(torch.stack([raw, raw_later], 1), missing)
    noise = valid_mean(np.square(deviation).reshape(len(raw), -1), 1)
    noise = np.maximum(without_nan(noise, 0.0), _MIN_NOISE**2)
    power = torch.as_tensor(noise, device=raw.device)
    means = functional.avg_pool2d(torch.cat([predicted, raw_later]), min(16, *raw.shape[-2:])).flatten(2).double()
    means = means.unflatten(0, (2, -1))  # (2, N, C, n)
    mean, target = means.mean(-1).unbind()
    one, other = means - means.mean(-1, keepdim=True)
    slope = ((one * other).mean((1, 2)) + power) / (one.square().mean((1, 2)) + power)
    offset = torch.where(slope[:, None] > 0, target - slope[:, None] * mean, 0.0).to(raw.dtype)[..., None, None]
    gain = torch.where(slope > 0, slope, 1.0).to(raw.dtype)[:, None, None, None]
    raw, still, predicted = (torch.addcmul(offset, values, gain) for values in (raw, still, predicted))
    if single:
        return FramePairs(raw, raw_later, still, None, predicted, gain * changed, share, noise)
    return FramePairs(raw, raw_later, still, still_later, predicted, changed, share, noise)


def _judge_pairs(moving: MovingFrames, restored: Tensor, common: CommonParts, shared: int) -> list[PairVerdict]:
    """Verdicts on pairs of frames in row order, whose common parts have one size.

    ``shared`` are the frames from which one image is restored.
    """
    pairs = cut_pairs(moving, restored, common)
    single, noise = pairs.restored_later is None, pairs.noise

    # 1. Displacement between the raw frames, and between the later one and its prediction. An image restored from both
    # frames lies between them, so that its distance from either is the smaller.
    widening = np.array([1.0, math.sqrt(2.0 * shared / (shared - 1.0)) if shared > 1 else 1.0])[:, None, None]
    both = torch.stack([pairs.earlier, pairs.predicted])
    sizes, resolutions = (values * widening for values in misfit(both, pairs.later.expand_as(both)))
    displacements = np.stack([*sizes, resolutions.min(0)], 1)  # (N, 3, 2)

    # 2. Means over the pixels, which are transferred together. The noise of two restored frames is independent and
    # vanishes in the product of the changes of the scene by the motion.
    later = pairs.restored if pairs.restored_later is None else pairs.restored_later
    squares = [
        (later - pairs.restored).square(),
        (pairs.later - pairs.predicted).square(),
        (pairs.predicted - pairs.restored) * pairs.changed_later,
    ]
    displacement = moving.motion.mean_displacement[common.stack[:, None], common.frames].diff(dim=1)[:, 0]  # (N, R, 2)
    means = [values.mean((1, 2, 3), dtype=torch.float64) for values in squares]
    after, unexplained, change, *offset = table(torch.stack([*means, *displacement.square().mean(1).sqrt().unbind(-1)]))

    # 3. Error of the restored frames, from their difference and that of the later frame from its prediction, and of the
    # raw frames: the change of the scene by the motion, and noise.
    error = (unexplained - noise).clip(0.0)
    error = np.maximum(error, 0.5 * after) if shared == 1 else error + noise / shared
    gains = 10.0 * np.log10((change.clip(0.0) + noise) / error.clip(_MIN_NOISE**2))

    # 4. The outcomes; a gain of the opposite sign is not stated.
    verdicts: list[PairVerdict] = []
    measured = zip(displacements.tolist(), np.stack(offset, 1).tolist(), gains.tolist(), strict=True)
    for n, ((raw_misfit, remaining, resolution), between, gain) in enumerate(measured):
        moves = common.moves[n].tolist()
        outcome, reasons = outcome_of_pair(raw_misfit, remaining, resolution, moves, between, gain, one_image=single)
        is_stated = outcome == "unknown" or (gain <= 0 if outcome == "worse" else gain >= 0)
        if pairs.missing[n] > _MAX_MISSING:
            outcome, reasons = "unknown", (Reason("pixels_missing", None, float(pairs.missing[n]), _MAX_MISSING),)
        verdicts.append(PairVerdict(gain if is_stated else math.nan, displacements[n], outcome, reasons))
    return verdicts
