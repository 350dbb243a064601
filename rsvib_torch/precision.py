"""Full precision and plain execution, where mixed precision or a compiler would spoil the result."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor

__all__ = ["full_precision", "outside_graphs"]

P = ParamSpec("P")
R = TypeVar("R")


def full_precision(function: Callable[P, R]) -> Callable[P, R]:
    """Make a function ignore autocast: splines, transforms and fits need every digit of float32.

    The device is that of the first tensor among the arguments.

    Example:
        >>> product = full_precision(torch.matmul)
        >>> with torch.autocast("cpu", dtype=torch.bfloat16):
        ...     product(torch.eye(2), torch.eye(2)).dtype
        torch.float32
    """

    @wraps(function)
    def with_all_digits(*args: P.args, **kwargs: P.kwargs) -> R:
        tensors = (value for value in (*args, *kwargs.values()) if isinstance(value, Tensor))
        device = next((tensor.device.type for tensor in tensors), "cpu")
        with torch.autocast(device_type=device, enabled=False):
            return function(*args, **kwargs)

    return with_all_digits


def outside_graphs(function: Callable[P, R]) -> Callable[P, R]:
    """Make ``torch.compile`` call a function as it is: one break of the graph instead of many.

    Sizes of kernels and bands follow from the motion, so that a graph could not outlive the next vibration.
    """
    disabled: list[Callable[P, R]] = []  # filled on demand: importing the compiler takes seconds

    @wraps(function)
    def as_it_is(*args: P.args, **kwargs: P.kwargs) -> R:
        if not torch.compiler.is_compiling():
            return function(*args, **kwargs)
        if not disabled:
            disabled.append(torch.compiler.disable(function, reason="sizes follow from the motion"))
        return disabled[0](*args, **kwargs)

    return as_it_is
