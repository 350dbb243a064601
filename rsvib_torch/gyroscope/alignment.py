"""A motion that another instrument recorded: alignment with the clock of the frames.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ParamSpec, Protocol, overload

import numpy as np
import torch
from torch import Tensor

from rsvib_torch.checks.arguments import FramesOrFiles
from rsvib_torch.checks.values import check_single
from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.rows.grouped_frames import grouped_frames
from rsvib_torch.detection.shapes.free import record_of, residual_of_motion, rms_motion, start_of_stack
from rsvib_torch.detection.verdict import recording_reasons
from rsvib_torch.execution.parallel import full_precision, without_gradients
from rsvib_torch.frames.entry_points import entry_point
from rsvib_torch.frames.prepare import (
    frames_from_row_order,
    grey_frames,
    magnitudes_from_row_order,
    offsets_from_row_order,
    reasons_from_row_order,
)
from rsvib_torch.gyroscope.corner_tracks import corner_tracks
from rsvib_torch.gyroscope.gyroscope_rates import AngularRates
from rsvib_torch.gyroscope.rotation_alignment import AlignOptions, RotationAlignment, align_rates, offset_range, outside
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.numerics.tables import Array, scaled_inverse, table, tensor
from rsvib_torch.results.presentation import JudgedResult
from rsvib_torch.results.reason import Reason
from rsvib_torch.text import measured_text, wrapped

P = ParamSpec("P")


@dataclass(frozen=True, eq=False, repr=False)
class ClockAlignment(
    JudgedResult,
    units={"offset": "s", "offset_std": "s", "drift": "px/s", "unexplained": "px"},
    shapes={"drift": "2", "unexplained": "2"},
):
    """Time of the frames within a recorded motion: ``scale t + offset`` on its clock.

    Attributes:
        motion: The motion in image axes on the clock of the frames, with drift.
        offset: Reading of the recording's clock at time 0 of the frames, in seconds.
        offset_std: Its standard deviation.
        scale: Seconds on the recording's clock per second of the frames.
        scale_std: Its standard deviation; 0 if it was not fitted.
        drift: (2,) px/s that the recording does not contain, as gyroscopes drift.
        unexplained: (2,) px, rms displacement of rows that the aligned motion does not explain, beyond their noise.
        reliable: Whether the recording explains the measurements, at this offset only.
        findings: Each ``Reason`` why not; ``reasons`` has their texts.
    """

    motion: FreeMotion
    offset: float
    offset_std: float
    scale: float
    scale_std: float
    drift: Tensor
    unexplained: Tensor
    reliable: bool
    findings: tuple[Reason, ...]

    def summary(self) -> str:
        """Offset and scale of the clock with standard deviations, drift, and the verdict."""
        verdict = "reliable" if self.reliable else f"not reliable: {'; '.join(self.reasons)}"
        drift, left = self.drift.tolist(), self.unexplained.tolist()
        second = measured_text(self.scale, self.scale_std or None, digits=8)
        clock = [
            f"time 0 of the frames is {measured_text(self.offset, self.offset_std)} s of the recording",
            f"1 s of the frames is {second} s of the recording",
        ]
        axes = [f"{name}: drift {drift[k]:.3g} px/s, {left[k]:.2g} px unexplained" for k, name in enumerate("xy")]
        return "\n".join([*clock, *axes, wrapped(verdict)])


@dataclass(frozen=True)
class FittedClock:
    """Parameters of the fit; ``at`` is the reading of the recording's clock at time ``middle`` of the frames."""

    at: float
    scale: float
    drift: tuple[float, float]
    middle: float

    @property
    def offset(self) -> float:
        """Reading of the recording's clock at time 0 of the frames, in seconds."""
        return self.at - self.scale * self.middle

    def motion(self, recorded: FreeMotion) -> FreeMotion:
        """The recorded motion on the clock of the frames."""
        moved = recorded.retimed(self.offset, self.scale)
        knots = moved.knots - self.middle
        drift = knots.new_tensor(self.drift)[:, None] * knots
        return FreeMotion(moved.coefficients + drift, moved.start, moved.spacing, moved.tones, moved.camera)


class _AlignsMotion(Protocol[P]):
    """Type of ``align_motion``."""

    @overload
    def __call__(
        self, frames: FramesOrFiles, timing: SensorTiming, recorded: FreeMotion, *args: P.args, **kwargs: P.kwargs
    ) -> ClockAlignment: ...
    @overload
    def __call__(
        self, frames: FramesOrFiles, timing: SensorTiming, recorded: AngularRates, *args: P.args, **kwargs: P.kwargs
    ) -> RotationAlignment: ...


def _align_options(options: Callable[P, AlignOptions]) -> Callable[[Callable[..., object]], _AlignsMotion[P]]:
    return lambda function: entry_point(options, function)


