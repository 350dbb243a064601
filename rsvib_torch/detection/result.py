"""Result of detection: vibration, standard deviations, verdict, and the offset curve."""

import math
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.core.presentation import Result, axis_head, axis_rows, plain_values
from rsvib_torch.core.text import measured_text, text_table
from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.motion.detected_vibration import detection_summary
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration, VibrationStd
from rsvib_torch.registration import OffsetCurve

__all__ = ["AttitudeTones", "DetectionResult", "OtherMotion", "TimingSensitivity", "stacked"]


@dataclass(frozen=True, eq=False)
class OtherMotion:
    """Motion of the rows that no vibration explains, for each axis in px, without the part that noise explains.

    Attributes:
        size: (..., 2) rms offset of the rows by the tones, for comparison.
        unexplained: (..., 2) rms residual displacement of the fit.
        correlated: (..., 2) the part of it that neighbouring rows have in common.
        differential: (..., 2) rms difference of the residual displacements of the left and right halves of the rows.
        measured: (...) fraction of the visible rows whose displacement was measured.
        blur: (..., 3) measured difference of the blur of the frames relative to the expected one, its standard
            deviation, and the size of the expected difference relative to the detail of the scene.
    """

    size: Tensor
    unexplained: Tensor
    correlated: Tensor
    differential: Tensor
    measured: Tensor
    blur: Tensor

    @classmethod
    def of(cls, measurements: Measurements, by_tones: Tensor, residual: Tensor, differential: Tensor) -> "OtherMotion":
        """From displacements (B, N, G, 2) of rows by the tones, and those left; the blur counts as expected."""
        visible = measurements.num_differences > 0
        measured = visible & (measurements.weights > 0).any(-1)
        return cls(
            size=math.sqrt(2) * measurements.distances(by_tones).square().nanmean(1).sqrt(),
            unexplained=measurements.unexplained(residual),
            correlated=measurements.correlated(residual),
            differential=differential,
            measured=measured.double().sum(1) / visible.double().sum(1).clamp(min=1.0),
            blur=residual.new_tensor([1.0, 0.0, 0.0]).expand(len(residual), 3),
        )

    @property
    def permitted(self) -> Tensor:
        """(..., 2) px, largest ``unexplained`` of a reliable axis: errors of interpolation and of unequal blur."""
        return (0.006 * self.size).clamp(min=0.05)

    def __getitem__(self, index: int) -> "OtherMotion":
        """The part of one stack out of a batch."""
        return OtherMotion(*(getattr(self, field.name)[index] for field in fields(self)))


_TONE_VALUES = ("amplitude", "frequency")
_SENSITIVITY_SHAPES = {
    f"{value}_by_{time}": "... A K" for time in ("row_time", "frame_rows", "exposure_rows") for value in _TONE_VALUES
}


