"""A simulated GPU: tensors whose device is a GPU, computed on the CPU.

Operations that a GPU refuses raise an error: tensors of two devices in one operation, conversion of GPU tensors to
NumPy arrays, random numbers from a CPU generator. Tests for mixed devices can therefore run without a GPU.
"""

from contextlib import contextmanager

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode, resolve_name
from torch.utils import _pytree as pytree

__all__ = ["SIMULATED_GPU", "DeviceError", "SimulatedGpuTensor", "simulated_gpu"]

SIMULATED_GPU = torch.device("cuda", 0)
_TO_HOST = {"item", "tolist", "__bool__", "__float__", "__int__", "__index__", "__repr__", "__format__"}
_DATA_DEPENDENT_SIZE = {"nonzero", "unique", "bincount", "masked_select"}
_INDEXING = {"__getitem__", "__setitem__", "index_put", "index_put_", "_index_put_impl_"}  # indices may be on the CPU
_NO_CPU_SCALARS = {"cat", "stack", "matmul", "mm", "bmm", "einsum", "gather", "scatter", "index_select", "searchsorted"}
_ACCEPT_TWO_DEVICES = {"copy_", "grad", "backward"}


class DeviceError(RuntimeError):
    """An operation that a GPU would refuse."""


class SimulatedGpuTensor(Tensor):
    """A tensor whose device is the simulated GPU."""


def _name(function):
    return getattr(function, "__name__", None) or str(resolve_name(function))


def _is_gpu(device):
    return device is not None and torch.device(device).type == SIMULATED_GPU.type


def _to_device(values, kind=SimulatedGpuTensor):
    """Move all tensors of a nested structure to the simulated GPU, or to the CPU."""
    return pytree.tree_map_only(Tensor, lambda value: value.as_subclass(kind), values)


class _SimulatedDevice(TorchFunctionMode):
    """Check the devices of all PyTorch functions.

    Attributes:
        synchronisations: Number of calls that wait for the device, for each function.
    """

    def __init__(self):
        super().__init__()
        self.synchronisations = {}

    def __torch_function__(self, function, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        with torch._C.DisableTorchFunctionSubclass():
            return self._call(function, args, kwargs)

    def _call(self, function, args, kwargs):
        name = _name(function)
        tensors = [value for value in pytree.tree_leaves((args, kwargs)) if isinstance(value, Tensor)]
        on_gpu = [value for value in tensors if isinstance(value, SimulatedGpuTensor)]
        if name == "__get__":
            return self._get_attribute(function, args, on_gpu)
        if on_gpu and name in ("numpy", "__array__"):
            raise DeviceError("can't convert cuda:0 device type tensor to numpy")
        if name in ("to", "cpu", "cuda", "type_as", "new_tensor", "pin_memory"):
            return self._move(name, function, args, kwargs)
        if on_gpu and name in _TO_HOST | _DATA_DEPENDENT_SIZE:
            self.synchronisations[name] = self.synchronisations.get(name, 0) + 1
        self._check(name, args, tensors, on_gpu)
        device = kwargs.get("device")
        if device is not None:
            generator = kwargs.get("generator")
            if generator is not None and generator.device.type != torch.device(device).type:
                raise DeviceError(f"{name}: a generator of {generator.device} for {device}")
            if _is_gpu(device):
                kwargs["device"] = torch.device("cpu")
            result = function(*args, **kwargs)
            return _to_device(result, SimulatedGpuTensor if _is_gpu(device) else Tensor)
        result = function(*args, **kwargs)
        return _to_device(result) if on_gpu and name not in _TO_HOST else result

    def _get_attribute(self, function, args, on_gpu):
        result = function(*args)
        if not on_gpu:
            return result
        if isinstance(result, torch.device):
            return SIMULATED_GPU
        if function is Tensor.is_cuda.__get__:
            return True
        return _to_device(result) if isinstance(result, Tensor) else result

    def _move(self, name, function, args, kwargs):
        source, *rest = args
        target_is_gpu = isinstance(source, SimulatedGpuTensor)
        rest = list(rest)
        if name in ("cpu", "cuda"):
            result = source.as_subclass(Tensor)
            target_is_gpu = name == "cuda"
        else:
            for index, value in enumerate(rest):
                if isinstance(value, torch.device) or (isinstance(value, str) and name == "to"):
                    target_is_gpu, rest[index] = _is_gpu(value), torch.device("cpu")
                elif isinstance(value, Tensor) and name in ("to", "type_as"):
                    target_is_gpu = isinstance(value, SimulatedGpuTensor)
            if kwargs.get("device") is not None:
                target_is_gpu, kwargs["device"] = _is_gpu(kwargs["device"]), torch.device("cpu")
            result = function(source, *rest, **kwargs)
        return result.as_subclass(SimulatedGpuTensor if target_is_gpu else Tensor)

    def _check(self, name, args, tensors, on_gpu):
        """Raise for tensors of two devices in one operation."""
        if not on_gpu or len(on_gpu) == len(tensors) or name in _ACCEPT_TWO_DEVICES:
            return
        on_cpu = [value for value in tensors if not isinstance(value, SimulatedGpuTensor)]
        if name in _INDEXING:
            if isinstance(args[0], SimulatedGpuTensor) and not (name == "__setitem__" and _is_cpu_array(args[2])):
                return
        elif name not in _NO_CPU_SCALARS and all(value.ndim == 0 for value in on_cpu):
            return
        shapes = [(tuple(value.shape), "cuda" if isinstance(value, SimulatedGpuTensor) else "cpu") for value in tensors]
        raise DeviceError(f"{name}: tensors on two devices: {shapes}")


def _is_cpu_array(value):
    return isinstance(value, Tensor) and not isinstance(value, SimulatedGpuTensor) and value.ndim > 0


@contextmanager
def simulated_gpu():
    """Simulate a GPU: ``tensor.to(SIMULATED_GPU)`` moves a tensor to it."""
    with _SimulatedDevice() as device:
        yield device
