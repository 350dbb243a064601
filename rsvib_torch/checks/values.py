"""Checks of values and of groups of options; messages contain the name, the value and what is expected.

The class of a group is the only place that states an option: its type, bounds and default, and its description in the
text below the field. ``options`` makes a class such a group. Python arguments, keys of TOML files and options of the
command line are checked by it, single values by ``check_number`` and others. pydantic checks them, and ``mistakes_of``
translates what it reports.
"""

import inspect
import json
import types
from collections.abc import Callable, Mapping, Sequence
from functools import cache, wraps
from importlib import import_module
from pathlib import Path
from textwrap import fill
from typing import Annotated, Any, Literal, TypeVar, Union, dataclass_transform, get_args, get_origin, get_type_hints

import pydantic
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError, ValidatorFunctionWrapHandler
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from rsvib_torch.files.reading import Table, read_text
from rsvib_torch.text import one_line, printable, quoted

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
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if shape is not None and dtype is not None:
        return f"{type(value).__name__} of shape {tuple(shape)} and {dtype}"
    if isinstance(value, (int, float, complex, str, bytes)):
        return f"{quoted(value)} ({type(value).__name__})"
    if isinstance(value, (list, tuple)) and len(value) < 10 and all(isinstance(item, (int, float)) for item in value):
        return repr(value)
    return "None" if value is None else type(value).__name__


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
    errors_of_keys: dict[tuple[str | int, ...], list[ErrorDetails]] = {}
    for entry in error.errors(include_url=False):
        keys: tuple[str | int, ...] = ()
        value = data
        for step in entry["loc"]:  # steps that are no keys name members of unions
            if isinstance(value, Mapping) and (step in value or entry["type"] == "missing"):
                keys, value = (*keys, step), value.get(step)
            elif isinstance(value, (list, tuple)) and isinstance(step, int):
                keys, value = (*keys, step), value[step] if step < len(value) else None
        errors_of_keys.setdefault(keys, []).append(entry)
    return [_explained(path, keys, entries, group) for keys, entries in errors_of_keys.items()]


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
    if get_origin(annotation) is Annotated:
        return members_of(get_args(annotation)[0])
    if get_origin(annotation) in (Union, types.UnionType):
        return tuple(member for part in get_args(annotation) for member in members_of(part))
    return () if annotation is type(None) else (annotation,)


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


_Group = TypeVar("_Group")
_Result = TypeVar("_Result")
_MAX_LINES = 20  # of an error message
_MAX_JSON_BYTES = 10**9  # a manifest has about 2 KB per window
# Numbers of options: finite, and of a magnitude that a quantity can have.
Number = Annotated[float, Field(ge=-MAX_NUMBER, le=MAX_NUMBER, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, le=MAX_NUMBER, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, le=MAX_NUMBER, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1, le=2**31)]


class MistakesError(ValueError):
    """Mistakes in one file, with a line of text for each."""


# unknown keys are refused, and values are not converted; the text below a field is its description
_CONFIG = ConfigDict(extra="forbid", strict=True, arbitrary_types_allowed=True, use_attribute_docstrings=True)


def _name_of_table(value: object, check: ValidatorFunctionWrapHandler, info: pydantic.ValidationInfo) -> object:
    """Any text outside of files, which may contain only the names of the package."""
    return value if info.context is None and isinstance(value, str) else check(value)


# Mark of a choice whose names are keys of a table that users extend: the function that uses it refuses unknown names.
Extensible = pydantic.WrapValidator(_name_of_table)


