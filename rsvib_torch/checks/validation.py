"""Groups of options, also those of files: their checks, and one line for each mistake.

The class of a group is the only place that states an option: its type, bounds and default, and its description in the
text below the field. ``options`` makes a class such a group. Python arguments, keys of TOML files and options of the
command line are checked by it, and ``_mistakes`` translates what pydantic reports for all of them.
"""

import inspect
import json
import os
import types
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from textwrap import fill
from typing import Annotated, Any, Literal, TypeVar, Union, dataclass_transform, get_args, get_origin, get_type_hints

import pydantic
from pydantic import (
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    WrapValidator,
)
from pydantic_core import ErrorDetails, PydanticCustomError

from rsvib_torch.checks.values import MAX_NUMBER, described, named
from rsvib_torch.files.reading import Table, read_text
from rsvib_torch.text import one_line, quoted

_Group = TypeVar("_Group")
_Result = TypeVar("_Result")
_MAX_LINES = 20  # of an error message
_MAX_JSON_BYTES = 10**9  # a manifest has about 2 KB per window
_TYPE_NAMES: dict[object, str] = {
    float: "a number",
    int: "a whole number",
    str: "text",
    bool: "true or false",
    Sequence: "a sequence",
    Mapping: "a dictionary",
    dict: "a dictionary",
    os.PathLike: "a path",
}
_CLASS_NAMES = {"Tensor": "a tensor", "ndarray": "a NumPy array"}
_LIST_NAMES: dict[object, str] = {float: "numbers", int: "whole numbers", str: "texts", bool: "true or false"}
_BOUNDS = {
    "greater_than": "larger than {gt:g}",
    "greater_than_equal": "at least {ge:g}",
    "less_than_equal": "at most {le:g}",
    "finite_number": "finite",
    "too_short": "{min_length} entries",
    "too_long": "{max_length} entries",
}
_NOT_AN_OPTION = "not_an_option"  # kind of mistake that is a TypeError in Python

# Numbers of options: finite, and of a magnitude that a quantity can have.
Number = Annotated[float, Field(ge=-MAX_NUMBER, le=MAX_NUMBER, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, le=MAX_NUMBER, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, le=MAX_NUMBER, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1, le=2**31)]


class MistakesError(ValueError):
    """Mistakes in one file; ``lines`` has one line for each."""

    def __init__(self, lines: Iterable[str]) -> None:
        self.lines = tuple(lines)
        super().__init__("\n".join(self.lines))


# unknown keys are refused, and values are not converted; the text below a field is its description
_CONFIG = ConfigDict(extra="forbid", strict=True, arbitrary_types_allowed=True, use_attribute_docstrings=True)


def _name_of_table(value: object, check: ValidatorFunctionWrapHandler, info: ValidationInfo) -> object:
    """Any text outside of files, which may contain only the names of the package."""
    return value if info.context is None and isinstance(value, str) else check(value)


# Mark of a choice whose names are keys of a table that users extend: the function that uses it refuses unknown names.
Extensible = WrapValidator(_name_of_table)


@dataclass_transform(kw_only_default=True, frozen_default=True, field_specifiers=(Field,))
def options(group: type[_Group]) -> type[_Group]:
    """Make a class a group of options: a frozen dataclass whose values are checked."""

    def accept_tables(_: type, source: object, handler: Callable[[object], Table]) -> Table:
        schema = handler(source)
        fields = schema["schema"] if schema["type"] == "function-after" else schema  # with a validator or without
        if fields["type"] == "dataclass":  # it can be a table, whose values are not converted nevertheless
            fields["strict"] = False
        return schema

    group.__get_pydantic_core_schema__ = classmethod(accept_tables)  # type: ignore[attr-defined]
    made: Any = pydantic.dataclasses.dataclass(frozen=True, kw_only=True, config=_CONFIG)(group)
    initialise = made.__init__
    _describe(made)

    def __init__(self: _Group, *args: object, **given: object) -> None:  # noqa: N807
        by_place = dict(zip(fields_of(made), args, strict=False))
        values = {name: _plain(value) for name, value in (by_place | given).items()}
        try:
            initialise(self, **values)
        except ValidationError as error:
            raise _mistakes(made, values, error)[0].error from None

    made.__init__ = __init__
    return made  # type: ignore[no-any-return]


def _describe(group: type) -> None:
    """Give each field of a group its description in one line, from its class or the one below it that states it."""
    for name, field in fields_of(group).items():
        stated = (getattr(kind, "__pydantic_fields__", {}).get(name) for kind in group.__mro__)
        described_by = next((one for one in stated if one is not None and one.description), field)
        field.description = " ".join((described_by.description or "").split())


