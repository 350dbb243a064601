"""Checks of single values; messages contain the name, the value and what is expected.

Values are checked by pydantic: those of arguments here, those of groups of options in ``validation``. ``mistakes_of``
translates what it reports for both.
"""

import types
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import import_module
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from rsvib_torch.text import quoted

Value = TypeVar("Value")

# Largest magnitude of numbers and pixels of public functions: squares of float32 are finite up to 1.8e19, and sums of
# squares over an image of 1e8 px up to 1.8e15. No quantity in px, s or Hz reaches it.
MAX_NUMBER = 1e15
_BOUNDS = {
    "greater_than": "larger than {gt:g}",
    "greater_than_equal": "at least {ge:g}",
    "less_than_equal": "at most {le:g}",
    "finite_number": "finite",
}


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


def check_single(name: str, batch_shape: Sequence[int]) -> None:
    """Raise a ``ValueError`` if a result or a motion is a batch."""
    if batch_shape:
        raise ValueError(f"{name} is a batch of shape {tuple(batch_shape)}: pass one of them, {name}[0]")


def check_number(
    name: str, value: object, *, above: float | None = None, at_least: float | None = None, at_most: float | None = None
) -> float:
    """Return ``value`` as a finite float within its bounds; booleans are refused."""
    number: float = validated(name, value, _adapter(float, gt=above, ge=at_least, le=at_most))
    return number


def check_whole_number(name: str, value: object, *, at_least: int, at_most: int = 2**63 - 1) -> int:
    """Return ``value`` as an int from ``at_least`` to ``at_most``, by default the largest index of an array."""
    number: int = validated(name, value, _adapter(int, ge=at_least, le=at_most))
    return number


def check_choice(name: str, value: object, choices: tuple[object, ...]) -> None:
    """Raise a ``ValueError`` that lists the choices unless ``value`` is one of them."""
    validated(name, value, _adapter(Literal[choices]))


@cache
def _adapter(kind: Any, **bounds: float | None) -> TypeAdapter[Any]:
    return TypeAdapter(Annotated[kind, Field(**bounds)], config=ConfigDict(strict=True, allow_inf_nan=False))


def validated(name: str, value: object, adapter: TypeAdapter[Value]) -> Value:
    """Return the value of an argument if it is of the kind of ``adapter``, as that converts it."""
    value = plain(value)
    if getattr(value, "is_meta", False):
        raise TypeError(f"{name} must have a value, got a meta tensor; load the data onto a device first")
    try:
        return adapter.validate_python(value)
    except ValidationError as error:
        raise mistakes_of(error, value, name)[0] from None


def plain(value: Any) -> Any:
    """NumPy numbers and short arrays as Python numbers and lists."""
    if type(value).__module__ != "numpy" or getattr(getattr(value, "dtype", None), "kind", "-") not in "biuf":
        return value
    return value.tolist() if value.ndim < 2 and value.size < 10 else value


def mistakes_of(error: ValidationError, data: object, path: str = "", group: object = None) -> list[Exception]:
    """What pydantic found in data, one error for each key, which it names behind ``path``.

    If the data are those of a ``group`` of options, errors of unknown keys list the options.
    """
    found: dict[tuple[object, ...], list[tuple[tuple[str | int, ...], ErrorDetails]]] = {}
    for entry in error.errors(include_url=False):
        keys: tuple[str | int, ...] = ()
        outer, value = None, data
        for step in entry["loc"]:
            if isinstance(value, Mapping) and (step in value or entry["type"] == "missing"):
                keys, value = (*keys, step), value.get(step)
            elif isinstance(value, (list, tuple)) and isinstance(step, int):
                keys, value = (*keys, step), value[step] if step < len(value) else None
            elif outer is None:  # the step names a member of a union
                outer = keys
        found.setdefault(keys if outer is None else outer, []).append((keys, entry))
    mistakes = []
    for entries in found.values():
        keys = max((keys for keys, _ in entries), key=len)  # of the members of a union, the one that fits best
        mistakes.append(_explained(path, keys, [entry for of_entry, entry in entries if of_entry == keys], group))
    return mistakes


def _explained(path: str, keys: Sequence[str | int], entries: list[ErrorDetails], group: object) -> Exception:
    """The error of entries of pydantic about one key, which are those of the members of a union."""
    place = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in (path, *keys)).strip(".")
    entry = next((entry for entry in entries if entry["type"] in _BOUNDS), entries[0])
    kind, context = entry["type"], entry.get("ctx", {})
    if kind == "missing":
        table = ", ".join(_options_at(group, keys))
        return TypeError(f"{place} is missing{table and f'; expected a table with {table}'}")
    if kind == "unexpected_keyword_argument":
        return TypeError(f"unknown option {quoted(place)}; the options are {', '.join(_options_at(group, keys[:-1]))}")
    if kind == "value_error":  # of a validator
        return ValueError(f"{place}: {context['error']}" if place else str(context["error"]))
    texts = (_BOUNDS[kind].format(**context),) if kind in _BOUNDS else (one["msg"] for one in entries)
    expected = " or ".join(dict.fromkeys(text.removeprefix("Input should be ") for text in texts))
    expected = expected.replace("a valid integer", "a whole number").replace("a valid ", "a ")
    of_value = kind in _BOUNDS or all(one["type"] == "literal_error" for one in entries)
    return (ValueError if of_value else TypeError)(f"{place} must be {expected}, got {described(entry['input'])}")


def _options_at(group: object, keys: Sequence[str | int]) -> list[str]:
    """Names of the options of a group that is a value in a group; none of other values."""
    fields: Mapping[str | int, FieldInfo] = {}
    for key in ("", *keys):
        group = fields[key].annotation if key in fields else group
        kind = next((one for one in members_of(group) if hasattr(one, "__pydantic_fields__")), None)
        fields = getattr(kind, "__pydantic_fields__", {})
    return list(map(str, fields))


def members_of(annotation: object) -> tuple[object, ...]:
    """Members of a union without their bounds, and without None."""
    annotation = without_alias(annotation)
    if get_origin(annotation) is Annotated:
        return members_of(get_args(annotation)[0])
    if get_origin(annotation) in (Union, types.UnionType):
        return tuple(member for part in get_args(annotation) for member in members_of(part))
    return () if annotation is type(None) else (annotation,)


def without_alias(annotation: Any) -> Any:
    """The annotation that a type alias stands for, as ``NDArray`` of NumPy 2.5 is one."""
    alias = get_origin(annotation) or annotation
    if type(alias).__name__ != "TypeAliasType":
        return annotation
    arguments = get_args(annotation)
    return alias.__value__[arguments] if arguments else alias.__value__


def needed_package(name: str, purpose: str, extra: str) -> types.ModuleType:
    """Import an optional package that ``purpose`` needs; an error names the extra of this package that installs it."""
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        if error.name is not None and error.name.partition(".")[0] != name.partition(".")[0]:
            raise
        needed = f"{purpose} needs the package {name.partition('.')[0]}: pip install rsvib_torch[{extra}]"
        raise ModuleNotFoundError(needed, name=error.name) from error


def beyond_full_scale(largest: int, full_scale: float) -> str:
    """Message for counts that exceed the full scale."""
    return f"counts reach {largest}, beyond full_scale={full_scale:g}; pass a full_scale of at least the largest count"
