"""Tables from files checked against types: one line a mistake, naming the key, the value and what was expected."""

import inspect
import json
import types
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from pydantic import BaseModel, ConfigDict, ValidationError, create_model

__all__ = ["Section", "checked", "options_section", "read_json", "validate"]

_Model = TypeVar("_Model", bound=BaseModel)
_Result = TypeVar("_Result")
_WORDS = {float: "a number", int: "a whole number", str: "text", bool: "true or false"}
_PLURALS: dict[Any, str] = {float: "numbers", int: "whole numbers", str: "texts"}


class Section(BaseModel):
    """A table with known keys and strict types: text is no number, and a key too many is a mistake."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, arbitrary_types_allowed=True)


def options_section(name: str, function: Callable[..., Any], *, skip: tuple[str, ...] = (), **more: Any) -> Any:
    """Section whose keys, types and defaults are the options of a function: they are written down only there.

    Args:
        name: Name of the section class.
        function: Function (its keyword-only parameters count) or dataclass (all of its fields do).
        skip: Parameters that are no keys.
        **more: Further fields as pydantic takes them, ``(type, default)``.

    Returns:
        A subclass of ``Section``.
    """
    hints = get_type_hints(function)
    fields = {
        parameter.name: (hints[parameter.name], ... if parameter.default is parameter.empty else parameter.default)
        for parameter in inspect.signature(function).parameters.values()
        if (parameter.kind is parameter.KEYWORD_ONLY or isinstance(function, type)) and parameter.name not in skip
    }
    return create_model(name, __base__=Section, **{**fields, **more})


def checked(build: Callable[..., _Result], *args: Any, **kwargs: Any) -> _Result:
    """Call ``build`` within a validator: its ``TypeError`` becomes the ``ValueError`` that pydantic reports."""
    try:
        return build(*args, **kwargs)
    except TypeError as error:
        raise ValueError(str(error)) from error


def validate(model: type[_Model], data: Mapping[str, Any], source: str) -> _Model:
    """Return ``data`` as a ``model``.

    Args:
        model: A ``Section``.
        data: Parsed TOML or JSON.
        source: The file, for the messages.

    Raises:
        ValueError: If anything is wrong: one line a mistake.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        lines: dict[str, str] = {}
        for mistake in error.errors(include_url=False):
            path, message = _describe(model, data, mistake)
            lines.setdefault(path, f"{source}: {path}: {message}" if path else f"{source}: {message}")
        raise ValueError("\n".join(lines.values())) from error


def _describe(model: type[BaseModel], data: Any, mistake: Any) -> tuple[str, str]:
    """Key path of a mistake, and what is wrong there."""
    path = ""
    value: Any = data
    expected: Any = model
    unknown = mistake["type"] == "extra_forbidden"
    for step in mistake["loc"]:
        if isinstance(value, Mapping) and isinstance(step, str):
            known = _table(expected)
            if step not in value and step not in known:
                break  # it names a member of a union
            path = f"{path}.{step}" if path else step
            if step not in value:
                return path, f"missing key; expected {_words(known[step])}"
            if unknown and step not in known:
                return path, f"unknown key; expected one of {', '.join(known)}"
            value, expected = value[step], known.get(step, Any)
        elif isinstance(value, list) and isinstance(step, int) and step < len(value):
            path, value = f"{path}[{step}]", value[step]
            expected = next((get_args(kind)[0] for kind in _kinds(expected) if get_origin(kind) is list), Any)
        else:
            break  # what remains names a member of a union
    if mistake["type"] == "value_error":
        return path, str(mistake["ctx"]["error"])
    return path, f"expected {_words(expected)}, got {value!r}"


def _kinds(annotation: Any) -> tuple[Any, ...]:
    """Members of a union, without None."""
    members = get_args(annotation) if get_origin(annotation) in (Union, types.UnionType) else (annotation,)
    return tuple(kind for kind in members if kind is not type(None))


def _table(annotation: Any) -> dict[str, Any]:
    """Keys of a section with their types; those of the values of a free table are empty."""
    for kind in _kinds(annotation):
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            return {name: field.annotation for name, field in kind.model_fields.items()}
    return {}


def _words(annotation: Any) -> str:
    """What a type is called in a message."""
    words: list[str] = []
    for kind in _kinds(annotation):
        if get_origin(kind) is Literal:
            words.extend(repr(choice) for choice in get_args(kind))
        elif get_origin(kind) is list:
            words.append(f"a list of {_PLURALS.get(get_args(kind)[0], 'lists of numbers')}")
        elif isinstance(kind, type) and issubclass(kind, BaseModel):
            words.append(f"a table with {', '.join(kind.model_fields)}")
        else:
            words.append(_WORDS.get(kind, str(kind)))
    return " or ".join(dict.fromkeys(words))


def read_json(path: Path, what: str) -> dict[str, Any]:
    """A table from a JSON file.

    Args:
        path: The file.
        what: What it should be, for the messages.

    Raises:
        OSError: If the file cannot be opened.
        ValueError: If it is not JSON, or not a table.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"), parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not a {what}: {error}") from error
    if not isinstance(data, dict):
        raise ValueError(f"{path}: not a {what}: expected a table, got {type(data).__name__}")
    return data


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is no JSON number")
