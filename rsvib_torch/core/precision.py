"""Full precision and plain execution, where mixed precision or a compiler would spoil the result."""

from collections.abc import Callable
from functools import wraps
from threading import Lock
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

__all__ = ["full_precision", "outside_graphs"]

P = ParamSpec("P")
R = TypeVar("R")


class _WholeProducts:
    """Products and convolutions of float32 with all their digits, whatever was allowed for the rest of a program.

    Shorter formats (TF32, bfloat16) are allowed for a whole process: where several threads ask for all digits, the
    first one takes the permission away and the last one gives it back.
    """

    _BACKENDS: Any = torch.backends  # their attributes are not typed
    _KINDS = (
        _BACKENDS.cuda.matmul,
        _BACKENDS.cudnn.conv,
        _BACKENDS.cudnn.rnn,  # asked for together with convolutions, by one name
        _BACKENDS.mkldnn.matmul,
        _BACKENDS.mkldnn.conv,
    )

    def __init__(self) -> None:
        self._lock, self._users = Lock(), 0
        self._allowed: list[str] = []

    def __enter__(self) -> None:
        with self._lock:
            self._users += 1
            if self._users == 1:
                self._allowed = [kind.fp32_precision for kind in self._KINDS]
                for kind in self._KINDS:
                    kind.fp32_precision = "ieee"

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._users -= 1
            if self._users == 0:
                for kind, allowed in zip(self._KINDS, self._allowed, strict=True):
                    kind.fp32_precision = allowed


_WHOLE_PRODUCTS = _WholeProducts()


def full_precision(function: Callable[P, R]) -> Callable[P, R]:
    """Make a function ignore autocast and TF32: splines, transforms and fits need every digit of float32.

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
        with torch.autocast(device_type=device, enabled=False), _WHOLE_PRODUCTS:
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
