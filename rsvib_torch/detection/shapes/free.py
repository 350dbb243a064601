"""Motion of any shape from consecutive frames, with what cannot be known of it."""

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from rsvib_torch.core.checks import check_whole_number
from rsvib_torch.core.precision import full_precision, outside_graphs
from rsvib_torch.detection.band_curve import band_curve, measurements_of_curve
from rsvib_torch.detection.grey_frames import GreyFrames, grey_frames
from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.rows.displacements import frame_groups, measure_groups, stack_spectra
from rsvib_torch.detection.shapes.spline_fit import SplineFit, fit_spline
from rsvib_torch.frames.arrays import ArrayLike
from rsvib_torch.frames.orientation import offsets_from_row_order
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import RowTiming, SensorTiming
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.registration import OffsetCurve, Registration, RegistrationOptions

__all__ = ["MotionDetection", "detect_motion", "start_curve"]

_MOST_KNOTS = 3000
_LOOKS = 32  # rows of a frame at which the motion is reported
_EXPLAINED = 0.15  # of the motion that rows may show beyond the fit
_FINEST = 0.03  # px, that never matters
_SURE = 0.3  # px
_LEAST_FOUND = 0.25  # of the row bands
_FAR = 0.25  # of the frame, from where on a steady motion is that of the image


@dataclass(frozen=True, eq=False)
class MotionDetection:
    """A motion of any shape, and how well it is known. A batch of stacks leads all tensors but ``times``.

    Rows tell how far they moved between frames. A warp that is fixed to the scene they do not tell: frames of a warped
    scene look the same, D(t) of the row that shows scene row s being larger by w(s) in every frame. For w the motion's
    own power at other frequencies decides, and ``std`` is larger than ``std_seen``. The mean over the record is never
    known, nor counted.

    Attributes:
        motion: The motion in image axes.
        times: (T, R) s, mid-exposures of rows spread over the frames.
        displacement: (..., T, R, 2) px, the motion there, less its mean over the record.
        std: (..., T, R, 2) px, standard deviation of that.
        std_seen: (..., 2) px, root mean square of the standard deviation of what rows tell: the displacement of the
            rows that show one scene row, less its mean over the frames.
        unseen: (..., 2) px, root mean square of the standard deviation of that mean: of the warp.
        unexplained: (..., 2) px, rms displacement of rows that the motion does not explain, beyond their noise.
        reliable: (..., 2) bool, whether the motion explains what the rows show.
        reasons: Why not, for each axis (x, y); a tuple of those for a batch.
    """

    motion: FreeMotion
    times: Tensor
    displacement: Tensor
    std: Tensor
    std_seen: Tensor
    unseen: Tensor
    unexplained: Tensor
    reliable: Tensor
    reasons: tuple[Any, ...]

    def __getitem__(self, index: int) -> "MotionDetection":
        """The result of one stack out of a batch."""
        rest = {name: getattr(self, name)[index] for name in self.__dataclass_fields__ if name != "times"}
        return replace(self, **rest)


@outside_graphs
@full_precision
@torch.no_grad()
def detect_motion(
    frames: ArrayLike,
    timing: SensorTiming,
    *,
    registration: Registration = "ncc",
    knot_rows: int = 24,
    iterations: int = 4,
    band_rows: int = 32,
    band_step: int = 16,
    search: int = 16,
    ignore: ArrayLike | None = None,
    full_scale: float | None = None,
) -> MotionDetection:
    """Detect a motion of any shape from consecutive frames: the free model.

    Row bands are registered between frames for a start. Then the frames are warped to the scene with the motion found
    so far, every block of rows tells what it still misses in each frame, and a spline in time is fitted to all
    of them. How smooth it is the data tell: a power spectrum is learned with up to 800 knots, one number beyond.

    Args:
        frames: Stack (T, H, W), (T, C, H, W) or (B, T, C, H, W) of at least two frames, tensor or NumPy array;
            floats, or integers of known full scale. NaN marks pixels that were not measured.
        timing: The sensor.
        registration: ``"ncc"``, ``"phase"`` or ``"projection"``, for the start.
        knot_rows: Rows read from one knot of the spline to the next: tones up to ``1 / (2 knot_rows T_row)`` fit in.
            Long stacks take more, so that there are 3000 knots at most.
        iterations: Rounds of measuring and fitting.
        band_rows: Rows of a band of the start.
        band_step: Rows from one band to the next.
        search: Search range of the start in px around the whole-frame offset.
        ignore: Bool, broadcastable to (..., H, W) of the frames: True for pixels to leave out (dead, saturated).
        full_scale: Count that means 1.0, for integer frames.

    Returns:
        The motion in image axes with its uncertainty over time.

    Raises:
        TypeError: If frames are not numbers.
        ValueError: If there are fewer than two frames, a frame is constant or has hardly a pixel that counts, the
            motion is beyond the search range, or an option is out of range.
    """
    check_whole_number("knot_rows", knot_rows, at_least=4)
    check_whole_number("iterations", iterations, at_least=1)
    stacks = grey_frames(frames, timing, full_scale, ignore)
    bands = RegistrationOptions(registration, band_rows, band_step, search)
    found = [_detect(stacks.one(i), timing, bands, knot_rows, iterations) for i in range(len(stacks.images))]
    return _stacked(found) if stacks.batched else found[0]


