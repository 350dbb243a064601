"""Small NumPy tables with missing values (NaN): the input of fits, which run on the CPU in float64.

An operation on a small array takes NumPy 0.5 to 1 us and PyTorch 3 to 5 us.
"""

from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Array = np.ndarray
Stacks = TypeVar("Stacks", bound="DataclassInstance")


def table(values: Tensor) -> Array:
    """A tensor as an array on the CPU, which shares the memory of a tensor on the CPU."""
    if values.requires_grad:
        values = values.detach()
    if values.is_conj():
        values = values.resolve_conj()
    return (values if values.device.type == "cpu" else values.cpu()).numpy()


def split_axis(values: Array, axis: int, *sizes: int) -> Array:
    """The values with one axis split into several of the given sizes, one of which may be -1 (``Tensor.unflatten``)."""
    axis %= values.ndim
    return values.reshape(*values.shape[:axis], *sizes, *values.shape[axis + 1 :])


def without_nan(values: Array, replacement: float) -> Array:
    """The values with a number in place of NaN."""
    return np.where(np.isnan(values), replacement, values)


def valid_mean(values: Array, axis: int | tuple[int, ...]) -> Array:
    """Mean along axes of the values that are not NaN; NaN if there are none."""
    valid = ~np.isnan(values)
    count = valid.sum(axis)
    mean: Array = np.where(valid, values, 0.0).sum(axis) / np.maximum(count, 1)
    return np.where(count > 0, mean, np.nan)


def median(values: Array, axis: int, *, keepdims: bool = False) -> Array:
    """Median along an axis of the values that are not NaN, the lower one of two; NaN if there are none."""
    ordered = np.sort(values, axis)  # NaN come last
    count = (~np.isnan(values)).sum(axis, keepdims=True)
    middle = np.take_along_axis(ordered, np.maximum(count - 1, 0) // 2, axis)
    return middle if keepdims else middle.squeeze(axis)


def quantile(values: Array, share: float, axis: int) -> Array:
    """Quantile along an axis of the values that are not NaN, interpolated linearly; NaN if there are none."""
    ordered = np.sort(values, axis)
    place = share * np.maximum((~np.isnan(values)).sum(axis, keepdims=True) - 1, 0)
    below = np.floor(place).astype(np.int64)
    low, high = (np.take_along_axis(ordered, index, axis) for index in (below, np.ceil(place).astype(np.int64)))
    return (low + (high - low) * (place - below)).squeeze(axis)


def pseudo_inverse(matrix: Array) -> Array:
    """Pseudo-inverse of matrices (..., M, N); singular values below rounding are 0."""
    return np.linalg.pinv(matrix, rcond=max(matrix.shape[-2:]) * np.finfo(np.float64).eps)


def scaled_inverse(matrix: Array) -> Array:
    """Pseudo-inverse of normal matrices (..., P, P) of parameters of any units; 0 for undetermined combinations."""
    diagonal = matrix.diagonal(axis1=-2, axis2=-1)
    unit = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    unit = unit[..., :, None] * unit[..., None, :]
    return np.linalg.pinv(matrix * unit, rcond=1e-12, hermitian=True) * unit


def tensor(values: Array) -> Tensor:
    """An array as a tensor on the CPU, for motions and for indices of tensors."""
    return torch.from_numpy(np.ascontiguousarray(values))


_MANY = 2048  # values; PyTorch takes 6 ns each and 5 us for a call, NumPy 17 ns each


def cos_sin(angle: Array) -> tuple[Array, Array]:
    """Cosine and sine of float64 angles in rad; PyTorch takes a third of the time of NumPy for many, 5 us for one."""
    if angle.size < _MANY:
        return np.cos(angle), np.sin(angle)
    cosine, sine = np.empty_like(angle), np.empty_like(angle)
    values = torch.from_numpy(angle)
    torch.cos(values, out=torch.from_numpy(cosine))
    torch.sin(values, out=torch.from_numpy(sine))
    return cosine, sine


def unit_wave(angle: Array) -> Array:
    """``exp(i angle)`` of float64 angles in rad."""
    wave: Array = np.empty(angle.shape, np.complex128)
    wave.real, wave.imag = cos_sin(angle)
    return wave


@lru_cache(maxsize=128)
def constant(make: Callable[..., Array], *arguments: object, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The table ``make(*arguments)`` as a tensor, made and transferred once; do not modify it."""
    with torch.inference_mode(False):  # later callers may differentiate
        return torch.as_tensor(make(*arguments), dtype=dtype, device=device)


def tables(*values: Tensor) -> list[Array]:
    """Tensors as arrays on the CPU, by one transfer; those of a GPU become float64."""
    if values[0].device.type == "cpu":
        return [table(value) for value in values]
    flat = table(torch.cat([value.to(torch.float64).flatten() for value in values]))
    parts = np.split(flat, np.cumsum([value.numel() for value in values])[:-1])
    return [array.reshape(value.shape) for array, value in zip(parts, values, strict=True)]


# Dataclasses of arrays whose first axis is the batch of stacks


def take_stacks(parts: Sequence[Stacks], index: Array) -> Stacks:
    """The stacks ``index`` of several concatenated dataclasses; values without a batch are those of the first."""
    arrays = {}
    for field in fields(parts[0]):
        values = [getattr(part, field.name) for part in parts]
        if isinstance(values[0], np.ndarray):
            arrays[field.name] = (np.concatenate(values) if len(values) > 1 else values[0])[index]
        elif is_dataclass(values[0]):
            arrays[field.name] = take_stacks(values, index)
    return replace(parts[0], **arrays)


def select_stacks(where: Array, one: Stacks, other: Stacks) -> Stacks:
    """A dataclass with the stacks of ``one`` where ``where`` (B,) is true, else those of ``other``."""
    place = np.arange(len(where))
    return take_stacks([one, other], np.where(where, place, place + len(where)))
