"""A motion that another instrument recorded: alignment with the clock of the frames."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ParamSpec, Protocol, overload

import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.checks.arguments import FramesOrFiles
from rsvib_torch.checks.values import check_single
from rsvib_torch.execution.parallel import full_precision, without_gradients
from rsvib_torch.frames.entry_points import entry_point
from rsvib_torch.frames.prepare import frames_from_row_order, grey_frames
from rsvib_torch.gyroscope.corner_tracks import CornerTracks, corner_tracks
from rsvib_torch.gyroscope.gyroscope_rates import AngularRates
from rsvib_torch.gyroscope.rotation_alignment import AlignOptions, RotationAlignment, align_rates
from rsvib_torch.gyroscope.rotation_fit import image_components
from rsvib_torch.motion.camera import Camera
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.results.presentation import JudgedResult
from rsvib_torch.results.reason import Reason
from rsvib_torch.text import measured_text, wrapped

P = ParamSpec("P")
_DISTANT = Camera(1e6)  # of a motion in px without a camera: all columns are displaced alike


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
        unexplained: (2,) px, standard deviation of the motion from frame to frame that the recording does not explain,
            beyond the noise of the measurements.
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

    Corners are followed between consecutive frames, and compared with the rotation of the camera between the exposures
    of their rows, at all offsets and, of **angular rates** (``read_gyroscope``), for all 24 assignments of the axes.
    Bias, clock and, without a camera, the focal length are fitted. Robust weights exclude what moves by itself or is
    fixed to the camera. Every pair of frames has a translation of its own: if the scene has parallax, only
    displacements across its lines (epipolar lines) determine the rotation.

    A **motion in px** is compared as the rotation of a distant camera, with its own axes and without a focal length;
    its bias is the drift.

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
    images = frames_from_row_order(stack.images[0], timing)
    masks = [None] * len(images) if stack.valid is None else frames_from_row_order(stack.valid[0], timing)
    starts = timing.in_row_order().frame_starts(len(images)).tolist()
    tracks = corner_tracks(zip(range(len(images)), images, masks, strict=True), starts, timing)
    with torch.device("cpu"):  # also where another device is the default of PyTorch
        return align_tracks(tracks, timing, recorded, options)


def align_tracks(
    tracks: CornerTracks, timing: SensorTiming, recorded: FreeMotion | AngularRates, options: AlignOptions
) -> ClockAlignment | RotationAlignment:
    """``align_motion`` from the corners of pairs of frames."""
    if isinstance(recorded, AngularRates):
        return align_rates(tracks, timing, recorded, options)
    # The motion as the rotation of a camera; its rates are splines of twice as many knots.
    camera, motion = recorded.camera or _DISTANT, recorded.to("cpu")
    times = torch.arange(motion.start, motion.end, 0.5 * motion.spacing, dtype=torch.float64, device="cpu")
    rates = AngularRates(times, camera.attitude(motion.velocity(times)))
    found = align_rates(tracks, timing, rates, replace(options, camera=camera), ("XYZ",))
    # The motion in px, with the bias as a drift from the middle of the frames on.
    drift = image_components(-found.scale * found.bias, camera.focal_length)[: motion.num_axes]
    moved = motion.retimed(found.offset, found.scale)
    drifted = functional.pad(drift, (0, motion.num_axes - len(drift)))[:, None] * (
        moved.knots - found.times[[0, -1]].mean()
    )
    return ClockAlignment(
        motion=FreeMotion(moved.coefficients + drifted, moved.start, moved.spacing, moved.tones, moved.camera),
        offset=found.offset,
        offset_std=found.offset_std,
        scale=found.scale,
        scale_std=found.scale_std,
        drift=drift[:2],
        unexplained=found.unexplained[:2],
        reliable=found.reliable,
        findings=found.findings,
    )
