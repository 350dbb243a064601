"""The verdict on a detected vibration: for each axis whether it is reliable, and the reasons if it is not."""

import math

import torch
from torch import Tensor

from rsvib_torch.detection.result import OtherMotion
from rsvib_torch.detection.tones.fit import MIN_GAIN, offset_gain
from rsvib_torch.detection.tones.selection import MIN_OFFSET, MIN_SIGNIFICANCE
from rsvib_torch.motion.timing import RowTiming
from rsvib_torch.motion.vibration import Vibration, VibrationStd

__all__ = ["contradicted_axes", "judge"]


def judge(
    vibration: Vibration,
    std: VibrationStd,
    *,
    offsets: Tensor,
    fitted: Tensor,
    visible: Tensor,
    intervals: Tensor,
    displacement: Tensor,
    own_std: Tensor,
    timing: RowTiming,
    other_motion: OtherMotion | None = None,
    max_tones: float = math.inf,
    min_bands: float = 0.5,
    radius: float = 0.0,
) -> tuple[Tensor, tuple[tuple[str, ...], ...]]:
    """Verdict on one vibration (not a batch), from the measurements that it was fitted to.

    These are the displacements of rows if ``other_motion`` is given, else the offsets of bands.

    Args:
        vibration: The detected vibration.
        std: Its standard deviations.
        offsets: (M, 2) px, measured offsets of row bands, NaN where a band could not be registered.
        fitted: (M, 2) px, offsets predicted by the vibration.
        visible: (M,) bool, bands that both frames contain.
        intervals: Times between the frames that were compared, s.
        displacement: (2,) px, displacement of the rows by the tones without its mean, rms over the rows.
        own_std: (2,) px, standard deviation of the displacement if the number of tones is right.
        timing: The sensor, in row order.
        other_motion: Motion of the rows that the vibration does not explain; None if it was fitted to bands.
        max_tones: Largest number of tones that was tried on an axis; an axis with so many may have more.
        min_bands: Fraction of the visible bands or rows that must be registered.
        radius: Distance from the centre, in px, at which roll and zoom are displacements in px.

    Returns:
        (A,) bool and the reasons against each of the A axes.
    """
    reasons: list[list[str]] = [[] for _ in range(vibration.num_axes)]
    good = torch.isfinite(offsets).all(-1) & visible
    gain = offset_gain(vibration.frequency, intervals)
    of_both = _against_measurements(good, visible, other_motion, min_bands)
    if other_motion is not None:
        of_both += _against_exposure(other_motion, timing)
    for axis, against in enumerate(reasons):
        amplitude = vibration.amplitude[axis]
        against.extend(of_both)
        if not bool((amplitude > 0).any()):
            against.append(
                "no significant tone: the offsets are those of a uniform motion, or below their noise; "
                "use more frames if a vibration is expected"
            )
        if int(amplitude.count_nonzero()) >= max_tones:
            against.append(
                f"{max_tones} tones do not explain the motion: it is not a sum of few tones, or the timing is wrong; "
                "try model='free'"
            )
        for tone in amplitude.nonzero()[:, 0].tolist():
            against.extend(_against_tone(vibration, std, axis, tone, float(gain[axis, tone]), timing))
        if std.displacement is not None and bool((amplitude > 0).any()):
            values = (float(value[axis]) for value in (displacement, std.displacement, own_std))
            against.extend(_against_displacement(*values, num_tones=int(amplitude.count_nonzero())))
        if other_motion is not None:
            size = float(other_motion.size[axis])
            against.extend(against_rotation(other_motion.differential, size, axis, vibration.num_axes))
            against.extend(_against_other_motion(other_motion, axis))
            continue
        if bool(good.any()):
            against.extend(_against_fit(offsets[good, axis], fitted[good, axis]))
        # condition (24) concerns the tones only: the blur by a uniform motion is exact at any speed
        tones = Vibration(vibration.amplitude, vibration.frequency, vibration.phase)
        within_row, max_within_row = float(tones.displacement_within(timing.row_time)[axis]), 0.1  # px
        if within_row > max_within_row:
            against.append(
                f"the image moves {within_row:.2g} px within a row time, condition (24) allows "
                f"{max_within_row} px: the camera does not move as a whole, or row_time is wrong; check row_time"
            )
    for against in reasons[2:]:
        against[:] = [f"{text} (px: at {radius:.0f} px from the centre)" if " px" in text else text for text in against]
    reliable = torch.tensor([not against for against in reasons], device=vibration.device)
    return reliable, tuple(map(tuple, reasons))


def contradicted_axes(vibration: Vibration, other_motion: OtherMotion, max_tones: float) -> tuple[bool, bool]:
    """Whether the measured rows contradict the tones of each axis, so that another timing may be the cause.

    Args:
        vibration: The detected vibration (not a batch).
        other_motion: Motion of the rows that it does not explain.
        max_tones: As in ``judge``.
    """
    many = (vibration.amplitude.count_nonzero(-1) >= max_tones).tolist()
    first, second = (many[axis] or bool(_against_other_motion(other_motion, axis)) for axis in range(2))
    return first, second


