"""Components of a motion with roll and zoom, from the displacements of strips of columns.

Roll and zoom displace the content of a row by amounts that depend on the column (``displacement_at``). For a start,
strips of columns are registered like stacks of their own. With the displacement ``d_s`` of a row in strip s, its
information ``W_s`` and the factors ``F_s`` from the components q of the motion to the displacement at the strip, the
components of the row are the weighted least-squares solution

    ``(sum_s F_s^T W_s F_s) q = sum_s F_s^T W_s d_s``,

whose matrix is the information of q. Fits then do not differ from those of whole rows. Components of roll and zoom are
multiplied by a length, the rms distance of the pixels from the centre, so that all components are in px.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.motion.camera import Camera, displacement_factors
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.motion.vibration import Vibration, VibrationStd
from rsvib_torch.numerics.tables import Array, split_axis
from rsvib_torch.options import ProjectionOptions


@dataclass(frozen=True)
class FieldScale:
    """Lengths of a frame that roll and zoom refer to."""

    axes: int  # number of components of the motion, 2 to 4
    width: int  # columns of a frame
    height: int  # rows of a frame
    camera: Camera | None = None  # focal length and lens, in row order

    @property
    def same_for_all_columns(self) -> bool:
        """Whether the motion displaces all columns of a row alike."""
        return self.axes == 2 and self.camera is None

    @property
    def radius(self) -> float:
        """Root-mean-square distance of the pixels from the centre of the frame, in px."""
        return math.sqrt((self.width**2 + self.height**2 - 2) / 12)

    def units(self, like: Tensor) -> Tensor:
        """(A,) factors from components in px to (px, px, rad, 1)."""
        return like.new_tensor([1.0, 1.0, 1 / self.radius, 1 / self.radius][: self.axes])

    def motion(self, fitted: Vibration) -> Vibration:
        """The vibration with roll in rad and relative zoom, of one whose components are all in px."""
        if self.same_for_all_columns:
            return fitted
        return replace(fitted.scaled(self.units(fitted.amplitude)), camera=self.camera)

    def free_motion(self, fitted: FreeMotion) -> FreeMotion:
        """The same for a free motion."""
        coefficients = fitted.coefficients * self.units(fitted.coefficients)[:, None]
        return FreeMotion(coefficients, fitted.start, fitted.spacing, self.motion(fitted.tones))

    def std(self, fitted: VibrationStd) -> VibrationStd:
        """The same for standard deviations."""
        factor = self.units(fitted.amplitude)
        of_axes = ("image_motion", "image_acceleration", "displacement")
        values = {name: getattr(fitted, name) for name in of_axes}
        scaled = {name: value * factor for name, value in values.items() if value is not None}
        return replace(fitted, amplitude=fitted.amplitude * factor[:, None], **scaled)

    def factors(self, x: Tensor, y: Tensor) -> Tensor:
        """Displacement (S, 2, A) at positions (S) in px from the centre by unit components in px."""
        return displacement_factors(x, y, self.axes, self.camera) * self.units(x)


def camera_in_row_order(options: ProjectionOptions, size: tuple[int, int], timing: SensorTiming) -> Camera | None:
    """Camera of frames of ``size`` (rows, columns) in row order, from the options of ``detect_vibration``."""
    principal_point, distortion = options.principal_point, options.distortion
    if options.focal_length is None:
        for name, value in (("principal_point", principal_point), ("distortion", distortion)):
            if value is not None:
                raise ValueError(f"{name}={value!r} requires focal_length, in px")
        return None
    height, width = size if timing.scan_axis == -2 else size[::-1]
    centre = (0.5 * (width - 1), 0.5 * (height - 1))
    point = centre if principal_point is None else principal_point
    camera = Camera(options.focal_length, point, distortion or (0.0,) * 5)
    x, y = camera.principal_point
    camera = replace(camera, principal_point=(x - centre[0], y - centre[1]))
    camera.check_size(width, height)
    return Vibration.still(axes=2).with_camera(camera).to_row_order(timing).camera


def combined_strips(measured: Measurements, factors: Array) -> Measurements:
    """Components (B, N, G, A) of rows from displacements (B S, N, G, 2) of strips by ``factors`` (B, S, N, 2, A)."""
    strips = factors.shape[1]

    def of_strips(values: Array) -> Array:
        return split_axis(values, 0, -1, strips)

    # 1. Displacements relative to the frames in which all strips of a row are visible.
    visible = of_strips(measured.visible).min(1)
    everywhere = replace(measured, visible=np.repeat(visible, strips, 0))
    displacements = of_strips(everywhere.relative(measured.displacements))  # (B, S, N, G, 2)
    # 2. The normal equations of the components of every row, in units of their sizes.
    weighted = of_strips(measured.information) @ factors
    information = (factors.mT @ weighted).sum(1)  # (B, N, A, A)
    right = np.einsum("bsnia,bsngi->bnga", weighted, displacements)
    size = information.diagonal(axis1=-2, axis2=-1)
    unit = 1 / np.sqrt(np.maximum(size, 1e-300))
    normal = information * unit[..., :, None] * unit[..., None, :]
    # 3. Their solution; fewer than two strips with detail do not determine roll.
    values, vectors = np.linalg.eigh(np.where((size > 0).all(-1)[..., None, None], normal, 0.0))
    regular = values[..., 0] > 1e-6
    solvable = np.where(regular[..., None], values, 1.0)
    inverse = (vectors / solvable[..., None, :]) @ vectors.mT  # (B, N, A, A)
    components = np.where(regular[:, :, None, None], ((right * unit[:, :, None]) @ inverse) * unit[:, :, None], 0.0)
    return Measurements(
        of_strips(measured.exposure_starts).mean(1),
        components,
        visible,
        np.where(regular[..., None, None], information, 0.0),
        measured.exposure_time,
        measured.average_times,
        measured.independent,
    )
