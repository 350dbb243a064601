"""Sinusoidal vibration with an image motion (Eqs. 1-8 and 24 of Liu et al. 2023)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import torch
from torch import Tensor
from torch.nn import functional

from rsvib_torch.checks.arguments import as_numbers, check_broadcast, checked_methods, checks_arguments
from rsvib_torch.checks.values import check_number, check_whole_number
from rsvib_torch.motion.camera import Camera
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import MAX_BATCH, SensorTiming, row_axes
from rsvib_torch.numerics.tables import Array
from rsvib_torch.results.presentation import Result, axis_head, axis_rows
from rsvib_torch.text import measured_text, text_table

_UNITS = {
    "amplitude": "px; of roll rad, of zoom 1",
    "frequency": "Hz",
    "period": "s",
    "phase": "rad at the first row of frame 0",
    "image_motion": "px/s; of roll rad/s, of zoom 1/s",
    "image_acceleration": "px/s^2; of roll rad/s^2, of zoom 1/s^2",
    "image_shift": "px; of roll rad, of zoom 1",
}
_QUANTITIES = ("amplitude", "frequency", "phase")
_POLYNOMIAL = ("image_motion", "image_acceleration", "image_shift")

# Largest values: beyond the largest image, the fastest row, and what float64 angles and positions resolve.
_LIMITS = {
    "amplitude": 1e6,
    "frequency": 1e9,
    "phase": 1e9,
    "image_motion": 1e9,
    "image_acceleration": 1e12,
    "image_shift": 1e6,
}
_NOT_NEGATIVE = ("amplitude", "frequency")
_MAX_BLIND = 10_000_000  # blind frequencies; 80 MB

TensorLike = Tensor | Array | float | Sequence[float] | Sequence[Sequence[float]]


def _per_tone(values: dict[str, TensorLike], device: torch.device | None) -> list[Tensor]:
    """Convert floats, (A,), (A, K) or (..., A, K) values to (..., A, K) float64 tensors with the same number A."""
    tensors, axes = {}, 0
    for name, value in values.items():
        tensor = as_numbers(name, value, device)
        tensors[name] = tensor if tensor.ndim == 0 else tensor[:, None] if tensor.ndim == 1 else tensor
        if tensor.ndim == 0:
            continue
        count = tensors[name].shape[-2]
        if not 2 <= count <= 4 or tensors[name].shape[-1] == 0 or axes not in (0, count):
            counts = "" if axes in (0, count) else f"; the other values have {axes} axes"
            raise ValueError(
                f"{name} must have shape (2,), (2, K) or (..., 2, K) for axes (x, y), with 3 for (x, y, roll) and 4 "
                f"for (x, y, roll, zoom), got {tuple(tensor.shape)}{counts}"
            )
        axes = count
    return [tensor.expand(axes or 2, 1) if tensor.ndim == 0 else tensor for tensor in tensors.values()]


def _per_axis(name: str, value: TensorLike, axes: int, device: torch.device | None) -> Tensor:
    """Convert a float, (2,) or (..., 2) value, or one with all axes, to a (..., A) float64 tensor."""
    tensor = as_numbers(name, value, device)
    tensor = tensor.expand(2) if tensor.ndim == 0 else tensor
    if tensor.shape[-1] not in (2, axes):
        raise ValueError(
            f"{name} must have shape (..., 2) for axes (x, y), or (..., {axes}) for all axes, got {tuple(tensor.shape)}"
        )
    return functional.pad(tensor, (0, axes - tensor.shape[-1]))


def _check_values(values: dict[str, Tensor]) -> None:
    """Raise a ValueError for values that are not finite or too large, and for negative amplitudes or frequencies."""
    # one transfer: the smallest and the largest value of each quantity that is not empty, NaN if one is
    ends = {name: torch.stack(tensor.detach().aminmax()) for name, tensor in values.items() if tensor.numel()}
    for name, (low, high) in zip(ends, torch.stack([*ends.values()]).tolist() if ends else (), strict=True):
        limit = _LIMITS[name]
        if not (math.isfinite(low) and math.isfinite(high)):
            raise ValueError(f"{name} must be finite")
        if max(-low, high) > limit:
            unit = _UNITS[name].partition(" at")[0]
            raise ValueError(f"{name} must be at most {limit:g} {unit}, got {max(-low, high):g}")
        if name in _NOT_NEGATIVE and low < 0:
            raise ValueError(f"{name} must not be negative, got {low:g}")


@dataclass(frozen=True, eq=False, repr=False)
@checked_methods
class Vibration(
    Motion, units=_UNITS, shapes={**dict.fromkeys(_QUANTITIES, "... A K"), **dict.fromkeys(_POLYNOMIAL, "... A")}
):
    """Sinusoidal displacement of the image on the sensor, with an image motion.

    ``D(t) = sum_k A_k sin(2 pi f_k t + phi_k) + v t + a t^2 / 2 + c`` per axis (Eq. 1 of Liu et al. 2023, several
    tones, Sec. 2.3; in the paper a = c = 0): scene content at ``s`` appears at ``s + D(t)``. Axes are
    ordered (x, y). Tones are sorted by amplitude, largest first; an axis with fewer tones than the other has
    amplitude 0 for the remaining ones.

    With three or four axes, the camera also rolls about the optical axis by theta(t) in rad, and its scale changes by
    zeta(t): content at (x, y) px from the centre of the frame is displaced by
    ``(X - theta y + zeta x, Y + theta x + zeta y)``.

    Args:
        amplitude: A >= 0: a float, ``(2,)`` (one tone per axis, px), ``(2, K)`` or ``(..., 2, K)`` for a batch; 3
            instead of 2 for the axes (x, y, roll), roll in rad, and 4 for (x, y, roll, zoom), zoom relative.
        frequency: f >= 0 in Hz, same shape.
        phase: phi in rad at the time origin (exposure start of the first row of frame 0), same shape.
        image_motion: v in px/s at the time origin, ``(2,)`` or ``(..., 2)``; with roll and zoom also one value for
            each axis, in rad/s and 1/s.
        image_acceleration: a in px/s^2, same shape.
        image_shift: c in px, same shape: a constant displacement. Frames do not determine it, so that detected
            vibrations have none.
        camera: Focal length and lens, for displacements that follow a rotation of the camera exactly; X and Y are then
            those at the principal point.

    Raises:
        ValueError: If shapes do not fit, a value is not finite, or an amplitude or frequency is negative.

    Example:
        >>> vibration = Vibration(amplitude=[3.1, 5.2], frequency=[50.0, 30.0], phase=[0.0, 1.0])
        >>> vibration
        axis  amplitude (px)  frequency (Hz)  phase (rad)
        x     3.100           50.00           0.000
        y     5.200           30.00           1.000
        >>> vibration.period[0].item()
        0.02
        >>> round(vibration.displacement(torch.tensor(0.005)).tolist()[0], 6)
        3.1
    """

    amplitude: Tensor
    frequency: Tensor
    phase: Tensor
    image_motion: Tensor
    image_acceleration: Tensor
    image_shift: Tensor = field(default_factory=lambda: torch.zeros(2, dtype=torch.float64))  # in files without it
    camera: Camera | None = None

    def __init__(
        self,
        amplitude: TensorLike,
        frequency: TensorLike,
        phase: TensorLike = 0.0,
        image_motion: TensorLike = (0.0, 0.0),
        image_acceleration: TensorLike = (0.0, 0.0),
        image_shift: TensorLike = (0.0, 0.0),
        camera: Camera | None = None,
    ) -> None:
        inputs = (amplitude, frequency, phase, image_motion, image_acceleration, image_shift)
        device = next((value.device for value in inputs if isinstance(value, Tensor)), None)
        tones = _per_tone({"amplitude": amplitude, "frequency": frequency, "phase": phase}, device)
        axes = tones[0].shape[-2]
        polynomial = [_per_axis(name, value, axes, device) for name, value in zip(_POLYNOMIAL, inputs[3:], strict=True)]
        try:
            tones = list(torch.broadcast_tensors(*tones))
            # torch.broadcast_shapes takes 40 us, and its first call imports sympy (0.3 s)
            firsts = [tones[0][..., 0, 0], *(values[..., 0] for values in polynomial)]
            batch = torch.broadcast_tensors(*firsts)[0].shape
        except RuntimeError as error:
            shapes = ", ".join(str(tuple(values.shape)) for values in (*tones, *polynomial))
            raise ValueError(f"amplitude, frequency, phase and image_motion do not fit together: {shapes}") from error
        _check_values(dict(zip(_LIMITS, (*tones, *polynomial), strict=True)))
        tones = [tensor.expand(*batch, *tensor.shape[-2:]) for tensor in tones]
        if tones[0].shape[-1] > 1:  # sorted
            order = tones[0].detach().argsort(dim=-1, descending=True, stable=True)
            tones = [tensor.take_along_dim(order, dim=-1) for tensor in tones]
        polynomial = [values.expand(*batch, axes) for values in polynomial]
        vars(self).update(zip(_LIMITS, (*tones, *polynomial), strict=True), camera=camera)

    @classmethod
    def still(cls, batch_shape: Sequence[int] = (), device: torch.device | str | None = None, *, axes: int = 2) -> Self:
        """No vibration and no image motion: the camera stands still."""
        sizes = [check_whole_number("batch_shape", size, at_least=1, at_most=MAX_BATCH) for size in batch_shape]
        if math.prod(sizes) > MAX_BATCH:
            raise ValueError(f"batch_shape must have at most {MAX_BATCH} motions, got {tuple(sizes)}")
        check_whole_number("axes", axes, at_least=2, at_most=4)
        zeros = torch.zeros(*sizes, axes, 1, dtype=torch.float64, device=device)
        return cls(zeros, zeros, zeros, zeros[..., 0], zeros[..., 0], zeros[..., 0])

    @classmethod
    def from_parameters(cls, parameters: Tensor) -> Self:
        """A batch of vibrations from one tensor, without checks and without another order of the tones.

        The parameters are (B, A, 3 K + 3) float64: amplitudes, frequencies and phases of the K tones, largest first,
        then image motion, image acceleration and image shift.
        """
        tones = (parameters.shape[-1] - 3) // 3
        *tone_values, polynomial = parameters.split([tones, tones, tones, 3], -1)
        values = dict(zip(_LIMITS, (*tone_values, *polynomial.unbind(-1)), strict=True))
        return cls.__new__(cls)._changed(**values, camera=None)

    @property
    def parameters(self) -> Tensor:
        """All values as one tensor (..., A, 3 K + 3), as in ``from_parameters``."""
        polynomial = torch.stack([getattr(self, name) for name in _POLYNOMIAL], -1)
        return torch.cat([self.amplitude, self.frequency, self.phase, polynomial], -1)

    @classmethod
    def _of_equal_shapes(cls, results: Sequence[Self]) -> Sequence[Self]:
        """Vibrations with as many tones as the one with most; missing tones have amplitude 0."""
        most_tones = max(result.amplitude.shape[-1] for result in results)
        missing = [most_tones - result.amplitude.shape[-1] for result in results]
        return [
            result._changed(**{name: functional.pad(getattr(result, name), (0, tones)) for name in _QUANTITIES})
            for result, tones in zip(results, missing, strict=True)
        ]

    def scaled(self, factor: Tensor | float) -> "Vibration":
        """The vibration with its components multiplied by factors (..., A), or one factor, that are not negative."""
        factors = torch.as_tensor(factor, dtype=torch.float64, device=self.device)
        polynomial = {name: getattr(self, name) * factors for name in _POLYNOMIAL}
        return replace(self, amplitude=self.amplitude * factors[..., None], **polynomial)

    def translation(self) -> "Vibration":
        """The components x and y: the motion of the centre of the frame, without roll and zoom."""
        tones = {name: getattr(self, name)[..., :2, :] for name in _QUANTITIES}
        return self._changed(**tones, **{name: getattr(self, name)[..., :2] for name in _POLYNOMIAL}, camera=None)

    def summary(self) -> str:
        """The tones of each axis as a table."""
        table = text_table([*axis_head(self.batch_shape), *tone_head(self.num_axes)], tone_rows(self))
        return "\n".join([table, *image_motion_line(self)])

    @property
    def num_axes(self) -> int:
        """Number of components of the displacement."""
        return self.amplitude.shape[-2]

    @property
    def period(self) -> Tensor:
        """Period T = 1/f in seconds, (..., 2, K); infinite where the frequency is 0."""
        return 1.0 / self.frequency

    def _at(self, times: Tensor, values: Tensor) -> Tensor:
        """Values (..., A) or (..., A, K) of each motion, to broadcast with those at times S."""
        batch, steps = self.batch_shape, times.ndim - len(self.batch_shape)
        if steps < 0 or any(
            size != 1 and count not in (1, size) for size, count in zip(times.shape, batch, strict=False)
        ):
            raise ValueError(f"times must have the batch dimensions {tuple(batch)} in front, got {tuple(times.shape)}")
        return values.reshape(*batch, *(1,) * steps, *values.shape[len(batch) :])

    def _angle(self, times: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Angles (S, A, K) of the tones at times S, with amplitude and frequency reshaped to broadcast with them."""
        amplitude, frequency, phase = (self._at(times, getattr(self, name)) for name in _QUANTITIES)
        return torch.addcmul(phase, frequency, times[..., None, None], value=2 * math.pi), amplitude, frequency

    def drift(self, times: Tensor) -> Tensor:
        """Displacement v t + a t^2 / 2 of the image motion alone in px."""
        times = times.to(dtype=torch.float64, device=self.device)
        velocity, acceleration = self._at(times, self.image_motion), self._at(times, self.image_acceleration)
        return torch.addcmul(velocity, acceleration, times[..., None], value=0.5) * times[..., None]

    def displacement(self, times: Tensor) -> Tensor:
        """Displacement D(t) in px (Eq. 1), as in ``Motion.displacement``."""
        times = times.to(dtype=torch.float64, device=self.device)
        angle, amplitude, _ = self._angle(times)
        return (amplitude * angle.sin()).sum(-1) + self.drift(times) + self._at(times, self.image_shift)

    def mean_displacement(self, starts: Tensor, exposure_time: float | Tensor) -> Tensor:
        """Mean displacement over exposures [start, start + T_e] in px (Eq. 2), as in ``Motion.mean_displacement``.

        A tone keeps its angle at mid-exposure and is attenuated by sinc(f T_e).
        """
        check_broadcast(starts=starts, exposure_time=exposure_time)
        middle = starts.to(dtype=torch.float64, device=self.device) + 0.5 * exposure_time
        exposure = exposure_time[..., None] if isinstance(exposure_time, Tensor) else exposure_time
        angle, amplitude, frequency = self._angle(middle)
        attenuation = torch.sinc(frequency * (exposure[..., None] if isinstance(exposure, Tensor) else exposure))
        tones = (amplitude * attenuation * angle.sin()).sum(-1)
        motion, acceleration, shift = (self._at(middle, getattr(self, name)) for name in _POLYNOMIAL)
        motion = torch.addcmul(motion, acceleration, middle[..., None], value=0.5)
        return torch.addcmul(tones + shift, motion, middle[..., None]) + acceleration * (exposure**2 / 24)

    def gain(self, interval: float) -> Tensor:
        """Gain 2 sin(pi f m T_row) from displacement to offset over ``interval`` seconds (Eq. 7), (..., 2, K).

        It may be negative (its sign is then a phase of pi) and is 0 at a blind frequency.
        """
        return 2.0 * torch.sin(math.pi * self.frequency * interval)

    def largest_oscillation(self) -> Tensor:
        """Sum of the amplitudes of the tones and of the constant displacement, (..., 2), in px."""
        return self.amplitude.detach().sum(-1) + self.image_shift.detach().abs()

    def displacement_within(self, duration: float) -> Tensor:
        """Bound on the displacement between two times as in ``Motion.displacement_within`` (Eq. 24, sum of tones).

        Condition (24): the discrete point spread function of Eqs. (25)-(39) requires less than 0.1 px in a row time.
        """
        cycles = self.frequency * duration
        path = torch.where(cycles < 0.5, 2.0 * torch.sin(math.pi * cycles), 4.0 * cycles)
        return ((self.amplitude * path).sum(-1) + self.image_motion.abs() * duration).detach()

    def periods_within(self, duration: float) -> Tensor:
        """Periods of the fastest tone in ``duration`` seconds, (..., 2).

        Tones below 1e-4 px do not count, roll and zoom below 1e-7: 1e-4 px at 1000 px from the centre.
        """
        smallest = self.amplitude.new_tensor([1e-4, 1e-4, 1e-7, 1e-7][: self.amplitude.shape[-2]])
        return torch.where(self.amplitude > smallest[:, None], self.frequency * duration, 0.0).amax(-1).detach()

    def with_axes(self, order: Sequence[int], signs: Sequence[float]) -> Self:
        """The vibration whose component k is ``signs[k]`` times component ``order[k]``; amplitudes stay positive."""
        self._check_axes(order, signs)
        sign = torch.tensor(signs, dtype=torch.float64, device=self.device)
        axes = list(order)
        phase = self.phase[..., axes, :]
        opposite = torch.remainder(phase + 2 * math.pi, 2 * math.pi) - math.pi
        return self._changed(
            amplitude=self.amplitude[..., axes, :],
            frequency=self.frequency[..., axes, :],
            phase=torch.where(sign[:, None] < 0, opposite, phase),
            **{name: getattr(self, name)[..., axes] * sign for name in _POLYNOMIAL},
            camera=None if self.camera is None else self.camera.with_axes(order, signs),
        )


