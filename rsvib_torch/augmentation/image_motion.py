"""Motion of a batch of images, each with a vibration, a start and an exposure of its own."""

from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.imaging import exposure_nodes, gauss_node_count
from rsvib_torch.motion.timing import RowTiming, SensorTiming
from rsvib_torch.motion.vibration import Vibration

__all__ = ["ImageMotion"]

_STEPS = 8  # of Newton's method
_ONE_SECOND = SensorTiming(row_time=1e-3, exposure_rows=1000, frame_rows=1000)  # nodes to be stretched to exposures


@dataclass(frozen=True, eq=False)
class ImageMotion:
    """Motion of B images in row order.

    Attributes:
        vibration: Of batch shape (B,).
        starts: (B,) exposure start of the first row of each image, seconds.
        exposure_time: (B,) seconds.
        timing: The sensor; its exposure is not used.
    """

    vibration: Vibration
    starts: Tensor
    exposure_time: Tensor
    timing: RowTiming

    def trajectory(self, num_rows: int) -> tuple[Tensor, Tensor]:
        """Displacement (B, R, N, 2) in px at the Gauss-Legendre nodes of the rows' exposures, and weights (N,)."""
        rows = torch.arange(num_rows, dtype=torch.float64, device=self.starts.device)
        starts = self.starts[:, None] + rows * self.timing.row_time
        count = gauss_node_count(self.vibration, float(self.exposure_time.amax()))
        nodes, weights = (tensor.to(starts.device) for tensor in exposure_nodes(_ONE_SECOND, "gauss", count))
        times = starts[..., None] + nodes * self.exposure_time[:, None, None]
        return self.vibration.displacement(times), weights

    def mean_displacement(self, rows: Tensor) -> Tensor:
        """Mean displacement (B, S, 2) in px over the exposures of frame rows (B, S) (Eq. 2)."""
        return self._averaged().displacement(self._middles(rows))

    def rows_showing(self, scene_rows: Tensor) -> Tensor:
        """Frame rows (B, S) that show scene rows (B, S): the solution of ``r = s + Y(t(r))`` by Newton's method."""
        averaged = self._averaged()
        rows = scene_rows
        for _ in range(_STEPS):
            times = self._middles(rows)
            miss = scene_rows + averaged.displacement(times)[..., 1] - rows
            slope = averaged.velocity(times)[..., 1] * self.timing.row_time
            rows = rows + miss / (1.0 - slope).clamp(min=0.1)
        return rows

    def move(self, points: Tensor) -> Tensor:
        """Places (B, S, 2) in the frame of scene points (B, S, 2) in px, both (x, y)."""
        rows = self.rows_showing(points[..., 1])
        return torch.stack([points[..., 0] + self.mean_displacement(rows)[..., 0], rows], dim=-1)

    def _middles(self, rows: Tensor) -> Tensor:
        return self.starts[:, None] + rows * self.timing.row_time + 0.5 * self.exposure_time[:, None]

    def _averaged(self) -> Vibration:
        """The vibration whose displacement at mid-exposure is the mean displacement over the exposure."""
        given = self.vibration
        attenuation = torch.sinc(given.frequency * self.exposure_time[:, None, None])
        phase = torch.where(attenuation < 0, given.phase + torch.pi, given.phase)
        return Vibration(given.amplitude * attenuation.abs(), given.frequency, phase, given.image_motion)
