"""The base class of motions, and motions of columns: displacements that depend on the row only.

In one column, the displacement by a motion with roll, zoom or a camera depends on the row only. Code that requires this
(docs/architecture.md) is applied to strips of columns, each with the ``ColumnMotion`` of its middle.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from rsvib_torch.checks.arguments import checked_methods
from rsvib_torch.checks.values import check_whole_number
from rsvib_torch.motion.camera import Camera, displacement_at, largest_at
from rsvib_torch.motion.timing import MAX_BATCH, RowTiming, SensorTiming, row_axes
from rsvib_torch.results.presentation import Result

_FIXED_POINT_STEPS = 2  # the displacement of 10 px changes by 1 % along y: two steps leave 1e-5 px


@dataclass(frozen=True, eq=False, repr=False)
@checked_methods
class Motion(Result, ABC):
    """Motion of the image on the sensor as a function of time: scene content at ``s`` appears at ``s + D(t)``.

    Contract of a motion type. It is a frozen dataclass (``eq=False, repr=False``) whose fields are float64 tensors that
    begin with the batch dimensions, other motions of the same batch shape, and plain numbers for the whole batch. It
    implements the abstract members below. The last axis of every result counts the components: x and y in px, positive
    to the right and down, then roll in rad and zoom (relative) if there are three or four (``displacement_at``). Times
    have any shape S whose leading dimensions are the batch dimensions (or 1), in seconds since the exposure start of
    row 0 of frame 0; results (S, axes) are float64, and differentiable except for bounds.
    """

    @property
    def device(self) -> torch.device:
        """Device of the parameters."""
        return next(value.device for value in vars(self).values() if isinstance(value, Tensor))

    @abstractmethod
    def displacement(self, times: Tensor) -> Tensor:
        """Displacement D(t) in px, (S, axes), at times S in seconds."""

    @abstractmethod
    def mean_displacement(self, starts: Tensor, exposure_time: float | Tensor) -> Tensor:
        """Mean displacement (S, axes) over exposures [start, start + T_e] in px (Eq. 2 of Liu et al. 2023).

        The exposure time in s is a number or a tensor that broadcasts against the starts S.
        """

    @abstractmethod
    def drift(self, times: Tensor) -> Tensor:
        """Part of the displacement that grows with time, in px: a polynomial of degree 2 that is 0 at time 0.

        Arguments and shapes as in ``displacement``.
        """

    @abstractmethod
    def largest_oscillation(self) -> Tensor:
        """Bound on ``|D(t) - drift(t)|`` at all times, (..., axes), in px."""

    @abstractmethod
    def displacement_within(self, duration: float) -> Tensor:
        """Bound on the displacement between two times ``duration`` seconds apart, (..., axes), in px (Eq. 24).

        A tone counts with 4 A per period beyond half a period, its path length; image motion with its velocity at time
        0.
        """

    @abstractmethod
    def periods_within(self, duration: float) -> Tensor:
        """Periods of the fastest tone in ``duration`` seconds, (..., axes); 0 for a motion without tones."""

    @abstractmethod
    def with_axes(self, order: Sequence[int], signs: Sequence[float]) -> Self:
        """The motion whose component k is ``signs[k]`` (1 or -1) times component ``order[k]`` of this motion."""

    @classmethod
    def stacked(cls, results: Sequence[Self]) -> Self:
        """Motions with the same axes, knots and camera as a batch; the new dimension is the first."""
        batch = super().stacked(results)
        for name in ("camera", "start", "spacing"):
            if any(getattr(motion, name, None) != getattr(batch, name, None) for motion in results):
                raise ValueError(f"motions with different {name} cannot be stacked")
        return batch

    @property
    def num_axes(self) -> int:
        """Number of components of the displacement."""
        return self.largest_oscillation().shape[-1]

    @property
    def camera(self) -> Camera | None:
        """Focal length and lens that the displacement follows; None for an infinite focal length."""
        return None

    @property
    def same_for_all_columns(self) -> bool:
        """Whether all columns of a row are displaced alike: no roll, no zoom, no finite focal length."""
        return self.num_axes == 2 and self.camera is None

    def attitude(self, times: Tensor) -> Tensor:
        """Rotation (S, 3) of the camera in rad at times S: pitch, yaw and roll, see ``Camera``.

        Raises:
            ValueError: If the motion has no camera.

        Example:
            >>> from rsvib_torch import Camera, Vibration
            >>> motion = Vibration((2.0, 1.0), (50.0, 50.0), (1.5, 0.0), camera=Camera(focal_length=1000.0))
            >>> motion.attitude(torch.tensor(0.005))[:2].round(decimals=6).tolist()  # pitch and yaw in rad
            [0.001, -0.000141]
        """
        if self.camera is None:
            raise ValueError("the attitude requires a motion with a camera: pass focal_length or camera=Camera(...)")
        return self.camera.attitude(self.displacement(times))

    def path(self, starts: Tensor, delays: Tensor) -> Tensor:
        """Displacement (S, N, axes) in px at delays (N,) in s from the starts S of exposures."""
        return self.displacement(starts.to(dtype=torch.float64, device=self.device)[..., None] + delays)

    def largest_displacement(self, first: float, last: float) -> Tensor:
        """Bound on ``|D(t)|`` for ``first <= t <= last``, (..., axes), in px."""
        longest = max(abs(first), abs(last))
        # a quadratic without constant term is largest at one of the ends of a symmetric interval
        ends = torch.tensor([-longest, longest], dtype=torch.float64, device="cpu").expand(*self.batch_shape, 2)
        return self.largest_oscillation() + self.drift(ends).detach().abs().amax(-2)

    def moving_axes(self) -> Tensor:
        """Whether the motion moves the image along each axis, (..., axes) bool."""
        return self.largest_displacement(-1.0, 1.0) > 0

    def to_row_order(self, timing: SensorTiming) -> Self:
        """The motion, given in image axes, as it appears in frames in row order, see ``row_axes``."""
        return self.with_axes(*row_axes(timing, self.num_axes))

    def from_row_order(self, timing: SensorTiming) -> Self:
        """The inverse of ``to_row_order``."""
        order, signs = row_axes(timing, self.num_axes)
        return self.with_axes(order, [signs[axis] for axis in order])

    def _check_axes(self, order: Sequence[int], signs: Sequence[float]) -> None:
        """Raise a ``ValueError`` unless ``order`` is a permutation of the axes and ``signs`` are 1 or -1."""
        if sorted(order) != list(range(self.num_axes)):
            raise ValueError(f"order must be a permutation of {list(range(self.num_axes))}, got {list(order)}")
        if len(signs) != self.num_axes or any(sign not in (1, -1) for sign in signs):
            raise ValueError(f"signs must be {self.num_axes} values of 1 or -1, got {list(signs)}")

    def with_camera(self, camera: Camera | None) -> Self:
        """The same components with another camera."""
        return self._changed(camera=camera)

    def detached(self) -> Self:
        """The same motion without gradients."""
        return self.mapped(Tensor.detach)

    def expanded(self, size: int) -> Self:
        """A batch of ``size`` copies of the motion; the new dimension is the first."""
        check_whole_number("size", size, at_least=1, at_most=MAX_BATCH)
        return self.mapped(lambda values: values.expand(size, *values.shape))


@dataclass(frozen=True, eq=False, repr=False)
class ColumnMotion(Motion, shapes={"column": "..."}):
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
    def num_axes(self) -> int:
        """2: the displacement of one column along x and y."""
        return 2

    def _heights(self, starts: Tensor, components: Tensor) -> Tensor:
        """Heights (S) in px from the centre of the frame of the rows exposed from ``starts`` (S) on."""
        frames = torch.tensor(self.frame_starts, dtype=torch.float64, device=self.device)
        frame = torch.searchsorted(frames, (starts + 1e-9 * self.row_time).contiguous(), right=True) - 1
        row = (starts - frames[frame.clamp(min=0)]) / self.row_time
        heights, _ = torch.broadcast_tensors(row - 0.5 * (self.num_rows - 1), components[..., 0])
        return torch.as_tensor(heights)

    def _content_displacement(self, starts: Tensor, components: Tensor) -> Tensor:
        """Displacement (S, 2) of the content of rows exposed from ``starts`` (S) on, by components (S, A)."""
        height, camera = self._heights(starts, components), self.components.camera
        x = self.column[(..., *(None,) * (height.ndim - self.column.ndim))].expand_as(height)
        y = height - components[..., 1]
        if camera is None:
            scale = 1.0 + components[..., 3] if components.shape[-1] > 3 else 1.0
            y = (y - components[..., 2] * x) / scale
        else:
            for _ in range(_FIXED_POINT_STEPS):
                y = height - camera.displacement(components, x, y)[..., 1]
        return displacement_at(components, x, y, camera)

    def displacement(self, times: Tensor) -> Tensor:
        """Displacement in px of the rows that begin their exposure at these times."""
        times = times.to(dtype=torch.float64, device=self.device)
        return self._content_displacement(times, self.components.displacement(times))

    def path(self, starts: Tensor, delays: Tensor) -> Tensor:
        """Displacement in px during exposures, as ``Motion.path``: a row keeps its position in the frame."""
        starts = starts.to(dtype=torch.float64, device=self.device)
        return self._content_displacement(starts[..., None], self.components.path(starts, delays))

    def mean_displacement(self, starts: Tensor, exposure_time: float | Tensor) -> Tensor:
        """Mean displacement over exposures in px."""
        starts = starts.to(dtype=torch.float64, device=self.device)
        return self._content_displacement(starts, self.components.mean_displacement(starts, exposure_time))

    def drift(self, times: Tensor) -> Tensor:
        """Drift of X and Y in px, the same for all columns; that of roll and zoom counts as oscillation."""
        return self.components.drift(times)[..., :2]

    def _at_ends_of_rows(self, components: Tensor) -> Tensor:
        """Bound (..., 2) on the displacement by components within bounds (..., A), in any row."""
        y = torch.stack([torch.full_like(self.column, half * self.num_rows) for half in (-0.5, 0.0, 0.5)])
        return largest_at(components, self.column, y, self.components.camera)

    def largest_oscillation(self) -> Tensor:
        """Bound on ``|D(t) - drift(t)|`` during the frames, (..., 2), in px."""
        last = self.frame_starts[-1] + (self.num_rows + 1) * self.row_time
        bounds = self.components.largest_displacement(self.frame_starts[0], last)  # roll and zoom with their drift
        return self._at_ends_of_rows(torch.cat([self.components.largest_oscillation()[..., :2], bounds[..., 2:]], -1))

    def displacement_within(self, duration: float) -> Tensor:
        """Bound on the displacement between two times ``duration`` seconds apart, (..., 2), in px."""
        return self._at_ends_of_rows(self.components.displacement_within(duration))

    def periods_within(self, duration: float) -> Tensor:
        """Periods of the fastest tone in ``duration`` seconds."""
        return self.components.periods_within(duration).amax(-1, keepdim=True).expand(*self.batch_shape, 2)

    def with_axes(self, order: Sequence[int], signs: Sequence[float]) -> Self:
        """Columns have a position in frames in row order: their axes are not exchanged."""
        raise NotImplementedError("a ColumnMotion stays in row order; exchange the axes of its components")


def check_two_axes(motion: Motion, quantity: str) -> None:
    """Raise a ``ValueError`` for a motion that displaces the columns of a row differently."""
    if not motion.same_for_all_columns:
        raise ValueError(
            f"{quantity} is not defined with roll, zoom or a camera, which displace the columns of a row differently; "
            "pass a motion with the axes (x, y) only"
        )


@dataclass(frozen=True)
class ColumnStrips:
    """Strips of columns of equal width, which overlap by half and are added up with triangular weights.

    Roll and zoom displace the content of a row by amounts that change slowly along the row. What requires a
    displacement per row is applied to strips, each with the displacement of its middle; between middles the result is
    interpolated.
    """

    frame_width: int  # columns of the frame
    width: int  # columns of a strip
    firsts: tuple[int, ...]  # first column of each strip
    middles: tuple[float, ...]  # columns, not necessarily whole, where the weight of each strip is 1

    @classmethod
    def of(cls, frame_width: int, max_pitch: float, margin: int, *, at_ends: bool = False) -> "ColumnStrips":
        """Strips whose middles are at most ``max_pitch`` px apart, with ``margin`` px without weight at both ends.

        The middles of the first and the last are half a pitch from the ends of the frame, or the ends (``at_ends``).

        Example:
            >>> strips = ColumnStrips.of(100, max_pitch=40, margin=4)
            >>> strips.width, strips.firsts
            (75, (0, 12, 25))
            >>> bool(torch.allclose(strips.joined(strips.cut(torch.ones(1, 100))), torch.ones(1, 100)))
            True
        """
        length = frame_width - at_ends
        count = max(1, math.ceil(length / max_pitch))
        step = length / count
        middles = [n * step if at_ends else (n + 0.5) * step - 0.5 for n in range(count + at_ends)]
        width = min(frame_width, math.ceil(2 * step) + 2 * margin)
        firsts = tuple(min(max(round(middle - 0.5 * (width - 1)), 0), frame_width - width) for middle in middles)
        return cls(frame_width, width, firsts, tuple(middles))

    @property
    def columns(self) -> Tensor:
        """(S,) float64 px, middles of the strips from the centre of the frame."""
        return torch.tensor(self.middles, dtype=torch.float64) - 0.5 * (self.frame_width - 1)

    def cut(self, images: Tensor) -> Tensor:
        """Strips (B S, ..., w) of images (B, ..., W)."""
        return torch.stack([images[..., first : first + self.width] for first in self.firsts], 1).flatten(0, 1)

    def joined(self, strips: Tensor) -> Tensor:
        """Images (B, ..., W) from strips (B S, ..., w), or on a finer grid whose first point lies at column 0."""
        last, scale = len(self.firsts) - 1, strips.shape[-1] // self.width
        step = self.middles[1] - self.middles[0] if last else 1.0
        values = strips.unflatten(0, (-1, last + 1))
        total = strips.new_zeros(*values[:, 0].shape[:-1], scale * self.frame_width)
        place = torch.arange(scale * self.width, device=strips.device)
        for number, (first, middle) in enumerate(zip(self.firsts, self.middles, strict=True)):
            away = (place + scale * (first - middle)) / (scale * step)
            away = away.clamp(min=0.0) if number == 0 else away
            away = away.clamp(max=0.0) if number == last else away
            weight = (1 - away.abs()).clamp(min=0.0).to(strips.dtype)
            total[..., scale * first : scale * (first + self.width)] += weight * values[:, number]
        return total
