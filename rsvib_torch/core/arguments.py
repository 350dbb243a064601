"""Checks of the arguments of public functions against their annotations.

Functions and methods of the public interface have the decorator ``checks_arguments``: a value of another type, a tensor
that PyTorch cannot compute with, a number that is not finite or beyond all physical quantities, and an unknown choice
are refused with the name of the argument. Bounds that depend on the function are checked by the function.
"""

import collections.abc
import inspect
import math
import os
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import cache, wraps
from typing import (
    Any,
    Literal,
    ParamSpec,
    TypeVar,
    Union,
    Unpack,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
)

import numpy as np
import torch
from torch import Tensor

from rsvib_torch.core.checks import MAX_NUMBER, check_choice, check_number, check_whole_number, described

__all__ = [
    "as_numbers",
    "check_broadcast",
    "check_device",
    "check_fields",
    "check_images",
    "check_options",
    "check_pixels",
    "check_shapes",
    "check_tensor",
    "checks_arguments",
]

P = ParamSpec("P")
R = TypeVar("R")
_Check = Callable[[str, Any], None]
_ARRAYS = (Tensor, np.ndarray)


def check_tensor(name: str, value: object) -> Tensor:
    """Return ``value`` if it is a dense tensor of real numbers that has data.

    Raises:
        TypeError: If it is not a tensor, or a sparse, nested, quantised, complex or meta tensor.

    Example:
        >>> check_tensor("frames", torch.zeros(2, 3, device="meta"))
        Traceback (most recent call last):
        ...
        TypeError: frames must be a tensor with data, got a meta tensor; load the data onto a device first
    """
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} must be a tensor, got {described(value)}")
    if value.is_nested:
        raise TypeError(f"{name} must be a dense tensor, got a nested tensor; pass its parts one by one")
    if value.layout != torch.strided:
        raise TypeError(f"{name} must be a dense tensor, got {value.layout}; call {name}.to_dense()")
    if value.is_quantized:
        raise TypeError(f"{name} must not be quantised, got {value.dtype}; call {name}.dequantize()")
    if value.is_complex():
        raise TypeError(f"{name} must be real numbers, got {value.dtype}")
    if value.is_floating_point() and value.dtype.itemsize == 1:
        raise TypeError(f"{name} must have at least 16 bits, got {value.dtype}; call {name}.float()")
    if value.device.type == "meta":
        raise TypeError(f"{name} must be a tensor with data, got a meta tensor; load the data onto a device first")
    return value


def as_numbers(name: str, value: object, device: torch.device | None = None) -> Tensor:
    """Return a tensor, a number or a nested list of numbers as a float64 tensor; gradients are kept.

    Args:
        name: Name of the argument in error messages.
        value: The value.
        device: Device of the result; by default that of a tensor, and the CPU for other values.

    Raises:
        TypeError: If it does not consist of real numbers, or lists differ in length.

    Example:
        >>> as_numbers("amplitude", [3, 5]).dtype
        torch.float64
    """
    if isinstance(value, Tensor):
        return check_tensor(name, value).to(dtype=torch.float64, device=device)
    if isinstance(value, np.ma.MaskedArray):
        raise TypeError(f"{name} must not be a masked array; pass the values without the masked ones")
    try:
        return torch.as_tensor(value, dtype=torch.float64, device="cpu" if device is None else device)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise TypeError(
            f"{name} must be a number, a tensor, or numbers in lists of equal lengths, got {described(value)}"
        ) from error


