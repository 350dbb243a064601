"""The peak of a sampled correlation surface, to a small fraction of a pixel."""

from functools import cache

import torch
from torch import Tensor

__all__ = ["integer_peak", "subpixel_peak"]

_NEWTON_STEPS = 6


def integer_peak(surface: Tensor) -> tuple[Tensor, Tensor]:
    """Place of the largest entry of each surface (M, A, B): indices (M, 2) as (row, column), and its value (M,)."""
    value, flat = surface.flatten(-2).max(-1)
    return torch.stack([flat // surface.shape[-1], flat % surface.shape[-1]], dim=-1), value


@cache
def _polynomial_fit(size: int) -> Tensor:
    """Matrix (size, size) from samples at -(size // 2) ... size // 2 to the coefficients of the polynomial."""
    places = torch.arange(size, dtype=torch.float64) - size // 2
    matrix: Tensor = torch.linalg.inv(torch.vander(places, increasing=True))
    return matrix


def _powers(position: Tensor, size: int) -> Tensor:
    """Powers 0 ... size - 1 of positions (M,), with their first and second derivatives, (M, 3, size)."""
    order = torch.arange(size, dtype=position.dtype, device=position.device)
    value = position[:, None] ** order
    result = value.new_zeros(len(value), 3, size)
    result[:, 0] = value
    result[:, 1, 1:] = value[:, :-1] * order[1:]
    result[:, 2, 2:] = value[:, :-2] * (order[2:] * (order[2:] - 1))
    return result


def subpixel_peak(surface: Tensor) -> tuple[Tensor, Tensor]:
    """Maximum of the polynomial through all samples of a surface, by Newton's method from its centre.

    A correlation of band-limited images is itself band limited, so its samples at whole pixels determine it. For
    images smoothed by a Gaussian of 1 px, the polynomial through 9 samples an axis errs below 0.001 px, where a
    three-point parabola errs by 0.05 px.

    Args:
        surface: (M, A, B) with A and B odd, the integer peak at the centre. A or B may be 1: that axis is left alone.

    Returns:
        Position (M, 2) as (row, column) relative to the centre, NaN where no maximum lies within one pixel of it, and
        the value there (M,).
    """
    count, rows, columns = surface.shape
    fit_rows, fit_columns = (_polynomial_fit(size).to(surface.device) for size in (rows, columns))
    polynomial = fit_rows @ surface.to(torch.float64) @ fit_columns.T
    position = polynomial.new_zeros(count, 2)
    known = torch.ones(count, dtype=torch.bool, device=surface.device)
    for _ in range(_NEWTON_STEPS):
        derivative = _powers(position[:, 0], rows) @ polynomial @ _powers(position[:, 1], columns).mT  # (M, 3, 3)
        down, right, b = derivative[:, 1, 0], derivative[:, 0, 1], derivative[:, 1, 1]
        a = derivative[:, 2, 0] if rows > 1 else -torch.ones_like(b)
        c = derivative[:, 0, 2] if columns > 1 else -torch.ones_like(b)
        determinant = a * c - b * b
        known = known & (determinant > 0) & (a < 0)
        move = torch.stack([b * right - c * down, b * down - a * right], dim=-1)
        step = (move / torch.where(known, determinant, 1.0)[:, None]).clamp(-0.5, 0.5)
        position = position + torch.where(known[:, None], step, 0.0)
    value = (_powers(position[:, 0], rows) @ polynomial @ _powers(position[:, 1], columns).mT)[:, 0, 0]
    known = known & (position.abs() <= 1.0).all(-1)
    return torch.where(known[:, None], position, torch.nan), value
