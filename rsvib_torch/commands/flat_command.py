"""Commands as functions of a group of options, whose fields are the arguments and options of the command line."""

import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin

import typer
from pydantic import Field
from typer.models import ArgumentInfo, OptionInfo

from rsvib_torch.checks.values import fields_of, members_of, options
from rsvib_torch.commands.terminal import Answer, current_output, error_line, show_answer
from rsvib_torch.files.reading import Table
from rsvib_torch.options import COMMAND_LINE

Group = TypeVar("Group")
_NOT_RELIABLE = 3  # exit code


def argument(default: object = ..., **form: Any) -> Any:
    """An argument of a command; ``form`` has arguments of ``typer.Argument``."""
    return Field(default, json_schema_extra={"positional": True, **form})


def option(default: object, *names: str, **form: Any) -> Any:
    """An option of a command that is not named as its field, or has arguments ``form`` of ``typer.Option``."""
    return Field(default, json_schema_extra={"names": list(names), **form})


@dataclass(frozen=True)
class Given:
    """Mark of a field of a command: a dictionary of those options of another group that are given."""

    group: type  # the group
    names: tuple[str, ...] = ()  # its options; by default those whose fields are marked by ``COMMAND_LINE``
    default: str = ""  # where the default comes from, before that of the group
    context: str = ""  # what comes before the description of each
    # for options that are stated in another form than the field: arguments of ``option``
    forms: Mapping[str, Table] = field(default_factory=dict)

    def parameters(self) -> Iterator[inspect.Parameter]:
        """The options as parameters, in the order of the group."""
        for name, stated in fields_of(self.group).items():
            marked = not self.names and stated.json_schema_extra == COMMAND_LINE
            if name in self.names or name in self.forms or marked:
                usual = [self.default] * bool(self.default)
                if not stated.is_required() and stated.default not in (None, False, "auto"):
                    usual.append(str(stated.default))
                # the first sentence of the description
                text = re.split(r"(?<=\.) (?=[A-Z])", stated.description.replace("``", "").replace('"', ""))[0]
                text = self.context + text[0].lower() + text[1:] if self.context else text
                form = {"help": text, "show_default": ", or ".join(usual) or False}
                yield _parameter(name, stated.annotation, None, {**form, **self.forms.get(name, {})})


@options
class _OutputOptions:
    """Options of all commands; ``--debug`` is read where errors are printed."""

    as_json: bool = option(False, "--json")
    """Print the answer as JSON on standard output, and nothing else there."""
    quiet: bool = option(False, "--quiet", "-q")
    """Print nothing but warnings and errors, and no progress."""
    debug: bool = False
    """Print the traceback of an error."""


def _number_or_word(words: tuple[str, ...], text: str) -> object:
    """Value of an option that is a number or one of some words, which are the same in capitals."""
    try:
        return text.lower() if text.lower() in words else float(text)
    except ValueError as error:
        raise typer.BadParameter(f"expected a number or {' or '.join(words)}, got {text!r}") from error


def _parameter(name: str, annotation: object, default: object, form: Table) -> inspect.Parameter:
    """A field as typer reads it; the group checks bounds, and has alternatives such as "auto" that options lack."""
    form = {"show_default": True, **form}
    members = members_of(annotation)
    choices = tuple(choice for kind in members if get_origin(kind) is Literal for choice in get_args(kind))
    plain = [kind for kind in members if get_origin(kind) is not Literal]
    if choices and float in plain:  # a number, or a word
        form = {"parser": partial(_number_or_word, choices), "metavar": "|".join(("NUMBER", *choices)), **form}
    kind: Any = str if str in plain else plain[-1] if plain else type(choices[0])
    kind = Literal[choices] if not plain and kind is str else kind
    info: ArgumentInfo | OptionInfo
    if form.pop("positional", False):
        info = ArgumentInfo(default=..., **form)
    else:
        names = form.pop("names", None) or [f"--{name.replace('_', '-')}"]
        info = OptionInfo(default=..., param_decls=names, **form)
    default = False if default is None and kind is bool else default
    kind = Annotated[kind | None if default is None else kind, info]
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)


def _parameters(group: type) -> Iterator[tuple[str, inspect.Parameter]]:
    """Name of each field of a command with its parameters: arguments, own options, then those that commands share."""
    depth = {name: place for place, kind in enumerate(group.__mro__) for name in inspect.get_annotations(kind)}
    fields = fields_of(group)
    forms = {name: {"help": stated.description, **(stated.json_schema_extra or {})} for name, stated in fields.items()}
    for name in sorted(fields, key=lambda name: -1 if forms[name].get("positional") else depth[name]):
        stated = fields[name]
        mark = next((mark for mark in stated.metadata if isinstance(mark, Given)), None)
        if mark is not None:
            yield from ((name, parameter) for parameter in mark.parameters())
        else:
            default = inspect.Parameter.empty if stated.is_required() else stated.default
            yield name, _parameter(name, stated.annotation, default, forms[name])


def flat_command(name: str, command: Callable[[Group], Answer]) -> Callable[..., None]:
    """A command as typer calls it: its options are flat, and its answer is printed."""
    (group,) = (parameter.annotation for parameter in inspect.signature(command, eval_str=True).parameters.values())
    fields = list(_parameters(group))
    declared = {one.name: get_args(one.annotation)[1].param_decls for _, one in fields}
    names = {name: stated[0] for name, stated in declared.items() if stated}  # without arguments

    def flat(**given: object) -> None:
        values: Table = {}
        for place, parameter in fields:
            value = given[parameter.name]
            if place == parameter.name:
                values[place] = value
                continue
            of_group = values.setdefault(place, {})
            if value is not None and value is not False:
                of_group[parameter.name] = value
        output = current_output()
        output.as_json, output.quiet = bool(given["as_json"]), bool(given["quiet"])
        # a configuration file has keys of the same names
        only = [name for name, value in given.items() if value is not None] if given.get("config") else names
        output.names = {name: option for name, option in names.items() if name in only}
        answer = command(group(**values))
        show_answer(name, answer)
        required = values.get("require_reliable") or ""
        missed = [axis for axis in required.split(",") if required and not answer.reliable.get(axis)]
        if missed:
            error_line(f"--require-reliable: {' and '.join(missed)} not reliable; the files are complete")
            raise typer.Exit(_NOT_RELIABLE)

    parameters = [parameter for _, parameter in (*fields, *_parameters(_OutputOptions))]
    flat.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    flat.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    flat.__doc__ = command.__doc__
    return flat