@_align_options(AlignOptions)
@full_precision
@without_gradients
def align_motion(
    frames: FramesOrFiles, timing: SensorTiming, recorded: FreeMotion | AngularRates, options: AlignOptions
) -> ClockAlignment | RotationAlignment:
    """Find offset and scale between the clock of a recorded motion and that of the frames.

    The recording (of a gyroscope, of attitude sensors) is compared with the displacements of the rows between frames:
    first at many offsets with those of row bands, then by least squares with those measured on the images around it. A
    uniform drift of each axis is fitted as well.

    **Angular rates** (``read_gyroscope``). Corners are followed between consecutive frames, and compared with the
    rotation of the camera between the exposures of their rows, for all 24 assignments of the axes and all offsets.
    Bias, clock and, without a camera, the focal length are fitted. Robust weights exclude what moves by itself or is
    fixed to the camera. Every pair of frames has a translation of its own: if the scene has parallax, only
    displacements across its lines (epipolar lines) determine the rotation.

    Args:
        frames: Stack (T, H, W) or (T, C, H, W) of at least two frames; tensor, array, list of these, or files; NaN
            marks missing pixels.
        timing: The sensor.
        recorded: The motion on its own clock, in image axes; or the rates of a gyroscope.
        options: Options.

    Returns:
        The motion on the clock of the frames, offset and scale with standard deviations, and a verdict.

    Raises:
        TypeError: If frames are not numbers, or the recording is neither a motion nor angular rates.
        ValueError: If the recording is shorter than the frames or does not cover them at any offset in ``offsets``,
            frames cannot be registered, or an option is out of range.

    Example:
        >>> import torch
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import city_and_fields
        >>> timing = rsv.SensorTiming(row_time=40e-6, exposure_rows=20, frame_rows=300)
        >>> times = torch.linspace(0.0, 0.05, 51, dtype=torch.float64)
        >>> path = torch.stack([1.5 * torch.sin(700 * times), 1.1 * torch.sin(500 * times)], -1)  # px
        >>> motion = rsv.FreeMotion.from_samples(times, path)
        >>> frames = rsv.simulate_frames(city_and_fields(260, 220, seed=3), timing, motion, num_frames=3)
        >>> late = rsv.FreeMotion.from_samples(times + 0.002, path)  # a gyroscope whose clock is 2 ms ahead
        >>> found = rsv.align_motion(frames, timing, late, offsets=(-0.004, 0.004))
        >>> round(1e3 * found.offset, 2)  # ms
        2.0
    """
    if not isinstance(recorded, (FreeMotion, AngularRates)):
        raise TypeError(
            "recorded must be a FreeMotion (read_motion, FreeMotion.from_samples) or AngularRates (read_gyroscope), "
            f"got {type(recorded).__name__}"
        )
    if isinstance(recorded, FreeMotion):
        check_single("recorded", recorded.batch_shape)
    if isinstance(recorded, FreeMotion) and (options.camera is not None or options.fit_row_time):
        raise ValueError("camera and fit_row_time are for angular rates (read_gyroscope); omit them for a FreeMotion")
    stack = grey_frames(frames, timing, options)
    timing = stack.timing
    if stack.batched:
        raise ValueError(f"align_motion takes one stack, got a batch of {len(stack.images)}")
    grey = stack.images
    if isinstance(recorded, AngularRates):
        images = frames_from_row_order(grey[0], timing)
        masks = [None] * len(images) if stack.valid is None else frames_from_row_order(stack.valid[0], timing)
        starts = timing.in_row_order().frame_starts(len(images)).tolist()
        tracks = corner_tracks(zip(range(len(images)), images, masks, strict=True), starts, timing)
        return align_rates(tracks, timing, recorded, options)
    rowwise, start = start_of_stack(stack, timing, options)
    measured, (first, last) = start.measurements, record_of(stack, rowwise)
    turned = recorded.to_row_order(timing).to("cpu")
    low, high = offset_range(turned.start, turned.end, first, last, options.offsets)
    offset, other = best_offset(measured, turned, low, high, rowwise)
    clock = FittedClock(offset + 0.5 * (first + last), 1.0, (0.0, 0.0), 0.5 * (first + last))
    clock, _ = fit_clock(measured, turned, clock, False)
    weighed = measured.reweighted(residual_of_motion(measured, clock.motion(turned)))
    clock, covariance = fit_clock(weighed, turned, clock, options.fit_scale)
    rows = grouped_frames(grey, stack.valid, rowwise, clock.motion(turned).expanded(1).to(grey.device))
    for _ in range(3):
        moved = clock.motion(turned).expanded(1).to(grey.device)
        measured = rows.measure(moved, keep_images=False).measurements
        weighed = measured.reweighted(residual_of_motion(measured, clock.motion(turned)))
        clock, covariance = fit_clock(weighed, turned, clock, options.fit_scale)
    aligned = clock.motion(turned)
    residual = residual_of_motion(measured, aligned)
    covariance = covariance / measured.independent_fraction(residual)
    std = np.sqrt(np.maximum(covariance.diagonal(), 0.0))
    gradient = np.array([1.0, -clock.middle])  # offset = at - scale * middle
    offset_std = float(np.sqrt(np.maximum(gradient @ covariance[:2, :2] @ gradient, 0.0)))
    rest = measured.unexplained(residual)[0]
    reasons = recording_reasons(rms_motion(measured, aligned).tolist(), rest.tolist(), other)
    reasons += outside(clock.offset, offset_std, options.offsets)
    drift = offsets_from_row_order(torch.tensor(clock.drift, dtype=torch.float64, device="cpu"), timing)
    in_image = replace(clock, drift=(float(drift[0]), float(drift[1])))
    return ClockAlignment(
        motion=in_image.motion(recorded),
        offset=clock.offset,
        offset_std=offset_std,
        scale=clock.scale,
        scale_std=float(std[1]),
        drift=drift,
        unexplained=magnitudes_from_row_order(tensor(rest), timing).to(grey.device),
        reliable=not reasons,
        findings=reasons_from_row_order(reasons, timing),
    )