def _stacked(found: list[MotionDetection]) -> MotionDetection:
    """Results of stacks as one of a batch."""
    names = ("displacement", "std", "std_seen", "unseen", "unexplained", "reliable")
    return MotionDetection(
        motion=FreeMotion.stacked([one.motion for one in found]),
        times=found[0].times,
        reasons=tuple(one.reasons for one in found),
        **{name: torch.stack([getattr(one, name) for one in found]) for name in names},
    )


def _detect(
    stack: GreyFrames, timing: SensorTiming, bands: RegistrationOptions, knot_rows: int, iterations: int
) -> MotionDetection:
    """``detect_motion`` of one stack."""
    grey, valid = stack.images, stack.valid
    rowwise, curve, record = start_curve(stack, timing, bands)
    starts = rowwise.frame_starts(grey.shape[1], grey.device)
    spacing = max(knot_rows * rowwise.row_time, (record[1] - record[0]) / _MOST_KNOTS)
    size = (grey.shape[-2], grey.shape[-1])
    measured = measurements_of_curve(curve, rowwise, bands.band_step)
    fit = fit_spline(measured, max(spacing, 0.5 * bands.band_rows * rowwise.row_time), record)
    motion = _motion(fit, size, 0.0)
    groups = frame_groups(stack_spectra(grey, valid), rowwise, motion)
    for step in range(iterations):
        measured, _ = measure_groups(groups, rowwise, motion)
        if step:  # blocks that show something that moves by itself have less say
            measured = measured.reweighted(_left(measured, motion))
        fit = fit_spline(measured, spacing, record)
        motion = _motion(fit, size, 0.0)  # groups follow the image as it moves on
    left = _left(measured, motion)
    weighed = measured.reweighted(left)
    share = weighed.independent_fraction(left) * measured.share_counted(left)
    fit = fit_spline(replace(weighed, independent=share), spacing, record, learn=True)
    motion = _motion(fit, size, _FAR)
    return _report(motion, fit, measured, _left(measured, motion), timing, starts, size[0])


def start_curve(
    stack: GreyFrames, timing: SensorTiming, bands: RegistrationOptions
) -> tuple[RowTiming, OffsetCurve, tuple[float, float]]:
    """Timing in row order, the offsets of the row bands of one stack, start and end of the record.

    Raises:
        ValueError: If the frames do not fit the timing, or hardly a band is found.
    """
    frames = stack.images
    rowwise = timing.in_row_order()
    rowwise.check_rows(frames.shape[-2])
    curve = band_curve(frames, stack.valid, rowwise, bands, mere_start=True)
    found = float(curve.good.double().mean())
    if found < _LEAST_FOUND:
        raise ValueError(
            f"only {found:.0%} of the row bands are found in the next frame: the motion is beyond "
            f"search={bands.search} px within a frame, or the frames show different scenes"
        )
    starts = rowwise.frame_starts(frames.shape[1])
    end = float(starts[-1]) + frames.shape[-2] * rowwise.row_time + rowwise.exposure_time
    return rowwise, curve, (float(starts[0]), end)


