"""What is left of frames of flickering light: brightness along the scan, of all columns and of parts of them."""

from dataclasses import dataclass

import torch
from torch import Tensor

from rsvib_torch.core.checks import check_number
from rsvib_torch.frames.prepare import as_float_frames

__all__ = ["Profiles", "row_profiles"]

_PARTS = 8  # of the columns
_LEAST_ROWS = 32
_SATURATED = 1.0 - 1e-6  # of full scale
_TOO_BRIGHT = 0.9  # of the pixels that are not black
_BLACK = 0.02  # of full scale


@dataclass(frozen=True, eq=False)
class Profiles:
    """Brightness of rows.

    Attributes:
        rows: (T, H) float64, mean over the columns of each row, first row of the image first.
        parts: (T, P, H) float64, the same for parts of the columns side by side.
        clipped: Fraction of all pixels that are saturated.
    """

    rows: Tensor
    parts: Tensor
    clipped: float


def row_profiles(frames: Tensor, scan_axis: int, full_scale: float | None, gamma: float) -> Profiles:
    """Mean brightness of the rows of a stack (T, H, W) or (T, C, H, W).

    Args:
        frames: The stack; floats of full scale 1, or integers.
        scan_axis: -2 or -1, the axis along which rows follow each other.
        full_scale: Count that means 1.0, for integers.
        gamma: Pixels are raised to this power to make them proportional to light.

    Raises:
        ValueError: If the frames are black, saturated or too small.
    """
    check_number("gamma", gamma, above=0.0, at_most=4.0)
    images = as_float_frames(frames, full_scale)
    if images.ndim == 5:
        raise ValueError(f"calibration takes one stack, got a batch of shape {tuple(images.shape)}")
    images = images.mean(1) if images.ndim == 4 else images
    images = images.transpose(-2, -1) if scan_axis == -1 else images
    if images.shape[-2] < _LEAST_ROWS:
        raise ValueError(f"frames have {images.shape[-2]} rows along the scan; at least {_LEAST_ROWS} are needed")
    clipped = images >= _SATURATED
    lit = (images > _BLACK).double().mean()
    if float(lit) == 0.0:
        raise ValueError(f"all pixels are below {_BLACK:g} of full scale: no light to calibrate with")
    share = float(clipped.double().mean())
    if share > _TOO_BRIGHT * float(lit):
        raise ValueError(f"{share:.0%} of the pixels are saturated: take less light or a shorter exposure")
    linear = images.double().clamp(min=0.0) ** gamma
    parts = torch.stack([part.mean(-1) for part in linear.tensor_split(min(_PARTS, linear.shape[-1]), dim=-1)], 1)
    # what is left are curves of a thousand numbers, fitted one after another: no work for a GPU
    return Profiles(linear.mean(-1).cpu(), parts.cpu(), share)