@dataclass(frozen=True, eq=False, repr=False)
@checked_methods
class VibrationStd(
    Result,
    units=_UNITS | {"displacement": "px"},
    shapes={
        **dict.fromkeys(("amplitude", "frequency", "period", "phase"), "... A K"),
        **dict.fromkeys(("image_motion", "image_acceleration", "displacement"), "... A"),
    },
):
    """Standard deviations in the layout of ``Vibration``: px, Hz, s, rad (..., 2, K), px/s and px/s^2 (..., 2).

    ``displacement`` (..., 2) in px is that of the displacement of the rows of the record, rms over the rows and without
    their mean. It contains the image motion and the correlations of all parameters: a record shorter than a period
    leaves amplitude and frequency uncertain, and may still determine the displacement. None: not known.
    """

    _MISSING = math.inf  # None in a file: an unknown standard deviation

    amplitude: Tensor
    frequency: Tensor
    period: Tensor
    phase: Tensor
    image_motion: Tensor
    image_acceleration: Tensor
    displacement: Tensor | None = None

    def summary(self) -> str:
        """Standard deviations of the tones of each axis as a table."""
        rows = [
            [*labels, *(measured_text(getattr(self, name)[at], digits=2) for name in _QUANTITIES)]
            for at, labels in tone_places(self)
        ]
        head = [*axis_head(self.batch_shape), *tone_head(self.amplitude.shape[-2])]
        return "standard deviations\n" + text_table(head, rows)

    def from_row_order(self, timing: SensorTiming) -> "VibrationStd":
        """The standard deviations, given in row order, in image axes: as ``Motion.from_row_order`` without signs."""
        order, axes = row_axes(timing, self.amplitude.shape[-2])[0], self.image_motion.ndim
        return self.mapped(lambda values: values[..., order] if values.ndim == axes else values[..., order, :])


