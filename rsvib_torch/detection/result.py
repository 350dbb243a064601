"""Result of detection: vibration, standard deviations, verdict, and the offset curve."""

import math
import os
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rsvib_torch.detection.spectrum import DisplacementSpectrum, displacement_spectrum
from rsvib_torch.files.reading import Table
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration, VibrationStd
from rsvib_torch.registration import OffsetCurve
from rsvib_torch.results.presentation import Result, axis_head, axis_rows, plain_values
from rsvib_torch.results.reason import Findings
from rsvib_torch.text import measured_text, text_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_TONE_VALUES = ("amplitude", "frequency")
_SENSITIVITY_SHAPES = {
    f"{value}_by_{time}": "... A K"
    for time in ("row_time", "frame_rows", "exposure_rows")
    for value in (*_TONE_VALUES, "phase")
}


@dataclass(frozen=True, eq=False, repr=False)
class TimingSensitivity(Result, shapes=_SENSITIVITY_SHAPES):
    """Relative change of amplitudes and frequencies, and change of phases, over the relative change of a stated time.

    ``d ln A / d ln frame_rows = 3`` means that an amplitude becomes 3 % larger if ``frame_rows`` is stated 1 % larger
    and the frames are the same. All values have the shape (..., 2, K), axes (x, y), 0 where there is no tone. A change
    of ``row_time`` changes exposure time and frame period alike; with ``frame_start_times``, ``frame_rows`` has no
    effect.
    """

    amplitude_by_row_time: Tensor  # d ln A / d ln row_time
    amplitude_by_frame_rows: Tensor  # d ln A / d ln frame_rows
    amplitude_by_exposure_rows: Tensor  # d ln A / d ln exposure_rows
    frequency_by_row_time: Tensor  # d ln f / d ln row_time
    frequency_by_frame_rows: Tensor  # d ln f / d ln frame_rows
    frequency_by_exposure_rows: Tensor  # d ln f / d ln exposure_rows
    phase_by_row_time: Tensor  # d phi / d ln row_time in rad, at the time origin
    phase_by_frame_rows: Tensor  # d phi / d ln frame_rows
    phase_by_exposure_rows: Tensor  # d phi / d ln exposure_rows

    def summary(self) -> str:
        """Changes of every tone if a time is stated 1 % larger; of a batch, of the strongest one of each axis."""
        shown = 1 if self.batch_shape else self.frequency_by_row_time.shape[-1]
        rows = [
            [
                *labels,
                str(tone + 1),
                name,
                *(f"{float(getattr(self, f'{of}_by_{name}')[at][tone]):+.2f}" for of in _TONE_VALUES),
            ]
            for at, labels in axis_rows(self.batch_shape)
            for tone in range(shown)
            if tone == 0 or float(self.frequency_by_row_time[at][tone]) != 0.0
            for name in ("row_time", "frame_rows", "exposure_rows")
        ]
        return text_table([*axis_head(self.batch_shape), "tone", "1 % of", *(f"{of} (%)" for of in _TONE_VALUES)], rows)


@dataclass(frozen=True, eq=False, repr=False)
class AttitudeTones(
    Result,
    units={"amplitude": "rad", "amplitude_std": "rad", "frequency": "Hz", "frequency_std": "Hz", "phase": "rad"},
    shapes=dict.fromkeys(("amplitude", "amplitude_std", "frequency", "frequency_std", "phase", "phase_std"), "... 3 K"),
):
    """Vibration of the attitude of the camera: tones of pitch, yaw and roll with standard deviations, (..., 3, K).

    The rotation is right-handed about the axes x (right), y (down) and z (forward) of the camera, see ``Camera``. Roll
    that was not measured has amplitude 0 and a standard deviation of infinity.
    """

    amplitude: Tensor  # rad
    amplitude_std: Tensor  # rad
    frequency: Tensor  # hz
    frequency_std: Tensor  # hz
    phase: Tensor  # rad at the time origin
    phase_std: Tensor  # rad

    @classmethod
    def of(cls, vibration: Vibration, std: VibrationStd) -> "AttitudeTones":
        """The tones of a vibration with a camera."""
        camera = vibration.camera
        if camera is None:
            raise ValueError("the attitude requires a vibration with a camera")

        def turned(values: Tensor, factors: tuple[float, float, float], without_roll: float) -> Tensor:
            x, y = values[..., 0, :], values[..., 1, :]
            roll = values[..., 2, :] if values.shape[-2] > 2 else torch.full_like(x, without_roll)
            return torch.stack([factors[0] * y, factors[1] * x, factors[2] * roll], -2)

        lengths, ones = (1 / camera.focal_length, 1 / camera.focal_length, 1.0), (1.0, 1.0, 1.0)
        # yaw = -X / f and roll = -theta: the phase changes by pi
        opposite = vibration.phase.new_tensor([0.0, math.pi, math.pi])[:, None]
        phase = torch.remainder(turned(vibration.phase, ones, 0.0) + opposite + math.pi, 2 * math.pi) - math.pi
        return cls(
            turned(vibration.amplitude, lengths, 0.0),
            turned(std.amplitude, lengths, math.inf),
            turned(vibration.frequency, ones, 0.0),
            turned(std.frequency, ones, math.inf),
            phase,
            turned(std.phase, ones, math.inf),
        )

    def summary(self) -> str:
        """The tones as a table."""
        rows = [
            [
                *([", ".join(map(str, batch))] if batch else []),
                ("pitch", "yaw", "roll")[axis],
                measured_text(1e3 * self.amplitude[at], 1e3 * self.amplitude_std[at]),
                measured_text(self.frequency[at], self.frequency_std[at]),
                measured_text(self.phase[at], self.phase_std[at]),
            ]
            for at in map(tuple, self.amplitude.nonzero().tolist())
            for *batch, axis, _ in [at]
        ]
        return text_table([*axis_head(self.batch_shape), "amplitude (mrad)", "frequency (Hz)", "phase (rad)"], rows)


