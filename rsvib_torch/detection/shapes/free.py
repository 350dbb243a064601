"""Free motion: a displacement of any shape, fitted as a spline in time whose power spectrum is estimated from the data.

Frames are registered to each other, so only differences of displacement between frames that contain the same scene row
are measured. ``spline_fit`` fits them, and estimates what they do not determine.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from rsvib_torch.checks.arguments import FramesOrFiles
from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.rows.displacements import BLOCK_ROWS
from rsvib_torch.detection.rows.grouped_frames import (
    GroupedFrames,
    MeasuredRows,
    grouped_frames,
    grouped_strips,
)
from rsvib_torch.detection.sensitivity import displacements_by_row_time
from rsvib_torch.detection.shapes.spline_fit import SplineFit, fit_spline
from rsvib_torch.detection.start import BandStart, FieldScale, band_start, camera_in_row_order
from rsvib_torch.detection.tones.fit import ToneFit, fit_tones, fitted_again, motion_of_fit, residual_of
from rsvib_torch.detection.tones.selection import find_tones, with_best_aliases
from rsvib_torch.detection.tones.uncertainty import with_further_tones
from rsvib_torch.detection.verdict import compared_bands, exposure_reasons, rotation_reasons, scene_reasons
from rsvib_torch.execution.parallel import full_precision, threads_for, without_gradients
from rsvib_torch.frames.entry_points import frames_options
from rsvib_torch.frames.prepare import (
    GreyFrames,
    findings_from_row_order,
    grey_frames,
    magnitudes_from_row_order,
    offsets_from_row_order,
)
from rsvib_torch.motion.motion import ColumnMotion, Motion
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import RowTiming, SensorTiming
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.numerics.interpolation import gauss_legendre
from rsvib_torch.numerics.tables import Array, table, tensor
from rsvib_torch.options import FreeMotionOptions, RegistrationOptions
from rsvib_torch.results.presentation import AXIS_NAMES, JudgedResult, axis_rows, verdict_table
from rsvib_torch.results.reason import Findings, Reason
from rsvib_torch.text import measured_text, wrapped

_MAX_BAND_ERROR = 0.1  # px; smaller differences between the offsets of row bands and a motion are errors of bands
# of what is allowed, above which frames were compared at a wrong place, so that the other axis is wrong as well: 2.4 to
# 8 in 16 stacks of noise, other scenes, repeated structure; beside 1.1 to 1.5, it was right in three stacks
_MISMATCH = 2.0
_MAX_STD_SEEN = 0.3  # px, of the visible part of a reliable motion; frames of different scenes have more
# rms of the part of a spline that all frames have in common over that of the rest. With frame_rows of the image height
# instead of 300, a tone of 1.6 px became a motion of 25 px, whose visible part has 0.4 px
_MOST_IN_COMMON = 10.0
# Of a motion whose largest part is near a multiple of the frame rate, frames show the least, and its power is
# estimated too small: of 72 axes of vibrations there that sweep, decay or pulse, 41 were reliable and wrong by more
# than 30 % (by 25 standard deviations, and by 60 to 95 px with tones). Largest distance in cycles per record, and
# largest standard deviation of the common part over the displacement
_NEARLY_BLIND, _MOST_UNKNOWN = 1.4, 0.2


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
            contain one scene row, less its mean over the frames. Of scene rows within eight rows of the rims, which are
            not measured, errors are up to ten times larger; ``std`` contains them.
        unseen: (..., 2) px, rms standard deviation of that mean, the warp.
        unexplained: (..., 2) px, rms displacement of rows that the motion does not explain, beyond their noise.
        reliable: (..., 2) bool, whether the motion explains the measurements.
        findings: Each ``Reason`` why not, for each axis (x, y); a tuple of those for a batch. ``reasons`` has their
            texts.

    Example:
        >>> import torch
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import example_frames
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
    findings: Findings

    def summary(self) -> str:
        """Size of the motion of each axis with its standard deviations, and the verdict.

        Of 200 axes of three tones, the rms errors of 11, all with a tone within 5 % of the frame rate, were 2.7 to 32
        deviations of the displacement; frames cannot contradict the assumption that there is no such tone.
        """
        size = self.displacement.square().mean((-3, -2)).sqrt()
        rows = [
            [*labels, *(measured_text(value[at], digits=2) for value in (size, self.std_seen, self.unseen))]
            for at, labels in axis_rows(self.batch_shape, size.shape[-1])
        ]
        unit = ("px", "px; roll: rad", "px; roll: rad; zoom: 1")[size.shape[-1] - 2]
        head = (f"displacement ({unit}, rms)", f"± between frames ({unit})", f"± common to all ({unit})")
        lines = verdict_table(head, rows, self.batch_shape, self.reliable, self.reasons)
        intervals = self.times[:, 0].diff()
        if self.reliable.any() and bool((intervals - intervals[0]).abs().amax() < 0.01 * intervals[0]):
            rate = f"{1 / float(intervals[0]):.4g} Hz"
            text = f"assumed: motion near multiples of {rate}, which all frames have in common, is as small as"
            lines.append(wrapped(f"{text} that at neighbouring frequencies"))
        return "\n".join(lines)


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
        ValueError: If there are fewer than two frames, a frame is constant or has too few valid pixels, the motion is
            beyond the search range, or an option is out of range.

    Example:
        >>> import torch
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import city_and_fields
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
        0.000
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
        results = [_detect(stacks.one(index), timing, options, scale) for index in range(len(stacks.images))]
    return MotionDetection.stacked(results) if stacks.batched else results[0]


def _detect(stack: GreyFrames, timing: SensorTiming, options: FreeMotionOptions, scale: FieldScale) -> MotionDetection:
    """``detect_motion`` of one stack."""
    # 1. The rows, measured around a spline, and their weights.
    rowwise, start = start_of_stack(stack, timing, options)
    record = record_of(stack, rowwise)
    longest, knot_rows = math.floor((record[1] - record[0]) / rowwise.row_time), options.knot_rows
    if knot_rows > longest:
        raise ValueError(f"knot_rows must be at most {longest}, the row times of the stack, got {knot_rows}")
    spacing = max(knot_rows * rowwise.row_time, (record[1] - record[0]) / 3000)  # s; the cost grows with knots^3
    motion = _motion(fit_spline(start.measurements, max(spacing, 0.5 * start.measurements.average_times[0]), record))
    frames, rows, motion = _measured_around(motion, stack, rowwise, spacing, options.iterations, None)
    if not scale.same_for_all_columns:
        still = torch.zeros_like(motion.coefficients[:, :1]).expand(-1, scale.axes - 2, -1)
        drift = functional.pad(motion.tones.image_motion, (0, scale.axes - 2))
        drifting = Vibration(torch.zeros(1, scale.axes, 1), 0.0, 0.0, drift)
        motion = FreeMotion(torch.cat([motion.coefficients, still], 1), motion.start, motion.spacing, drifting)
        frames, rows, motion = _measured_around(motion, stack, rowwise, spacing, options.iterations, scale)
    measured = rows.measurements
    blur_reasons = exposure_reasons(rowwise, *table(frames.blur_ratio(motion.to(stack.images.device)))[0].tolist())
    weighed = measured.weighed(residual_of_motion(measured, motion[0]))
    # 2. The last fit, with its uncertainty at the middles of exposures of up to 32 rows of each frame.
    starts = rowwise.frame_starts(stack.images.shape[1])
    rows_of_report = np.linspace(0, scale.height - 1, min(32, scale.height))
    times = starts[:, None] + tensor(rows_of_report) * rowwise.row_time + 0.5 * rowwise.exposure_time
    fit = fit_spline(weighed, motion.spacing, record, table(times).ravel())
    spread = noise_spread = _Spread.of(fit, measured, times)
    by_row_time = np.zeros_like(measured.displacements)
    if rowwise.row_time_std:
        by_row_time = displacements_by_row_time(measured, motion[0], rowwise, len(starts))
        changed = replace(weighed, displacements=weighed.displacements + by_row_time)
        changes = fit_spline(changed, motion.spacing, record, table(times).ravel()).coefficients - fit.coefficients
        covariances = [covariance + np.outer(c, c) for covariance, c in zip(fit.covariances, changes, strict=True)]
        fit = replace(fit, covariances=covariances)
        spread = _Spread.of(fit, measured, times)
    motion = _motion(fit, (0.25 * scale.width, 0.25 * scale.height))  # px; beyond, frames share too little
    # 3. The tones that explain the rows as well.
    free, spread = _with_tones(measured, motion[0], spread, noise_spread.seen, times, rowwise, by_row_time)
    # 4. The row bands, which may contradict the motion of the middle column.
    middle_motion: Motion = motion
    if not scale.same_for_all_columns:
        middle = torch.zeros(1, dtype=torch.float64, device="cpu")
        middle_motion = ColumnMotion.of_columns(scale.free_motion(motion), middle, rowwise, len(starts), scale.height)
    bands_reasons = _bands_reasons(start, scale.width, middle_motion[0], scale.axes)
    report = _report(free, spread, measured, timing, times, scale, bands_reasons, blur_reasons, rows.differential()[0])
    return report.to(stack.images.device)


def _measured_around(
    motion: FreeMotion, stack: GreyFrames, timing: RowTiming, spacing: float, iterations: int, scale: FieldScale | None
) -> tuple[GroupedFrames, MeasuredRows, FreeMotion]:
    """The frames and rows of one stack around a spline, and the spline (a batch of one), from rounds of measurements.

    ``scale`` is that of roll and zoom, with which rows are measured in strips of columns.
    """
    images, device = stack.images, stack.images.device
    for number in range(iterations):
        if scale is None and number == 0:
            frames: GroupedFrames = grouped_frames(images, stack.valid, timing, motion.to(device))
        elif scale is not None and number < 2:  # strips follow the size of roll and zoom, unknown in the first round
            frames = grouped_strips(images, stack.valid, timing, motion.to(device), scale, pairs=False)
        measured = frames.measure(motion.to(device), keep_images=False)
        measurements = measured.measurements
        if number:
            measurements = measurements.reweighted(residual_of_motion(measurements, motion[0]))
        # while iterating, any drift is an image motion, which the scene rows of the groups follow
        motion = _motion(fit_spline(measurements, spacing, record_of(stack, timing)))
    return frames, replace(measured, measurements=measurements), motion


def start_of_stack(stack: GreyFrames, timing: SensorTiming, bands: RegistrationOptions) -> tuple[RowTiming, BandStart]:
    """Timing in row order, and the offsets of the row bands of one stack.

    An error if the frames do not fit the timing, or fewer than a quarter of the bands are found.
    """
    rowwise = timing.in_row_order()
    rowwise.check_rows(stack.images.shape[-2])
    start = band_start(stack, rowwise, bands, mere_start=True)
    share = float(start.curve.good.double().mean())
    if share < 0.25:
        raise ValueError(
            f"only {share:.0%} of the row bands are found in the next frame: the motion exceeds "
            f"search={bands.search} px within a frame (use a larger search), or the frames show different scenes"
        )
    return rowwise, start


def record_of(stack: GreyFrames, timing: RowTiming) -> tuple[float, float]:
    """Start and end in s of the exposures of a stack."""
    num_frames, num_rows = stack.images.shape[1:3]
    starts = timing.frame_starts(num_frames)
    return float(starts[0]), float(starts[-1]) + num_rows * timing.row_time + timing.exposure_time


def residual_of_motion(measured: Measurements, motion: Motion) -> Array:
    """Residual displacements (1, N, G, 2) in px of a motion (not a batch, on the CPU)."""
    return measured.relative(measured.displacements - _row_displacements(measured, motion))


def _row_displacements(measured: Measurements, motion: Motion) -> Array:
    """Displacements (1, N, G, A) in px of the rows by a motion, means over the exposure and the rows of a band."""
    starts, duration = tensor(measured.exposure_starts), measured.average_times[1]
    nodes, shares = gauss_legendre(3 if duration else 1)
    at_nodes = [motion.mean_displacement(starts + (node - 0.5) * duration, measured.exposure_time) for node in nodes]
    return table(torch.stack(at_nodes, -1) @ shares)


def _bands_reasons(start: BandStart, columns: int, motion: Motion, axes: int) -> list[list[Reason]]:
    """Reasons against each axis of a motion, in row order, from the row bands of one stack of ``columns`` px.

    Noise without a scene has offsets of any size, and rows that are measured around a fit to them confirm it.
    """
    # the pairs of frames one by one: one frame of noise, or of another scene, hardly changes the mean of all bands
    pairs, banded = start.curve.quality.shape[1:], start.measurements
    offsets, residual = (
        np.diff(values[0], axis=1).reshape(*pairs, 2)  # px
        for values in (banded.displacements, residual_of_motion(banded, motion))
    )
    valid = banded.weights[0].min(-1).reshape(pairs) > 0
    bands = compared_bands(np.where(valid[..., None], offsets, np.nan), offsets - residual, np.ones_like(valid))
    band_residuals, spread = np.nanmax(bands["residual"], 0), np.nanmean(bands["size"], 0)
    against, allowed = scene_reasons(start.curve, columns, by_pair=True)[0], np.maximum(_MAX_BAND_ERROR, 0.3 * spread)
    excess = band_residuals / allowed
    contradicted = {
        name: Reason("bands_contradict", name, float(band_residuals[axis]), float(allowed[axis]))
        for axis, name in enumerate(AXIS_NAMES[:2])
        if excess[axis] > 1.0
    }
    whole_motion = excess.max() > _MISMATCH
    return [
        [*against, *(reason for name, reason in contradicted.items() if whole_motion or name == axis)]
        for axis in AXIS_NAMES[:axes]
    ]


def _motion(fit: SplineFit, largest_drift: tuple[float, float] = (0.0, 0.0)) -> FreeMotion:
    """The spline as a batch of one motion; a drift by more than ``largest_drift`` px becomes its image motion."""
    coefficients, knots = tensor(fit.coefficients), tensor(fit.knots)
    centred = knots - knots.mean()
    speed = (coefficients * centred).sum(-1) / centred.square().sum()
    large = speed[:2].abs() * float(knots[-1] - knots[0]) > speed.new_tensor(largest_drift)
    speed = torch.where(functional.pad(large, (0, len(speed) - 2)), speed, 0.0)  # none of roll and zoom
    drift = Vibration(torch.zeros_like(speed)[None, :, None], 0.0, 0.0, speed[None])
    return FreeMotion((coefficients - speed[:, None] * knots)[None], fit.start, fit.spacing, drift)


# --- Uncertainty, and tones ---


@dataclass(frozen=True, eq=False)
class _Spread:
    """Standard deviations in px of a motion, in row order."""

    of_rows: Array  # (T, R, A) at the times of a report
    seen: Array  # (A,) of the motion of scene rows between frames
    unseen: Array  # (A,) of their mean over the frames

    @classmethod
    def of(cls, fit: SplineFit, measured: Measurements, times: Tensor) -> Self:
        """The standard deviations of a spline."""
        return cls(fit.std_at(table(times)), *fit.std_of_visible(measured))


# rms difference of the displacements of rows by tones from those by a spline, over their standard deviation. Of 240
# axes of random walks and smooth motions in five frames, tones were at least 2.0 apart, of 160 axes with the right
# tones at most 1.1
_MAX_DIFFERENCE = 1.3
# frames beyond the number of tones of an axis that may take the place of a spline: three tones agreed with a random
# walk in two frames and were wrong by 21 px, with a standard deviation of 0.1 px
_FRAMES_BESIDE = 2


def _with_tones(
    measured: Measurements,
    motion: FreeMotion,
    spread: _Spread,
    noise_std: Array,
    times: Tensor,
    timing: RowTiming,
    by_row_time: Array,
) -> tuple[FreeMotion, _Spread]:
    """The motion with tones in place of the spline, on axes whose rows they explain as well.

    The spline has a smooth power spectrum, in which a tone near a multiple of the frame rate, which the frames hardly
    show, is nearly missing. A few tones that agree with the same rows are the simpler explanation, and also determine
    the motion that all frames have in common. The spline is kept where the uncertainty of the tones exceeds their
    difference from it, and where so few frames agree with different tones. The difference then counts as its standard
    deviation.

    ``noise_std`` (A,) px are the standard deviations of the motion of rows between frames by noise, ``by_row_time`` (1,
    N, G, A) px the changes of the displacements by the standard deviation of the row time.
    """
    # 1. The tones of the rows.
    residual = residual_of_motion(measured, motion)
    interval = max(BLOCK_ROWS * timing.row_time, 0.5 * timing.exposure_time)
    rows = replace(measured, independent=measured.independent_fraction(residual))
    single = find_tones(rows, interval, 1)
    for _ in range(2):  # the other side of a multiple of the frame rate, and then of another multiple
        single = with_best_aliases(rows, single, large_size=0.0, max_share=1.0)
    fit = find_tones(rows, interval, start=single, least_gain=0.02)
    weighed = measured.weighed(residual_of(measured, fit))
    fit = fitted_again(weighed, fit)
    # 2. The axes on which they agree with the spline.
    deviation = (residual_of(measured, fit) - residual)[0][measured.visible[0] > 0]
    agree = fit.active[0].any(-1) & (np.sqrt(np.square(deviation).mean(0)) < _MAX_DIFFERENCE * noise_std)
    if not agree.any():
        return motion, spread
    # 3. Their standard deviation, with the allowance for a further one and for the row time.
    with_allowance = with_further_tones(weighed, fit, table(times).ravel() - 0.5 * weighed.exposure_time)[1]
    changed = replace(weighed, displacements=weighed.displacements + by_row_time)
    fits = fit, fit_tones(changed, fit, fit.active)
    before, after = (motion_of_fit(tones)[0].displacement(times) for tones in fits)
    change = table(after - before)
    tone_std = np.hypot(with_allowance.displacement_std[0], change - change.mean((0, 1)))
    # 4. The axes on which they are better.
    size = table(_with_tones_on(motion, fit, agree).displacement(times) - motion.displacement(times)).std((0, 1))
    tone_size, spline_size = (np.sqrt(np.square(values).mean((0, 1))) for values in (tone_std, spread.of_rows))
    replaced = agree & ((tone_size < spline_size) | (2 * tone_size < size))
    replaced &= fit.active[0].sum(-1) <= len(times) - _FRAMES_BESIDE
    # 5. The motion and its standard deviations.
    row_std = np.where(replaced, tone_std, np.hypot(spread.of_rows, size))
    unseen = np.where(replaced, tone_size, np.hypot(spread.unseen, size))
    return _with_tones_on(motion, fit, replaced), _Spread(row_std, spread.seen, unseen)


def _with_tones_on(motion: FreeMotion, fit: ToneFit, axes: NDArray[np.bool_]) -> FreeMotion:
    """The motion with tones and a straight line in place of the spline of some axes."""
    tones = motion_of_fit(replace(fit, active=fit.active & axes[:, None]))[0]
    knots, speed = motion.knots, motion.tones.image_motion
    line = (tones.image_motion - speed)[:, None] * (knots - knots.mean())
    coefficients = torch.where(torch.from_numpy(axes)[:, None], line, motion.coefficients)
    return FreeMotion(coefficients, motion.start, motion.spacing, replace(tones, image_motion=speed))


# --- Report ---


def _report(
    motion: FreeMotion,
    spread: _Spread,
    measured: Measurements,
    timing: SensorTiming,
    times: Tensor,
    scale: FieldScale,
    bands_reasons: list[list[Reason]],
    blur_reasons: list[Reason],
    strip_difference: Array,
) -> MotionDetection:
    """The motion in image axes, and its uncertainty at times (T, R) of rows of every frame.

    ``bands_reasons`` are the reasons of each axis from the row bands, ``blur_reasons`` those of all axes from the blur.
    ``strip_difference`` (2,) px is the rms difference of displacements along a row that the motion does not explain.
    """
    # 1. Standard deviations, with the motion that is too fast for the knots, which neither spline nor tones contain.
    value, residual = motion.displacement(times), residual_of_motion(measured, motion)
    value = value - value.mean((0, 1))
    sudden = tensor(_sudden_motion(measured, residual, table(times), motion.spacing))
    unseen, excess = tensor(spread.unseen), tensor(measured.unexplained(residual)[0])
    known_std = torch.hypot(tensor(spread.seen), sudden.square().mean((0, 1)).sqrt())
    std, std_seen = torch.hypot(tensor(spread.of_rows), torch.hypot(sudden, excess)), torch.hypot(known_std, excess)
    # 2. The verdict.
    rms = (value - value.mean(0)).square().mean((0, 1)).sqrt()
    nearly_blind = _nearly_blind(motion, times, timing)
    findings = []
    for axis, name in enumerate(AXIS_NAMES[: scale.axes]):
        against, residual_of_axis = list(bands_reasons[axis]), float(excess[axis])
        allowed = max(0.15 * float(rms[axis]), 0.03)  # px
        if residual_of_axis > allowed:
            against.insert(0, Reason("motion_unexplained", name, residual_of_axis, allowed))
        size = math.sqrt(2) * float(rms[axis] if scale.axes == 2 else rms[:2].amax())
        against += rotation_reasons(axis, scale.axes, strip_difference.tolist(), size)
        if float(known_std[axis]) > _MAX_STD_SEEN:
            against.append(Reason("motion_uncertain", name, float(known_std[axis]), _MAX_STD_SEEN))
        displacement = float(value[..., axis].square().mean().sqrt())
        limit = _MOST_UNKNOWN * displacement if nearly_blind[axis] else max(displacement, _MAX_STD_SEEN)
        if float(unseen[axis]) > limit:
            against.append(Reason("common_motion_uncertain", name, float(unseen[axis]), limit))
        in_common, limit = float(value[..., axis].mean(0).square().mean().sqrt()), _MOST_IN_COMMON * float(rms[axis])
        if in_common > limit:
            against.append(Reason("common_motion_large", name, in_common, limit))
        findings.append((*against, *blur_reasons))
    # 3. From row order and px to image axes and units.
    reliable, units = torch.tensor([not against for against in findings], device=excess.device), scale.units(value)
    sizes = {"std": std, "std_seen": std_seen, "unseen": unseen, "unexplained": excess}
    return MotionDetection(
        motion=scale.free_motion(motion).from_row_order(timing),
        times=times,
        displacement=offsets_from_row_order(value * units, timing),
        **{name: magnitudes_from_row_order(values * units, timing) for name, values in sizes.items()},
        reliable=magnitudes_from_row_order(reliable, timing),
        findings=findings_from_row_order(findings, timing),
    )


_SAMPLES = 4096  # of a motion in its record, for the spectrum: 500 per frame of 8


def vibration_in_place_of(motion: FreeMotion, start: float, end: float) -> Vibration:
    """A tone that represents the motion of each axis between two times in s.

    The amplitude is that of a tone with the same rms displacement from a straight line. Frequency and phase are those
    of the largest part of the motion.
    """
    # 1. The motion, less a straight line.
    times = torch.linspace(start, end, _SAMPLES, dtype=torch.float64, device=motion.coefficients.device)
    displacement = motion.displacement(times)
    centred = (times - times.mean())[:, None]
    speed = (displacement * centred).sum(0) / centred.square().sum()
    displacement = displacement - displacement.mean(0) - speed * centred
    # 2. Its size, and the largest part of its spectrum.
    window = torch.hann_window(_SAMPLES, dtype=torch.float64, device=times.device)[:, None]
    spectrum = torch.fft.rfft(window * displacement, n=4 * _SAMPLES, dim=0)
    cycles = torch.fft.rfftfreq(4 * _SAMPLES, (end - start) / (_SAMPLES - 1), dtype=torch.float64, device=times.device)
    largest = 1 + spectrum[1:].abs().argmax(0, keepdim=True)
    frequency = cycles[largest].mT  # (A, 1)
    amplitude = math.sqrt(2) * displacement.square().mean(0)[:, None].sqrt()
    phase = spectrum.gather(0, largest).angle().mT + 0.5 * math.pi - 2 * math.pi * frequency * start
    return Vibration(amplitude, frequency, phase, image_motion=speed)


def _nearly_blind(motion: FreeMotion, times: Tensor, timing: SensorTiming) -> list[bool]:
    """Whether the largest part of each axis is near a multiple of the frame rate, which hides motions.

    Frames at unequal intervals have no frequencies in common that they do not show, except by chance.
    """
    if timing.frame_start_times is not None:
        return [False] * motion.num_axes
    cycles = vibration_in_place_of(motion, float(times.min()), float(times.max())).frequency[:, 0] * timing.frame_period
    return ((cycles.round() >= 1) & ((cycles - cycles.round()).abs() * len(times) < _NEARLY_BLIND)).tolist()


# of the median mean square of residuals within a knot interval; smaller ones are noise. Of steps of 2 and 6 px within
# 0.6 ms, and an impulse of 1.2 ms, the largest error was 6 to 7 standard deviations without this part, with it 4
_SUDDEN = 6.0


def _sudden_motion(measured: Measurements, residual: Array, times: Array, spacing: float) -> Array:
    """(T, R, A) px, rms residuals (1, N, G, A) within a ``spacing`` in s of times (T, R), where large; 0 elsewhere."""
    visible = measured.visible[0] > 0
    sample_times = (measured.exposure_starts[0] + 0.5 * measured.exposure_time)[visible]
    order = np.argsort(sample_times)
    squares = np.square(residual[0][visible][order])
    total = np.concatenate([np.zeros((1, squares.shape[-1])), np.cumsum(squares, 0)])
    begins, ends = (np.searchsorted(sample_times[order], times + side * spacing) for side in (-1.0, 1.0))
    local = (total[ends] - total[begins]) / np.maximum(ends - begins, 1)[..., None]
    return np.sqrt(np.where(local > _SUDDEN * np.median(local, (0, 1)), local, 0.0))
