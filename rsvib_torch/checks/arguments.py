"""Checks of the arguments of public functions against their annotations, and conversion of arrays to tensors.

Functions and methods of the public interface have the decorator ``checks_arguments``: a value of another type, a tensor
that PyTorch cannot compute with, a number that is not finite or beyond all physical quantities, and an unknown choice
are refused with the name of the argument. Bounds that depend on the function are checked by the function.
"""

import inspect
import operator
import os
import types
from collections.abc import Callable, Mapping, Sequence
from functools import cache, reduce, wraps
from typing import Annotated, Any, Literal, ParamSpec, Self, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
import torch
from pydantic import ConfigDict, Field, GetPydanticSchema, Strict, TypeAdapter
from pydantic_core import core_schema
from torch import Tensor

from rsvib_torch.checks.values import MAX_NUMBER, Number, check_choice, described, members_of, validated
from rsvib_torch.text import one_line, quoted

P = ParamSpec("P")
R = TypeVar("R")
_ARRAYS = (Tensor, np.ndarray)
_PLAIN = (bool, float, str, type(None), object)  # types that pydantic checks itself


def check_tensor(name: str, value: object) -> Tensor:
    """Return ``value`` if it is a dense tensor of real numbers that has data."""
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} must be a tensor, got {described(value)}")
    if value.layout != torch.strided or value.is_nested or value.is_quantized or value.is_meta:
        kind = "a nested tensor" if value.is_nested else f"{value.layout}, {value.dtype} on {value.device}"
        raise TypeError(f"{name} must be a dense tensor that has data, got {kind}")
    if value.is_complex() or (value.is_floating_point() and value.dtype.itemsize == 1):
        raise TypeError(f"{name} must be real numbers of at least 16 bits, got {value.dtype}")
    return value


def as_numbers(name: str, value: object, device: torch.device | None = None) -> Tensor:
    """A copy of a number, tensor or nested list as a float64 tensor, by default on its device; gradients are kept."""
    if isinstance(value, Tensor):
        return check_tensor(name, value).to(dtype=torch.float64, device=device, copy=True)
    if isinstance(value, np.ma.MaskedArray):
        raise TypeError(f"{name} must not be a masked array; pass the values without the masked ones")
    try:
        return torch.tensor(value, dtype=torch.float64, device="cpu" if device is None else device)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        expected = "a number, a tensor, or numbers in lists of equal lengths"
        raise TypeError(f"{name} must be {expected}, got {described(value)}") from error


def check_shapes(values: Mapping[str, object], shapes: Mapping[str, str]) -> None:
    """Raise a ``ValueError`` unless tensors have the stated shapes.

    Stated are the axes: a size; a name for a size that is the same in all tensors, at least 1, and 2 to 4 for ``A``,
    the components of a motion; ``...`` for leading dimensions that are the same in all tensors, or ``[...]`` for these
    or none. ``...`` alone, for values that are not tensors, is not checked; None is omitted.
    """
    known: dict[str, object] = {}

    def fits(axis: str, size: int) -> bool:
        if axis.isdecimal():
            return size == int(axis)
        return size == known.get(axis, size) and (2 <= size <= 4 if axis == "A" else size >= 1)

    for name, stated in shapes.items():
        value = values.get(name)
        if value is None or stated == "...":
            continue
        lead, *axes = stated.split() if stated.startswith(("...", "[...]")) else ["", *stated.split()]
        shape = tuple(getattr(value, "shape", ()))
        count = len(shape) - len(axes)
        batch, sizes = shape[: max(count, 0)], shape[max(count, 0) :]
        leading = known.get("...", batch)
        batches: dict[str, tuple[object, ...]] = {"": ((),), "...": (leading,), "[...]": (leading, ())}
        if count < 0 or batch not in batches[lead] or not all(map(fits, axes, sizes)):
            names = [lead.strip("[]")] * bool(lead) + axes
            limits = {"A": "2 to 4"} | known
            where = ", ".join(f"{axis} = {limits[axis]}" for axis in names if axis in limits)
            expected = f"({', '.join(names)}{',' * (len(names) == 1)}){' with ' * bool(where)}{where}"
            raise ValueError(f"{name} must have shape {expected}, got {shape}")
        known |= {axis: size for axis, size in zip(axes, sizes, strict=True) if not axis.isdecimal()}
        if batch or lead == "...":
            known["..."] = batch


