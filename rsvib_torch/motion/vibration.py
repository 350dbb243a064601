"""The vibration model: displacement, mean displacement over an exposure, offset between frames."""

import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from rsvib_torch.motion.timing import SensorTiming

__all__ = ["Vibration", "VibrationStd", "blind_frequencies"]

TensorLike = Tensor | float | Sequence[float] | Sequence[Sequence[float]]

_SAME_PLACE = 1e-6  # of a turn
_NOT_NEGATIVE = ("amplitude", "frequency")


def _tones(name: str, value: TensorLike, device: torch.device | None) -> Tensor:
    """Turn a float, (2,), (2, K) or (..., 2, K) value into a (..., 2, K) float64 tensor."""
    tensor = torch.as_tensor(value, dtype=torch.float64, device=device)
    if tensor.ndim == 0:
        tensor = tensor.expand(2)
    if tensor.ndim == 1:
        tensor = tensor[:, None]
    if tensor.shape[-2] != 2:
        raise ValueError(
            f"{name} must have shape (2,), (2, K) or (..., 2, K) for axes (x, y), got {tuple(tensor.shape)}"
        )
    return tensor


def _of_axes(name: str, value: TensorLike, device: torch.device | None) -> Tensor:
    """Turn a float, (2,) or (..., 2) value into a (..., 2) float64 tensor."""
    tensor = torch.as_tensor(value, dtype=torch.float64, device=device)
    tensor = tensor.expand(2) if tensor.ndim == 0 else tensor
    if tensor.shape[-1] != 2:
        raise ValueError(f"{name} must have shape (..., 2) for axes (x, y), got {tuple(tensor.shape)}")
    return tensor


def _check_values(values: dict[str, Tensor]) -> None:
    """Raise ValueError for values that are not finite, or negative where they must not be."""
    wrong = [~torch.isfinite(tensor).all() for tensor in values.values()]
    wrong += [(values[name] < 0).any() for name in _NOT_NEGATIVE]
    if not bool(torch.stack(wrong).any()):  # a device is waited for once
        return
    for name, tensor in values.items():
        if not bool(torch.isfinite(tensor).all()):
            raise ValueError(f"{name} must be finite")
    for name in _NOT_NEGATIVE:
        if bool((values[name] < 0).any()):
            raise ValueError(f"{name} must not be negative, got {values[name].min().item():g}")