def _plain(value: Any) -> Any:
    """NumPy numbers and short arrays as Python numbers and lists."""
    if type(value).__module__ != "numpy" or getattr(getattr(value, "dtype", None), "kind", "-") not in "biuf":
        return value
    return value.tolist() if value.ndim < 2 and value.size < 10 else value


def fields_of(group: type) -> Table:
    """Fields of a group of options, by name: annotation, default and description."""
    return dict(vars(group)["__pydantic_fields__"])


def flat_options(group: Any, function: Callable[..., object]) -> Any:
    """The function with the fields of a group of options as keyword arguments, instead of its argument ``options``.

    Its signature and its docstring list them; the line ``options:`` of the docstring is replaced.
    """
    direct = [one for name, one in inspect.signature(function).parameters.items() if name != "options"]
    names = {parameter.name for parameter in direct}

    @wraps(function)
    def flat(*args: object, **given: object) -> object:
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


def _with_options(text: str, group: type) -> str:
    """A docstring in which the line ``options:`` is replaced by the options of a group; without text, only these."""
    entries = (f"{name}: {field.description}" for name, field in fields_of(group).items())
    listed = [fill(entry, 116, initial_indent=" " * 4, subsequent_indent=" " * 8) for entry in entries]
    before, _, after = (text or "Args:\n    options: Options.").partition("    options:")
    return "\n".join([before.removesuffix("\n"), *listed, *after.splitlines()[1:]])


def not_an_option(name: str, message: str) -> PydanticCustomError:
    """The error of a group for an option that does not go with the others, a ``TypeError`` in Python."""
    return PydanticCustomError(_NOT_AN_OPTION, "{message}", {"name": name, "message": message})


def checked(build: Callable[..., _Result], *args: object, **kwargs: object) -> _Result:
    """Call ``build`` in a validator: pydantic reports ``ValueError`` only, so a ``TypeError`` becomes one."""
    try:
        return build(*args, **kwargs)
    except TypeError as error:
        changed = ValueError(str(error))
        vars(changed).update(vars(error))
        raise changed from error


def validate(model: type[_Result], data: Mapping[str, object], source: str, path: str = "") -> _Result:
    """Parsed TOML or JSON as a group of options; an error has a line for each mistake in ``source``.

    ``path`` names the table of the source that ``data`` is.
    """
    try:
        return TypeAdapter(model).validate_python(data, context={"file": source})
    except ValidationError as error:
        mistakes = _mistakes(model, data, error, path)
        lines = [": ".join(filter(None, (source, one_line(one.path, 200), one.line))) for one in mistakes]
        more = [f"{source}: {len(lines) - _MAX_LINES} more mistakes"] if len(lines) > _MAX_LINES else []
        all_lines = MistakesError([*lines[:_MAX_LINES], *more])
        vars(all_lines).update(vars(mistakes[0].error))  # its argument
        raise all_lines from error


def validated(name: str, value: object, adapter: TypeAdapter[Any], kind: object) -> Any:
    """Return the value of an argument if it is of a kind, as ``adapter`` converts it."""
    try:
        return adapter.validate_python(_plain(value))
    except ValidationError as error:
        raise _mistakes(kind, value, error, name)[0].error from None


@dataclass
class _Mistake:
    """A mistake at one key."""

    path: str  # the key, with the tables around it
    error: Exception  # in Python, with the argument that it is about (``named``)
    line: str  # about a file, without its name and the key
    is_bound: bool = False  # whether the value has the right type and is out of bounds


def _mistakes(model: object, data: object, error: ValidationError, path: str = "") -> list[_Mistake]:
    """The mistakes that pydantic found, one for each key: of the members of a union, that of the fitting type."""
    found: dict[str, _Mistake] = {}
    for entry in error.errors(include_url=False):
        mistake = _mistake(model, data, entry, path)
        if mistake.path not in found or (mistake.is_bound and not found[mistake.path].is_bound):
            found[mistake.path] = mistake
    return list(found.values())


