"""The verdict on detected vibrations: the reasons against each axis.

``results/reason.py`` has their texts, docs/verdicts.md the measurements that the limits were chosen with.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from rsvib_torch.detection.measurements import OtherMotion
from rsvib_torch.detection.tones.fit import MIN_GAIN, offset_gain
from rsvib_torch.detection.tones.selection import MIN_OFFSET
from rsvib_torch.files.reading import Table
from rsvib_torch.motion.timing import RowTiming
from rsvib_torch.motion.vibration import Vibration, VibrationStd
from rsvib_torch.numerics.tables import Array, table, valid_mean, without_nan
from rsvib_torch.registration.register import OffsetCurve, similar_share
from rsvib_torch.results.presentation import AXIS_NAMES
from rsvib_torch.results.reason import Reason

Findings = tuple[tuple[Reason, ...], ...]  # the reasons against each axis

_MIN_MEASURED = 0.5  # of the visible rows or bands
_MIN_REGISTERED = 0.25  # of the bands; of 81 recordings with clouds, objects and large motions, the least was 0.35
MAX_DISPLACEMENT_STD = 0.25  # of the displacement of the rows
_MAX_WITHIN_ROW_TIME = 0.1  # px; condition (24) of the paper
# px along the scan; rows that move by 1 px would be passed by their content. A vertical edge, which shows nothing along
# the scan, had a reliable tone of 6.7 px there that moves by 0.87 px; 4.8 px at 143 Hz that move by 0.65 px are found
_MAX_OF_ROWS = 0.8
_MIN_MOTION = 0.05  # px between frames; offsets of bands have errors of this size
_OF_STACK = ("measured", "bands", "differential", "blur")  # quantities without an entry for each axis


def judged(
    vibration: Vibration,
    std: VibrationStd,
    measured: OtherMotion | dict[str, Array],
    *,
    intervals: Array,
    displacement: Array,
    known_std: Array,
    timing: RowTiming,
    max_tones: float = math.inf,
    radius: float = 0.0,
) -> tuple[Findings, ...]:
    """Reasons against the vibrations of B stacks, for each of their A axes in row order.

    ``measured`` is the motion of the rows that they do not explain, or ``compared_bands``. ``intervals`` are the times
    in s between the frames of the largest groups. ``displacement`` (B, A) in px is the displacement of the rows by the
    tones without its mean, rms over the rows, and ``known_std`` its standard deviation if the number of tones is right.
    An axis with ``max_tones``, the largest number that was tried, may have more. ``radius`` is the distance in px from
    the centre, at which roll and zoom are displacements in px.
    """
    # 1. The quantities of all stacks and axes that are compared with limits.
    frequency = table(vibration.frequency)
    quantities = {
        "amplitude": table(vibration.amplitude),
        "amplitude_std": table(std.amplitude),
        "frequency": frequency,
        "frequency_std": table(std.frequency),
        "gain": offset_gain(frequency, intervals),
        "displacement": displacement,
        "known_std": known_std,
        "std": known_std if std.displacement is None else table(std.displacement),
    }
    # Condition (24) concerns the tones only: the blur by a uniform motion is exact at any speed.
    tones = Vibration(vibration.amplitude, vibration.frequency, vibration.phase)
    quantities["within_row_time"] = table(tones.displacement_within(timing.row_time))
    if isinstance(measured, OtherMotion):
        quantities |= {**vars(measured), "permitted": measured.permitted}
    else:
        quantities |= measured

    # 2. The comparisons with the limits.
    findings = []
    for numbers in zip(*(values.tolist() for values in quantities.values()), strict=True):
        stack = dict(zip(quantities, numbers, strict=True))
        against = _reasons_against_stack(stack, timing, max_tones, intervals.size)
        # A displacement by roll or zoom depends on the distance from the centre.
        for reasons in against[2:]:
            reasons[:] = [
                replace(reason, details={**reason.details, "radius": radius}) if reason.kind.unit == "px" else reason
                for reason in reasons
            ]
        findings.append(tuple(map(tuple, against)))
    return tuple(findings)


def compared_bands(offsets: Array, fitted: Array, visible: Array) -> dict[str, Array]:
    """Fraction of the visible bands that were registered, and size and residual of the best three quarters of them.

    Offsets (B, M, A) in px are NaN where a band could not be registered. The vibration predicts the offsets ``fitted``.
    ``visible`` (B, M) is true for bands that both frames contain.
    """
    registered = np.isfinite(offsets).all(-1) & visible
    num_registered = registered.sum(1, keepdims=True)
    offsets = np.where(registered[..., None], offsets, np.nan)
    # Clouds may cover the other quarter.
    residuals = np.sort(without_nan(np.abs(offsets - fitted), math.inf), 1)
    counted = np.ceil(0.75 * num_registered)
    best = np.arange(residuals.shape[1])[:, None] < counted[:, None]
    return {
        "measured": num_registered[:, 0] / np.maximum(visible.sum(1), 1),
        "bands": visible.sum(1),
        "residual": np.where(best, residuals, 0.0).sum(1) / counted,
        "size": valid_mean(np.abs(offsets - valid_mean(offsets, 1)[:, None]), 1),
    }


def _reasons_against_stack(stack: Table, timing: RowTiming, max_tones: float, intervals: int) -> list[list[Reason]]:
    """Reasons against each axis of one stack, from its compared quantities and the number of intervals of frames."""
    least_gain = _MIN_GAIN_OF_TWO if intervals == 1 else MIN_GAIN
    by_rows, axes, common_reasons = "bands" not in stack, len(stack["amplitude"]), []
    if stack["measured"] < _MIN_MEASURED:
        details = {"what": "the rows that frames have in common" if by_rows else f"{stack['bands']:g} row bands"}
        common_reasons = [Reason("rows_not_registered", None, stack["measured"], _MIN_MEASURED, details)]
    if by_rows:
        common_reasons += exposure_reasons(timing, *stack["blur"])
    against, aliases = [], list[Reason]()
    for axis, name in enumerate(AXIS_NAMES[:axes]):
        numbers = {quantity: values[axis] for quantity, values in stack.items() if quantity not in _OF_STACK}
        tones = [tone for tone, amplitude in enumerate(numbers["amplitude"]) if amplitude > 0]
        reasons = common_reasons.copy()
        if not tones:
            reasons.append(Reason("no_tone", name))
        if len(tones) >= max_tones:
            reasons.append(Reason("too_many_tones", name, len(tones), max_tones))
        for tone in tones:
            reasons += _tone_reasons(name, numbers, tone, timing, least_gain)
        reasons += _displacement_reasons(name, numbers, len(tones))
        if by_rows:
            reasons += rotation_reasons(axis, axes, stack["differential"], numbers["size"])
            reasons += residual_reasons(name, numbers)
            if name == "y" and numbers["within_row_time"] > _MAX_OF_ROWS:
                reasons.append(Reason("motion_within_row_time", name, numbers["within_row_time"], _MAX_OF_ROWS))
        else:
            reasons += _band_reasons(name, numbers)
        if (intervals > 1 and not reasons) or (intervals > 3 and contradicted_axes((tuple(reasons),))[0]):
            aliases += _alias_reasons(name, numbers, timing)
        against.append(reasons)
    return [[*aliases, *reasons] for reasons in against]


def scene_reasons(curve: OffsetCurve, columns: int, *, by_pair: bool = False) -> list[list[Reason]]:
    """For each stack, the reason against frames that show different scenes or noise; ``columns`` is their width in px.

    Without it, 6 of 24 stacks of 2 to 8 frames of independent noise had reliable axes, with amplitudes of 5 to 52 px;
    and a motion beyond the search range, of which a sixth of the bands was registered, had a wrong one. ``by_pair``
    compares the pair of frames with the fewest similar bands instead of all together: a free motion, other than tones,
    follows one frame of noise.
    """
    registered, similar = curve.good.double().mean((1, 2)), similar_share(curve, columns)
    similar = similar.amin(-1) if by_pair else similar.mean(-1)
    against, details = list[list[Reason]](), {"what": "the row bands of two frames" if by_pair else "the row bands"}
    for shares in zip(registered.tolist(), similar.tolist(), strict=True):
        share, limit = (shares[0], _MIN_REGISTERED) if shares[0] < _MIN_REGISTERED else (shares[1], _MIN_MEASURED)
        against.append([Reason("rows_not_registered", None, share, limit, details)] if share < limit else [])
    return against


def with_common_reasons(common_reasons: list[Reason], findings: Findings) -> Findings:
    """The findings of a stack with reasons against all axes, each added unless the axis has one with the same code."""
    return tuple(
        (*(common for common in common_reasons if common.code not in {reason.code for reason in reasons}), *reasons)
        for reasons in findings
    )


# Frame rates, three standard deviations of a difference of frequencies that is compared with multiples of it. A wrong
# timing leaves a residual, which gave 0.02 and more; harmonics and the sidebands of a lamp may be known better
_LEAST_ALIAS_ERROR, _MOST_ALIAS_ERROR = 0.01, 0.15


def _alias_reasons(axis: str, numbers: Table, timing: RowTiming) -> list[Reason]:
    """Reason against all axes from tones of an axis that are a multiple of the frame rate apart.

    With a wrong timing, two of them explain one tone in three frames or more, and the axes have one timing. Of 13 axes
    with several tones that were reliable and wrong (frame_rows, row_time or the size of frames wrong, interlaced rows,
    exposures that alternate), 10 had such tones; of 45 right ones, 1. Axes whose rows contradict the tones count in
    four frames or more: in H.264 video with a row time of 0.73, all 14 had such tones, and beside one of them an axis
    was reliable and wrong. With three frames, one such axis was beside a right one.
    """
    tones = zip(*(numbers[name] for name in ("amplitude", "frequency", "frequency_std")), strict=True)
    for (size, hertz, std), (other_size, other_hertz, other_std) in combinations(tones, 2):
        cycles = abs(hertz - other_hertz) * timing.frame_period
        error = 3 * math.hypot(std, other_std) * timing.frame_period
        distance = max(abs(cycles - round(cycles)), _LEAST_ALIAS_ERROR)
        if min(size, other_size) > 0 and round(cycles) and distance < error < _MOST_ALIAS_ERROR:
            return [Reason("tones_alias", axis, hertz, other_hertz)]
    return []


# Offset gain of a tone in two frames. A tone with a smaller one and an image motion may explain the rows as well as a
# tone of another frequency: of 59 reliable axes with gains of 0.1 to 0.3, 30 had displacements that were wrong by more
# than 5 %, one by more than its size; of 79 in four frames 8, none by more than 15 %. Of 301 axes with random tones,
# one was wrong by five times its size
_MIN_GAIN_OF_TWO = 0.3


def _tone_reasons(axis: str, numbers: Table, tone: int, timing: RowTiming, least_gain: float) -> list[Reason]:
    """Reasons against one tone."""
    names = ("amplitude", "amplitude_std", "frequency", "frequency_std", "gain")
    size, size_std, hertz, hertz_std, gain = (numbers[name][tone] for name in names)
    turns = math.pi * hertz * timing.exposure_time
    offset = size * gain * abs(math.sin(turns) / turns if turns else 1.0)
    details: dict[str, float | str] = {"frequency": hertz}
    reasons = []
    # Displacements by slow tones were wrong by at most 2.4 standard deviations if the amplitude had one of 0.25 to 10
    # amplitudes (50 axes with right timing), and by more than 5 for 2 of 5 with larger ones
    if not (0 < size_std < 10 * size and 0 < hertz_std < math.inf):
        reasons.append(Reason("tone_uncertainty_unknown", axis, details=details))
    elif offset < MIN_OFFSET:
        reasons.append(Reason("tone_too_small", axis, offset, MIN_OFFSET, details))
    if gain < least_gain:
        # A wrong frame_rows also causes tones whose frequency is a multiple of the frame rate.
        multiple = round(hertz * timing.frame_period)
        distance, hint = abs(hertz - multiple * timing.frame_rate), details
        if timing.frame_start_times is None and multiple and distance <= max(3 * hertz_std, 1e-3 * hertz):
            times = "" if multiple == 1 else f"{multiple} times "
            hint = details | {"multiple": times, "frame_rate": timing.frame_rate}
        reasons.append(Reason("tone_blind", axis, gain, least_gain, hint))
    if hertz * timing.exposure_time > 1.0:
        reasons.append(Reason("tone_averaged_out", axis, hertz, 1 / timing.exposure_time))
    return reasons


def _displacement_reasons(axis: str, numbers: Table, num_tones: int) -> list[Reason]:
    """Reasons from the displacement of the rows by all tones and its standard deviations, rms over the rows.

    ``known_std`` holds if the number of tones is right, ``std`` allows for a further tone. The limits and their effect
    are listed in docs/verdicts.md; of 18 simulated axes with several tones above 4 %, 3 were known within 2 %.
    """
    size, std, known_std = numbers["displacement"], numbers["std"], numbers["known_std"]
    allowed, largest = max(0.04 * size, 0.01), MAX_DISPLACEMENT_STD * size  # px
    if num_tones and std > allowed and (num_tones > 1 or std > 1.5 * known_std):
        return [Reason("displacement_ambiguous", axis, std, allowed, {"size": size})]
    if num_tones and std > largest:
        return [Reason("displacement_uncertain", axis, std, largest, {"size": size})]
    return []


def _band_reasons(axis: str, numbers: Table) -> list[Reason]:
    """Reasons from the residual of the bands, and from condition (24)."""
    reasons = []
    residual, size, within = numbers["residual"], numbers["size"], numbers["within_row_time"]
    allowed = max(0.05, 0.3 * size)  # px; smaller residuals are errors of registration
    if residual > allowed:
        reasons.append(Reason("bands_unexplained", axis, residual, allowed, {"size": size}))
    if within > _MAX_WITHIN_ROW_TIME:
        reasons.append(Reason("motion_within_row_time", axis, within, _MAX_WITHIN_ROW_TIME))
    return reasons


def residual_reasons(axis: str, numbers: Table) -> list[Reason]:
    """Reasons from motion of rows in px that no vibration explains; limits exceed errors of interpolation and blur."""
    if numbers["unexplained"] > numbers["permitted"]:
        return [Reason("rows_unexplained", axis, numbers["unexplained"], numbers["permitted"])]
    # px. With 0.015 px and 0.6 %, 7 more axes of 216 recordings are right (11 of 190 with an image motion, a strong
    # blur or flicker), and two are wrong: by a tone of 1.4 px at a blind frequency, and by an acceleration of the image
    allowed = max(0.01, 0.0025 * numbers["size"])
    if numbers["correlated"] > allowed:
        return [Reason("neighbours_unexplained", axis, numbers["correlated"], allowed)]
    return []


def with_remedy(reasons: Iterable[Reason], remedy: str) -> tuple[Reason, ...]:
    """Reasons with another remedy where theirs is to follow a vibration that changes, or to try other tones."""
    codes = {"displacement_ambiguous", "rows_unexplained", "neighbours_unexplained"}
    return tuple(
        replace(reason, details={**reason.details, "instead": remedy}) if reason.code in codes else reason
        for reason in reasons
    )


def contradicted_axes(findings: Findings) -> list[bool]:
    """Whether the measured rows contradict the tones of x and y, so that another timing may be the cause."""
    codes = {"too_many_tones", "rows_unexplained", "neighbours_unexplained", "displacement_ambiguous"}
    return [any(reason.code in codes for reason in reasons) for reasons in findings[:2]]


# Roll and zoom


def _max_difference(size: Array | float) -> Array:
    """Largest permitted difference in px of the displacements along a row, for an axis with offsets of size px rms."""
    return np.maximum(0.009 * size, 0.035)


def halves_move_apart(other_motion: OtherMotion) -> Array:
    """(B,) whether the halves of the rows move apart, as roll and zoom cause it."""
    return np.any(other_motion.differential[..., ::-1] > _max_difference(other_motion.size), -1)


# Limits of roll and zoom as the cause. Clouds, parallax and objects had 0.12 px and more of the differences along a row
# that were not linear in the column, motions that are no sums of tones moved the rows by 10 times the difference of
# their halves and more. Detail that is not even along the rows displaces them by a part of the roll along the other
# axis, too, and makes the differences of their quarters less linear: with the difference of the halves along the same
# axis only, and 0.25 instead of 0.5 below, roll or zoom was not tried in 5 of 25 stacks, where it was then reliable.
_MAX_UNEVEN, _MAX_MOVED = 3.0, 8.0  # of the permitted difference of the halves, of the difference of the halves
# Of the permitted difference of the halves, difference along the axis itself: 13 of a subject on half of the frame,
# whose motion was reliable as that of the camera; none of 200 other axes is refused for it
_MAX_TWO_MOTIONS = 4.0
# of the difference of the halves: roll of 4 to 20 mrad in 300 columns has 0.14 to 0.17, up to 0.45 with uneven detail,
# because differences of a pixel are not linear in the gradients; halves at two distances have 0.9
_MAX_UNEVEN_PART = 0.5


def rotation_possible(other_motion: OtherMotion, uneven: Array, aspect: float) -> Array:
    """(B,) whether roll or zoom may explain the whole residual of the fit of a stack.

    ``uneven`` (B, 2) px are differences of the displacements along a row that are not linear in the column; ``aspect``
    is the rows of a frame over its columns.
    """
    difference = other_motion.differential[..., ::-1]
    max_uneven = np.maximum(_MAX_UNEVEN * _max_difference(other_motion.size), _MAX_UNEVEN_PART * difference)
    is_uneven = (uneven[..., ::-1] > max_uneven).any(-1)
    limit = np.maximum(other_motion.permitted, _MAX_MOVED * max(1.0, aspect) * difference.max(-1, keepdims=True))
    return halves_move_apart(other_motion) & ~is_uneven & ~(other_motion.unexplained > limit).any(-1)


def rotation_reasons(axis: int, axes: int, differential: Sequence[float], size: float) -> list[Reason]:
    """Reasons against an axis from rotation, zoom and objects, which move the halves of a row apart.

    A roll by theta moves the halves of a row by ``theta W / 4`` along y in opposite directions, and rows by up to
    ``theta H / 2`` along x. A zoom does the same with the axes exchanged. Halves that move apart along the axis itself
    by more show two motions, and their mean is neither of them.

    ``differential`` (2,) px is the rms difference of the displacements along a row that the motion does not explain,
    and ``size`` px the rms offset along the axis.
    """
    allowed = float(_max_difference(size))
    if axes > 2:
        difference = max(differential)
    elif differential[axis] > _MAX_TWO_MOTIONS * allowed:
        difference = differential[axis]
    else:
        difference = differential[1 - axis]
    code = "strips_apart" if axes > 2 else "halves_apart"
    return [Reason(code, AXIS_NAMES[axis], difference, allowed)] if difference > allowed else []  # not if it is NaN


# Exposure


def exposure_reasons(timing: RowTiming, ratio: float, std: float, size: float | None = None) -> list[Reason]:
    """Reasons against all axes from the difference of the blur between frames.

    Its ratio to the expected one is the square of the ratio of the exposure times (docs/verdicts.md). A stated exposure
    that is far too short expects nearly no blur, so that what counts is the size of the measured difference: rows
    that move slowly are compared at the same part of a pixel, and errors of interpolation seemed to be a blur of
    0.004 to 0.009 of the detail in 5 of 27 recordings with slow tones or roll and sizes below 1e-4. Sizes above
    0.25 of the detail are beyond the second order, with which ratios of 0.5 to 1.5 were measured for sizes of 0.05
    and more. Negative ratios are caused by another error, because no exposure time gives them. H.264 predicts
    frames from others and lowers the ratio, from 1.06 to 0.94, 0.61 and 0.23 with CRF 10, 17 and 23: without a
    size, frames are those of a video, and only a large ratio is a reason.
    """
    low, high = 0.6, 2.0
    is_low, is_high = False, ratio > high and ratio - 1 > 4 * std
    if size is not None:
        is_low = -0.3 < ratio < low and 1 - ratio > 3 * std and size < 0.25
        is_high = is_high and (ratio - 1) * size > (0.01 if size < 1e-4 else 0.002) and size < 0.25
    if not (is_low or is_high):
        return []
    details: dict[str, float | str] = {"exposure_rows": timing.exposure_rows}
    rows = timing.exposure_rows * math.sqrt(max(ratio, 0.0))
    if 0 < rows * timing.row_time <= timing.frame_period:  # longer exposures are impossible; the cause is another error
        details |= {"likely": rows} if size is not None else {"likely_ms": 1e3 * rows * timing.row_time}
    if size is None:
        details["exposure_ms"] = 1e3 * timing.exposure_time
    if is_low:
        details["compressed"] = "video"
    return [Reason("blur_contradicts_exposure", None, ratio, low if is_low else high, details)]


# Recorded motions


def recording_reasons(sizes: Sequence[float], residuals: Sequence[float], other_offset: float | None) -> list[Reason]:
    """Reasons against a recorded motion, from its rms displacements and residuals in px, and another offset in s."""
    reasons = []
    if max(sizes) < _MIN_MOTION:
        reasons.append(Reason("recorded_motion_too_small", None, max(sizes), _MIN_MOTION))
    for name, size, residual in zip(AXIS_NAMES, sizes, residuals, strict=False):
        allowed = max(0.25 * size, 0.05)  # px
        if residual > allowed:
            reasons.append(Reason("recording_incomplete", name, residual, allowed))
    if other_offset is not None:
        reasons.append(Reason("motion_repeats", details={"offset": other_offset}))
    return reasons
