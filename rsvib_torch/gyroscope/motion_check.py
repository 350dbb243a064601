"""Comparison of a given motion with the offsets between frames.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ParamSpec, Protocol

import torch
from torch import Tensor

from rsvib_torch.checks.values import check_single, described
from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.shapes.free import start_of_stack
from rsvib_torch.execution.precision import full_precision, without_gradients
from rsvib_torch.frames.entry_points import entry_point
from rsvib_torch.frames.grey import grey_frames
from rsvib_torch.frames.orientation import offsets_from_row_order
from rsvib_torch.io.stack_reading import FramesOrFiles
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.numerics.splines import gauss_legendre
from rsvib_torch.numerics.tables import tensor
from rsvib_torch.options import OffsetOptions
from rsvib_torch.results.presentation import AXIS_NAMES, JudgedResult
from rsvib_torch.results.reason import Reason
from rsvib_torch.text import measured_text, text_table

_MIN_CHANGE = 0.05  # px, registration errors of bands

P = ParamSpec("P")


@dataclass(frozen=True, eq=False, repr=False)
class MotionCheck(
    JudgedResult,
    units={"before": "px", "after": "px", "times": "s", "offsets": "px", "residual": "px"},
    shapes={"before": "2", "after": "2", "times": "N", "offsets": "N 2", "residual": "N 2"},
):
    """Offsets of rows between frames, before and after a given motion is subtracted.

    Attributes:
        before: (2,) px, rms offset of row bands between consecutive frames, axes (x, y), of the nine tenths that fit
            best: the others may be clouds or registration errors.
        after: (2,) px, the same of the offsets less those of the motion.
        helps: Whether the motion reduces the offsets, both axes together.
        findings: Each ``Reason`` against the motion; ``reasons`` has their texts.
        times: (N,) s, exposure starts of the registered row bands in the earlier frame of their pair.
        offsets: (N, 2) px, offsets of these bands, axes (x, y).
        residual: (N, 2) px, these offsets less those of the motion.
    """

    before: Tensor
    after: Tensor
    helps: bool
    findings: tuple[Reason, ...]
    times: Tensor
    offsets: Tensor
    residual: Tensor

    def summary(self) -> str:
        """Offsets before and after the motion is subtracted, and the verdict."""
        rows = [
            [name, measured_text(before, digits=3), measured_text(after, digits=3)]
            for name, before, after in zip("xy", self.before, self.after, strict=True)
        ]
        table = text_table(("axis", "offset between frames (px rms)", "without the motion (px rms)"), rows)
        return "\n".join([table, "the motion reduces the offsets" if self.helps else "not reduced", *self.reasons])


class _ChecksMotion(Protocol[P]):
    """Type of ``check_motion``."""

    def __call__(
        self, frames: FramesOrFiles, timing: SensorTiming, motion: Motion, *args: P.args, **kwargs: P.kwargs
    ) -> MotionCheck:
        """Call the function."""


def _check_options(options: Callable[P, OffsetOptions]) -> Callable[[Callable[..., MotionCheck]], _ChecksMotion[P]]:
    return lambda function: entry_point(options, function)


@_check_options(OffsetOptions)
@full_precision
@without_gradients
def check_motion(frames: FramesOrFiles, timing: SensorTiming, motion: Motion, options: OffsetOptions) -> MotionCheck:
    """Compare a given motion with the offsets of row bands between frames.

    A motion with the wrong sign, clock or focal length makes frames worse: its subtraction increases the offsets.

    Args:
        frames: Stack (T, H, W) or (T, C, H, W) of at least two frames; tensor, array, list of these, or files; NaN
            marks missing pixels.
        timing: The sensor.
        motion: A vibration or free motion in image axes, on the clock of the frames.
        options: Options, as in ``detect_vibration``.

    Returns:
        Rms offsets with and without the motion, and a verdict.

    Raises:
        ValueError: If frames or motion are a batch, or the frames cannot be registered.

    Example:
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import example_frames
        >>> frames, timing, vibration = example_frames()
        >>> print(rsv.check_motion(frames, timing, vibration))
        axis  offset between frames (px rms)  without the motion (px rms)
        x     2.36                            0.0661
        y     0.576                           0.0953
        the motion reduces the offsets
    """
    if not isinstance(motion, Motion):
        raise TypeError(f"motion must be a Motion, got {described(motion)}")
    stack = grey_frames(frames, timing, options)
    timing = stack.timing
    check_single("motion", motion)
    if stack.batched:
        raise ValueError("check_motion takes one stack, not a batch")
    measured = start_of_stack(stack, timing, options)[1].measurements
    turned = motion.to("cpu").to_row_order(timing)
    offsets = _offsets(tensor(measured.displacements))
    residual = offsets - _offsets(_averaged(turned, measured))
    used = tensor(measured.weights[0].min(-1) > 0)
    before, after = (offsets_from_row_order(_rms(values[used]), timing).abs() for values in (offsets, residual))
    findings = []
    for name, moved, rest in zip(AXIS_NAMES, before.tolist(), after.tolist(), strict=False):
        largest, expected = moved + _MIN_CHANGE, max(0.5 * moved, _MIN_CHANGE)
        if rest > largest:
            findings.append(Reason("motion_enlarges_offsets", name, rest, largest, {"moved": moved}))
        elif rest > expected and moved > 2 * _MIN_CHANGE:
            findings.append(Reason("motion_leaves_offsets", name, rest, expected, {"moved": moved}))
    of_bands = (offsets_from_row_order(values[used], timing) for values in (offsets, residual))
    rest, moved = float(after.norm()), float(before.norm())
    if rest >= moved and not findings:
        findings.append(Reason("offsets_not_reduced", None, rest, moved))
    return MotionCheck(
        before, after, rest < moved, tuple(findings), tensor(measured.exposure_starts[0, :, 0])[used], *of_bands
    )


def _offsets(displacements: Tensor) -> Tensor:
    """(N, 2) px, displacement in the later frame less that in the earlier one, of pairs (1, N, 2, 2)."""
    return displacements[0, :, 1] - displacements[0, :, 0]


def _averaged(motion: Motion, measured: Measurements) -> Tensor:
    """Mean displacement (1, N, 2, 2) over exposure and rows of the bands."""
    duration = measured.average_times[1]
    nodes, weights = gauss_legendre(3)
    mean = torch.zeros_like(tensor(measured.displacements))
    for node, weight in zip(nodes.tolist(), weights.tolist(), strict=True):
        times = tensor(measured.exposure_starts) + (node - 0.5) * duration
        mean = mean + weight * motion.mean_displacement(times, measured.exposure_time)
    return mean


def _rms(offsets: Tensor) -> Tensor:
    """(2,) rms of the smallest nine tenths of offsets (N, 2)."""
    square = offsets.square().sort(dim=0).values
    return square[: max(1, math.ceil(0.9 * len(square)))].mean(0).sqrt()
