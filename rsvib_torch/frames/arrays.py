"""Conversion of NumPy arrays of any memory layout and byte order to tensors."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

__all__ = ["ArrayLike", "as_tensor"]

ArrayLike = Tensor | NDArray[Any]


def as_tensor(name: str, value: object) -> Tensor:
    """Return a tensor, array or nested list of numbers as a tensor of the same values and dtype.

    The tensor shares the memory of an array if PyTorch supports its layout. Read-only arrays and arrays with negative
    strides or foreign byte order (FITS and TIFF files) are copied.

    Args:
        name: Name of the argument in error messages.
        value: The value.

    Raises:
        TypeError: If the value is a masked array or does not consist of numbers.

    Example:
        >>> as_tensor("frames", np.arange(3, dtype=">u2")[::-1]).tolist()
        [2, 1, 0]
    """
    if isinstance(value, Tensor):
        return value
    if isinstance(value, np.ma.MaskedArray):
        raise TypeError(f"{name} must not be a masked array; pass its data, and the mask as ignore=")
    try:
        if isinstance(value, np.ndarray):
            native = value if value.dtype.isnative else value.astype(value.dtype.newbyteorder("="))
            unsupported = any(stride < 0 or stride % native.itemsize for stride in native.strides)
            return torch.from_numpy(native.copy() if unsupported or not native.flags.writeable else native)
        return torch.as_tensor(value)
    except (TypeError, ValueError, RuntimeError) as error:
        kind = f" of {value.dtype}" if isinstance(value, np.ndarray) else ""
        raise TypeError(f"{name} must be a tensor or array of numbers, got {type(value).__name__}{kind}") from error
