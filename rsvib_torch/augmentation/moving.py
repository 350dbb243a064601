"""Images, masks, points and boxes of a still scene as a rolling shutter shows them, all moved alike."""

import torch
from torch import Tensor

from rsvib_torch.augmentation.image_motion import ImageMotion
from rsvib_torch.core.precision import full_precision
from rsvib_torch.core.splines import mirrored
from rsvib_torch.imaging import blur_rows, trajectory_psf
from rsvib_torch.imaging.psf import Interpolation

__all__ = ["move_boxes", "move_images", "move_masks"]


@full_precision
def move_images(images: Tensor, motion: ImageMotion, interpolation: Interpolation) -> Tensor:
    """Form frames (B, C, R, W) from still images of the same shape, in row order; past its edges a scene is mirrored.

    Half-precision images are formed in float32.
    """
    dtype = images.dtype if images.dtype in (torch.float32, torch.float64) else torch.float32
    psf = trajectory_psf(*motion.trajectory(images.shape[-2]), interpolation=interpolation)
    psf = type(psf)(psf.first_tap[:, None], psf.weights[:, None], psf.degree)  # every channel alike
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
    """Boxes (B, N, 4, 2) of corner pixels, in row order, around what they held.

    Rows move apart, so a straight box holds a bent one: what comes back is the smallest straight box around it. Boxes
    that are not straight are moved corner by corner.
    """
    if boxes.numel() == 0:
        return boxes
    low, high = boxes.amin(-2), boxes.amax(-2)
    steps = torch.linspace(
        0.0, 1.0, int((high - low)[..., 1].amax().ceil()) + 2, dtype=boxes.dtype, device=boxes.device
    )
    side_rows = low[..., 1, None] + (high - low)[..., 1, None] * steps  # (B, N, S), a row apart or closer
    sides = torch.stack(
        [torch.stack([x[..., None].expand_as(side_rows), side_rows], -1) for x in (low[..., 0], high[..., 0])], -3
    )
    moved = motion.move(sides.flatten(1, -2)).reshape(sides.shape).flatten(2, 3)
    left, top = moved.amin(-2).unbind(-1)
    right, bottom = moved.amax(-2).unbind(-1)
    rightmost = boxes == high[..., None, :]  # which corners are right, which are low
    around = torch.where(
        rightmost, torch.stack([right, bottom], -1)[..., None, :], torch.stack([left, top], -1)[..., None, :]
    )
    straight = (rightmost | (boxes == low[..., None, :])).flatten(-2).all(-1)
    corners = motion.move(boxes.flatten(1, -2)).reshape(boxes.shape)
    return torch.where(straight[..., None, None], around, corners)
