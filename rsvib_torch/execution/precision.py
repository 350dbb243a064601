"""Decorators that exclude functions from mixed precision, from graph compilation and from differentiation."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import is_dataclass
from functools import wraps
from types import ModuleType
from typing import ParamSpec, TypeVar, cast

import numpy as np
import torch
from torch import Tensor

from rsvib_torch.execution.parallel import ONE_BLAS_THREAD, ProcessSetting

P = ParamSpec("P")
R = TypeVar("R")


_BACKENDS: ModuleType = torch.backends  # whose attributes are not typed


@contextmanager
def _products_of_float32() -> Iterator[None]:
    """Products and convolutions of float32 use float32, not TF32 or bfloat16."""
    cudnn, mkldnn = _BACKENDS.cudnn, _BACKENDS.mkldnn
    # those of cuDNN's recurrent networks are set together with its convolutions under one name
    kinds = (_BACKENDS.cuda.matmul, cudnn.conv, cudnn.rnn, mkldnn.matmul, mkldnn.conv)
    previous = [kind.fp32_precision for kind in kinds]
    for kind in kinds:
        kind.fp32_precision = "ieee"
    yield
    for kind, value in zip(kinds, previous, strict=True):
        kind.fp32_precision = value


_FLOAT32_PRODUCTS = ProcessSetting(_products_of_float32)


def full_precision(function: Callable[P, R]) -> Callable[P, R]:
    """Run a function without autocast and TF32: splines, transforms and fits need all digits of float32.

    The device is that of the first tensor among the arguments.
    """

    @wraps(function)
    def in_full_precision(*args: P.args, **kwargs: P.kwargs) -> R:
        tensors = (value for value in (*args, *kwargs.values()) if isinstance(value, Tensor) and not value.is_meta)
        device = next((tensor.device.type for tensor in tensors), "cpu")
        with torch.autocast(device_type=device, enabled=False), _FLOAT32_PRODUCTS:
            return function(*args, **kwargs)

    return in_full_precision


def outside_graphs(function: Callable[P, R]) -> Callable[P, R]:
    """Exclude a function from ``torch.compile``: one break of the graph instead of many.

    Sizes of kernels and bands follow from the motion, so that a graph would be compiled again for every vibration.
    """
    disabled: list[Callable[P, R]] = []  # filled at the first use: importing the compiler takes seconds

    @wraps(function)
    def uncompiled(*args: P.args, **kwargs: P.kwargs) -> R:
        if not torch.compiler.is_compiling():
            return function(*args, **kwargs)
        if not disabled:
            disabled.append(torch.compiler.disable(function, reason="sizes follow from the motion"))
        return disabled[0](*args, **kwargs)

    return uncompiled


def without_gradients(function: Callable[P, R]) -> Callable[P, R]:
    """Run a function in inference mode; its results can be differentiated and changed like all others.

    Operations on small tensors take 10 to 15 % less time than with ``torch.no_grad`` (detection in two frames of
    512 x 512 px, and a frame of ``VibrationTracker``). Derivatives that the function itself computes would be zero.
    NumPy does not warn of NaN and infinite values in the tables of fits, as PyTorch does not of those in tensors.
    """

    @wraps(function)
    def in_inference_mode(*args: P.args, **kwargs: P.kwargs) -> R:
        with ONE_BLAS_THREAD, torch.inference_mode(), np.errstate(all="ignore"):
            result = function(*args, **kwargs)
        return outside_inference(result)

    return in_inference_mode


def outside_inference(value: R) -> R:
    """Copies of the tensors of inference mode in a tensor, sequence, mapping or dataclass; the rest is kept."""
    result: object = value
    if isinstance(value, Tensor):
        result = value.clone() if value.is_inference() else value
    elif isinstance(value, (tuple, list)):
        result = type(value)(map(outside_inference, value))
    elif isinstance(value, dict):
        result = {key: outside_inference(entry) for key, entry in value.items()}
    elif is_dataclass(value) and not isinstance(value, type):
        result = copy(value)
        vars(result).update(outside_inference(vars(value)))  # cached properties as well
    return cast(R, result)
