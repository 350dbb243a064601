"""Whether a motion that is known from elsewhere explains what frames show."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.core.precision import full_precision, outside_graphs
from rsvib_torch.detection.band_curve import measurements_of_curve
from rsvib_torch.detection.grey_frames import grey_frames
from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.shapes.free import start_curve
from rsvib_torch.frames.arrays import ArrayLike
from rsvib_torch.frames.orientation import offsets_from_row_order
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.registration import Registration, RegistrationOptions

__all__ = ["MotionCheck", "check_motion"]

_COUNTED = 0.9  # of the bands, those that fit best: the others may be clouds or mistakes of registration
_NOTHING = 0.05  # px, which bands are apart by mistakes of registration
_MOST_LEFT = 0.5  # of the motion, that a recording which explains it may leave


@dataclass(frozen=True, eq=False)
class MotionCheck:
    """How far rows move between frames, before and after a known motion is taken out.

    Attributes:
        before: (2,) px, rms offset of row bands between consecutive frames, axes (x, y), of the nine tenths that fit
            best.
        after: (2,) px, the same less the offsets that the motion makes.
        helps: Whether the motion brings the frames closer to each other, both axes together.
        reasons: What speaks against the motion.
    """

    before: Tensor
    after: Tensor
    helps: bool
    reasons: tuple[str, ...]


@outside_graphs
@full_precision
@torch.no_grad()
def check_motion(
    frames: ArrayLike,
    timing: SensorTiming,
    motion: Motion,
    *,
    registration: Registration = "ncc",
    band_rows: int = 32,
    band_step: int = 16,
    search: int = 16,
    ignore: ArrayLike | None = None,
    full_scale: float | None = None,
) -> MotionCheck:
    """Hold a known motion against the offsets of row bands between frames.

    A motion of the wrong sign, clock or focal length makes frames worse: rows are then further apart less the motion
    than with it.

    Args:
        frames: Stack (T, H, W) or (T, C, H, W) of at least two frames, tensor or NumPy array; NaN marks pixels that
            were not measured.
        timing: The sensor.
        motion: A vibration or free motion in image axes, on the clock of the frames.
        registration: ``"ncc"``, ``"phase"`` or ``"projection"``.
        band_rows: Rows of a band.
        band_step: Rows from one band to the next.
        search: Search range in px around the whole-frame offset.
        ignore: Bool, broadcastable to (..., H, W) of the frames: True for pixels to leave out.
        full_scale: Count that means 1.0, for integer frames.

    Raises:
        TypeError: If frames are not numbers.
        ValueError: If frames or motion are a batch, or the frames cannot be registered.
    """
    stack = grey_frames(frames, timing, full_scale, ignore)
    if stack.batched or motion.batch_shape:
        raise ValueError("check_motion takes one stack and one motion, not a batch")
    bands = RegistrationOptions(registration, band_rows, band_step, search)
    rowwise, curve, _ = start_curve(stack, timing, bands)
    measured = measurements_of_curve(curve, rowwise, band_step)
    turned = motion.to(stack.images.device).to_row_order(timing)
    offsets = _offsets(measured.displacements)
    left = offsets - _offsets(_averaged(turned, measured))
    known = measured.weights[0].amin(-1) > 0
    # image axes have x first, whatever the scan
    before, after = (offsets_from_row_order(_size(v[known]), timing).abs() for v in (offsets, left))
    reasons = []
    for axis, name in enumerate("xy"):
        moved, rest = float(before[axis]), float(after[axis])
        if rest > moved + _NOTHING:
            reasons.append(
                f"rows are further apart along {name} less the motion: {rest:.3g} px, {moved:.3g} px with it"
            )
        elif rest > max(_MOST_LEFT * moved, _NOTHING) and moved > 2 * _NOTHING:
            reasons.append(f"the motion leaves {rest:.3g} px of the {moved:.3g} px that rows move along {name}")
    return MotionCheck(before, after, float(after.norm()) < float(before.norm()), tuple(reasons))


def _offsets(displacements: Tensor) -> Tensor:
    """(N, 2) px, displacement in the later frame less that in the earlier one, of pairs (1, N, 2, 2)."""
    return displacements[0, :, 1] - displacements[0, :, 0]


def _averaged(motion: Motion, measured: Measurements) -> Tensor:
    """Mean displacement (1, N, 2, 2) over exposure and rows of the bands."""
    duration = measured.average_times[1]
    places = [0.5 * duration * math.sqrt(0.6) * place for place in (-1, 0, 1)]
    values = [motion.mean_displacement(measured.moments + place, measured.exposure_time) for place in places]
    return (5 * values[0] + 8 * values[1] + 5 * values[2]) / 18  # Gauss-Legendre


def _size(offsets: Tensor) -> Tensor:
    """(2,) rms of the smallest offsets (N, 2)."""
    square = offsets.square().sort(dim=0).values
    return square[: max(1, math.ceil(_COUNTED * len(square)))].mean(0).sqrt()
