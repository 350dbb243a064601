"""Reasons against a result as data, and the table from which their texts follow.

A new reason is an entry of the table below and the comparison that returns a ``Reason`` with its code. docs/reasons.md
is written from the table.
"""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from operator import attrgetter
from string import Formatter
from typing import Any

from rsvib_torch.files.reading import Table
from rsvib_torch.text import quoted

Findings = tuple[Any, ...]  # reasons, or such a tuple for each axis, or for each result of a batch


@dataclass(frozen=True)
class ReasonKind:
    """The reasons of one code: their text, and what they compare.

    Sentence and remedy are templates with the fields ``value``, ``limit``, ``axis``, ``other`` (the axis across it) and
    the names of the details. A part in square brackets is omitted if one of its details is not given. They are read by
    users of Python and of the program: options have their names in Python, which configuration files have as well.
    """

    sentence: str  # template of the sentence
    remedy: str = ""  # template of what the user can do; empty if nothing is known
    compares: str = ""  # the quantity, and from which limit on it is a reason; empty if there is no limit
    unit: str = ""  # unit of value and limit; empty for a ratio, a count, or nothing
    refuses: str = "the axis"  # what is refused
    free_model: bool = False  # whether ``detect_motion`` may explain the frames


@dataclass(frozen=True)
class Reason:
    """Why a result, or one axis of it, is not reliable.

    Example:
        >>> reason = Reason("tone_averaged_out", "x", 2600.0, 2500.0)
        >>> print(reason)
        tone of 2600 Hz is above 1/T_e = 2500 Hz, where the exposure averages it out; use a shorter exposure
    """

    code: str  # key of the table ``REASONS``
    axis: str | None = None  # ``"x"``, ``"y"``, ``"roll"`` or ``"zoom"``; None for all axes
    value: float | None = None  # the compared quantity in the unit of the table; None if nothing is compared
    limit: float | None = None  # its limit in the same unit
    details: Mapping[str, float | str] = field(default_factory=dict)  # further numbers and texts of the sentence

    def __post_init__(self) -> None:
        if self.code not in REASONS:
            raise ValueError(f"code must be one of {', '.join(REASONS)}, got {quoted(self.code)}")
        try:
            str(self)
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"value, limit or details of {quoted(self.code)} do not fit its text") from error

    @property
    def kind(self) -> ReasonKind:
        """Entry of the table."""
        return REASONS[self.code]

    def __str__(self) -> str:
        """The sentence with its remedy, without the axis."""
        values = {"axis": self.axis, "other": {"x": "y", "y": "x"}.get(self.axis or ""), **self.details}
        # JSON has no infinity: a number that is missing in a file was infinite
        values |= {name: getattr(self, name) if getattr(self, name) is not None else math.inf for name in _COMPARED}
        remedy = str(self.details.get("instead", self.kind.remedy))  # another remedy than that of the table
        template = "; ".join(filter(None, (self.kind.sentence, remedy))) + _AT_RADIUS

        def part(match: re.Match[str]) -> str:
            names = {name for _, name, _, _ in Formatter().parse(match[1]) if name}
            return match[1] if names <= values.keys() else ""

        return re.sub(r"\[([^]]*)\]", part, template).format_map(values)

    @property
    def with_axis(self) -> str:
        """The text after the name of the axis."""
        return str(self) if self.axis is None else f"{self.axis}: {self}"

    def to_dict(self) -> dict[str, object]:
        """The reason as JSON can store it, with its text; None for numbers that are not finite."""
        numbers = {
            name: None if isinstance(number, float) and not math.isfinite(number) else number
            for name, number in {"value": self.value, "limit": self.limit, **self.details}.items()
        }
        compared = {name: numbers.pop(name) for name in _COMPARED}
        return {"code": self.code, "axis": self.axis, **compared, "details": numbers, "text": str(self)}

    @classmethod
    def from_dict(cls, values: Table) -> "Reason":
        """Inverse of ``to_dict``; a code that this version does not know becomes ``"unspecified"`` with its text."""
        code, axis = values.get("code"), values.get("axis")
        if code not in REASONS:
            return cls("unspecified", axis, details={"text": str(values.get("text", code))})
        details = {name: math.inf if value is None else value for name, value in (values.get("details") or {}).items()}
        return cls(code, axis, values.get("value"), values.get("limit"), details)


_COMPARED = ("value", "limit")
_AT_RADIUS = "[ (px: at {radius:.0f} px from the centre)]"  # for components of roll and zoom