# Text


def tone_places(values: Vibration | VibrationStd) -> list[tuple[tuple[int, ...], list[str]]]:
    """Index (..., axis, tone) of every tone, and the first cells of its row; an axis without a tone has one row."""
    axes, count = values.amplitude.shape[-2:]
    rows = [((*at, tone), labels) for at, labels in axis_rows(values.batch_shape, axes) for tone in range(count)]
    return [(at, labels) for at, labels in rows if at[-1] == 0 or float(values.amplitude[at]) > 0]


def tone_head(axes: int) -> list[str]:
    """Heads of the columns of ``tone_rows`` behind the axis, for motions with this number of axes."""
    unit = ("px", "px; roll: rad", "px; roll: rad; zoom: 1")[axes - 2]
    return [f"amplitude ({unit})", "frequency (Hz)", "phase (rad)"]


def tone_rows(
    vibration: Vibration, std: VibrationStd | None = None, hidden: VibrationStd | None = None
) -> list[list[str]]:
    """Rows of a table of tones.

    Standard deviations if a further tone is ``hidden`` are added where they are larger, but for phases: a line of a
    terminal has 80 characters.
    """

    def cell(name: str, at: tuple[int, ...]) -> str:
        uncertainty = None if std is None else getattr(std, name)[at]
        if_hidden = None if hidden is None or name == "phase" else getattr(hidden, name)[at]
        return measured_text(getattr(vibration, name)[at], uncertainty, hidden=if_hidden)

    return [
        [*labels, *([cell(name, at) for name in _QUANTITIES] if vibration.amplitude[at] > 0 else ["no tone", "", ""])]
        for at, labels in tone_places(vibration)
    ]