def check_images(images: Mapping[str, Tensor], shapes: Mapping[str, str]) -> None:
    """Check that tensors are floating-point images of the shapes of ``check_shapes``."""
    for name, image in images.items():
        if not image.is_floating_point():
            problem = f"must be a floating-point tensor, got {image.dtype}"
            raise TypeError(f"{name} {problem}; divide counts by their full scale")
    check_shapes(images, shapes)


def check_pixels(name: str, pixels: Tensor) -> None:
    """Raise a ``ValueError`` if a pixel of a floating-point tensor is NaN, infinite or beyond all scales."""
    if not pixels.numel():
        return
    ends = torch.stack(pixels.detach().aminmax())  # one pass; propagates NaN and infinity
    if not bool(torch.isfinite(ends).all()):
        pixel = tuple((~torch.isfinite(pixels)).nonzero()[0].tolist())
        raise ValueError(f"{name} must be finite, but pixel {pixel} is {pixels[pixel].item()}")
    largest = float(ends.abs().max())
    if largest > MAX_NUMBER:
        problem = f"reach {largest:.3g}, at most {MAX_NUMBER:g} is possible"
        raise ValueError(f"{name} {problem}: divide them by their full scale")


def check_broadcast(**tensors: object) -> None:
    """Raise a ``ValueError`` unless tensors broadcast; other values are omitted."""
    present = {name: value for name, value in tensors.items() if isinstance(value, Tensor)}
    if len(present) < 2:
        return
    try:
        torch.broadcast_tensors(*present.values())  # torch.broadcast_shapes takes 40 us, and first imports sympy
    except RuntimeError as error:
        shapes = ", ".join(str(tuple(value.shape)) for value in present.values())
        raise ValueError(f"{' and '.join(present)} do not fit together: {shapes}") from error


def check_device(name: str, value: object) -> torch.device:
    """Return ``value`` as a device on which tensors can be computed."""
    if not isinstance(value, (str, torch.device)):
        raise TypeError(f"{name} must be a device such as 'cpu' or 'cuda', got {described(value)}")
    try:
        device = torch.device(value)
        torch.empty(0, device=device, dtype=torch.float32)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = one_line(str(error).partition("\n")[0], 200)
        raise ValueError(f"{name}={quoted(str(value))} is not available: {reason}; use 'cpu'") from error
    return device


def checks_arguments(function: Callable[P, R]) -> Callable[P, R]:
    """Check the arguments of a function against its annotations before each call.

    Arguments that accept arrays are left to ``as_tensor``, which the function calls. Compiled graphs omit the checks.
    """
    parameters = inspect.signature(function).parameters.values()
    # inspect.Signature.bind would take longer than the checks; calls that it refuses are refused by the function
    names = [parameter.name for parameter in parameters if parameter.kind is parameter.POSITIONAL_OR_KEYWORD]

    @wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        if not torch.compiler.is_compiling():
            kinds = hints_of(function)
            for name, value in (*zip(names, args, strict=False), *kwargs.items()):
                if name in kinds:
                    _checked(name, value, kinds[name])
        return function(*args, **kwargs)

    return checked


def checked_methods(kind: type[R]) -> type[R]:
    """Check the arguments of the public methods that a class defines against their annotations before each call."""
    for name, method in tuple(vars(kind).items()):
        function = method.__func__ if isinstance(method, classmethod) else method
        is_public = name in ("__init__", "__getitem__") or not name.startswith("_")
        if isinstance(function, types.FunctionType) and is_public and len(function.__annotations__) > 1:
            checked = checks_arguments(function)
            setattr(kind, name, classmethod(checked) if isinstance(method, classmethod) else checked)
    return kind


