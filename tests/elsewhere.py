"""A device that is not there: tensors that say that they are on a GPU, and work on the CPU.

What a GPU would refuse is refused: tensors of two devices in one operation, NumPy arrays made of tensors that are
elsewhere, random numbers of a generator of the CPU. So code can be shown to keep to one device where there is no other.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode, resolve_name
from torch.utils import _pytree as pytree

__all__ = ["ELSEWHERE", "Elsewhere", "NotHereError", "elsewhere"]

ELSEWHERE = torch.device("cuda", 0)
_TO_HOST = {"item", "tolist", "__bool__", "__float__", "__int__", "__index__", "__repr__", "__format__"}
_OF_UNKNOWN_SIZE = {"nonzero", "unique", "bincount", "masked_select"}
_INDEXING = {"__getitem__", "__setitem__", "index_put", "index_put_", "_index_put_impl_"}  # indices may be on the CPU
_NUMBERS_TOO = {"cat", "stack", "matmul", "mm", "bmm", "einsum", "gather", "scatter", "index_select", "searchsorted"}
_ANYWHERE = {"copy_", "grad", "backward"}


class NotHereError(RuntimeError):
    """What a device would have refused."""


class Elsewhere(Tensor):
    """A tensor that says that it is on a GPU."""


def _name(function: Callable[..., Any]) -> str:
    return getattr(function, "__name__", None) or str(resolve_name(function))


def _is_elsewhere(device: object) -> bool:
    return device is not None and torch.device(device).type == ELSEWHERE.type  # type: ignore[call-overload]


def _sent(values: Any) -> Any:
    """All tensors of some values, sent elsewhere."""
    return pytree.tree_map_only(Tensor, lambda value: value.as_subclass(Elsewhere), values)


def _fetched(value: Tensor) -> Tensor:
    return value.as_subclass(Tensor)


class _Device(TorchFunctionMode):
    """Makes PyTorch's functions keep to one device.

    Attributes:
        waits: Names of the functions that waited for the device, so often.
    """

    def __init__(self) -> None:
        super().__init__()
        self.waits: dict[str, int] = {}

    def __torch_function__(
        self, function: Callable[..., Any], types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        kwargs = dict(kwargs or {})
        with torch._C.DisableTorchFunctionSubclass():
            return self._called(function, args, kwargs)

    def _called(self, function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        name = _name(function)
        tensors = [value for value in pytree.tree_leaves((args, kwargs)) if isinstance(value, Tensor)]
        there = [value for value in tensors if isinstance(value, Elsewhere)]
        if name == "__get__":
            return self._attribute(function, args, there)
        if there and name in ("numpy", "__array__"):
            raise NotHereError("can't convert cuda:0 device type tensor to numpy")
        if name in ("to", "cpu", "cuda", "type_as", "new_tensor", "pin_memory"):
            return self._moved(name, function, args, kwargs)
        if there and name in _TO_HOST | _OF_UNKNOWN_SIZE:
            self.waits[name] = self.waits.get(name, 0) + 1
        self._check(name, args, kwargs, tensors, there)
        device = kwargs.get("device")
        if device is not None:
            generator = kwargs.get("generator")
            if generator is not None and generator.device.type != torch.device(device).type:
                raise NotHereError(f"{name}: a generator of {generator.device} for {device}")
            if _is_elsewhere(device):
                kwargs["device"] = torch.device("cpu")
            result = function(*args, **kwargs)
            return _sent(result) if _is_elsewhere(device) else pytree.tree_map_only(Tensor, _fetched, result)
        result = function(*args, **kwargs)
        return _sent(result) if there and name not in _TO_HOST else result

    def _attribute(self, function: Callable[..., Any], args: tuple[Any, ...], there: list[Tensor]) -> Any:
        result = function(*args)
        if not there:
            return result
        if isinstance(result, torch.device):
            return ELSEWHERE
        if function is Tensor.is_cuda.__get__:  # type: ignore[attr-defined]
            return True
        return _sent(result) if isinstance(result, Tensor) else result

    def _moved(self, name: str, function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        source, *rest = args
        where = isinstance(source, Elsewhere)
        rest = list(rest)
        if name in ("cpu", "cuda"):
            result = source.as_subclass(Tensor)
            where = name == "cuda"
        else:
            for place, value in enumerate(rest):
                if isinstance(value, torch.device) or (isinstance(value, str) and name == "to"):
                    where, rest[place] = _is_elsewhere(value), torch.device("cpu")
                elif isinstance(value, Tensor) and name in ("to", "type_as"):
                    where = isinstance(value, Elsewhere)
            if kwargs.get("device") is not None:
                where, kwargs["device"] = _is_elsewhere(kwargs["device"]), torch.device("cpu")
            result = function(source, *rest, **kwargs)
        return result.as_subclass(Elsewhere if where else Tensor)

    def _check(
        self, name: str, args: tuple[Any, ...], kwargs: dict[str, Any], tensors: list[Tensor], there: list[Tensor]
    ) -> None:
        """Raise for tensors of two devices in one operation."""
        if not there or len(there) == len(tensors) or name in _ANYWHERE:
            return
        here = [value for value in tensors if not isinstance(value, Elsewhere)]
        if name in _INDEXING:
            if isinstance(args[0], Elsewhere) and not (name == "__setitem__" and _stray(args[2])):
                return
        elif name not in _NUMBERS_TOO and all(value.ndim == 0 for value in here):
            return
        shapes = [(tuple(value.shape), "cuda" if isinstance(value, Elsewhere) else "cpu") for value in tensors]
        raise NotHereError(f"{name}: tensors on two devices: {shapes}")


def _stray(value: Any) -> bool:
    return isinstance(value, Tensor) and not isinstance(value, Elsewhere) and value.ndim > 0


@contextmanager
def elsewhere() -> Iterator[_Device]:
    """Pretend that there is a GPU: ``tensor.to(ELSEWHERE)`` is then on it."""
    with _Device() as device:
        yield device
