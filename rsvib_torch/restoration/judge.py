"""Verdict on a restoration without the true scene: agreement between frames of one scene.

A restored frame, blurred by the motion of the next frame, should equal that next frame. The residual displacement
between the two and the estimated gain in PSNR determine the outcome of every pair of frames, see ``outcome_of_pair``.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rsvib_torch.checks.arguments import ArrayLike, Channels, FramesOrFiles, as_tensor, checks_arguments
from rsvib_torch.checks.values import check_whole_number
from rsvib_torch.execution.parallel import at_once, runs
from rsvib_torch.execution.progress import steps
from rsvib_torch.frames.entry_points import load_frames
from rsvib_torch.frames.pixels import detailed_parts
from rsvib_torch.frames.prepare import PreparedFrames, prepare_frames, reasons_from_row_order
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.numerics.tables import Array, table, take_stacks, valid_mean, without_nan
from rsvib_torch.restoration.frame_motion import FrameMotion, joint_groups, motion_of_frames, vibration_to_undo
from rsvib_torch.restoration.frame_pairs import (
    CommonParts,
    JudgedFrames,
    common_parts,
    cut_pairs,
    equally_bright,
    judged_strip,
    mean_places,
    misfit,
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
_MIN_NOISE = 1e-5  # of full scale; noise level assumed at least, rounding of float32 images


class TooLittleInCommonError(ValueError):
    """Two frames share too little of the scene to be compared."""


class PairVerdict(NamedTuple):
    """Verdict on one pair of frames, in row order."""

    levels: Array  # (5,), ``LEVELS``
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
    given = judged_strip(JudgedFrames(images=raw, restored=still, ignore=frames.missing, motion=motion))
    numbers = np.array([(stack, *pair) for stack in stacks for pair in pairs], np.int64).reshape(-1, 3)
    detailed = None if columns is None else detailed_parts(given.images, columns)
    common = common_parts(given.motion, numbers, given.images.shape[-2:])

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
            verdicts_of_pairs = _judge_pairs(given, take_stacks([common], some), shared, detailed)
            judged |= zip(some.tolist(), verdicts_of_pairs, strict=True)
            advance(len(some))

    # 3. The verdicts on all pairs of each stack.
    verdicts: list[RestorationVerdict | TooLittleInCommonError] = []
    for of_stack in np.arange(len(numbers)).reshape(-1, len(pairs)).tolist():
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
        else:
            verdicts.append(_joined([judged[number] for number in of_stack], frames.image_timing))
    return verdicts


def _joined(pairs: list[PairVerdict], timing: SensorTiming) -> RestorationVerdict:
    """One verdict from those on all pairs of a stack, in image axes."""
    levels, displacements, outcomes, reasons = zip(*pairs, strict=True)
    moved = torch.from_numpy(np.stack(displacements, 1))  # (3, P, 2)
    moved = moved.flip(-1) if timing.scan_axis == -1 else moved
    return RestorationVerdict(
        **dict(zip(LEVELS, torch.from_numpy(np.stack(levels, 1)), strict=True)),
        **dict(zip(DISPLACEMENTS, moved, strict=True)),
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


def _mean(values: Tensor) -> Tensor:
    """Mean (N,) over the pixels of N pairs (N, C, h, w)."""
    return values.mean((1, 2, 3), dtype=torch.float64)


def _judge_pairs(
    given: JudgedFrames, common: CommonParts, shared: int, detailed: list[slice] | None
) -> list[PairVerdict]:
    """Verdicts on pairs of frames in row order, whose common parts have one size.

    ``shared`` are the frames from which one image is restored.
    """
    # 1. Noise of the raw frames; frames that differ in brightness are made equal.
    pairs = cut_pairs(given, common, detailed)
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
    moved = mean_places(given.motion)[common.stack[:, None], common.frames].diff(dim=1)[:, 0]  # (N, R, 2)
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
    verdicts: list[PairVerdict] = []
    levels = np.stack([np.sqrt(before), np.sqrt(after), np.sqrt(noise), unexplained / noise, gain], 1)
    single, offsets = pairs.restored_later is None, np.stack(offset, 1)
    for n, (raw_misfit, rest, resolution) in enumerate(displacements.tolist()):
        moves, between = common.moves[n].tolist(), offsets[n].tolist()
        outcome, reasons = outcome_of_pair(
            raw_misfit, rest, resolution, moves, between, float(gain[n]), one_image=single
        )
        if (outcome == "worse" and gain[n] > 0) or (outcome in ("helps", "partly") and gain[n] < 0):
            levels[n, -1] = math.nan
        if missing[n] > _MAX_MISSING:
            outcome, reasons = "unknown", (Reason("pixels_missing", None, float(missing[n]), _MAX_MISSING),)
        verdicts.append(PairVerdict(levels[n], displacements[n], outcome, reasons))
    return verdicts