def texts(findings: Findings, text: Callable[[Reason], str] = attrgetter("with_axis")) -> tuple[Any, ...]:
    """Texts of reasons: of those in the tuple of an axis without its name, of others with it."""
    return tuple(text(one) if isinstance(one, Reason) else texts(one, str) for one in findings)


def read_findings(values: object) -> Reason | Findings:
    """Reasons in nested lists as JSON files have them."""
    if isinstance(values, dict):
        return Reason.from_dict(values)
    if not isinstance(values, (list, tuple)):
        raise ValueError(f"findings: expected a list of reasons, got {quoted(values)}")
    return tuple(map(read_findings, values))


_MORE_FRAMES = "use more frames"
_MAY_BE_STILL = "the camera may stand still along this axis; use more frames if a vibration is expected"
_CHANGES = "detect_motion (rsvib motion) if the vibration changes"
_TONES_OR_FREE = f"try more tones, or {_CHANGES}"
_CHECK_TIMING = "and check frame_rows, row_time, exposure_rows and the times of frames (lost or repeated ones?)"
_UNCERTAIN = "the displacement of the rows is uncertain: {size:.2g} ± {value:.2g} px"

_px = partial(ReasonKind, unit="px")
_of_result = partial(ReasonKind, refuses="the result")
_px_of_result = partial(_px, refuses="the result")
_of_all_axes = partial(ReasonKind, refuses="all axes")

