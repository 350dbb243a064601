"""Commands whose parameters are groups of options, and their flat options on the command line."""

import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args, get_origin

import typer

from rsvib_torch.commands.terminal import Answer, output_of, show_answer
from rsvib_torch.core.validation import fields_of, members_of
from rsvib_torch.options import COMMAND_LINE

JsonOption = Annotated[
    bool, typer.Option("--json", help="Print the answer as JSON on standard output, and nothing else there.")
]
QuietOption = Annotated[
    bool, typer.Option("--quiet", "-q", help="Print nothing but warnings and errors, and no progress.")
]
DebugOption = Annotated[bool, typer.Option("--debug", help="Print the traceback of an error.")]


@dataclass(frozen=True)
class MadeBy:
    """Mark of a parameter of a command whose value a function makes of several options.

    Attributes:
        build: The function. Those of its arguments that are options take the place of the parameter; others are
            arguments of the command, or None if it has none of their name.
    """

    build: Callable[..., Any]


def _common(*, as_json: JsonOption = False, quiet: QuietOption = False, debug: DebugOption = False) -> None:
    """Options of all commands; ``--debug`` is read where errors are printed."""


def _build_of(parameter: inspect.Parameter) -> Callable[..., Any] | None:
    """The function that makes the value of a parameter; None for an option."""
    marks = (mark for mark in getattr(parameter.annotation, "__metadata__", ()) if isinstance(mark, MadeBy))
    return next((mark.build for mark in marks), None)


def _options_of(function: Callable[..., Any]) -> Iterator[inspect.Parameter]:
    """Options of a command or of a function of ``MadeBy``, and of those that make its arguments."""
    for parameter in inspect.signature(function, eval_str=True).parameters.values():
        if build := _build_of(parameter):
            yield from _options_of(build)
        elif get_origin(parameter.annotation) is Annotated:
            yield parameter


def _called(function: Callable[..., Any], given: Mapping[str, Any]) -> Any:
    """Call a function with the options that are its arguments; those with the mark ``MadeBy`` are made of several."""
    values = {}
    for name, parameter in inspect.signature(function, eval_str=True).parameters.items():
        build = _build_of(parameter)
        values[name] = given.get(name) if build is None else _called(build, given)
    return function(**values)


def flat_command(name: str, command: Callable[..., Answer]) -> Callable[..., None]:
    """A command as typer calls it: its options are flat, and its answer is printed."""

    def flat(**given: Any) -> None:
        with output_of(as_json=given["as_json"], quiet=given["quiet"]):
            show_answer(name, _called(command, given))

    parameters = sorted([*_options_of(command), *_options_of(_common)], key=lambda parameter: parameter.kind)
    flat.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    flat.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    flat.__doc__ = command.__doc__
    return flat


def group_arguments(group: Any, forms: Mapping[str, Any] | None = None) -> Callable[..., dict[str, Any]]:
    """A function for ``MadeBy`` that returns those options of a group that are given on the command line.

    Args:
        group: The group; options whose field is marked by ``COMMAND_LINE`` are options of the command.
        forms: Annotations for typer of further options, and of those that are stated in another form than the field.
    """

    def given_options(**given: Any) -> dict[str, Any]:
        return {name: value for name, value in given.items() if value is not None}

    known = forms or {}
    given_options.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [
            inspect.Parameter(
                name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=known.get(name) or _form(field)
            )
            for name, field in fields_of(group).items()
            if name in known or field.json_schema_extra == COMMAND_LINE
        ]
    )
    return given_options


def _form(field: Any) -> Any:
    """Annotation for typer of an option of a group: a number, or choices; the group checks the value."""
    members = members_of(field.annotation)
    choices = tuple(choice for member in members if get_origin(member) is Literal for choice in get_args(member))
    numbers = [member for member in members if member in (int, float)] or [type(choices[0])]
    kind: Any = Literal[choices] if numbers == [str] else numbers[0]
    text = re.split(r"(?<=\.) (?=[A-Z])", field.description.replace("``", "").replace('"', ""))[0]  # first sentence
    default = "" if field.default in (None, "auto") else f", or {field.default}"
    return Annotated[kind | None, typer.Option(help=text, show_default=f"from the configuration{default}")]
