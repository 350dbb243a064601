"""The hypotheses that detection tries, one after the other.

1. The motion is a translation: all columns of a row have the same displacement.
2. If the halves of the rows move apart as roll and zoom cause it, or if roll and zoom are requested: a motion with
   roll and zoom. All stacks of a batch have these components then, if any stack rolls.
3. If the halves of the rows move apart in another way: a translation without the parts of the frames that move by
   themselves, such as clouds.
4. If only the halves of the rows move apart: each half by itself. Halves at unequal distances move apart uniformly
   (parallax) and vibrate alike, which confirms the translation.
5. If the rows agree with another timing: that timing (``other_timing``), which then is the reason against the axes. The
   vibration is that of the stated timing.

The findings of an attempt (``pipeline``) decide whether the next hypothesis is tried. It is accepted unless its attempt
is abandoned.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

from dataclasses import replace

import numpy as np

from rsvib_torch.detection.other_timing import other_timings
from rsvib_torch.detection.pipeline import Attempt, DetectionOptions, Hypothesis, attempt
from rsvib_torch.detection.refinement import FittedRows
from rsvib_torch.detection.result import DetectionResult, assembled
from rsvib_torch.detection.rows.displacements import SUMMED_ROWS, compared_intervals, displacements_of_parts
from rsvib_torch.detection.start import FieldScale, strips_fit
from rsvib_torch.detection.tones.fit import motion_of_fit, shrunk, tone_displacements
from rsvib_torch.detection.tones.selection import MIN_SIGNIFICANCE
from rsvib_torch.detection.verdict import halves_move_apart, rotation_possible
from rsvib_torch.frames.prepare import GreyFrames
from rsvib_torch.motion.camera import Camera
from rsvib_torch.motion.timing import RowTiming, SensorTiming
from rsvib_torch.numerics.tables import Array, split_axis, table, take_stacks
from rsvib_torch.registration.register import fits_frame


def detect_tones(
    stacks: GreyFrames, timing: SensorTiming, options: DetectionOptions, axes: tuple[int, int], camera: Camera | None
) -> DetectionResult:
    """Detect the tones of B stacks, with as many components as were requested or as the frames require.

    ``axes`` are the numbers of components that are measured in any case, and at most; the camera is in row order.
    """
    height, width = stacks.images.shape[-2:]
    row_timing, num_frames = timing.in_row_order(), stacks.images.shape[1]

    # 1. Translation.
    translation = attempt(stacks, row_timing, options, Hypothesis(FieldScale(2, width, height)))

    # 2. Roll and zoom, if they may be the cause of what the translation of any stack does not explain. A requested
    # component is measured in any case; frames that are too narrow for strips of columns are refused by an error then.
    least_axes, most_axes = axes
    refined = translation.fitted.refined
    requested = camera is not None or least_axes > 2
    possible = np.full(len(stacks.images), requested)
    if refined is not None and most_axes > 2 and strips_fit(height, width, options.bands):
        possible |= rotation_possible(refined.other_motion, refined.uneven, height / width)
    if possible.any():
        hypothesis = Hypothesis(
            FieldScale(most_axes, width, height, camera),
            is_doubtful=not requested,
            translation=take_stacks([translation.fit], np.flatnonzero(possible)),
        )
        rotation = attempt(stacks.some(possible), row_timing, options, hypothesis)
        moving = _moving_axes(rotation, least_axes)
        if requested or (moving > 2 and not rotation.abandoned.all()):  # parallax otherwise
            if not possible.all():
                rotation = attempt(stacks, row_timing, options, replace(hypothesis, translation=translation.fit))
            return _assembled(rotation, timing, num_frames).with_axes(moving)

    # 3. Without clouds and objects.
    stacks, translation = _without_moving_parts(stacks, row_timing, options, translation, ~possible)

    # 4. The same vibration of both halves.
    translation = _without_parallax(stacks, row_timing, options, translation)

    # 5. Another timing, for stacks whose rows the tones do not explain. The axes of a stack have one timing: of 9
    # reliable axes beside a contradicted one, 3 were wrong.
    result = _assembled(translation, timing, num_frames)
    reliable, findings = result.reliable.clone(), list(result.findings)
    for index, reason in other_timings(stacks, timing, translation).items():
        reliable[index] = False
        findings[index] = tuple((reason, *reasons) for reasons in findings[index])
    return replace(result, reliable=reliable, findings=tuple(findings))


def _assembled(result: Attempt, timing: SensorTiming, num_frames: int) -> DetectionResult:
    """The results of an attempt in image axes."""
    fitted = result.fitted
    return assembled(
        result.fit,
        result.std,
        result.std_if_hidden_tone,
        (fitted.offsets, fitted.predicted),
        result.findings,
        timing,
        scale=result.scale,
        num_frames=num_frames,
        interval=result.interval,
        blur=None if fitted.refined is None else fitted.refined.other_motion.blur,
    )


# px, displacement relative to the median of its rows from which on a part of a frame moves by itself; limit of the
# share of such parts. Of recordings with clouds over a quarter of the frame or objects, 6 axes that were refused
# although known are right without these parts, which were 0.3 to 0.67 of all, and none is wrong
_MOVES_BY_ITSELF, _MOST_MOVING = 0.1, 0.7


def _without_moving_parts(
    stacks: GreyFrames, timing: RowTiming, options: DetectionOptions, previous: Attempt, tried: Array
) -> tuple[GreyFrames, Attempt]:
    """Stacks without the parts of the frames that move by themselves, and their attempt, if it refuses fewer axes.

    Rows that clouds or objects cover in part have a displacement between both motions. This is tried for the stacks
    where ``tried`` (B,) is true and the halves of the rows move apart.
    """
    refined = previous.fitted.refined
    if refined is None:
        return stacks, previous
    tried = tried & halves_move_apart(refined.other_motion)
    if not tried.any():
        return stacks, previous
    # 1. The stacks in which some parts, but not most of them, move by themselves, without these.
    moving = _moving_parts(refined, timing, stacks)
    share = moving.mean((1, 2, 3))
    tried = tried & (share > 0) & (share < _MOST_MOVING)
    if not tried.any():
        return stacks, previous
    reduced = stacks.some(tried).only(~moving[tried])
    without_parts = attempt(reduced, timing, options, Hypothesis(previous.scale, is_doubtful=True))
    # 2. All stacks, without these parts where that refuses fewer axes.
    for index, against in zip(np.flatnonzero(tried).tolist(), without_parts.findings, strict=True):
        tried[index] = sum(map(bool, against)) < sum(map(bool, previous.findings[index]))
    if not tried.any():
        return stacks, previous
    if not tried.all():
        reduced = stacks.only(~(moving & tried[:, None, None, None]))
        without_parts = attempt(reduced, timing, options, Hypothesis(previous.scale))
    return reduced, without_parts


def _moving_parts(refined: FittedRows, timing: RowTiming, stacks: GreyFrames) -> Array:
    """(B, T, H, W) bool, parts whose displacement differs from the median of their rows, in all frames of a group.

    A part has a quarter of the columns and the rows of a sum of ``displacements_of_parts``.
    """
    count, num_frames, height, width = stacks.images.shape
    motion = motion_of_fit(shrunk(refined.fit, compared_intervals(timing, num_frames)), stacks.images.device)
    first_frame, moving_in_frames = 0, []
    for group, gradients in zip(refined.frames.groups, refined.frames.measure(motion).gradients, strict=True):
        displacement, _, regular = map(table, displacements_of_parts(gradients))
        deviation = np.abs(displacement - np.median(displacement, 2, keepdims=True)).max(-1)  # (B M, N, 4) px
        is_moving = split_axis((deviation > _MOVES_BY_ITSELF) & regular[..., None], 0, count, -1)
        for moving_in_group in np.moveaxis(is_moving, 1, 0):
            moving_in_frames.append((slice(first_frame, first_frame + group.size), moving_in_group))
            first_frame += group.size - 1
    blocks, parts = moving_in_frames[0][1].shape[1:]
    moving = np.zeros((count, num_frames, blocks, parts), dtype=bool)
    for frames, moving_in_group in moving_in_frames:
        moving[:, frames] |= moving_in_group[:, None]
    rows = np.minimum(np.arange(height) // SUMMED_ROWS, blocks - 1)
    return moving[:, :, rows][..., np.arange(width) * parts // width]


# -, px; differences between displacements of a half and of the whole. Of 16 recordings with parallax, 5 were accepted
# with these limits, none wrong. They and those that chose the limits are the same
_MAX_DIFFERENCE, _MAX_DIFFERENCE_PX = 0.01, 0.01


def _without_parallax(stacks: GreyFrames, timing: RowTiming, options: DetectionOptions, previous: Attempt) -> Attempt:
    """The attempt without the reason that the halves of the rows move apart, for stacks whose halves vibrate alike.

    Roll moves the halves of a row apart along y and zoom along x, so that their tones differ. A uniform roll or zoom
    displaces the rows by an amount that is repeated in each frame, which no tone explains in three frames.
    """
    num_frames, height, width = stacks.images.shape[1:]
    half = width // 2
    if previous.fitted.refined is None or num_frames < 3 or not fits_frame(height, half, options.bands):
        return previous
    row_starts = table(timing.row_starts(num_frames, height)[:, ::8].flatten())
    findings = list(previous.findings)
    for index, against in enumerate(previous.findings):
        # 1. Stacks that are refused along an axis for this reason only.
        if not any({reason.code for reason in reasons} == {"halves_apart"} for reasons in against):
            continue
        # 2. Each half must be reliable along both axes, with the displacements of the whole.
        stack = stacks.one(index)
        displacement = tone_displacements(previous.fit, row_starts, timing.exposure_time)[index]
        allowed = np.maximum(_MAX_DIFFERENCE * displacement.std(0), _MAX_DIFFERENCE_PX)
        for columns in (slice(0, half), slice(width - half, width)):
            half_attempt = attempt(stack.columns(columns), timing, options, Hypothesis(FieldScale(2, half, height)))
            difference = tone_displacements(half_attempt.fit, row_starts, timing.exposure_time)[0] - displacement
            if any(half_attempt.findings[0]) or (difference.std(0) > allowed).any():
                break
        else:
            findings[index] = tuple(
                tuple(reason for reason in reasons if reason.code != "halves_apart") for reasons in against
            )
    return replace(previous, findings=tuple(findings))


def _moving_axes(rotation: Attempt, least_axes: int) -> int:
    """Number of components up to the last one with a significant tone in any stack, at least ``least``."""
    significant = rotation.vibration.amplitude > MIN_SIGNIFICANCE * rotation.std_if_hidden_tone.amplitude
    moving = significant.any(0).any(-1).tolist()
    return max([least_axes, *(axis + 1 for axis in range(2, len(moving)) if moving[axis])])