@dataclass(frozen=True, eq=False, repr=False)
class TimingSensitivity(Result, shapes=_SENSITIVITY_SHAPES):
    """Relative change of amplitudes and frequencies over the relative change of a stated time.

    ``d ln A / d ln frame_rows = 3`` means that an amplitude becomes 3 % larger if ``frame_rows`` is stated 1 % larger
    and the frames are the same. All values have the shape (..., 2, K), axes (x, y), 0 where there is no tone. A change
    of ``row_time`` changes exposure time and frame period alike; with ``frame_start_times``, ``frame_rows`` has no
    effect.

    Attributes:
        amplitude_by_row_time: d ln A / d ln row_time.
        amplitude_by_frame_rows: d ln A / d ln frame_rows.
        amplitude_by_exposure_rows: d ln A / d ln exposure_rows.
        frequency_by_row_time: d ln f / d ln row_time.
        frequency_by_frame_rows: d ln f / d ln frame_rows.
        frequency_by_exposure_rows: d ln f / d ln exposure_rows.
    """

    amplitude_by_row_time: Tensor
    amplitude_by_frame_rows: Tensor
    amplitude_by_exposure_rows: Tensor
    frequency_by_row_time: Tensor
    frequency_by_frame_rows: Tensor
    frequency_by_exposure_rows: Tensor

    @property
    def batch_shape(self) -> torch.Size:
        """Leading dimensions: empty for one result, (B,) for a batch of stacks or windows."""
        return self.amplitude_by_row_time.shape[:-2]

    def summary(self) -> str:
        """Changes of the strongest tone of each axis if a time is stated 1 % larger."""
        rows = [
            [*labels, name, *(f"{float(getattr(self, f'{of}_by_{name}')[at][0]):+.2f}" for of in _TONE_VALUES)]
            for at, labels in axis_rows(self.batch_shape)
            for name in ("row_time", "frame_rows", "exposure_rows")
        ]
        return text_table([*axis_head(self.batch_shape), "1 % of", *(f"{of} (%)" for of in _TONE_VALUES)], rows)

    def __getitem__(self, index: int) -> "TimingSensitivity":
        """The part of one stack out of a batch."""
        return TimingSensitivity(*(getattr(self, field.name)[index] for field in fields(self)))


@dataclass(frozen=True, eq=False, repr=False)
class AttitudeTones(
    Result,
    units={"amplitude": "rad", "amplitude_std": "rad", "frequency": "Hz", "frequency_std": "Hz", "phase": "rad"},
    shapes=dict.fromkeys(("amplitude", "amplitude_std", "frequency", "frequency_std", "phase", "phase_std"), "... 3 K"),
):
    """Vibration of the attitude of the camera: tones of pitch, yaw and roll with standard deviations, (..., 3, K).

    The rotation is right-handed about the axes x (right), y (down) and z (forward) of the camera, see ``Camera``. Roll
    that was not measured has amplitude 0 and a standard deviation of infinity.

    Attributes:
        amplitude: rad.
        amplitude_std: rad.
        frequency: Hz.
        frequency_std: Hz.
        phase: rad at the time origin.
        phase_std: rad.
    """

    amplitude: Tensor
    amplitude_std: Tensor
    frequency: Tensor
    frequency_std: Tensor
    phase: Tensor
    phase_std: Tensor

    @classmethod
    def of(cls, vibration: Vibration, std: VibrationStd) -> "AttitudeTones":
        """The tones of a vibration with a camera."""
        camera = vibration.camera
        if camera is None:
            raise ValueError("the attitude requires a vibration with a camera")
        focal_length = camera.focal_length

        def turned(values: Tensor, factors: tuple[float, float, float], without_roll: float) -> Tensor:
            x, y = values[..., 0, :], values[..., 1, :]
            roll = values[..., 2, :] if values.shape[-2] > 2 else torch.full_like(x, without_roll)
            return torch.stack([factors[0] * y, factors[1] * x, factors[2] * roll], -2)

        lengths, ones = (1 / focal_length, 1 / focal_length, 1.0), (1.0, 1.0, 1.0)
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

    @property
    def batch_shape(self) -> torch.Size:
        """Leading dimensions: empty for one result, (B,) for a batch of stacks or windows."""
        return self.amplitude.shape[:-2]

    def summary(self) -> str:
        """The tones as a table; of a batch, the strongest of each axis."""
        shown = self.amplitude[..., : 1 if self.batch_shape else None]
        rows = [
            [
                *([", ".join(map(str, batch))] if batch else []),
                ("pitch", "yaw", "roll")[axis],
                measured_text(1e3 * self.amplitude[at], 1e3 * self.amplitude_std[at]),
                measured_text(self.frequency[at], self.frequency_std[at]),
                measured_text(self.phase[at], self.phase_std[at]),
            ]
            for at in map(tuple, shown.nonzero().tolist())
            for *batch, axis, _ in [at]
        ]
        return text_table([*axis_head(self.batch_shape), "amplitude (mrad)", "frequency (Hz)", "phase (rad)"], rows)