def best_offset(
    measured: Measurements, recorded: FreeMotion, low: float, high: float, timing: SensorTiming
) -> tuple[float, float | None]:
    """The offset of the least residual, with a free drift, and another local minimum below twice the least square."""
    every = max(1, measured.exposure_starts.shape[1] // 400)  # 400 scene rows are enough for a start
    rows = measured.of_rows(np.flatnonzero((measured.weights[0] > 0).all(-1))[::every])
    starts = rows.exposure_starts + 0.5 * rows.exposure_time
    weight = rows.weights[:, :, None] * rows.visible[..., None]
    drift = rows.relative(np.repeat(starts[..., None], 2, -1))
    norm = (weight * np.square(drift)).sum((1, 2)).clip(min=1e-300)
    step = max(0.5 * recorded.spacing, 4 * timing.row_time, (high - low) / 20000)  # at most 20,000 offsets
    grid = np.linspace(low, high, max(2, math.ceil((high - low) / step) + 1))
    costs = []
    for part in np.split(grid, range(128, len(grid), 128)):  # (128, N, G, 2) values at a time
        moved = table(recorded.displacement(tensor(part[:, None, None] + starts)))
        residual = rows.displacements * rows.visible[..., None] - rows.relative(moved)
        along = (weight * drift * residual).sum((1, 2)) / norm
        # both axes together, as one of them may be at rest; without the largest fifth: clouds
        size = (weight * np.square(residual - along[:, None, None] * drift)).sum(-1).reshape(len(part), -1)
        costs.append(np.sort(size)[:, : math.ceil(0.8 * size.shape[-1])].sum(-1))
    cost = np.concatenate(costs)
    best, padded = int(cost.argmin()), np.pad(cost, 1, constant_values=math.inf)
    valleys = (cost <= padded[:-2]) & (cost <= padded[2:]) & (cost < 2.0 * cost[best] + 1e-300)
    valleys[best] = False
    others = np.flatnonzero(valleys)
    return float(grid[best]), float(grid[others[cost[others].argmin()]]) if len(others) else None


def fit_clock(
    measured: Measurements, recorded: FreeMotion, clock: FittedClock, fit_scale: bool
) -> tuple[FittedClock, Array]:
    """Gauss-Newton on clock reading, scale and drift, from start values; also their covariance (4, 4)."""
    starts = measured.exposure_starts
    free = np.array([True, fit_scale, True, True])
    for _ in range(12):
        # 1. Velocity of the recording at the measured rows.
        middle = starts + 0.5 * measured.exposure_time - clock.middle
        in_time = recorded.retimed(clock.offset, clock.scale)
        speed = table(in_time.velocity(tensor(starts + 0.5 * measured.exposure_time))) / clock.scale
        # 2. Derivatives (1, N, G, 2, 4) of the displacements by the parameters.
        x, y = np.eye(2)
        middle = middle[..., None]
        columns = [speed, speed * middle, middle * x, middle * y]
        jacobian = measured.relative(np.stack(columns, -1)) * free
        # 3. The normal equations and the step.
        residual = residual_of_motion(measured, clock.motion(recorded))
        weighted = np.einsum("bnac,bngcq->bngaq", measured.information, jacobian)
        gram = np.einsum("bngap,bngaq->pq", jacobian, weighted)
        right = np.einsum("bngap,bnga->p", weighted, residual)
        inverse = scaled_inverse(gram)
        change = inverse @ right
        known = max(float(measured.num_measurements.sum()), 8.0) - free.sum()
        covariance = inverse * (measured.square(residual).sum() / known)
        at, speed_of_clock, *drift = (np.array([clock.at, clock.scale, *clock.drift]) + change).tolist()
        clock = FittedClock(at, max(speed_of_clock, 0.1 * clock.scale), (drift[0], drift[1]), clock.middle)
        if (np.abs(change) <= 1e-3 * np.sqrt(np.maximum(covariance.diagonal(), 0.0))).all():
            break
    return clock, covariance
