"""The rotation of a camera over a video by a gyroscope, as a path like that of ``camera_path``.

Orientations are compared by rotation vectors between them, in the units of a path (x and y in px, roll in rad): pans of
any size are composed exactly.
"""

import math
import operator
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from rsvib_torch.gyroscope.gyroscope_rates import AngularRates, orientation_matrix
from rsvib_torch.gyroscope.rotation_alignment import RotationAlignment
from rsvib_torch.gyroscope.rotation_fit import image_components
from rsvib_torch.motion.camera import Camera
from rsvib_torch.motion.spline import FreeMotion
from rsvib_torch.numerics.tables import Array, table, tensor

_MARGIN = 4  # samples of the gyroscope on each side of a frame, for the ends of a spline


@dataclass(frozen=True, eq=False)
class RecordedRotation:
    """Rotation of a camera about its axes x (right), y (down) and z (forward), on the clock of the frames."""

    rates: AngularRates  # of the camera
    camera: Camera
    times: Array  # (N,) s, middle of every frame
    orientations: Rotation  # (N) of the camera at these times, from the first

    @classmethod
    def aligned(cls, rates: AngularRates, alignment: RotationAlignment, times: Array) -> "RecordedRotation":
        """The rotation at the middles of all frames, which the recording must cover, by rates aligned with some."""
        # 1. The rates about the axes of the camera, per second of the frames.
        turned = alignment.scale * (rates.rates.cpu() - alignment.bias) @ orientation_matrix(alignment.orientation).T
        of_camera = AngularRates((rates.times.cpu() - alignment.offset) / alignment.scale, turned)
        if times[0] < of_camera.start or times[-1] > of_camera.end:
            raise ValueError(
                f"the gyroscope was recorded from {of_camera.start:.4g} to {of_camera.end:.4g} s of the video: it must "
                f"cover all frames, {times[0]:.4g} to {times[-1]:.4g} s"
            )
        # 2. Orientations at the samples before the middles of the frames, and the rotation from there.
        middles = tensor(times)
        before = torch.searchsorted(of_camera.times, middles, right=True) - 1
        samples = Rotation.from_rotvec(table(of_camera.attitude(float(times[0]))[before]))
        within = Rotation.from_rotvec(table(of_camera.rotation(of_camera.times[before], middles)))
        return cls(of_camera, alignment.motion.camera or Camera(alignment.focal_length), times, samples * within)

    @cached_property
    def _axes(self) -> Rotation:
        """(N) axes of the frames from those of ``path``.

        They turn by half of the rotation from frame to frame: displacements S and T of neighbouring frames, whose
        rotation is R, have the rotation ``R + T - S`` between them then, without ``(S + T) x R / 2``.
        """
        return Rotation.concatenate([*accumulate(self._steps**0.5, operator.mul, initial=Rotation.identity())])

    @cached_property
    def _steps(self) -> Rotation:
        """(N - 1) rotations from frame to frame."""
        return self.orientations[:-1].inv() * self.orientations[1:]

    @property
    def path(self) -> Array:
        """(N, 3) px at the focal length, sums of the rotation vectors from frame to frame."""
        summed = np.cumsum(self._axes[:-1].apply(self._steps.as_rotvec()), 0)
        return self.camera.focal_length * np.concatenate([np.zeros((1, 3)), summed])

    def of_frames(self, shifts: Array) -> Array:
        """(N, 4) components in the axes of every frame of displacements (N, 3) in those of ``path``."""
        turned = Rotation.from_rotvec(self._axes.inv().apply(shifts) / self.camera.focal_length)
        return np.pad(self._components(turned), ((0, 0), (0, 1)))

    def motion(self, number: int, shift: Array, reach: float) -> FreeMotion:
        """The motion up to ``reach`` in s from the middle of a frame, its time origin, where it is ``shift`` (4,)."""
        samples = math.ceil(reach * self.rates.sample_rate) + _MARGIN
        times = np.arange(-2 * samples, 2 * samples + 1) / (2 * self.rates.sample_rate)
        middle = torch.full((len(times),), self.times[number], dtype=torch.float64)
        within = Rotation.from_rotvec(table(self.rates.rotation(middle, middle + tensor(times))))
        turned = Rotation.from_rotvec(table(self.camera.attitude(tensor(shift[:3])))) * within
        return FreeMotion.through(times, self._components(turned), camera=self.camera)

    def _components(self, rotations: Rotation) -> Array:
        """(n, 3) X, Y (px) and roll (rad) of rotations, see ``Camera``."""
        return table(image_components(tensor(rotations.as_rotvec()), self.camera.focal_length))