@dataclass(frozen=True, eq=False, repr=False)
class DetectionResult(
    DetectedVibration,
    units={**Vibration.units, "residual": "px", "gain": "px of offset per px of displacement", "offsets": "s and px"},
    shapes={**DetectedVibration.shapes, "fitted": "... P N A"},
    file_format="rsvib vibration",
):
    """A detected vibration with its uncertainty and verdict. Batches of stacks or windows lead all tensors.

    Attributes:
        vibration: The vibration in image axes; an axis without a significant tone has amplitude 0.
        std: Standard deviations of its parameters, given the tones that were found.
        std_if_hidden_tone: The same if the record may contain a further tone, which few frames cannot exclude.
        gain: (..., 2, K) offset gain of Eq. (7) from displacement to offset between the first two frames. A tone with a
            gain near 0 is nearly blind, unless other frames are at other intervals.
        residual: (..., 2) px, mean absolute difference of measured and fitted offsets.
        reliable: (..., 2) bool, verdict for each axis.
        findings: Each ``Reason`` against each axis (x, y) that is not reliable; a tuple of those for a batch.
            ``reasons`` has their texts.
        assumptions: What the frames cannot contradict, one sentence for each; a tuple of those for a batch.
        offsets: The measured offset curve.
        fitted: (..., P, N, 2) px, offsets of the same bands predicted by the vibration.
        sensitivity: Effect of the stated timing on amplitudes and frequencies.
        timing: The sensor of the frames.

    ``save`` writes a ``vibration.json`` as the program does, which ``rsvib restore`` and ``read_vibration`` read.

    Example:
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import example_frames
        >>> frames, timing, vibration = example_frames()
        >>> detection = rsv.detect_vibration(frames, timing)
        >>> detection.std.amplitude.shape, detection.offsets.offsets.shape[-1]  # (axis, tone); x and y
        (torch.Size([2, 1]), 2)
        >>> (detection.vibration.amplitude - vibration.amplitude).abs().max().item() < 0.02
        True
        >>> detection.gain[:, 0].round(decimals=2).tolist()  # offset of the later frame over displacement
        [-1.69, -0.5]
        >>> detection.save("vibration.json")  # doctest: +SKIP
        >>> detection = rsv.DetectionResult.load("vibration.json")  # doctest: +SKIP
    """

    offsets: OffsetCurve
    fitted: Tensor
    sensitivity: TimingSensitivity
    timing: SensorTiming | None = None

    @property
    def attitude(self) -> AttitudeTones | None:
        """Tones of pitch, yaw and roll in rad; None if no focal length was given."""
        return None if self.vibration.camera is None else AttitudeTones.of(self.vibration, self.std)

    def spectrum(self) -> DisplacementSpectrum:
        """Amplitude spectrum and power spectral density of the displacement, from the offset curve.

        Raises:
            ValueError: If it is a batch, the timing is unknown, or fewer than 8 offsets were measured.
        """
        if self.timing is None:
            raise ValueError("timing unknown: replace(result, timing=SensorTiming(...)) has a spectrum")
        return displacement_spectrum(self.offsets, self.timing, self.vibration, self.fitted)

    def plot_spectrum(self, path: str | os.PathLike[str] | None = None) -> "Figure":
        """Draw ``spectrum``; ``path`` as in ``plot``."""
        return self.spectrum().plot(path)

    def to_dict(self) -> Table:
        """All values as nested lists, numbers and texts, as in a ``vibration.json``; None for unknown numbers."""
        values = super().to_dict()
        values["period"] = plain_values(self.vibration.period)
        curve = {name: values.pop(name) for name in ("offsets", "fitted")}  # long, therefore last
        return values | curve

    def _middle_time(self, batch: tuple[int, ...]) -> float | None:
        curve, exposure_time = self.offsets, 0.0 if self.timing is None else self.timing.exposure_time
        part = batch if curve.times.ndim > 2 else ()  # stacks of one timing have their times in common
        return 0.5 * (float(curve.times[part].min()) + float(curve.later_times[part].max()) + exposure_time)

    def with_axes(self, count: int) -> "DetectionResult":
        """The result with the first axes of (x, y, roll, zoom) only."""
        batch = len(self.batch_shape)

        def first(values: Tensor) -> Tensor:
            """The first axes of values (..., A), or (..., A, K) of tones."""
            return values[..., :count, :] if values.ndim == batch + 2 else values[..., :count]

        def of_findings(findings: Findings, depth: int) -> Findings:
            return findings[:count] if depth == 0 else tuple(of_findings(part, depth - 1) for part in findings)

        curve, hidden = self.offsets, self.std_if_hidden_tone
        std = None if curve.std is None else curve.std[..., :count]
        return replace(
            self,
            vibration=self.vibration.mapped(first),
            std=self.std.mapped(first),
            std_if_hidden_tone=None if hidden is None else hidden.mapped(first),
            gain=first(self.gain),
            residual=first(self.residual),
            reliable=first(self.reliable),
            findings=of_findings(self.findings, batch),
            offsets=replace(curve, offsets=curve.offsets[..., :count], std=std),
            fitted=self.fitted[..., :count],
            sensitivity=self.sensitivity.mapped(first),
        )
