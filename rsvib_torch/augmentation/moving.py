"""Images, masks, points and boxes of still scenes as a rolling-shutter camera records them, all with one motion.

Invariant: the displacement depends on the row only (docs/architecture.md).
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.core.precision import full_precision
from rsvib_torch.core.splines import gauss_legendre, mirrored
from rsvib_torch.imaging import blur_rows, gauss_node_count, rows_showing, trajectory_psf
from rsvib_torch.imaging.psf import Interpolation
from rsvib_torch.motion.motion import Motion
from rsvib_torch.motion.timing import RowTiming

__all__ = ["ImageMotion", "move_boxes", "move_images", "move_masks"]


@dataclass(frozen=True, eq=False)
class ImageMotion:
    """Motion of B images in row order, each with its own vibration, start and exposure.

    Attributes:
        vibration: Motion of batch shape (B,).
        starts: (B,) exposure start of the first row of each image, seconds.
        exposure_time: (B,) seconds.
        timing: The sensor; its exposure is not used.
    """

    vibration: Motion
    starts: Tensor
    exposure_time: Tensor
    timing: RowTiming

    def trajectory(self, num_rows: int) -> tuple[Tensor, Tensor]:
        """Displacement (B, R, N, 2) in px at the Gauss-Legendre nodes of the exposures of rows, and weights (N,)."""
        rows = torch.arange(num_rows, dtype=torch.float64, device=self.starts.device)
        starts = self.starts[:, None] + rows * self.timing.row_time
        count = gauss_node_count(self.vibration, float(self.exposure_time.amax()))
        nodes, weights = (tensor.to(starts.device) for tensor in gauss_legendre(count))
        times = starts[..., None] + nodes * self.exposure_time[:, None, None]
        return self.vibration.displacement(times), weights

    def mean_displacement(self, rows: Tensor) -> Tensor:
        """Mean displacement (B, S, 2) in px over the exposures of frame rows (B, S) (Eq. 2)."""
        starts = self.starts[:, None] + rows * self.timing.row_time
        return self.vibration.mean_displacement(starts, self.exposure_time[:, None])

    def move(self, points: Tensor) -> Tensor:
        """Positions (B, S, 2) in the frame of scene points (B, S, 2) in px, both (x, y)."""
        rows = rows_showing(
            points[..., 1],
            self.starts[:, None],
            self.timing,
            self.vibration,
            exposure_time=self.exposure_time[:, None],
        )
        return torch.stack([points[..., 0] + self.mean_displacement(rows)[..., 0], rows], dim=-1)


@full_precision
def move_images(images: Tensor, motion: ImageMotion, interpolation: Interpolation) -> Tensor:
    """Form frames (B, C, R, W) from still images of the same shape, in row order, with mirrored boundaries.

    Half-precision images are formed in float32.
    """
    dtype = images.dtype if images.dtype in (torch.float32, torch.float64) else torch.float32
    psf = trajectory_psf(*motion.trajectory(images.shape[-2]), interpolation=interpolation)
    psf = type(psf)(psf.first_tap[:, None], psf.weights[:, None], psf.degree)  # the same for all channels
    return blur_rows(images.to(dtype), psf).to(images.dtype)


def move_masks(masks: Tensor, motion: ImageMotion) -> Tensor:
    """Labels (B, C, R, W) moved by the mean displacement of their rows, to the nearest pixel."""
    B, _, R, W = masks.shape
    rows = torch.arange(R, dtype=torch.float64, device=masks.device)
    displacement = motion.mean_displacement(rows.expand(B, -1))
    source_rows = mirrored((rows - displacement[..., 1]).round().to(torch.int64), R)
    columns = torch.arange(W, dtype=torch.float64, device=masks.device)
    source_columns = mirrored((columns - displacement[..., :1]).round().to(torch.int64), W)
    index = source_rows[..., None] * W + source_columns
    index = index.flatten(1)[:, None].expand(-1, masks.shape[1], -1)
    return masks.flatten(-2).gather(-1, index).reshape(masks.shape)


def move_boxes(boxes: Tensor, motion: ImageMotion) -> Tensor:
    """Boxes (B, N, 4, 2) of corner pixels, in row order, that contain the moved content of the given boxes.

    Rows move by different amounts, so the content of an upright box becomes curved: the result is the smallest upright
    box around it. Boxes that are not upright are moved corner by corner.
    """
    if boxes.numel() == 0:
        return boxes
    low, high = boxes.amin(-2), boxes.amax(-2)
    steps = torch.linspace(
        0.0, 1.0, int((high - low)[..., 1].amax().ceil()) + 2, dtype=boxes.dtype, device=boxes.device
    )
    side_rows = low[..., 1, None] + (high - low)[..., 1, None] * steps  # (B, N, S), at most one row apart
    sides = torch.stack(
        [torch.stack([x[..., None].expand_as(side_rows), side_rows], -1) for x in (low[..., 0], high[..., 0])], -3
    )
    moved = motion.move(sides.flatten(1, -2)).reshape(sides.shape).flatten(2, 3)
    lowest, highest = moved.amin(-2)[..., None, :], moved.amax(-2)[..., None, :]
    is_high = boxes == high[..., None, :]  # per corner and coordinate
    around = torch.where(is_high, highest, lowest)
    upright = (is_high | (boxes == low[..., None, :])).flatten(-2).all(-1)
    corners = motion.move(boxes.flatten(1, -2)).reshape(boxes.shape)
    return torch.where(upright[..., None, None], around, corners)
