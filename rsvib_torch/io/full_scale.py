"""Counts in files, floats in memory: full scale is 1."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rsvib_torch.core.checks import check_number

__all__ = ["check_dtype", "check_full_scale", "counts_to_frames", "frames_to_counts", "known_full_scale"]

_LARGEST_SIZES = {"u": 4, "i": 4, "f": 8}  # bytes; other kinds are bool, complex, text, objects


def check_dtype(dtype: np.dtype[Any]) -> None:
    """Raise a ``ValueError`` unless pixels of ``dtype`` are numbers."""
    if dtype.itemsize > _LARGEST_SIZES.get(dtype.kind, 0):
        raise ValueError(f"pixels are {dtype}; expected integers of up to 32 bits, or floats of up to 64")


def known_full_scale(dtype: np.dtype[Any], stated: object = None) -> float | None:
    """Full scale of pixels of ``dtype``: the stated one, or 255 for ``uint8``; None where nobody can know."""
    if dtype.kind == "f":
        return None
    if stated is not None:
        return check_full_scale(stated, dtype)
    return 255.0 if dtype == np.uint8 else None


def check_full_scale(full_scale: object, dtype: np.dtype[Any]) -> float:
    """Return ``full_scale`` as a float that is positive and can be held by integers of ``dtype``."""
    value = check_number("full_scale", full_scale, above=0.0)
    largest = int(np.iinfo(dtype).max)
    if value > largest:
        raise ValueError(f"full_scale={value:g} is more than {dtype} can hold ({largest})")
    return value


def counts_to_frames(counts: NDArray[Any], full_scale: float | None, name: str) -> Tensor:
    """Turn pixels as stored into float32 frames; floats keep their values.

    Args:
        counts: Pixels as stored.
        full_scale: Count that means 1.0; not used for floats.
        name: The file, for messages.

    Raises:
        ValueError: If integers come without a full scale or exceed it.
    """
    if counts.dtype.kind == "f":
        return torch.from_numpy(np.ascontiguousarray(counts, dtype=np.float32))
    if full_scale is None:
        raise ValueError(
            f"{name}: {counts.dtype} frames do not say their full scale; state full_scale, e.g. 4095 for 12-bit counts"
        )
    full_scale = check_full_scale(full_scale, counts.dtype)
    largest = int(counts.max())
    if largest > full_scale:
        raise ValueError(
            f"{name}: counts reach {largest}, beyond full_scale={full_scale:g}; state the count that means full scale"
        )
    wide = torch.float32 if counts.dtype.itemsize <= 2 else torch.float64
    signed = counts.astype(np.int32 if counts.dtype.itemsize <= 2 else np.int64)  # types that torch computes with
    return (torch.from_numpy(signed).to(wide) / full_scale).to(torch.float32)


def frames_to_counts(frames: Tensor, dtype: np.dtype[Any], full_scale: float | None) -> NDArray[Any]:
    """Turn frames whose full scale is 1 into pixels to store: scaled, rounded and clipped; floats keep their values.

    Raises:
        ValueError: If integers are asked for without a full scale, or of frames that are not finite.
    """
    pixels = frames.detach().cpu()
    if dtype.kind == "f":
        return pixels.to(torch.float64 if dtype.itemsize == 8 else torch.float32).numpy().astype(dtype, copy=False)
    if full_scale is None:
        raise ValueError(f"full_scale must be stated to write {dtype} frames, e.g. 4095 for 12-bit counts")
    if not bool(torch.isfinite(pixels).all()):
        raise ValueError(f"frames hold NaN or infinite pixels, which {dtype} cannot")
    wide = torch.float32 if dtype.itemsize <= 2 and pixels.dtype != torch.float64 else torch.float64
    counts = (pixels.to(wide) * full_scale).round_().clamp_(0.0, float(np.floor(full_scale)))
    return counts.numpy().astype(dtype)