def image_motion_line(vibration: Vibration, std: VibrationStd | None = None) -> list[str]:
    """A line with the image motion of one vibration, if it exceeds 1 px/s and four standard deviations."""
    if vibration.batch_shape:
        return []
    speeds = vibration.image_motion[:2].tolist()
    stds = [0.0, 0.0] if std is None else std.image_motion[:2].tolist()
    if not any(math.isfinite(e) and abs(v) > max(4 * e, 1.0 if e else 0.0) for v, e in zip(speeds, stds, strict=True)):
        return []
    texts = [measured_text(v, e or None) for v, e in zip(speeds, stds, strict=True)]
    return [f"image motion {texts[0]} px/s along x, {texts[1]} px/s along y"]


@checks_arguments
def blind_frequencies(timing: SensorTiming, highest: float) -> Tensor:
    """Frequencies up to ``highest`` Hz that cannot be measured from the frames, sorted, float64.

    ``j / (m T_row)``: every frame is displaced alike (the gain of Eq. 7 is zero). ``j / T_e``: the exposure averages
    the tone out (the sinc of Eq. 2 is zero). With individual frame start times, only frequencies for which all frames
    are displaced alike are blind; for two frames, ``j`` over the time between them.

    Example:
        >>> timing = SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)
        >>> [round(f, 1) for f in blind_frequencies(timing, 50.0).tolist()]
        [23.8, 47.6]
    """
    starts = timing.frame_starts(len(timing.frame_start_times) if timing.frame_start_times else 2)
    intervals = starts[1:] - starts[0]
    longest = max([timing.exposure_time, *intervals[:1].tolist()])
    check_number("highest", highest, at_least=0.0, at_most=_MAX_BLIND / longest)

    def multiples(interval: float) -> Tensor:
        return torch.arange(1, math.floor(highest * interval) + 1, dtype=torch.float64, device="cpu") / interval

    blind = multiples(float(intervals[0])) if len(intervals) else starts[:0]
    cycles = blind[:, None] * intervals
    blind = blind[((cycles - cycles.round()).abs() < 1e-6).all(-1)]  # whole cycles to the rounding of the start times
    return torch.cat([blind, multiples(timing.exposure_time)]).unique(sorted=True)
