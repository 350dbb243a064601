"""Checks of arguments and optional packages; messages contain the name, the value and what is expected."""

import math
from importlib import import_module
from numbers import Real
from types import ModuleType
from typing import Any, TypeVar

from rsvib_torch.text import quoted

Error = TypeVar("Error", bound=Exception)

# Largest magnitude of numbers and pixels of public functions: squares of float32 are finite up to 1.8e19, and sums of
# squares over an image of 1e8 px up to 1.8e15. No quantity in px, s or Hz reaches it.
MAX_NUMBER = 1e15


def described(value: object) -> str:
    """Type of a value, with the value if it is short, for error messages."""
    if value is None or getattr(value, "is_nested", False):
        return "None" if value is None else "a nested tensor"  # whose shape raises an error
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if shape is not None and dtype is not None:
        return f"{type(value).__name__} of shape {tuple(shape)} and {dtype}"
    if isinstance(value, (bool, float, complex, str, bytes)):
        return f"{quoted(value)} ({type(value).__name__})"
    if isinstance(value, int):
        return f"{value} (int)" if abs(value) < 10**30 else "a very large int"
    if isinstance(value, (list, tuple)) and len(value) < 10 and all(isinstance(item, (int, float)) for item in value):
        return repr(value)
    return type(value).__name__


def named(error: Error, argument: str, problem: str) -> Error:
    """The error with the argument that it is about and what is wrong with it, as commands state it for an option."""
    vars(error).update(argument=argument, problem=problem)
    return error


def refused(kind: type[Error], name: str, problem: str) -> Error:
    """The error of an argument: its name and what is wrong with it, also as data."""
    return named(kind(f"{name} {problem}"), name, problem)


def check_single(name: str, value: Any) -> None:
    """Raise a ``ValueError`` if a result or a motion is a batch."""
    if value.batch_shape:
        raise ValueError(f"{name} is a batch of shape {tuple(value.batch_shape)}: pass one of them, {name}[0]")


def check_number(
    name: str, value: object, *, above: float = -math.inf, at_least: float = -math.inf, at_most: float = math.inf
) -> float:
    """Return ``value`` as a finite float within its bounds; booleans are refused."""
    if isinstance(value, bool) or not isinstance(value, Real):
        raise refused(TypeError, name, f"must be a number, got {described(value)}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf if value == abs(value) else -math.inf  # a whole number beyond float64
    if not math.isfinite(number):
        raise refused(ValueError, name, f"must be finite, got {number}")
    if number <= above:
        raise refused(ValueError, name, f"must be larger than {above:g}, got {number:g}")
    if not at_least <= number <= at_most:
        bound = f"at least {at_least:g}" if number < at_least else f"at most {at_most:g}"
        raise refused(ValueError, name, f"must be {bound}, got {number:g}")
    return number


def check_choice(name: str, value: object, choices: tuple[object, ...]) -> None:
    """Raise a ``ValueError`` that lists the choices unless ``value`` is one of them."""
    # only values of the same types are compared: a tensor has no truth value
    if not isinstance(value, tuple(type(choice) for choice in choices)) or value not in choices:
        raise refused(ValueError, name, f"must be one of {', '.join(map(repr, choices))}; got {described(value)}")


def check_whole_number(name: str, value: object, *, at_least: int, at_most: int = 2**63 - 1) -> int:
    """Return ``value`` as an int from ``at_least`` to ``at_most``, by default the largest index of an array."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise refused(TypeError, name, f"must be a whole number, got {described(value)}")
    if not at_least <= value <= at_most:
        bound = f"at least {at_least}" if value < at_least else f"at most {at_most}"
        raise refused(ValueError, name, f"must be {bound}, got {described(value).removesuffix(' (int)')}")
    return value


def needed_package(name: str, purpose: str, extra: str) -> ModuleType:
    """Import an optional package that ``purpose`` needs; an error names the extra of this package that installs it."""
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        if error.name is not None and error.name.partition(".")[0] != name.partition(".")[0]:
            raise
        needed = f"{purpose} needs the package {name.partition('.')[0]}: pip install rsvib_torch[{extra}]"
        raise ModuleNotFoundError(needed, name=error.name) from error
