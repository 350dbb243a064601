"""Motion of any shape: a cubic spline in time, with tones and image motion."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from rsvib_torch.checks.arguments import as_numbers, checked_methods
from rsvib_torch.checks.values import check_number
from rsvib_torch.motion.camera import Camera
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import MAX_START_TIME, MIN_ROW_TIME
from rsvib_torch.motion.vibration import TensorLike, Vibration
from rsvib_torch.numerics.interpolation import bspline_coefficients, bspline_weights, gauss_legendre
from rsvib_torch.numerics.tables import Array
from rsvib_torch.results.presentation import axis_head, axis_rows
from rsvib_torch.text import measured_text, text_table

MAX_DISPLACEMENT = 1e9  # px; image motion of 1e5 px/s for three hours
MAX_KNOTS = 100_000_000  # 1.6 GB of coefficients; a gyroscope with 8 kHz for three hours
MAX_EXPOSURE_NODES = 10_000  # times; an exposure of 1 s of a gyroscope with 5 kHz


@dataclass(frozen=True, eq=False, repr=False)
@checked_methods
class FreeMotion(
    Motion, units={"coefficients": "px", "start": "s", "spacing": "s"}, shapes={"coefficients": "... A N"}
):
    """A free spline with tones: ``D(t) = sum_k A_k sin(2 pi f_k t + phi_k) + v t + a t^2 / 2 + R(t)``.

    ``R(t) = sum_n c_n B((t - start) / spacing - n + 1)`` is a cubic B-spline; before its first and after its last knot
    it keeps its end values. It is accepted wherever a ``Vibration`` is accepted.

    Args:
        coefficients: c in px, (2, N) or (..., 2, N), N >= 4, axes (x, y); 3 or 4 instead of 2 for (x, y, roll) and
            (x, y, roll, zoom), roll in rad and zoom relative.
        start: Time of the first knot in seconds; the last is at ``start + (N - 3) spacing``.
        spacing: Time between knots in seconds.
        tones: Tones and image motion of the same batch shape; by default none.
        camera: Focal length and lens, as for ``Vibration``.

    Raises:
        ValueError: If shapes do not fit or a value is not finite.

    Example:
        >>> times = torch.linspace(0, 0.1, 41, dtype=torch.float64)
        >>> motion = FreeMotion.through(times, torch.stack([times * 20, torch.exp(-times * 30)], -1))
        >>> [round(value, 3) for value in motion.displacement(torch.tensor(0.05)).tolist()]
        [1.0, 0.223]
    """

    _MADE_BY: ClassVar[str] = "read_motion, FreeMotion.from_samples"  # for errors about arguments

    coefficients: Tensor
    start: float
    spacing: float
    tones: Vibration
    camera: Camera | None = None

    def __init__(
        self,
        coefficients: TensorLike,
        start: float,
        spacing: float,
        tones: Vibration | None = None,
        camera: Camera | None = None,
    ) -> None:
        values = as_numbers("coefficients", coefficients)
        if values.ndim < 2 or not 2 <= values.shape[-2] <= 4 or values.shape[-1] < 4:
            raise ValueError(
                "coefficients must have shape (..., 2, N) with N >= 4 (3 for x, y, roll; 4 for x, y, roll, zoom), got "
                f"{tuple(values.shape)}"
            )
        if not bool(torch.isfinite(values).all()):
            raise ValueError("coefficients must be finite")
        largest = float(values.detach().abs().max())
        if largest > MAX_DISPLACEMENT:
            raise ValueError(f"coefficients must be at most {MAX_DISPLACEMENT:g} px, got {largest:g}")
        axes = values.shape[-2]
        tones = Vibration.still(values.shape[:-2], values.device, axes=axes) if tones is None else tones
        tones = tones.to(values.device)
        if tones.batch_shape != values.shape[:-2] or tones.num_axes != axes:
            raise ValueError(
                f"tones of batch shape {tuple(tones.batch_shape)} and {tones.num_axes} axes do not fit coefficients "
                f"{tuple(values.shape)}"
            )
        start = check_number("start", start, at_least=-MAX_START_TIME, at_most=MAX_START_TIME)
        spacing = check_number("spacing", spacing, at_least=MIN_ROW_TIME)
        camera = tones.camera if camera is None else camera
        vars(self).update(coefficients=values, start=start, spacing=spacing, tones=tones, camera=camera)

    @classmethod
    def through(
        cls, times: TensorLike, displacement: TensorLike, tones: Vibration | None = None, camera: Camera | None = None
    ) -> "FreeMotion":
        """The motion that passes through displacements (N, A) in px at evenly spaced times (N,) in seconds.

        Raises:
            ValueError: If times are not evenly spaced and increasing, or shapes do not fit.
        """
        grid, values = as_numbers("times", times), as_numbers("displacement", displacement)
        _check_samples(grid, values)
        steps = grid.diff()
        spacing = float(steps.mean())
        if spacing <= 0 or float((steps - spacing).abs().amax()) > 1e-6 * spacing:
            raise ValueError("times must be evenly spaced and increasing; FreeMotion.from_samples accepts other times")
        # point reflection at both ends makes the second derivative 0 there: a natural spline
        before = 2 * values[:1] - values[1:].flip(0)
        after = 2 * values[-1:] - values[:-1].flip(0)
        coefficients = bspline_coefficients(torch.cat([before, values, after]).T, 3, -1)
        return cls(coefficients[:, len(grid) - 2 : 2 * len(grid)], float(grid[0]), spacing, tones, camera)

    @classmethod
    def from_samples(
        cls,
        times: TensorLike,
        displacement: TensorLike,
        *,
        spacing: float | None = None,
        camera: Camera | None = None,
    ) -> "FreeMotion":
        """The motion through displacements (N, A) at increasing times, interpolated in between by cubic splines.

        Args:
            times: Seconds, strictly increasing.
            displacement: px; roll, the third of A = 3 columns, in rad, and zoom, the fourth, relative.
            spacing: Time between knots; by default half the median step.
            camera: Focal length and lens.
        """
        from scipy.interpolate import CubicSpline  # noqa: PLC0415

        grid, values = as_numbers("times", times).cpu(), as_numbers("displacement", displacement).cpu()
        for name, value in (("times", grid), ("displacement", values)):
            if value.requires_grad:
                remedy = f"pass {name}.detach(), or evenly spaced times to through"
                raise ValueError(f"from_samples has no gradient: {remedy}")
        _check_samples(grid, values)
        check_increasing(grid.numpy())
        usual = 0.5 * float(np.median(np.diff(grid.numpy())))
        step = usual if spacing is None else check_number("spacing", spacing, above=0.0)
        first, last = float(grid[0]), float(grid[-1])
        if (last - first) / step > MAX_KNOTS:
            raise ValueError(f"spacing must give at most {MAX_KNOTS:,} knots, got {step:g} s for {last - first:g} s")
        intervals = math.ceil((last - first) / step - 1e-6)  # a whole number for even times, but for rounding
        even = np.linspace(first, last, max(4, intervals + 1))
        interpolated = CubicSpline(grid.numpy(), values.numpy())(even)
        return cls.through(torch.from_numpy(even), torch.from_numpy(interpolated), camera=camera)

    def summary(self) -> str:
        """Duration and range of the motion; of a batch, those of each motion."""
        count = self.coefficients.shape[-1] - 2
        times = torch.linspace(self.start, self.end, 4 * count, dtype=torch.float64, device=self.device)
        displacement = self.displacement(times.expand(*self.batch_shape, -1)).detach()
        low, high = displacement.amin(-2), displacement.amax(-2)
        rows = [
            [*labels, measured_text(low[at]), measured_text(high[at])]
            for at, labels in axis_rows(self.batch_shape, self.num_axes)
        ]
        unit = ("px", "px; roll: rad", "px; roll: rad; zoom: 1")[self.num_axes - 2]
        head = [*axis_head(self.batch_shape), f"smallest displacement ({unit})", "largest"]
        first = f"{self.start:.6g} … {self.end:.6g} s, {count} knots {1e3 * self.spacing:.4g} ms apart"
        tones = [self.tones.summary()] if bool(self.tones.moving_axes().any()) else []
        return "\n".join([first, text_table(head, rows), *tones])

    @property
    def end(self) -> float:
        """Time of the last knot in seconds."""
        return self.start + (self.coefficients.shape[-1] - 3) * self.spacing

    @property
    def knots(self) -> Tensor:
        """(N,) s, times that the coefficients belong to."""
        count = self.coefficients.shape[-1]
        return self.start + self.spacing * (torch.arange(count, dtype=torch.float64, device=self.device) - 1.0)

    def retimed(self, offset: float) -> "FreeMotion":
        """The motion on another clock, on which the time 0 is ``offset`` seconds on this one: ``D(t + offset)``."""
        check_number("offset", offset)
        old = self.tones
        tones = replace(
            old,
            phase=old.phase + 2 * math.pi * old.frequency * offset,
            image_motion=old.image_motion + old.image_acceleration * offset,
        )
        shift = old.image_motion * offset + 0.5 * old.image_acceleration * offset**2
        return replace(self, coefficients=self.coefficients + shift[..., None], start=self.start - offset, tones=tones)

    def within(self, first: float, last: float) -> "FreeMotion":
        """The motion between two times in seconds, without the knots that have no influence there."""
        count = self.coefficients.shape[-1]
        low = min(max(math.floor((first - self.start) / self.spacing), 0), count - 4)
        high = min(max(math.ceil((last - self.start) / self.spacing) + 3, low + 4), count)
        return replace(self, coefficients=self.coefficients[..., low:high], start=self.start + low * self.spacing)

    def with_axes(self, order: Sequence[int], signs: Sequence[float]) -> Self:
        """The motion whose component k is ``signs[k]`` (1 or -1) times component ``order[k]`` of this motion."""
        self._check_axes(order, signs)
        coefficients = self.coefficients[..., list(order), :] * self.coefficients.new_tensor(signs)[:, None]
        camera = None if self.camera is None else self.camera.with_axes(order, signs)
        return type(self)(coefficients, self.start, self.spacing, self.tones.with_axes(order, signs), camera)

    def rest(self, times: Tensor) -> Tensor:
        """R(t) alone in px."""
        times, batch = times.to(dtype=torch.float64, device=self.device), self.batch_shape
        knots = self.coefficients.shape[-1]
        # 1. The four knots about each time.
        place = ((times - self.start) / self.spacing).clamp(0.0, knots - 3.0)
        cell = place.detach().nan_to_num(0.0).floor().clamp(max=knots - 4.0)  # times that are NaN have NaN results
        index = cell.to(torch.int64)[..., None] + torch.arange(4, device=times.device)
        index = index.expand(*batch, *index.shape[len(batch) :])
        # 2. Their coefficients (S, A, 4) times their weights.
        flat = index.reshape(*batch, 1, -1).expand(*batch, self.coefficients.shape[-2], -1)
        picked = self.coefficients.gather(-1, flat).unflatten(-1, index.shape[len(batch) :]).movedim(len(batch), -2)
        return (picked * bspline_weights(place - cell, 3)[..., None, :]).sum(-1)

    def drift(self, times: Tensor) -> Tensor:
        """Displacement of the image motion alone in px; arguments and shapes as in ``displacement``."""
        return self.tones.drift(times)

    def displacement(self, times: Tensor) -> Tensor:
        """Displacement D(t) in px; arguments and shapes as in ``Vibration.displacement``."""
        return self.tones.displacement(times) + self.rest(times)

    def mean_displacement(self, starts: Tensor, exposure_time: float | Tensor) -> Tensor:
        """Mean displacement over exposures in px; arguments and shapes as in ``Vibration.mean_displacement``.

        The spline is integrated with Gauss-Legendre nodes: exactly within a knot spacing, closely beyond.
        """
        starts = starts.to(dtype=torch.float64, device=self.device)
        mean = self.tones.mean_displacement(starts, exposure_time)
        longest = float(exposure_time.amax()) if isinstance(exposure_time, Tensor) else exposure_time
        count = 3 + math.ceil(2 * longest / self.spacing)
        if count > MAX_EXPOSURE_NODES:
            raise ValueError(
                f"exposure_time={longest:g} s contains {longest / self.spacing:.3g} knots of the motion, at most "
                f"{MAX_EXPOSURE_NODES // 2} can be averaged; check its unit (seconds)"
            )
        nodes, weights = gauss_legendre(count)
        for node, weight in zip(nodes.tolist(), weights.tolist(), strict=True):
            mean = mean + weight * self.rest(starts + node * exposure_time)
        return mean

    def largest_oscillation(self) -> Tensor:
        """Bound on the tones and the spline, (..., 2), in px: the sum of amplitudes and the largest coefficient."""
        return self.tones.largest_oscillation() + self.coefficients.detach().abs().amax(-1)

    def displacement_within(self, duration: float) -> Tensor:
        """Bound on the displacement between two times ``duration`` seconds apart, (..., 2), in px."""
        speed = self.coefficients.detach().diff(dim=-1).abs().amax(-1) / self.spacing
        return self.tones.displacement_within(duration) + speed * duration

    def periods_within(self, duration: float) -> Tensor:
        """Periods of the fastest tone in ``duration`` seconds, (..., 2)."""
        return self.tones.periods_within(duration)


def check_increasing(times: Array) -> None:
    """Raise a ValueError unless times (N,) in s increase."""
    steps = np.diff(times)
    if (steps <= 0).any():
        place = int(np.argmax(steps <= 0))
        raise ValueError(
            f"times must increase, but sample {place + 2} at {times[place + 1]:.9g} s comes after {times[place]:.9g} s"
        )


def _check_samples(times: Tensor, displacement: Tensor) -> None:
    """Raise a ValueError unless times are (N,), displacements (N, 2 to 4), N >= 4, and all values finite."""
    fits = displacement.ndim == 2 and len(displacement) == len(times) and 2 <= displacement.shape[1] <= 4
    if times.ndim != 1 or len(times) < 4 or not fits:
        raise ValueError(
            "times must be (N,) and displacement (N, 2) with N >= 4 (3 columns with roll, 4 with zoom), got "
            f"{tuple(times.shape)}, {tuple(displacement.shape)}"
        )
    if not bool(torch.isfinite(times).all() and torch.isfinite(displacement).all()):
        raise ValueError("times and displacement must be finite")
