"""Verdict on a restoration without the true scene: agreement between frames of one scene.

A restored frame, blurred by the motion of the next frame, should equal that next frame. The residual displacement
between the two and the estimated gain in PSNR determine the outcome of every pair of frames, see ``outcome_of_pair``.
"""

import math
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import torch
from torch import Tensor

from rsvib_torch.core.arguments import checks_arguments
from rsvib_torch.core.arrays import ArrayLike, Channels, as_tensor
from rsvib_torch.core.checks import check_whole_number
from rsvib_torch.core.presentation import JudgedResult
from rsvib_torch.core.progress import steps
from rsvib_torch.core.reason import Reason
from rsvib_torch.core.text import measured_text, text_table, wrapped
from rsvib_torch.frames.orientation import reasons_from_row_order
from rsvib_torch.frames.pixels import detailed_columns
from rsvib_torch.frames.prepare import PreparedFrames, prepare_frames
from rsvib_torch.io.stack_reading import FramesOrFiles, load_frames
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.field import ColumnMotion
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import RowTiming, SensorTiming
from rsvib_torch.restoration.frame_motion import FrameMotion, frame_motion, joint_groups, motion_in_row_order
from rsvib_torch.restoration.noise import estimate_noise
from rsvib_torch.restoration.restoration_warning import RestorationWarning
from rsvib_torch.restoration.verdict.pairs import FramePair, equally_bright, misfit, pairs_to_judge, shared_part
from rsvib_torch.restoration.verdict.trust import vibration_to_undo

__all__ = [
    "Outcome",
    "RestorationVerdict",
    "RestorationWarning",
    "judge_prepared",
    "judge_restoration",
    "outcome_of_pair",
]

Outcome = Literal["helps", "unknown", "partly", "worse"]
_OUTCOMES: tuple[Outcome, ...] = ("helps", "unknown", "partly", "worse")  # in order of concern

# Thresholds of the two scores of the verdict, fitted on 720 restorations with known truth, see docs/ablation.md.
_PARTLY_RESIDUAL = 0.35  # of the displacement between the raw frames; above, a part of the vibration was not undone
_WORSE_RESIDUAL = 0.8  # of that displacement; above, the vibration was not undone
_GAIN_ERROR = 2.0  # dB; error of the estimated gain, up to which its sign is not used

_STRIP = 160  # px, width of the strip of columns that is judged with roll or zoom: enough for the means of a pair
_MIN_NOISE = 1e-5  # of full scale; noise level assumed at least, rounding of float32 images


