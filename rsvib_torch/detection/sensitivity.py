"""Sensitivity of a detected vibration to the stated timing, and the assumptions that the frames cannot contradict.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones.fit import ToneFit, free_jacobian, model_displacements
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import RowTiming, SensorTiming, other_intervals
from rsvib_torch.motion.vibration import Vibration, VibrationStd
from rsvib_torch.numerics.tables import Array, pseudo_inverse, split_axis, table, tables, tensor
from rsvib_torch.results.presentation import AXIS_NAMES, Result

_TONE_VALUES = ("amplitude", "frequency")  # quantities whose change by a wrong timing is stated
_SENSITIVITY_SHAPES = {
    f"{value}_by_{time}": "... A K"
    for time in ("row_time", "frame_rows", "exposure_rows")
    for value in (*_TONE_VALUES, "phase")
}


@dataclass(frozen=True, eq=False, repr=False)
class TimingSensitivity(Result, shapes=_SENSITIVITY_SHAPES):
    """Relative change of amplitudes and frequencies, and change of phases, over the relative change of a stated time.

    ``d ln A / d ln frame_rows = 3`` means that an amplitude becomes 3 % larger if ``frame_rows`` is stated 1 % larger
    and the frames are the same. All values have the shape (..., 2, K), axes (x, y), 0 where there is no tone. A change
    of ``row_time`` changes exposure time and frame period alike; with ``frame_start_times``, ``frame_rows`` has no
    effect.
    """

    amplitude_by_row_time: Tensor  # d ln A / d ln row_time
    amplitude_by_frame_rows: Tensor  # d ln A / d ln frame_rows
    amplitude_by_exposure_rows: Tensor  # d ln A / d ln exposure_rows
    frequency_by_row_time: Tensor  # d ln f / d ln row_time
    frequency_by_frame_rows: Tensor  # d ln f / d ln frame_rows
    frequency_by_exposure_rows: Tensor  # d ln f / d ln exposure_rows
    phase_by_row_time: Tensor  # d phi / d ln row_time in rad, at the time origin
    phase_by_frame_rows: Tensor  # d phi / d ln frame_rows
    phase_by_exposure_rows: Tensor  # d phi / d ln exposure_rows


_STEP = 1e-4  # relative change of the timing, for differences


def timing_sensitivity(fit: ToneFit, timing: RowTiming, num_frames: int, num_rows: int) -> TimingSensitivity:
    """Sensitivities (B, 2, K) of the tones of a fit to the timing, in row order, in the order of ``vibration_of_fit``.

    A timing that is wrong by dT changes the displacements at the measured times by ``dD``. The least-squares fit then
    changes its parameters by ``-X^+ dD`` to first order, X the Jacobian of the displacements of about 128 rows of all
    frames.
    """
    batch, axes, tones = fit.coefficients.shape

    # 1. A record of all rows of all frames, and the fit at its middle.
    def record(record_timing: RowTiming) -> Measurements:
        rows = record_timing.row_time * np.arange(0, num_rows, max(1, num_rows // 128))
        times = np.repeat((rows[:, None] + table(record_timing.frame_starts(num_frames)))[None], batch, 0)  # (B, N, T)
        information = np.broadcast_to(np.eye(axes), (*times.shape[:2], axes, axes))
        zeros = np.zeros((*times.shape, axes))
        return Measurements(times, zeros, np.ones_like(times), information, record_timing.exposure_time)

    measurements = record(timing)
    fit = fit.about(measurements.centre)

    # 2. The pseudo-inverse of the derivatives of the displacements of each axis by its parameters.
    jacobian = free_jacobian(measurements, fit)
    columns = np.moveaxis(jacobian, 3, 1).reshape(batch, axes, -1, jacobian.shape[-1])
    inverses = pseudo_inverse(columns)  # (B, A, P, D)

    # 3. The change of the tones by a change of each time, the tones in the order of a ``Vibration``.
    values = {}
    largest_first = (-fit.amplitude).argsort(-1, stable=True)
    size = np.where(fit.amplitude > 1e-9, fit.amplitude, 1.0)  # px or rad; a tone that has decayed does not count
    for name in ("row_time", "frame_rows", "exposure_rows"):
        timings = [replace(timing, **{name: getattr(timing, name) * (1 + sign * _STEP)}) for sign in (-1, 1)]
        lower, higher = (model_displacements(record(changed_timing), fit) for changed_timing in timings)
        change = (higher - lower) / (2 * _STEP)
        parameter_changes = -inverses @ np.moveaxis(change, -1, 1).reshape(batch, axes, -1, 1)
        by_tones = split_axis(parameter_changes[:, :, : 3 * tones, 0], -1, tones, 3)
        along = fit.coefficients.conj() * (by_tones[..., 0] + 1j * by_tones[..., 1])
        amplitude = np.where(fit.active, along.real / np.square(size), 0.0)
        frequency = np.where(fit.active, by_tones[..., 2] / np.maximum(fit.frequencies, 1e-300), 0.0)
        # the phase at the time origin instead of the middle of the record
        phase_change = np.where(fit.active, along.imag / np.square(size), 0.0)
        phase = phase_change - 2 * math.pi * fit.frequencies * frequency * fit.centre[:, None, None]
        for quantity, change in (("amplitude", amplitude), ("frequency", frequency), ("phase", phase)):
            values[f"{quantity}_by_{name}"] = torch.from_numpy(np.take_along_axis(change, largest_first, -1))
    return TimingSensitivity(**values)


def with_row_time_std(
    std: VibrationStd, vibration: Vibration, sensitivity: TimingSensitivity, timing: SensorTiming | RowTiming
) -> VibrationStd:
    """Standard deviations of tones, with the effect of that of the row time at known exposure and frame period in s."""
    if not timing.row_time_std:
        return std
    by_row_time, by_frame_rows, by_exposure_rows = (
        torch.stack([getattr(sensitivity, f"{quantity}_by_{time}") for quantity in ("amplitude", "frequency", "phase")])
        for time in ("row_time", "frame_rows", "exposure_rows")
    )
    relative = timing.row_time_std / timing.row_time
    amplitude, frequency, phase = (by_row_time - by_frame_rows - by_exposure_rows) * relative
    return replace(
        std,
        amplitude=torch.hypot(std.amplitude, vibration.amplitude * amplitude),
        frequency=torch.hypot(std.frequency, vibration.frequency * frequency),
        period=torch.hypot(std.period, frequency / vibration.frequency.clamp(min=1e-300)),
        phase=torch.hypot(std.phase, phase),
    )


def displacements_by_row_time(measured: Measurements, motion: Motion, timing: RowTiming, num_frames: int) -> Array:
    """Change (1, N, G, A) in px of the displacements by a motion (no batch) for a row time wrong by its deviation."""
    times, starts = measured.exposure_starts, table(timing.frame_starts(num_frames))
    frames = np.searchsorted(starts, times + 0.5 * timing.row_time, "right") - 1
    later = times + (timing.row_time_std / timing.row_time) * (times - starts[np.maximum(frames, 0)])
    before, after = (motion.mean_displacement(tensor(values), measured.exposure_time) for values in (times, later))
    return measured.relative(table(after - before))


def assumptions(
    vibration: Vibration,
    sensitivity: TimingSensitivity,
    timing: RowTiming,
    num_frames: int,
    num_rows: int,
    blur: Array | None = None,
    contradicted: Sequence[bool] = (),
) -> tuple[tuple[str, ...], ...]:
    """Assumptions that frames cannot contradict, with their effect on vibrations (B) in image axes, for each stack.

    ``blur`` as in ``OtherMotion``. ``contradicted``: whether the rows contradict one axis of a stack, of which a wrong
    timing may be the cause. With the wrong readout direction, 2 of 28 axes beside such an axis were reliable and wrong.
    """
    # 1. Sentences about all stacks.
    sentences, times = [], ["exposure_rows"]
    if timing.frame_start_times is None:
        # two frames show frequencies relative to the row time, more frames relative to the frame rate
        uncertain = f" ± {timing.row_time_std:.2g}" if timing.row_time_std else ""
        row, rate = f"row_time={timing.row_time:g}{uncertain} s", f"{timing.frame_rate:.4g}"
        sentences.append(
            f"{row}; frequencies scale inversely with it, or differ by multiples of {rate} Hz"
            if num_frames == 2
            else f"{rate} frames/s; frequencies scale with it; a wrong {row} adds multiples of it"
        )
    intervals = other_intervals(timing, timing.frame_starts(num_frames), num_rows)
    if intervals is not None:
        interval_texts = " to ".join(dict.fromkeys(f"{interval:.4g}" for interval in intervals))
        sentences.append(
            f"frame_start_times {interval_texts} s apart, although the frame period is "
            f"{timing.frame_period:.4g} s (frame_rows x row_time); wrong times give wrong frequencies"
        )
    if timing.frame_start_times is None and timing.frame_rows == num_rows:
        sentences.append(
            f"frame_rows={num_rows} is the number of rows of the frames: there are no blanking rows, which is rare; "
            "otherwise frame_rows, and a row_time of 1 / (frame rate x rows), are wrong"
        )
    if num_frames == 2:
        settings = "frame_rows" if timing.frame_start_times is None else "row_time, frame_start_times"
        sentences.append(
            f"{settings}, readout direction, scan axis and order of the frames: two frames cannot contradict them, "
            "more frames can"
        )
        times.insert(0, settings.partition(",")[0])
    # 2. Effects on the tones of each stack.
    amplitudes, frequencies = tables(vibration.amplitude, vibration.frequency)
    changes = {name: tables(*(getattr(sensitivity, f"{value}_by_{name}") for value in _TONE_VALUES)) for name in times}
    sentences_of_stacks = []
    for stack, frequency in enumerate(frequencies):
        tones = [(axis, tone, float(frequency[axis, tone])) for axis, tone in np.argwhere(amplitudes[stack] > 0)]
        tone_changes = [(name, [change[stack] for change in changes[name]]) for name in times]
        effects = [text for name, change in tone_changes for text in _effects(name, tones, change, timing)]
        if blur is not None:
            effects += _exposure_range(tones, timing, *blur[stack, :2].tolist())
        effects += _tones_of_lamps(tones, amplitudes[stack], 0.1 / (num_frames * timing.frame_period))
        if any(contradicted[stack : stack + 1]):
            effects.append(
                "readout direction, frame_rows and row_time: the tones of the other axis are not known, as with a "
                "wrong timing; the motion along it may also be none of tones"
            )
        sentences_of_stacks.append((*sentences, *effects) if tones else ())
    return tuple(sentences_of_stacks)


_Tones = list[tuple[int, int, float]]  # axis, number and frequency in Hz of each tone


def _tones_of_lamps(tones: _Tones, amplitudes: Array, tolerance: float) -> list[str]:
    """Sentence about tones that lamps on mains of 50 or 60 Hz cause beside a tone of another frequency in Hz.

    Their light of the frequency F weights the times within an exposure. The rows show the motion at the weighted middle
    of the exposure, and a tone of the frequency f therefore also has the frequencies F + f and F - f. Of 11 reliable
    axes under such lamps, 5 had these tones, with 0.2 to 4 % of the amplitude.
    """
    pairs = [(weak, strong) for weak in tones for strong in tones if weak[0] == strong[0]]
    texts = [
        f"{AXIS_NAMES[axis]} {weak:.4g} Hz ({lamp:g} {'+' if weak > lamp else '-'} {strong:.4g} Hz)"
        for (axis, tone, weak), (_, strong_tone, strong) in pairs
        for lamp in (100.0, 120.0)
        if amplitudes[axis, tone] < 0.1 * amplitudes[axis, strong_tone] and abs(abs(weak - lamp) - strong) < tolerance
    ]
    return [f"steady light; a lamp that flickers also causes tones: {', '.join(texts)}"] if texts else []


def _effects(name: str, tones: _Tones, changes: list[Array], timing: RowTiming) -> list[str]:
    """Sentence about the effect of an error of 1 % of a stated time on every tone; none if all are below 0.1 %."""
    tone_texts = []
    for axis, tone, frequency in tones:
        tone_changes = zip(_TONE_VALUES, (change[axis, tone] for change in changes), strict=True)
        texts = [f"{quantity} {change:+.2g} %" for quantity, change in tone_changes if abs(change) > 0.1]
        if texts:
            tone_texts.append(f"{AXIS_NAMES[axis]} {frequency:.4g} Hz: {', '.join(texts)}")
    setting = f"{name}={getattr(timing, name):g}"
    return [f"{setting}: if it is stated 1 % too large, this changes {'; '.join(tone_texts)}"] if tone_texts else []


def _exposure_range(tones: _Tones, timing: RowTiming, ratio: float, std: float) -> list[str]:
    """Sentence about the exposures that the blur of the frames agrees with, within two standard deviations.

    The rows determine ``A sinc(f T_e)`` (Eq. 2). There is no sentence if no amplitude changes by more than 1 %.
    """
    exposure = timing.exposure_time
    low, high = (min(exposure * math.sqrt(max(ratio + 2 * n * std, 0.0)), timing.frame_period) for n in (-1, 1))
    tone_texts = []
    for axis, _, frequency in (tone for tone in tones if tone[0] < 2):
        # an exposure of a period averages the tone out; a fit without meaning may have a frequency of 0
        longest = min(high, 0.9 / frequency) if frequency else high
        changes = [100 * (np.sinc(frequency * exposure) / np.sinc(frequency * time) - 1) for time in (low, longest)]
        if low < longest and frequency * exposure < 0.9 and max(map(abs, changes)) > 1.0:
            more = " and more" if longest < high else ""
            name = f"{AXIS_NAMES[axis]} {frequency:.4g} Hz"
            # the phase is measured in the middle of the exposure, and stated for its start
            turns = [math.pi * frequency * (exposure - time) for time in (low, longest)]
            amplitude, phase = ("{:+.2g} to {:+.2g}".format(*values) for values in (changes, turns))
            tone_texts.append(f"{name}: amplitude {amplitude} %, phase {phase} rad{more}")
    rows = f"{low / timing.row_time:.3g} to {high / timing.row_time:.3g}"
    effects = "; ".join(tone_texts)
    return [f"exposure_rows={timing.exposure_rows:g}: the blur agrees with {rows}: {effects}"] if tone_texts else []
