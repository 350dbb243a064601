"""Displacement fields of a camera that rolls about its optical axis or changes its scale.

A motion with three or four components (X, Y, theta, zeta) displaces scene content at (x, y) px from the centre of the
frame by ``(X - theta y + zeta x, Y + theta x + zeta y)``, with theta in rad and zeta relative. In one column, the
displacement depends on the row only. Code that requires this (docs/architecture.md) is applied to strips of columns,
each with the ``ColumnMotion`` of its middle. With a finite focal length (``Camera``), translation displaces columns
differently as well.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import torch
from torch import Tensor

from rsvib_torch.motion.camera import Camera
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import RowTiming

_FIXED_POINT_STEPS = 2  # the displacement of 10 px changes by 1 % along y: two steps leave 1e-5 px
_RAY_DEGREE = 9  # of a polynomial along a column; rays are then within 1e-6 rad for a field of 80 degrees
_STEP = 1e-6  # s, of the derivative with respect to time; float64 leaves 1e-8 of the velocity
_BEYOND_LINEAR = 1.1  # a rotation by 0.05 rad displaces a corner at 60 degrees by 8 % more than its linear part


def displacement_factors(x: Tensor, y: Tensor, axes: int, camera: Camera | None = None) -> Tensor:
    """Displacement by unit components at positions of the scene: ``((1, 0, -y, x), (0, 1, x, y))``, (S, 2, A).

    Positions (S) are in px from the centre of the frame. With a camera, the factors are those of small angles.
    """
    if camera is not None:
        return camera.factors(x, y, axes)
    x, y = torch.broadcast_tensors(x, y)
    one, zero = torch.ones_like(x), torch.zeros_like(x)
    along = torch.stack([one, zero, -y, x][:axes], -1)
    across = torch.stack([zero, one, x, y][:axes], -1)
    return torch.stack([along, across], -2)


def displacement_at(components: Tensor, x: Tensor, y: Tensor, camera: Camera | None = None) -> Tensor:
    """Displacement (S, 2) in px of scene content at (x, y) px (S) from the centre, by components (S, A)."""
    if camera is not None:
        return camera.displacement(components, x, y)
    if components.shape[-1] == 2:
        return components
    # products with the matrices of ``displacement_factors`` take twice as long
    along, across = components[..., 0] - y * components[..., 2], components[..., 1] + x * components[..., 2]
    if components.shape[-1] > 3:
        along, across = along + x * components[..., 3], across + y * components[..., 3]
    return torch.stack([along, across], -1)


def _corners(width: float, height: float, like: Tensor) -> tuple[Tensor, Tensor]:
    """(4,) positions x and y in px of the corners of a frame."""
    x, y = 0.5 * width, 0.5 * height
    return like.new_tensor([-x, x, -x, x]), like.new_tensor([-y, -y, y, y])


def largest_in_frame(components: Tensor, width: int, height: int, camera: Camera | None = None) -> Tensor:
    """Bound (..., 2) in px on the displacement in a frame, by components within bounds (..., A)."""
    factors = displacement_factors(*_corners(width, height, components), components.shape[-1], camera).abs().amax(0)
    if camera is not None:  # a strong barrel distortion is largest within the frame
        factors = torch.maximum(factors, torch.eye(2, components.shape[-1]).to(factors))
    moved: Tensor = (factors @ components[..., None])[..., 0]
    return moved if camera is None else moved * _BEYOND_LINEAR


def largest_slope(components: Tensor, width: int, height: int, camera: Camera | None = None) -> Tensor:
    """Bound (...) in px on the change of the displacement per column, by components within bounds (..., A)."""
    x, y = _corners(width, height, components)
    axes = components.shape[-1]
    along = displacement_factors(x, y, axes, camera) - displacement_factors(x - x.sign(), y, axes, camera)
    return (along.abs().amax(0) @ components[..., None])[..., 0].amax(-1)


@dataclass(frozen=True, eq=False, repr=False)
class ColumnMotion(Motion):
    """Displacement (x, y) in px of the content of single columns, by a motion with roll or zoom, in row order.

    The displacement at time t is that of the row that is being exposed at that time: a row belongs to the frame that
    started last, and its content lies at the height y of the scene with
    ``row = middle + y + Y(t) + theta(t) x + zeta(t) y``.

    Args:
        components: Motion with roll, zoom or a camera, in row order.
        column: (...) px from the centre of the frame, one for each motion of the batch.
        frame_starts: Exposure starts of the first rows of the frames in seconds, increasing.
        row_time: Seconds from one row to the next.
        num_rows: Rows of a frame.
    """

    components: Motion
    column: Tensor
    frame_starts: tuple[float, ...]
    row_time: float
    num_rows: int

    @classmethod
    def of_columns(
        cls, motion: Motion, columns: Tensor, timing: RowTiming, num_frames: int, num_rows: int
    ) -> "ColumnMotion":
        """Motions (B S) of columns (S,) in px from the centre for a motion (B), stack after stack."""
        repeated = motion.mapped(lambda values: values.repeat_interleave(len(columns), 0))
        column = columns.to(dtype=torch.float64, device=motion.device).repeat(*motion.batch_shape)
        return cls(repeated, column, tuple(timing.frame_starts(num_frames).tolist()), timing.row_time, num_rows)

    @property
    def batch_shape(self) -> torch.Size:
        """Leading dimensions: (B,)."""
        return self.components.batch_shape

    @property
    def device(self) -> torch.device:
        """Device of the parameters."""
        return self.components.device

    @property
    def num_axes(self) -> int:
        """2: the displacement of one column along x and y."""
        return 2

    def _column(self, dimensions: int) -> Tensor:
        """The columns with trailing dimensions of size 1, to broadcast with a tensor of so many dimensions."""
        return self.column.reshape(*self.column.shape, *(1,) * (dimensions - self.column.ndim))

    def _heights(self, starts: Tensor, components: Tensor) -> Tensor:
        """Heights (S) in px from the centre of the frame of the rows exposed from ``starts`` (S) on."""
        frames = torch.tensor(self.frame_starts, dtype=torch.float64, device=self.device)
        frame = torch.searchsorted(frames, (starts + 1e-9 * self.row_time).contiguous(), right=True) - 1
        row = (starts - frames[frame.clamp(min=0)]) / self.row_time
        heights, _ = torch.broadcast_tensors(row - 0.5 * (self.num_rows - 1), components[..., 0])
        return torch.as_tensor(heights)

    def _positions(self, starts: Tensor, components: Tensor) -> tuple[Tensor, Tensor]:
        """Positions x and y (S) in the scene of rows exposed from ``starts`` (S) on, at components (S, A)."""
        height = self._heights(starts, components)
        x = self._column(height.ndim).expand_as(height)
        scale = 1.0 + components[..., 3] if components.shape[-1] > 3 else 1.0
        return x, (height - components[..., 1] - components[..., 2] * x) / scale

    @cached_property
    def _ray_coefficients(self) -> Tensor:
        """(..., 2, K): polynomials of ``y / (0.55 num_rows)`` for the rays u and v of the content of the columns."""
        camera = self.components.camera or Camera(1.0)
        degree = _RAY_DEGREE if camera.distorts else 1
        nodes = torch.cos(math.pi * torch.linspace(0, 1, 4 * degree + 1, dtype=torch.float64, device=self.device))
        x, y = torch.broadcast_tensors(self.column[..., None], 0.55 * self.num_rows * nodes)
        values = torch.stack(camera.rays(x, y), -2)
        powers = nodes[:, None] ** torch.arange(degree + 1, device=self.device)
        return values @ torch.linalg.pinv(powers).mT

    def _rays(self, camera: Camera, starts: Tensor, components: Tensor) -> tuple[Tensor, Tensor]:
        """Rays u and v (S) of the content of rows exposed from ``starts`` (S) on, at components (S, A)."""
        height = self._heights(starts, components)
        u_coefficients, v_coefficients = self._ray_coefficients.unbind(-2)
        shape = (*self.column.shape, *(1,) * (height.ndim - self.column.ndim), -1)
        u_terms, v_terms = (c.reshape(shape).unbind(-1) for c in (u_coefficients, v_coefficients))
        y = height - components[..., 1]
        for step in range(_FIXED_POINT_STEPS + 1):
            place = (y / (0.55 * self.num_rows)).clamp(-1.0, 1.0)
            u, v = u_terms[-1].expand_as(place), v_terms[-1].expand_as(place)
            for u_term, v_term in zip(u_terms[-2::-1], v_terms[-2::-1], strict=True):
                u, v = u * place + u_term, v * place + v_term
            if step < _FIXED_POINT_STEPS:
                y = height - camera.displacement_of_rays(components, u, v)[..., 1]
        return u, v

    def _moved(self, starts: Tensor, components: Tensor) -> Tensor:
        """Displacement (S, 2) of the content of rows exposed from ``starts`` (S) on, by components (S, A)."""
        camera = self.components.camera
        if camera is None:
            return displacement_at(components, *self._positions(starts, components))
        return camera.displacement_of_rays(components, *self._rays(camera, starts, components))

    def displacement(self, times: Tensor) -> Tensor:
        """Displacement in px of the rows that begin their exposure at these times."""
        times = times.to(dtype=torch.float64, device=self.device)
        return self._moved(times, self.components.displacement(times))

    def path(self, starts: Tensor, delays: Tensor) -> Tensor:
        """Displacement in px during exposures, as ``Motion.path``: a row keeps its position in the frame."""
        starts = starts.to(dtype=torch.float64, device=self.device)
        return self._moved(starts[..., None], self.components.path(starts, delays))

    def mean_displacement(self, starts: Tensor, exposure_time: float | Tensor) -> Tensor:
        """Mean displacement over exposures in px."""
        starts = starts.to(dtype=torch.float64, device=self.device)
        return self._moved(starts, self.components.mean_displacement(starts, exposure_time))

    def velocity(self, times: Tensor) -> Tensor:
        """Velocity in px/s of the content of the row that begins its exposure at these times."""
        times = times.to(dtype=torch.float64, device=self.device)
        components, velocity = self.components.displacement(times), self.components.velocity(times)
        camera = self.components.camera
        if camera is None:
            return displacement_at(velocity, *self._positions(times, components))
        rays = self._rays(camera, times, components)
        ends = [camera.displacement_of_rays(components + step * velocity, *rays) for step in (_STEP, -_STEP)]
        return (ends[0] - ends[1]) / (2 * _STEP)

    def drift(self, times: Tensor) -> Tensor:
        """Drift of X and Y in px, the same for all columns; that of roll and zoom counts as oscillation."""
        return self.components.drift(times)[..., :2]

    def _at_ends_of_rows(self, components: Tensor) -> Tensor:
        """Bound (..., 2) on the displacement by components within bounds (..., A), in any row."""
        camera, axes = self.components.camera, components.shape[-1]
        ends = [torch.full_like(self.column, half * self.num_rows) for half in (-0.5, 0.0, 0.5)]
        reach = torch.stack([displacement_factors(self.column, end, axes, camera).abs() for end in ends]).amax(0)
        moved: Tensor = (reach @ components[..., None])[..., 0]
        return moved if camera is None else moved * _BEYOND_LINEAR

    def largest_oscillation(self) -> Tensor:
        """Bound on ``|D(t) - drift(t)|`` during the frames, (..., 2), in px."""
        last = self.frame_starts[-1] + (self.num_rows + 1) * self.row_time
        turned = self.components.largest_displacement(self.frame_starts[0], last)  # roll and zoom with their drift
        return self._at_ends_of_rows(torch.cat([self.components.largest_oscillation()[..., :2], turned[..., 2:]], -1))

    def displacement_within(self, duration: float) -> Tensor:
        """Bound on the displacement between two times ``duration`` seconds apart, (..., 2), in px."""
        return self._at_ends_of_rows(self.components.displacement_within(duration))

    def periods_within(self, duration: float) -> Tensor:
        """Periods of the fastest tone in ``duration`` seconds, (..., 2)."""
        return self.components.periods_within(duration).amax(-1, keepdim=True).expand(*self.batch_shape, 2)

    def with_axes(self, order: Sequence[int], signs: Sequence[float]) -> Self:
        """Columns have a position in frames in row order: their axes are not exchanged."""
        raise NotImplementedError("a ColumnMotion stays in row order; exchange the axes of its components")


def check_two_axes(motion: Motion, what: str) -> None:
    """Raise a ``ValueError`` for a motion that displaces the columns of a row differently."""
    if not motion.same_for_all_columns:
        raise ValueError(
            f"{what} is not defined with roll, zoom or a camera, which displace the columns of a row differently; pass "
            "a motion with the axes (x, y) only"
        )
