"""Free motion: a displacement of any shape, fitted as a spline in time whose power spectrum is estimated from the data.

Frames are registered to each other, so only differences of displacement between frames that contain the same scene row
are measured. A penalised spline (P-spline) whose smoothness maximises the marginal likelihood gives a first estimate;
then the power spectrum of the motion is estimated by expectation maximisation, which yields realistic uncertainties of
the components that the differences do not determine.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.core.parallel import threads_for
from rsvib_torch.core.precision import full_precision, without_gradients
from rsvib_torch.core.presentation import AXIS_NAMES, JudgedResult, axis_rows, verdict_table
from rsvib_torch.core.reason import Reason
from rsvib_torch.core.splines import bspline_weights, gauss_legendre
from rsvib_torch.core.tables import Array, table, tensor
from rsvib_torch.core.text import measured_text
from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.rows.displacements import frame_groups, stack_spectra
from rsvib_torch.detection.rows.grouped_frames import GroupedFrames, GroupedStrips, MeasuredRows, grouped_strips
from rsvib_torch.detection.start import band_curve, measurements_of_curve
from rsvib_torch.detection.strips import FieldScale, camera_in_row_order
from rsvib_torch.detection.verdict import rotation_reasons
from rsvib_torch.frames.entry_points import frames_options
from rsvib_torch.frames.grey import GreyFrames, grey_frames
from rsvib_torch.frames.orientation import (
    findings_from_row_order,
    magnitudes_from_row_order,
    offsets_from_row_order,
)
from rsvib_torch.io.stack_reading import FramesOrFiles
from rsvib_torch.motion.field import ColumnMotion
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import RowTiming, SensorTiming
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.options import FreeMotionOptions, RegistrationOptions
from rsvib_torch.registration import OffsetCurve

_MAX_STD_SEEN = 0.3  # px, of the visible part of a reliable motion; frames of different scenes have more


@dataclass(frozen=True, eq=False, repr=False)
class MotionDetection(
    JudgedResult,
    units={
        "times": "s",
        **dict.fromkeys(("displacement", "std", "std_seen", "unseen", "unexplained"), "px; of roll rad, of zoom 1"),
    },
    shapes={
        "times": "T R",
        **dict.fromkeys(("displacement", "std"), "... T R A"),
        **dict.fromkeys(("std_seen", "unseen", "unexplained", "reliable"), "... A"),
        "findings": "...",
    },
):
    """A motion of any shape with its uncertainty. A batch of stacks leads all tensors but ``times``.

    Only differences of displacement between frames are measured. A warp that is fixed to the scene is not visible:
    frames of a warped scene look the same if D(t) of the row that contains scene row s is larger by w(s) in every
    frame. This component is estimated from the power of the motion at other frequencies, and ``std`` is therefore
    larger than ``std_seen``. The mean over the record is undetermined and not included. With roll and zoom, there are
    three or four axes instead of two, in rad and relative.

    Attributes:
        motion: The motion in image axes.
        times: (T, R) s, mid-exposures of rows spread over the frames.
        displacement: (..., T, R, 2) px, the motion there, less its mean over the record.
        std: (..., T, R, 2) px, its standard deviation.
        std_seen: (..., 2) px, rms standard deviation of the visible component: the displacement of the rows that
            contain one scene row, less its mean over the frames.
        unseen: (..., 2) px, rms standard deviation of that mean, the warp.
        unexplained: (..., 2) px, rms displacement of rows that the motion does not explain, beyond their noise.
        reliable: (..., 2) bool, whether the motion explains the measurements.
        findings: Each ``Reason`` why not, for each axis (x, y); a tuple of those for a batch. ``reasons`` has their
            texts.

    Example:
        >>> import torch
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.evaluation import example_frames
        >>> frames, timing, _ = example_frames()
        >>> found = rsv.detect_motion(frames, timing)
        >>> found.motion.displacement(torch.tensor(0.01, dtype=torch.float64)).shape  # px along x and y at 10 ms
        torch.Size([2])
    """

    motion: FreeMotion
    times: Tensor
    displacement: Tensor
    std: Tensor
    std_seen: Tensor
    unseen: Tensor
    unexplained: Tensor
    reliable: Tensor
    findings: tuple[Any, ...]

    def summary(self) -> str:
        """Size of the motion of each axis with its standard deviations, and the verdict."""
        size = self.displacement.square().mean((-3, -2)).sqrt()
        rows = [
            [*labels, *(measured_text(value[at], digits=2) for value in (size, self.std_seen, self.unseen))]
            for at, labels in axis_rows(self.batch_shape, size.shape[-1])
        ]
        unit = ("px", "px; roll: rad", "px; roll: rad; zoom: 1")[size.shape[-1] - 2]
        head = (f"displacement ({unit}, rms)", f"± between frames ({unit})", f"± common to all ({unit})")
        return "\n".join(verdict_table(head, rows, self.batch_shape, self.reliable, self.reasons))


@frames_options(FreeMotionOptions)
@full_precision
@without_gradients
def detect_motion(frames: FramesOrFiles, timing: SensorTiming, options: FreeMotionOptions) -> MotionDetection:
    """Detect a motion of any shape from consecutive frames: the free model.

    Row bands are registered between frames for a start. Then the frames are warped to the scene with the current
    motion, the residual displacement of every block of rows is measured in each frame, and a spline in time is fitted
    to all of them. Its smoothness is chosen by the marginal likelihood; with up to 800 knots the power spectrum of the
    motion is estimated as well.

    Args:
        frames: Stack (T, H, W), (T, C, H, W) or (B, T, C, H, W) of at least two frames; tensor, array, list of
            these, or files; floats, or integers of known full scale. NaN marks missing pixels.
        timing: The sensor.
        options: Options.

    Returns:
        The motion in image axes with its uncertainty over time.

    Raises:
        TypeError: If frames are not numbers.
        ValueError: If there are fewer than two frames, a frame is constant or has too few valid pixels, the motion is
            beyond the search range, or an option is out of range.

    Example:
        >>> import torch
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.evaluation import city_and_fields
        >>> timing = rsv.SensorTiming(row_time=40e-6, exposure_rows=20, frame_rows=300)
        >>> times = torch.linspace(0.0, 0.05, 51, dtype=torch.float64)
        >>> path = torch.stack([1.5 * torch.sin(700 * times), 1.1 * torch.sin(500 * times)], -1)  # px
        >>> motion = rsv.FreeMotion.from_samples(times, path)
        >>> frames = rsv.simulate_frames(city_and_fields(260, 220, seed=3), timing, motion, num_frames=3)
        >>> found = rsv.detect_motion(frames, timing)
        >>> restored = rsv.restore(frames, timing, found.motion, check=False)
        >>> for images in (frames, restored):  # mean difference of two frames
        ...     print(f"{(images[1] - images[0])[16:-16, 16:-16].abs().mean():.3f}")
        0.040
        0.001
        >>> found.reliable.tolist()
        [True, True]
    """
    axes = 4 if options.zoom else 3 if options.roll else 2
    stacks = grey_frames(frames, timing, options)
    timing = stacks.timing
    height, width = stacks.images.shape[-2:]
    camera = camera_in_row_order(options, (height, width), timing)
    scale = FieldScale(axes, width, height, camera)
    with threads_for(stacks.images):
        results = [
            _detect(stacks.one(i), timing, options, options.knot_rows, options.iterations, scale)
            for i in range(len(stacks.images))
        ]
    return MotionDetection.stacked(results) if stacks.batched else results[0]


def _detect(
    stack: GreyFrames,
    timing: SensorTiming,
    bands: RegistrationOptions,
    knot_rows: int,
    iterations: int,
    scale: FieldScale,
) -> MotionDetection:
    """``detect_motion`` of one stack."""
    rowwise, curve, record = start_curve(stack, timing, bands)
    longest = math.floor((record[1] - record[0]) / rowwise.row_time)
    if knot_rows > longest:
        raise ValueError(f"knot_rows must be at most {longest}, the row times of the stack, got {knot_rows}")
    rows, motion, spacing = measure_freely(stack, rowwise, curve, record, bands, knot_rows, iterations)
    if not scale.same_for_all_columns:
        rows, motion = _measure_field(stack, rowwise, motion, spacing, record, scale, iterations)
    measured = rows.measurements
    residual = residual_of_motion(measured, motion[0])
    weighed = measured.reweighted(residual)
    share = weighed.independent_fraction(residual) * measured.share_counted(residual)
    fit = _fit_spline(replace(weighed, independent=share), spacing, record, learn=True)
    motion = _motion(fit, (0.25 * scale.width, 0.25 * scale.height))  # px; beyond, frames share too little
    starts = rowwise.frame_starts(stack.images.shape[1])
    banded = measurements_of_curve(curve, rowwise, bands.band_step)
    of_middle: Motion = motion
    if not scale.same_for_all_columns:
        middle = torch.zeros(1, dtype=torch.float64, device="cpu")
        of_middle = ColumnMotion.of_columns(scale.free_motion(motion), middle, rowwise, len(starts), scale.height)
    of_bands = [*bands_reasons(banded, of_middle[0]), [], []][: scale.axes]
    report = _report(motion[0], fit, measured, timing, starts, scale, of_bands, rows.differential()[0])
    return report.to(stack.images.device)


def _measure_field(
    stack: GreyFrames,
    timing: RowTiming,
    start: FreeMotion,
    spacing: float,
    record: tuple[float, float],
    scale: FieldScale,
    iterations: int,
) -> tuple[MeasuredRows, FreeMotion]:
    """``measure_freely`` with roll and zoom, from a motion without them; all components in px."""
    still = torch.zeros_like(start.coefficients[:, :1]).expand(-1, scale.axes - 2, -1)
    drift = torch.cat([start.image_motion, start.image_motion.new_zeros(1, scale.axes - 2)], -1)
    tones = Vibration(torch.zeros(1, scale.axes, 1), 0.0, 0.0, drift)
    motion = FreeMotion(torch.cat([start.coefficients, still], 1), start.start, start.spacing, tones)

    def strips_for(motion: FreeMotion) -> GroupedStrips:
        motion = motion.to(stack.images.device)
        return grouped_strips(stack.images, stack.valid, timing, motion, scale, pairs_if_blurred_differently=False)

    # strips follow the size of roll and zoom, which are unknown in the first round
    rows, motion = _rounds(strips_for(motion), motion, spacing, record, 1)
    if iterations == 1:
        return rows, motion
    return _rounds(strips_for(motion), motion, spacing, record, iterations - 1, weighted=True)


def _rounds(
    rows: GroupedFrames,
    motion: FreeMotion,
    spacing: float,
    record: tuple[float, float],
    count: int,
    *,
    weighted: bool = False,
) -> tuple[MeasuredRows, FreeMotion]:
    """Rounds of measuring the rows of one stack around a spline and fitting the spline to them.

    ``weighted`` gives objects that move by themselves less weight in the first round already.
    """
    for number in range(count):
        measured = rows.measure(motion.to(rows.groups[0].starts.device))
        measurements = measured.measurements
        if number or weighted:
            measurements = measurements.reweighted(residual_of_motion(measurements, motion[0]))
        # while iterating, any drift is an image motion, which the scene rows of the groups follow
        motion = _motion(_fit_spline(measurements, spacing, record))
    return replace(measured, measurements=measurements), motion


def measure_freely(
    stack: GreyFrames,
    timing: RowTiming,
    curve: OffsetCurve,
    record: tuple[float, float],
    bands: RegistrationOptions,
    knot_rows: int,
    iterations: int,
) -> tuple[MeasuredRows, FreeMotion, float]:
    """Displacements of the rows of one stack, measured around a spline that is fitted to them again in every round.

    The result has the measurements, the motion (a batch of one), and its knot spacing in seconds.
    """
    spacing = max(knot_rows * timing.row_time, (record[1] - record[0]) / 3000)  # the cost grows with knots^3
    measured = measurements_of_curve(curve, timing, bands.band_step)
    fit = _fit_spline(measured, max(spacing, 0.5 * bands.band_rows * timing.row_time), record)
    motion = _motion(fit)
    rows = GroupedFrames(
        frame_groups(stack_spectra(stack.images, stack.valid), timing, motion.to(stack.images.device)), timing
    )
    return *_rounds(rows, motion, spacing, record, iterations), spacing


def start_curve(
    stack: GreyFrames, timing: SensorTiming, bands: RegistrationOptions
) -> tuple[RowTiming, OffsetCurve, tuple[float, float]]:
    """Timing in row order, the offsets of the row bands of one stack, start and end of the record in seconds.

    Raises:
        ValueError: If the frames do not fit the timing, or fewer than a quarter of the bands are found.
    """
    frames = stack.images
    rowwise = timing.in_row_order()
    rowwise.check_rows(frames.shape[-2])
    curve = band_curve(frames, stack.valid, rowwise, bands, mere_start=True)
    share = float(curve.good.double().mean())
    if share < 0.25:
        raise ValueError(
            f"only {share:.0%} of the row bands are found in the next frame: the motion exceeds "
            f"search={bands.search} px within a frame (use a larger search), or the frames show different scenes"
        )
    starts = rowwise.frame_starts(frames.shape[1])
    end = float(starts[-1]) + frames.shape[-2] * rowwise.row_time + rowwise.exposure_time
    return rowwise, curve, (float(starts[0]), end)


def residual_of_motion(measured: Measurements, motion: Motion) -> Array:
    """Residual displacements (1, N, G, 2) in px of a motion (not a batch, on the CPU)."""
    return measured.relative(measured.displacements - _moved(measured, motion))


def rms_motion(measured: Measurements, motion: Motion) -> Array:
    """(2,) px, rms displacement of scene rows about their mean over the frames, by a motion as above."""
    moved = measured.relative(_moved(measured, motion))[0]
    square = np.square(moved).sum(1) / np.maximum(measured.num_differences[0], 1.0)[:, None]
    return np.sqrt(square.mean(0))


def _moved(measured: Measurements, motion: Motion) -> Array:
    """Displacements (1, N, G, 2) in px of the rows by a motion."""
    return table(motion.mean_displacement(tensor(measured.exposure_starts), measured.exposure_time))


def bands_reasons(banded: Measurements, motion: Motion, *, counted: float = 0.75) -> list[list[Reason]]:
    """Reasons against a motion of each axis in row order that the offsets of row bands of one stack contradict.

    Noise without a scene has offsets of any size, and rows that are measured around a fit to them confirm it. The best
    bands count, a fraction ``counted``: clouds may cover the others.
    """
    used = banded.weights[0].min(-1) > 0
    values, rest = (x[0, used, 1] - x[0, used, 0] for x in (banded.displacements, residual_of_motion(banded, motion)))
    size = np.abs(values - values.mean(0)).mean(0).tolist()
    count = math.ceil(counted * len(rest))
    residual = np.sort(np.abs(rest), 0)[:count].mean(0).tolist()
    allowed = [max(0.1, 0.3 * axis) for axis in size]  # px; smaller ones are errors of registration, as for tones
    compared = zip(AXIS_NAMES, residual, allowed, strict=False)
    return [[Reason("bands_contradict", *of_axis)] if of_axis[1] > of_axis[2] else [] for of_axis in compared]


def unexplained_reasons(axis: str, residual: float, moved: float, model: str) -> list[Reason]:
    """Reasons against a fit whose rms ``residual`` in px exceeds 15 % of the rms motion ``moved``, and 0.03 px."""
    allowed = max(0.15 * moved, 0.03)  # px
    return [Reason("motion_unexplained", axis, residual, allowed, {"model": model})] if residual > allowed else []


def _motion(fit: "_SplineFit", largest_drift: tuple[float, float] = (0.0, 0.0)) -> FreeMotion:
    """The spline as a batch of one motion; a drift by more than ``largest_drift`` px becomes its image motion."""
    knots = fit.knots
    centred = knots - knots.mean()
    speed = (fit.coefficients * centred).sum(-1) / centred.square().sum()
    large = speed[:2].abs() * float(knots[-1] - knots[0]) > speed.new_tensor(largest_drift)
    speed = torch.where(functional.pad(large, (0, len(speed) - 2)), speed, 0.0)  # none of roll and zoom
    drift = Vibration(torch.zeros_like(speed)[None, :, None], 0.0, 0.0, speed[None])
    return FreeMotion((fit.coefficients - speed[:, None] * knots)[None], fit.start, fit.spacing, drift)


# --- Spline fit ---


@dataclass(frozen=True, eq=False)
class _SplineFit:
    """Cubic spline ``sum_n c_n B((t - start) / spacing - n + 1)`` of each axis."""

    coefficients: Tensor  # (A, N) float64 px
    covariance: Tensor  # (A, N, N) float64 px^2 of each axis
    start: float  # time of the first knot in seconds
    spacing: float  # seconds between knots

    @property
    def knots(self) -> Tensor:
        """(N,) s, times of the coefficients."""
        count = self.coefficients.shape[-1]
        places = torch.arange(count, dtype=torch.float64, device=self.coefficients.device) - 1.0
        return self.start + places * self.spacing

    def columns(self, times: Tensor) -> Tensor:
        """Derivatives (S, N) of the motion at times (S,) by the coefficients."""
        count = self.coefficients.shape[-1]
        place = ((times - self.start) / self.spacing).clamp(0.0, count - 3.0)
        cell = place.floor().clamp(max=count - 4.0)
        index = cell.to(torch.int64)[..., None] + torch.arange(4, device=times.device)
        columns = torch.zeros(len(times), count, dtype=torch.float64, device=times.device)
        return columns.scatter(-1, index, bspline_weights(place - cell, 3))


def _fit_spline(
    measurements: Measurements, spacing: float, record: tuple[float, float], *, learn: bool = False
) -> _SplineFit:
    """Fit a spline with knots at a spacing in seconds to the measurements of one stack (B = 1), each axis by itself.

    Minimises ``sum w (d - relative(D))^2 + lambda |D''|^2``; lambda maximises the marginal likelihood. With ``learn``,
    the power spectrum of the motion is estimated, for splines of up to 800 knots.
    """
    first, last = record
    axes = measurements.displacements.shape[-1]
    count = math.ceil((last - first) / spacing) + 3
    shape = _SplineFit(
        torch.zeros(axes, count, dtype=torch.float64, device="cpu"),
        torch.zeros(axes, 0, 0, dtype=torch.float64, device="cpu"),
        first,
        spacing,
    )
    values, covariances = zip(*(_fit_axis(measurements, shape, axis, learn) for axis in range(axes)), strict=True)
    return replace(shape, coefficients=torch.stack(values), covariance=torch.stack(covariances))


def _fit_axis(measurements: Measurements, shape: _SplineFit, axis: int, learn: bool) -> tuple[Tensor, Tensor]:
    """Coefficients (N,) of one axis and their covariance (N, N)."""
    values = tensor((measurements.displacements[..., axis] * measurements.visible)[0])
    weight = tensor(measurements.inverse_variances[0, :, axis])  # the other axes being unknown too
    count = shape.coefficients.shape[-1]
    gram = torch.zeros(count, count, dtype=torch.float64, device=values.device)
    right = torch.zeros(count, dtype=torch.float64, device=values.device)
    for begin in range(0, len(values), 128):  # scene rows at a time: their columns are (128 G, N)
        part = slice(begin, begin + 128)
        design = _design(measurements, shape, axis, part)
        used = (design != 0).flatten(0, 1).any(0).nonzero()[:, 0]
        flat = design[..., used].flatten(0, 1)
        weighted = flat * weight[part, None].expand(-1, design.shape[1]).flatten()[:, None]
        gram[used[:, None], used] += flat.mT @ weighted
        right[used] += weighted.mT @ values[part].flatten()
    energy = (weight[:, None] * values.square()).sum()
    rounding = 1e-12 * energy  # error of the sums that make the residual energy
    known = max(float(measurements.num_measurements[0, axis]), 1.0)
    scale = gram.diagonal().mean() + 1e-300
    second = torch.eye(count, dtype=torch.float64, device=values.device).diff(n=2, dim=0)
    bend = second.mT @ second
    base = gram + scale * 1e-3 / count  # on every element: the undetermined mean becomes 0

    def solution(smoothness: float) -> tuple[Tensor, Tensor]:
        """Coefficients and Cholesky factor of the normal matrix."""
        factor = torch.linalg.cholesky(base + smoothness * scale * bend)
        return torch.cholesky_solve(right[:, None], factor)[:, 0], factor

    def evidence(smoothness: float) -> Tensor:
        """Logarithm of the marginal likelihood."""
        coefficients, factor = solution(smoothness)
        residual = torch.maximum(energy - right @ coefficients, rounding) + 1e-300
        logarithm = 2 * factor.diagonal().log().sum() - (count - 2) * math.log(smoothness)
        return -0.5 * (known * (residual / known).log() + logarithm)

    decade = max((10.0**power for power in range(-8, 5)), key=lambda tried: float(evidence(tried)))
    thirds = (decade * 10 ** (step / 3) for step in (0, -2, -1, 1, 2))
    smoothness = max(thirds, key=lambda tried: float(evidence(tried)))
    coefficients, factor = solution(smoothness)
    noise = float(torch.maximum(energy - right @ coefficients, rounding) / known)
    if learn and count <= 800 and noise > 0:  # the cost grows with knots^3, 20 times
        return _fit_with_spectrum(gram, right, noise, smoothness * float(scale))
    return coefficients, noise * torch.cholesky_inverse(factor)


def _design(measurements: Measurements, shape: _SplineFit, axis: int, part: slice) -> Tensor:
    """Derivatives (n, G, N) of the relative displacements of some scene rows by the coefficients of an axis."""
    exposure_starts = tensor(measurements.exposure_starts[0, part])
    average = measurements.average_times[axis if axis < 2 else 0] + measurements.exposure_time
    nodes, weights = gauss_legendre(3 + math.ceil(2 * average / shape.spacing))
    first = exposure_starts + 0.5 * (measurements.exposure_time - average)
    columns = torch.zeros(*exposure_starts.shape, 1, dtype=torch.float64, device=exposure_starts.device)
    for node, weight in zip(nodes.tolist(), weights.tolist(), strict=True):
        at = (first + average * node).flatten()
        columns = columns + weight * shape.columns(at).unflatten(0, exposure_starts.shape)
    seen = tensor(measurements.visible[0, part])[..., None]
    mean = (seen * columns).sum(1, keepdim=True) / seen.sum(1, keepdim=True).clamp(min=1.0)
    return seen * (columns - mean)


def _fit_with_spectrum(gram: Tensor, right: Tensor, noise: float, smoothness: float) -> tuple[Tensor, Tensor]:
    """Coefficients (N,) of a spline and their covariance (N, N), with the power of each frequency estimated.

    The smoothness penalty assumes how fast the power of a motion falls with frequency. A motion with a resonance has
    more power there, and may have more in undetermined components of similar frequency. The coefficients are a straight
    line and cosines, ``c = sum_j a_j cos(w_j (n + 1/2))`` with a_j of variance s_j. Expectation maximisation alternates
    between a for given s, and s_j = mean of ``a_j^2 + var(a_j)`` over neighbouring frequencies, relative to the
    penalty.

    ``gram`` (N, N) and ``right`` (N,) are the normal equations, ``noise`` is the variance of measurements of unit
    weight, and ``smoothness`` the weight of squared second differences to start with.
    """
    count = len(right)
    margin = max(10, count // 16)  # knots beyond the record, as cosines have zero slope at their ends
    length = count + 2 * margin
    order = torch.arange(length, dtype=torch.float64, device=right.device)
    place = torch.arange(count, dtype=torch.float64, device=right.device)
    angle = math.pi / length * order
    waves = torch.cos(angle * (place[:, None] + margin + 0.5)) * math.sqrt(2 / length)
    line = place - place.mean()
    columns = torch.cat([waves, (line / line.norm())[:, None]], 1)
    matrix = columns.mT @ gram @ columns / noise
    target = columns.mT @ right / noise
    expected = noise / smoothness * (2 * torch.sin(0.5 * angle[1:])) ** -4
    window = torch.exp(-0.5 * ((order[1:, None] - order[1:]) / 2.0) ** 2)  # standard deviation: one cycle in the record
    window = window / window.sum(1, keepdim=True)
    anchor = (1e-9 * matrix.diagonal().mean()).expand(1)  # makes the undetermined mean 0
    power = expected
    amplitude, covariance = torch.zeros_like(target), matrix
    for _ in range(20):
        whole = matrix + torch.diag(torch.cat([anchor, anchor + 1 / power, anchor]))
        covariance = torch.cholesky_inverse(torch.linalg.cholesky(whole))
        amplitude = covariance @ target
        second_moment = amplitude[1:-1].square() + covariance.diagonal()[1:-1]
        power = (window @ (second_moment / expected)) * expected
    return columns @ amplitude, columns @ covariance @ columns.mT


# --- Report ---


def _report(
    motion: FreeMotion,
    fit: _SplineFit,
    measured: Measurements,
    timing: SensorTiming,
    starts: Tensor,
    scale: FieldScale,
    of_bands: list[list[Reason]],
    apart: Array,
) -> MotionDetection:
    """The motion in image axes, and its uncertainty at up to 32 rows of every frame.

    ``of_bands`` are the reasons of each axis from the row bands, ``apart`` (2,) px the rms difference of the
    displacements along a row that the motion does not explain.
    """
    num_rows = scale.height
    rows = torch.linspace(0, num_rows - 1, min(32, num_rows), dtype=torch.float64, device=starts.device)
    times = starts[:, None] + rows * timing.row_time + 0.5 * timing.exposure_time
    columns = fit.columns(times.flatten())
    mean = columns.mean(0)
    visible, common = _visible_and_common(fit, measured)

    def variance(of: Tensor) -> Tensor:
        """Variances (S, 2) of linear functions (S, N) of the coefficients of each axis."""
        return torch.stack([((of @ covariance) * of).sum(-1).clamp(min=0.0) for covariance in fit.covariance], -1)

    std = variance(columns - mean).sqrt().unflatten(0, times.shape)
    std_seen = variance(visible).mean(0).sqrt()
    unseen = variance(common - mean).mean(0).sqrt()
    rest = tensor(measured.unexplained(residual_of_motion(measured, motion))[0])
    value = motion.displacement(times)
    value = value - value.mean((0, 1))
    moved = (value - value.mean(0)).square().mean((0, 1)).sqrt()
    findings = []
    for axis, name in enumerate(AXIS_NAMES[: scale.axes]):
        against = unexplained_reasons(name, float(rest[axis]), float(moved[axis]), "smooth motion") + of_bands[axis]
        size = math.sqrt(2) * float(moved[axis] if scale.axes == 2 else moved[:2].amax())
        against += rotation_reasons(axis, scale.axes, apart.tolist(), size, remedy="True")
        if float(std_seen[axis]) > _MAX_STD_SEEN:
            against.append(Reason("motion_uncertain", name, float(std_seen[axis]), _MAX_STD_SEEN))
        findings.append(tuple(against))
    reliable = torch.tensor([not against for against in findings], device=rest.device)
    units = scale.units(value)
    return MotionDetection(
        motion=scale.free_motion(motion).from_row_order(timing),
        times=times,
        displacement=offsets_from_row_order(value * units, timing),
        std=magnitudes_from_row_order(std * units, timing),
        std_seen=magnitudes_from_row_order(std_seen * units, timing),
        unseen=magnitudes_from_row_order(unseen * units, timing),
        unexplained=magnitudes_from_row_order(rest * units, timing),
        reliable=magnitudes_from_row_order(reliable, timing),
        findings=findings_from_row_order(findings, timing),
    )


def _visible_and_common(fit: _SplineFit, measured: Measurements) -> tuple[Tensor, Tensor]:
    """Linear functions of the coefficients, for scene rows in several frames.

    Returns:
        (S, N), the displacement in each frame less the mean over the frames; (R, N), that mean.
    """
    seen = tensor(measured.visible[0])
    several = seen.sum(-1) > 1
    seen = seen[several]
    exposure_starts = tensor(measured.exposure_starts[0])[several] + 0.5 * measured.exposure_time
    columns = fit.columns(exposure_starts.flatten()).unflatten(0, seen.shape)
    mean = (seen[..., None] * columns).sum(1) / seen.sum(-1)[:, None]
    return (columns - mean[:, None])[seen > 0], mean
