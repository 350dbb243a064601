"""The base class of motions: what code outside this package may use of a motion of any type."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from rsvib_torch.checks.arguments import check_broadcast, checked_methods
from rsvib_torch.checks.values import check_whole_number
from rsvib_torch.motion.camera import Camera
from rsvib_torch.motion.timing import MAX_BATCH, SensorTiming, row_axes
from rsvib_torch.results.presentation import Result


@dataclass(frozen=True, eq=False, repr=False)
@checked_methods
class Motion(Result, ABC):
    """Motion of the image on the sensor as a function of time: scene content at ``s`` appears at ``s + D(t)``.

    Contract of a motion type. It is a frozen dataclass (``eq=False, repr=False``) whose fields are float64 tensors that
    begin with the batch dimensions, other motions of the same batch shape, and plain numbers for the whole batch. It
    implements the abstract members below. The last axis of every result counts the components: x and y in px, positive
    to the right and down, then roll in rad and zoom (relative) if there are three or four (see ``motion.field``). Times
    have any shape S whose leading dimensions are the batch dimensions (or 1), in seconds since the exposure start of
    row 0 of frame 0; results (S, axes) are float64, and differentiable except for bounds. A motion is an immutable
    value.
    """

    @property
    @abstractmethod
    def batch_shape(self) -> torch.Size:
        """Leading dimensions: empty for one motion, (B,) for a batch of stacks."""

    @property
    @abstractmethod
    def device(self) -> torch.device:
        """Device of the parameters."""

    @abstractmethod
    def displacement(self, times: Tensor) -> Tensor:
        """Displacement D(t) in px, (S, axes), at times S in seconds."""

    @abstractmethod
    def mean_displacement(self, starts: Tensor, exposure_time: float | Tensor) -> Tensor:
        """Mean displacement (S, axes) over exposures [start, start + T_e] in px (Eq. 2 of Liu et al. 2023).

        The exposure time in s is a number or a tensor that broadcasts against the starts S.
        """

    @abstractmethod
    def velocity(self, times: Tensor) -> Tensor:
        """Velocity dD/dt in px/s; arguments and shapes as in ``displacement``."""

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

    def offset(self, starts: Tensor, later_starts: Tensor, exposure_time: float) -> Tensor:
        """Offset (Eq. 4): mean displacement of the later exposure minus that of the earlier one, in px, (S, axes).

        Starts S in s are those of the same scene rows in two frames. The left-hand side of Eq. (4) has the opposite
        sign.
        """
        check_broadcast(starts=starts, later_starts=later_starts)
        return self.mean_displacement(later_starts, exposure_time) - self.mean_displacement(starts, exposure_time)

    def largest_displacement(self, first: float, last: float) -> Tensor:
        """Bound on ``|D(t)|`` for ``first <= t <= last``, (..., axes), in px."""
        longest = max(abs(first), abs(last))
        # a quadratic without constant term is largest at one of the ends of a symmetric interval
        ends = torch.tensor([-longest, longest], dtype=torch.float64, device="cpu").expand(*self.batch_shape, 2)
        return self.largest_oscillation() + self.drift(ends).detach().abs().amax(-2)

    def moving_axes(self) -> Tensor:
        """Whether the motion moves the image along each axis, (..., axes) bool.

        Example:
            >>> from rsvib_torch import Vibration
            >>> Vibration([2.0, 0.0], [50.0, 0.0], image_acceleration=[0.0, 3.0]).moving_axes().tolist()
            [True, True]
        """
        return self.largest_displacement(-1.0, 1.0) > 0

    def to_row_order(self, timing: SensorTiming) -> Self:
        """The motion, given in image axes, as it appears in frames in row order, see ``row_axes``."""
        order, signs = row_axes(timing, self.num_axes)
        return self.with_axes(order, signs)

    def from_row_order(self, timing: SensorTiming) -> Self:
        """The motion, given in row order, in image axes: the inverse of ``to_row_order``."""
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
        result = copy(self)
        object.__setattr__(result, "camera", camera)
        return result

    def detached(self) -> Self:
        """The same motion without gradients."""
        return self.mapped(Tensor.detach)

    def expanded(self, size: int) -> Self:
        """A batch of ``size`` copies of the motion; the new dimension is the first."""
        check_whole_number("size", size, at_least=1, at_most=MAX_BATCH)
        return self.mapped(lambda values: values.expand(size, *values.shape))

    def __getitem__(self, index: int) -> Self:
        """One motion of a batch."""
        if not self.batch_shape:
            raise IndexError("this motion is not a batch")
        return self.mapped(lambda values: values[index])
