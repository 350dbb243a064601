"""The vibration at each frame of a stack, by trackers that run through it forwards and backwards.

Both begin with the tones of the whole record (``changing_tones``). What two trackers that share no frame agree on is
not an error of their start, and each knows the frames in which the other begins. Backwards in time, the last row of the
last frame is the first that is exposed, and rows move in the opposite direction.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.checks.arrays import FramesOrFiles
from rsvib_torch.detection.shapes.free import start_of_stack
from rsvib_torch.detection.tones.fit import residual_of
from rsvib_torch.detection.verdict import Findings, scene_reasons
from rsvib_torch.execution.parallel import threads_for
from rsvib_torch.execution.precision import full_precision, without_gradients
from rsvib_torch.execution.progress import steps
from rsvib_torch.frames.entry_points import frames_options
from rsvib_torch.frames.grey import GreyFrames, grey_frames
from rsvib_torch.frames.orientation import findings_from_row_order, magnitudes_from_row_order
from rsvib_torch.motion.detected_vibration import FollowedVibration
from rsvib_torch.motion.timing import RowTiming, SensorTiming
from rsvib_torch.motion.vibration import Vibration, VibrationStd
from rsvib_torch.numerics.tables import Array, table, tensor
from rsvib_torch.options import FollowOptions, RegistrationOptions
from rsvib_torch.registration import OffsetCurve
from rsvib_torch.results.presentation import AXIS_NAMES
from rsvib_torch.results.reason import Reason
from rsvib_torch.tracking.changing_tones import (
    ChangingTones,
    changing_tones,
    moving_parts,
    of_frames,
    tones_of_rows,
)
from rsvib_torch.tracking.tone_filter import ToneFilter
from rsvib_torch.tracking.tracked_frame import TrackedTones, displacement_std_at_frame, vibration_at_frame
from rsvib_torch.tracking.tracker import PATIENCE, TrackerState, VibrationTracker

_BANDS = RegistrationOptions()
_SLOWEST = 1.25  # frame rates; slower tones are not distinguished from a drift that changes, which trackers follow
_BEGIN = 3  # frames at the start of a tracker, whose rows are measured around a less accurate motion
_TONE = ("amplitude", "frequency", "phase")
_DRIFT = ("image_motion", "image_acceleration")
_STDS = (*_TONE, "period", *_DRIFT, "displacement")
_ACROSS = (1.0, -1.0)  # sign of displacements along and across the rows if rows are read backwards
_SIZE_STD, _FREQUENCY_STD = 0.2, 0.2  # of the amplitude, and Hz, of the tones of a record at a frame
_MAX_SIZE_STD = 0.3  # px, of all tones; with 0.2 of 2.6 px and more, no tracker began, because rows are not predicted
# Largest rms difference of the displacements of the rows by both trackers: px, of the displacement, and standard
# deviations of the difference.
_MAX_APART = (0.01, 0.03, 4.0)
# Part of the frames whose rows contradict the tones of an axis: with more, tones are missing or wrong in all frames. Of
# 16 axes with two tones that decay, 4 had wrong displacements in frames whose rows do not contradict them.
_MAX_CONTRADICTED = 0.07
_UNCERTAIN = {"displacement_ambiguous", "displacement_uncertain"}  # by the tracker that knows an axis less well
# "tone_blind": trackers that begin with a tone that sweeps out of a blind frequency were wrong by 1 px
_CONTRADICTED = {
    "rows_unexplained",
    "neighbours_unexplained",
    "halves_apart",
    "directions_differ",
    "not_followed",
    "tone_blind",
}


class _Follower(VibrationTracker):
    """A tracker of grey frames in row order that begins, and begins again, with the tones of the record."""

    def __init__(self, timing: RowTiming, tones: Sequence[ChangingTones], columns: int | None) -> None:
        super().__init__(timing, columns=columns)
        self._known = tones

    def _detected(self, state: TrackerState) -> TrackerState:
        if len(state.frames) < 2 or (state.track is not None and state.contradictions < PATIENCE):
            return state
        before, last = state.frames[-2:]
        time = 0.5 * (before.time + last.time) + 0.5 * last.images.shape[-2] * self._rows.row_time
        parts = [of_axis.at(time) for of_axis in self._known]
        count = max(1, *(len(size) for size, _ in parts))
        coefficients = np.array([np.pad(size, (0, count - len(size))) for size, _ in parts])
        frequencies = np.array([np.pad(one.frequencies, (0, count - len(one.frequencies))) for one in self._known])
        drift = np.array([[velocity, 0.0] for _, velocity in parts])
        size_std, frequency_std = _SIZE_STD * np.abs(coefficients), np.full_like(frequencies, _FREQUENCY_STD)
        size_std *= np.minimum(_MAX_SIZE_STD / np.maximum(np.linalg.norm(size_std, axis=1, keepdims=True), 1e-9), 1.0)
        state = replace(state, contradictions=0)
        exposure_time = self._rows.exposure_time
        started = ToneFilter.started(time, exposure_time, coefficients, frequencies, drift, size_std, frequency_std)
        return self._begun(state, started)


@dataclass(frozen=True, eq=False)
class _AtFrame:
    """Both axes at a frame, in row order; the time origin is the start of the frame.

    Tones are in the order of those of the record, with which the filters begin.
    """

    values: Mapping[str, Tensor]  # (2, K), the fields of ``Vibration``
    std: Mapping[str, Tensor]  # those of ``VibrationStd``
    known_std: Array  # (2,) px, of the displacement of the rows
    residual: Array  # (2,) px
    findings: Findings  # reasons against each axis
    moved: Array  # (N, 2) px, displacement of rows by the tones, without their mean


_Judged = tuple[_AtFrame | None, tuple[Reason, ...]]  # what an axis is known from, and the reasons against it


@frames_options(FollowOptions)
@full_precision
@without_gradients
def follow_vibration(frames: FramesOrFiles, timing: SensorTiming, options: FollowOptions) -> FollowedVibration:
    """Follow a vibration that changes, e.g. decays, from frame to frame.

    Args:
        frames: Stack (T, H, W), (T, C, H, W) or (B, T, C, H, W), as for ``detect_vibration``.
        timing: The sensor.
        options: Options.

    Returns:
        The vibration at each frame: a batch with one entry per frame, which ``restore`` accepts.

    Raises:
        ValueError: As by ``detect_vibration``.

    Example:
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import city_and_fields
        >>> timing = rsv.SensorTiming(row_time=40e-6, exposure_rows=20, frame_rows=300)
        >>> times = torch.arange(-0.01, 0.3, 2e-4, dtype=torch.float64)
        >>> tone = 3.0 * torch.exp(-times / 0.3) * torch.sin(2 * torch.pi * 110 * times)  # px
        >>> decaying = rsv.FreeMotion.through(times, torch.stack([tone, 0.5 * tone], -1))
        >>> frames = rsv.simulate_frames(city_and_fields(320, 240, seed=3), timing, decaying, num_frames=20)
        >>> followed = rsv.follow_vibration(frames, timing)
        >>> followed.vibration.amplitude[::10, 0, 0].round(decimals=1).tolist()  # px along x, of frames 0 and 10
        [2.9, 2.0]
    """
    stacks = grey_frames(frames, timing, options)
    with threads_for(stacks.images):
        followed = [_followed(stacks.one(index), options) for index in range(len(stacks.images))]
    if not stacks.batched:
        return followed[0]
    count = max(one.gain.shape[-1] for one in followed)
    return FollowedVibration.stacked([one.with_tones(count) for one in followed])


def _followed(stack: GreyFrames, options: FollowOptions) -> FollowedVibration:
    rows, start = start_of_stack(stack, stack.timing, _BANDS)
    curve = start.curve
    against = scene_reasons(curve, stack.images.shape[-1])[0]
    if against:
        raise ValueError(str(against[0]))
    starts = table(rows.frame_starts(stack.images.shape[1]))
    images = stack.images[0] if stack.valid is None else stack.images[0].masked_fill(~stack.valid[0], math.nan)
    rows = replace(rows, frame_start_times=None)  # from here on, the starts have them
    parts, at_rest = moving_parts(curve)
    judged = [_unknown("no_tone" if rests else "not_followed") for rests in at_rest]
    for part in parts:
        judged[part] = _followed_part(images[part], starts[part], of_frames(curve, part), rows, options)
    return _assembled(judged, starts, stack)


def _unknown(code: str) -> list[_Judged]:
    """Both axes of a frame of which nothing is known."""
    return [(None, (Reason(code, name),)) for name in AXIS_NAMES[:2]]


def _followed_part(
    images: Tensor, starts: Array, curve: OffsetCurve, rows: RowTiming, options: FollowOptions
) -> list[list[_Judged]]:
    """Each axis at each of T frames (T, H, W) with their starts in s, and the offsets of their row bands."""
    number, height = images.shape[:2]
    tones: Sequence[ChangingTones] = changing_tones(curve, starts, rows, _BANDS)
    ends = starts + (height - 1) * rows.row_time + rows.exposure_time
    results: list[list[list[_Judged]]] = []
    for last in (False, True):
        # 1. Both trackers. Backwards, a frame begins with the end of its last row.
        step = steps(2 * number, "frames")
        forwards = _tracked(images, starts, rows, tones, options.columns, step)
        backwards = _tracked(images.flip(0, 1), -ends[::-1], rows, _reversed(tones), options.columns, step)[::-1]
        # 2. The measured rows may show tones that bands do not, and decide between tones.
        measured = [(one.time, one.measurements) for one in forwards if one is not None][_BEGIN:]
        found = tones_of_rows(measured, starts, rows, _BANDS.band_rows) if measured else tones
        slowest = _SLOWEST * rows.frame_rate
        missing = [known.missing(one, slowest) for known, one in zip(tones, found, strict=True)]
        others = [
            frequency or (known.other and one.other)
            for known, one, frequency in zip(tones, found, missing, strict=True)
        ]
        # 3. What both trackers agree on, at each frame and axis.
        both_trackers = (
            _at_frames(forwards, starts, starts, rows, height, 1),
            _at_frames(backwards, starts, ends, rows, height, -1),
        )
        judged = [
            [_judged([one for one in both if one is not None], axis, others[axis]) for axis in range(2)]
            for both in zip(*both_trackers, strict=True)
        ]
        results.append(_with_reasons_of_axes(_with_wider_ends(judged)))
        # 4. Once more, with the tones that are missing.
        if last or missing == [None, None]:
            break
        tones = [known if one is None else other for known, other, one in zip(tones, found, missing, strict=True)]
    return max(results, key=_num_reliable)


def _num_reliable(judged: list[list[_Judged]]) -> int:
    """Number of axes of frames without a reason against them."""
    return sum(not against for of_frame in judged for _, against in of_frame)


def _reversed(tones: Sequence[ChangingTones]) -> list[ChangingTones]:
    """The tones backwards in time; displacements across the rows then have the opposite sign."""
    return [
        replace(
            one,
            knots=-one.knots[::-1],
            coefficients=sign * one.coefficients[:, ::-1].conj(),
            velocity=-sign * one.velocity[::-1],
        )
        for one, sign in zip(tones, _ACROSS, strict=True)
    ]


def _tracked(
    images: Tensor,
    starts: Array,
    rows: RowTiming,
    tones: Sequence[ChangingTones],
    columns: int | None,
    step: Callable[[], None],
) -> list[TrackedTones | None]:
    """The tones at each of T frames (T, H, W) with their starts in s; None where they are not known."""
    tracker = _Follower(rows, tones, columns)
    found = []
    for image, start in zip(images, starts, strict=True):
        found.append(tracker.update(image, float(start)).tones)
        step()
    return found


def _at_frames(
    tracked: Sequence[TrackedTones | None],
    starts: Array,
    origins: Array,
    rows: RowTiming,
    height: int,
    direction: int,
) -> list[_AtFrame | None]:
    """Both axes at frames that start at ``starts`` in s, from the tones of one tracker with time origins in s.

    Each has the mean standard deviations of the five frames around it. They change with the process noise that is the
    most probable at a frame, by up to ten times, the errors do not.
    """
    found = [
        None if tones is None else _at_frame(tones, start - origin, rows, height, direction)
        for tones, start, origin in zip(tracked, starts, origins, strict=True)
    ]
    averaged: list[_AtFrame | None] = []
    for index, one in enumerate(found):
        around = [other.std for other in found[max(index - 2, 0) : index + 3] if one and other]
        stds = {name: torch.stack([std[name] for std in around]).mean(0) for name in _STDS if around}
        averaged.append(one and replace(one, std=stds))
    return averaged


def _at_frame(tones: TrackedTones, start: float, rows: RowTiming, height: int, direction: int) -> _AtFrame:
    """Both axes at a frame that starts ``start`` s behind the time origin of the tones.

    ``direction`` is -1 for tones backwards in time: sin(-2 pi f t + phi) = sin(2 pi f t + pi - phi).
    """
    vibrations, stds_of_fit = vibration_at_frame(tones.fit, rows, height)
    vibration, std = vibrations[0], stds_of_fit[0]
    if direction < 0:
        signs = vibration.phase.new_tensor(_ACROSS)
        vibration = replace(
            vibration,
            phase=math.pi * (1.5 - 0.5 * signs[:, None]) - vibration.phase,
            image_motion=-signs * vibration.image_motion,
            image_acceleration=signs * vibration.image_acceleration,
        )
    vibration = vibration.timed_from(start)
    exposures = table(rows.row_starts(1, height)[0, ::8])
    known = displacement_std_at_frame(tones.fit, tones.growth, rows, height)
    residual = np.nanmean(np.abs(residual_of(tones.measurements, tones.fit)[0]), (0, 1))
    without_drift = Vibration(vibration.amplitude, vibration.frequency, vibration.phase)
    moved = table(without_drift.mean_displacement(tensor(exposures), rows.exposure_time))
    places = tensor((-tones.fit.amplitude[0]).argsort(-1, kind="stable").argsort(-1))  # of the tones of the fit
    values, stds = (
        {name: getattr(of, name).gather(-1, places) for name in of_tones} | {name: getattr(of, name) for name in _DRIFT}
        for of, of_tones in ((vibration, _TONE), (std, (*_TONE, "period")))
    )
    stds["displacement"] = tensor(known)
    return _AtFrame(values, stds, known, residual, tones.findings, moved - moved.mean(0))


def _mean(both: Sequence[_AtFrame], axis: int) -> _AtFrame:
    """The mean of what both trackers know of an axis, with weights by the variances of its displacement.

    What changes is late forwards in time and early backwards: of tones that sweep by 3 Hz/s, frequencies of one tracker
    were wrong by up to 13 standard deviations. The frame itself is known to both, so that their errors do not average
    out: standard deviations are those of equal errors, and of a choice between two values.
    """
    variance, other = (float(one.std["displacement"][axis]) ** 2 for one in both)
    share = other / (variance + other)  # of the first

    def mean(values: Tensor, others: Tensor) -> Tensor:
        return share * values + (1 - share) * others

    def std(name: str, apart: Tensor) -> Tensor:
        return torch.hypot(mean(*(one.std[name] for one in both)), math.sqrt(share * (1 - share)) * apart)

    before, after = (one.values for one in both)
    apart = {name: after[name] - before[name] for name in before}
    apart["phase"] = torch.remainder(apart["phase"] + math.pi, 2 * math.pi) - math.pi
    apart["displacement"] = tensor(both[1].moved - both[0].moved).square().mean(0).sqrt()
    values = {name: mean(before[name], after[name]) for name in before}
    tones = mean(*(torch.polar(one["amplitude"], one["phase"]) for one in (before, after)))
    values |= {"amplitude": tones.abs(), "phase": tones.angle()}
    apart["period"] = apart["frequency"] / values["frequency"].clamp(min=1e-9).square()
    stds = {name: std(name, difference) for name, difference in apart.items()}
    return replace(both[0], values=values, std=stds, residual=0.5 * (both[0].residual + both[1].residual))


def _judged(known: Sequence[_AtFrame], axis: int, other: float | None) -> _Judged:
    """What is known of an axis at a frame from one or both trackers, and the reasons against it."""
    name = AXIS_NAMES[axis]
    if not known:
        return None, (Reason("not_followed", name),)
    trusted = [one for one in known if not one.findings[axis]]
    best = min(trusted or known, key=lambda one: float(one.known_std[axis]))
    if best.findings[axis]:
        return best, best.findings[axis]
    if len(known) > 1:
        first, second = (one.moved[:, axis] for one in known)
        least, share, deviations = _MAX_APART
        std = math.hypot(*(one.known_std[axis] for one in known))
        allowed = max(least, share * float(np.sqrt(np.square(best.moved[:, axis]).mean())), deviations * std)
        apart = float(np.sqrt(np.square(second - first).mean()))
        if not apart < allowed:
            return best, (Reason("directions_differ", name, apart, allowed),)
        if all(one.code in _UNCERTAIN for one in (*known[0].findings[axis], *known[1].findings[axis])):
            best = _mean(known, axis)
    return best, () if other is None else (Reason("other_tone", name, details={"frequency": other}),)


def _with_wider_ends(judged: list[list[_Judged]]) -> list[list[_Judged]]:
    """The first and the last frame, which one tracker knows, with half of the change from their neighbours.

    Pairs of frames are half a frame period apart from them: of 43 first frames of tones that decay by 10 to 30 % in a
    frame, 4 had errors of 5 to 12 standard deviations.
    """
    widened = [list(of_frame) for of_frame in judged]
    for end, beside in ((0, 1), (-1, -2)):
        for axis, (one, against) in enumerate(judged[end]):
            neighbour = judged[beside][axis][0]
            if one is not None and neighbour is not None:
                apart = {name: 0.5 * (one.values[name] - neighbour.values[name]) for name in ("amplitude", "frequency")}
                apart["displacement"] = apart["amplitude"].square().sum(-1).mul(0.5).sqrt()
                stds = {name: torch.hypot(one.std[name], change) for name, change in apart.items()}
                widened[end][axis] = (replace(one, std={**one.std, **stds}), against)
    return widened


def _with_reasons_of_axes(judged: list[list[_Judged]]) -> list[list[_Judged]]:
    """The axes with a reason against all frames if rows contradict the tones in too many of them."""
    refused: list[tuple[Reason, ...]] = []
    for axis, name in enumerate(AXIS_NAMES[:2]):
        contradicted = [any(one.code in _CONTRADICTED for one in of_frame[axis][1]) for of_frame in judged]
        reason = Reason("tones_contradicted", name, sum(contradicted) / len(judged), _MAX_CONTRADICTED)
        refused.append((reason,) if sum(contradicted) > _MAX_CONTRADICTED * len(judged) else ())
    return [
        [(known, against or of_all) for (known, against), of_all in zip(of_frame, refused, strict=True)]
        for of_frame in judged
    ]


def _assembled(judged: Sequence[Sequence[_Judged]], starts: Array, stack: GreyFrames) -> FollowedVibration:
    """The result in image axes, from what is known of each axis at each frame."""
    timing = stack.timing
    found = [[known for known, _ in of_frame] for of_frame in judged]
    findings = [tuple(against for _, against in of_frame) for of_frame in judged]
    known = [(index, axis, one) for index, pair in enumerate(found) for axis, one in enumerate(pair) if one is not None]
    count = max([1, *(one.values["amplitude"].shape[-1] for _, _, one in known)])

    def of_axes(name: str, *, std: bool = False) -> Tensor:
        """(T, 2, K) values of tones, padded with zeros, or (T, 2) others, or their standard deviations."""
        shape = (count,) if name in (*_TONE, "period") else ()
        values = torch.full((len(found), 2, *shape), math.inf if std else 0.0, dtype=torch.float64, device="cpu")
        for index, axis, one in known:
            given = (one.std if std else one.values)[name][axis]
            values[index, axis] = functional.pad(given, (0, count - len(given))) if shape else given
        return values

    amplitude, frequency, phase = (of_axes(name) for name in _TONE)
    order = torch.argsort(-amplitude, dim=-1, stable=True)  # that of the tones of a Vibration
    speed, acceleration = (of_axes(name) for name in _DRIFT)
    origins = tensor(starts)  # of the frames; that of the stack is 0
    vibration = Vibration(amplitude, frequency, phase, speed, acceleration).timed_from(-origins).from_row_order(timing)
    stds = {name: of_axes(name, std=True) for name in _STDS}
    std = VibrationStd(**stds | {name: stds[name].gather(-1, order) for name in (*_TONE, "period")})
    std = replace(std, phase=torch.hypot(std.phase, 2 * math.pi * origins[:, None, None] * std.frequency))
    reliable = torch.tensor([[not of_axis for of_axis in of_frame] for of_frame in findings], device="cpu")
    residual = torch.full((len(found), 2), math.nan, dtype=torch.float64, device="cpu")
    for index, axis, one in known:
        residual[index, axis] = float(one.residual[axis])
    return FollowedVibration(
        vibration=vibration,
        std=std.from_row_order(timing),
        gain=vibration.gain(float(np.diff(starts).min())),
        residual=magnitudes_from_row_order(residual, timing),
        reliable=magnitudes_from_row_order(reliable, timing),
        findings=tuple(findings_from_row_order(of_frame, timing) for of_frame in findings),
        assumptions=((),) * len(found),
        times=tensor(starts + timing.time_to_middle(stack.images.shape[-2])),
    ).to(stack.images.device)