def _against_measurements(
    good: Tensor, visible: Tensor, other_motion: OtherMotion | None, min_bands: float
) -> list[str]:
    """Reasons from the share of rows or bands that were measured."""
    share = float(good.double().sum() / visible.double().sum().clamp(min=1))
    if other_motion is not None:
        share = float(other_motion.measured)
    if share >= min_bands:
        return []
    what = f"{int(visible.sum())} row bands" if other_motion is None else "the rows"
    return [
        f"only {share:.0%} of {what} can be registered, {min_bands:.0%} are needed: the motion is beyond the search "
        "range (increase search), or the frames lack detail or show different scenes"
    ]


def _against_tone(
    vibration: Vibration, std: VibrationStd, axis: int, tone: int, gain: float, timing: RowTiming
) -> list[str]:
    """Reasons against one tone."""
    size, hertz = float(vibration.amplitude[axis, tone]), float(vibration.frequency[axis, tone])
    size_std, hertz_std = float(std.amplitude[axis, tone]), float(std.frequency[axis, tone])
    offset = size * gain * abs(_sinc(hertz * timing.exposure_time))
    name = f"tone of {hertz:.4g} Hz"
    against = []
    if not (0 < size_std < math.inf and 0 < hertz_std < math.inf):
        against.append(f"the uncertainty of the {name} is unknown: too few rows were measured; use more frames")
    elif size < MIN_SIGNIFICANCE * size_std and vibration.amplitude[axis].count_nonzero() == 1:
        against.append(
            f"{name} is not significant: its amplitude is {size:.3g} ± {size_std:.2g} px, and {MIN_SIGNIFICANCE:g} "
            "standard deviations are needed; use more frames"
        )
    elif offset < MIN_OFFSET:
        against.append(
            f"{name} is too small: its offsets of {offset:.2g} px are below {MIN_OFFSET} px, where errors of "
            "interpolation may cause them"
        )
    if gain < MIN_GAIN:
        against.append(
            f"{name} is nearly blind: its offset gain is {gain:.3f}, {MIN_GAIN} is needed, because every frame is "
            "displaced alike; use frames at other or unequal intervals" + _frame_rate_hint(hertz, hertz_std, timing)
        )
    if hertz * timing.exposure_time > 1.0:
        against.append(
            f"{name} is above 1/T_e = {1 / timing.exposure_time:.4g} Hz, where the exposure averages it out; use a "
            "shorter exposure"
        )
    return against


def _frame_rate_hint(hertz: float, std: float, timing: RowTiming) -> str:
    """Addition for a tone whose frequency is a multiple of the frame rate: a wrong ``frame_rows`` causes such tones."""
    multiple = round(hertz * timing.frame_period)
    if timing.frame_start_times is not None or multiple == 0:
        return ""
    if abs(hertz - multiple * timing.frame_rate) > max(3 * std, 1e-3 * hertz):
        return ""
    times = "" if multiple == 1 else f"{multiple} times "
    return (
        f"; its frequency equals {times}the frame rate of {timing.frame_rate:.5g} Hz, which a wrong frame_rows also "
        "causes: check that frame_rows counts the blanking rows and is not the image height"
    )


def _sinc(x: float) -> float:
    return math.sin(math.pi * x) / (math.pi * x) if x else 1.0


def _against_displacement(size: float, std: float, own_std: float, *, num_tones: int) -> list[str]:
    """Reasons from the displacement of the rows in px and its standard deviations, rms over the rows.

    ``own_std`` holds if the number of tones is right, ``std`` allows for a further tone. The limits and their effect
    are listed in docs/verdicts.md; of 18 simulated axes with several tones above 4 %, 3 were known within 2 %.
    """
    uncertain = f"the displacement of the rows is uncertain: {size:.2g} ± {std:.2g} px"
    if std > max(0.04 * size, 0.01) and (num_tones > 1 or std > 1.5 * own_std):
        return [f"{uncertain}, because the frames also agree with other tones; use more frames"]
    if std > 0.25 * size:
        return [f"{uncertain}; the standard deviation must be at most 25 % of the displacement; use more frames"]
    return []


def _against_fit(offsets: Tensor, fitted: Tensor, *, counted: float = 0.75) -> list[str]:
    """Reasons from the residual of the best ``counted`` of the bands: clouds may cover the others."""
    residuals = (offsets - fitted).abs().sort().values
    residual = float(residuals[: math.ceil(counted * len(residuals))].mean())
    size = float((offsets - offsets.mean()).abs().mean())
    allowed = max(0.05, 0.3 * size)  # px; smaller residuals are errors of registration
    if residual <= allowed:
        return []
    return [
        f"the fit does not explain the offset curve: mean residual {residual:.3g} px, {allowed:.3g} px are allowed for "
        f"offsets of {size:.3g} px; try more tones or model='free'"
    ]


