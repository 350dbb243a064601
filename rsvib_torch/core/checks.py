"""Checks of arguments; error messages contain the name, the value and what is expected."""

import math
from numbers import Real

__all__ = ["check_choice", "check_number", "check_whole_number"]


def check_number(
    name: str,
    value: object,
    *,
    above: float = -math.inf,
    at_least: float = -math.inf,
    at_most: float = math.inf,
) -> float:
    """Return ``value`` as a finite float within its bounds.

    Args:
        name: Name of the argument in error messages.
        value: The value; booleans are refused.
        above: The value must be larger than this.
        at_least: The value must not be smaller than this.
        at_most: The value must not be larger than this.

    Returns:
        The value as a float.

    Raises:
        TypeError: If the value is not a real number.
        ValueError: If it is not finite or out of bounds.

    Example:
        >>> check_number("row_time", 2e-5, above=0.0)
        2e-05
    """
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError(f"{name} must be a number, got {value!r} ({type(value).__name__})")
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{name} must be finite, got {number}")
    if number <= above:
        raise ValueError(f"{name} must be larger than {above:g}, got {number:g}")
    if number < at_least:
        raise ValueError(f"{name} must be at least {at_least:g}, got {number:g}")
    if number > at_most:
        raise ValueError(f"{name} must be at most {at_most:g}, got {number:g}")
    return number


def check_choice(name: str, value: object, choices: tuple[object, ...]) -> None:
    """Raise a ``ValueError`` that lists the choices unless ``value`` is one of them.

    Example:
        >>> check_choice("method", "bands", ("bands",))
    """
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, choices))}; got {value!r}")


def check_whole_number(name: str, value: object, *, at_least: int, at_most: int | None = None) -> int:
    """Return ``value`` as an int that is not smaller than ``at_least``, and not larger than ``at_most``.

    Raises:
        TypeError: If the value is not a whole number.
        ValueError: If it is too small or too large.

    Example:
        >>> check_whole_number("band_rows", 32, at_least=4)
        32
    """
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError(f"{name} must be a whole number, got {value!r}")
    if value < at_least:
        raise ValueError(f"{name} must be at least {at_least}, got {value}")
    if at_most is not None and value > at_most:
        raise ValueError(f"{name} must be at most {at_most}, got {value}")
    return value