def check_shapes(values: Mapping[str, Any], shapes: Mapping[str, str]) -> None:
    """Raise a ``ValueError`` unless tensors have the stated shapes.

    Args:
        values: Tensors by name; None and names without a stated shape are omitted.
        shapes: Axes of a tensor: a size; a name for a size of at least 1 that is the same in all tensors, with its
            limits if there are any (``A=2-4``); ``...`` for leading dimensions that are the same in all tensors, or
            ``[...]`` for these or none. ``...`` alone, for values that are not tensors, is not checked.

    Example:
        >>> check_shapes({"scene": torch.zeros(3)}, {"scene": "... H W"})
        Traceback (most recent call last):
        ...
        ValueError: scene must have shape (..., H, W), got (3,)
    """
    known: dict[str, Any] = {}
    for name, stated in shapes.items():
        value = values.get(name)
        if value is None or stated == "...":
            continue
        lead, axes = _stated_axes(stated)
        shape = tuple(value.shape)
        count = len(shape) - len(axes)
        batch, sizes = shape[: max(count, 0)], shape[max(count, 0) :]
        fits = count >= 0 and all(
            low <= size <= high and size == known.get(axis, size)
            for size, (axis, low, high) in zip(sizes, axes, strict=True)
        )
        batches = {"": [()], "...": [known.get("...", batch)], "[...]": [known.get("...", batch), ()]}[lead]
        if not fits or batch not in batches:
            names = [lead.strip("[]")] * bool(lead) + [axis for axis, _, _ in axes]
            limits = {axis: f"{low} to {high}" for axis, low, high in axes if math.isfinite(high) and low < high}
            sizes_known = [f"{axis} = {(limits | known)[axis]}" for axis in names if axis in limits | known]
            where = f" with {', '.join(sizes_known)}" if sizes_known else ""
            raise ValueError(
                f"{name} must have shape ({', '.join(names)}{',' * (len(names) == 1)}){where}, got {shape}"
            )
        known |= {axis: size for (axis, low, high), size in zip(axes, sizes, strict=True) if low < high}
        if batch or lead == "...":
            known["..."] = batch


def _stated_axes(stated: str) -> tuple[str, list[tuple[str, int, float]]]:
    """Mark of the leading dimensions, and name, smallest and largest size of each axis of a shape."""
    names = stated.split()
    lead = names.pop(0) if names[0] in ("...", "[...]") else ""
    axes: list[tuple[str, int, float]] = []
    for entry in names:
        axis, _, limits = entry.partition("=")
        low, _, high = (axis if axis.isdecimal() else limits or "1").partition("-")
        axes.append((axis, int(low), int(high or low) if limits or axis.isdecimal() else math.inf))
    return lead, axes


def check_images(images: Mapping[str, Tensor], shapes: Mapping[str, str]) -> None:
    """Check that tensors are floating-point images of the shapes of ``check_shapes``.

    Raises:
        TypeError: If one is not a floating-point tensor.
        ValueError: If one has another shape.

    Example:
        >>> check_images({"scene": torch.zeros(4, 5, dtype=torch.uint8)}, {"scene": "... H W"})
        Traceback (most recent call last):
        ...
        TypeError: scene must be a floating-point tensor, got torch.uint8; divide counts by their full scale
    """
    for name, image in images.items():
        if not image.is_floating_point():
            raise TypeError(
                f"{name} must be a floating-point tensor, got {image.dtype}; divide counts by their full scale"
            )
    check_shapes(images, shapes)


def check_pixels(name: str, pixels: Tensor) -> None:
    """Raise a ``ValueError`` if a pixel of a floating-point tensor is NaN, infinite or beyond all scales.

    Example:
        >>> check_pixels("frames", torch.tensor([[0.0, torch.inf]]))
        Traceback (most recent call last):
        ...
        ValueError: frames must be finite, but pixel (0, 1) is inf
    """
    if not pixels.numel():
        return
    ends = torch.stack(pixels.detach().aminmax())  # one pass; propagates NaN and infinity
    if not bool(torch.isfinite(ends).all()):
        pixel = tuple((~torch.isfinite(pixels)).nonzero()[0].tolist())
        raise ValueError(f"{name} must be finite, but pixel {pixel} is {pixels[pixel].item()}")
    largest = float(ends.abs().max())
    if largest > MAX_NUMBER:
        raise ValueError(
            f"{name} reach {largest:.3g}, at most {MAX_NUMBER:g} is possible: divide them by their full scale"
        )