@dataclass(frozen=True, eq=False)
class Vibration:
    """Sinusoidal displacement of the image on the sensor, with an image motion.

    ``D(t) = sum_k A_k sin(2 pi f_k t + phi_k) + v t + a t^2 / 2`` per axis (Eq. 1 of Liu et al. 2023, several tones,
    Sec. 2.3; the paper's image motion is uniform, a = 0): scene content at ``s`` appears at ``s + D(t)``. Axes are
    ordered (x, y). Tones are kept sorted by amplitude, largest first; an axis with fewer tones than the other has
    amplitude 0 in the rest.

    Args:
        amplitude: A >= 0 in px: a float, ``(2,)`` (one tone an axis), ``(2, K)`` or ``(..., 2, K)`` for a batch.
        frequency: f >= 0 in Hz, same shape.
        phase: phi in rad at the time origin (exposure start of the first row of frame 0), same shape.
        image_motion: v in px/s at the time origin, ``(2,)`` or ``(..., 2)``.
        image_acceleration: a in px/s^2, same shape.

    Raises:
        ValueError: If shapes do not fit, a value is not finite, or an amplitude or frequency is negative.

    Example:
        >>> vibration = Vibration(amplitude=[3.1, 5.2], frequency=[50.0, 30.0], phase=[0.0, 1.0])
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

    def __init__(
        self,
        amplitude: TensorLike,
        frequency: TensorLike,
        phase: TensorLike = 0.0,
        image_motion: TensorLike = (0.0, 0.0),
        image_acceleration: TensorLike = (0.0, 0.0),
    ) -> None:
        given = (amplitude, frequency, phase, image_motion, image_acceleration)
        device = next((value.device for value in given if isinstance(value, Tensor)), None)
        tones = [
            _tones(name, value, device)
            for name, value in (("amplitude", amplitude), ("frequency", frequency), ("phase", phase))
        ]
        motion = _of_axes("image_motion", image_motion, device)
        acceleration = _of_axes("image_acceleration", image_acceleration, device)
        try:
            tones = list(torch.broadcast_tensors(*tones))
            batch = torch.broadcast_shapes(tones[0].shape[:-2], motion.shape[:-1], acceleration.shape[:-1])
        except RuntimeError as error:
            shapes = ", ".join(str(tuple(t.shape)) for t in (*tones, motion, acceleration))
            raise ValueError(f"amplitude, frequency, phase and image_motion do not fit together: {shapes}") from error
        _check_values(dict(zip(Vibration.__dataclass_fields__, (*tones, motion, acceleration), strict=True)))
        tones = [tensor.expand(*batch, *tensor.shape[-2:]) for tensor in tones]
        order = tones[0].detach().argsort(dim=-1, descending=True, stable=True)
        for name, tensor in zip(("amplitude", "frequency", "phase"), tones, strict=True):
            object.__setattr__(self, name, tensor.take_along_dim(order, dim=-1))
        object.__setattr__(self, "image_motion", motion.expand(*batch, 2))
        object.__setattr__(self, "image_acceleration", acceleration.expand(*batch, 2))

    @property
    def period(self) -> Tensor:
        """Period T = 1/f in seconds, (..., 2, K); infinite where the frequency is 0."""
        return 1.0 / self.frequency

    @property
    def batch_shape(self) -> torch.Size:
        """Leading dimensions: empty for one vibration, (B,) for a batch of stacks."""
        return self.amplitude.shape[:-2]

    @property
    def device(self) -> torch.device:
        """Device of the parameters."""
        return self.amplitude.device

    def mapped(self, function: Callable[[Tensor], Tensor]) -> Self:
        """The same motion with every parameter put through a function that leaves its values as they are.

        Nothing is checked anew: a device need not be waited for.
        """
        result = copy(self)
        for name, value in vars(self).items():
            if isinstance(value, Tensor):
                object.__setattr__(result, name, function(value))
        return result

    def to(self, device: torch.device | str) -> Self:
        """The same motion on another device."""
        return self.mapped(lambda values: values.to(device))

    def detached(self) -> Self:
        """The same motion without gradients."""
        return self.mapped(Tensor.detach)

    def expanded(self, size: int) -> Self:
        """The same motion as a batch of ``size`` equal ones, whose dimension leads."""
        return self.mapped(lambda values: values.expand(size, *values.shape))

    def __getitem__(self, index: int) -> Self:
        """One motion out of a batch."""
        if not self.batch_shape:
            raise IndexError("this vibration is not a batch")
        return self.mapped(lambda values: values[index])

    @classmethod
    def still(cls, batch_shape: Sequence[int] = (), device: torch.device | str | None = None) -> Self:
        """No vibration and no image motion: the camera stands still."""
        zeros = torch.zeros(*batch_shape, 2, 1, dtype=torch.float64, device=device)
        return cls(zeros, zeros, zeros, zeros[..., 0], zeros[..., 0])

    def _angle(self, times: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Tone angles (..., S, 2, K) with amplitude and frequency shaped to match, for times (..., S)."""
        steps = times.ndim - len(self.batch_shape)
        if steps < 0:
            raise ValueError(
                f"times must have the batch dimensions {tuple(self.batch_shape)} in front, got {tuple(times.shape)}"
            )
        shape = (*self.batch_shape, *(1,) * steps, *self.amplitude.shape[-2:])
        amplitude, frequency, phase = (t.reshape(shape) for t in (self.amplitude, self.frequency, self.phase))
        return 2 * math.pi * frequency * times[..., None, None] + phase, amplitude, frequency

    def drift(self, times: Tensor) -> Tensor:
        """Displacement v t + a t^2 / 2 of the image motion alone in px; arguments and shapes as in ``displacement``."""
        times = times.to(dtype=torch.float64, device=self.device)[..., None]
        return (
            self._per_axis(self.image_motion, times) + 0.5 * self._per_axis(self.image_acceleration, times) * times
        ) * times

    def _per_axis(self, values: Tensor, times: Tensor) -> Tensor:
        """(..., 2) values shaped to match times (..., S, 1)."""
        return values.reshape(*self.batch_shape, *(1,) * (times.ndim - 1 - len(self.batch_shape)), 2)

    def displacement(self, times: Tensor) -> Tensor:
        """Displacement D(t) in px (Eq. 1).

        Args:
            times: Seconds, any shape S; for a batched vibration the batch dimensions (or 1) lead: (B, ...).

        Returns:
            float64 tensor of shape (S, 2), axes (x, y).
        """
        times = times.to(dtype=torch.float64, device=self.device)
        angle, amplitude, _ = self._angle(times)
        return (amplitude * angle.sin()).sum(-1) + self.drift(times)

    def mean_displacement(self, starts: Tensor, exposure_time: float) -> Tensor:
        """Mean displacement over exposures [start, start + T_e] in px (Eq. 2).

        A tone keeps its angle at mid-exposure and is attenuated by sinc(f T_e).

        Args:
            starts: Exposure starts in seconds, any shape S (batch dimensions lead as in ``displacement``).
            exposure_time: T_e in seconds.

        Returns:
            float64 tensor of shape (S, 2), axes (x, y).
        """
        middle = starts.to(dtype=torch.float64, device=self.device) + 0.5 * exposure_time
        angle, amplitude, frequency = self._angle(middle)
        bend = self._per_axis(self.image_acceleration, middle[..., None]) * (exposure_time**2 / 24.0)
        return (amplitude * torch.sinc(frequency * exposure_time) * angle.sin()).sum(-1) + self.drift(middle) + bend

    def offset(self, starts: Tensor, later_starts: Tensor, exposure_time: float) -> Tensor:
        """Offset: mean displacement of the later exposure minus that of the earlier one, in px (Eq. 4).

        Eq. (4) as printed gives this sign on its right-hand side, and the opposite one on its left-hand side.

        Args:
            starts: Exposure starts in frame p, seconds, shape S.
            later_starts: Exposure starts of the same scene rows in frame p + 1, shape S.
            exposure_time: T_e in seconds.

        Returns:
            float64 tensor of shape (S, 2), axes (x, y).
        """
        return self.mean_displacement(later_starts, exposure_time) - self.mean_displacement(starts, exposure_time)

    def velocity(self, times: Tensor) -> Tensor:
        """Velocity dD/dt in px/s; arguments and shapes as in ``displacement``."""
        times = times.to(dtype=torch.float64, device=self.device)
        angle, amplitude, frequency = self._angle(times)
        span = times[..., None]
        drift = self._per_axis(self.image_motion, span) + self._per_axis(self.image_acceleration, span) * span
        return (2 * math.pi * frequency * amplitude * angle.cos()).sum(-1) + drift

    def gain(self, interval: float) -> Tensor:
        """Gain 2 sin(pi f m T_row) from displacement to offset over ``interval`` seconds (Eq. 7), (..., 2, K).

        It may be negative (its sign is then a phase of pi) and is 0 at a blind frequency.
        """
        return 2.0 * torch.sin(math.pi * self.frequency * interval)

    def largest_displacement(self, first: float, last: float) -> Tensor:
        """Bound on |D(t)| for ``first <= t <= last``, (..., 2), in px."""
        longest = max(abs(first), abs(last))
        return (
            self.amplitude.sum(-1)
            + self.image_motion.abs() * longest
            + 0.5 * self.image_acceleration.abs() * longest**2
        )

    def displacement_within_row_time(self, row_time: float) -> Tensor:
        """Largest displacement within one row time, (..., 2), in px (Eq. 24, summed over tones, with motion).

        Condition (24): the discrete point spread function of Eqs. (25)-(39) wants this below 0.1 px.
        """
        step = 2.0 * self.amplitude * torch.sin(math.pi * (self.frequency * row_time).clamp(max=0.5))
        return step.sum(-1) + self.image_motion.abs() * row_time


