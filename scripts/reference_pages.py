#!/usr/bin/env python
"""Write configuration.md (keys of the TOML file), commands.md, reasons.md and the packages of architecture.md in docs/.

Types, defaults and descriptions come from the groups of options and the parameters of the commands, reasons from their
table in results/reason.py. A test fails if the pages are out of date.
"""

import argparse
import inspect
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import harness
from architecture import table_of_packages

from rsvib_torch.checks.values import fields_of, members_of
from rsvib_torch.commands.main import app
from rsvib_torch.motion.timing import SensorSection
from rsvib_torch.options import METHOD_OPTIONS, OpticsOptions, RestorationOptions, ToneOptions, WindowOptions
from rsvib_torch.results.reason import GROUPS

ROOT = Path(__file__).resolve().parents[1]
NOTE = "<!-- Written by scripts/reference_pages.py: change the docstrings and help texts, then run make pages. -->"
CONFIGURATION = f"""{NOTE}

# Configuration

A TOML file describes a camera and the processing of its frames. `rsvib init FRAMES` writes one. Only `[sensor]` is
required. The options `--row-time`, `--exposure`, `--frame-rate`, `--scan-axis` and `--readout-direction` of the
[commands](commands.md) replace keys of `[sensor]`, or the file. Unknown keys and wrong values are errors, one line
each, with the path of the key, its value and the expected value.
"""
SENSOR = """The camera. Exposure and frame period are in seconds (`exposure_time`, `frame_rate`) or in row times
(`exposure_rows`, `frame_rows`); both keys of a pair may be given if they agree within 0.1 %.
[Your own camera](your_own_camera.md) explains how to find the values."""
SATURATION = "`saturation` is in the unit of the file."
COMMANDS = f"""{NOTE}

# Commands

`rsvib COMMAND --help` prints the same. A time is in seconds, with a unit (`14.6us`, `2ms`) or as a fraction (`1/500`).
Exit code 0: done; 2: an error of the input or the options, one line on standard error; 3: done, but an axis of
`--require-reliable` is not reliable; 130: stopped by Ctrl-C.
"""
REASONS_PAGE = f"""{NOTE}

# Reasons

`findings` of a result has a `Reason` for everything that contradicts it: of detections in one tuple for each axis, of
a restoration in one for each pair of frames. A reason has a `code`, an `axis` (`"x"`, `"y"`, `"roll"`, `"zoom"`, or
None for all), the compared `value`, its `limit` in the same unit, and `details`, the other numbers of its text.
`reasons` has the texts. JSON files and `--json` contain both. The values in braces below are filled in, and parts in
square brackets are omitted where they do not apply. [Verdicts](verdicts.md) explains how the limits were chosen.
"""


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """A Markdown table of texts of docstrings."""
    return harness.table(
        heads, ([" ".join(cell.replace("``", "`").split()).replace("|", "\\|") for cell in row] for row in rows)
    )


def value_text(value: object) -> str:
    """A value as in a TOML file; empty for none."""
    if value is None or value is inspect.Parameter.empty:
        return ""
    text = str(value).lower() if isinstance(value, bool) else repr(value)
    return "`" + text.replace("'", '"') + "`"


def type_text(annotation: object) -> str:
    """A type in words."""
    names = {float: "a number", int: "a whole number", str: "text", bool: "true or false"}
    words = []
    for member in members_of(annotation):
        items = [members_of(item)[0] for item in get_args(member) if get_origin(member) in (list, tuple)]
        kinds = [names.get(item, "a list").removeprefix("a ") + "s" for item in items]
        if get_origin(member) is Literal:
            words += [f'"{choice}"' if isinstance(choice, str) else str(choice) for choice in get_args(member)]
        elif kinds:
            words.append(f"a list of {kinds[0]}" if len(kinds) == 1 else f"{len(kinds)} {kinds[0]}")
        else:
            words.append(names.get(member) or f"a table with {', '.join(fields_of(member))}")
    return " or ".join(words)