_TONES = {
    "rows_not_registered": _of_all_axes(
        "only {value:.0%} of {what} can be registered, {limit:.0%} are needed: the motion is beyond the search range, "
        "or the frames lack detail or show different scenes",
        "increase search",
        "fraction of the visible rows (of the frames with the fewest) or bands that were registered and of the "
        "registered bands that correlate more than independent noise, below 0.5",
    ),
    "no_tone": ReasonKind(
        "no significant tone: the offsets are those of a uniform motion, or below their noise", _MAY_BE_STILL
    ),
    "too_many_tones": ReasonKind(
        "{value:g} tones, of at most {limit:g}, do not explain the motion: it is not a sum of few tones, or the timing "
        "is wrong",
        "try detect_motion (rsvib motion)",
        "number of tones, if it is the largest that is tried (4)",
        free_model=True,
    ),
    "tone_uncertainty_unknown": ReasonKind(
        "the uncertainty of the tone of {frequency:.4g} Hz is unknown: too few rows were measured", _MORE_FRAMES
    ),
    "tone_too_small": _px(
        "tone of {frequency:.4g} Hz is too small: its offsets of {value:.2g} px are below {limit:g} px, where errors "
        "of interpolation may cause them",
        compares="amplitude of the offsets of a tone, below 0.01 px",
    ),
    "tone_blind": ReasonKind(
        "tone of {frequency:.4g} Hz is nearly blind: its offset gain is {value:.3f}, {limit:g} is needed, because "
        "every frame is displaced alike",
        "use frames at other or unequal intervals[; its frequency equals {multiple}the frame rate of {frame_rate:.5g} "
        "Hz, which a wrong frame_rows also causes: check that frame_rows counts the blanking rows and is not the image "
        "height]",
        "offset gain of a tone, below 0.1; in two frames below 0.3, where an image motion and another tone explain the "
        "rows as well",
    ),
    "tones_alias": ReasonKind(
        "tones of {value:.5g} and {limit:.5g} Hz are a multiple of the frame rate apart: both explain one motion, "
        "because the rows are read in another time than stated, or the camera vibrates in roll",
        f"use frames at another rate if both exist, {_CHECK_TIMING}",
        "frequencies of two tones, whose difference is a multiple of the frame rate (three standard deviations)",
        "Hz",
    ),
    "tone_changes": _px(
        "tone of {frequency:.4g} Hz changes by {value:.2g} px faster than it is followed, {limit:.2g} px are allowed",
        "if frames are missing, use the video as the camera recorded it",
        "what a spline does not follow of the largest tone of a video, above a third of its mean amplitude, or above a "
        "tenth if its phase jumps from a frame to the next one",
    ),
    "tone_averaged_out": ReasonKind(
        "tone of {value:.4g} Hz is above 1/T_e = {limit:.4g} Hz, where the exposure averages it out",
        "use a shorter exposure",
        "frequency of a tone, above 1 / exposure time",
        "Hz",
    ),
    "displacement_ambiguous": _px(
        f"{_UNCERTAIN}, {{limit:.2g}} px are allowed, because the frames also agree with other tones",
        f"use {_CHANGES}, or more frames",
        "standard deviation of the displacement of the rows, above 4 % of it and 0.01 px, with several tones or if it "
        "exceeds 1.5 times the one of the fit alone",
    ),
    "displacement_uncertain": _px(
        f"{_UNCERTAIN}; the standard deviation must be at most 25 % of the displacement, {{limit:.2g}} px",
        _MAY_BE_STILL,
        "standard deviation of the displacement of the rows, above 25 % of it",
    ),
    "rows_unexplained": _px(
        "rows move by {value:.3g} px that no tone explains, {limit:.2g} px are allowed",
        f"{_TONES_OR_FREE}, {_CHECK_TIMING}",
        "rms residual of the rows without their noise, or residual of the typical row of the frames that are explained "
        "worst if it is 5 times that of all, above 0.6 % of the rms offsets, at least 0.05 px and at most 0.1 px",
        free_model=True,
    ),
    "neighbours_unexplained": _px(
        "neighbouring rows move by {value:.3g} px that no tone explains, {limit:.2g} px are allowed",
        f"{_TONES_OR_FREE}, {_CHECK_TIMING}",
        "the part of the residual that neighbouring rows have in common, above 0.01 px and 0.25 % of the rms offsets, "
        "with 95 % confidence",
        free_model=True,
    ),
    "halves_apart": _px(
        "left and right halves of the rows move apart by {value:.3g} px along {other}, {limit:.2g} px are allowed: the "
        "camera rolls or zooms (measure it with roll, zoom and no columns), or the scene has parallax (select a "
        "part of the frame with one distance)",
        compares="rms difference between the halves of the rows along the other axis, above 0.035 px and 0.9 % of the "
        "rms offsets",
    ),
    "strips_apart": _px(
        "strips of columns move apart by {value:.3g} px that roll and zoom do not explain, {limit:.2g} px are allowed: "
        "the scene has parallax, or the lens is distorted",
        "select a part of the frame with one distance",
        "with roll or zoom: rms difference between strips of columns, above 0.035 px and 0.9 % of the rms offsets",
    ),
    "blur_contradicts_exposure": _of_all_axes(
        "the difference of the blur between frames is {value:.3g} times the value expected for an exposure of "
        "{exposure_rows:.4g} rows[ ({exposure_ms:.3g} ms)], the limit is {limit:g}[; about {likely_ms:.2g} ms agree "
        "with the blur, or more if compression hides a part of it]",
        "check exposure_rows[ (about {likely:.2g} rows agree with the blur)], and frame_rows and row_time, which "
        "determine the motion[; the compression of a {compressed}, which makes frames alike, is another cause]",
        "difference of the blur between frames over the expected one, significantly between -0.3 and 0.6 or above 2",
    ),
    "bands_unexplained": _px(
        "the fit does not explain the offset curve: mean residual {value:.3g} px, {limit:.3g} px are allowed for "
        "offsets of {size:.3g} px",
        _TONES_OR_FREE,
        "method='bands': mean residual of the best three quarters of the bands, above 0.05 px and 30 % of the offsets",
        free_model=True,
    ),
    "motion_within_row_time": _px(
        "the image moves {value:.2g} px within a row time, {limit:g} px are allowed: the camera does not move as a "
        "whole, the frames show no detail along this axis, or row_time is wrong",
        "check row_time",
        "motion within a row time, above 0.1 px with method='bands' (condition (24) of the paper), and above 0.8 px "
        "along the scan otherwise",
    ),
    "other_frame_rows": _of_all_axes(
        "the frames agree with frame_rows={limit:.5g}, not with {value:g}: frame_rows counts the blanking rows and is "
        "not the image height",
        "if the frame rate is known, row_time is 1 / (frame rate x frame_rows), with {frame_rate:.5g} frames/s "
        "{row_time:.5g} s",
        "the stated frame_rows (value), and the one with which detection is reliable (limit)",
        "row times",
    ),
    "other_row_time": _of_all_axes(
        "the frames agree with row_time={limit:.5g} s, not with {value:g} s, if the start times of frames are right",
        compares="the stated row time (value), and the one with which detection is reliable (limit)",
        unit="s",
    ),
    "other_frame_times": _of_all_axes(
        "the frames agree with a lost frame between frames {before} and {after}",
        "state frame_start_times that are a frame period later from frame {after} on, or detect in the frames before "
        "or after the lost one",
    ),
    "other_readout_direction": _of_all_axes(
        "the frames agree with readout_direction='{agreeing}', not with '{stated}'"
    ),
    "other_scan_axis": _of_all_axes("the frames agree with scan_axis='{agreeing}', not with '{stated}'"),
}
_SHAPES = {
    "frames_repeated": ReasonKind(
        "{value:.0%} of the frames are copies of the frame before, {limit:.0%} are allowed: the video does not have "
        "the times of the camera",
        "use the video as the camera recorded it",
        "part of the frames of a video that are copies of the frame before, above 5 %",
    ),
    "rows_differ": ReasonKind(
        "{value:.0%} of a tone is left in a third of the rows or columns, {limit:.0%} is allowed: a part of the "
        "picture moves by itself, or roll or zoom vibrates",
        compares="largest part of a tone of a video that is left in a third of the rows or columns, above 25 %",
    ),
    "corners_unexplained": _px(
        "corners move by {value:.3g} px that no path of the camera and no tones explain, {limit:.2g} px are allowed; "
        "parts of the scene may move by themselves",
        compares="standard deviation of the offsets of corners in a window of a video",
    ),
    "readout_contradicted": _px(
        "path and tones leave {value:.2g} px of the motion of corners, and {limit:.2g} px if the rows are read {other}",
        "check row_time, scan_axis, readout_direction, and the frame rate: of slow motion, that of the camera",
        "residual of the corners of a video with the stated and with another readout, whose square is smaller by a "
        "tenth or more",
    ),
    "motion_unexplained": _px(
        "rows move by {value:.3g} px that no smooth motion explains, {limit:.2g} px are allowed",
        compares="rms residual of the rows, above 15 % of their motion and 0.03 px",
    ),
    "bands_contradict": _px(
        "the offsets of row bands of two frames differ by {value:.3g} px from it, {limit:.3g} px are allowed: noise "
        "hides the scene, or a frame shows another one",
        compares="mean difference of the best three quarters of the row bands of two frames, above 0.1 px and 30 % of "
        "the mean deviation of the offsets of two frames",
    ),
    "motion_uncertain": _px(
        "the motion is determined to {value:.3g} px only, {limit:g} px are needed: frames may show different scenes",
        "use detect_vibration with image_acceleration if the motion has a constant acceleration",
        compares="rms standard deviation of the visible part of the motion, above 0.3 px",
    ),
    "common_motion_uncertain": _px(
        "the part of the motion that all frames have in common has a standard deviation of {value:.3g} px, more than "
        "{limit:.3g} px",
        "use more frames, or frames at other or unequal intervals; tones are measured by detect_vibration",
        compares="rms standard deviation of the common part of the motion, above 0.3 px and the rms motion, or above "
        "0.2 of the motion if its largest part is near a multiple of the frame rate",
    ),
    "common_motion_large": _px(
        "all frames have {value:.3g} px of the motion in common, more than {limit:.3g} px, ten times what differs "
        "between them: a tone near a multiple of the frame rate, or a wrong frame_rows",
        "check that frame_rows counts the blanking rows, or measure tones with detect_vibration",
        compares="rms of the common part of the motion, above ten times that of the rest",
    ),
}
_RECORDED = {
    "recorded_motion_too_small": _px_of_result(
        "the recorded motion moves rows by {value:.2g} px between frames, too little: {limit:g} px are needed",
        compares="rms motion of the rows between frames by the recording, below 0.05 px",
    ),
    "recording_incomplete": _px_of_result(
        "rows move by {value:.3g} px that the recording does not explain, {limit:.2g} px are allowed",
        compares="motion of the rows beside the recorded one, above 25 % of the recorded motion and 0.05 px",
    ),
    "motion_repeats": _of_result("an offset of {offset:.6g} s explains the frames as well: the motion repeats"),
    "offset_outside": _of_result(
        "the frames begin at {value:.6g} s of the recording, and offsets ends at {limit:.6g} s",
        compares="offset of the best fit, beyond a limit of those given by more than 4 standard deviations",
        unit="s",
    ),
    "axes_mirrored": _of_result(
        "the mirrored axes {axes} fit better than every rotation: the frames are mirrored, or the recording has "
        "left-handed axes"
    ),
    "axes_ambiguous": _of_result("the axes {axes} explain the frames as well", "rotate the camera about all axes"),
    "focal_length_uncertain": _px_of_result(
        "the focal length is not determined, {focal_length:.4g} ± {value:.2g} px, at most ± {limit:.2g} px is allowed",
        "give camera=",
        "standard deviation of the focal length, above 5 % of it",
    ),
    "focal_length_implausible": _px_of_result(
        "a focal length of {value:.0f} px agrees with the rates, {times:.3g} times the longer side of the frames and "
        "beyond the limit of {limit:.0f} px: rates in degrees per second instead of rad/s, or the reverse, cause it",
        "check the unit of the rates, or give camera=",
        "fitted focal length, below 0.15 or above 30 times the longer side of the frames",
    ),
    "fit_not_converged": _of_result("the fit does not converge"),
    "gap_in_recording": _of_result(
        "the recording has a gap of {value:.3g} s within the frames, {limit:.3g} s are allowed",
        compares="longest interval between samples within the frames, above 4 times the median",
        unit="s",
    ),
    "readout_too_long": _of_result(
        "the readout of {rows:g} rows takes {value:.4g} s, longer than the interval of {limit:.4g} s between frames",
        compares="duration of the readout, above the shortest interval between frames",
        unit="s",
    ),
}
_ROW_TIME = {
    "row_time_uncertain": _of_result(
        "the standard deviation is {value:.2g} of the row time, and {limit:g} is allowed: the motion is too small, or "
        "nearly the same in all frames",
        compares="standard deviation of the row time over the row time, above 0.01; with a gyroscope above 0.2",
    ),
    "row_times_ambiguous": _of_result(
        "{value:g} row times explain the frames instead of {limit:g}: {row_time:.4f} us as well as {others} us "
        "(negative: reverse readout)",
        "give row_time limits around the right one (--row-time twice), or use frames with vibrations of other, "
        "unrelated frequencies",
        "number of row times that explain the frames, above 1",
    ),
    "row_time_contradicted": _of_result(
        "no row time within the limits agrees with the vibration: its frequencies per row and per frame contradict "
        "each other (chi-square {value:.3g}, at most {limit:g} is expected)",
        "check the frame rate, and give row_time wider limits (--row-time twice)",
        "chi-square of the frequencies of the tones at the row time, above 20",
    ),
    "too_few_frames_for_row_time": _of_result(
        "{value:g} frames determine the product of row time and frequency only, {limit:g} are needed",
        _MORE_FRAMES,
        "number of frames, below 3",
    ),
    "no_motion_for_row_time": _of_result(
        "no vibration determines the row time",
        "shake the camera while it records, use more frames, and leave out what is fixed to the frames or moves by "
        "itself (ignore)",
    ),
}
_RESTORATION = {
    "axis_not_reliable": ReasonKind("[stack {stack:g}: ]{axis} is not {action}: its vibration is not reliable ({why})"),
    "axis_not_accurate": ReasonKind(
        "[stack {stack:g}: ]{axis} is not {action}: its displacement of {size:.2g} {unit} has a standard deviation of "
        "{value:.2g} {unit}, {limit:.2g} {unit} are allowed",
        "detect it from more frames",
        "standard deviation of the displacement of the rows, above its rms over the square root of 2",
        "px; roll: rad; zoom: 1",
    ),
    "motion_remains": _px(
        "frames lie {before:.2g} px apart, {value:.2g} px remain unexplained, {limit:.2g} px are allowed",
        compares="displacement between the prediction from a restored frame and the next raw frame, above 0.35 "
        "(partly) or 0.8 (worse) of that of the raw frames",
        refuses="the pair: partly or worse",
    ),
    "no_contrast": ReasonKind("the frames have no contrast", refuses="the pair: unknown"),
    "displaced_alike": _px(
        "frames lie {value:.2g} px apart, less than {limit:.2g} px: all are displaced alike",
        compares="displacement between the raw frames, at most 0.03 px or what can be distinguished from zero",
        refuses="the pair: unknown",
    ),
    "nothing_undone": ReasonKind("no vibration was undone", refuses="the pair: unknown"),
    "noise_outweighs": ReasonKind(
        "noise and artefacts outweigh the restored sharpness (estimated improvement {value:.1f} dB, below {limit:g})",
        compares="estimated improvement, below -2 dB",
        unit="dB",
        refuses="the pair: worse",
    ),
    "improvement_uncertain": ReasonKind(
        "the estimated improvement of {value:.1f} dB is negative, and above {limit:g} dB within its error",
        compares="estimated improvement, between -2 dB (its error) and 0",
        unit="dB",
        refuses="the pair: unknown",
    ),
    "pixels_missing": ReasonKind(
        "{value:.0%} of the pixels are missing, {limit:.0%} are allowed",
        compares="fraction of the pixels that are missing, above 0.5",
        refuses="the pair: unknown",
    ),
}

# The codes by what they refuse; a code belongs to one group.
GROUPS = {
    "Tones (`detect_vibration`)": _TONES,
    "Other motions (`detect_motion`)": _SHAPES,
    "Recorded motions (`align_motion`)": _RECORDED,
    "Row time (`calibrate_row_time_by_motion`)": _ROW_TIME,
    "Restoration (`restore`, `judge_restoration`)": _RESTORATION,
    "Files of later versions": {"unspecified": ReasonKind("{text}")},
}
REASONS = {code: kind for kinds in GROUPS.values() for code, kind in kinds.items()}