def check_options(options: Mapping[str, Any], kind: type) -> None:
    """Check options against the annotations of a ``TypedDict``.

    Example:
        >>> from typing import TypedDict
        >>> Options = TypedDict("Options", {"iterations": int})
        >>> check_options({"iterations": 1.5}, Options)
        Traceback (most recent call last):
        ...
        TypeError: iterations must be a whole number, got 1.5 (float)
    """
    checks = _option_checks(kind)
    for name, value in options.items():
        if check := checks.get(name):
            check(name, value)


def check_broadcast(**tensors: Any) -> None:
    """Raise a ``ValueError`` unless tensors broadcast; other values are omitted.

    Example:
        >>> check_broadcast(u=torch.zeros(3), v=torch.zeros(2))
        Traceback (most recent call last):
        ...
        ValueError: u and v do not fit together: (3,), (2,)
    """
    given = {name: value for name, value in tensors.items() if isinstance(value, Tensor)}
    if len(given) < 2:
        return
    try:
        torch.broadcast_tensors(*given.values())  # torch.broadcast_shapes takes 40 us, and its first call imports sympy
    except RuntimeError as error:
        shapes = ", ".join(str(tuple(value.shape)) for value in given.values())
        raise ValueError(f"{' and '.join(given)} do not fit together: {shapes}") from error


def check_device(name: str, value: object) -> torch.device:
    """Return ``value`` as a device on which tensors can be computed.

    Raises:
        TypeError: If it is neither a device nor text.
        ValueError: If there is no such device.

    Example:
        >>> check_device("device", "cpu")
        device(type='cpu')
    """
    if not isinstance(value, (str, torch.device)):
        raise TypeError(f"{name} must be a device such as 'cpu' or 'cuda', got {described(value)}")
    try:
        device = torch.device(value)
        torch.empty(0, device=device, dtype=torch.float32)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).partition("\n")[0]
        raise ValueError(f"{name}={str(value)!r} is not available: {reason}; use 'cpu'") from error
    return device


def checks_arguments(function: Callable[P, R]) -> Callable[P, R]:
    """Check the arguments of a function against its annotations before each call.

    Arguments that accept arrays are left to ``as_tensor``, which the function calls. Compiled graphs omit the
    checks.

    Example:
        >>> @checks_arguments
        ... def doubled(count: int) -> int:
        ...     return 2 * count
        >>> doubled("3")
        Traceback (most recent call last):
        ...
        TypeError: count must be a whole number, got '3' (str)
    """
    parameters = inspect.signature(function).parameters.values()
    # inspect.Signature.bind would take longer than the checks; calls that it refuses are refused by the function
    names = [parameter.name for parameter in parameters if parameter.kind is parameter.POSITIONAL_OR_KEYWORD]

    @wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        if torch.compiler.is_compiling():
            return function(*args, **kwargs)
        checks = _checks_of(function)
        for name, value in (*zip(names, args, strict=False), *kwargs.items()):
            if check := checks.get(name):
                check(name, value)
        return function(*args, **kwargs)

    return checked


def check_fields(value: Any) -> None:
    """Check the types of the fields of a dataclass against their annotations; lists and arrays become tuples.

    Raises:
        TypeError: If a field has another type; numbers may be infinite or NaN.
    """
    for name, check, is_tuple in _field_checks(value.__class__):
        given = getattr(value, name)
        check(name, given)
        if is_tuple and given is not None and not isinstance(given, tuple):
            given = tuple(given.tolist() if isinstance(given, _ARRAYS) else given)
            check(name, given)
            object.__setattr__(value, name, given)


@cache
def _field_checks(kind: type) -> list[tuple[str, _Check, bool]]:
    """Name and check of each field, and whether it is a tuple."""
    hints = get_type_hints(kind, localns={"Tensor": Tensor})
    checks = ((name, _check(hints[name], finite=False)) for name in (field.name for field in fields(kind)))
    return [
        (name, check, tuple in (get_origin(hints[name]), *map(get_origin, get_args(hints[name]))))
        for name, check in checks
        if check is not None
    ]