def key_table(group: Any, keys: Iterable[str] = ()) -> list[str]:
    """Table of the keys of a group of options or section, by default of all."""
    rows = []
    for name in keys or fields_of(group):
        field = fields_of(group)[name]
        shown = "required" if field.is_required() else value_text(field.get_default(call_default_factory=True))
        rows.append([f"`{name}`", type_text(field.annotation), shown, field.description])
    return table(("key", "type", "default", "meaning"), rows)


def configuration_page() -> str:
    """Markdown of the reference of the configuration file."""
    lines = [CONFIGURATION, "## [sensor]", "", SENSOR, ""]
    lines += key_table(SensorSection)
    lines += ["## [detection]", "", "Options of `detect_vibration`.", "", *key_table(ToneOptions)]
    lines += ["## [restoration]", "", f"Options of `restore` for all methods. {SATURATION}", ""]
    lines += key_table(RestorationOptions, ("method", "saturation"))
    for name, group in METHOD_OPTIONS.items():
        lines += [f'Options of `method = "{name}"`:', "", *key_table(group)]
    lines += ["## [restoration.optics]", "", "Optics of the camera, see `optics`.", "", *key_table(OpticsOptions)]
    lines += ["## [stack]", "", "Processing of stacks in windows.", "", *key_table(WindowOptions)]
    return "\n".join(lines)


def parameter_row(parameter: inspect.Parameter) -> list[str]:
    """Name with its value, default and meaning of an argument or option of a command."""
    kind, info = get_args(parameter.annotation)
    names = {"float": "NUMBER", "int": "NUMBER", "str": "TEXT", "Path": "PATH"}
    types = [member for member in get_args(kind) or (kind,) if member is not type(None)]
    choices = get_args(types[0]) or (types if isinstance(types[0], str) else ())
    choices = [choice for choice in choices if isinstance(choice, str)]
    value = info.metavar or "|".join(choices) or names.get(getattr(types[0], "__name__", ""), "TEXT")
    option, *_ = info.param_decls or [None]
    text = parameter.name.upper() if option is None else option if types == [bool] else f"{option} {value}"
    required = parameter.default is inspect.Parameter.empty
    stated = "" if parameter.default in (None, False) else f"`{parameter.default}`"
    default = info.show_default if isinstance(info.show_default, str) else stated
    return [f"`{text}`", "required" if required else default, info.help or ""]


def command_page() -> str:
    """Markdown of the reference of the commands."""
    lines = [COMMANDS]
    for command in app.registered_commands:
        assert command.callback is not None
        name = command.name or command.callback.__name__
        signature = inspect.signature(command.callback, eval_str=True)
        parameters = [each for each in signature.parameters.values() if hasattr(each.annotation, "__metadata__")]
        words = [
            each.name.upper() if each.default is inspect.Parameter.empty else f"[{each.name.upper()}]"
            for each in parameters
            if not get_args(each.annotation)[1].param_decls
        ]
        lines += [f"## rsvib {name}", "", "```text", " ".join(["rsvib", name, *words, "[OPTIONS]"]), "```", ""]
        lines += [inspect.getdoc(command.callback) or "", ""]
        lines += table(("argument or option", "default", "meaning"), map(parameter_row, parameters))
    return "\n".join(lines)


def reasons_page() -> str:
    """Markdown of the table of reasons."""
    lines = [REASONS_PAGE]
    for title, kinds in GROUPS.items():
        heads = ("code", "value, limit", "unit", "refuses", "text", "remedy")
        rows = [
            [f"`{code}`", kind.compares, kind.unit, kind.refuses, kind.sentence, kind.remedy]
            for code, kind in kinds.items()
        ]
        lines += [f"## {title}", "", *table(heads, rows)]
    return "\n".join(lines)


def pages() -> dict[Path, str]:
    """Text of the pages, by path."""
    docs = ROOT / "docs"
    architecture = docs / "architecture.md"
    return {
        docs / "configuration.md": configuration_page(),
        docs / "commands.md": command_page(),
        docs / "reasons.md": reasons_page(),
        architecture: harness.with_generated_part(architecture.read_text(encoding="utf-8"), table_of_packages()),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.parse_args(arguments)
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")
        print(path)


if __name__ == "__main__":
    main()
