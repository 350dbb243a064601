"""Motion of any shape: a spline in time beside tones and image motion, used wherever a vibration is."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rsvib_torch.core.checks import check_number
from rsvib_torch.core.quadrature import gauss_legendre
from rsvib_torch.core.splines import bspline_coefficients, bspline_weights
from rsvib_torch.motion.vibration import TensorLike, Vibration

__all__ = ["FreeMotion", "moving_axes", "rest_path", "rest_reach"]

_TAPS = 4
_REACH = 24  # knots after which an end is forgotten


@dataclass(frozen=True, eq=False)
class FreeMotion(Vibration):
    """A vibration with a free rest: ``D(t) = sum_k A_k sin(2 pi f_k t + phi_k) + v t + a t^2 / 2 + R(t)``.

    ``R(t) = sum_n c_n B((t - start) / spacing - n + 1)`` is a cubic B-spline; before its first and after its last knot
    it keeps its end values. Whatever takes a ``Vibration`` takes this, and the tones may be none.

    Args:
        coefficients: c in px, (2, N) or (..., 2, N), N >= 4, axes (x, y).
        start: Time of the first knot in seconds; the last is at ``start + (N - 3) spacing``.
        spacing: Time between knots in seconds.
        tones: Tones and image motion of the same batch shape; by default none.

    Raises:
        ValueError: If shapes do not fit or a value is not finite.
        TypeError: If ``start`` or ``spacing`` is not a number.

    Example:
        >>> times = torch.linspace(0, 0.1, 41, dtype=torch.float64)
        >>> motion = FreeMotion.through(times, torch.stack([times * 20, torch.exp(-times * 30)], -1))
        >>> [round(value, 3) for value in motion.displacement(torch.tensor(0.05)).tolist()]
        [1.0, 0.223]
    """

    coefficients: Tensor
    start: float
    spacing: float

    def __init__(self, coefficients: TensorLike, start: float, spacing: float, tones: Vibration | None = None) -> None:
        values = torch.as_tensor(coefficients, dtype=torch.float64)
        if values.ndim < 2 or values.shape[-2] != 2 or values.shape[-1] < _TAPS:
            raise ValueError(f"coefficients must have shape (..., 2, N) with N >= 4, got {tuple(values.shape)}")
        if not bool(torch.isfinite(values).all()):
            raise ValueError("coefficients must be finite")
        tones = Vibration.still(values.shape[:-2], values.device) if tones is None else tones.to(values.device)
        if tones.batch_shape != values.shape[:-2]:
            raise ValueError(
                f"tones of batch shape {tuple(tones.batch_shape)} do not fit coefficients {tuple(values.shape)}"
            )
        super().__init__(*(getattr(tones, name) for name in Vibration.__dataclass_fields__))
        object.__setattr__(self, "coefficients", values)
        object.__setattr__(self, "start", check_number("start", start))
        object.__setattr__(self, "spacing", check_number("spacing", spacing, above=0.0))

    @classmethod
    def through(cls, times: TensorLike, displacement: TensorLike, tones: Vibration | None = None) -> "FreeMotion":
        """The motion that passes through displacements (N, 2) in px at evenly spaced times (N,) in seconds.

        Raises:
            ValueError: If times are not evenly spaced and increasing, or shapes do not fit.
        """
        grid = torch.as_tensor(times, dtype=torch.float64)
        values = torch.as_tensor(displacement, dtype=torch.float64)
        if grid.ndim != 1 or len(grid) < _TAPS or values.shape != (len(grid), 2):
            raise ValueError(
                "times must be (N,) and displacement (N, 2) with N >= 4, got "
                f"{tuple(grid.shape)}, {tuple(values.shape)}"
            )
        if not bool(torch.isfinite(values).all()):
            raise ValueError("displacement must be finite")
        steps = grid.diff()
        spacing = float(steps.mean())
        if spacing <= 0 or float((steps - spacing).abs().amax()) > 1e-6 * spacing:
            raise ValueError("times must be evenly spaced and increasing; FreeMotion.from_samples takes others")
        # turned about its ends the curve goes on straight there: a natural spline
        reach = min(_REACH, len(grid) - 1)
        before = 2 * values[:1] - values[1 : reach + 1].flip(0)
        after = 2 * values[-1:] - values[-reach - 1 : -1].flip(0)
        whole = bspline_coefficients(torch.cat([before, values, after]).T, 3, -1)
        return cls(whole[:, reach - 1 : reach + len(grid) + 1], float(grid[0]), spacing, tones)

    @classmethod
    def from_samples(
        cls,
        times: TensorLike,
        displacement: TensorLike,
        *,
        spacing: float | None = None,
        tones: Vibration | None = None,
    ) -> "FreeMotion":
        """The motion through displacements (N, 2) at increasing times, interpolated in between by cubic splines.

        Args:
            times: Seconds, strictly increasing.
            displacement: px.
            spacing: Time between knots; by default half the median step.
            tones: Tones that are added.
        """
        from scipy.interpolate import CubicSpline  # noqa: PLC0415

        grid = torch.as_tensor(times, dtype=torch.float64).cpu().numpy()
        values = torch.as_tensor(displacement, dtype=torch.float64).cpu().numpy()
        if grid.ndim != 1 or len(grid) < _TAPS or values.shape != (len(grid), 2):
            raise ValueError(
                f"times must be (N,) and displacement (N, 2) with N >= 4, got {grid.shape}, {values.shape}"
            )
        if not (np.isfinite(grid).all() and np.isfinite(values).all()):
            raise ValueError("times and displacement must be finite")
        if (np.diff(grid) <= 0).any():
            raise ValueError("times must be strictly increasing")
        step = 0.5 * float(np.median(np.diff(grid))) if spacing is None else check_number("spacing", spacing, above=0.0)
        count = max(_TAPS, math.ceil((grid[-1] - grid[0]) / step) + 1)
        even = np.linspace(grid[0], grid[-1], count)
        return cls.through(torch.from_numpy(even), torch.from_numpy(CubicSpline(grid, values)(even)), tones)

    @classmethod
    def stacked(cls, motions: Sequence["FreeMotion"]) -> "FreeMotion":
        """Motions of equal knots and equally many tones as a batch; its first dimension counts them."""
        first = motions[0]
        knots = {(m.start, m.spacing, m.coefficients.shape) for m in motions}
        if len(knots) > 1:
            raise ValueError(f"motions of different knots cannot be stacked: {sorted(knots)}")
        fields = ([getattr(m, name) for m in motions] for name in Vibration.__dataclass_fields__)
        tones = Vibration(*(torch.stack(values) for values in fields))
        return cls(torch.stack([m.coefficients for m in motions]), first.start, first.spacing, tones)

    @property
    def tones(self) -> Vibration:
        """Tones and image motion alone."""
        return Vibration(*(getattr(self, name) for name in Vibration.__dataclass_fields__))

    @property
    def end(self) -> float:
        """Time of the last knot in seconds."""
        return self.start + (self.coefficients.shape[-1] - 3) * self.spacing

    @property
    def knots(self) -> Tensor:
        """(N,) s, times that the coefficients belong to."""
        count = self.coefficients.shape[-1]
        return self.start + self.spacing * (torch.arange(count, dtype=torch.float64, device=self.device) - 1.0)

    def with_tones(self, tones: Vibration, signs: Sequence[float] = (1.0, 1.0), *, swap: bool = False) -> "FreeMotion":
        """The same rest, with axes turned by ``signs`` or swapped, beside other tones."""
        rest = self.coefficients * self.coefficients.new_tensor(signs)[:, None]
        return FreeMotion(rest.flip(-2) if swap else rest, self.start, self.spacing, tones)

    def retimed(self, offset: float, scale: float = 1.0, gain: tuple[float, float] = (1.0, 1.0)) -> "FreeMotion":
        """The motion of another clock: ``gain D(scale t + offset)`` at time t.

        Args:
            offset: Reading of this motion's clock at time 0, in seconds.
            scale: Seconds that pass on it in one second.
            gain: Factor of each axis (x, y), not negative where there are tones.
        """
        check_number("offset", offset)
        check_number("scale", scale, above=0.0)
        size = self.coefficients.new_tensor(gain)
        tones = Vibration(
            self.amplitude * size[:, None],
            self.frequency * scale,
            self.phase + 2 * math.pi * self.frequency * offset,
            size * (self.image_motion + self.image_acceleration * offset) * scale,
            size * self.image_acceleration * scale**2,
        )
        moved = self.image_motion * offset + 0.5 * self.image_acceleration * offset**2
        rest = (self.coefficients + moved[..., None]) * size[:, None]
        return FreeMotion(rest, (self.start - offset) / scale, self.spacing / scale, tones)

    def _taps(self, times: Tensor) -> tuple[Tensor, Tensor]:
        """The four coefficients (S, 2, 4) about times S, and the fraction (S,) of a knot spacing."""
        batch = self.batch_shape
        knots = self.coefficients.shape[-1]
        place = ((times - self.start) / self.spacing).clamp(0.0, knots - 3.0)
        cell = place.detach().floor().clamp(max=knots - 4.0)
        index = cell.to(torch.int64)[..., None] + torch.arange(_TAPS, device=times.device)
        if not batch:
            return self.coefficients.movedim(-2, -1)[index].movedim(-1, -2), place - cell
        index = index.expand(*batch, *index.shape[len(batch) :])
        flat = index.reshape(*batch, 1, -1).expand(*batch, 2, -1)
        picked = self.coefficients.gather(-1, flat).unflatten(-1, index.shape[len(batch) :])
        return picked.movedim(len(batch), -2), (place - cell).expand(index.shape[:-1])

    def rest(self, times: Tensor) -> Tensor:
        """R(t) alone in px; arguments and shapes as in ``displacement``."""
        times = times.to(dtype=torch.float64, device=self.device)
        taps, fraction = self._taps(times)
        value: Tensor = (taps * bspline_weights(fraction, 3)[..., None, :]).sum(-1)
        return value

    def displacement(self, times: Tensor) -> Tensor:
        """Displacement D(t) in px; arguments and shapes as in ``Vibration.displacement``."""
        return super().displacement(times) + self.rest(times)

    def mean_displacement(self, starts: Tensor, exposure_time: float) -> Tensor:
        """Mean displacement over exposures in px; arguments and shapes as in ``Vibration.mean_displacement``."""
        starts = starts.to(dtype=torch.float64, device=self.device)
        mean = super().mean_displacement(starts, exposure_time)
        for node, weight in zip(*_nodes(exposure_time, self.spacing), strict=True):
            mean = mean + weight * self.rest(starts + node)
        return mean

    def velocity(self, times: Tensor) -> Tensor:
        """Velocity dD/dt in px/s; arguments and shapes as in ``displacement``."""
        times = times.to(dtype=torch.float64, device=self.device)
        taps, fraction = self._taps(times)
        fraction = fraction[..., None]
        slopes = torch.cat(
            [0.5 * (1 - fraction).square(), 0.75 - (fraction - 0.5).square(), 0.5 * fraction.square()], -1
        )
        inside = ((times > self.start) & (times < self.end))[..., None]
        moving = (taps.diff(dim=-1) * slopes[..., None, :]).sum(-1) / self.spacing
        return super().velocity(times) + torch.where(inside, moving, 0.0)

    def largest_displacement(self, first: float, last: float) -> Tensor:
        """Bound on |D(t)| for ``first <= t <= last``, (..., 2), in px."""
        return super().largest_displacement(first, last) + rest_reach(self)

    def displacement_within_row_time(self, row_time: float) -> Tensor:
        """Largest displacement within one row time, (..., 2), in px (Eq. 24)."""
        return super().displacement_within_row_time(row_time) + rest_path(self, row_time)


def _nodes(exposure_time: float, spacing: float) -> tuple[list[float], list[float]]:
    """Gauss-Legendre nodes over an exposure and their weights: exact within a knot spacing, close beyond."""
    count = 3 + math.ceil(2 * exposure_time / spacing)
    nodes, weights = gauss_legendre(count)
    return (nodes * exposure_time).tolist(), weights.tolist()


def rest_reach(vibration: Vibration) -> Tensor:
    """Bound (..., 2) in px on the free rest of a motion; 0 for a vibration that has none."""
    if not isinstance(vibration, FreeMotion):
        return torch.zeros_like(vibration.image_motion)
    return vibration.coefficients.detach().abs().amax(-1)


def moving_axes(vibration: Vibration) -> Tensor:
    """Which axes (..., 2) a motion moves at all: by tones, uniform or accelerated motion, or a free rest.

    Example:
        >>> moving_axes(Vibration([2.0, 0.0], [50.0, 0.0], image_acceleration=[0.0, 3.0])).tolist()
        [True, True]
    """
    tones = (vibration.amplitude > 0).any(-1)
    return tones | (vibration.image_motion != 0) | (vibration.image_acceleration != 0) | (rest_reach(vibration) > 0)


def rest_path(vibration: Vibration, duration: float) -> Tensor:
    """Bound (..., 2) in px on how far the free rest of a motion moves within ``duration`` seconds."""
    if not isinstance(vibration, FreeMotion):
        return torch.zeros_like(vibration.image_motion)
    speed = vibration.coefficients.detach().diff(dim=-1).abs().amax(-1) / vibration.spacing
    return speed * duration
