"""``VibrationTracker``: vibration and restored frames one by one, at the rate of a camera.

Each new frame is warped to the scene by the predicted motion, and the displacements of its rows from the frame before
are measured as in ``detect_vibration`` (``detection.rows``). They correct the prediction (``tone_filter``). The
gradients of the scene are kept while the scene stays within a few pixels. ``detect_vibration`` itself is only called to
begin, and again if the rows contradict the prediction.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import torch
from torch import Tensor

from rsvib_torch.core.arguments import as_numbers, checks_arguments
from rsvib_torch.core.arrays import ArrayLike, Channels, as_tensor
from rsvib_torch.core.checks import check_number, check_whole_number
from rsvib_torch.core.option_types import DetectionMethod
from rsvib_torch.core.precision import full_precision, outside_graphs, outside_inference, without_gradients
from rsvib_torch.detection import DetectionResult, detect_vibration
from rsvib_torch.detection.assemble import offset_curve
from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.reliability import contradicted_axes, judge
from rsvib_torch.detection.result import OtherMotion
from rsvib_torch.detection.rows.displacements import (
    FrameGroup,
    differential_motion,
    measure_group,
    stack_spectra,
)
from rsvib_torch.detection.sensitivity import assumptions, timing_sensitivity
from rsvib_torch.detection.tones.fit import (
    MIN_GAIN,
    ToneFit,
    displacement_std,
    motion_of_fit,
    offset_gain,
    residual_of,
    vibration_of_fit,
)
from rsvib_torch.detection.tones.selection import MAX_TONES, MIN_SIGNIFICANCE
from rsvib_torch.frames.orientation import frames_from_row_order, offsets_from_row_order
from rsvib_torch.frames.pixels import detailed_columns
from rsvib_torch.frames.prepare import PreparedFrames, prepare_frames
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.registration.gradients import RowGradients
from rsvib_torch.registration.row_spectra import RowSpectra
from rsvib_torch.restoration.frame_motion import visible_pixels
from rsvib_torch.restoration.restore import METHODS, check_method_options, restore_prepared, unchanged_frames
from rsvib_torch.tracking.tone_filter import ToneFilter

__all__ = ["TrackedFrame", "TrackingState", "VibrationTracker", "displaced"]

TrackingState = Literal["searching", "tracking", "unusable"]

_MAX_PREDICTED_STD = 0.5  # px; the gradients of rows reach a few tenths of a pixel, and there are several rounds
_MAX_UNMEASURED_STD = 0.1  # px; paths of hand-held cameras are predicted within 0.25 px, with 1 px within 0.6 px
_MAX_UNEXPLAINED = 1.0  # px, residual displacement of rows; they are not measured correctly over larger distances
_MAX_CHANGE = 0.2  # px, by which a round may change the displacement of a row; otherwise the frame is measured again
_MAX_ROUNDS = 3
_MAX_PATH = 4.0  # px; the scene may move so far before its gradients are computed again
_MAX_AGE = 30  # frames; then gradients are computed again, because the scene may have changed
_DRIFT_STD = (10.0, 500.0)  # px/s and px/s^2, at the start; tones and drift are correlated, their sum is more accurate
_STARTS: tuple[tuple[DetectionMethod, Literal["auto"] | int], ...] = (("bands", "auto"), ("direct", 1))
_MIN_CORRELATION = 0.3  # of the typical band with the next frame; bands of independent noise reach 0.1
_MAX_DOUBLED = 4  # times that the number of frames between two attempts to detect the vibration is doubled
# The direct method takes up to ten times as long as bands (9 s for eight frames of a flying drone without a tone)
_DIRECT_ATTEMPTS, _FEW_ROWS = 2, 256  # consecutive attempts, after which only bands are tried unless there are few
_PATIENCE = 3  # consecutive frames that contradict the tones, before the vibration is detected again


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """Result of ``VibrationTracker.update``.

    Attributes:
        time: s, exposure start of its first row.
        latency: Number of frames that were given after this one.
        state: ``"tracking"``: the motion is known; ``"searching"``: it is not, or the rows contradict it;
            ``"unusable"``: the frame is constant, or a copy of the frame before.
        motion: The motion to remove, in image axes; its time origin is the middle of the frame. Axes whose vibration is
            not reliable are still.
        path: (2,) px, axes (x, y): image motion without vibration from the first tracked frame to the middle of this
            one; NaN if it is not known.
        detected: Whether ``detect_vibration`` was called for this frame.
        measurements: Displacements of the rows of this frame and of the frame before, in row order; times count
            from the first row of this frame. None if they were not measured.
    """

    time: float
    latency: int
    state: TrackingState
    motion: Vibration
    path: Tensor
    detected: bool
    measurements: Measurements | None
    _restore: Callable[[Vibration], Tensor] = field(repr=False)
    _result: Callable[[], DetectionResult | None] = field(repr=False)
    _visible: Callable[[Vibration], Tensor] = field(repr=False)

    @cached_property
    def restored(self) -> Tensor:
        """The frame without the motion, in its shape; as taken if no motion is known. Computed at the first use.

        Another thread may use it while the next frame is tracked.
        """
        return outside_inference(self._restore(self.motion))

    @cached_property
    def detection(self) -> DetectionResult | None:
        """The vibration at this frame, with its time origin at the first row of this frame; None if none is known."""
        return outside_inference(self._result())

    @cached_property
    def visible(self) -> Tensor:
        """(H, W) bool, pixels of the restored frame that the sensor recorded; the others are extrapolated."""
        return outside_inference(self._visible(self.motion))

    def moved_to(self, place: Tensor) -> "TrackedFrame":
        """The same frame with its content at another place (2,) of the path in px, to stabilise a video.

        Content stays at ``path`` if the frame is not moved.
        """
        return replace(self, motion=displaced(self.motion, self.path - place))


@dataclass(frozen=True, eq=False)
class _Reference:
    """The frame before.

    Attributes:
        spectra: Its spectra.
        start: s, exposure start of its first row.
        gradients: Gradients of the scene; None if they are not known.
        apart: Their ``differential_motion``.
        path: Path at which they were computed.
        age: Number of frames since then.
    """

    spectra: RowSpectra
    start: float
    gradients: RowGradients | None = None
    apart: Tensor | None = None
    path: Tensor | None = None
    age: int = 0


@dataclass(frozen=True, eq=False)
class _Verdict:
    """State of the tones according to the last pair of frames, in row order.

    Attributes:
        time: s, exposure start of the frame that the tones belong to.
        fit: The tones; the time origin is ``time``.
        measurements: Displacements of the rows of the pair, with the same time origin.
        other_motion: Motion that the tones do not explain.
        reliable: (2,) bool.
        reasons: Against each axis.
        contradicted: Axes whose rows the tones do not explain.
    """

    time: float
    fit: ToneFit
    measurements: Measurements
    other_motion: OtherMotion
    reliable: Tensor
    reasons: tuple[tuple[str, ...], ...]
    contradicted: tuple[bool, bool]


class VibrationTracker:
    """Vibration and restored frames of a camera, frame by frame, with constant memory and no delay.

    The tones of ``detect_vibration`` are followed by a Kalman filter: amplitude, phase and frequency are predicted for
    every frame and corrected by the displacements of its rows from the frame before. Amplitudes may grow and
    frequencies may sweep; the filter estimates how fast. Times of frames may have gaps. If the rows contradict the
    prediction, the vibration is detected again from the last frames, which takes as long as a few frames.
    Roll and zoom are not followed.

    Args:
        timing: The sensor, without ``frame_start_times``.
        window: Number of frames from which the vibration is detected at the start, and again if tracking fails.
        columns: As in ``detect_vibration``: the columns with the most detail that are measured; None for all.
        method: Method of ``restore``; ``"dewarp"`` is the fastest.
        steady: s; the image is moved to the straight line that fits its path during this time, so that slow shaking is
            removed as well. 0: frames stay where they are.
        wobble: Whether skew and wobble by slow motion are removed along axes without a reliable vibration as well, as
            with ``steady``. Frames that move as a whole (stabilised in the camera) would be skewed by it.
        full_scale: As in ``restore``.
        channels: ``"last"`` for frames (H, W, C).
        **options: Options of the method.

    Raises:
        TypeError: If the method does not have an option.
        ValueError: If a value is out of range, or the timing has frame start times.

    Example:
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.evaluation import city_and_fields
        >>> timing = rsv.SensorTiming(row_time=40e-6, exposure_rows=20, frame_rows=300)
        >>> vibration = rsv.Vibration(amplitude=[2.1, 1.6], frequency=[110.0, 90.0], phase=[0.5, 1.0])
        >>> frames = rsv.simulate_frames(city_and_fields(320, 240, seed=3), timing, vibration, num_frames=10)
        >>> tracker = rsv.VibrationTracker(timing, window=4)
        >>> for frame in frames:  # of a camera
        ...     tracked = tracker.update(frame)
        >>> tracked.state, tracked.latency, tracked.restored.shape == frame.shape
        ('tracking', 0, True)
        >>> tracked.detection.vibration.frequency[:, 0].round(decimals=1).tolist()
        [110.0, 90.0]
    """

    @checks_arguments
    def __init__(
        self,
        timing: SensorTiming,
        *,
        window: int = 8,
        columns: int | None = 384,
        method: str = "dewarp",
        steady: float = 0.0,
        wobble: bool = False,
        full_scale: float | None = None,
        channels: Channels = None,
        **options: Any,
    ) -> None:
        if timing.frame_start_times is not None:
            raise ValueError(
                "timing must not have frame_start_times: pass the time of each frame to update(frame, time)"
            )
        check_method_options(method, options)
        self.timing, self.method, self.options = timing, method, options
        self.window = check_whole_number("window", window, at_least=2)
        self.columns = columns if columns is None else check_whole_number("columns", columns, at_least=64)
        self.steady = check_number("steady", steady, at_least=0.0)
        self.wobble = wobble or steady > 0
        self.full_scale, self.channels = full_scale, channels
        self._rows = timing.in_row_order()
        self.reset()

    def reset(self) -> None:
        """Forget all frames, e.g. after a change of the camera's settings."""
        self._filter: ToneFilter | None = None
        self._reference: _Reference | None = None
        self._verdict: _Verdict | None = None
        self._path = torch.zeros(2, dtype=torch.float64)
        self._paths: deque[tuple[float, Tensor]] = deque()
        self._last: deque[tuple[Tensor, Tensor | None, float]] = deque(maxlen=self.window)
        self._untried, self._attempts, self._contradictions, self._time = 0, 0, 0, -math.inf
        self._trusted: deque[Tensor] = deque(maxlen=self.window)
        self._columns = slice(None)

    @outside_graphs
    @full_precision
    @without_gradients
    @checks_arguments
    def update(self, frame: ArrayLike, time: float | None = None, *, measure: bool = True) -> TrackedFrame:
        """Process the next frame.

        Args:
            frame: (H, W) or (C, H, W) in image orientation, floating point, or integers of known full scale.
            time: s, exposure start of its first row on any clock; None: one frame period after the frame before.
            measure: Whether the rows are measured. False for a frame that is late: its motion is predicted, which takes
                a fifth of the time, unless the prediction is too uncertain.

        Returns:
            The restored frame with the vibration.

        Raises:
            TypeError: If the frame is not numbers.
            ValueError: If the frame has another shape than the frames before, or its time is not later.
        """
        time = self._checked_time(time)
        prepared = prepare_frames(
            as_tensor("frame", frame)[None],
            self.timing,
            full_scale=self.full_scale,
            channels=self.channels,
            saturation="auto" if "clipped" in METHODS[self.method].masks else None,
        )
        grey = prepared.filled[:, :, 0] if prepared.images.shape[2] == 1 else prepared.filled.mean(2)
        valid = None if prepared.missing is None else ~prepared.missing.any(2)
        if self._last and self._last[-1][0].shape != grey.shape:
            raise ValueError(
                f"frame has {grey.shape[-2]} rows of {grey.shape[-1]} px, the frames before had "
                f"{self._last[-1][0].shape[-2]} of {self._last[-1][0].shape[-1]}; call reset() before another size"
            )
        self._time = time
        if self._is_unusable(grey):
            return self._unchanged(prepared, time, "unusable")
        self._last.append((grey, valid, time))
        self._untried += 1
        if not measure and self._predict(time):
            return self._result(prepared, time, measured=False)
        self._follow(grey, valid, time)
        count = self._frames_to_detect()
        if count:
            self._detect(count)
        return self._result(prepared, time, detected=count > 0)

    # Input

    def _checked_time(self, time: float | None) -> float:
        if time is None:
            return 0.0 if math.isinf(self._time) else self._time + self.timing.frame_period
        value = float(as_numbers("time", time))
        if value <= self._time:
            raise ValueError(f"time must be later than that of the frame before, {self._time:.6g} s, got {value:.6g} s")
        return value

    def _is_unusable(self, grey: Tensor) -> bool:
        """Whether a frame is constant, or a copy of the frame before; some rows are enough to find that it is not."""
        some = grey[..., ::16, :]
        if bool(some.amax() - some.amin() <= 1e-6 * some.abs().amax()):
            return bool((grey.amax() - grey.amin()) <= 1e-6 * grey.abs().amax())
        before = self._last[-1][0] if self._last else None
        return before is not None and torch.equal(before[..., ::16, :], some) and torch.equal(before, grey)

    # Tracking

    def _follow(self, grey: Tensor, valid: Tensor | None, time: float) -> None:
        """Predict the state, measure the new frame against the one before, correct the state."""
        if self._filter is None or self._reference is None:
            return
        height, before = grey.shape[-2], self._reference
        centre = 0.5 * (before.start + time) + 0.5 * height * self._rows.row_time
        state = self._filter.predicted(centre)
        fit = state.as_fit(centre)
        starts = torch.tensor([before.start, time], dtype=torch.float64, device=grey.device) - centre
        if not state.displacement_std() < _MAX_PREDICTED_STD:
            self._filter = self._verdict = None
            return
        step, previous = centre - self._filter.time, self._path
        path = previous + self._filter.path(step)
        spectra = self._spectra(grey, valid)
        group = FrameGroup(before.spectra.followed_by(spectra), starts[None])
        gradients, age, anchor = before.gradients, before.age + 1, path if before.path is None else before.path
        if age > _MAX_AGE or float((path - anchor).abs().amax()) > _MAX_PATH:
            gradients, age, anchor = None, 0, path
        gain = offset_gain(fit.frequencies, (starts[1] - starts[0])[None])[0] * fit.active[0]
        # neighbouring pairs share a frame: after many pairs, the variance of a tone is gain^2 / 2 times that of
        # independent offsets
        noise_factor = (0.5 * gain.amax(-1).square()).clamp(min=1.0)
        for _ in range(_MAX_ROUNDS):
            motion = displaced(motion_of_fit(fit), (path - anchor)[None])
            measurements, found = measure_group(group, self._rows, motion, gradients)
            corrected = state.updated(measurements, centre, noise_factor)
            tones, drift = corrected.explained(measurements, centre)
            change = tones + drift
            change -= measurements.relative(
                motion.mean_displacement(measurements.exposure_starts, self._rows.exposure_time)
            )
            if float(change.abs().amax()) < _MAX_CHANGE:
                break
            fit, path, gradients = corrected.as_fit(centre), previous - corrected.path(-step), None
            age, anchor = 0, path
        self._path, self._filter = previous - corrected.path(-step), corrected
        apart = before.apart if found is before.gradients and before.apart is not None else differential_motion([found])
        self._reference = _Reference(spectra, time, found, apart, anchor, age)
        self._verdict = self._judged(
            time,
            corrected.predicted(time + self._half(height), mixed=False).as_fit(time),
            replace(measurements, exposure_starts=measurements.exposure_starts + (centre - time)),
            tones,
            measurements.displacements - tones - drift,
            apart,
        )
        if not float(self._verdict.other_motion.unexplained.amax()) < _MAX_UNEXPLAINED:
            self._filter = self._verdict = None  # rows further away are not measured correctly
            return
        contradicted = any(self._verdict.contradicted)
        self._contradictions = self._contradictions + 1 if contradicted else 0
        if not contradicted:
            self._attempts = 0
        self._trusted.append(self._verdict.reliable)

    def _half(self, height: int) -> float:
        """Time in s from the exposure start of a frame to its middle."""
        return 0.5 * ((height - 1) * self._rows.row_time + self._rows.exposure_time)

    def _predict(self, time: float) -> bool:
        """Predict the tones of a frame that starts at ``time`` in s; False if the frame must be measured.

        The state is not changed: the next frame that is measured is compared with the last one that was.
        """
        if self._filter is None or self._reference is None or self._verdict is None or self._contradictions:
            return False
        before, middle = self._verdict.measurements, time + self._half(self._last[-1][0].shape[-2])
        predicted = self._filter.predicted(middle, mixed=False)
        path_std = self._filter.path_std(middle - self._filter.time)
        if not max(predicted.displacement_std(), path_std) < _MAX_UNMEASURED_STD:
            return False
        later = time - self._verdict.time
        measurements = replace(before, exposure_starts=before.exposure_starts - later)
        self._verdict = replace(self._verdict, fit=predicted.as_fit(time), measurements=measurements, time=time)
        return True

    def _spectra(self, grey: Tensor, valid: Tensor | None) -> RowSpectra:
        mask = None if valid is None else valid[..., self._columns]
        return stack_spectra(grey[..., self._columns], mask)

    def _row_starts(self, height: int, device: torch.device, step: int = 8) -> Tensor:
        """(N,) s, exposure starts of every eighth row from that of the first."""
        return torch.arange(0, height, step, dtype=torch.float64, device=device) * self._rows.row_time

    def _judged(
        self, time: float, fit: ToneFit, measurements: Measurements, tones: Tensor, residual: Tensor, apart: Tensor
    ) -> _Verdict:
        """Verdict by the rows of one pair, from their displacements (1, N, 2, 2) by the tones and their residuals.

        ``apart`` is the ``differential_motion``.
        """
        visible = measurements.num_differences > 0
        measured = (visible & (measurements.weights > 0).any(-1)).double().sum(1) / visible.double().sum(1).clamp(min=1)
        other = OtherMotion(
            size=math.sqrt(2) * measurements.distances(tones).square().nanmean(1).sqrt(),
            unexplained=measurements.unexplained(residual),
            correlated=measurements.correlated(residual),
            differential=apart,
            measured=measured,
            blur=measured.new_tensor([[1.0, 0.0, 0.0]]),
        )[0]
        vibration, std = vibration_of_fit(fit)
        starts = self._row_starts(self._last[-1][0].shape[-2], measured.device)
        own_std = displacement_std(fit, starts, self._rows.exposure_time)
        moved = vibration.mean_displacement(starts[None], self._rows.exposure_time) - vibration.drift(starts[None])
        offsets = measurements.displacements[0, :, 1] - measurements.displacements[0, :, 0]
        reliable, reasons = judge(
            vibration[0],
            replace(std, displacement=own_std)[0],
            offsets=offsets,
            fitted=offsets,
            visible=visible[0],
            intervals=self._intervals(measurements),
            displacement=moved[0].std(0, correction=0),
            own_std=own_std[0],
            timing=self._rows,
            other_motion=other,
            max_tones=MAX_TONES,
        )
        contradicted = contradicted_axes(vibration[0], other, MAX_TONES)
        return _Verdict(time, fit, measurements, other, reliable, reasons, contradicted)

    @staticmethod
    def _intervals(measurements: Measurements) -> Tensor:
        starts = measurements.exposure_starts
        return (starts[..., 1] - starts[..., 0]).mean(1)

    # Detection

    def _frames_to_detect(self) -> int:
        """Number of last frames to detect the vibration from; 0 if it is known, or if it is too early to try again.

        After a change of the vibration, only frames behind the change are used: half a window first, then whole windows
        at times that double, up to 32 frames apart (with a window of 8).
        """
        new = len(self._last) if self._filter is None and self._attempts == 0 else self._contradictions
        if self._filter is None:
            new = max(new, self._untried)
        needed = max(2, self.window // 2) * 2 ** min(self._attempts, _MAX_DOUBLED)
        if new < needed or self._untried < needed // 2:
            return 0
        return min(new, self.window, len(self._last))

    def _detect(self, count: int) -> None:
        """Detect the vibration in the last ``count`` frames, and start the filter with its tones."""
        frames, masks, times = zip(*list(self._last)[-count:], strict=True)
        self._untried, self._attempts = 0, self._attempts + 1
        middle = 0.5 * (times[0] + times[-1]) + 0.5 * frames[0].shape[-2] * self._rows.row_time
        timing = replace(self._rows, frame_start_times=tuple(time - middle for time in times))
        ignore = None
        if any(mask is not None for mask in masks):
            ignore = torch.cat([~one if one is not None else torch.zeros_like(masks[-1]) for one in masks], 1)[0]
        names = ("_filter", "_reference", "_verdict", "_path", "_columns", "_trusted")
        before, stack = {name: getattr(self, name) for name in names}, torch.cat(frames, 1)[0]
        # too few bands are registered, or the fit diverges: the next frames may be better
        with suppress(ValueError, OverflowError, torch.linalg.LinAlgError):  # type: ignore[attr-defined]
            # the filter measures the rows, so that bands are a sufficient start; small frames have too few of them
            only_bands = self._attempts > _DIRECT_ATTEMPTS and stack.shape[-2] >= _FEW_ROWS
            for method, tones in _STARTS[:1] if only_bands else _STARTS:
                found = detect_vibration(
                    stack,
                    timing,
                    method=method,
                    tones=tones,
                    image_acceleration=len(times) > 2,
                    window=len(times),
                    columns=self.columns,
                    ignore=ignore,
                    roll=False,
                    zoom=False,
                )[0]
                if method == "bands" and float(found.offsets.quality.median()) < _MIN_CORRELATION:
                    break  # the frames do not show the same scene
                plausible = _plausible(found)
                for chosen in (plausible, plausible & False):  # without tones, the path is followed at least
                    self._start(found, chosen, middle, times[-1] - times[0])
                    if self._filter is not None:
                        break
                if self._filter is not None and self._contradictions == 0:
                    return
        if before["_filter"] is not None:  # no better
            vars(self).update(before)

    def _start(self, found: DetectionResult, chosen: Tensor, middle: float, record: float) -> None:
        """Start the filter with chosen tones (2, K) of a record of ``record`` s about ``middle`` s, follow its end."""
        vibration, std = found.vibration, found.std
        # a record does not distinguish a tone of less than one period from a drift, and its amplitude is not known
        slow = vibration.frequency * record < 1.0
        tones = torch.polar(vibration.amplitude, vibration.phase - 0.5 * math.pi) * chosen
        rate = 2j * math.pi * vibration.frequency
        drift = torch.stack([vibration.image_motion, vibration.image_acceleration], -1)
        if not bool(chosen.any()):  # the drift of a fit with wrong tones is wrong as well
            apart = found.offsets.offsets[-1].nanmedian(0).values
            starts = (found.offsets.later_times - found.offsets.times)[-1]
            drift = torch.stack([apart / starts.mean(), torch.zeros_like(apart)], -1)
        drift = drift + torch.stack([(tones * rate).real, (tones * rate.square()).real], -1).mul(slow[..., None]).sum(1)
        tones = tones * ~slow
        growth_std = torch.full_like(std.amplitude, 0.5)  # 1/s
        # the standard deviations of a record allow for other tones
        size_std = torch.minimum(std.amplitude, 0.05 * vibration.amplitude)
        parts = torch.stack([size_std, size_std, growth_std, 2 * math.pi * std.frequency], -1)
        # the last frame is measured again
        tone_std = torch.where((tones.abs() > 0)[..., None], 2.0 * parts, 0.0).flatten(-2)
        self._filter = ToneFilter.started(
            middle,
            tones,
            vibration.frequency,
            drift,
            torch.cat([tone_std, tone_std.new_tensor(_DRIFT_STD).expand(2, -1)], -1),
            self._rows.exposure_time,
        )
        (grey, valid, time), last = self._last[-2], self._last[-1]
        self._columns = slice(None) if self.columns is None else detailed_columns(last[0][0, 0], self.columns)
        self._reference, self._path = _Reference(self._spectra(grey, valid), time), self._path.to(grey.device)
        self._trusted = deque(maxlen=self.window)
        self._follow(*last)

    # Results

    def _result(
        self, prepared: PreparedFrames, time: float, *, detected: bool = False, measured: bool = True
    ) -> TrackedFrame:
        if self._filter is None or self._verdict is None:  # nothing is known
            return self._unchanged(prepared, time, "searching", detected)
        height = prepared.images.shape[-2]
        half = self._half(height)
        fit = self._verdict.fit  # its time origin is the first row; that of the motion is the middle of the frame
        motion = motion_of_fit(replace(fit, centre=fit.centre - half))
        trusted = torch.stack(list(self._trusted)).any(0)
        followed = ~trusted.new_tensor(self._verdict.contradicted) if self.wobble else trusted
        motion = Vibration(
            motion.amplitude * trusted[..., None],
            motion.frequency,
            motion.phase,
            motion.image_motion * followed,
            motion.image_acceleration * followed,
        ).from_row_order(self.timing)[0]
        timing = replace(self.timing, frame_start_times=(-half,))
        framed = replace(prepared, timing=timing.in_row_order(), image_timing=timing)
        method, options = self.method, self.options
        shape = tuple(prepared.images.shape[-2:])
        size = (shape[0], shape[1]) if self.timing.scan_axis == -2 else (shape[1], shape[0])
        state: TrackingState = "searching" if self._contradictions >= _PATIENCE else "tracking"
        verdict = self._verdict
        path = self._path + self._filter.path(time + half - self._filter.time)
        tracked = TrackedFrame(
            time,
            0,
            state,
            motion,
            offsets_from_row_order(path, self.timing),
            detected,
            verdict.measurements if measured else None,
            lambda motion: framed.from_row_order(_restored(framed, motion, method, options))[0],
            lambda: self._detection(verdict, height),
            lambda motion: visible_pixels(timing, motion, size, 1)[0][0],
        )
        return tracked.moved_to(self._steady_place(tracked)) if self.steady else tracked

    def _steady_place(self, tracked: TrackedFrame) -> Tensor:
        """(2,) px, place at this frame of the straight line that fits the last part of the path."""
        self._paths.append((tracked.time, tracked.path))
        while self._paths[0][0] < tracked.time - self.steady:
            self._paths.popleft()
        if len(self._paths) < 3:
            return tracked.path
        times = torch.tensor([time for time, _ in self._paths], dtype=torch.float64, device=tracked.path.device)
        columns = torch.stack([torch.ones_like(times), times - tracked.time], -1)
        place: Tensor = torch.linalg.lstsq(columns, torch.stack([path for _, path in self._paths])).solution[0]
        return place

    def _unchanged(
        self, prepared: PreparedFrames, time: float, state: TrackingState, detected: bool = False
    ) -> TrackedFrame:
        def visible(motion: Vibration) -> Tensor:
            mask = torch.ones_like(prepared.images[0, 0, :1], dtype=torch.bool)
            return frames_from_row_order(mask, self.timing)[0]

        device = prepared.images.device
        return TrackedFrame(
            time,
            0,
            state,
            Vibration.still(device=device),
            torch.full((2,), math.nan, dtype=torch.float64, device=device),
            detected,
            None,
            lambda motion: unchanged_frames(prepared, joint=False)[0],
            lambda: None,
            visible,
        )

    def _detection(self, verdict: _Verdict, height: int) -> DetectionResult:
        """The state as the result of a detection in image axes."""
        fit, measurements = verdict.fit, verdict.measurements
        robust = measurements.reweighted(residual_of(measurements, fit))
        weights = robust.weights / measurements.weights.clamp(min=1e-300)
        curve, fitted = offset_curve(robust, fit, weights, [2])
        vibration, std = vibration_of_fit(fit)
        own_std = displacement_std(fit, self._row_starts(height, weights.device), self._rows.exposure_time)
        std = replace(std, displacement=own_std)
        intervals = self._intervals(measurements)
        swap = self.timing.scan_axis == -1
        order = [1, 0] if swap else [0, 1]
        sensitivity = timing_sensitivity(fit, self._rows, self.window, height).mapped(
            lambda values: values[..., order, :]
        )
        in_image = vibration.from_row_order(self.timing)
        residual = (curve.offsets - fitted).abs().nanmean(dim=(1, 2))
        result = DetectionResult(
            vibration=in_image,
            std=std.from_row_order(self.timing),
            offsets=replace(
                curve,
                offsets=offsets_from_row_order(curve.offsets, self.timing),
                std=None if curve.std is None else curve.std[..., order],
            ),
            fitted=offsets_from_row_order(fitted, self.timing),
            gain=in_image.gain(float(intervals[0])),
            residual=residual[..., order],
            reliable=verdict.reliable[None, order],
            reasons=(tuple(verdict.reasons[axis] for axis in order),),
            sensitivity=sensitivity,
            assumptions=(assumptions(in_image[0], sensitivity[0], self._rows, self.window, height),),
            timing=self.timing,
        )
        return result[0]


def _plausible(found: DetectionResult) -> Tensor:
    """(2, K) bool, tones to start with: significant ones, and the strongest of each axis above its standard deviation.

    The verdict on a record may be that the motion changes, which the filter follows. It has its own verdict.
    """
    amplitude, std = found.vibration.amplitude, found.std.amplitude
    strongest = amplitude == amplitude.amax(-1, keepdim=True)
    plausible = (amplitude > MIN_SIGNIFICANCE * std) | (strongest & (amplitude > std))
    return plausible & (found.gain.abs() > MIN_GAIN)  # blind tones may have any amplitude


@torch.no_grad()
def _restored(frames: PreparedFrames, motion: Vibration, method: str, options: dict[str, Any]) -> Tensor:
    return restore_prepared(frames, motion, method, options)


def displaced(motion: Vibration, displacement: Tensor) -> Vibration:
    """The motion with a constant displacement (..., 2) in px added, as a tone of frequency 0."""
    size = displacement.abs()[..., None]
    zero = torch.zeros_like(size)
    return Vibration(
        torch.cat([motion.amplitude, size], -1),
        torch.cat([motion.frequency, zero], -1),
        torch.cat([motion.phase, torch.copysign(zero + 0.5 * math.pi, displacement[..., None])], -1),
        motion.image_motion,
        motion.image_acceleration,
    )
