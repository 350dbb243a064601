"""The part of a detected vibration that is accurate enough to be undone, from its standard deviations."""

import math

import torch
from torch import Tensor

from rsvib_torch.checks.arguments import checks_arguments
from rsvib_torch.checks.values import check_whole_number, described
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration, VibrationStd
from rsvib_torch.results.presentation import AXIS_NAMES
from rsvib_torch.results.reason import Reason


def displacement_uncertainty(
    vibration: Vibration, std: VibrationStd, timing: SensorTiming, num_frames: int, num_rows: int
) -> tuple[Tensor, Tensor]:
    """Root-mean-square error of the displacement of the rows by standard deviations, and the displacement itself.

    If ``std.displacement`` is given, it is the error; it contains the image motion and all correlations. Otherwise, for
    ``A sinc(f T_e) sin(2 pi f t + phi)``, the variance of a tone averaged over its period is ``sinc^2 (std_A^2 + A^2
    std_angle^2) / 2``. The phase at the time origin and the frequency are correlated: the angle is most accurate in the
    middle of the record. Its variance there, plus the variance by the frequency with the mean squared distance from the
    middle, is ``std_angle^2``.

    The vibration has the batch shape () or (B,). Uncertainty and displacement (..., 2) are in px, axes (x, y), float64;
    image motion is not part of either.
    """
    starts = timing.frame_starts(num_frames)
    first, last = float(starts[0]), float(starts[-1]) + num_rows * timing.row_time
    middle, spread = 0.5 * (first + last), (last - first) ** 2 / 12.0
    amplitude, moving = vibration.amplitude, vibration.amplitude > 0
    rate = (2 * math.pi * std.frequency.to(amplitude)).square()
    angle = (std.phase.to(amplitude).square() - rate * middle**2).clamp(min=0.0) + rate * spread
    attenuation = 0.5 * torch.sinc(vibration.frequency * timing.exposure_time).square()
    variance = attenuation * (std.amplitude.to(amplitude).square() + amplitude.square() * angle)
    variance = torch.where(moving, variance.nan_to_num(nan=math.inf), 0.0)
    error = variance.sum(-1).sqrt()
    if std.displacement is not None:
        error = torch.where(moving.any(-1), std.displacement.to(amplitude), 0.0)
    return error, (attenuation * amplitude.square()).sum(-1).sqrt()


@checks_arguments
def trusted_vibration(
    detected: DetectedVibration, timing: SensorTiming, num_frames: int, num_rows: int
) -> tuple[Vibration, tuple[Reason, ...]]:
    """The part of a detected vibration that is accurate enough to be undone.

    The amplitude and the image motion of an axis are set to zero if the axis is not reliable, or if the variance of its
    displacement exceeds half of the mean square displacement: its rows stay where they are. Two frames that are
    displaced as a whole have the same offsets as frames that move uniformly, so that an image motion without a
    reliable tone is not known.

    Args:
        detected: A detection.
        timing: The sensor.
        num_frames: Frames to restore.
        num_rows: Rows of a frame, along the scan axis.

    Returns:
        The vibration, and a ``Reason`` for each axis that is not restored.

    Example:
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import city_and_fields
        >>> timing = rsv.SensorTiming(row_time=40e-6, exposure_rows=20, frame_rows=300)
        >>> blind = rsv.Vibration(amplitude=[2.1, 1.6], frequency=[110.0, 83.0], phase=[0.5, 1.0])  # Hz; 83.3 is blind
        >>> frames = rsv.simulate_frames(city_and_fields(320, 240, seed=3), timing, blind, num_frames=2)
        >>> detection = rsv.detect_vibration(frames, timing)
        >>> vibration, (reason,) = rsv.trusted_vibration(detection, timing, *frames.shape[:2])
        >>> (vibration.amplitude[:, 0] > 0).tolist(), reason.code, reason.axis
        ([True, False], 'axis_not_reliable', 'y')
    """
    check_whole_number("num_frames", num_frames, at_least=1)
    check_whole_number("num_rows", num_rows, at_least=1)
    vibration, std = detected.vibration, detected.std_if_hidden_tone or detected.std
    reliable = torch.as_tensor(detected.reliable, dtype=torch.bool, device=vibration.device)
    error, size = (
        value.to(vibration.device) for value in displacement_uncertainty(vibration, std, timing, num_frames, num_rows)
    )
    accurate = error.square() <= 0.5 * size.square()
    # of all stacks and axes in one transfer
    figures = torch.stack([error, size, reliable.to(error), accurate.to(error)], -1)
    batched = len(vibration.batch_shape) > 0
    left_alone = []
    for stack, of_axes in enumerate(figures.view(-1, *figures.shape[-2:]).tolist()):
        reasons = detected.reasons[stack] if batched else detected.reasons
        where: dict[str, float | str] = {"action": "restored"} | ({"stack": stack} if batched else {})
        for axis, (value, moved, is_reliable, is_accurate) in enumerate(of_axes):
            name = AXIS_NAMES[axis]
            if not is_reliable:
                left_alone.append(Reason("axis_not_reliable", name, details=where | {"why": "; ".join(reasons[axis])}))
            elif not is_accurate:
                details = where | {"size": moved, "unit": ("px", "px", "rad", "(zoom)")[axis]}
                left_alone.append(Reason("axis_not_accurate", name, value, math.sqrt(0.5) * moved, details))
    return vibration.scaled(reliable & accurate), tuple(left_alone)


def vibration_to_undo(
    vibration: Motion | DetectedVibration, timing: SensorTiming, num_frames: int, num_rows: int
) -> tuple[Motion, tuple[Reason, ...]]:
    """A given motion unchanged; of a detection the accurate part, and a reason for each axis not restored."""
    if isinstance(vibration, Motion):
        return vibration, ()
    if not isinstance(vibration, DetectedVibration):
        made_by = DetectedVibration._MADE_BY
        raise TypeError(f"vibration must be a Motion or a DetectedVibration ({made_by}), got {described(vibration)}")
    return trusted_vibration(vibration, timing, num_frames, num_rows)