def check_fields(value: Any) -> None:
    """Check the fields of a dataclass against their annotations; lists become tuples, tables and tensors are copied."""
    kinds = hints_of(value.__class__)
    for name, content in tuple(vars(value).items()):
        checked = _checked(name, content, kinds[name], finite=False)
        checked = checked.clone() if isinstance(checked, Tensor) else checked
        if isinstance(checked, (tuple, dict, Tensor)) and not isinstance(content, tuple):
            object.__setattr__(value, name, checked)


@cache
def hints_of(owner: Callable[..., object]) -> dict[str, object]:
    """Annotations of the arguments of a function, or of the fields of a class."""
    annotations = {name: kind for name, kind in owner.__annotations__.items() if name != "return"}
    if isinstance(owner, type):
        return get_type_hints(owner, localns={"Tensor": Tensor}, include_extras=True)
    names = inspect.unwrap(owner).__globals__
    namespace = {"Tensor": Tensor, "torch": torch}
    return get_type_hints(types.SimpleNamespace(__annotations__=annotations), names, namespace, include_extras=True)


def _checked(name: str, value: object, kind: object, *, finite: bool = True) -> object:
    """The value, or a tuple in place of a list or array, if it is of a kind."""
    adapter, members = _adapter(kind, finite)
    if torch.device in members and value is not None:
        return check_device(name, value)
    if adapter is None:
        return value
    if isinstance(value, Tensor) and Tensor in members:
        return check_tensor(name, value)
    if isinstance(value, _ARRAYS) and any({int, float} & {*get_args(member)} for member in members):
        value = (check_tensor(name, value) if isinstance(value, Tensor) else value).tolist()
    return validated(name, tuple(value) if isinstance(value, (torch.Size, range)) else value, adapter)


@cache
def _adapter(kind: object, finite: bool) -> tuple[TypeAdapter[object] | None, tuple[object, ...]]:
    """The check of an annotation, None where the function converts the value itself; and the members of a union."""
    members = members_of(kind)
    if np.ndarray in members:
        return None, members
    return TypeAdapter(_bounded(kind, finite), config=ConfigDict(strict=True, allow_inf_nan=not finite)), members


def _bounded(kind: Any, finite: bool) -> Any:  # noqa: PLR0911
    """The annotation without numbers beyond all physical quantities, with lists in place of tuples, for pydantic."""
    if kind is float and finite:
        return Number
    if kind is int:
        return Annotated[int, Field(ge=-(2**63), le=2**63 - 1)]
    if kind in (Any, Self):
        return object
    if get_origin(kind) is os.PathLike or (isinstance(kind, type) and kind not in _PLAIN and get_origin(kind) is None):
        made_by = f"{kind.__name__} ({kind._MADE_BY})" if hasattr(kind, "_MADE_BY") else None
        of_class = core_schema.is_instance_schema(get_origin(kind) or kind, cls_repr=made_by)
        return Annotated[object, GetPydanticSchema(lambda source, handler: of_class)]
    arguments = tuple(argument if argument is ... else _bounded(argument, finite) for argument in get_args(kind))
    if get_origin(kind) is tuple:
        return Annotated[tuple.__class_getitem__(arguments), Strict(False)]
    if get_origin(kind) in (Union, types.UnionType):
        return reduce(operator.or_, arguments)
    return get_origin(kind)[arguments] if get_origin(kind) in (Sequence, Mapping, list, dict) else kind


ArrayLike = Tensor | np.ndarray
FramesLike = ArrayLike | Sequence[ArrayLike]
PathLike = str | os.PathLike[str]
FramesOrFiles = FramesLike | PathLike | Sequence[PathLike]
Channels = Literal["first", "last"] | None


