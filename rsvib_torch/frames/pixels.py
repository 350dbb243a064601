"""Pixels that say nothing or too little: without data, or at the level where the sensor saturates."""

from typing import Literal

import torch
from torch import Tensor

from rsvib_torch.core.checks import check_number

__all__ = ["Saturation", "hidden_pixels", "saturated_pixels"]

Saturation = float | Literal["auto"] | None


def hidden_pixels(frames: Tensor, ignore: Tensor | None) -> Tensor | None:
    """Mask of the pixels without data: those to be ignored, and NaN; None where there are none.

    Args:
        frames: A stack.
        ignore: Boolean mask of the same shape, or None.

    Raises:
        ValueError: If the mask is not one of that shape.
    """
    if ignore is not None and (
        not isinstance(ignore, Tensor) or ignore.dtype != torch.bool or ignore.shape != frames.shape
    ):
        raise ValueError(f"ignore must be a boolean mask of shape {tuple(frames.shape)} like the frames")
    missing = torch.isnan(frames) if frames.dtype.is_floating_point and bool(torch.isnan(frames.sum())) else None
    if ignore is None or missing is None:
        return missing if ignore is None else ignore
    return ignore | missing


def saturated_pixels(frames: Tensor, saturation: Saturation, full_scale: float | None) -> Tensor | None:
    """Mask of the pixels at the level of saturation or above; None where there are none.

    Args:
        frames: A stack as it came: counts, or floats.
        saturation: The level in the unit of the frames. ``"auto"``: full scale for integer frames; floats do not say
            where they were cut, so none. None for none.
        full_scale: Count that means 1.0, for integer frames other than uint8.

    Raises:
        TypeError: If the level is not a number.
        ValueError: If it is not positive.
    """
    if saturation is None:
        return None
    if saturation == "auto":
        if frames.dtype.is_floating_point:
            return None
        if full_scale is None and frames.dtype != torch.uint8:
            return None  # the frames will be refused for it
        saturation = 255.0 if full_scale is None else check_number("full_scale", full_scale, above=0.0)
    mask = frames >= check_number("saturation", saturation, above=0.0)
    return mask if bool(mask.any()) else None
