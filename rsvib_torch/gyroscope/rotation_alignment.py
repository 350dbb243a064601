"""Alignment of the angular rates of a gyroscope with frames: clock, axes, bias, focal length, row time."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ParamSpec, Protocol

import torch
from pydantic import Field
from torch import Tensor

from rsvib_torch.checks.arguments import FramesOrFiles
from rsvib_torch.checks.values import Number, check_number
from rsvib_torch.checks.values import options as option_group
from rsvib_torch.detection.verdict import recording_reasons
from rsvib_torch.execution.parallel import full_precision, without_gradients
from rsvib_torch.frames.entry_points import entry_point
from rsvib_torch.frames.prepare import frames_from_row_order, grey_frames
from rsvib_torch.gyroscope.corner_tracks import CornerTracks, corner_tracks
from rsvib_torch.gyroscope.gyroscope_rates import AngularRates, orientation_matrix
from rsvib_torch.gyroscope.rotation_fit import RotationFit, RotationModel, fit_robustly, image_components
from rsvib_torch.gyroscope.rotation_search import Start, search_orientations
from rsvib_torch.motion.camera import Camera
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.options import MaskedInputOptions
from rsvib_torch.results.presentation import JudgedResult
from rsvib_torch.results.reason import Reason
from rsvib_torch.text import measured_text, text_table, wrapped

P = ParamSpec("P")

_CERTAIN = 25.0  # chi-square by which other axes or offsets fit worse: 5 standard deviations of one parameter
_MAX_COST, _MOST_OTHERS = 4.0, 5  # starts that are worse by this factor in the search, and further ones, are not fitted
_MAX_FOCAL_LENGTH_STD, _MAX_ROW_TIME_STD = 0.05, 0.2  # of the value; less accurate ones are not determined
# longer sides of the frames: of a fisheye lens, and of 1000 mm on film. Rates in degrees per second for rad/s fitted
# reliably with 180 for 3.1
_FOCAL_LENGTHS = (0.15, 30.0)


@dataclass(frozen=True, eq=False, repr=False)
class RotationAlignment(
    JudgedResult,
    units={
        **dict.fromkeys(("offset", "offset_std", "row_time", "row_time_std", "times"), "s"),
        **dict.fromkeys(("bias", "bias_std"), "rad/s"),
        **dict.fromkeys(("focal_length", "focal_length_std", "corner_std"), "px"),
    },
    shapes={
        **dict.fromkeys(("bias", "bias_std", "unexplained"), "3"),
        **dict.fromkeys(("translation", "measured", "predicted"), "P 3"),
        "times": "P",
    },
):
    """The motion of the image by the rotation that a gyroscope recorded. Its clock reads ``scale t + offset``.

    Attributes:
        motion: X and Y in px and roll in rad in image axes on the clock of the frames, with the camera.
        orientation: Axes of the gyroscope that are the axes x (right), y (down) and z (forward) of the camera, a small
            letter for a negative axis: with "yxZ", the camera turns about its x axis by minus the rate about y.
        offset: Reading of the gyroscope's clock at time 0 of the frames, in seconds.
        offset_std: Its standard deviation.
        scale: Seconds on the gyroscope's clock per second of the frames.
        scale_std: Its standard deviation; 0 if it was not fitted.
        bias: (3,) rad/s about the axes of the gyroscope, to be subtracted from its rates.
        bias_std: Their standard deviations.
        focal_length: px.
        focal_length_std: Its standard deviation; 0 if it was not fitted.
        row_time: s.
        row_time_std: Its standard deviation; 0 if it was not fitted.
        translation: (P, 3) translation of the camera between consecutive frames over the mean distance of the content,
            camera axes.
        unexplained: (3,) px, px, rad: standard deviation of X, Y and roll from frame to frame that the gyroscope does
            not explain, beyond the noise of the measurements.
        corner_std: px, standard deviation of the place of a corner across the line of its parallax.
        times: (P,) s, mid-times of consecutive frames.
        measured: (P, 3) px, px, rad: X, Y and roll between consecutive frames, from the images.
        predicted: (P, 3) The same by the gyroscope.
        reliable: Whether the gyroscope explains the frames, with this clock and these axes only.
        findings: Each ``Reason`` why not; ``reasons`` has their texts.

    Example:
        >>> import torch
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import city_and_fields
        >>> timing = rsv.SensorTiming(row_time=80e-6, exposure_rows=10, frame_rows=420)
        >>> times = torch.arange(-0.02, 0.12, 0.001, dtype=torch.float64)
        >>> angles = [5e-3 * torch.sin(50 * times), 4e-3 * torch.sin(70 * times + 1), 6e-3 * torch.sin(45 * times + 2)]
        >>> pitch, yaw, roll = angles  # rad, of the camera
        >>> path = torch.stack([-400 * yaw, 400 * pitch, -roll], -1)
        >>> motion = rsv.FreeMotion.from_samples(times, path, camera=rsv.Camera(400.0))
        >>> frames = rsv.simulate_frames(city_and_fields(224, 240, seed=2), timing, motion, num_frames=3)
        >>> turned = torch.stack([roll, pitch, yaw], -1)  # the gyroscope is mounted in another direction
        >>> rates = rsv.AngularRates(times[1:-1] + 0.5, (turned[2:] - turned[:-2]) / 0.002)
        >>> found = rsv.align_motion(frames, timing, rates)
        >>> found.orientation, round(found.offset, 3), round(found.focal_length / 10)
        ('YZX', 0.5, 40)
    """

    motion: FreeMotion
    orientation: str
    offset: float
    offset_std: float
    scale: float
    scale_std: float
    bias: Tensor
    bias_std: Tensor
    focal_length: float
    focal_length_std: float
    row_time: float
    row_time_std: float
    translation: Tensor
    unexplained: Tensor
    corner_std: float
    times: Tensor
    measured: Tensor
    predicted: Tensor
    reliable: bool
    findings: tuple[Reason, ...]

    def summary(self) -> str:
        """Clock, axes, bias and focal length with standard deviations, what is not explained, and the verdict."""
        second = measured_text(self.scale, self.scale_std or None, digits=8)
        axes = [letter.lower() if letter.isupper() else f"-{letter}" for letter in self.orientation]
        verdict = "reliable" if self.reliable else f"not reliable: {'; '.join(self.reasons)}"
        bias, std = self.bias.tolist(), self.bias_std.tolist()
        motion, residual = (self.predicted - self.predicted.mean(0)).square().mean(0).sqrt(), self.unexplained
        names = ("X (px)", "Y (px)", "roll (rad)")
        return "\n".join(
            [
                f"time 0 of the frames is {measured_text(self.offset, self.offset_std)} s of the gyroscope",
                f"1 s of the frames is {second} s of the gyroscope",
                f"axes x, y, z of the camera are {', '.join(axes)} of the gyroscope",
                f"bias {', '.join(measured_text(b, s) for b, s in zip(bias, std, strict=True))} rad/s, focal length "
                f"{measured_text(self.focal_length, self.focal_length_std or None)} px, row time "
                f"{measured_text(1e6 * self.row_time, 1e6 * self.row_time_std or None)} us",
                text_table(
                    ["between frames", "by the gyroscope (rms)", "not explained"],
                    [[names[k], measured_text(motion[k]), measured_text(residual[k], digits=2)] for k in range(3)],
                ),
                wrapped(verdict),
            ]
        )


@option_group
class AlignOptions(MaskedInputOptions):
    """Options of ``align_motion``."""

    camera: Camera | None = None
    """Focal length and lens, for angular rates; by default the focal length is fitted."""
    offsets: tuple[Number, Number] | None = Field(default=None, strict=False)
    """Smallest and largest offset in seconds; by default all for which the recording covers the frames. A result
    outside them is refused."""
    fit_scale: bool = True
    """Whether to fit the ratio of the speeds of the clocks."""
    fit_row_time: bool = False
    """Whether to fit the row time as well, with angular rates; ``timing`` has the start value."""


class _AlignsMotion(Protocol[P]):
    """Type of ``align_motion``."""

    def __call__(
        self, frames: FramesOrFiles, timing: SensorTiming, recorded: AngularRates, *args: P.args, **kwargs: P.kwargs
    ) -> RotationAlignment:
        """Call the function."""


def _align_options(
    options: Callable[P, AlignOptions],
) -> Callable[[Callable[..., RotationAlignment]], _AlignsMotion[P]]:
    return lambda function: entry_point(options, function)


@_align_options(AlignOptions)
@full_precision
@without_gradients
def align_motion(
    frames: FramesOrFiles, timing: SensorTiming, recorded: AngularRates, options: AlignOptions
) -> RotationAlignment:
    """Find offset and scale between the clock of a gyroscope and that of the frames, and the axes of the gyroscope.

    Corners are followed between consecutive frames, and compared with the rotation of the camera between the exposures
    of their rows, for all 24 assignments of the axes and all offsets. Bias, clock and, without a camera, the focal
    length are fitted. Robust weights exclude what moves by itself or is fixed to the camera. Every pair of frames has a
    translation of its own: if the scene has parallax, only displacements across its lines (epipolar lines) determine
    the rotation.

    Args:
        frames: Stack (T, H, W) or (T, C, H, W) of at least two frames; tensor, array, list of these, or files; NaN
            marks missing pixels.
        timing: The sensor.
        recorded: The rates of the gyroscope on its own clock.
        options: Options.

    Returns:
        The motion on the clock of the frames, offset and scale with standard deviations, and a verdict.

    Raises:
        TypeError: If frames are not numbers, or the recording is no angular rates.
        ValueError: If the recording is shorter than the frames or does not cover them at any offset in ``offsets``,
            frames have too few corners, or an option is out of range.

    Example:
        See ``RotationAlignment``.
    """
    if not isinstance(recorded, AngularRates):
        raise TypeError(
            f"recorded must be AngularRates (read_gyroscope), got {type(recorded).__name__}; the clock of a motion in "
            "px is set by FreeMotion.retimed"
        )
    stack = grey_frames(frames, timing, options)
    timing = stack.timing
    if stack.batched:
        raise ValueError(f"align_motion takes one stack, got a batch of {len(stack.images)}")
    images = frames_from_row_order(stack.images[0], timing)
    masks = [None] * len(images) if stack.valid is None else frames_from_row_order(stack.valid[0], timing)
    starts = timing.in_row_order().frame_starts(len(images)).tolist()
    tracks = corner_tracks(zip(range(len(images)), images, masks, strict=True), starts, timing)
    with torch.device("cpu"):  # also where another device is the default of PyTorch
        return align_rates(tracks, timing, recorded, options)


def align_rates(
    tracks: CornerTracks, timing: SensorTiming, rates: AngularRates, options: AlignOptions
) -> RotationAlignment:
    """``align_motion`` from the corners of pairs of frames."""
    camera, offsets = options.camera, options.offsets
    if camera is not None:
        camera.check_size(tracks.size[1], tracks.size[0])
    rows = tracks.size[int(timing.scan_axis)]
    begin, last = float(tracks.starts[0, 0]), float(tracks.starts[-1, 1])
    last += rows * timing.row_time + timing.exposure_time
    # The offsets at which the recording covers the frames.
    low, high = rates.start - begin, rates.end - last
    if high < low:
        raise ValueError(
            f"the recording of {rates.end - rates.start:.7g} s is shorter than the frames, which take "
            f"{last - begin:.7g} s with their readout; use fewer frames, or check the unit of its times"
        )
    limits = low, high
    if offsets is not None:
        least, most = (check_number("offsets", limit) for limit in offsets)
        limits = max(low, least), min(high, most)
        if most < least or limits[1] < limits[0]:
            raise ValueError(
                f"offsets {least:g} to {most:g} s: the recording covers the frames from {low:.6g} to {high:.6g} s"
            )
    middle = 0.5 * (begin + last)
    free = (True, True, True, True, options.fit_scale, camera is None, options.fit_row_time)

    def parameters(start: Start, row_time: float) -> Tensor:
        values = [0.0, 0.0, 0.0, start.offset + middle, 1.0, start.focal_length, row_time]
        return torch.tensor(values, dtype=torch.float64)

    # 1. Axes and offsets that explain the displacements best, and the fit from there with the smallest residuals.
    (first, *_), _, _ = search_orientations(tracks, tracks.roughly(), rates, timing.row_time, limits, camera)
    lens = camera or Camera(first.focal_length)
    model = RotationModel(tracks, rates, first.orientation, lens, middle, free)
    fit = fit_robustly(model, parameters(first, timing.row_time))

    # 2. What does not follow the gyroscope has no weight in a second search, and parallax little.
    row_time = float(fit.parameters[6])
    lens = replace(lens, focal_length=float(fit.parameters[5]))
    starts, other_offsets, mirrored = search_orientations(tracks, fit.information(), rates, row_time, limits, lens)
    best = starts[0]
    if best.orientation != first.orientation or abs(best.offset - first.offset) > 5 / rates.sample_rate:
        model = replace(model, orientation=best.orientation)
        fit = fit_robustly(model, parameters(best, timing.row_time))

    # 3. Other axes and offsets that explain the frames as well.
    def explains(start: Start) -> bool:
        near = start.cost < _MAX_COST * best.cost
        return near and fit.significance(start.orientation, parameters(start, row_time)) < _CERTAIN

    other_starts = [start for start in starts if start.orientation != fit.model.orientation][:_MOST_OTHERS]
    axes = [start.orientation for start in other_starts if explains(start)]
    other = next((start.offset for start in other_offsets[:_MOST_OTHERS] if explains(start)), None)
    ambiguous: list[Reason] = []
    if mirrored is not None:
        ambiguous.append(Reason("axes_mirrored", details={"axes": mirrored}))
    if axes:
        ambiguous.append(Reason("axes_ambiguous", details={"axes": ", ".join(axes)}))
    return _result(fit, ambiguous, other, rows, offsets)


def _result(
    fit: RotationFit, ambiguous: list[Reason], other: float | None, rows: int, offsets: tuple[float, float] | None
) -> RotationAlignment:
    """The result of a fit to frames whose readout has a number of rows; an ``other`` offset in s explains them too."""
    model, radius, starts = fit.model, fit.model.tracks.radius, fit.model.tracks.starts
    *_, at, scale, focal_length, row_time = fit.parameters.tolist()
    std = fit.covariance.diagonal().clamp(min=0.0).sqrt()
    gradient = torch.zeros(7, dtype=torch.float64)
    gradient[3], gradient[4] = 1.0, -model.middle  # offset = at - scale * middle
    offset, offset_std = at - scale * model.middle, float(gradient @ fit.covariance @ gradient) ** 0.5
    middles = starts + 0.5 * (rows - 1) * row_time + 0.5 * model.tracks.exposure_time
    predicted = model.components(fit.parameters, middles)
    units = torch.tensor([1.0, 1.0, 1 / radius], dtype=torch.float64)
    unexplained = fit.errors.effects[:3] * units
    first, last = float(middles[0, 0]) - 0.5 * rows * row_time, float(middles[-1, 1]) + 0.5 * rows * row_time
    clock = scale * (torch.tensor([first, last], dtype=torch.float64) - model.middle) + at

    displacement = model.components(fit.parameters, model.tracks.times(row_time))  # of the rows of the corners
    displacement = (displacement - displacement.mean(0)).square().mean(0).sqrt()
    reasons = recording_reasons(displacement[:2].tolist(), unexplained[:2].tolist(), other)
    reasons += ambiguous
    # Parameters that are not determined.
    *_, fits_focal_length, fits_row_time = model.free
    side, allowed = max(model.tracks.size), _MAX_FOCAL_LENGTH_STD * focal_length
    if std[5] > allowed:
        details = {"focal_length": focal_length}
        reasons.append(Reason("focal_length_uncertain", None, float(std[5]), allowed, details))
    shortest, longest = (sides * side for sides in _FOCAL_LENGTHS)
    if fits_focal_length and not shortest <= focal_length <= longest:
        limit = shortest if focal_length < shortest else longest
        reasons.append(Reason("focal_length_implausible", None, focal_length, limit, {"times": focal_length / side}))
    if fits_row_time and std[6] > _MAX_ROW_TIME_STD * row_time:
        reasons.append(Reason("row_time_uncertain", None, float(std[6]) / row_time, _MAX_ROW_TIME_STD))
    if not math.isfinite(float(std.sum())):
        reasons.append(Reason("fit_not_converged"))
    if offsets is not None and not offsets[0] - 4 * offset_std <= offset <= offsets[1] + 4 * offset_std:
        reasons.append(Reason("offset_outside", None, offset, offsets[0] if offset < offsets[0] else offsets[1]))
    steps = model.rates.times.diff()
    inside = (model.rates.times[1:] > clock[0]) & (model.rates.times[:-1] < clock[1])
    longest, allowed = max(steps[inside].tolist(), default=float(clock[1] - clock[0])), 4 * float(steps.median())
    if longest > allowed:
        reasons.append(Reason("gap_in_recording", None, longest, allowed))
    readout, shortest = row_time * rows, float(starts.diff(dim=1).amin())
    if readout > shortest:
        reasons.append(Reason("readout_too_long", None, readout, shortest, {"rows": rows}))
    translation = fit.translation + fit.effects[:, 3:]
    return RotationAlignment(
        motion=_motion(fit, clock),
        orientation=model.orientation,
        offset=offset,
        offset_std=offset_std,
        scale=scale,
        scale_std=float(std[4]),
        bias=fit.parameters[:3],
        bias_std=std[:3],
        focal_length=focal_length,
        focal_length_std=float(std[5]),
        row_time=row_time,
        row_time_std=float(std[6]),
        translation=translation / torch.tensor([-focal_length, -focal_length, radius], dtype=torch.float64),
        unexplained=unexplained,
        corner_std=fit.errors.sigma,
        times=middles.mean(1),
        measured=predicted + fit.unshrunk() * units,
        predicted=predicted,
        reliable=not reasons,
        findings=tuple(reasons),
    )


def _motion(fit: RotationFit, clock: Tensor, margin: int = 4) -> FreeMotion:
    """The motion on the clock of the frames, relative to their mid-time, with ``margin`` samples beyond the frames."""
    model, parameters = fit.model, fit.parameters
    times = model.rates.times.cpu()
    low = max(int(torch.searchsorted(times, clock[0])) - margin, 0)
    high = min(int(torch.searchsorted(times, clock[1])) + margin, len(times))
    part = AngularRates(times[low:high], model.rates.rates[low:high].cpu() - parameters[:3])
    turned = part.attitude(float(parameters[3])) @ orientation_matrix(model.orientation).T
    path = image_components(turned, parameters[5])
    recorded_times = (part.times - parameters[3]) / parameters[4] + model.middle
    camera = replace(model.camera, focal_length=float(parameters[5]))
    return FreeMotion.from_samples(recorded_times, path, spacing=float(recorded_times.diff().median()), camera=camera)
