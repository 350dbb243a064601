"""Sensitivity of a detected vibration to the stated timing, and the assumptions that the frames cannot contradict.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

import math
from dataclasses import replace

import torch
from torch import Tensor

from rsvib_torch.core.presentation import AXIS_NAMES
from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.result import TimingSensitivity
from rsvib_torch.detection.tones.fit import ToneFit, axis_jacobian, motion_of_fit
from rsvib_torch.motion.timing import RowTiming
from rsvib_torch.motion.vibration import Vibration

__all__ = ["assumptions", "timing_sensitivity"]

_STEP = 1e-4  # relative change of the timing, for differences


def timing_sensitivity(fit: ToneFit, timing: RowTiming, num_frames: int, num_rows: int) -> TimingSensitivity:
    """Sensitivity of the tones of a fit to the timing, in row order.

    A timing that is wrong by dT changes the displacements at the measured times by ``dD``. The least-squares fit then
    changes its parameters by ``-X^+ dD`` to first order, X the Jacobian of the displacements of all rows.

    Args:
        fit: The fit of B stacks.
        timing: The sensor.
        num_frames: Frames of a stack.
        num_rows: Rows of a frame; about 128 of them are used.

    Returns:
        Sensitivities (B, 2, K), the tones in the order of ``vibration_of_fit``.
    """
    batch, device = len(fit.centre), fit.centre.device

    def starts(stated: RowTiming) -> Tensor:
        rows = stated.row_starts(num_frames, num_rows, device)[:, :: max(1, num_rows // 128)]
        return rows.T.expand(batch, -1, -1)  # (B, N, T)

    times = starts(timing)
    axes = fit.coefficients.shape[1]
    eye = torch.eye(axes, dtype=times.dtype, device=device).expand(*times.shape[:2], axes, axes)
    displacements = times.new_zeros(*times.shape, axes)
    record = Measurements(times, displacements, torch.ones_like(times), eye, timing.exposure_time)
    # parameters of the fit at the middle of this record
    turn = 2 * math.pi * fit.frequencies * (record.centre - fit.centre)[:, None, None]
    fit = replace(fit, coefficients=fit.coefficients * torch.polar(torch.ones_like(turn), turn), centre=record.centre)
    motion, inverses = motion_of_fit(fit), []
    for axis in range(axes):
        jacobian, to_all = axis_jacobian(record, fit, axis)
        inverses.append(to_all @ torch.linalg.pinv(jacobian.flatten(1, 2)))

    def predicted(stated: RowTiming) -> Tensor:
        return record.relative(motion.mean_displacement(starts(stated), stated.exposure_time))

    values = {}
    largest_first = fit.amplitude.argsort(dim=-1, descending=True, stable=True)
    size = torch.where(fit.amplitude > 0, fit.amplitude, 1.0)
    for name in ("row_time", "frame_rows", "exposure_rows"):
        lower, higher = (_scaled(timing, name, 1 + sign * _STEP) for sign in (-1, 1))
        change = (predicted(higher) - predicted(lower)) / (2 * _STEP)
        moved = torch.stack([-inverses[axis] @ change[..., axis].flatten(1)[..., None] for axis in range(axes)], 1)
        tones = moved[:, :, : 3 * size.shape[-1], 0].unflatten(-1, (-1, 3))  # (B, 2, K, 3)
        along = fit.coefficients.conj() * torch.complex(tones[..., 0], tones[..., 1])
        amplitude = torch.where(fit.active, along.real / size.square(), 0.0)
        frequency = torch.where(fit.active, tones[..., 2] / fit.frequencies.clamp(min=1e-300), 0.0)
        values[f"amplitude_by_{name}"] = amplitude.take_along_dim(largest_first, -1)
        values[f"frequency_by_{name}"] = frequency.take_along_dim(largest_first, -1)
    return TimingSensitivity(**values)


def _scaled(timing: RowTiming, name: str, factor: float) -> RowTiming:
    """The timing with one of its times multiplied by a factor."""
    return replace(timing, **{name: getattr(timing, name) * factor})


def assumptions(
    vibration: Vibration, sensitivity: TimingSensitivity, timing: RowTiming, num_frames: int, num_rows: int
) -> tuple[str, ...]:
    """What the frames cannot contradict, with its effect, one sentence for each.

    Args:
        vibration: The vibration (not a batch), in image axes.
        sensitivity: Its sensitivity, in image axes.
        timing: The sensor.
        num_frames: Frames of the stack.
        num_rows: Rows of a frame.
    """
    if not bool((vibration.amplitude > 0).any()):
        return ()
    sentences = []
    if timing.frame_start_times is None:
        sentences.append(f"row_time={timing.row_time:g} s; all frequencies are inversely proportional to it")
    if timing.frame_start_times is None and timing.frame_rows == num_rows:
        sentences.append(
            f"frame_rows={num_rows} is the number of rows of the frames: there are no blanking rows, which is rare; "
            "otherwise frame_rows, and a row_time of 1 / (frame rate x rows), are wrong"
        )
    if num_frames == 2:
        what = "frame_rows" if timing.frame_start_times is None else "frame_start_times"
        sentences.append(
            f"{what}, readout direction, scan axis and order of the frames: two frames cannot contradict them, more "
            "frames can"
        )
        if timing.frame_start_times is None:
            sentences.append(_effect("frame_rows", vibration, sensitivity, timing.frame_rows))
    if float(sensitivity.amplitude_by_exposure_rows.abs().amax()) > 0.01:
        sentences.append(_effect("exposure_rows", vibration, sensitivity, timing.exposure_rows))
    return tuple(sentences)


def _effect(name: str, vibration: Vibration, sensitivity: TimingSensitivity, value: float) -> str:
    """Sentence about the effect of an error of 1 % of a stated time, on the strongest tone of each axis."""
    of_axes = []
    for axis, letter in enumerate(AXIS_NAMES[: vibration.num_axes]):
        if float(vibration.amplitude[axis, 0]) <= 0:
            continue
        amplitude, frequency = (
            round(float(getattr(sensitivity, f"{of}_by_{name}")[axis, 0]), 1) + 0.0  # no -0.0
            for of in ("amplitude", "frequency")
        )
        of_axes.append(f"{letter} amplitude {amplitude:+.1f} %, frequency {frequency:+.1f} %")
    return f"{name}={value:g}: if it is stated 1 % too large, this changes {'; '.join(of_axes)}"
