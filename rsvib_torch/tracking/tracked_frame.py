"""Result of the tracker for one frame; the restored frame and the detection are computed when they are used."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from rsvib_torch.detection import DetectionResult
from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.result import assembled, offset_curve
from rsvib_torch.detection.sensitivity import timing_sensitivity, with_row_time_std
from rsvib_torch.detection.start import FieldScale
from rsvib_torch.detection.tones.fit import ToneFit, displacement_std, residual_of, vibration_of_fit
from rsvib_torch.detection.verdict import Findings
from rsvib_torch.frames.prepare import PreparedFrames
from rsvib_torch.motion.timing import RowTiming
from rsvib_torch.motion.vibration import Vibration
from rsvib_torch.numerics.tables import Array, table, tensor
from rsvib_torch.options import TrackerOptions
from rsvib_torch.restoration.restore import as_taken, restore_prepared

TrackingState = Literal["searching", "tracking", "unusable"]


def displacement_std_at_frame(fit: ToneFit, growth: Array, timing: RowTiming, height: int) -> Array:
    """(2,) px, standard deviation of the displacement of the rows by tones whose time origin is the frame.

    ``growth`` (2, K) in 1/s changes amplitudes within the frame, which the tones do not show: of a tone of 3 px that
    decays with 1.6 /s, displacements were wrong by up to 12 standard deviations without it.
    """
    known = displacement_std(fit, table(timing.row_starts(1, height)[0, ::8]), timing.exposure_time)[0]
    change = np.abs(fit.coefficients[0]) * growth * (height * timing.row_time)  # px, from the first to the last row
    return np.sqrt(np.square(known) + np.square(change).sum(-1) / 24)


@dataclass(frozen=True, eq=False)
class TrackedTones:
    """The tones at one frame, in row order."""

    time: float  # s, exposure start of the frame
    fit: ToneFit  # the tones; the time origin is ``time``
    growth: Array  # (2, K) 1/s, by which amplitudes change
    # displacements of the rows of the last frame that was measured and of the one before, with the same time origin
    measurements: Measurements
    findings: Findings  # reasons against each axis


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """Result of ``VibrationTracker.update``.

    Attributes:
        time: s, exposure start of its first row.
        state: ``"tracking"``: the motion is known; ``"searching"``: it is not, or the rows contradict it;
            ``"unusable"``: the frame is constant, or a copy of the frame before.
        motion: The motion to remove, in image axes; its time origin is the middle of the frame. Axes whose vibration is
            not reliable are still.
        path: (2,) px, axes (x, y): image motion without the tones of ``motion``, from the first frame to the middle of
            this one, by corners that are followed with ``steady``; NaN if it is not known.
        detected: Whether the vibration was searched for, as ``detect_vibration`` does, after this frame.
        measurements: Displacements of the rows of this frame and of the frame before, in row order; times count
            from the first row of this frame. None if they were not measured.
        frame: The frame as given.
        tones: The tones at this frame; None if they are not known.
        options: Options of the tracker.
        lost: That no motion can be found because the times contradict the frame period; otherwise empty.
    """

    time: float
    state: TrackingState
    motion: Vibration
    path: Tensor
    detected: bool
    measurements: Measurements | None
    frame: PreparedFrames
    tones: TrackedTones | None
    options: TrackerOptions
    lost: str = ""

    @cached_property
    def restored(self) -> Tensor:
        """The frame without the motion, in its shape; as taken if no motion is known. Computed at the first use.

        Another thread may use it while the next frame is tracked.
        """
        if not bool(self.motion.moving_axes().any()):
            return self.frame.from_row_order(as_taken(self.frame, joint=False))[0]
        # the time origin of the motion is the middle of the frame
        half = self.frame.timing.time_to_middle(self.frame.images.shape[-2])
        timing = replace(self.frame.image_timing, frame_start_times=(-half,))
        frame = replace(self.frame, timing=timing.in_row_order(), image_timing=timing)
        with torch.no_grad():
            return frame.from_row_order(restore_prepared(frame, self.motion, self.options))[0]

    @cached_property
    def detection(self) -> DetectionResult | None:
        """The vibration at this frame, with its time origin at the first row of this frame; None if none is known."""
        if self.tones is None:
            return None
        fit, measurements, timing = self.tones.fit, self.tones.measurements, self.frame.timing
        height, width = self.frame.images.shape[-2:]
        # Standard deviations, also of the displacement of the rows of this frame.
        vibration, std = vibration_of_fit(fit)
        if timing.row_time_std:
            # Each frame is compared with the one before: with the sensitivity of a fit to more frames, errors of
            # amplitudes by a wrong row time were up to 8 standard deviations; with that of two frames, at most 1.1.
            std = with_row_time_std(std, vibration, timing_sensitivity(fit, timing, 2, height), timing)
        known_std = displacement_std_at_frame(fit, self.tones.growth, timing, height)
        std = replace(std, displacement=tensor(known_std[None]))
        # The offset curve with the weights that a fit to these rows would have.
        robust = measurements.reweighted(residual_of(measurements, fit))
        weights = robust.weights / np.maximum(measurements.weights, 1e-300)
        results = assembled(
            fit,
            std,
            None,
            offset_curve(robust, fit, weights, [2], self.frame.images.device),
            (self.tones.findings,),
            self.frame.image_timing,
            scale=FieldScale(2, width, height),
            num_frames=self.options.window,
            interval=float(measurements.interval.mean()),
        )
        return results[0]
