"""``VibrationTracker``: vibration and restored frames one by one, at the rate of a camera.

Each new frame is warped to the scene by the predicted motion, and the displacements of its rows from the frame before
are measured as in ``detect_vibration`` (``detection.rows``). They correct the prediction (``tone_filter``). The
gradients of the scene are kept while the scene stays within a few pixels. Detection from several frames
(``detection.pipeline``) is only needed to begin, and again if the rows contradict the prediction.

All that the tracker knows is one immutable ``_State``. A frame takes it through these steps, each of which
returns another state: ``_measured`` or, for a late frame, ``_predicted``; then, if the motion is not known or
contradicted, ``_detected``. The result for the user (``tracked_frame``) is made from the last state.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
import torch
from torch import Tensor

from rsvib_torch.checks.arguments import ArrayLike, as_numbers, as_tensor
from rsvib_torch.detection.measurements import Measurements, OtherMotion
from rsvib_torch.detection.pipeline import Attempt, DetectionOptions, Hypothesis, attempt
from rsvib_torch.detection.rows.displacements import (
    FrameGroups,
    differential_motion,
    joined_groups,
    measure_group,
    stack_spectra,
)
from rsvib_torch.detection.start import FieldScale
from rsvib_torch.detection.tones.fit import (
    MIN_GAIN,
    ToneFit,
    motion_of_fit,
    offset_gain,
    tone_displacements,
    vibration_of_fit,
)
from rsvib_torch.detection.tones.selection import MIN_SIGNIFICANCE
from rsvib_torch.detection.tones.uncertainty import with_unknown_amplitudes
from rsvib_torch.detection.verdict import contradicted_axes, judged, scene_reasons, with_remedy
from rsvib_torch.execution.parallel import full_precision, outside_graphs, threads_for, without_gradients
from rsvib_torch.frames.entry_points import module_options
from rsvib_torch.frames.pixels import detailed_parts
from rsvib_torch.frames.prepare import GreyFrames, PreparedFrames, frames_from_row_order, prepare_frames, without_mosaic
from rsvib_torch.motion.timing import MAX_SPAN, SensorTiming, check_timing, contradiction
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.numerics.tables import Array, table, tables, tensor
from rsvib_torch.options import MAX_TONES, DetectionMethod, RegistrationOptions, TrackerOptions
from rsvib_torch.registration.corners import Grey, eight_bits
from rsvib_torch.registration.gradients import RowGradients
from rsvib_torch.registration.register import fits_frame
from rsvib_torch.registration.row_spectra import RowSpectra
from rsvib_torch.restoration.restore import WITH_SATURATION
from rsvib_torch.results.reason import Reason
from rsvib_torch.tracking.live_path import LivePath
from rsvib_torch.tracking.tone_filter import ToneFilter
from rsvib_torch.tracking.tracked_frame import TrackedFrame, TrackedTones, TrackingState, displacement_std_at_frame

_MAX_PREDICTED_STD = 0.5  # px; the gradients of rows reach a few tenths of a pixel, and there are several rounds
_MAX_UNMEASURED_STD = 0.1  # px; paths of hand-held cameras are predicted within 0.25 px, with 1 px within 0.6 px
_MAX_UNEXPLAINED = 1.0  # px, residual displacement of rows; they are not measured correctly over larger distances
# of the rms displacement by the tones, residual beyond which they are not removed. Where a vibration of 2 px stops, the
# first frame at rest had 0.12 to 0.2, and would become worse by 19 dB
_MAX_LEFT = 0.1
_MAX_CHANGE = 0.2  # px, by which a round may change the displacement of a row; otherwise the frame is measured again
_MAX_ROUNDS = 3  # measurements of one frame
_MAX_PATH = 4.0  # px; the scene may move so far before its gradients are computed again
_MAX_AGE = 30  # frames; then gradients are computed again, because the scene may have changed
# Methods and numbers of tones of a detection, in this order. Bands are a sufficient start, because the filter measures
# the rows. The direct method takes up to ten times as long (9 s for eight frames of a flying drone without a tone). Of
# 28 recordings of 128 to 256 rows with one random tone per axis, 510 results of axes are reliable and right with both
# methods, 333 with bands alone, where tones of 2 px and more move them within their height.
_STARTS: tuple[tuple[DetectionMethod, int | None], ...] = (("bands", None), ("direct", 1))
_BANDS = RegistrationOptions()
_DIRECT_ATTEMPTS = 2  # consecutive attempts; after them only bands are tried
_FEW_ROWS = 256  # rows of a frame; smaller frames have few bands, and every attempt uses the direct method as well
_MIN_VALID = 0.1  # of the pixels of each frame, to detect the vibration; as in detect_vibration
_MAX_DOUBLED = 4  # times that the number of frames between two attempts to detect the vibration is doubled
_PATIENCE = 3  # consecutive frames that contradict the tones, before the state is "searching"


@dataclass(frozen=True, eq=False)
class _GreyFrame:
    """A frame as it is measured."""

    images: Tensor  # (1, 1, H, W) grey, in row order; missing pixels hold local means
    valid: Tensor | None  # bool of that shape, False at missing pixels; None if there are none
    time: float  # s, exposure start of its first row

    @classmethod
    def of(cls, prepared: PreparedFrames, time: float) -> Self:
        """The mean of the channels."""
        grey = prepared.filled[:, :, 0] if prepared.images.shape[2] == 1 else prepared.filled.mean(2)
        return cls(grey, None if prepared.missing is None else ~prepared.missing.any(2), time)

    def shows_nothing_new(self, before: "_GreyFrame | None") -> bool:
        """Whether the frame is constant, or a copy of the frame before."""
        darkest, brightest = self.images.aminmax()
        is_constant = bool(brightest - darkest <= 1e-6 * torch.maximum(darkest.abs(), brightest.abs()))
        return is_constant or (before is not None and torch.equal(before.images, self.images))

    def grey(self, timing: SensorTiming) -> Grey:
        """The frame (H, W) in image orientation as 8-bit counts, in which corners are followed."""
        return eight_bits(frames_from_row_order(self.images[0, 0], timing).cpu().numpy())

    def spectra(self, columns: slice) -> RowSpectra:
        """Spectra of the rows in some columns."""
        valid = None if self.valid is None else self.valid[..., columns]
        return stack_spectra(self.images[..., columns], valid)


@dataclass(frozen=True, eq=False)
class _Scene:
    """The scene that rows are compared with."""

    gradients: RowGradients  # of its rows
    differential: Array  # (1, 2) px, their ``differential_motion``
    path: Array  # (2,) px, place on the path where they were computed
    age: int = 0  # number of frames that they have been used for


@dataclass(frozen=True, eq=False)
class _Track:
    """The motion that is followed."""

    filter: ToneFilter  # tones and image motion
    spectra: RowSpectra  # of the last frame that was measured, which the next one is compared with
    start: float  # s, exposure start of that frame
    columns: slice  # that are measured
    scene: _Scene | None = None  # None before a frame has been measured, as are the tones
    tones: TrackedTones | None = None  # at the last frame
    trusted: tuple[Array, ...] = ()  # (2,) bool for each of the last frames: axes whose tones were reliable


@dataclass(frozen=True, eq=False)
class _State:
    """All that the tracker knows after a frame. It is never changed: a step returns another one."""

    live: LivePath  # by corners, from frame to frame, and where the steady image shows the last frame
    time: float = -math.inf  # s, exposure start of the last frame
    frames: tuple[_GreyFrame, ...] = ()  # the last ones that could be used, at most a window
    track: _Track | None = None  # the motion that is followed; None if it is not known
    path: Array = field(default_factory=lambda: np.zeros(2))  # (2,) px, as predicted, to the time of the filter
    untried: int = 0  # frames since the last attempt to detect the vibration
    attempts: int = 0  # to detect the vibration, since the rows last agreed with the tones
    contradictions: int = 0  # consecutive frames, and starts of the filter, whose rows contradict the tones


class VibrationTracker:
    """Vibration and restored frames of a camera, frame by frame, with constant memory and no delay.

    The tones of ``detect_vibration`` are followed by a Kalman filter: amplitude, phase and frequency are predicted for
    every frame and corrected by the displacements of its rows from the frame before. Amplitudes may grow and
    frequencies may sweep; the filter estimates how fast. Times of frames may have gaps. If the rows contradict the
    prediction, the vibration is detected again from the last frames, which takes as long as a few frames.
    Roll and zoom are not followed. A copy of a tracker (``copy.copy``) follows on its own.

    Args:
        timing: The sensor, without ``frame_start_times``.

    Raises:
        ValueError: If a value is out of range, or the timing has frame start times.

    Example:
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import city_and_fields
        >>> timing = rsv.SensorTiming(row_time=40e-6, exposure_rows=20, frame_rows=300)
        >>> vibration = rsv.Vibration(amplitude=[2.1, 1.6], frequency=[110.0, 90.0], phase=[0.5, 1.0])
        >>> frames = rsv.simulate_frames(city_and_fields(320, 240, seed=3), timing, vibration, num_frames=10)
        >>> tracker = rsv.VibrationTracker(timing, window=4)
        >>> for frame in frames:  # of a camera
        ...     tracked = tracker.update(frame)
        >>> tracked.state, tracked.restored.shape == frame.shape
        ('tracking', True)
        >>> tracked.detection.vibration.frequency[:, 0].round(decimals=1).tolist()
        [110.0, 90.0]
    """

    @module_options(TrackerOptions)
    def __init__(self, timing: SensorTiming, options: TrackerOptions) -> None:
        check_timing(timing)
        if timing.frame_start_times is not None:
            raise ValueError("timing must not have frame_start_times: pass the time of each frame to update")
        self.timing, self.options = timing, options
        self._rows = timing.in_row_order()
        self.reset()

    def reset(self) -> None:
        """Forget all frames, e.g. after a change of the camera's settings."""
        self._state = _State(LivePath.started(self.timing))

    @outside_graphs
    @full_precision
    @without_gradients
    def update(self, frame: ArrayLike, time: float | None = None, *, measure: bool = True) -> TrackedFrame:
        """Process the next frame.

        Args:
            frame: (H, W) or (C, H, W) in image orientation, floating point, or integers of known full scale.
            time: s, exposure start of its first row on any clock; None: one frame period after the frame before.
            measure: Whether the rows are measured. False for a frame that is late: its tones are predicted, which takes
                a fifth of the time, unless the prediction is too uncertain.

        Returns:
            The restored frame with the vibration.

        Raises:
            ValueError: If the frame has another shape than the frames before, or its time is not later.
        """
        # 1. Input. Frames that show nothing new do not count, except for the time of the next one.
        time = self._checked_time(time)
        with torch.inference_mode(mode=False), torch.no_grad():  # cameras write into few buffers again and again
            prepared = prepare_frames(
                as_tensor("frame", frame)[None].clone(),
                self.timing,
                full_scale=self.options.full_scale,
                channels=self.options.channels,
                saturation=self.options.saturation if self.options.method in WITH_SATURATION else None,
            )
            latest = _GreyFrame.of(prepared, time)
        before = self._state.frames[-1] if self._state.frames else None
        if before is not None and before.images.shape != latest.images.shape:
            (rows, columns), (rows_before, columns_before) = latest.images.shape[-2:], before.images.shape[-2:]
            raise ValueError(
                f"frame has {rows} rows of {columns} px, the frames before had {rows_before} of {columns_before}; "
                "call reset() before another size"
            )
        state = replace(self._state, time=time)
        if latest.shows_nothing_new(before):
            return self._result(prepared, state, usable=False)
        longest = MAX_SPAN * self._rows.row_time  # s; frames further apart do not resolve frequencies
        recent = tuple(frame for frame in state.frames if time - frame.time <= longest)
        state = replace(state, frames=(*recent, latest)[-self.options.window :], untried=state.untried + 1)

        # 2. Predict the motion of a late frame, measure that of any other; detect the vibration if it is not known, or
        # if the rows contradict it.
        with threads_for(latest.images), np.errstate(all="ignore"):
            predicted = None if measure else self._predicted(state)
            try:
                state = self._detected(self._measured(state)) if predicted is None else predicted
            except (ValueError, torch.linalg.LinAlgError):  # type: ignore[attr-defined]
                state = replace(state, track=None)  # no argument is wrong: they were checked
        return self._result(prepared, state)

    def _checked_time(self, time: float | None) -> float:
        before = self._state.time
        if time is None:
            return 0.0 if math.isinf(before) else before + self.timing.frame_period
        value = float(as_numbers("time", time))
        if value <= before:
            raise ValueError(f"time must be later than that of the frame before, {before:.6g} s, got {value:.6g} s")
        return value

    # Tracking

    def _measured(self, state: _State) -> _State:
        """Compare the last frame with the one before, and correct the motion that is followed."""
        track = state.track
        if track is None:
            return state
        frame, height = state.frames[-1], state.frames[-1].images.shape[-2]

        # 1. Predict the motion in the middle of the two frames.
        centre = 0.5 * (track.start + frame.time) + 0.5 * height * self._rows.row_time
        prediction = track.filter.predicted(centre)
        fit, step = prediction.as_fit(centre), centre - track.filter.time
        is_accurate = prediction.displacement_std() < _MAX_PREDICTED_STD  # not if it is not a number
        if not (is_accurate and self._is_possible(track, frame, fit)):
            return replace(state, track=None)
        path = state.path + track.filter.path(step)

        # 2. The gradients of the scene are used again unless they are old or the scene has moved.
        scene = track.scene
        if scene is not None and (scene.age > _MAX_AGE or np.abs(path - scene.path).max() > _MAX_PATH):
            scene = None

        # 3. Measure the rows around the prediction and correct it; again if the correction is large. Neighbouring pairs
        # share a frame: after many pairs, the variance of a tone is gain^2 / 2 times that of independent offsets.
        spectra = frame.spectra(track.columns)
        starts, device = np.array([track.start, frame.time]) - centre, frame.images.device
        group = FrameGroups(track.spectra.followed_by(spectra), tensor(starts)[None].to(device))
        gain = offset_gain(fit.frequencies, np.diff(starts))[0] * fit.active[0]
        noise_factor = np.maximum(0.5 * np.square(gain.max(-1)), 1.0)
        for _ in range(_MAX_ROUNDS):
            anchor, known = (path, None) if scene is None else (scene.path, scene.gradients)
            motion = replace(motion_of_fit(fit), image_shift=tensor(path - anchor)[None])
            measured, gradients = measure_group(group, self._rows, motion.to(device), known)
            measurements = joined_groups([measured], self._rows.exposure_time)
            corrected = prediction.updated(measurements, centre, noise_factor)
            by_tones, by_drift = corrected.explained(measurements, centre)
            around = motion.mean_displacement(tensor(measurements.exposure_starts), self._rows.exposure_time)
            largest = float(np.abs(by_tones + by_drift - measurements.relative(table(around))).max())
            if not math.isfinite(largest):  # the rows were not measured
                return replace(state, track=None)
            if largest < _MAX_CHANGE:
                break
            fit, path, scene = corrected.as_fit(centre), state.path - corrected.path(-step), None
        # The roll of a hand is uniform in a frame and does not affect tones: of 57 frames with 5 mrad, it refused 35.
        scene = scene or _Scene(gradients, differential_motion([gradients], 1, uniform=False), path)
        scene = replace(scene, age=scene.age + 1)
        state = replace(state, path=state.path - corrected.path(-step))
        return self._followed(
            state, replace(track, filter=corrected, spectra=spectra, scene=scene), scene, measurements
        )

    def _followed(self, state: _State, track: _Track, scene: _Scene, measurements: Measurements) -> _State:
        """The state with a track from the frame before, whose tones are judged by the rows of the last frame."""
        # 1. Rows far from where the motion places them are not measured correctly.
        frame, height = state.frames[-1], state.frames[-1].images.shape[-2]
        corrected, centre = track.filter, track.filter.time
        by_tones, by_drift = corrected.explained(measurements, centre)
        residual = measurements.displacements - by_tones - by_drift
        other = OtherMotion.of(measurements, by_tones, residual, scene.differential)
        at_middle = corrected.predicted(frame.time + self._rows.time_to_middle(height), mixed=False)
        fit, growth = at_middle.as_fit(frame.time), at_middle.growth()
        if not (other.unexplained.max() < _MAX_UNEXPLAINED and self._is_possible(track, frame, fit)):
            return replace(state, track=None)
        # 2. The verdict on the tones.
        aliasing, interval = table(scene.gradients.aliasing), np.array([frame.time - track.start])
        fit = with_unknown_amplitudes(fit, aliasing, other.unexplained, interval, self._rows.exposure_time, known=0)
        measurements = replace(measurements, exposure_starts=measurements.exposure_starts + (centre - frame.time))
        vibration, std = vibration_of_fit(fit)
        known_std = displacement_std_at_frame(fit, growth, self._rows, height)[None]
        (findings,) = judged(
            vibration,
            replace(std, displacement=tensor(known_std)),
            other,
            intervals=measurements.interval,
            displacement=tone_displacements(
                fit, table(self._rows.row_starts(1, height)[0, ::8]), self._rows.exposure_time
            ).std(1),
            known_std=known_std,
            timing=self._rows,
            max_tones=MAX_TONES,
        )
        # the tones are followed already, and some may have ended
        findings = tuple(
            with_remedy(_of_present_tones(of_axis, number), "use frames at shorter intervals")
            for of_axis, number in zip(findings, fit.active[0].sum(-1), strict=True)
        )
        tones = TrackedTones(frame.time, fit, growth, measurements, findings)
        trusted = np.array([not against for against in tones.findings])
        # an axis whose rows are far from its tones is not moved until these are reliable again
        lost = ~trusted & (other.unexplained[0] > _MAX_LEFT * np.sqrt(np.square(by_tones).mean((0, 1, 2))))
        trusted_axes = tuple(one & ~lost for one in (*track.trusted, trusted)[-self.options.window :])
        track = replace(track, start=frame.time, tones=tones, trusted=trusted_axes)
        if any(contradicted_axes(tones.findings)):
            return replace(state, track=track, contradictions=state.contradictions + 1)
        return replace(state, track=track, contradictions=0, attempts=0)

    def _is_possible(self, track: _Track, frame: _GreyFrame, fit: ToneFit) -> bool:
        """Whether tones, and the image motion over both frames, are smaller than a frame; not if they are NaN."""
        size, readout = max(frame.images.shape[-2:]), frame.images.shape[-2] * self._rows.row_time
        seconds = frame.time - track.start + readout
        distance = np.abs(fit.drift) @ np.array([seconds, 0.5 * seconds**2])
        is_small = bool((np.abs(fit.coefficients) < size).all() and (distance < size).all())
        return is_small and bool(np.isfinite(fit.frequencies).all() and np.isfinite(fit.covariance).all())

    def _predicted(self, state: _State) -> _State | None:
        """The state with predicted tones of the last frame; None if the frame must be measured.

        The filter stays where it is: the next frame that is measured is compared with the last one that was.
        """
        track, frame = state.track, state.frames[-1]
        if track is None or track.tones is None or state.contradictions:
            return None
        middle = frame.time + self._rows.time_to_middle(frame.images.shape[-2])
        predicted = track.filter.predicted(middle, mixed=False)
        path_std = track.filter.path_std(middle - track.filter.time)
        if not max(predicted.displacement_std(), path_std) < _MAX_UNMEASURED_STD:
            return None
        before = track.tones.measurements
        measurements = replace(before, exposure_starts=before.exposure_starts - (frame.time - track.tones.time))
        tones = replace(track.tones, time=frame.time, fit=predicted.as_fit(frame.time), measurements=measurements)
        return replace(state, track=replace(track, tones=tones))

    # Detection

    def _frames_to_detect(self, state: _State) -> int:
        """Number of last frames to detect the vibration from; 0 if it is known, or if it is too early to try again.

        After a change of the vibration, only frames behind the change are used: half a window first, then whole windows
        at times that double, up to 32 frames apart (with a window of 8).
        """
        new = state.contradictions
        if state.track is None:
            new = max(new, len(state.frames) if state.attempts == 0 else 0, state.untried)
        needed = max(2, self.options.window // 2) * 2 ** min(state.attempts, _MAX_DOUBLED)
        if new < needed or state.untried < needed // 2 or len(state.frames) < 2:
            return 0
        return min(new, len(state.frames))

    def _detected(self, state: _State) -> _State:
        """Detect the vibration in the last frames if that is due, and follow its tones from the last frame."""
        count = self._frames_to_detect(state)
        if count == 0:
            return state
        state = replace(state, untried=0, attempts=state.attempts + 1)
        frames = state.frames[-count:]
        stacks = self._stacked(frames)
        if stacks is None:
            return state
        times, height = [frame.time for frame in frames], stacks.images.shape[-2]
        middle = 0.5 * (times[0] + times[-1]) + 0.5 * height * self._rows.row_time
        timing = replace(self._rows, frame_start_times=tuple(time - middle for time in times))
        hypothesis = Hypothesis(FieldScale(2, stacks.images.shape[-1], height))
        drift_order = 2 if count > 2 else 1
        only_bands = state.attempts > _DIRECT_ATTEMPTS and height >= _FEW_ROWS
        started = state
        for method, number in _STARTS[:1] if only_bands else _STARTS:
            result = attempt(stacks, timing, DetectionOptions(method, number, drift_order, _BANDS), hypothesis)
            if scene_reasons(result.start.curve, stacks.images.shape[-1])[0] or not result.visible[0]:
                break
            # Tones that the last frame contradicts are not used: without tones, the path is followed at least.
            plausible = _plausible(result)
            for kept in (plausible, torch.zeros_like(plausible)):
                started = self._started(started, result, kept, middle, times[-1] - times[0])
                if started.track is not None:
                    break
            if started.track is not None and started.contradictions == 0:
                return started
        if state.track is None:
            return started
        return replace(state, contradictions=started.contradictions)  # the new start is no better

    def _stacked(self, frames: tuple[_GreyFrame, ...]) -> GreyFrames | None:
        """Frames as one stack for a detection; None if they are too small for bands, or have too few valid pixels."""
        images = torch.cat([frame.images for frame in frames], 1)
        everywhere = torch.ones_like(frames[0].images, dtype=torch.bool)
        valid = torch.cat([everywhere if frame.valid is None else frame.valid for frame in frames], 1)
        height, width = images.shape[-2:]
        columns = self.options.columns
        is_large_enough = fits_frame(height, width if columns is None else min(width, columns), _BANDS)
        if not is_large_enough or bool((valid.float().mean((-2, -1)) < _MIN_VALID).any()):
            return None
        mask = None if bool(valid.all()) else valid
        stacks = GreyFrames(without_mosaic(images), mask, batched=False, timing=self._rows)
        return stacks if self.options.columns is None else stacks.narrowed(self.options.columns)

    def _started(self, state: _State, result: Attempt, chosen: Tensor, middle: float, record: float) -> _State:
        """Start the filter with the ``chosen`` (2, K) tones of a detection from the last frames; measure the last one.

        The ``middle`` of these frames is the time origin of the detection, the ``record`` their duration (s).
        """
        vibration, std, curve = result.vibration[0], result.std_if_hidden_tone[0], result.fitted.offsets[0].to("cpu")
        # 1. Image motion. A record does not distinguish a tone of less than one period from a drift, and its amplitude
        # is not known: it becomes a part of the drift. Without tones, the drift of the fit is wrong as well.
        tones = torch.polar(vibration.amplitude, vibration.phase - 0.5 * math.pi) * chosen
        slow, rate = vibration.frequency * record < 1.0, 2j * math.pi * vibration.frequency
        drift = torch.stack([vibration.image_motion, vibration.image_acceleration], -1)
        if not bool(chosen.any()):
            offset = curve.offsets[-1].nanmedian(0).values
            speed = offset / (curve.later_times - curve.times)[-1].mean()
            drift = torch.stack([speed, torch.zeros_like(speed)], -1)
        drift = drift + torch.stack([(tones * rate).real, (tones * rate.square()).real], -1).mul(slow[..., None]).sum(1)
        if not bool(torch.isfinite(drift).all()):  # no row of the last frame was measured
            return replace(state, track=None)
        # 2. Tones, with twice the standard deviations, because the last frame is measured again. Those of a record
        # allow for further tones, which the filter does not.
        size_std = torch.minimum(std.amplitude, 0.05 * vibration.amplitude)
        parts = tables(tones * ~slow, vibration.frequency, drift, 2.0 * size_std, 2.0 * std.frequency)
        started = ToneFilter.started(middle, self._rows.exposure_time, *parts)
        # 3. The last two frames, which the filter starts between.
        (before, last), number = state.frames[-2:], self.options.columns
        columns = slice(None) if number is None else detailed_parts(last.images[:1], number)[0]
        return self._measured(replace(state, track=_Track(started, before.spectra(columns), before.time, columns)))

    # Results

    def _result(self, prepared: PreparedFrames, state: _State, *, usable: bool = True) -> TrackedFrame:
        """The result for the last frame, moved to where the steady image is; the state is kept."""
        label: TrackingState = "searching" if usable else "unusable"
        device, measurements, lost = prepared.images.device, None, ""
        motion, live = Vibration.still(device=device), state.live
        track = state.track if usable else None
        tones = None if track is None else track.tones
        if track is not None and tones is not None:
            if track.start == state.time:  # the frame was measured
                measurements = tones.measurements
            # The time origin of the tones is the first row, that of the motion the middle of the frame.
            half = self._rows.time_to_middle(prepared.images.shape[-2])
            motion = motion_of_fit(replace(tones.fit, centre=tones.fit.centre - half), device)[0]
            # An axis moves if its tones were reliable in one of the last frames.
            motion = motion.scaled(tensor(np.any(track.trusted, 0)).to(device)).from_row_order(self.timing)
            label = "searching" if state.contradictions >= _PATIENCE else "tracking"
        if label == "searching":
            starts = tensor(np.array([*(frame.time for frame in self._state.frames), state.time]))
            lost = contradiction(self._rows, starts, 0)
        if usable and self.options.steady:  # rows follow the path of the corners along both axes
            live = live.followed(state.frames[-1].grey(self.timing), state.time, motion)
            live = live.steadied(state.time - self._state.time, self.options.steady)
            velocity, acceleration = tensor(live.rates).to(device)
            motion = replace(motion, image_motion=velocity, image_acceleration=acceleration)
        self._state = state = replace(state, live=live)
        place = live.place if usable and live.pairs else np.full(2, math.nan)
        return TrackedFrame(
            time=state.time,
            state=label,
            motion=replace(motion, image_shift=tensor(state.live.shift).to(device)),
            path=tensor(place).to(device),
            detected=usable and state.untried == 0,
            measurements=measurements,
            frame=prepared,
            tones=tones,
            options=self.options,
            lost=lost,
        )


def _plausible(result: Attempt) -> Tensor:
    """(2, K) bool, tones to start with: significant ones, and the strongest of each axis above its standard deviation.

    The verdict on a record may be that the motion changes, which the filter follows. It has its own verdict.
    """
    vibration, std = result.vibration[0], result.std_if_hidden_tone[0].amplitude
    amplitude = vibration.amplitude
    strongest = amplitude == amplitude.amax(-1, keepdim=True)
    plausible = (amplitude > MIN_SIGNIFICANCE * std) | (strongest & (amplitude > std))
    return plausible & (vibration.gain(result.interval).abs() > MIN_GAIN)  # blind tones may have any amplitude


def _of_present_tones(reasons: tuple[Reason, ...], tones: int) -> tuple[Reason, ...]:
    """The reasons against an axis without those against tones that have ended beside others of its ``tones``.

    Where one of two tones stops, no later frame would be reliable.
    """
    ended = [one.code == "tone_too_small" for one in reasons]
    return reasons if sum(ended) == tones else tuple(one for one in reasons if one.code != "tone_too_small")
