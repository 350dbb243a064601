"""Verdict on a restoration without the true scene: agreement between frames of one scene.

A restored frame, blurred by the motion of the next frame, should equal that next frame. The residual displacement
between the two and the estimated gain in PSNR determine the outcome of every pair of frames, see ``outcome_of_pair``.
All stacks of a batch are judged together.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from rsvib_torch.checks.arguments import checks_arguments
from rsvib_torch.checks.arrays import ArrayLike, Channels, FramesOrFiles, as_tensor
from rsvib_torch.checks.values import check_whole_number
from rsvib_torch.execution.chunking import at_once, runs
from rsvib_torch.execution.progress import steps
from rsvib_torch.frames.loading import load_frames
from rsvib_torch.frames.orientation import reasons_from_row_order
from rsvib_torch.frames.pixels import cut_columns, detailed_parts
from rsvib_torch.frames.prepare import PreparedFrames, prepare_frames
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.field import ColumnMotion
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.numerics.tables import Array, table, valid_mean, without_nan
from rsvib_torch.restoration.frame_motion import FrameMotion, frame_motion, joint_groups, motion_of_frames
from rsvib_torch.restoration.noise import noise_deviation
from rsvib_torch.restoration.verdict.pairs import (
    ComparedFrames,
    FramePairs,
    TooLittleInCommonError,
    equally_bright,
    is_enough,
    misfit,
    overlaps,
    pairs_to_judge,
    shared_part,
)
from rsvib_torch.restoration.verdict.restoration_verdict import (
    DISPLACEMENTS,
    LEVELS,
    OUTCOMES,
    Outcome,
    RestorationVerdict,
)
from rsvib_torch.restoration.verdict.trust import vibration_to_undo
from rsvib_torch.results.reason import Reason

# Thresholds of the two scores of the verdict, fitted on 720 restorations with known truth, see docs/ablation.md.
_PARTLY_RESIDUAL = 0.35  # of the displacement between the raw frames; above, a part of the vibration was not undone
_WORSE_RESIDUAL = 0.8  # of that displacement; above, the vibration was not undone
_GAIN_ERROR = 2.0  # dB; error of the estimated gain, up to which its sign is not used
_FINEST = 0.03  # px; misfit that is negligible in any image
_CROSSTALK = 0.05  # error of a misfit along one axis, relative to the displacement along the other
_MAX_MISSING = 0.5  # share of the pixels of a pair without data, above which it is not judged

_STRIP = 160  # px, width of the strip of columns that is judged with roll or zoom: enough for the means of a pair
_MIN_NOISE = 1e-5  # of full scale; noise level assumed at least, rounding of float32 images


def outcome_of_pair(
    before: list[float],
    after: list[float],
    resolution: list[float],
    moves: list[bool],
    offset: list[float],
    gain: float,
    *,
    one_image: bool = False,
) -> tuple[Outcome, tuple[Reason, ...]]:
    """Outcome of one pair, and the reasons for it; none if restoration helps.

    Scores are the residual displacement relative to that of the raw frames, and the estimated gain in dB. The gain
    decides where the residual is small, because it is valid only where the motion is right. ``before`` and ``after``
    are the misfits (x, y) in px of the raw and of the restored frames, ``offset`` is what the vibration predicts for
    the raw ones, and below the ``resolution`` a misfit cannot be distinguished from 0. ``moves`` are the axes with
    motion. ``one_image`` states that both frames were restored to one image, whose gain is not valid for a wrong
    motion.
    """
    outcomes: list[tuple[Outcome, Reason | None]] = []
    motion_is_complete = True
    for axis, name in enumerate("xy"):
        least, size, rest = max(resolution[axis], _FINEST), before[axis], after[axis]
        if not moves[axis]:
            motion_is_complete &= size <= least
            continue
        negligible = max(least, _CROSSTALK * before[1 - axis])
        visible = max(size, offset[axis])
        details = {"before": size}
        if math.isinf(least):
            outcomes.append(("unknown", Reason("no_contrast", name)))
        elif rest <= negligible and visible <= least:
            outcomes.append(("unknown", Reason("displaced_alike", name, visible, least)))
        elif rest <= max(negligible, _PARTLY_RESIDUAL * size):
            outcomes.append(("helps", None))
        elif rest > _WORSE_RESIDUAL * size:
            # less noise may outweigh a motion that was not undone, but not a motion that does not exist
            outweighed = size > least and gain > _GAIN_ERROR and not one_image
            remains = Reason("motion_remains", name, rest, max(_WORSE_RESIDUAL * size, negligible), details)
            outcomes.append(("partly" if outweighed else "worse", remains))
        else:
            remains = Reason("motion_remains", name, rest, max(_PARTLY_RESIDUAL * size, negligible), details)
            outcomes.append(("partly", remains))
    if not outcomes:
        return "unknown", (Reason("nothing_undone"),)
    outcome = max((outcome for outcome, _ in outcomes), key=OUTCOMES.index)
    reasons = tuple(reason for kind, reason in outcomes if kind == outcome and reason is not None)
    if outcome in ("partly", "worse") or gain >= 0 or not motion_is_complete:
        return outcome, reasons
    if gain < -_GAIN_ERROR:
        return "worse", (Reason("noise_outweighs", None, gain, -_GAIN_ERROR),)
    return "unknown", reasons or (Reason("improvement_uncertain", None, gain, -_GAIN_ERROR),)


def _mean_square(difference: Tensor) -> Tensor:
    """Mean square (B,) of images (B, C, h, w), float64."""
    return difference.square().mean((1, 2, 3), dtype=torch.float64)


def _judge_pairs(
    pair: FramePairs, moves: list[list[bool]], shared: int
) -> tuple[Array, Array, list[tuple[Outcome, tuple[Reason, ...]]]]:
    """Verdict on one pair of each of B stacks, in row order.

    ``moves`` are the axes with motion of each stack, ``shared`` the frames from which one image is restored. The result
    is ``LEVELS`` (5, B), ``DISPLACEMENTS`` (3, B, 2), and the outcome of each stack with its reasons.
    """
    # Noise of the raw frames; frames that differ in brightness are made equal.
    raw = torch.stack([pair.earlier, pair.later], 1)
    noise = valid_mean(np.square(noise_deviation(raw, pair.ignore)).reshape(len(raw), -1), 1)
    noise = np.maximum(without_nan(noise, 0.0), _MIN_NOISE**2)
    pair = equally_bright(pair, noise)

    # Displacement between the raw frames, and between the later one and its prediction. An image restored from both
    # frames lies between them, so that its distance from either is the smaller.
    widening = math.sqrt(2.0 * shared / (shared - 1.0)) if shared > 1 else 1.0
    sizes, resolutions = misfit(torch.stack([pair.earlier, pair.predicted]), torch.stack([pair.later, pair.later]))
    misfit_before, misfit_after = sizes[0], widening * sizes[1]
    resolution = np.minimum(resolutions[0], widening * resolutions[1])

    # Means over the pixels, which are transferred together. The noise of two restored frames is independent and
    # vanishes in the product of the changes of the scene by the motion.
    unknown = torch.full((len(raw),), math.nan, dtype=torch.float64, device=raw.device)
    means = torch.stack(
        [
            _mean_square(pair.later - pair.earlier),
            unknown if pair.restored_later is None else _mean_square(pair.restored_later - pair.restored),
            _mean_square(pair.later - pair.predicted),
            ((pair.predicted - pair.restored) * pair.changed_later).mean((1, 2, 3), dtype=torch.float64),
            torch.zeros_like(unknown) if pair.ignore is None else pair.ignore.any(1).double().mean((1, 2, 3)),
            *pair.offset.unbind(-1),
        ]
    )
    before, after, unexplained, change, missing, *offset = table(means)

    # Error of the restored frames, from their difference and that of the later frame from its prediction, and of the
    # raw frames: the change of the scene by the motion, and noise.
    error = np.maximum(unexplained - noise, 0.0)
    error = np.fmax(error, 0.5 * after) if shared == 1 else error + noise / shared
    gain = 10.0 * np.log10((np.maximum(change, 0.0) + noise) / np.maximum(error, _MIN_NOISE**2))

    # Outcome of each pair.
    displacements = np.stack([misfit_before, misfit_after, resolution])
    figures = np.column_stack([*displacements, *offset, gain, missing])
    outcomes: list[tuple[Outcome, tuple[Reason, ...]]] = []
    contradicted = []
    one_image = pair.restored_later is None
    for (*axes, level, share), moving in zip(figures.tolist(), moves, strict=True):
        outcome, why = outcome_of_pair(axes[:2], axes[2:4], axes[4:6], moving, axes[6:], level, one_image=one_image)
        contradicted.append((outcome == "worse" and level > 0) or (outcome in ("helps", "partly") and level < 0))
        if share > _MAX_MISSING:
            outcome, why = "unknown", (Reason("pixels_missing", None, share, _MAX_MISSING),)
        outcomes.append((outcome, why))
    gain = np.where(contradicted, math.nan, gain)
    levels = np.stack([np.sqrt(before), np.sqrt(after), np.sqrt(noise), unexplained / noise, gain])
    return levels, displacements, outcomes


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
    loaded = load_frames(restored, full_scale)
    expected = 1 if joint is True else prepared.images.shape[1]
    restored = _at_pixels(as_tensor("restored", loaded.frames), prepared, expected)
    count, height = prepared.images.shape[1], prepared.images.shape[-2]
    vibration, _ = vibration_to_undo(vibration, timing, count, height)
    images = prepare_frames(
        restored,
        timing,
        full_scale=loaded.full_scale or prepared.full_scale,
        channels=channels,
        allow_missing=False,
        name="restored",
    ).images
    return judge_prepared(prepared, images, vibration, joint=joint, most_pairs=most_pairs)


def _at_pixels(restored: Tensor, frames: PreparedFrames, count: int) -> Tensor:
    """Restored images at the pixels of the frames, in image axes; ``count`` images, possibly on a finer grid."""
    expected = [frames.restored_shape(count, scale) for scale in (1, 2)]
    if tuple(restored.shape) not in expected:
        raise ValueError(
            f"restored must have the shape {expected[0]}, or {expected[1]} with scale=2, got {tuple(restored.shape)}"
        )
    step = 1 + expected.index(tuple(restored.shape))
    if restored.ndim == 4 and frames.channel_axis == -1:
        return restored[:, ::step, ::step]
    return restored[..., ::step, ::step]


def _judged_strip(frames: ComparedFrames) -> ComparedFrames:
    """The part of the frames by which their restoration is judged.

    With roll or zoom, this is a strip of columns: of those in the middle of both halves, the one with more detail.
    """
    raw, motion, width = frames.images, frames.motion, frames.images.shape[-1]
    if motion.vibration.same_for_all_columns:
        motion.check_fits(width)
        return frames
    strip = min(_STRIP, width // 2)
    halves = [slice(middle - strip // 2, middle - strip // 2 + strip) for middle in (width // 4, width - width // 4)]
    both = torch.cat([raw[..., half] for half in halves], -1)
    parts = [halves[0 if part.start < strip // 2 else 1] for part in detailed_parts(both, strip)]
    middles = [part.start + 0.5 * (strip - 1) - 0.5 * (width - 1) for part in parts]
    columns = torch.tensor(middles, dtype=torch.float64, device=raw.device)
    starts, height = tuple(motion.frame_starts.tolist()), motion.num_rows
    of_strips = ColumnMotion(motion.vibration, columns, starts, motion.timing.row_time, height)
    of_frames = frame_motion(of_strips, motion.timing, motion.frame_starts, height)
    return replace(frames.mapped(lambda values: cut_columns(values, parts)), motion=of_frames)


def judge_prepared(
    frames: PreparedFrames,
    restored: Tensor,
    vibration: Motion,
    *,
    joint: bool | int = False,
    most_pairs: int | None = None,
) -> RestorationVerdict:
    """``judge_restoration`` of one stack of frames that are already prepared; arguments as in ``judge_stacks``."""
    motion = motion_of_frames(frames, vibration)
    moves = {0: [bound > 0 for bound in motion.bounds[0]]}
    (verdict,) = judge_stacks(frames, restored, motion, moves, joint=joint, most_pairs=most_pairs)
    if isinstance(verdict, TooLittleInCommonError):
        raise verdict
    return verdict


@torch.no_grad()
def judge_stacks(
    frames: PreparedFrames,
    restored: Tensor,
    motion: FrameMotion,
    moves: dict[int, list[bool]],
    *,
    joint: bool | int = False,
    most_pairs: int | None = None,
    columns: int | None = None,
) -> list[RestorationVerdict | TooLittleInCommonError]:
    """Verdicts on stacks of a batch, which are judged together, or errors if two frames have too little in common.

    Restored frames (B, T, C, H, W), or (B, 1, C, H, W), are in row order, verdicts in image axes. ``moves`` has the
    stacks to judge with their axes with motion. Only the ``columns`` with the most detail are used.
    """
    limit = None if most_pairs is None else check_whole_number("most_pairs", most_pairs, at_least=1)
    dtype = torch.promote_types(frames.images.dtype, restored.dtype)
    raw, still = (images.to(dtype) for images in frames.compared(restored))
    every = ComparedFrames(images=raw, restored=still, ignore=frames.missing, motion=motion)
    count = raw.shape[1]
    pairs = pairs_to_judge(count, joint, limit)
    # only the frames that are compared, if these are some of a long stack
    numbers = sorted({frame for pair in pairs for frame in pair})
    if len(numbers) < count:
        every = every.of_stacks(list(range(len(raw))), numbers)
    compared = [(numbers.index(earlier), numbers.index(later)) for earlier, later in pairs]
    shared = len(joint_groups(count, joint)[0][0])  # frames from which one image is restored
    advance = steps(len(moves), "stacks")

    # as many stacks at a time as the memory allows
    pixels = raw.shape[2] * raw.shape[3] * min(columns or raw.shape[4], raw.shape[4])
    together = at_once(16 * pixels, raw.device, cpu_bytes=2**26)
    verdicts: list[RestorationVerdict | TooLittleInCommonError] = []
    for chosen in (list(moves)[part] for part in runs(len(moves), together)):
        some = every if len(chosen) == len(raw) else every.of_stacks(chosen)  # all are judged without a copy
        moving = [moves[stack] for stack in chosen]
        verdicts += _judge_batch(_judged_strip(some), moving, compared, numbers, shared, columns, frames.image_timing)
        advance(len(chosen))
    return verdicts


def _judge_batch(
    frames: ComparedFrames,
    moves: list[list[bool]],
    pairs: list[tuple[int, int]],
    numbers: list[int],
    shared: int,
    columns: int | None,
    timing: SensorTiming,
) -> list[RestorationVerdict | TooLittleInCommonError]:
    """Verdicts on all stacks of a batch, whose displacement depends on the row only.

    The ``pairs`` are counted among the frames that are compared, which have ``numbers`` in the stack. One image is
    restored from ``shared`` frames. The timing is in image orientation.
    """
    # What the frames of each pair have in common. Stacks with too little are not judged; stacks whose parts of one size
    # would be too small are judged one by one.
    size = frames.images.shape[-2:]
    steps, rims = overlaps(frames, pairs)
    if not is_enough(size, abs(steps).max(0), rims.max(0)).all():
        results: list[RestorationVerdict | TooLittleInCommonError] = []
        for stack, enough in enumerate(is_enough(size, steps, rims)):
            if enough.all():
                alone = frames.of_stacks([stack])
                results += _judge_batch(alone, [moves[stack]], pairs, numbers, shared, columns, timing)
                continue
            place = int(enough.argmin())
            (y, x), (earlier, later) = steps[stack, place], (numbers[frame] for frame in pairs[place])
            apart = f"they lie ({x}, {y}) px apart"
            message = f"frames {earlier} and {later} have nothing in common, or too little: {apart}"
            results.append(TooLittleInCommonError(message))
        return results

    # The verdict on each pair of frames, of all stacks.
    verdicts = [
        _judge_pairs(shared_part(frames, pair, steps[:, number], rims[:, number], columns), moves, shared)
        for number, pair in enumerate(pairs)
    ]

    # One result for each stack, in image axes.
    levels = np.stack([levels for levels, *_ in verdicts], -1)  # (5, B, P)
    displacements = np.stack([displacements for _, displacements, _ in verdicts], -2)  # (3, B, P, 2)
    if timing.scan_axis == -1:
        displacements = displacements[..., ::-1].copy()
    of_levels, of_displacements = (
        torch.from_numpy(values).to(frames.images.device) for values in (levels, displacements)
    )
    return [
        RestorationVerdict(
            **dict(zip(LEVELS, of_levels[:, stack], strict=True)),
            **dict(zip(DISPLACEMENTS, of_displacements[:, stack], strict=True)),
            outcome=tuple(outcomes[stack][0] for *_, outcomes in verdicts),
            findings=tuple(reasons_from_row_order(outcomes[stack][1], timing) for *_, outcomes in verdicts),
        )
        for stack in range(len(moves))
    ]