def _mistake(model: object, data: object, entry: ErrorDetails, path: str) -> _Mistake:
    """What an entry of pydantic means: the key at its location, behind that of the data, and what is wrong."""
    value, expected = data, model
    kind, context = entry["type"], entry.get("ctx", {})
    for step in entry["loc"]:
        tables = [member for member in members_of(expected) if get_origin(member) in (Mapping, dict)]
        if isinstance(value, Mapping) and tables:
            path, value, expected = f"{path}[{step!r}]", value.get(step), get_args(tables[0])[1]
        elif isinstance(value, Mapping) and isinstance(step, str):
            keys = _keys(expected)
            if step not in value and step not in keys:
                break  # the rest of the location names a member of a union
            path = f"{path}.{step}" if path else step
            if step not in value:
                expected_value = expected_text(keys[step])
                required = TypeError(f"{path} is required; expected {expected_value}")
                return _Mistake(path, required, f"missing key; expected {expected_value}")
            if kind in ("extra_forbidden", "unexpected_keyword_argument") and step not in keys:
                unknown = TypeError(f"unknown option {quoted(path)}; the options are {', '.join(keys)}")
                return _Mistake(path, unknown, f"unknown key; expected one of {', '.join(keys)}")
            value, expected = value[step], keys.get(step, Any)
        elif isinstance(value, (list, tuple)) and isinstance(step, int) and step < len(value):
            path, value = f"{path}[{step}]", value[step]
            expected = next(_items(expected, step), Any)
        else:
            break  # the rest of the location names a member of a union
    if kind == _NOT_AN_OPTION:
        path, text = ".".join(filter(None, (path, context["name"]))), context["message"]
        return _Mistake(path, TypeError(text), text)
    if kind == "value_error":  # of a validator, which may state its argument
        cause, text = context["error"], str(context["error"])
        argument = ".".join(filter(None, (path, getattr(cause, "argument", ""))))
        return _Mistake(path, named(ValueError(text), argument, getattr(cause, "problem", text)), text)
    members = members_of(expected)
    choices = [repr(name) for member in members if get_origin(member) is Literal for name in get_args(member)]
    stated = _BOUNDS[kind].format(**context) if kind in _BOUNDS else expected_text(expected)
    error: type[Exception] = ValueError
    if choices and kind not in _BOUNDS and all(get_origin(member) is Literal for member in members):
        problem = f"must be one of {', '.join(choices)}; got"
    else:
        or_none = " or None" if kind not in _BOUNDS and type(None) in get_args(expected) else ""
        error = ValueError if kind in _BOUNDS else TypeError
        problem = f"must be {stated.replace('true or false', 'True or False')}{or_none}, got"
    made = named(error(f"{path} {problem} {described(value)}"), path, f"{problem} {quoted(value)}")
    return _Mistake(path, made, f"expected {stated}, got {quoted(value)}", kind in _BOUNDS)


def members_of(annotation: object) -> tuple[Any, ...]:
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


def _items(annotation: object, index: int) -> Iterator[object]:
    """Types that an entry of a list or tuple may have."""
    for member in members_of(annotation):
        if get_origin(member) in (list, tuple, Sequence):
            yield get_args(member)[index if get_origin(member) is tuple and ... not in get_args(member) else 0]


def _keys(annotation: object) -> dict[str, object]:
    """Keys of a table with their types; empty for a table with arbitrary keys."""
    for member in members_of(annotation):
        if isinstance(member, type) and hasattr(member, "__pydantic_fields__"):
            return {name: described.annotation for name, described in fields_of(member).items()}
    return {}


def expected_text(annotation: object) -> str:
    """Description of a type in a message."""
    words: list[str] = []
    for member in members_of(annotation):
        origin, arguments = get_origin(member), get_args(member)
        if origin is Literal:
            words.extend(repr(choice) for choice in arguments)
        elif origin is list or (origin is tuple and arguments[-1] is ...):
            item = members_of(arguments[0])[0]
            words.append(f"a list of {_LIST_NAMES.get(item, 'lists' if get_origin(item) is list else 'tables')}")
        elif origin is tuple:
            words.append(f"{len(arguments)} {_LIST_NAMES.get(members_of(arguments[0])[0], 'values')}")
        elif _keys(member):
            words.append(f"a table with {', '.join(_keys(member))}")
        elif isinstance(member, type) and member not in _TYPE_NAMES:
            name, source = _CLASS_NAMES.get(member.__name__, member.__name__), getattr(member, "_MADE_BY", "")
            article = "" if " " in name else "an " if name[0] in "AEIOU" else "a "
            words.append(f"{article}{name}{source and f' ({source})'}")
        else:
            name = _CLASS_NAMES.get(getattr(origin, "__name__", ""), str(member))
            words.append(_TYPE_NAMES.get(origin or member, name))
    return " or ".join(dict.fromkeys(words))


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
