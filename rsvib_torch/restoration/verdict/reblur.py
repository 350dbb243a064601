"""What a frame would look like if a restored scene were the truth."""

import math

import torch
from torch import Tensor

from rsvib_torch.core.chunking import runs
from rsvib_torch.core.fourier import extended_length, spline_spectra
from rsvib_torch.core.splines import bspline_weights, mirrored, spread_taps
from rsvib_torch.imaging.trajectory import exposure_trajectory
from rsvib_torch.restoration.frame_motion import FrameMotion

__all__ = ["reblur"]

_DEGREE = 5  # of the spline across rows
_VALUES = {"cpu": 1 << 18}  # of kernels at a time: what rows are formed from stays in the cache


def reblur(scene: Tensor, motion: FrameMotion, frame: int, *, first_row: int = 0) -> Tensor:
    """Form one frame from a restored scene (Eq. 9), independently of how it was restored.

    Displacement along rows is a phase ramp, across rows a quintic B-spline, the exposure a Gauss-Legendre sum.

    Args:
        scene: (C, H, W) in row order, in the coordinates in which frame ``frame`` is restored; it may be a part of
            the rows and columns, and is mirrored beyond.
        motion: Motion of the frames, batch of one.
        frame: Index of the frame to form.
        first_row: Row of the frame that row 0 of the scene lies on.

    Returns:
        The same part (C, H, W) of the frame.
    """
    height, width = scene.shape[-2:]
    rows = torch.arange(height, dtype=torch.float64, device=scene.device)
    starts = motion.frame_starts[frame] + (first_row + rows) * motion.timing.row_time
    displacement, node_weights = exposure_trajectory(motion.vibration[0], starts, motion.timing, "gauss")
    displacement = displacement - motion.shift[0, frame]
    reach = math.ceil(float(displacement[..., 0].abs().amax()))
    length = extended_length(width, reach)
    u = torch.fft.rfftfreq(length, dtype=torch.float64, device=scene.device)
    spectra = spline_spectra(scene, _DEGREE, length)

    place = rows[:, None] - displacement[..., 1]
    cell = place.floor()
    first, taps = spread_taps(cell, bspline_weights(place - cell, _DEGREE) * node_weights[:, None])
    angle = displacement[..., 0, None].to(scene.dtype) * (-2 * math.pi * u).to(scene.dtype)
    taps = taps.transpose(-2, -1).to(scene.dtype)
    count = taps.shape[-2]
    source = first - _DEGREE // 2
    seen = mirrored(source[:, None] + torch.arange(count, device=scene.device), height)  # (H, count)
    step = max(1, _VALUES.get(scene.device.type, height * count * len(u)) // (count * len(u)))
    formed = []
    for part in runs(height, step):
        transfer = torch.complex(taps[part] @ angle[part].cos(), taps[part] @ angle[part].sin())  # (R, count, U)
        formed.append((transfer * spectra[:, seen[part]]).sum(-2))
    image: Tensor = torch.fft.irfft(torch.cat(formed, dim=-2), n=length)[..., :width]
    return image