@dataclass(frozen=True, eq=False, repr=False)
class DetectionResult(
    Result,
    units={**Vibration.units, "residual": "px", "gain": "px of offset per px of displacement", "offsets": "s and px"},
    shapes={"gain": "... A K", "residual": "... A", "reliable": "... A", "fitted": "... P N A"},
    file_format="rsvib vibration",
):
    """A detected vibration with its uncertainty and verdict. Batches of stacks or windows lead all tensors.

    Attributes:
        vibration: The vibration in image axes; an axis without a significant tone has amplitude 0.
        std: Standard deviations of its parameters.
        offsets: The measured offset curve.
        fitted: (..., P, N, 2) px, offsets of the same bands predicted by the vibration.
        gain: (..., 2, K) offset gain of Eq. (7) from displacement to offset; a tone with a gain near 0 is nearly blind.
        residual: (..., 2) px, mean absolute difference of measured and fitted offsets.
        reliable: (..., 2) bool, verdict for each axis.
        reasons: Reasons against each axis (x, y) that is not reliable; a tuple of those for a batch.
        sensitivity: Effect of the stated timing on amplitudes and frequencies.
        assumptions: What the frames cannot contradict, one sentence for each; a tuple of those for a batch.
        timing: The sensor of the frames.

    ``save`` writes a ``vibration.json`` as the program does, which ``rsvib restore`` and ``read_vibration`` read.

    Example:
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.evaluation import city_and_fields
        >>> timing = rsv.SensorTiming(row_time=40e-6, exposure_rows=20, frame_rows=300)
        >>> vibration = rsv.Vibration(amplitude=[2.1, 1.6], frequency=[110.0, 90.0], phase=[0.5, 1.0])
        >>> frames = rsv.simulate_frames(city_and_fields(320, 240, seed=3), timing, vibration, num_frames=2)
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

    vibration: Vibration
    std: VibrationStd
    offsets: OffsetCurve
    fitted: Tensor
    gain: Tensor
    residual: Tensor
    reliable: Tensor
    reasons: tuple[Any, ...]
    sensitivity: TimingSensitivity
    assumptions: tuple[Any, ...]
    timing: SensorTiming | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        shape = tuple(self.batch_shape)
        if (tuple(self.std.batch_shape), tuple(self.reliable.shape[:-1])) != (shape, shape):
            raise ValueError(
                f"vibration, std and reliable must have the same batch dimensions, got {shape}, "
                f"{tuple(self.std.batch_shape)} and {tuple(self.reliable.shape[:-1])}"
            )
        if not shape and not all(isinstance(sentence, str) for sentence in self.assumptions):
            raise TypeError("assumptions must be texts")

    @property
    def batch_shape(self) -> torch.Size:
        """Leading dimensions: empty for one result, (B,) for a batch of stacks or windows."""
        return self.vibration.batch_shape

    def summary(self) -> str:
        """Tones of each axis with standard deviations, then the verdict; of a batch, a table with one row per axis."""
        return detection_summary(self)

    @property
    def attitude(self) -> AttitudeTones | None:
        """Tones of pitch, yaw and roll in rad; None if no focal length was given."""
        return None if self.vibration.camera is None else AttitudeTones.of(self.vibration, self.std)

    def to_dict(self) -> dict[str, Any]:
        """All values as nested lists, numbers and texts, as in a ``vibration.json``; None for unknown numbers."""
        values = super().to_dict()
        values["period"] = plain_values(self.vibration.period)
        curve = {name: values.pop(name) for name in ("offsets", "fitted")}  # long, therefore last
        return values | curve

    def refused(self, index: int, reason: str) -> "DetectionResult":
        """The results of a batch with a further reason against all axes of one stack."""
        reliable, reasons = self.reliable.clone(), list(self.reasons)
        reliable[index] = False
        reasons[index] = tuple((reason, *of_axis) for of_axis in reasons[index])
        return replace(self, reliable=reliable, reasons=tuple(reasons))

    def with_axes(self, count: int) -> "DetectionResult":
        """The result with the first axes of (x, y, roll, zoom) only."""
        batch = len(self.batch_shape)

        def first(values: Tensor) -> Tensor:
            return values[..., :count]

        def of_tones(values: Any) -> Any:
            kept = {
                name: (v[..., :count, :] if v.ndim == batch + 2 else v[..., :count]) if isinstance(v, Tensor) else v
                for name, v in vars(values).items()
            }
            return type(values)(**kept)

        def of_reasons(reasons: tuple[Any, ...], depth: int) -> tuple[Any, ...]:
            return reasons[:count] if depth == 0 else tuple(of_reasons(part, depth - 1) for part in reasons)

        curve = replace(
            self.offsets,
            offsets=first(self.offsets.offsets),
            std=None if self.offsets.std is None else first(self.offsets.std),
        )
        return replace(
            self,
            vibration=of_tones(self.vibration),
            std=of_tones(self.std),
            offsets=curve,
            fitted=first(self.fitted),
            gain=self.gain[..., :count, :],
            residual=first(self.residual),
            reliable=first(self.reliable),
            reasons=of_reasons(self.reasons, batch),
            sensitivity=of_tones(self.sensitivity),
        )

    def __getitem__(self, index: int) -> "DetectionResult":
        """The result of one stack out of a batch."""
        return DetectionResult(
            self.vibration[index],
            self.std[index],
            self.offsets[index],
            self.fitted[index],
            self.gain[index],
            self.residual[index],
            self.reliable[index],
            self.reasons[index],
            self.sensitivity[index],
            self.assumptions[index],
            self.timing,
        )


def stacked(results: list[DetectionResult]) -> DetectionResult:
    """Results of the windows of a batch of stacks as one result (B, number of windows, ...).

    Tones that are missing in some windows have amplitude 0 there.
    """
    tones = max(result.gain.shape[-1] for result in results)

    def joined(values: list[Tensor]) -> Tensor:
        return torch.stack(values, dim=1)

    def padded(values: list[Tensor]) -> Tensor:
        return joined([functional.pad(value, (0, tones - value.shape[-1])) for value in values])

    def parameters(parts: list[Any], kind: type[Any]) -> dict[str, Tensor]:
        names = [field.name for field in fields(kind) if field.name != "camera"]
        values = {name: [getattr(part, name) for part in parts] for name in names}
        axes = results[0].gain.ndim  # of values with an entry for each tone
        return {name: padded(v) if v[0].ndim == axes else joined(v) for name, v in values.items()}

    curves = [result.offsets for result in results]
    batch = curves[0].offsets.shape[0]
    return DetectionResult(
        vibration=Vibration(
            **parameters([result.vibration for result in results], Vibration), camera=results[0].vibration.camera
        ),
        std=VibrationStd(**parameters([result.std for result in results], VibrationStd)),
        offsets=OffsetCurve(
            curves[0].pairs,
            curves[0].rows,
            joined([curve.times.expand(batch, -1, -1) for curve in curves]),
            joined([curve.later_times.expand(batch, -1, -1) for curve in curves]),
            joined([curve.offsets for curve in curves]),
            joined([curve.quality for curve in curves]),
            curves[0].heights,
            joined([curve.std for curve in curves if curve.std is not None]) if curves[0].std is not None else None,
        ),
        fitted=joined([result.fitted for result in results]),
        gain=padded([result.gain for result in results]),
        residual=joined([result.residual for result in results]),
        reliable=joined([result.reliable for result in results]),
        reasons=tuple(tuple(result.reasons[index] for result in results) for index in range(batch)),
        sensitivity=TimingSensitivity(**parameters([result.sensitivity for result in results], TimingSensitivity)),
        assumptions=tuple(tuple(result.assumptions[index] for result in results) for index in range(batch)),
        timing=results[0].timing,
    )
