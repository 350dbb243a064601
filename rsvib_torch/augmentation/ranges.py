"""Ranges of random values, one for each axis."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from rsvib_torch.core.checks import check_number

__all__ = ["Range", "axis_ranges", "draw"]

Range = float | Sequence[float] | Sequence[Sequence[float]]


def axis_ranges(
    name: str, value: Range, *, at_least: float = -math.inf
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Lowest and highest value for the axes x and y.

    Args:
        name: What the range is called in messages.
        value: One number, ``(low, high)`` for both axes, or ``((low, high), (low, high))`` for x and y.
        at_least: The lowest value that makes sense.

    Raises:
        TypeError: If it is none of these.
        ValueError: If low exceeds high, or a value is out of bounds.

    Example:
        >>> axis_ranges("amplitude", (1.0, 2.0))
        ((1.0, 2.0), (1.0, 2.0))
    """
    if not isinstance(value, Sequence):
        number = check_number(name, value, at_least=at_least)
        return (number, number), (number, number)
    pairs = value if any(isinstance(part, Sequence) for part in value) else (value, value)
    if len(pairs) != 2 or not all(isinstance(pair, Sequence) and len(pair) == 2 for pair in pairs):
        raise TypeError(
            f"{name} must be a number, (low, high) or ((low, high), (low, high)) for x and y, got {value!r}"
        )
    x, y = (tuple(check_number(name, number, at_least=at_least) for number in pair) for pair in pairs)  # type: ignore[union-attr]
    for low, high in (x, y):
        if low > high:
            raise ValueError(f"{name} must have low before high, got ({low:g}, {high:g})")
    return (x[0], x[1]), (y[0], y[1])


def draw(
    ranges: tuple[tuple[float, float], ...], shape: Sequence[int], device: torch.device, dtype: torch.dtype
) -> Tensor:
    """Values drawn evenly between low and high: (*shape, number of ranges), from torch's generator."""
    low, high = torch.tensor(ranges, device=device, dtype=dtype).unbind(-1)
    return low + (high - low) * torch.rand(*shape, len(ranges), device=device, dtype=dtype)