@dataclass(frozen=True, eq=False)
class VibrationStd:
    """Standard deviations in the layout of ``Vibration``: px, Hz, s, rad (..., 2, K), px/s and px/s^2 (..., 2)."""

    amplitude: Tensor
    frequency: Tensor
    period: Tensor
    phase: Tensor
    image_motion: Tensor
    image_acceleration: Tensor

    def __getitem__(self, index: int) -> "VibrationStd":
        """The standard deviations of one stack out of a batch."""
        return VibrationStd(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


def blind_frequencies(timing: SensorTiming, highest: float) -> Tensor:
    """Frequencies up to ``highest`` Hz that the frames cannot see.

    ``j / (m T_row)``: every frame is displaced alike (the gain of Eq. 7 is zero). ``j / T_e``: the exposure averages
    the tone out (the sinc of Eq. 2 is zero). With frame start times of its own, a camera is blind to what returns in
    all of its frames; a pair, to ``j`` over the time between the two.

    Returns:
        Sorted float64 tensor.

    Example:
        >>> timing = SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)
        >>> [round(f, 1) for f in blind_frequencies(timing, 50.0).tolist()]
        [23.8, 47.6]
    """
    starts = timing.frame_starts(len(timing.frame_start_times) if timing.frame_start_times else 2)
    intervals = starts[1:] - starts[0]

    def multiples(interval: float) -> Tensor:
        return torch.arange(1, math.floor(highest * interval) + 1, dtype=torch.float64) / interval

    alike = multiples(float(intervals[0])) if len(intervals) else starts[:0]
    turns = alike[:, None] * intervals
    alike = alike[((turns - turns.round()).abs() < _SAME_PLACE).all(-1)]
    frequencies: Tensor = torch.cat([alike, multiples(timing.exposure_time)]).unique(sorted=True)
    return frequencies
