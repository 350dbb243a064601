"""Conversion between counts and float frames whose full scale is 1."""

import math

import numpy as np
import torch
from torch import Tensor

from rsvib_torch.checks.values import beyond_full_scale, check_number
from rsvib_torch.numerics.tables import Array

_NOT_RELATIVE = 10.0  # of full scale 1; pixels beyond are counts or percents


def check_dtype(dtype: np.dtype) -> None:
    """Raise a ``ValueError`` unless pixels of ``dtype`` are integers or floats of a supported size."""
    largest_sizes = {"u": 4, "i": 4, "f": 8}  # bytes by kind; other kinds are bool, complex, text, objects
    if dtype.itemsize > largest_sizes.get(dtype.kind, 0):
        raise ValueError(f"pixels are {dtype}; expected integers of up to 32 bits, or floats of up to 64")


def known_full_scale(dtype: np.dtype, stated: object = None) -> float | None:
    """Full scale of pixels of ``dtype``: the stated value, or 255 for ``uint8``; None if unknown, and for floats."""
    if dtype.kind == "f":
        return None
    if stated is None:
        return 255.0 if dtype == np.uint8 else None
    value = check_number("full_scale", stated, above=0.0)
    largest = int(np.iinfo(dtype).max)
    if value > largest:
        raise ValueError(f"full_scale={value:g} exceeds the largest {dtype} value ({largest})")
    return value


def required_full_scale(full_scale: object, dtype: np.dtype, name: object) -> float:
    """As ``known_full_scale`` of integers; the error names a file or an argument if it is unknown."""
    if dtype.kind == "b":
        raise TypeError(f"{name} must be real numbers, got {dtype}; pass {name}.float()")
    known = known_full_scale(dtype, full_scale)
    if known is None:
        raise ValueError(f"{name}: full scale of {dtype} frames unknown: pass full_scale, e.g. 4095 for 12-bit counts")
    return known


def scaled_counts(counts: Tensor, full_scale: float | None, name: str, *, most: float = 1.0) -> Tensor:
    """Counts of any integer type as float32 with full scale 1; those above ``most`` times full scale are refused."""
    full_scale = required_full_scale(full_scale, np.dtype(str(counts.dtype).removeprefix("torch.")), name)
    # float32 holds 16-bit counts exactly; PyTorch finds no largest value of some integers
    floats = counts.to(torch.float32 if counts.dtype.itemsize <= 2 else torch.float64)
    if floats.numel() and (largest := float(floats.max())) > most * full_scale:
        raise ValueError(f"{name}: {beyond_full_scale(int(largest), full_scale)}")
    return floats.div_(full_scale).to(torch.float32)


def counts_to_frames(counts: Array, full_scale: float | None, name: str, nodata: float | None = None) -> Tensor:
    """Pixels as stored as float32 frames; floats keep their values, ``nodata`` is NaN, messages have the ``name``."""
    if nodata is not None:
        missing = counts == counts.dtype.type(nodata)
        if missing.any():
            frames = counts_to_frames(np.where(missing, counts.dtype.type(0), counts), full_scale, name)
            return frames.masked_fill_(torch.from_numpy(missing), torch.nan)
    if counts.dtype.kind == "f":
        return torch.from_numpy(np.ascontiguousarray(counts, dtype=np.float32))
    return scaled_counts(torch.from_numpy(np.require(counts, None, ["C", "W"])), full_scale, name)


def frames_to_counts(frames: Tensor, dtype: np.dtype, full_scale: float | None, nodata: float | None = None) -> Array:
    """Frames of full scale 1 as pixels to store: integers scaled, rounded and clipped; NaN as ``nodata``."""
    pixels = frames.detach().cpu()
    if nodata is not None:
        missing = torch.isnan(pixels)
        if bool(missing.any()):
            stored = frames_to_counts(pixels.masked_fill(missing, 0.0), dtype, full_scale)
            stored[missing.numpy()] = nodata
            return stored
    if dtype.kind == "f":
        return pixels.to(torch.float64 if dtype.itemsize == 8 else torch.float32).numpy().astype(dtype, copy=False)
    full_scale = required_full_scale(full_scale, dtype, "frames")
    # one pass; NaN and infinity are among the ends
    lowest, highest = (float(end) for end in pixels.aminmax()) if pixels.numel() else (0.0, 0.0)
    if not math.isfinite(lowest) or not math.isfinite(highest):
        raise ValueError(f"frames contain NaN or infinite pixels, which {dtype} cannot represent; write floats")
    if highest > _NOT_RELATIVE and float((pixels > _NOT_RELATIVE).float().mean()) > 0.5:
        raise ValueError(
            f"frames have values up to {highest:.4g}, and more than half of them are above "
            f"{_NOT_RELATIVE:g}: to be written as {dtype}, their full scale must be 1; divide them by it"
        )
    narrow = dtype.itemsize <= 2 and pixels.dtype != torch.float64
    counts = pixels.to(torch.float32 if narrow else torch.float64) * full_scale
    return counts.round_().clamp_(0.0, float(np.floor(full_scale))).numpy().astype(dtype)