def as_tensor(name: str, value: object) -> Tensor:
    """Return a tensor, array or nested list of numbers as a tensor of the same values and dtype; lists are stacked.

    The tensor shares the memory of an array if PyTorch supports its layout. Read-only arrays and arrays with negative
    strides or foreign byte order (FITS and TIFF files) are copied.
    """
    if isinstance(value, Tensor):
        return check_tensor(name, value)
    if isinstance(value, np.ma.MaskedArray):
        raise TypeError(f"{name} must not be a masked array; pass its data, and the mask as ignore=")
    if isinstance(value, (list, tuple)) and any(isinstance(item, (list, tuple, *_ARRAYS)) for item in value):
        items = [as_tensor(f"{name}[{index}]", item) for index, item in enumerate(value)]
        kinds = [f"{tuple(item.shape)} {str(item.dtype).removeprefix('torch.')} on {item.device}" for item in items]
        for index, kind in enumerate(kinds):
            if kind != kinds[0]:
                raise ValueError(f"{name} must be alike, but {name}[{index}] is {kind} and {name}[0] is {kinds[0]}")
        return torch.stack(items)
    array = np.asarray(value)  # of data sets of files and images as well
    if array.dtype.kind not in "biuf":
        remedy = "read files with read_stack, pass a list instead of a generator"
        got = f"{type(value).__name__} of {array.dtype}"
        raise TypeError(f"{name} must be a tensor or array of numbers, got {got}; {remedy}")
    native = np.require(array, array.dtype.newbyteorder("="), ["W"])
    is_known = all(stride >= 0 and stride % native.itemsize == 0 for stride in native.strides)  # to PyTorch
    return torch.from_numpy(native if is_known else native.copy())


def channels_appear_last(shape: Sequence[int]) -> bool:
    """Whether the last axis is one of up to four channels of an image of more than four pixels along each axis."""
    return len(shape) >= 3 and shape[-1] <= 4 < min(shape[-3:-1])


# Axes of frames, and what is to be passed for others, by their number.
_AXES = {
    3: '(T, H, W): one image (H, W, C) is {name}[None] with channels="last", (H, W, T) is {name}.permute(2, 0, 1)',
    4: '(T, C, H, W): pass channels="last" for (T, H, W, C), {name}[:, :, None] for a batch (B, T, H, W)',
    5: '(B, T, C, H, W): pass channels="last" for (B, T, H, W, C), {name}.permute(0, 2, 1, 3, 4) for (B, C, T, H, W)',
}


def other_axes(name: str, shape: tuple[int, ...]) -> ValueError:
    """The error about frames whose axes appear to be others."""
    remedies = _AXES[len(shape)].format(name=name)
    return ValueError(f'{name} of shape {shape} do not appear to be {remedies}, or channels="first" if they are')


def channel_axis(name: str, shape: Sequence[int], channels: Channels) -> int:
    """The axis of the channels: -1 if they are last, -3 if they come before the image axes or do not exist.

    Shapes are (T, H, W), (T, C, H, W) and (B, T, C, H, W); with ``channels="last"`` (T, H, W, C) and (B, T, H, W, C).
    Without ``channels="first"``, a shape is refused that appears to have up to four channels last in an image of more
    than four pixels along each axis, or the frames on the last axis: (H, W, T) or (H, W, C, T).
    """
    check_choice("channels", channels, (None, "first", "last"))
    shape, is_last = tuple(shape), channels == "last" and len(shape) > 3
    if len(shape) not in _AXES:
        grey = f"; one grey image is {name}[None]" if len(shape) == 2 else ""
        raise ValueError(f"{name} must have shape (T, H, W), (T, C, H, W) or (B, T, C, H, W), got {shape}{grey}")
    if is_last and channels_appear_last((*shape[-2:], shape[-3])):
        raise ValueError(f'{name} of shape {shape} appear to have channels before the image axes: omit channels="last"')
    few_columns, few_rows = 4 * shape[2] <= min(shape[:2]), shape[2] <= 4 < min(shape[:2])  # no camera has such frames
    frames_last = few_columns if len(shape) == 3 else few_rows and len(shape) == 4
    if channels != "first" and not is_last and (frames_last or channels_appear_last(shape)):
        raise other_axes(name, shape)
    return -1 if is_last else -3
