"""Checks of tables from TOML and JSON files against types, with one line per mistake."""

import json
import types
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from pydantic import BaseModel, ConfigDict, ValidationError, create_model

from rsvib_torch.core.reading import read_text

__all__ = ["MistakesError", "Section", "checked", "expected_text", "options_section", "read_json", "validate"]

_Model = TypeVar("_Model", bound=BaseModel)
_Result = TypeVar("_Result")
_MAX_LINES = 20  # of an error message
_MAX_JSON_BYTES = 10**9  # a manifest has about 2 KB per window
_TYPE_NAMES = {float: "a number", int: "a whole number", str: "text", bool: "true or false"}
_LIST_NAMES: dict[Any, str] = {float: "numbers", int: "whole numbers", str: "texts", bool: "true or false"}


class MistakesError(ValueError):
    """Mistakes in one file.

    Attributes:
        lines: One line for each.
    """

    def __init__(self, lines: Iterable[str]) -> None:
        self.lines = tuple(lines)
        super().__init__("\n".join(self.lines))


class Section(BaseModel):
    """Table with a fixed set of keys and strict types: unknown keys are refused, and values are not converted."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, arbitrary_types_allowed=True)


def options_section(name: str, options: type, **more: Any) -> Any:
    """Create a section with the keys and types of typed options; no key is required.

    Args:
        name: Name of the section class.
        options: ``TypedDict`` or dataclass of the options.
        **more: Types of further keys.

    Returns:
        A subclass of ``Section``. Options that are not in a file are None in it and not in ``model_fields_set``.
    """
    hints = get_type_hints(options) | more
    fields: dict[str, Any] = {key: (kind, None) for key, kind in hints.items()}
    return create_model(name, __base__=Section, **fields)


def checked(build: Callable[..., _Result], *args: Any, **kwargs: Any) -> _Result:
    """Call ``build`` in a validator: pydantic reports ``ValueError`` only, so a ``TypeError`` becomes one."""
    try:
        return build(*args, **kwargs)
    except TypeError as error:
        raise ValueError(str(error)) from error


def validate(model: type[_Model], data: Mapping[str, Any], source: str) -> _Model:
    """Return ``data`` as a ``model``.

    Args:
        model: A ``Section``.
        data: Parsed TOML or JSON.
        source: Name of the file, for the messages.

    Raises:
        ValueError: If a key is missing or unknown, or a value has a wrong type or value: one line for each key, with
            its path, its value and what was expected.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        lines: dict[str, str] = {}
        for mistake in error.errors(include_url=False):
            path, message = _describe(model, data, mistake)
            lines.setdefault(path, f"{source}: {path}: {message}" if path else f"{source}: {message}")
        more = [f"{source}: {len(lines) - _MAX_LINES} more mistakes"] if len(lines) > _MAX_LINES else []
        raise MistakesError([*list(lines.values())[:_MAX_LINES], *more]) from error


def _describe(model: type[BaseModel], data: Any, mistake: Any) -> tuple[str, str]:
    """Path of the key that a mistake of pydantic belongs to, and the message."""
    path = ""
    value: Any = data
    expected: Any = model
    kind, context = mistake["type"], mistake.get("ctx", {})
    for step in mistake["loc"]:
        if isinstance(value, Mapping) and isinstance(step, str):
            keys = _keys(expected)
            if step not in value and step not in keys:
                break  # the rest of the location names a member of a union
            path = f"{path}.{step}" if path else step
            if step not in value:
                return path, f"missing key; expected {expected_text(keys[step])}"
            if kind == "extra_forbidden" and step not in keys:
                return path, f"unknown key; expected one of {', '.join(keys)}"
            value, expected = value[step], keys.get(step, Any)
        elif isinstance(value, list) and isinstance(step, int) and step < len(value):
            path, value = f"{path}[{step}]", value[step]
            expected = next((get_args(member)[0] for member in _members(expected) if get_origin(member) is list), Any)
        else:
            break  # the rest of the location names a member of a union
    if kind == "value_error":
        return path, str(context["error"])
    if kind == "greater_than_equal":
        return path, f"expected at least {context['ge']}, got {value!r}"
    if kind in ("too_short", "too_long"):
        return path, f"expected {context.get('min_length', context.get('max_length'))} entries, got {value!r}"
    return path, f"expected {expected_text(expected)}, got {value!r}"


def _members(annotation: Any) -> tuple[Any, ...]:
    """Members of a union, without None."""
    members = get_args(annotation) if get_origin(annotation) in (Union, types.UnionType) else (annotation,)
    return tuple(member for member in members if member is not type(None))


def _keys(annotation: Any) -> dict[str, Any]:
    """Keys of a section with their types; empty for a table with arbitrary keys."""
    for member in _members(annotation):
        if isinstance(member, type) and issubclass(member, BaseModel):
            return {name: field.annotation for name, field in member.model_fields.items()}
    return {}


def expected_text(annotation: Any) -> str:
    """Description of a type in a message."""
    words: list[str] = []
    for member in _members(annotation):
        if get_origin(member) is Literal:
            words.extend(repr(choice) for choice in get_args(member))
        elif get_origin(member) is list:
            item = _members(get_args(member)[0])[0]
            words.append(f"a list of {_LIST_NAMES.get(item, 'lists' if get_origin(item) is list else 'tables')}")
        elif isinstance(member, type) and issubclass(member, BaseModel):
            words.append(f"a table with {', '.join(member.model_fields)}")
        else:
            words.append(_TYPE_NAMES.get(member, str(member)))
    return " or ".join(dict.fromkeys(words))


def read_json(path: Path, what: str) -> dict[str, Any]:
    """Read a table from a JSON file.

    Args:
        path: The file.
        what: Name of the kind of file, for the messages.

    Raises:
        OSError: If the file cannot be opened.
        ValueError: If it is not JSON or not a table, or larger than 1 GB.
    """
    try:
        text = read_text(path, at_most=_MAX_JSON_BYTES)
        data = json.loads(text, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not a {what}: {error}") from error
    if not isinstance(data, dict):
        raise ValueError(f"{path}: not a {what}: expected a table, got {type(data).__name__}")
    return data


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is not a JSON number")