def _against_other_motion(other: OtherMotion, axis: int) -> list[str]:
    """Reasons from motion that no vibration explains.

    docs/verdicts.md lists the limits; they exceed the errors of interpolation and of the correction for unequal blur.
    """
    size = float(other.size[axis])
    limits = (
        ("rows", float(other.unexplained[axis]), float(other.permitted[axis])),
        ("neighbouring rows", float(other.correlated[axis]), max(0.01, 0.0025 * size)),
    )
    for rows, unexplained, allowed in limits:
        if unexplained > allowed:
            return [
                f"{rows} move by {unexplained:.3g} px that no tone explains, {allowed:.2g} px are allowed; try more "
                "tones or model='free', and check frame_rows, row_time and the start times of the frames"
            ]
    return []


def _max_apart(size: float) -> float:
    """Largest permitted difference in px of the displacements along a row, for an axis with offsets of size px rms."""
    return max(0.035, 0.009 * size)


def rotation_found(other: OtherMotion) -> bool:
    """Whether the halves of the rows of one stack move apart, as roll and zoom cause it."""
    return any(float(other.differential[1 - axis]) > _max_apart(float(other.size[axis])) for axis in range(2))


# Limits of roll and zoom as the cause. Of 15 recordings with either, 0.057 px of the differences along a row were not
# linear in the column, and the rows moved by 4 times the difference of their halves; clouds, parallax and objects had
# 0.12 px and more, motions that are no sums of tones 10 times and more.
_MAX_UNEVEN, _MAX_MOVED = 3.0, 8.0  # of the permitted difference of the halves, of the difference of the halves


def rotation_possible(other: OtherMotion, uneven: Tensor, aspect: float) -> bool:
    """Whether roll or zoom may be all that the fit of one stack does not explain.

    Args:
        other: Motion of the rows that the fit does not explain.
        uneven: (2,) px, differences of the displacements along a row that are not linear in the column.
        aspect: Rows of a frame over its columns.
    """
    if not rotation_found(other):
        return False
    for axis in range(2):
        apart, moved = float(other.differential[1 - axis]), float(other.unexplained[axis])
        if float(uneven[1 - axis]) > _MAX_UNEVEN * _max_apart(float(other.size[axis])):
            return False
        if moved > max(float(other.permitted[axis]), _MAX_MOVED * max(1.0, aspect) * apart):
            return False
    return True


def against_rotation(differential: Tensor, size: float, axis: int, axes: int, remedy: str = "'auto'") -> list[str]:
    """Reasons against an axis from rotation and zoom, which move the halves of a row apart along the other axis.

    A roll by theta moves the halves of a row by ``theta W / 4`` along y in opposite directions, and rows by up to
    ``theta H / 2`` along x. A zoom does the same with the axes exchanged. Rows of both axes are concerned by parallax.

    Args:
        differential: (2,) px, rms difference of the displacements along a row that the motion does not explain.
        size: px, rms offset along the axis.
        axis: The axis, in row order.
        axes: Number of components of the motion.
        remedy: Value of ``roll`` and ``zoom`` with which they are measured.
    """
    allowed = _max_apart(size)
    if axes > 2:
        apart = float(differential.amax())
        if apart <= allowed:
            return []
        return [
            f"strips of columns move apart by {apart:.3g} px that roll and zoom do not explain, {allowed:.2g} px are "
            "allowed: the scene has parallax, or the lens is distorted; select a part of the frame with one distance"
        ]
    apart = float(differential[1 - axis])
    if apart <= allowed:
        return []
    return [
        f"left and right halves of the rows move apart by {apart:.3g} px along {'yx'[axis]}, {allowed:.2g} px are "
        f"allowed: the camera rolls or zooms (pass roll={remedy}, zoom={remedy} and no columns), or the scene has "
        "parallax (select a part of the frame with one distance)"
    ]


def _against_exposure(other: OtherMotion, timing: RowTiming) -> list[str]:
    """Reasons against both axes from the difference of the blur between frames.

    Its ratio to the expected one is the square of the ratio of the exposure times (docs/verdicts.md). Interpolation
    errors increase it by about 0.005 / size, so that high ratios count only if the excess is 0.02 of the detail, and
    sizes below 0.002 do not count; above 0.25 the second order is not enough. Negative ratios are caused by another
    error, because no exposure time gives them.
    """
    ratio, std, size = other.blur.tolist()
    low = -0.3 < ratio < 0.6 and 1 - ratio > 3 * std
    high = ratio > 2.5 and ratio - 1 > 5 * std and (ratio - 1) * size > 0.02
    if not 0.002 < size < 0.25 or not (low or high):
        return []
    rows = timing.exposure_rows
    likely = f" (about {rows * math.sqrt(ratio):.2g} rows agree with the blur)" if ratio > 0 else ""
    return [
        f"the difference of the blur between frames is {ratio:.2g} times the value expected for an exposure of "
        f"{rows:g} rows; check exposure_rows{likely}, and frame_rows and row_time, which determine the motion"
    ]
