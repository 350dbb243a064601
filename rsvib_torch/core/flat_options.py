"""Functions whose options are a group, with flat keyword arguments for their callers."""

import inspect
from collections.abc import Callable
from functools import wraps
from textwrap import fill
from typing import Annotated, Any, get_args, get_origin

from rsvib_torch.core.validation import fields_of


def flat_options(
    group: Any, function: Callable[..., Any], build: Callable[..., Any] | None = None
) -> Callable[..., Any]:
    """The function with the fields of a group of options as keyword arguments, instead of its argument ``options``.

    Its signature and its docstring list them; the line ``options:`` of the docstring is replaced. ``build`` makes the
    options of the arguments, if it is not the group.
    """
    direct = [one for name, one in inspect.signature(function).parameters.items() if name != "options"]
    names = {parameter.name for parameter in direct}

    @wraps(function)
    def flat(*args: object, **given: object) -> object:
        own = {name: given.pop(name) for name in names & given.keys()}
        return function(*args, **own, options=(build or group)(**given))

    kind = inspect.Parameter.KEYWORD_ONLY
    of_group = [
        inspect.Parameter(name, kind, default=field.get_default(), annotation=_without_bounds(field.annotation))
        for name, field in fields_of(group).items()
    ]
    flat.__signature__ = inspect.Signature([*direct, *of_group])  # type: ignore[attr-defined]
    flat.__doc__ = _with_options(inspect.getdoc(function) or "", group)
    return flat


def _without_bounds(annotation: Any) -> Any:
    """The annotation of an option as users read it."""
    if get_origin(annotation) is Annotated:
        return _without_bounds(get_args(annotation)[0])
    if arguments := get_args(annotation):
        plain = tuple(map(_without_bounds, arguments))
        return annotation.copy_with(plain) if hasattr(annotation, "copy_with") else annotation
    return annotation


def _with_options(text: str, group: type) -> str:
    """A docstring in which the line ``options:`` is replaced by the options of a group; without text, only these."""
    lines = (text or "Args:\n    options: Options.").splitlines()
    place = next((number for number, line in enumerate(lines) if line.startswith("    options:")), len(lines))
    entries = (f"{name}: {field.description}" for name, field in fields_of(group).items())
    listed = [fill(entry, 116, initial_indent=" " * 4, subsequent_indent=" " * 8) for entry in entries]
    return "\n".join([*lines[:place], *listed, *lines[place + 1 :]])