@dataclass(frozen=True, eq=False, repr=False)
class RestorationVerdict(
    JudgedResult,
    units={"misfit_before": "px", "misfit_after": "px", "resolution": "px", "predicted_gain": "dB"},
    shapes={
        **dict.fromkeys(("before", "after", "noise", "chi_square", "predicted_gain"), "P"),
        **dict.fromkeys(("misfit_before", "misfit_after", "resolution"), "P 2"),
    },
):
    """Verdict on a restoration from P pairs of frames of one scene.

    Displacements and levels are root-mean-square values over the pixels that both frames contain.

    Attributes:
        before: (P,) difference of the raw frames, moved onto each other by whole pixels, full scale 1.
        after: (P,) difference of the restored frames; NaN for one image restored jointly from all.
        misfit_before: (P, 2) px, displacement between the raw frames, axes (x, y).
        misfit_after: (P, 2) px, displacement between a raw frame and its prediction, which is the other frame
            restored and blurred by the motion of the first.
        resolution: (P, 2) px, misfits below this cannot be distinguished from zero.
        noise: (P,) standard deviation of the noise of the raw frames.
        chi_square: (P,) mean square of that frame's difference from its prediction, over the variance of the noise:
            1 ... 2 where motion, blur and noise explain the frame.
        predicted_gain: (P,) dB, improvement: estimated PSNR of the restored frames minus that of the raw ones. It is
            valid where the motion is right and complete, NaN where it is not and has the opposite sign of the outcome.
        outcome: For each pair: ``"helps"``; ``"partly"``: the vibration explains only a part of the displacement;
            ``"worse"``; ``"unknown"``: cannot be determined from this pair (vibration too small, or at a blind
            frequency; frames without contrast; too many missing pixels).
        findings: The ``Reason`` objects of each pair; none where restoration helps. ``reasons`` has their texts.

    Example:
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.evaluation import city_and_fields
        >>> timing = rsv.SensorTiming(row_time=40e-6, exposure_rows=20, frame_rows=300)
        >>> vibration = rsv.Vibration(amplitude=[2.1, 1.6], frequency=[110.0, 90.0], phase=[0.5, 1.0])
        >>> frames = rsv.simulate_frames(city_and_fields(320, 240, seed=3), timing, vibration, num_frames=2)
        >>> restored = rsv.restore(frames, timing, vibration, check=False)
        >>> verdict = rsv.judge_restoration(frames, restored, timing, vibration)
        >>> verdict.outcome, bool(verdict.misfit_after.max() < 0.01)  # px
        (('helps',), True)
    """

    before: Tensor
    after: Tensor
    misfit_before: Tensor
    misfit_after: Tensor
    resolution: Tensor
    noise: Tensor
    chi_square: Tensor
    predicted_gain: Tensor
    outcome: tuple[Outcome, ...]
    findings: tuple[Any, ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("outcome", "findings"):
            if len(getattr(self, name)) != len(self.before):
                raise ValueError(f"{name} must have {len(self.before)} entries, one for each pair of frames")

    @property
    def reasons(self) -> tuple[str, ...]:
        """For each pair, the texts of its ``findings``."""
        return tuple("; ".join(reason.with_axis for reason in of_pair) for of_pair in self.findings)

    @property
    def helped(self) -> Tensor:
        """(P,) whether the outcome of the pair is ``"helps"``."""
        return torch.tensor([outcome == "helps" for outcome in self.outcome], device=self.before.device)

    @property
    def overall(self) -> Outcome:
        """The outcome of greatest concern over all pairs."""
        return max(self.outcome, key=_OUTCOMES.index)

    def summary(self) -> str:
        """The verdict in one line, and a table of the pairs of frames."""
        rows = []
        for pair, (outcome, gain) in enumerate(zip(self.outcome, self.predicted_gain.tolist(), strict=True)):
            sizes = torch.stack([self.misfit_before[pair], self.misfit_after[pair]], -1).flatten()
            rows.append([str(pair), outcome, *(measured_text(size, digits=2) for size in sizes), f"{gain:+.1f}"])
        head = ("pair", "outcome", "x before (px)", "x after (px)", "y before (px)", "y after (px)", "improvement (dB)")
        return f"{wrapped(self.sentence)}\n{text_table(head, rows)}"

    @property
    def sentence(self) -> str:
        """The verdict in one line."""
        worst = self.outcome.index(self.overall)
        gain = float(self.predicted_gain.nanmean())
        counted = f" ({self.outcome.count(self.overall)} of {len(self.outcome)} pairs)" if len(self.outcome) > 1 else ""
        sentences = {
            "helps": "restored frames agree" + ("" if math.isnan(gain) else f"; estimated improvement {gain:+.1f} dB"),
            "unknown": f"cannot determine whether restoration helps{counted}: {self.reasons[worst]}",
            "partly": f"restoration helps in part only{counted}: {self.reasons[worst]}",
            "worse": f"restored is no better than raw{counted}: {self.reasons[worst]}",
        }
        return sentences[self.overall]

    @checks_arguments
    def in_image_axes(self, timing: SensorTiming) -> "RestorationVerdict":
        """The verdict on frames in row order, with axes named as in the image."""
        if timing.scan_axis == -2:
            return self
        swapped = {name: getattr(self, name).flip(-1) for name in ("misfit_before", "misfit_after", "resolution")}
        findings = tuple(reasons_from_row_order(of_pair, timing) for of_pair in self.findings)
        return replace(self, findings=findings, **swapped)


def outcome_of_pair(
    before: list[float],
    after: list[float],
    resolution: list[float],
    moves: list[bool],
    offset: list[float],
    gain: float,
    *,
    one_image: bool = False,
    finest: float = 0.03,
    crosstalk: float = 0.05,
) -> tuple[Outcome, tuple[Reason, ...]]:
    """Outcome of one pair, and the reasons for it; none if restoration helps.

    Scores are the residual displacement relative to that of the raw frames, and the estimated gain. The gain decides
    where the residual is small, because it is valid only where the motion is right.

    Args:
        before: Misfit of the raw frames (x, y) in px.
        after: Residual misfit after restoration.
        resolution: Misfits below which they cannot be distinguished from 0.
        moves: Axes with motion in the vibration.
        offset: Displacement between the frames that the vibration predicts, px.
        gain: Estimated gain in dB.
        one_image: Whether both frames were restored to one image, whose gain is not valid for a wrong motion.
        finest: Misfit in px that is negligible in any image.
        crosstalk: Error of ``after`` along one axis, relative to the displacement along the other.
    """
    outcomes: list[tuple[Outcome, Reason | None]] = []
    motion_is_complete = True
    for axis, name in enumerate("xy"):
        least, size, rest = max(resolution[axis], finest), before[axis], after[axis]
        if not moves[axis]:
            motion_is_complete &= size <= least
            continue
        visible = max(size, offset[axis])
        details = {"before": size}
        if math.isinf(least):
            outcomes.append(("unknown", Reason("no_contrast", name)))
        elif rest <= max(least, crosstalk * before[1 - axis]):
            is_visible = visible > least
            outcomes.append(
                ("helps", None) if is_visible else ("unknown", Reason("displaced_alike", name, visible, least))
            )
        elif rest > _WORSE_RESIDUAL * size:
            # less noise may outweigh a motion that was not undone, but not a motion that does not exist
            outweighed = size > least and gain > _GAIN_ERROR and not one_image
            remains = Reason("motion_remains", name, rest, _WORSE_RESIDUAL * size, details)
            outcomes.append(("partly" if outweighed else "worse", remains))
        elif rest > _PARTLY_RESIDUAL * size:
            outcomes.append(("partly", Reason("motion_remains", name, rest, _PARTLY_RESIDUAL * size, details)))
        else:
            outcomes.append(("helps", None))
    if not outcomes:
        return "unknown", (Reason("nothing_undone"),)
    outcome = max((outcome for outcome, _ in outcomes), key=_OUTCOMES.index)
    reasons = tuple(reason for kind, reason in outcomes if kind == outcome and reason is not None)
    if outcome in ("partly", "worse") or gain >= 0 or not motion_is_complete:
        return outcome, reasons
    if gain < -_GAIN_ERROR:
        return "worse", (Reason("noise_outweighs", None, gain, -_GAIN_ERROR),)
    return "unknown", reasons or (Reason("improvement_uncertain", None, gain, -_GAIN_ERROR),)


def _mean_square(difference: Tensor) -> Tensor:
    return difference.square().mean(dtype=torch.float64)


def _judge_pair(pair: FramePair, moves: list[bool], shared: int, *, max_missing: float = 0.5) -> RestorationVerdict:
    """Verdict on one pair, its values without a leading axis; not judged if more than ``max_missing`` is missing."""
    noise = estimate_noise(torch.stack([pair.earlier, pair.later]), pair.ignore).square().nanmean().double()
    noise = noise.nan_to_num(nan=0.0).clamp(min=_MIN_NOISE**2)
    pair = equally_bright(pair, noise)
    # an image restored from both frames lies between them, so that its distance from either is the smaller
    widening = math.sqrt(2.0 * shared / (shared - 1.0)) if shared > 1 else 1.0
    misfit_before, coarse = misfit(pair.earlier, pair.later)
    misfit_after, fine = (widening * value for value in misfit(pair.predicted, pair.later))
    resolution = torch.minimum(coarse, fine)
    unexplained = _mean_square(pair.later - pair.predicted)
    error = (unexplained - noise).clamp(min=0.0)
    after = error.new_tensor(math.nan)
    if pair.restored_later is not None:
        after = _mean_square(pair.restored_later - pair.restored)
    error = torch.maximum(error, 0.5 * after) if shared == 1 else error + noise / shared
    # change of the scene by the motion; the noise of two restored frames is independent and vanishes in the product
    raw_error = ((pair.predicted - pair.restored) * pair.changed_later).mean(dtype=torch.float64).clamp(min=0.0) + noise
    gain = 10.0 * torch.log10(raw_error / error.clamp(min=_MIN_NOISE**2))
    misfits = (misfit_before.tolist(), misfit_after.tolist(), resolution.tolist())
    one_image = pair.restored_later is None
    outcome, reasons = outcome_of_pair(*misfits, moves, pair.offset.tolist(), float(gain), one_image=one_image)
    if (outcome == "worse" and gain > 0) or (outcome in ("helps", "partly") and gain < 0):
        gain = torch.full_like(gain, math.nan)
    missing = 0.0 if pair.ignore is None else float(pair.ignore.any(0).double().mean())
    if missing > max_missing:
        outcome, reasons = "unknown", (Reason("pixels_missing", None, missing, max_missing),)
    return RestorationVerdict(
        before=_mean_square(pair.later - pair.earlier).sqrt()[None],
        after=after.sqrt()[None],
        misfit_before=misfit_before[None],
        misfit_after=misfit_after[None],
        resolution=resolution[None],
        noise=noise.sqrt()[None],
        chi_square=(unexplained / noise)[None],
        predicted_gain=gain[None],
        outcome=(outcome,),
        findings=(reasons,),
    )


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

    Three quantities are measured. Every restored frame, blurred by the motion of the next one, should equal that next
    frame: a wrong vibration leaves a displacement between the two (``misfit_after``). Restored frames should agree
    with each other better than raw frames do, noise and ringing included (``predicted_gain``). The residual should be
    noise (``chi_square``).

    A vibration that displaces all frames alike (at a blind frequency) is not visible in these quantities; the outcome
    is then ``"unknown"``.

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
        TypeError: If an argument has the wrong type.
        ValueError: If there is one frame only, shapes differ, or two frames have too little in common.

    Example:
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.evaluation import city_and_fields
        >>> timing = rsv.SensorTiming(row_time=40e-6, exposure_rows=20, frame_rows=300)
        >>> vibration = rsv.Vibration(amplitude=[2.1, 1.6], frequency=[110.0, 90.0], phase=[0.5, 1.0])
        >>> frames = rsv.simulate_frames(city_and_fields(320, 240, seed=3), timing, vibration, num_frames=2)
        >>> wrong = rsv.Vibration(amplitude=[2.1, 1.6], frequency=[110.0, 90.0], phase=[3.6, 4.1])  # opposite phase
        >>> for candidate in (vibration, wrong):
        ...     restored = rsv.restore(frames, timing, candidate, check=False)
        ...     verdict = rsv.judge_restoration(frames, restored, timing, candidate)
        ...     print(verdict.outcome)
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


def _judged_strip(
    raw: Tensor, restored: Tensor, ignore: Tensor | None, motion: Motion, timing: RowTiming
) -> tuple[Tensor, Tensor, Tensor | None, FrameMotion]:
    """The part of the frames of a stack by which their restoration is judged, and its motion.

    With roll or zoom, this is a strip of columns: of those in the middle of both halves, the one with more detail.
    Arguments and results are as in ``shared_part``, except for the motion (1) in row order and the timing.
    """
    count, (height, width) = len(raw), raw.shape[-2:]
    if motion.same_for_all_columns:
        of_frames = frame_motion(motion, timing, count, height)
        of_frames.check_fits(height, width)
        return raw, restored, ignore, of_frames
    strip = min(_STRIP, width // 2)
    halves = [slice(middle - strip // 2, middle - strip // 2 + strip) for middle in (width // 4, width - width // 4)]
    both = torch.cat([raw[0][..., half] for half in halves], -1)
    half = halves[0 if detailed_columns(both, strip).start < strip // 2 else 1]
    column = torch.tensor([half.start + 0.5 * (strip - 1) - 0.5 * (width - 1)], dtype=torch.float64)
    of_strip = ColumnMotion.of_columns(motion, column, timing, count, height)
    ignore = None if ignore is None else ignore[..., half]
    return raw[..., half], restored[..., half], ignore, frame_motion(of_strip, timing, count, height)


@torch.no_grad()
def judge_prepared(
    frames: PreparedFrames,
    restored: Tensor,
    vibration: Motion,
    *,
    joint: bool | int = False,
    most_pairs: int | None = None,
    columns: int | None = None,
    stack: int = 0,
) -> RestorationVerdict:
    """``judge_restoration`` of one stack of frames that are already prepared.

    Args:
        frames: The raw frames.
        restored: (B, T, C, H, W), or (B, 1, C, H, W), in row order.
        vibration: The vibration that was undone, in image axes, batch shape () or (B,).
        joint: As in ``judge_restoration``.
        most_pairs: As in ``judge_restoration``.
        columns: Judge on so many columns only, those with the most detail; None for all.
        stack: Index of the stack.

    Returns:
        The verdict in image axes.

    Raises:
        TooLittleInCommonError: If two frames have too little in common.
    """
    # Frames, restored frames and motion of the stack; with roll or zoom, of a strip of columns.
    limit = None if most_pairs is None else check_whole_number("most_pairs", most_pairs, at_least=1)
    motion = motion_in_row_order(frames, vibration)[stack].expanded(1)
    dtype = torch.promote_types(frames.images.dtype, restored.dtype)
    taken, still = (images[stack].to(dtype) for images in frames.compared(restored))
    ignore = None if frames.missing is None else frames.missing[stack]
    raw, image, ignore, of_part = _judged_strip(taken, still, ignore, motion, frames.timing)

    # The verdict on each pair of frames.
    count = len(raw)
    shared, pairs = len(joint_groups(count, joint)[0][0]), pairs_to_judge(count, joint, limit)
    moves = motion.moving_axes()[0].tolist()
    verdicts, advance = [], steps(len(pairs), "pairs")
    for pair in pairs:
        verdicts.append(_judge_pair(shared_part(raw, image, of_part, pair, columns, ignore), moves, shared))
        advance()
    joined = {
        field.name: torch.cat([getattr(verdict, field.name) for verdict in verdicts])
        for field in fields(RestorationVerdict)
        if field.name not in ("outcome", "findings")
    }
    outcome = tuple(verdict.outcome[0] for verdict in verdicts)
    findings = tuple(verdict.findings[0] for verdict in verdicts)
    return RestorationVerdict(**joined, outcome=outcome, findings=findings).in_image_axes(frames.image_timing)
