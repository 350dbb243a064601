"""A camera with a focal length and lens distortion: the image displacement that a rotation of the camera causes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.checks.arguments import check_broadcast, checked_methods
from rsvib_torch.checks.values import check_number, check_whole_number
from rsvib_torch.text import quoted

_NEWTON_STEPS = 8  # of the inverse of the distortion; quadratic convergence, 1e-13 after 6 steps for 60 degrees


def _first(components: Tensor) -> Tensor:
    """The first of 2 to 4 components of a motion (S, A)."""
    if components.ndim == 0 or not 2 <= components.shape[-1] <= 4:
        raise ValueError(f"components must have the shape (..., A) with A = 2 to 4, got {tuple(components.shape)}")
    return components[..., 0]


@dataclass(frozen=True)
@checked_methods
class Camera:
    """Focal length, principal point, and lens distortion (the five coefficients of OpenCV).

    Axes of the camera: x to the right and y down as in the image, z forward. Scene content at the ray r appears,
    after the rotation of the camera by the vector ``w = (pitch, yaw, roll)`` in rad (right-handed about x, y, z), at
    the ray ``R(-w) r``. The components of a motion are related to it by

        ``X = -f yaw, Y = f pitch, theta = -roll``:

    X and Y are the displacement in px at the principal point for small angles. At other points the displacement
    follows exactly from the projection

        ``(x, y) = c + (1 + zeta) f (u L + 2 p1 u v + p2 (s + 2 u^2), v L + p1 (s + 2 v^2) + 2 p2 u v)``,

    with ``(u, v) = (r_x, r_y) / r_z, s = u^2 + v^2, L = 1 + k1 s + k2 s^2 + k3 s^3`` (OpenCV, camera calibration).

    Args:
        focal_length: f in px.
        principal_point: c in px from the centre of the frame, (x, y). OpenCV counts from the first pixel: subtract
            ``(width - 1) / 2`` and ``(height - 1) / 2``.
        distortion: (k1, k2, p1, p2, k3).

    Raises:
        ValueError: If a value is not finite, the focal length is not positive, or there are not five coefficients.

    Example:
        >>> camera = Camera(focal_length=1000.0)
        >>> turned = torch.tensor([-2.0, 0.0, 0.0], dtype=torch.float64)  # X = -2 px: 2 mrad to the right
        >>> x = torch.tensor([0.0, 500.0])
        >>> camera.displacement(turned, x, y=torch.tensor(0.0))[:, 0].round(decimals=3).tolist()
        [-2.0, -2.498]
    """

    focal_length: float
    principal_point: tuple[float, float] = (0.0, 0.0)
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        check_number("focal_length", self.focal_length, at_least=1.0, at_most=1e9)
        for name, count in (("principal_point", 2), ("distortion", 5)):
            values = getattr(self, name)
            if isinstance(values, str) or not isinstance(values, Sequence) or len(values) != count:
                raise ValueError(f"{name} must be {count} numbers, got {quoted(values)}")
            for value in values:
                check_number(name, value, at_least=-1e6, at_most=1e6)
            object.__setattr__(self, name, tuple(float(value) for value in values))

    def with_axes(self, order: Sequence[int], signs: Sequence[float]) -> "Camera":
        """The camera for images whose axis k (x, y) is ``signs[k]`` times axis ``order[k]`` of these images."""
        if sorted(order)[:2] != [0, 1] or any(sign not in (1, -1) for sign in signs):
            raise ValueError(f"order must be a permutation of the axes and signs 1 or -1, got {order} and {signs}")
        x, y = (signs[k] * self.principal_point[order[k]] for k in (0, 1))
        k1, k2, p1, p2, k3 = self.distortion
        tangential = (p2, p1)  # along x, along y
        p2, p1 = (signs[k] * tangential[order[k]] for k in (0, 1))
        return Camera(self.focal_length, (x, y), (k1, k2, p1, p2, k3))

    def _distorted(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        k1, k2, p1, p2, k3 = self.distortion
        s = u * u + v * v
        radial = 1 + s * (k1 + s * (k2 + s * k3))
        along = u * radial + 2 * p1 * u * v + p2 * (s + 2 * u * u)
        return along, v * radial + p1 * (s + 2 * v * v) + 2 * p2 * u * v

    def _distortion_slope(self, u: Tensor, v: Tensor) -> Tensor:
        """Derivative (S, 2, 2) of the distorted position with respect to (u, v)."""
        k1, k2, p1, p2, k3 = self.distortion
        s = u * u + v * v
        radial = 1 + s * (k1 + s * (k2 + s * k3))
        slope = 2 * (k1 + s * (2 * k2 + s * 3 * k3))  # of the radial factor, divided by u or v
        mixed = u * v * slope + 2 * (p1 * u + p2 * v)
        return torch.stack(
            [
                torch.stack([radial + u * u * slope + 2 * p1 * v + 6 * p2 * u, mixed], -1),
                torch.stack([mixed, radial + v * v * slope + 6 * p1 * v + 2 * p2 * u], -1),
            ],
            -2,
        )

    def rays(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """(u, v) of the rays (u, v, 1) of image points in px from the centre of the frame, by Newton's method."""
        check_broadcast(x=x, y=y)
        x, y = torch.broadcast_tensors(1.0 * x, 1.0 * y)
        along, across = (
            (x - self.principal_point[0]) / self.focal_length,
            (y - self.principal_point[1]) / self.focal_length,
        )
        if not any(self.distortion):
            return along, across
        u, v = along, across
        for _ in range(_NEWTON_STEPS):
            there = self._distorted(u, v)
            a, b, c, d = self._distortion_slope(u, v).flatten(-2).unbind(-1)
            rest, other = along - there[0], across - there[1]
            determinant = a * d - b * c
            u, v = u + (d * rest - b * other) / determinant, v + (a * other - c * rest) / determinant
        return u, v

    def check_size(self, width: int, height: int) -> None:
        """Raise a ``ValueError`` unless every point of a frame of this size has one ray.

        Example:
            >>> Camera(500.0, distortion=(-2.0, 0.0, 0.0, 0.0, 0.0)).check_size(1920, 1080)
            Traceback (most recent call last):
            ...
            ValueError: distortion (-2.0, 0.0, 0.0, 0.0, 0.0) with focal_length=500 px is not invertible in frames of \
1920 x 1080 px: check the order (k1, k2, p1, p2, k3) and the size of the frames of the calibration
        """
        x = torch.linspace(-0.5, 0.5, 33, dtype=torch.float64) * width
        y = torch.linspace(-0.5, 0.5, 33, dtype=torch.float64)[:, None] * height
        u, v = self.rays(x, y)
        back = self._distorted(u, v)
        px = self.focal_length * torch.stack([u, v])
        missed = max(
            float((self.focal_length * back[k] + self.principal_point[k] - at).abs().amax())
            for k, at in ((0, x), (1, y))
        )
        folded = bool((torch.linalg.det(self._distortion_slope(u, v)) <= 0).any())
        if folded or not bool(torch.isfinite(px).all()) or not missed < 1e-6:
            raise ValueError(
                f"distortion {self.distortion} with focal_length={self.focal_length:g} px is not invertible in frames "
                f"of {width} x {height} px: check the order (k1, k2, p1, p2, k3) and the size of the frames of the "
                "calibration"
            )

    def displacement(self, components: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """Displacement (S, 2) in px of content at (x, y) px (S) from the centre, by components (S, A) of a motion.

        Args:
            components: X and Y in px, roll theta in rad and zoom, A = 2 to 4.
            x: px, position at rest.
            y: The same along y.
        """
        check_broadcast(components=_first(components), x=x, y=y)
        return self.displacement_of_rays(components, *self.rays(x.to(components), y.to(components)))

    def displacement_of_rays(self, components: Tensor, u: Tensor, v: Tensor) -> Tensor:
        """``displacement`` of the content at the rays (u, v, 1)."""
        check_broadcast(components=_first(components), u=u, v=v)
        pitch, yaw = components[..., 1] / self.focal_length, components[..., 0] / -self.focal_length
        roll = -components[..., 2] if components.shape[-1] > 2 else torch.zeros_like(pitch)
        # Rodrigues: R(-w) r = cos a r - sinc(a) w x r + (1 - cos a) / a^2 w (w . r), a = |w|
        squared = pitch.square() + yaw.square() + roll.square()
        angle = squared.sqrt() if not components.requires_grad else (squared + 1e-300).sqrt()
        sine = torch.sinc(angle / math.pi)
        versed = 0.5 * torch.sinc(angle / (2 * math.pi)).square()
        cosine = 1 - versed * squared
        along = versed * (pitch * u + yaw * v + roll)
        turned_x = cosine * u - sine * (yaw - roll * v) + along * pitch
        turned_y = cosine * v - sine * (roll * u - pitch) + along * yaw
        turned_z = cosine - sine * (pitch * v - yaw * u) + along * roll
        moved = torch.stack(self._distorted(turned_x / turned_z, turned_y / turned_z), -1)
        rest = torch.stack(self._distorted(u, v), -1)
        if components.shape[-1] > 3:
            moved = moved * (1 + components[..., 3:])
        return self.focal_length * (moved - rest)

    def factors(self, x: Tensor, y: Tensor, axes: int) -> Tensor:
        """Displacement (S, 2, A) by unit components at positions (S) in px from the centre, for small angles.

        Example:
            >>> Camera(1000.0).factors(torch.tensor(500.0), torch.tensor(0.0), 3).tolist()
            [[1.25, 0.0, 0.0], [0.0, 1.0, 500.0]]
        """
        check_whole_number("axes", axes, at_least=2, at_most=4)
        u, v = self.rays(x, y)
        x, y = torch.broadcast_tensors(x.to(u), y.to(u))
        f = self.focal_length
        rotation = torch.stack(
            [torch.stack([1 + u * u, u * v, -f * v], -1), torch.stack([u * v, 1 + v * v, f * u], -1)], -2
        )
        moved = self._distortion_slope(u, v) @ rotation
        zoomed = torch.stack([x - self.principal_point[0], y - self.principal_point[1]], -1)
        return torch.cat([moved, zoomed[..., None]], -1)[..., :axes]

    def attitude(self, components: Tensor) -> Tensor:
        """(S, 3) rad: pitch, yaw and roll of the camera for components (S, A) of a motion.

        Example:
            >>> Camera(1000.0).attitude(torch.tensor([-2.0, 1.0, 1e-3], dtype=torch.float64)).tolist()
            [0.001, 0.002, -0.001]
        """
        angles = [components[..., 1] / self.focal_length, -components[..., 0] / self.focal_length]
        roll = -components[..., 2] if components.shape[-1] > 2 else torch.zeros_like(angles[0])
        return torch.stack([*angles, roll], -1)