@dataclass_transform(kw_only_default=True, frozen_default=True, field_specifiers=(Field,))
def options(group: type[_Group]) -> type[_Group]:
    """Make a class a group of options: a frozen dataclass whose values are checked."""

    def accept_tables(_: type, source: object, handler: Callable[[object], Table]) -> Table:
        schema = handler(source)
        if schema["type"] == "dataclass":  # it can be a table, whose values are not converted nevertheless
            schema["strict"] = False
        return schema

    group.__get_pydantic_core_schema__ = classmethod(accept_tables)  # type: ignore[attr-defined]
    decorated: Any = pydantic.dataclasses.dataclass(frozen=True, kw_only=True, config=_CONFIG)(group)
    initialise = decorated.__init__
    _describe(decorated)

    def __init__(self: _Group, *args: object, **given: object) -> None:  # noqa: N807
        by_place = dict(zip(fields_of(decorated), args, strict=False))
        values = {name: plain(value) for name, value in (by_place | given).items()}
        try:
            initialise(self, **values)
        except ValidationError as error:
            raise mistakes_of(error, values, group=decorated)[0] from None

    decorated.__init__ = __init__
    return decorated  # type: ignore[no-any-return]


def _describe(group: type) -> None:
    """Give each field of a group its description in one line, from its class or the one below it that states it."""
    for name, field in fields_of(group).items():
        stated = (getattr(kind, "__pydantic_fields__", {}).get(name) for kind in group.__mro__)
        described_by = next((one for one in stated if one is not None and one.description), field)
        field.description = " ".join((described_by.description or "").split())


def fields_of(group: object) -> Table:
    """Fields of a group of options, by name: annotation, default and description."""
    return dict(vars(group)["__pydantic_fields__"])


def flat_options(group: Callable[..., object], function: Callable[..., _Result]) -> Callable[..., _Result]:
    """The function with the fields of a group of options as keyword arguments, instead of its argument ``options``.

    Its signature and its docstring list them; the line ``options:`` of the docstring is replaced.
    """
    direct = [one for name, one in inspect.signature(function).parameters.items() if name != "options"]
    names = {parameter.name for parameter in direct}

    @wraps(function)
    def flat(*args: object, **given: object) -> _Result:
        stated = {name: given.pop(name) for name in names & given.keys()}
        return function(*args, **stated, options=group(**given))

    kind, annotations = inspect.Parameter.KEYWORD_ONLY, get_type_hints(group)  # as users read them, without bounds
    of_group = [
        inspect.Parameter(
            name,
            kind,
            default=inspect.Parameter.empty if field.is_required() else field.get_default(),
            annotation=annotations[name],
        )
        for name, field in fields_of(group).items()
    ]
    flat.__signature__ = inspect.Signature([*direct, *of_group])  # type: ignore[attr-defined]
    flat.__doc__ = _with_options(inspect.getdoc(function) or "", group)
    return flat


def _with_options(text: str, group: object) -> str:
    """A docstring in which the line ``options:`` is replaced by the options of a group; without text, only these."""
    entries = (f"{name}: {field.description}" for name, field in fields_of(group).items())
    listed = [fill(entry, 116, initial_indent=" " * 4, subsequent_indent=" " * 8) for entry in entries]
    before, _, after = (text or "Args:\n    options: Options.").partition("    options:")
    return "\n".join([before.removesuffix("\n"), *listed, *after.splitlines()[1:]])


def validate(group: type[_Result], data: Mapping[str, object], source: str) -> _Result:
    """Parsed TOML as a group of options; an error has a line for each mistake in ``source``."""
    try:
        return TypeAdapter(group).validate_python(data, context={"file": source})
    except ValidationError as error:
        lines = [f"{printable(source)}: {one_line(mistake)}" for mistake in mistakes_of(error, data, group=group)]
        more = [f"{source}: {len(lines) - _MAX_LINES} more mistakes"] if len(lines) > _MAX_LINES else []
        raise MistakesError("\n".join([*lines[:_MAX_LINES], *more])) from error


def read_json(path: Path, what: str) -> Table:
    """Read a table from a JSON file of a kind, at most 1 GB."""

    def refuse(name: str) -> float:
        raise ValueError(f"{name} is not a JSON number")

    try:
        data = json.loads(read_text(path, at_most=_MAX_JSON_BYTES), parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not a {what}: {error}") from error
    if not isinstance(data, dict):
        raise ValueError(f"{path}: not a {what}: expected a table, got {type(data).__name__}")
    return data
