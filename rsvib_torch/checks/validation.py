"""Groups of options, also those of files: their checks, and one line for each mistake.

The class of a group is the only place that states an option: its type, bounds and default, and its description in the
text below the field. ``options`` makes a class such a group. Python arguments, keys of TOML files and options of the
command line are checked by it, and ``mistakes_of`` translates what pydantic reports for all of them.
"""

import inspect
import json
from collections.abc import Callable, Iterable, Mapping
from functools import wraps
from pathlib import Path
from textwrap import fill
from typing import Annotated, Any, TypeVar, dataclass_transform, get_type_hints

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

from rsvib_torch.checks.values import MAX_NUMBER, mistakes_of, plain
from rsvib_torch.files.reading import Table, read_text
from rsvib_torch.text import one_line

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
        if schema["type"] == "dataclass":  # it can be a table, whose values are not converted nevertheless
            schema["strict"] = False
        return schema

    group.__get_pydantic_core_schema__ = classmethod(accept_tables)  # type: ignore[attr-defined]
    made: Any = pydantic.dataclasses.dataclass(frozen=True, kw_only=True, config=_CONFIG)(group)
    initialise = made.__init__
    _describe(made)

    def __init__(self: _Group, *args: object, **given: object) -> None:  # noqa: N807
        by_place = dict(zip(fields_of(made), args, strict=False))
        values = {name: plain(value) for name, value in (by_place | given).items()}
        try:
            initialise(self, **values)
        except ValidationError as error:
            raise mistakes_of(error, values, group=made)[0] from None

    made.__init__ = __init__
    return made  # type: ignore[no-any-return]


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


def validate(group: type[_Result], data: Mapping[str, object], source: str, path: str = "") -> _Result:
    """Parsed TOML or JSON as a group of options; an error has a line for each mistake in ``source``.

    ``path`` names the table of the source that ``data`` is.
    """
    try:
        return TypeAdapter(group).validate_python(data, context={"file": source})
    except ValidationError as error:
        mistakes = mistakes_of(error, data, path, group)
        lines = [f"{source}: {one_line(mistake)}" for mistake in mistakes]
        more = [f"{source}: {len(lines) - _MAX_LINES} more mistakes"] if len(lines) > _MAX_LINES else []
        raise MistakesError([*lines[:_MAX_LINES], *more]) from error


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