@cache
def _option_checks(kind: type) -> dict[str, _Check | None]:
    return {name: _check(hint) for name, hint in get_type_hints(kind).items()}


@cache
def _checks_of(function: Callable[..., Any]) -> dict[str, _Check]:
    """Check of each parameter and option by name."""
    checks: dict[str, _Check | None] = {}
    given = {name: kind for name, kind in function.__annotations__.items() if name != "return"}
    names = inspect.unwrap(function).__globals__
    hints = get_type_hints(types.SimpleNamespace(__annotations__=given), names, {"Tensor": Tensor, "torch": torch})
    for parameter in inspect.signature(function).parameters.values():
        kind = hints.get(parameter.name, Any)
        if get_origin(kind) is Unpack:
            checks |= _option_checks(get_args(kind)[0])
        elif parameter.kind not in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL):
            checks[parameter.name] = _check(kind)
    return {name: check for name, check in checks.items() if check is not None}


def _check(kind: Any, *, finite: bool = True) -> _Check | None:  # noqa: PLR0911, PLR0912
    """The check of an annotation; None where every value is accepted or the function itself checks it."""
    kind = _without_alias(kind)
    origin, arguments = get_origin(kind), tuple(map(_without_alias, get_args(kind)))
    if kind is Any or isinstance(kind, TypeVar):
        return None
    if torch.device in arguments and origin in (Union, types.UnionType):
        return lambda name, value: None if value is None else void(check_device(name, value))
    if origin in (Union, types.UnionType):
        return _check_of_union(arguments, finite)
    if origin is Literal:
        kinds = tuple({type(choice) for choice in arguments})  # the choices are keys of tables that users extend
        return lambda name, value: None if isinstance(value, kinds) else check_choice(name, value, arguments)
    if kind is Tensor:
        return lambda name, value: void(check_tensor(name, value))
    if kind is torch.device:
        return lambda name, value: void(check_device(name, value))
    if kind is bool:
        return _instance((bool, np.bool_), "True or False")
    if kind is int:
        return lambda name, value: void(check_whole_number(name, value, at_least=-(2**63), at_most=2**63 - 1))
    if kind is float and finite:
        return lambda name, value: void(check_number(name, value, at_least=-MAX_NUMBER, at_most=MAX_NUMBER))
    if kind is float:
        return _instance((float, int, np.floating, np.integer), "a number")
    if kind is types.NoneType:
        return _instance((types.NoneType,), "None")
    if origin is os.PathLike or kind is os.PathLike:
        return _instance((os.PathLike,), "a path")
    if kind is str:
        return _instance((str,), "text")
    if origin is tuple or (inspect.isclass(origin) and issubclass(origin, Sequence)):
        return _check_of_sequence(origin, arguments, finite)
    if origin is np.ndarray:
        return _instance((np.ndarray,), "a NumPy array")
    if inspect.isclass(origin) and issubclass(origin, Mapping):
        return _check_of_mapping(arguments, finite)
    if origin is collections.abc.Callable:
        return lambda name, value: None if callable(value) else _refuse(name, "a function", value)
    if inspect.isclass(kind) and origin is None and not is_typeddict(kind) and kind is not object:
        if getattr(kind, "_is_protocol", False) and not getattr(kind, "_is_runtime_protocol", False):
            return None
        article, source = "an" if kind.__name__[0] in "AEIOU" else "a", getattr(kind, "_MADE_BY", "")
        return _instance((kind,), f"{article} {kind.__name__}{source and f' ({source})'}")
    return None


def _without_alias(kind: Any) -> Any:
    """What a ``type`` statement stands for, as numpy.typing.NDArray from NumPy 2.5 on; other annotations unchanged."""
    alias = kind if get_origin(kind) is None else get_origin(kind)
    return alias.__value__ if type(alias).__name__ == "TypeAliasType" else kind