def _left(measured: Measurements, motion: FreeMotion) -> Tensor:
    """What a motion leaves of the displacements (1, N, G, 2)."""
    one = FreeMotion(motion.coefficients[0], motion.start, motion.spacing, motion.tones[0])
    predicted = one.mean_displacement(measured.moments, measured.exposure_time)
    return measured.relative(measured.displacements - predicted)


def _motion(fit: SplineFit, size: tuple[int, int], far: float) -> FreeMotion:
    """The spline as a motion that is a batch of one; an image motion of ``far`` frames in the record is told apart."""
    knots = fit.knots
    apart = knots - knots.mean()
    speed = (fit.coefficients * apart).sum(-1) / apart.square().sum()
    extent = torch.tensor([size[1], size[0]], dtype=torch.float64, device=knots.device)
    speed = torch.where(speed.abs() * float(knots[-1] - knots[0]) > far * extent, speed, 0.0)
    drift = Vibration(torch.zeros_like(speed)[None, :, None], 0.0, 0.0, speed[None])
    return FreeMotion((fit.coefficients - speed[:, None] * knots)[None], fit.start, fit.spacing, drift)


def _variance(columns: Tensor, covariance: Tensor) -> Tensor:
    """Variances (S,) of what columns (S, N) make of coefficients of this covariance."""
    return ((columns @ covariance) * columns).sum(-1).clamp(min=0.0)


def _told_and_common(fit: SplineFit, moments: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
    """Columns (S, N) of what the frames (N, G) that see a row of the scene tell of it, and (R, N) of their mean."""
    several = seen.sum(-1) > 1
    seen = seen[several]
    columns = fit.columns(moments[several].flatten()).unflatten(0, seen.shape)
    mean = (seen[..., None] * columns).sum(1) / seen.sum(-1)[:, None]
    return (columns - mean[:, None])[seen > 0], mean


def _report(
    motion: FreeMotion,
    fit: SplineFit,
    measured: Measurements,
    left: Tensor,
    timing: SensorTiming,
    starts: Tensor,
    num_rows: int,
) -> MotionDetection:
    """The motion in image axes and how well it is known at some rows of every frame."""
    rows = torch.linspace(0, num_rows - 1, min(_LOOKS, num_rows), dtype=torch.float64, device=starts.device)
    times = starts[:, None] + rows * timing.row_time + 0.5 * timing.exposure_time
    moments = measured.moments[0] + 0.5 * measured.exposure_time
    stds, seen, unseen = [], [], []
    for axis in range(2):
        columns = fit.columns(times.flatten())
        centred = columns - columns.mean(0)
        stds.append(_variance(centred, fit.covariance[axis]).sqrt().unflatten(0, times.shape))
        told, common = _told_and_common(fit, moments, measured.seen[0])
        seen.append(_variance(told, fit.covariance[axis]).mean().sqrt())
        unseen.append(_variance(common - columns.mean(0), fit.covariance[axis]).mean().sqrt())
    beside = measured.unexplained(left)[0]
    value = motion[0].displacement(times)
    value = value - value.mean((0, 1))
    relative = (value - value.mean(0)).square().mean((0, 1)).sqrt()
    reasons = []
    for axis in range(2):
        much, sure, moved = float(beside[axis]), float(seen[axis]), float(relative[axis])
        found = []
        if much > max(_EXPLAINED * moved, _FINEST):
            found.append(f"rows move by {much:.3g} px that no smooth motion explains")
        if sure > _SURE:
            found.append(f"rows tell the motion to {sure:.3g} px only: they may show different scenes")
        reasons.append(tuple(found))
    reliable = torch.tensor([not found for found in reasons], device=beside.device)
    swap = timing.scan_axis == -1
    per_axis = [torch.stack(values, -1) for values in (stds, seen, unseen)]
    per_axis += [beside, reliable]
    spread, seen_std, unseen_std, rest, good = ((v.flip(-1) if swap else v) for v in per_axis)
    return MotionDetection(
        motion=motion[0].from_row_order(timing),
        times=times,
        displacement=offsets_from_row_order(value, timing),
        std=spread,
        std_seen=seen_std,
        unseen=unseen_std,
        unexplained=rest,
        reliable=good,
        reasons=(reasons[1], reasons[0]) if swap else (reasons[0], reasons[1]),
    )
