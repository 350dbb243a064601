"""A camera with a focal length and lens distortion: the image displacement that a rotation of the camera causes."""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from rsvib_torch.checks.arguments import check_broadcast, checked_methods
from rsvib_torch.checks.values import check_choice, check_number, check_whole_number, read_json
from rsvib_torch.text import quoted

_NEWTON_STEPS = 8  # of the inverse of the distortion; quadratic convergence, 1e-13 after 6 steps for 60 degrees
_LARGEST_ANGLE = 1.55  # rad from the optical axis, of the rays of a fisheye lens; those of 90 degrees have no (u, v, 1)
_CENTRAL = 1e-5  # squared tangent of the angle, below which series replace quotients of a fisheye lens
_SAME_ASPECT = 0.01  # of the ratio of width and height; 2160 and 2176 rows of 3840 px are one mode of a camera
_BEYOND_LINEAR = 1.1  # a rotation by 0.05 rad displaces a corner at 60 degrees by 8 % more than its linear part
_SAME_FOCAL_LENGTH = 0.02  # of both axes of a lens profile; of 1,094, nine in ten differ by less than 1 %


@dataclass(frozen=True)
@checked_methods
class Camera:
    """Focal length, principal point, and lens distortion (the coefficients of OpenCV).

    Axes of the camera: x to the right and y down as in the image, z forward. Scene content at the ray r appears,
    after the rotation of the camera by the vector ``w = (pitch, yaw, roll)`` in rad (right-handed about x, y, z), at
    the ray ``R(-w) r``. The components of a motion are related to it by

        ``X = -f yaw, Y = f pitch, theta = -roll``:

    X and Y are the displacement in px at the principal point for small angles. At other points the displacement
    follows exactly from the projection

        ``(x, y) = c + (1 + zeta) f (u L + 2 p1 u v + p2 (s + 2 u^2), v L + p1 (s + 2 v^2) + 2 p2 u v)``,

    with ``(u, v) = (r_x, r_y) / r_z, s = u^2 + v^2, L = 1 + k1 s + k2 s^2 + k3 s^3`` (OpenCV, camera calibration). For
    a fisheye lens, ``p1 = p2 = 0`` and, with the angle ``a = arctan sqrt(s)`` from the optical axis,

        ``L = a (1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8) / sqrt(s)`` (OpenCV, fisheye camera model).

    Args:
        focal_length: f in px.
        principal_point: c in px from the centre of the frame, (x, y). OpenCV counts from the first pixel: subtract
            ``(width - 1) / 2`` and ``(height - 1) / 2``.
        distortion: (k1, k2, p1, p2, k3), or (k1, k2, k3, k4) of a fisheye lens; by default zeros.
        fisheye: Whether it is a fisheye lens.

    Raises:
        ValueError: If a value is not finite, the focal length is not positive, or there are not five (four)
            coefficients.

    Example:
        >>> camera = Camera(focal_length=1000.0)
        >>> turned = torch.tensor([-2.0, 0.0, 0.0], dtype=torch.float64)  # X = -2 px: 2 mrad to the right
        >>> x = torch.tensor([0.0, 500.0])
        >>> camera.displacement(turned, x, y=torch.tensor(0.0))[:, 0].round(decimals=3).tolist()
        [-2.0, -2.498]
    """

    focal_length: float
    principal_point: tuple[float, float] = (0.0, 0.0)
    distortion: tuple[float, ...] = ()
    fisheye: bool = False

    def __post_init__(self) -> None:
        check_number("focal_length", self.focal_length, at_least=1.0, at_most=1e9)
        check_choice("fisheye", self.fisheye, (True, False))
        for name, count in (("principal_point", 2), ("distortion", 4 if self.fisheye else 5)):
            values = (0.0,) * count if getattr(self, name) == () else getattr(self, name)
            if isinstance(values, str) or not isinstance(values, Sequence) or len(values) != count:
                raise ValueError(f"{name} must be {count} numbers, got {quoted(values)}")
            for value in values:
                check_number(name, value, at_least=-1e6, at_most=1e6)
            object.__setattr__(self, name, tuple(float(value) for value in values))

    @staticmethod
    def from_gyroflow(path: str | os.PathLike[str], width: int, height: int) -> "Camera":
        """The fisheye lens of a lens profile of Gyroflow (JSON), for frames of a size to which the image is scaled.

        Profiles of many cameras: https://github.com/gyroflow/lens_profiles.

        Raises:
            ValueError: If it is no such profile, of another lens model, or of another aspect than the frames.

        Example:
            >>> Camera.from_gyroflow("GoPro_HERO11 Black_Wide_16by9.json", 1920, 1080)  # doctest: +SKIP
        """
        columns, rows = check_whole_number("width", width, at_least=1), check_whole_number("height", height, at_least=1)
        profile = read_json(Path(path), "lens profile of Gyroflow")
        model = profile.get("digital_lens") or profile.get("distortion_model") or "opencv_fisheye"
        if model != "opencv_fisheye":
            raise ValueError(f"{path}: the lens model {quoted(model)} is not supported, only opencv_fisheye")
        try:
            size, lens = profile["calib_dimension"], profile["fisheye_params"]
            (fx, _, cx), (_, fy, cy), _ = lens["camera_matrix"]
            centre = cx - 0.5 * (size["w"] - 1), cy - 0.5 * (size["h"] - 1)
            camera = Camera(math.sqrt(fx * fy), centre, tuple(lens["distortion_coeffs"]), fisheye=True)
            aspects = size["w"] / size["h"], columns / rows
        except (KeyError, TypeError, ValueError, ArithmeticError) as error:
            raise ValueError(f"{path}: not a lens profile of Gyroflow: {error!r}") from error
        if not math.isclose(*aspects, rel_tol=_SAME_ASPECT):
            raise ValueError(f"{path}: is for frames of {size['w']} x {size['h']} px, got {columns} x {rows} px")
        if not math.isclose(fx, fy, rel_tol=_SAME_FOCAL_LENGTH):
            raise ValueError(f"{path}: different focal lengths along x and y, {fx:g} and {fy:g} px, are not supported")
        return camera.scaled(columns / size["w"])

    def scaled(self, factor: float) -> "Camera":
        """The camera for images whose pixels are smaller by a factor."""
        x, y = self.principal_point
        return replace(self, focal_length=factor * self.focal_length, principal_point=(factor * x, factor * y))

    @property
    def _tangential(self) -> tuple[float, float]:
        return (0.0, 0.0) if self.fisheye else (self.distortion[2], self.distortion[3])

    def with_axes(self, order: Sequence[int], signs: Sequence[float]) -> "Camera":
        """The camera for images whose axis k (x, y) is ``signs[k]`` times axis ``order[k]`` of these images."""
        if sorted(order)[:2] != [0, 1] or any(sign not in (1, -1) for sign in signs):
            raise ValueError(f"order must be a permutation of the axes and signs 1 or -1, got {order} and {signs}")
        x, y = (signs[k] * self.principal_point[order[k]] for k in (0, 1))
        distortion = list(self.distortion)
        if not self.fisheye:  # p2 belongs to x, p1 to y
            tangential = distortion[3], distortion[2]
            distortion[3], distortion[2] = (signs[k] * tangential[order[k]] for k in (0, 1))
        return replace(self, principal_point=(x, y), distortion=tuple(distortion))

    def _radial(self, s: Tensor) -> tuple[Tensor, Tensor]:
        """The factor L, and twice its derivative by s."""
        if not self.fisheye:
            k1, k2, _, _, k3 = self.distortion
            return 1 + s * (k1 + s * (k2 + s * k3)), 2 * (k1 + s * (2 * k2 + s * 3 * k3))
        r = (s + torch.finfo(s.dtype).tiny).sqrt()
        distance, slope = self._distance(r.atan())
        factor = distance / r
        series = 2 * (self.distortion[0] - 1 / 3)
        return factor, torch.where(s < _CENTRAL, series, (slope / (1 + s) - factor) / s.clamp(min=_CENTRAL))

    def _distance(self, angle: Tensor) -> tuple[Tensor, Tensor]:
        """Distance of the image of a ray from the principal point over f, by a fisheye lens, and its derivative."""
        k1, k2, k3, k4 = self.distortion
        t = angle * angle
        distance = angle * (1 + t * (k1 + t * (k2 + t * (k3 + t * k4))))
        return distance, 1 + t * (3 * k1 + t * (5 * k2 + t * (7 * k3 + t * 9 * k4)))

    def _distorted(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        p1, p2 = self._tangential
        s = u * u + v * v
        radial, _ = self._radial(s)
        along = u * radial + 2 * p1 * u * v + p2 * (s + 2 * u * u)
        return along, v * radial + p1 * (s + 2 * v * v) + 2 * p2 * u * v

    def _distortion_slope(self, u: Tensor, v: Tensor) -> Tensor:
        """Derivative (S, 2, 2) of the distorted position with respect to (u, v)."""
        p1, p2 = self._tangential
        radial, slope = self._radial(u * u + v * v)
        mixed = u * v * slope + 2 * (p1 * u + p2 * v)
        by_u, by_v = radial + u * u * slope + 2 * p1 * v + 6 * p2 * u, radial + v * v * slope + 6 * p1 * v + 2 * p2 * u
        return torch.stack([by_u, mixed, mixed, by_v], -1).unflatten(-1, (2, 2))

    def rays(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """(u, v) of the rays (u, v, 1) of image points in px from the centre of the frame, by Newton's method."""
        check_broadcast(x=x, y=y)
        x, y = torch.broadcast_tensors(1.0 * x, 1.0 * y)
        along, across = ((p - c) / self.focal_length for p, c in zip((x, y), self.principal_point, strict=True))
        if not self.fisheye and not any(self.distortion):
            return along, across
        if self.fisheye:
            distance = torch.hypot(along, across)
            angle = distance.clamp(max=_LARGEST_ANGLE)
            for _ in range(2 * _NEWTON_STEPS):
                reached, slope = self._distance(angle)
                angle = (angle - (reached - distance) / slope).clamp(0.0, _LARGEST_ANGLE)
            factor = torch.where(distance > 0, angle.tan() / distance.clamp(min=1e-30), 1.0)
            return along * factor, across * factor
        u, v = along, across
        for _ in range(_NEWTON_STEPS):
            distorted = self._distorted(u, v)
            a, b, c, d = self._distortion_slope(u, v).flatten(-2).unbind(-1)
            error_u, error_v = along - distorted[0], across - distorted[1]
            determinant = a * d - b * c
            u, v = u + (d * error_u - b * error_v) / determinant, v + (a * error_v - c * error_u) / determinant
        return u, v

    def check_size(self, width: int, height: int) -> None:
        """Raise a ``ValueError`` unless every point of a frame of this size has one ray."""
        x = torch.linspace(-0.5, 0.5, 33, dtype=torch.float64) * width
        y = torch.linspace(-0.5, 0.5, 33, dtype=torch.float64)[:, None] * height
        u, v = self.rays(x, y)
        back = zip(self._distorted(u, v), self.principal_point, (x, y), strict=True)
        missed = max(float((self.focal_length * p + centre - at).abs().amax()) for p, centre, at in back)
        folded = bool((torch.linalg.det(self._distortion_slope(u, v)) <= 0).any())
        names = "k1, k2, k3, k4" if self.fisheye else "k1, k2, p1, p2, k3"
        if folded or not bool(torch.isfinite(torch.stack([u, v])).all()) or not missed < 1e-6:
            raise ValueError(
                f"distortion {self.distortion} with focal_length={self.focal_length:g} px is not invertible in frames "
                f"of {width} x {height} px: check the order ({names}) and the size of the frames of the calibration"
            )

    def displacement(self, components: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """Displacement (S, 2) in px of content at rest at (x, y) px (S) from the centre, by components (S, A).

        The components are X and Y in px, roll theta in rad and zoom, A = 2 to 4.
        """
        if components.ndim == 0 or not 2 <= components.shape[-1] <= 4:
            raise ValueError(f"components must have the shape (..., A) with A = 2 to 4, got {tuple(components.shape)}")
        check_broadcast(components=components[..., 0], x=x, y=y)
        components = components if components.is_floating_point() else components.double()
        u, v = self.rays(x.to(components), y.to(components))
        pitch, yaw, roll = self.attitude(components).unbind(-1)
        # Rodrigues: R(-w) r = cos a r - sinc(a) w x r + (1 - cos a) / a^2 w (w . r), a = |w|
        squared = pitch.square() + yaw.square() + roll.square()
        angle = (squared + 1e-300).sqrt()  # with a derivative at 0
        sine = torch.sinc(angle / math.pi)
        versed = 0.5 * torch.sinc(angle / (2 * math.pi)).square()
        cosine = 1 - versed * squared
        along = versed * (pitch * u + yaw * v + roll)
        turned_x = cosine * u - sine * (yaw - roll * v) + along * pitch
        turned_y = cosine * v - sine * (roll * u - pitch) + along * yaw
        turned_z = cosine - sine * (pitch * v - yaw * u) + along * roll
        displaced = torch.stack(self._distorted(turned_x / turned_z, turned_y / turned_z), -1)
        still = torch.stack(self._distorted(u, v), -1)
        if components.shape[-1] > 3:
            displaced = displaced * (1 + components[..., 3:])
        return self.focal_length * (displaced - still)

    def factors(self, x: Tensor, y: Tensor, axes: int) -> Tensor:
        """Displacement (S, 2, A) by unit components at positions (S) in px from the centre, for small angles."""
        check_whole_number("axes", axes, at_least=2, at_most=4)
        u, v = self.rays(x, y)
        x, y = torch.broadcast_tensors(x.to(u), y.to(u))
        f = self.focal_length
        rotation = torch.stack([1 + u * u, u * v, -f * v, u * v, 1 + v * v, f * u], -1).unflatten(-1, (2, 3))
        rotated = self._distortion_slope(u, v) @ rotation
        zoomed = torch.stack([x - self.principal_point[0], y - self.principal_point[1]], -1)
        return torch.cat([rotated, zoomed[..., None]], -1)[..., :axes]

    def attitude(self, components: Tensor) -> Tensor:
        """(S, 3) rad: pitch, yaw and roll of the camera for components (S, A) of a motion."""
        pitch, yaw = components[..., 1] / self.focal_length, -components[..., 0] / self.focal_length
        roll = -components[..., 2] if components.shape[-1] > 2 else torch.zeros_like(pitch)
        return torch.stack([pitch, yaw, roll], -1)


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
    """Displacement (S, 2) in px of scene content at (x, y) px (S) from the centre, by components (S, A).

    Components (X, Y, theta, zeta) displace it by ``(X - theta y + zeta x, Y + theta x + zeta y)``, with the roll theta
    in rad and the relative zoom zeta. With a finite focal length (``Camera``), translation displaces columns
    differently as well.
    """
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


def largest_at(components: Tensor, x: Tensor, y: Tensor, camera: Camera | None) -> Tensor:
    """Bound (..., 2) in px on the displacement at P places (P, ...), by components within bounds (..., A)."""
    factors = displacement_factors(x, y, components.shape[-1], camera).abs().amax(0)
    bound: Tensor = (factors @ components[..., None])[..., 0]
    return bound if camera is None else bound * _BEYOND_LINEAR


def largest_in_frame(components: Tensor, width: int, height: int, camera: Camera | None = None) -> Tensor:
    """Bound (..., 2) in px on the displacement in a frame, by components within bounds (..., A)."""
    x, y = _corners(width, height, components)
    if camera is not None:  # a strong barrel distortion is largest within the frame
        centre = components.new_tensor(camera.principal_point)
        x, y = torch.cat([x, centre[:1]]), torch.cat([y, centre[1:]])
    return largest_at(components, x, y, camera)


def largest_slope(components: Tensor, width: int, height: int, camera: Camera | None = None) -> Tensor:
    """Bound (...) in px on the change of the displacement per column, by components within bounds (..., A)."""
    x, y = _corners(width, height, components)
    axes = components.shape[-1]
    along = displacement_factors(x, y, axes, camera) - displacement_factors(x - x.sign(), y, axes, camera)
    return (along.abs().amax(0) @ components[..., None])[..., 0].amax(-1)