def void(_: object) -> None:
    """None, for checks that return their value."""


def _refuse(name: str, expected: str, value: object) -> None:
    raise TypeError(f"{name} must be {expected}, got {described(value)}")


def _instance(kinds: tuple[type, ...], expected: str) -> _Check:
    return lambda name, value: None if isinstance(value, kinds) else _refuse(name, expected, value)


def _instance_of_choice(choices: tuple[Any, ...]) -> _Check:
    """Check of the type only, among other types: the function checks the value."""
    return _instance(tuple({type(choice) for choice in choices}), " or ".join(map(repr, choices)))


def _check_of_union(members: tuple[Any, ...], finite: bool) -> _Check | None:
    checks = [
        _instance_of_choice(get_args(member)) if get_origin(member) is Literal else _check(member, finite=finite)
        for member in members
    ]
    if any(get_origin(member) is np.ndarray or check is None for member, check in zip(members, checks, strict=True)):
        return None  # as_tensor checks arrays
    if any(getattr(member, "_is_protocol", False) for member in members):
        return None  # the function names what it accepts, and the remedy

    accepts_none = types.NoneType in members

    def check(name: str, value: Any) -> None:
        if value is None and accepts_none:
            return
        errors = []
        for member in checks:
            try:
                if member is not None:
                    member(name, value)
                return
            except (TypeError, ValueError) as error:
                # with its traceback, it would keep the tensors of all callers in memory until the garbage collection
                errors.append(error.with_traceback(None))
        refused = [error for error in errors if isinstance(error, ValueError)]
        if len(errors) == 1 or refused:
            raise (refused or errors)[0]
        words = dict.fromkeys(str(error).removeprefix(f"{name} must be ").partition(", got")[0] for error in errors)
        _refuse(name, " or ".join(words), value)

    return check


def _holds_numbers(kind: Any) -> bool:
    return kind in (int, float, bool, Any) or any(map(_holds_numbers, get_args(kind)))


def _check_of_sequence(origin: Any, arguments: tuple[Any, ...], finite: bool) -> _Check:
    length = len(arguments) if origin is tuple and arguments[-1:] != (...,) else None
    parts = [_check(argument, finite=finite) for argument in arguments if argument is not ...]
    numbers = not arguments or any(map(_holds_numbers, arguments))

    def check(name: str, value: Any) -> None:
        if numbers and isinstance(value, _ARRAYS):
            check_tensor(name, value if isinstance(value, Tensor) else _numeric(name, value))
            if value.ndim == 0:
                _refuse(name, "a sequence" if length is None else f"{length} values", value)
        elif not isinstance(value, Sequence) or isinstance(value, (str, bytes)):
            _refuse(name, "a sequence" if length is None else f"{length} values", value)
        if length is not None and len(value) != length:
            raise ValueError(f"{name} must have {length} values, got {len(value)}")
        if isinstance(value, Sequence):
            for index, entry in enumerate(value):
                part = parts[index] if length is not None else parts[0] if parts else None
                if part is not None:
                    part(f"{name}[{index}]", entry)

    return check


def _check_of_mapping(arguments: tuple[Any, ...], finite: bool) -> _Check:
    key_check, value_check = (_check(argument, finite=finite) for argument in arguments)

    def check(name: str, value: Any) -> None:
        if not isinstance(value, Mapping):
            _refuse(name, "a dictionary", value)
        for key, entry in value.items():
            if key_check is not None:
                key_check(f"keys of {name}", key)
            if value_check is not None:
                value_check(f"{name}[{key!r}]", entry)

    return check


def _numeric(name: str, value: Any) -> Tensor:
    """An array of numbers as a tensor that is not used."""
    if isinstance(value, np.ma.MaskedArray) or value.dtype.kind not in "biuf":
        _refuse(name, "an array of real numbers", value)
    return torch.empty(0, dtype=torch.float32, device="cpu")
