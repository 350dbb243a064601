"""NumPy arrays at the door: whatever their memory looks like, they become tensors."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

__all__ = ["ArrayLike", "as_tensor"]

ArrayLike = Tensor | NDArray[Any]


def as_tensor(name: str, value: object) -> Tensor:
    """Return a tensor, array or nested list of numbers as a tensor of the same values and dtype.

    An array lends its memory where PyTorch can read it; one that is read-only, runs backwards or has foreign byte
    order (FITS and TIFF files) is copied.

    Args:
        name: What the value is called in the message.
        value: The value.

    Raises:
        TypeError: If it holds no numbers.

    Example:
        >>> as_tensor("frames", np.arange(3, dtype=">u2")[::-1]).tolist()
        [2, 1, 0]
    """
    if isinstance(value, Tensor):
        return value
    if isinstance(value, np.ma.MaskedArray):
        raise TypeError(f"{name} must not be a masked array; give its data, and the mask by itself (ignore=)")
    try:
        if isinstance(value, np.ndarray):
            native = value if value.dtype.isnative else value.astype(value.dtype.newbyteorder("="))
            strange = not native.flags.writeable or any(
                stride < 0 or stride % native.itemsize for stride in native.strides
            )
            return torch.from_numpy(native.copy() if strange else native)
        return torch.as_tensor(value)
    except (TypeError, ValueError, RuntimeError) as error:
        kind = f" of {value.dtype}" if isinstance(value, np.ndarray) else ""
        raise TypeError(f"{name} must be a tensor or array of numbers, got {type(value).__name__}{kind}") from error
