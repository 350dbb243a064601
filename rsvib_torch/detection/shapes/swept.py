"""Swept tones: one tone of each axis whose amplitude decays or grows and whose frequency changes linearly."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import OptimizeResult, least_squares
from torch import Tensor

from rsvib_torch.checks.arguments import check_shapes
from rsvib_torch.checks.arrays import FramesOrFiles
from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.rows.grouped_frames import grouped_frames
from rsvib_torch.detection.sensitivity import displacements_by_row_time
from rsvib_torch.detection.shapes.free import (
    MAX_BAND_ERROR,
    band_errors,
    bands_reasons,
    record_of,
    residual_of_motion,
    rms_motion,
    start_of_stack,
    unexplained_reasons,
)
from rsvib_torch.detection.tones.fit import MIN_GAIN, offset_gain
from rsvib_torch.detection.tones.periodogram import explained_power
from rsvib_torch.detection.tones.selection import F_THRESHOLD
from rsvib_torch.detection.verdict import MAX_DISPLACEMENT_STD
from rsvib_torch.execution.parallel import threads_for
from rsvib_torch.execution.precision import full_precision, without_gradients
from rsvib_torch.execution.progress import whole_steps
from rsvib_torch.frames.entry_points import frames_options
from rsvib_torch.frames.grey import GreyFrames, grey_frames
from rsvib_torch.frames.orientation import findings_from_row_order, magnitudes_from_row_order, offsets_from_row_order
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.numerics.splines import gauss_legendre
from rsvib_torch.numerics.tables import Array, scaled_inverse, split_axis, table, tensor, unit_wave
from rsvib_torch.options import SweptToneOptions
from rsvib_torch.results.presentation import AXIS_NAMES, JudgedResult, axis_rows, verdict_lines, verdict_table
from rsvib_torch.results.reason import Findings, Reason
from rsvib_torch.text import measured_text, text_table

# Of 24 simulated tones in two frames, 10 were found more than 6 standard deviations from the truth (a steady tone of
# 90 Hz as 83.6 ± 1.1 Hz with a decay of 68 ± 6 /s); of 12 in three frames and 48 in four frames, none.
_MIN_FRAMES = 3
_MAX_STD = 5.0  # standard deviations: fits nearer to the best one in chi-square are not excluded
_E_FOLDS = (-4.0, 0.0, 4.0, 10.0, 20.0)  # decays within the record that are tried
_STARTS = 7.5  # starts over the squared number of periods of the highest frequency: sweeps, summed over frequencies
_MAX_STARTS = 100_000  # the search takes 0.5 s for frames of 266 rows; a part of the record has fewer
# probability; of 96 axes of frames of noise, 54 were reliable without this limit and 0 of 60 with it
_MAX_CHANCE = 0.01
_LARGEST = 1e3  # px, of a fit to any motion that is searched for; a fit to frames of noise grew to 36,000 px
_MOST_STEPS = 25  # evaluations of a fit from one start
# factors of the parameters [a, b, f, g, c, v]: of the same tone with the opposite frequency, and of no tone
_MIRRORED, _STILL = np.array([1.0, -1.0, -1.0, 1.0, -1.0, 1.0]), np.array([0.0, 0.0, 1.0, 1.0, 1.0, 1.0])
_TONE = ("amplitude", "frequency", "decay", "chirp", "phase")
_STD_SHAPES = dict.fromkeys(("amplitude", *(f"std[{name!r}]" for name in _TONE)), "... 2")


@dataclass(frozen=True, eq=False, repr=False)
class SweptTone(
    JudgedResult,
    units={
        "amplitude": "px",
        "frequency": "Hz",
        "decay": "1/s",
        "chirp": "Hz/s",
        "phase": "rad",
        "image_motion": "px/s",
        "unexplained": "px",
    },
    shapes=dict.fromkeys((*_TONE, "image_motion", "unexplained", "reliable"), "... 2")
    | {"std": "...", "findings": "..."},
):
    """One tone an axis that decays and sweeps: ``A exp(-g t) sin(2 pi (f t + c t^2 / 2) + phi) + v t``.

    All values are those at the time origin, in image axes (x, y); an axis without a significant tone has amplitude 0.
    A batch of stacks leads all tensors.

    Attributes:
        amplitude: (..., 2) px A.
        frequency: (..., 2) Hz f.
        decay: (..., 2) 1/s g; negative where the tone grows.
        chirp: (..., 2) Hz/s c.
        phase: (..., 2) rad phi.
        image_motion: (..., 2) px/s v.
        std: Standard deviations of amplitude, frequency, decay, chirp and phase by name, (..., 2) each.
        motion: The motion, as ``restore`` and ``simulate_frames`` take it.
        unexplained: (..., 2) px, rms displacement of rows that it does not explain, beyond their noise.
        reliable: (..., 2) bool.
        findings: Each ``Reason`` why not, for each axis; a tuple of those for a batch. ``reasons`` has their texts.

    Example:
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import example_frames
        >>> frames, timing, _ = example_frames(num_frames=4)  # of a steady tone
        >>> bool((rsv.detect_swept_tone(frames, timing).decay.abs() < 1).all())  # 1/s
        True
    """

    amplitude: Tensor
    frequency: Tensor
    decay: Tensor
    chirp: Tensor
    phase: Tensor
    image_motion: Tensor
    std: dict[str, Tensor]
    motion: FreeMotion
    unexplained: Tensor
    reliable: Tensor
    findings: Findings

    def __post_init__(self) -> None:
        super().__post_init__()
        if set(self.std) != set(_TONE):
            raise ValueError(f"std must have the keys {', '.join(_TONE)}, got {', '.join(map(str, self.std))}")
        check_shapes({"amplitude": self.amplitude, **{f"std[{name!r}]": self.std[name] for name in _TONE}}, _STD_SHAPES)

    def summary(self) -> str:
        """The tone of each axis with standard deviations, and the verdict; of a batch, amplitudes and frequencies."""

        def text(name: str, at: tuple[int, ...]) -> str:
            return measured_text(getattr(self, name)[at], self.std[name][at])

        if not self.batch_shape:
            table = [[f"{name} ({self.units[name]})", text(name, (0,)), text(name, (1,))] for name in self.std]
            return "\n".join([text_table(("axis", "x", "y"), table), *verdict_lines(self.reliable, self.reasons)])
        rows = [[*labels, text("amplitude", at), text("frequency", at)] for at, labels in axis_rows(self.batch_shape)]
        head = ("amplitude (px)", "frequency (Hz)")
        return "\n".join(verdict_table(head, rows, self.batch_shape, self.reliable, self.reasons))


@frames_options(SweptToneOptions)
@full_precision
@without_gradients
def detect_swept_tone(frames: FramesOrFiles, timing: SensorTiming, options: SweptToneOptions) -> SweptTone:
    """Detect one tone an axis whose amplitude decays or grows exponentially and whose frequency changes linearly.

    Start values come from the offsets of row bands, over a grid of frequencies, sweeps and decays; in long stacks from
    the part of the record that moves most, from which the tone is followed into the rest. The fit is then repeated with
    displacements measured on the images around it, row by row.

    Args:
        frames: Stack (T, H, W), (T, C, H, W) or (B, T, C, H, W) of at least two frames; tensor, array, list of
            these, or files. NaN marks missing pixels.
        timing: The sensor.
        options: Options.

    Returns:
        Parameters of both axes at the time origin, with standard deviations and verdict.

    Raises:
        ValueError: If they cannot be registered, see ``detect_motion``, an option is out of range, or three frames
            cover more time than the grid of starts is searched in: 0.47 s for bands of 32 rows of 20 us.

    Note:
        A result of two frames is never reliable: decay, sweep and frequency replace each other there.

    Example:
        >>> import torch
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import city_and_fields
        >>> timing = rsv.SensorTiming(row_time=40e-6, exposure_rows=20, frame_rows=300)
        >>> times = torch.arange(0.0, 0.06, 2e-4, dtype=torch.float64)
        >>> decaying = 3.0 * torch.exp(-20 * times) * torch.sin(2 * torch.pi * 105 * times)  # px, 20/s
        >>> motion = rsv.FreeMotion.through(times, torch.stack([decaying, 0.5 * decaying], -1))
        >>> frames = rsv.simulate_frames(city_and_fields(280, 220, seed=3), timing, motion, num_frames=4)
        >>> found = rsv.detect_swept_tone(frames, timing)
        >>> [round(value, 0) for value in (found.frequency[0].item(), found.decay[0].item())]
        [105.0, 20.0]
    """
    stacks = grey_frames(frames, timing, options)
    timing = stacks.timing
    number = len(stacks.images)
    # the start of each axis, and rounds of measuring and fitting
    with threads_for(stacks.images), whole_steps(number * (3 + options.iterations), "steps") as step_done:
        fitted = [_detect(stacks.one(index), timing, options, step_done) for index in range(number)]
    step = min(_step(one.fits, one.record, timing) for one in fitted)  # motions of a batch have common knots
    tones = [_report(one, timing, step).to(stacks.images.device) for one in fitted]
    return SweptTone.stacked(tones) if stacks.batched else tones[0]


@dataclass(frozen=True, eq=False)
class _Fitted:
    """Fit of one stack, in row order."""

    # (2, 6) parameters [a, b, f, g, c, v] of each axis about the middle of the record: ``exp(-g s) (a cos(theta) + b
    # sin(theta)) + v s``, ``theta = 2 pi (f s + c s^2 / 2)``, s = t - middle
    fits: Array
    covariances: Array  # (2, 6, 6)
    record: tuple[float, float]  # its start and end in seconds
    moved: Array  # (2,) px, rms motion of the rows
    unexplained: Array  # (2,) px, rms displacement of rows beside it
    uncertain: Array  # (2,) px, rms standard deviation of the motion of the rows
    against: list[list[Reason]]  # reasons against each axis from the offsets of row bands
    others: list[Array | None]  # another fit (6,) of each axis that agrees with the rows as well, if there is one
    intervals: Array  # s, between the frames


def _detect(
    stack: GreyFrames, timing: SensorTiming, options: SweptToneOptions, step_done: Callable[[], None]
) -> _Fitted:
    """Fit of one stack."""
    # 1. Start from the row bands.
    rowwise, start = start_of_stack(stack, timing, options)
    record, banded = record_of(stack, rowwise), start.measurements
    highest = 0.5 / (options.band_rows * rowwise.row_time)
    (num_frames, _, width), pairs, device = stack.images.shape[1:], start.curve.quality.shape[1], stack.images.device
    starts = []
    for axis in range(2):
        starts.append(_start(banded, axis, pairs, record, highest))
        step_done()
    fits = np.stack([of_axis[0] for of_axis in starts])

    # 2. Rounds of measuring and fitting.
    def motion_of(values: Array) -> FreeMotion:
        return _motion(values, record, _step(values, record, rowwise))

    frames = grouped_frames(stack.images, stack.valid, rowwise, motion_of(fits).expanded(1).to(device))
    for _ in range(options.iterations):
        motion = motion_of(fits)
        measured = frames.measure(motion.expanded(1).to(device), keep_images=False).measurements
        weighed = measured.reweighted(residual_of_motion(measured, motion))
        starts = [_with_aliases(of_axis, (record[1] - record[0]) / num_frames) for of_axis in starts]
        starts = [_settle(weighed, axis, record, starts[axis])[0][:4] for axis in range(2)]
        fits = np.stack([of_axis[0] for of_axis in starts])
        step_done()

    # 3. The last fit, its uncertainty, and what else the rows agree with.
    solved = [_settle(weighed, axis, record, starts[axis]) for axis in range(2)]
    fits, covariances, gains = (np.stack([one[i][0] for one in solved]) for i in range(3))
    fits = np.where(gains[:, None] > F_THRESHOLD, fits, fits * _STILL)
    motion = motion_of(fits)
    residual = residual_of_motion(measured, motion)
    independent = float((weighed.independent_fraction(residual) * measured.share_counted(residual))[0])
    covariances = covariances / independent
    others = [_equally_good(*one, independent) for one in solved]
    times = (measured.exposure_starts + 0.5 * measured.exposure_time - 0.5 * (record[0] + record[1]))[..., None]
    columns = np.stack([measured.relative(_columns(times, fit, np.ones(1)))[0] for fit in fits])  # (2, N, G, 6)
    if rowwise.row_time_std:
        by_row_time = displacements_by_row_time(measured, motion, rowwise, num_frames)
        changed = replace(weighed, displacements=weighed.displacements + by_row_time)
        for axis, fit in enumerate(fits):
            change = _settle(changed, axis, record, fit[None])[0][0] - fit
            covariances[axis] += np.outer(change, change)
    variances = np.maximum(((columns @ covariances[:, None]) * columns).sum(-1), 0.0)

    # 4. Reasons from the row bands.
    against = bands_reasons(start, width, motion)
    chance = _chance(banded, motion, pairs, _STARTS * ((record[1] - record[0]) * highest) ** 2)
    for axis, error in enumerate(band_errors(banded, motion)):
        if error > MAX_BAND_ERROR and chance[axis] > _MAX_CHANCE:
            against[axis].append(Reason("tone_of_chance", AXIS_NAMES[axis], chance[axis], _MAX_CHANCE))
    step_done()
    return _Fitted(
        fits,
        covariances,
        record,
        moved=rms_motion(measured, motion),
        unexplained=measured.unexplained(residual)[0],
        uncertain=np.sqrt(variances.mean((1, 2))),
        against=against,
        others=others,
        intervals=np.diff(table(rowwise.frame_starts(num_frames))),
    )


def _chance(banded: Measurements, motion: FreeMotion, pairs: int, candidates: float) -> list[float]:
    """Probability for each axis that the best candidate explains as much of the offsets of row bands by chance.

    Without a scene, the offsets of a frame pair scatter about a common value, because bands are searched for near it.
    The deviations from it count. A tone leaves a fraction r of the power of n deviations of noise or less with the
    probability ``r^((n - 2) / 2)``.
    """
    rest = residual_of_motion(banded, motion)
    weight = split_axis(banded.reweighted(rest).weights[0], 0, pairs, -1)  # (P, N, 2)

    def power(displacements: Array) -> Array:
        """(2,) weighted sum of the squared deviations from the mean of each pair."""
        offsets = split_axis(np.diff(displacements[0], axis=1)[:, 0], 0, pairs, -1)
        mean = (weight * offsets).sum(1, keepdims=True) / np.maximum(weight.sum(1, keepdims=True), 1e-300)
        return (weight * np.square(offsets - mean)).sum((0, 1))

    left = power(rest) / np.maximum(power(banded.displacements), 1e-300)
    freedom = np.maximum((weight > 0).sum(1) * float(banded.independent) - 1, 0).sum(0)
    return np.minimum(candidates * left ** (0.5 * np.maximum(freedom - 2, 0)), 1.0).tolist()


def _equally_good(fits: Array, covariances: Array, _: Array, excess: Array, independent: float) -> Array | None:
    """A fit of ``_settle`` that the rows do not exclude, outside the stated error of the first one; None if none is."""
    std = np.sqrt(np.maximum(covariances[0].diagonal()[2:5] / independent, 1e-300))
    distance = np.abs(fits - fits[0])[:, 2:5] / std
    other = (distance.max(-1) > 2 * _MAX_STD) & (excess * independent < _MAX_STD**2)
    return fits[other][0] if other.any() else None


def _waves(times: Array, fit: Array) -> Array:
    """``exp(-g s) (cos(theta) + i sin(theta))`` of parameters (6,) at times s from the middle."""
    return np.exp(-fit[3] * times) * unit_wave(2 * math.pi * times * (fit[2] + 0.5 * fit[4] * times))


def _value(times: Array, fit: Array) -> Array:
    """Displacement in px at times from the middle."""
    value: Array = (complex(fit[0], -fit[1]) * _waves(times, fit)).real + fit[5] * times
    return value


def _columns(times: Array, fit: Array, shares: Array) -> Array:
    """Derivatives (..., 6) by the parameters (6,) of the mean displacement over times (..., Q) with shares (Q,)."""
    waves = _waves(times, fit)
    by_rate = complex(fit[0], -fit[1]) * times * waves
    mean, by_rate, by_chirp = waves @ shares, by_rate @ shares, (times * by_rate) @ shares
    parts = [mean.real, mean.imag, -2 * math.pi * by_rate.imag, -by_rate.real, -math.pi * by_chirp.imag, times @ shares]
    return np.stack(parts, -1)


def _start(banded: Measurements, axis: int, pairs: int, record: tuple[float, float], highest: float) -> Array:
    """Fits (S, 6), best first, to the offsets of the row bands of a number of frame pairs.

    Decay, sweep and frequency replace each other within a short record, so that fits from one start end in a minimum of
    another tone. The best starts of a grid are therefore fitted, in a part of the record that bounds their number.
    """
    # 1. The part of the record in which the offsets are largest: a tone may have decayed in the others.
    bands, period = banded.visible.shape[1] // pairs, (record[1] - record[0]) / (pairs + 1)
    longest = math.sqrt(_MAX_STARTS / _STARTS) / highest / period  # frame periods
    count = min(pairs, max(_MIN_FRAMES - 1, math.floor(longest) - 1))
    offsets, weight = np.diff(banded.displacements[0, ..., axis])[:, 0], banded.weights[0, :, axis]
    power = weight * np.square(offsets - np.average(offsets, weights=weight + 1e-300))
    power = np.convolve(power.reshape(pairs, bands).sum(1), np.ones(count), "valid")
    first, end = int(power.argmax()), int(power.argmax()) + count
    # 2. Its best starts, and their fits to a part that becomes twice as long until it is the record.
    fits = _best_starts(banded.of_rows(slice(first * bands, end * bands)), axis, record, highest)
    while True:
        fits = _settle(banded.of_rows(slice(first * bands, end * bands)), axis, record, fits)[0]
        if end - first == pairs:
            return fits
        more = (end - first + 1) // 2
        first, end, fits = max(0, first - more), min(pairs, end + more), fits[:4]


def _best_starts(banded: Measurements, axis: int, record: tuple[float, float], highest: float) -> Array:
    """Start parameters (S, 6) from a grid of frequencies, sweeps and decays: the four best of each decay.

    An offset is ``p(t') E(t') - p(t) E(t)`` with ``E = exp(2 pi i f t)`` and p of decay and sweep. All sums over the
    offsets are products of a matrix of p and one of E.
    """
    times = banded.exposure_starts[0] + 0.5 * banded.exposure_time  # (N, 2)
    middle, span = 0.5 * (times.max() + times.min()), np.ptp(times)
    times = times - middle
    if _STARTS * (span * highest) ** 2 > 10 * _MAX_STARTS:
        longest = math.sqrt(10 * _MAX_STARTS / _STARTS) / highest
        raise ValueError(
            f"frames cover {span:.3g} s; starts of the swept model up to {highest:.4g} Hz are searched in "
            f"at most {longest:.3g} s: pass larger band_rows for lower frequencies, or frames at shorter intervals"
        )
    # 1. The grid, with sweeps that change the frequency by up to 75 % from the middle to the ends.
    frequencies = 0.5 / span * np.arange(1, max(2, math.ceil(2 * span * highest)))
    most = max(1, round(0.375 * len(frequencies)))
    steps = np.arange(-most, most + 1)
    lowest = np.maximum(np.ceil((np.abs(steps) - 0.5) / 0.375).astype(int) - 1, 0)  # the first frequency of a sweep
    lowest[most - 1 : most + 2] = 0
    decays = np.array(_E_FOLDS) / span
    # 2. Weights, values and the image motion.
    weight, value = 0.5 * banded.inverse_variances[0, :, axis], np.diff(banded.displacements[0, ..., axis])[:, 0]
    drift = np.diff(times)[:, 0]
    drift_drift, drift_value = (weight * drift) @ drift + 1e-300, (weight * drift) @ value
    earlier, later = unit_wave(2 * math.pi * times.T[..., None] * frequencies)  # (N, F)
    squares = earlier**2, later**2, earlier * later, later * earlier.conj()
    gains = np.full((len(decays), len(steps), len(frequencies)), -np.inf)
    for place, step in enumerate(steps):
        # 3. Sums over the bands for all decays: products of the wave with values, image motion and itself.
        sweep = 2j * math.pi * step / span**2 * np.square(times)
        envelope = np.exp(-decays[:, None, None] * times + sweep)  # (D, N, 2)
        of_earlier, of_later, *of_squares = (wave[:, lowest[place] :] for wave in (earlier, later, *squares))
        p, q = envelope[..., 0], envelope[..., 1]
        linear = weight * np.stack([value, drift])[:, None]  # (2, 1, N)
        with_value, with_drift = (linear * q) @ of_later - (linear * p) @ of_earlier
        square = (weight * p**2) @ of_squares[0] + (weight * q**2) @ of_squares[1]
        square -= (2 * weight * p * q) @ of_squares[2]
        modulus = np.square(np.abs(envelope)).sum(-1) @ weight
        modulus = modulus[:, None] - 2 * ((weight * q * p.conj()) @ of_squares[3]).real
        gains[:, place, lowest[place] :] = explained_power(
            square, modulus * (1 + 1e-9), with_value, with_drift, drift_value, drift_drift
        )
    # 4. The four best frequencies of each decay, each with its best sweep.
    starts = []
    for decay, sweep_of, power_of in zip(decays, gains.argmax(1), gains.max(1), strict=True):
        chosen: list[int] = []
        for k in power_of.argsort()[::-1].tolist():
            if len(chosen) < 4 and all(abs(k - other) > 1 for other in chosen):
                chosen.append(k)
        chirp = 2 * steps[sweep_of[chosen]] / span**2
        about = 0.5 * (record[0] + record[1]) - middle
        columns = np.zeros((len(chosen), 6))
        columns[:, 2], columns[:, 3], columns[:, 4] = frequencies[chosen] + chirp * about, decay, chirp
        starts.append(columns)
    return np.concatenate(starts)


def _settle(
    measured: Measurements, axis: int, record: tuple[float, float], starts: Array
) -> tuple[Array, Array, Array, Array]:
    """Levenberg-Marquardt from each of several starts (S, 6), for one axis of one stack.

    Best fit first: parameters (S, 6), covariances (S, 6, 6), decrease of chi-square per parameter (S,) by the tone, and
    chi-square less that of the best fit (S,).
    """
    # 1. Displacements are means over the exposure and the rows of a band, relative to the other frames.
    duration = measured.exposure_time + measured.average_times[axis]
    first = measured.exposure_starts[0] + 0.5 * (measured.exposure_time - duration) - 0.5 * (record[0] + record[1])
    nodes, shares = (table(values) for values in gauss_legendre(4))
    times = first[..., None] + duration * nodes
    root = np.sqrt(measured.inverse_variances[0, :, axis])

    def whitened(values: Array) -> Array:
        """Relative displacements (N, G, ...) in standard deviations, (N G, ...)."""
        relative = measured.relative(values[None])[0]
        return (root.reshape(-1, *(1,) * (values.ndim - 1)) * relative).reshape(-1, *values.shape[2:])

    # 2. The fits, best first; the opposite frequency, sweep and sine part are the same tone. To noise, a tone may be
    # fitted that grows to any size, beside which its start is kept.
    data = whitened(measured.displacements[0, ..., axis])

    def solved(start: Array, most_steps: int) -> OptimizeResult:
        return least_squares(
            lambda fit: whitened(_value(times, fit) @ shares) - data,
            start,
            lambda fit: whitened(_columns(times, fit, shares)),
            method="lm",
            x_scale="jac",
            max_nfev=most_steps,
        )

    found = [solved(start, _MOST_STEPS) for start in starts]
    is_bounded = [np.abs(_value(times, one.x)).max() < _LARGEST for one in found]
    found = [one if fits else solved(start, 1) for one, start, fits in zip(found, starts, is_bounded, strict=True)]
    found.sort(key=lambda one: one.cost)
    signs = np.array([_MIRRORED if one.x[2] < 0 else np.ones(6) for one in found])
    jacobians = np.stack([one.jac for one in found]) * signs[:, None]
    # 3. Their errors, and what they explain beside an image motion.
    cost, known = 2 * np.array([one.cost for one in found]), max(float(measured.num_measurements[0, axis]), 7.0)
    noise, drift = cost / known, whitened(first)
    drift_only = data @ data - (drift @ data) ** 2 / (drift @ drift + 1e-300)
    covariances = noise[:, None, None] * scaled_inverse(jacobians.mT @ jacobians)
    gain, excess = (drift_only - cost) / (5 * noise + 1e-300), known * (cost / (cost[0] + 1e-300) - 1)
    return np.array([one.x for one in found]) * signs, covariances, gain, excess


def _step(fits: Array, record: tuple[float, float], timing: SensorTiming) -> float:
    """Seconds between the knots of a motion: 24 in the shortest period, for an error of its spline below 1e-4."""
    span = record[1] - record[0]
    fastest = float((np.abs(fits[:, 2]) + 0.5 * np.abs(fits[:, 4]) * span).max())
    return max(min(1 / (24 * fastest + 1e-9), span / 64), timing.row_time)


def _motion(fits: Array, record: tuple[float, float], step: float) -> FreeMotion:
    """Both axes as one spline with knots every ``step`` seconds."""
    middle, span = 0.5 * (record[0] + record[1]), record[1] - record[0]
    times = np.linspace(*record, math.ceil(span / step) + 1)
    return FreeMotion.through(tensor(times), tensor(np.stack([_value(times - middle, fit) for fit in fits], -1)))


def _at_origin(fit: Array, middle: float) -> tuple[Array, Array]:
    """[A, f, g, c, phi] at time 0 of parameters (6,) about the middle, and their derivatives (5, 6)."""
    a, b, frequency, decay, chirp, _ = fit
    size, growth = max(math.hypot(a, b), 1e-300), math.exp(decay * middle)
    phase = math.atan2(a, b) - 2 * math.pi * (frequency * middle - 0.5 * chirp * middle**2)
    slopes = np.eye(5, 6, 1)
    slopes[0] = [a / size * growth, b / size * growth, 0.0, size * growth * middle, 0.0, 0.0]
    slopes[1, 4] = -middle
    slopes[4] = [b / size**2, -a / size**2, -2 * math.pi * middle, 0.0, math.pi * middle**2, 0.0]
    return np.array([size * growth, frequency - chirp * middle, decay, chirp, phase]), slopes


def _with_aliases(fits: Array, period: float) -> Array:
    """Fits, and the first one at the frequencies that differ by up to three times the frame rate.

    Of 16 axes of tones that decay in 40 frames, one was found at such a frequency, and reliable.
    """
    others = np.tile(fits[0], (6, 1))
    others[:, 2] += np.array([-3, -2, -1, 1, 2, 3]) / period
    return np.concatenate([fits, others[others[:, 2] > 0]])


def _report(fitted: _Fitted, timing: SensorTiming, step: float) -> SweptTone:
    """Parameters at the time origin and in image axes, with standard deviations and verdict."""
    middle = 0.5 * (fitted.record[0] + fitted.record[1])
    reverse, num_frames = timing.readout_direction == "reverse", len(fitted.intervals) + 1
    values, stds, findings = [], [], []
    for axis, (fit, covariance) in enumerate(zip(fitted.fits, fitted.covariances, strict=True)):
        present = bool(np.abs(fit[:2]).sum() > 0)
        value, slope = _at_origin(fit, middle)
        std = np.sqrt(np.maximum((slope @ covariance @ slope.T).diagonal(), 0.0))
        turned = math.pi if reverse and axis == 1 else 0.0  # displacement along the scan changes its sign
        value[4] = np.mod(value[4] + turned + math.pi, 2 * math.pi) - math.pi
        values.append(present * value)
        stds.append(present * std)
        name = AXIS_NAMES[axis]
        against = [] if present else [Reason("no_tone", name)]
        if present and num_frames < _MIN_FRAMES:
            against.append(Reason("too_few_frames_for_sweep", name, num_frames, _MIN_FRAMES))
        elif present and (other := fitted.others[axis]) is not None:
            details = {"frequency": float(other[2]), "decay": float(other[3])}
            against.append(Reason("other_swept_tone", name, details=details))
        # of the pairs of frames: a sweep passes through blind frequencies
        between = np.cumsum(fitted.intervals) - 0.5 * (fitted.intervals + fitted.intervals.sum())
        frequencies = np.abs(float(fit[2]) + float(fit[4]) * between)
        gain = float(np.sqrt(np.square(offset_gain(frequencies, fitted.intervals[:, None])).mean()))
        if present and gain < MIN_GAIN:
            against.append(Reason("tone_blind", name, gain, MIN_GAIN, {"frequency": float(fit[2])}))
        uncertain, size = float(fitted.uncertain[axis]), float(fitted.moved[axis])
        allowed = MAX_DISPLACEMENT_STD * size
        if present and uncertain > allowed:
            against.append(Reason("displacement_uncertain", name, uncertain, allowed, {"size": size}))
        against += fitted.against[axis] if present else []
        against += unexplained_reasons(name, float(fitted.unexplained[axis]), size, "swept tone")
        findings.append(tuple(against))
    # the row bands contradict the fit of one axis, with which the rows of the other one were warped
    wrong = [any(reason.code == "bands_contradict" for reason in against) for against in findings]
    for axis, name in enumerate(AXIS_NAMES[:2]):
        if wrong[1 - axis] and not findings[axis]:
            findings[axis] = (Reason("other_axis_unknown", name),)
    reliable = torch.tensor([not against for against in findings], device="cpu")
    parameters, deviations = (magnitudes_from_row_order(tensor(np.stack(x, -1)), timing) for x in (values, stds))
    return SweptTone(
        **dict(zip(_TONE, parameters, strict=True)),
        image_motion=offsets_from_row_order(tensor(fitted.fits[:, 5]), timing),
        std=dict(zip(_TONE, deviations, strict=True)),
        motion=_motion(fitted.fits, fitted.record, step).from_row_order(timing),
        unexplained=magnitudes_from_row_order(tensor(fitted.unexplained), timing),
        reliable=magnitudes_from_row_order(reliable, timing),
        findings=findings_from_row_order(findings, timing),
    )
