"""Terminal output: progress, the answer of a command as text or JSON, and warnings and errors in one line each."""

import os
import re
import shlex
import sys
import textwrap
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path

import typer
from rich import progress
from rich.console import Console

from rsvib_torch.execution.progress import listening
from rsvib_torch.files.reading import Table
from rsvib_torch.text import json_text, one_line, printable, shortened, wrapped


@dataclass
class Answer:
    """What a command found and did: the last thing that it prints."""

    results: dict[str, list[str]]  # titles of the results, and their lines
    data: Table  # the same for ``--json``, values that JSON can store
    files: list[Path] = field(default_factory=list)  # files that were written, the one to open first in front
    next_steps: list[str] = field(default_factory=list)  # what to do next: sentences and commands
    reliable: dict[str, bool] = field(default_factory=dict)  # verdict on each axis, in all windows


@dataclass
class Output:
    """Form of the output of a command, and its notes and warnings so far."""

    command: str | None = None  # the command line, as it can be copied into a shell; None outside of the program
    as_json: bool = False  # print nothing but the answer, as JSON
    quiet: bool = False  # print no answer and no progress
    names: dict[str, str] = field(default_factory=dict)  # options by the arguments of Python that they stand for
    work: Path | None = None  # folder with the complete windows of an interrupted run
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


_outputs: list[Output] = [Output()]  # that of the running command is the last


@contextmanager
def running(arguments: Sequence[str]) -> Iterator[None]:
    """Collect the output of a command line while it runs."""
    _outputs.append(Output(printable(shlex.join(["rsvib", *arguments]))))
    try:
        yield
    finally:
        _outputs.pop()


def current_output() -> Output:
    """The output of the running command."""
    return _outputs[-1]


def print_line(message: str) -> None:
    """Print a text to standard output; long lines are not wrapped, and control codes are escaped."""
    try:
        typer.echo(printable(message, lines=True))
    except OSError as error:  # as of a pipe whose reader has ended, after which typer exits without a message
        # what is left in the buffer would fail again at the exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        problem = f"the answer cannot be written to standard output ({error.strerror})"
        raise OSError(f"{problem}; the files are complete") from error


def show_answer(command: str, answer: Answer) -> None:
    """Print what a command found and did, as text or as JSON."""
    output = _outputs[-1]
    if output.as_json:
        files = [str(path) for path in answer.files]
        content = {"command": command, **answer.data, "files": files, "open_first": files[0] if files else None}
        content |= {"next_steps": answer.next_steps, "notes": output.notes, "warnings": output.warnings}
        print_line(json_text(content))
        return
    if output.quiet:
        return
    notes = {"Notes": output.notes} if output.notes else {}
    for title, lines in {**answer.results, **notes}.items():
        print_line("\n".join([printable(title), *(f"  {line}" for text in lines for line in text.splitlines())]) + "\n")
    if answer.files:
        print_line(f"Files (open {printable(answer.files[0].name)} first)" if len(answer.files) > 1 else "File")
        for folder in dict.fromkeys(path.parent for path in answer.files):
            names = [path.name for path in answer.files if path.parent == folder]
            text = str(folder / names[0]) if len(names) == 1 else f"{folder}: {', '.join(names)}"
            print_line(textwrap.indent(wrapped(printable(text)), "  "))
    if answer.next_steps:
        print_line("\n".join(["", "Next", *(textwrap.indent(step, "  ") for step in answer.next_steps)]))


def note(message: str) -> None:
    """Print a sentence with the answer of the running command: what a file states, or what it does not contain."""
    _outputs[-1].notes.append(printable(shortened(message)))


def error_line(message: str, kind: str = "error") -> None:
    """Print a message to standard error, with the prefix ``rsvib: error:``.

    Control codes are escaped, and long texts are shortened. If nobody reads them, as after the end of a terminal, the
    command continues.
    """
    message = shortened(_with_options(message))
    if kind == "warning":
        _outputs[-1].warnings.append(message)
    with suppress(OSError):
        typer.echo(f"{typer.style(f'rsvib: {kind}:', bold=True)} {printable(message)}", err=True)


def _with_options(message: str) -> str:
    """A message with the options of the running command in place of the arguments of Python."""
    for name, option in _outputs[-1].names.items():
        pattern = rf"\b{name}\b" if "_" in name else rf"^{name}\b(?= must )"  # other names are English words
        message = re.sub(pattern, option, message)
    return message


def warn(message: str) -> None:
    """Print a warning to standard error."""
    error_line(message, "warning")


@contextmanager
def warnings_in_one_line() -> Iterator[None]:
    """Show Python's warnings without file name and source line, each once."""
    shown: set[str] = set()

    def show(message: object, *_: object, **__: object) -> None:
        line = one_line(message)
        if line not in shown:
            shown.add(line)
            warn(line)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


@contextmanager
def working(description: str, *, counts: bool = False) -> Iterator[Callable[[int, int], None]]:
    """Show the progress of a loop, and the elapsed and the remaining time, in a terminal; it is removed at the end.

    With ``counts``, the block calls the function that it gets with the number of processed frames and of all frames;
    otherwise, the loops in it report their steps.
    """
    console = Console(stderr=True)
    text, bar = progress.TextColumn("{task.description}", markup=False), progress.BarColumn(bar_width=10)
    times = (progress.TimeElapsedColumn(), progress.TimeRemainingColumn())
    columns = (progress.SpinnerColumn(), text, bar, progress.MofNCompleteColumn(), *times)
    is_shown = console.is_terminal and not _outputs[-1].quiet
    with progress.Progress(*columns, console=console, transient=True, disable=not is_shown) as shown:
        task = shown.add_task(printable(description), total=None)

        def show(done: int, total: int, unit: str = "frames") -> None:
            if done == 0:  # another loop
                shown.reset(task)
            shown.update(task, description=printable(f"{description} ({unit})"), completed=done, total=total)

        with nullcontext() if counts else listening(show):
            yield show
