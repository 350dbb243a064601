"""Did restoration help? Judged without truth, by how well frames of one scene agree."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from rsvib_torch.core.checks import check_whole_number
from rsvib_torch.frames.arrays import as_tensor
from rsvib_torch.frames.prepare import PreparedFrames, prepare_frames
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.restoration.frame_motion import FrameMotion, frame_motion
from rsvib_torch.restoration.joint_groups import joint_groups
from rsvib_torch.restoration.noise.single_frame import estimate_noise
from rsvib_torch.restoration.verdict.misfit import misfit
from rsvib_torch.restoration.verdict.outcome import OUTCOMES, Outcome, RestorationVerdict
from rsvib_torch.restoration.verdict.pairs import FramePair, equally_bright, pairs_to_judge, shared_part
from rsvib_torch.restoration.verdict.trust import Detected, vibration_to_undo

__all__ = ["judge_frames", "judge_prepared", "judge_restoration"]

_EXPLAINED = 0.35  # of the displacement between the raw frames may remain
_UNCHANGED = 0.9  # of it remaining means that nothing was gained
_FINEST = 0.03  # px, a misfit that never matters
_DOUBTFUL_GAIN, _BAD_GAIN = -2.0, -4.0  # dB; the estimate is low by as much where the exposure blurs most
_WELCOME_GAIN = 1.0  # dB
_QUIETEST = 1e-5  # noise level below which none is assumed, of full scale
_MISSING = 0.5  # of the pixels of a pair: with more it is not judged
_SMALL = 0.05  # of the displacement along the other axis: as much is no motion that was made up


def _mean_square(difference: Tensor) -> Tensor:
    return difference.square().mean(dtype=torch.float64)


def _moves(motion: FrameMotion) -> tuple[bool, bool]:
    """Whether the vibration claims to move the image along x, y."""
    x, y = motion.vibration.moving_axes()[0].tolist()
    return x, y


def _outcome(
    before: list[float],
    after: list[float],
    resolution: list[float],
    moves: tuple[bool, bool],
    offset: list[float],
    gain: float,
    difference: tuple[float, float],
) -> tuple[Outcome, str]:
    """The verdict on one pair, and why.

    Args:
        before: Misfit of the raw frames (x, y) in px.
        after: Misfit that remains.
        resolution: Misfits that are not told from 0.
        moves: Which axes the vibration moves.
        offset: Displacement between the frames that the vibration predicts, px.
        gain: Estimated gain in dB.
        difference: Root-mean-square difference of the raw and of the restored frames; the latter NaN for one image.
    """
    found: list[tuple[Outcome, str]] = []
    trust_gain = True
    for axis, name in enumerate("xy"):
        least = max(resolution[axis], _FINEST)
        if not moves[axis]:
            trust_gain &= before[axis] <= least
            continue
        apart = f"{name}: frames lie {before[axis]:.2g} px apart, {after[axis]:.2g} px are left unexplained"
        if math.isinf(least):
            found.append(("unknown", f"{name}: the frames show nothing to tell it by"))
        elif before[axis] <= least < after[axis] <= _SMALL * before[1 - axis] and gain > _WELCOME_GAIN:
            found.append(("unknown", f"{apart}, next to {before[1 - axis]:.2g} px along the other axis"))
        elif after[axis] > max(_UNCHANGED * before[axis], least):
            # less noise may outweigh a motion that was not undone, but not one that was made up
            outweighed = gain > _WELCOME_GAIN and before[axis] > least and not math.isnan(difference[1])
            found.append(("partly" if outweighed else "worse", apart))
        elif after[axis] > max(_EXPLAINED * before[axis], least):
            found.append(("partly", apart))
        elif max(before[axis], offset[axis]) <= least:
            found.append(("unknown", f"{name}: frames lie less than {least:.2g} px apart, all are displaced alike"))
        else:
            found.append(("helps", ""))
    if not found:
        return "unknown", "no vibration was undone"
    outcome = max((outcome for outcome, _ in found), key=OUTCOMES.index)
    if outcome in ("helps", "unknown") and trust_gain and gain < _DOUBTFUL_GAIN:
        # a wrong motion makes the estimate of the gain wrong as well: it counts where the motion is right
        return (
            "worse" if gain < _BAD_GAIN else "partly",
            f"noise and artefacts outweigh what was undone ({gain:.1f} dB)",
        )
    return outcome, "; ".join(why for kind, why in found if kind == outcome and why)


def _judge_pair(pair: FramePair, moves: tuple[bool, bool], shared: int) -> RestorationVerdict:
    """The verdict on one pair, its values without a leading axis."""
    noise = estimate_noise(torch.stack([pair.earlier, pair.later]), pair.missing).square().nanmean().double()
    noise = noise.nan_to_num(nan=0.0).clamp(min=_QUIETEST**2)
    pair = equally_bright(pair, noise)
    # what was made of both frames lies between them: their distance from it is the smaller
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
    # what the motion does to the scene; noise of two restored frames drops out of the product
    raw_error = ((pair.predicted - pair.restored) * pair.changed_later).mean(dtype=torch.float64).clamp(min=0.0) + noise
    gain = 10.0 * torch.log10(raw_error / error.clamp(min=_QUIETEST**2))
    before, after = _mean_square(pair.later - pair.earlier).sqrt(), after.sqrt()
    missing = 0.0 if pair.missing is None else float(pair.missing.any(0).double().mean())
    outcome, why = _outcome(
        misfit_before.tolist(),
        misfit_after.tolist(),
        resolution.tolist(),
        moves,
        pair.offset.tolist(),
        float(gain),
        (float(before), float(after)),
    )
    if missing > _MISSING:
        outcome, why = "unknown", f"{100 * missing:.0f} % of the pixels are missing"
    return RestorationVerdict(
        before,
        after,
        misfit_before,
        misfit_after,
        resolution,
        noise.sqrt(),
        unexplained / noise,
        gain,
        (outcome,),
        (why,),
    )


@torch.no_grad()
def judge_frames(
    raw: Tensor,
    restored: Tensor,
    motion: FrameMotion,
    pairs: Sequence[tuple[int, int]],
    *,
    shared: int = 1,
    columns: int | None = None,
    hidden: Tensor | None = None,
) -> RestorationVerdict:
    """Judge a stack in row order; ``judge_restoration`` with everything made ready.

    Args:
        raw: (T, C, H, W).
        restored: (T, C, H, W), or (1, C, H, W) in the coordinates of the first frame of every pair.
        motion: Motion of the frames, batch of one.
        pairs: Frames to compare.
        shared: Frames that each restored one was made of.
        columns: Judge on so many columns only, those with the most detail.
        hidden: Mask shaped like ``raw`` of pixels that were not measured.

    Raises:
        TooLittleInCommonError: If two frames have too little in common.
    """
    verdicts = [
        _judge_pair(shared_part(raw, restored, motion, frames, columns, hidden), _moves(motion), shared)
        for frames in pairs
    ]
    tensors = (
        "before",
        "after",
        "misfit_before",
        "misfit_after",
        "resolution",
        "noise",
        "chi_square",
        "predicted_gain",
    )
    joined = {name: torch.stack([getattr(verdict, name) for verdict in verdicts]) for name in tensors}
    outcome = tuple(verdict.outcome[0] for verdict in verdicts)
    return replace(verdicts[0], **joined, outcome=outcome, reasons=tuple(verdict.reasons[0] for verdict in verdicts))


def judge_restoration(
    frames: Tensor,
    restored: Tensor,
    timing: SensorTiming,
    vibration: Motion | Detected,
    *,
    joint: bool | int = False,
    full_scale: float | None = None,
    ignore: Tensor | None = None,
    most_pairs: int | None = None,
) -> RestorationVerdict:
    """Judge without truth whether restored frames are better than raw ones.

    Three things are looked at. Every restored frame, blurred again by the motion of the next one, should be that
    next frame: a wrong vibration leaves the two apart. Restored frames should agree with each other better than raw
    frames do, noise and ringing included. And what is left unexplained should be noise (``chi_square``).

    What displaces all frames alike (a blind frequency) cannot be seen this way; the outcome is then ``"unknown"``.

    Args:
        frames: Raw stack (T, H, W) or (T, C, H, W), at least two frames.
        restored: What ``restore`` made of it: one frame from each, or one image (1, ...) from all.
        timing: The sensor.
        vibration: The vibration that was undone, in image axes, or the detection that ``restore`` was given.
        joint: What ``restore`` was told.
        full_scale: As in ``restore``.
        ignore: As in ``restore``: what is ignored, and NaN, is not judged.
        most_pairs: Compare no more pairs than these, evenly spread over the stack; None for all.

    Returns:
        Verdict on each pair of neighbouring frames; on each frame with the middle one where there is one image. Frames
        may differ in brightness and contrast.

    Raises:
        TypeError: If an argument has the wrong type.
        ValueError: If there is one frame only, shapes differ, or two frames have too little in common.
    """
    prepared = prepare_frames(frames, timing, full_scale=full_scale, ignore=ignore, minimum_frames=2)
    if prepared.batched:
        raise ValueError(f"frames must be one stack (T, H, W) or (T, C, H, W), got shape {prepared.shape}")
    restored = as_tensor("restored", restored)
    expected = (1, *prepared.shape[1:]) if joint is True else prepared.shape
    if tuple(restored.shape) != expected:
        raise ValueError(f"restored must have the shape {expected}, got {tuple(restored.shape)}")
    count, height = prepared.images.shape[1], prepared.images.shape[-2]
    vibration, _ = vibration_to_undo(vibration, timing, count, height)
    images = prepare_frames(restored, timing, full_scale=full_scale, allow_missing=False, name="restored").images
    return judge_prepared(prepared, images, vibration, joint=joint, most_pairs=most_pairs)


def judge_prepared(
    frames: PreparedFrames,
    restored: Tensor,
    vibration: Motion,
    *,
    joint: bool | int = False,
    most_pairs: int | None = None,
) -> RestorationVerdict:
    """``judge_restoration`` of one stack that is already prepared.

    Args:
        frames: The raw frames.
        restored: (1, T, C, H, W), or (1, 1, C, H, W), in row order.
        vibration: The vibration that was undone, in image axes.
        joint: As in ``judge_restoration``.
        most_pairs: As in ``judge_restoration``.

    Returns:
        The verdict in image axes.
    """
    limit = None if most_pairs is None else check_whole_number("most_pairs", most_pairs, at_least=1)
    if vibration.batch_shape:
        raise ValueError(f"vibration must be one for the stack, got batch shape {tuple(vibration.batch_shape)}")
    count, height = frames.images.shape[1], frames.images.shape[-2]
    shared = len(joint_groups(count, joint)[0][0])
    dtype = torch.promote_types(frames.images.dtype, restored.dtype)
    motion = vibration.to_row_order(frames.image_timing).to(frames.images.device).expanded(1)
    verdict = judge_frames(
        frames.filled[0].to(dtype),
        restored[0].to(dtype),
        frame_motion(motion, frames.timing, count, height),
        pairs_to_judge(count, joint, limit),
        shared=shared,
        hidden=None if frames.missing is None else frames.missing[0],
    )
    return verdict.in_image_axes(frames.image_timing)
