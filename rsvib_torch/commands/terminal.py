"""Terminal output: progress, the answer of a command as text or JSON, and warnings and errors in one line each."""

import os
import shlex
import sys
import textwrap
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, SpinnerColumn, Task, TextColumn
from rich.text import Text

from rsvib_torch.execution.progress import listening
from rsvib_torch.files.reading import Table
from rsvib_torch.results.reason import options_of_the_program
from rsvib_torch.text import json_text, printable, shortened, wrapped


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
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


LOG_AFTER = 2.0  # s; commands that take less write no progress to files
_SHOWN_AFTER = 2.0  # s, from which the elapsed time is shown beside that of a loop, which may be one of several

_outputs: list[Output] = [Output()]  # that of the running command is the last


@contextmanager
def running(arguments: Sequence[str]) -> Iterator[None]:
    """Collect the output of a command line while it runs."""
    _outputs.append(Output(printable(shlex.join(["rsvib", *arguments]))))
    try:
        with options_of_the_program():
            yield
    finally:
        _outputs.pop()


def current_output() -> Output:
    """The output of the running command."""
    return _outputs[-1]


def print_line(message: str) -> None:
    """Print a text to standard output; long lines are not wrapped, and control codes are escaped."""
    try:
        print(printable(message, lines=True), flush=True)
    except OSError as error:  # as in a pipe whose reader has ended
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

    Control codes are escaped, and long texts are shortened. Lines are wrapped in a terminal only. If nobody reads them,
    as after the end of a terminal, the command continues.
    """
    message = shortened(message)
    if kind == "warning":
        _outputs[-1].warnings.append(message)
    console = Console(stderr=True, highlight=False)
    line = Text.assemble(("rsvib: ", "bold"), (f"{kind}: ", "bold red"), printable(message))
    with suppress(OSError, SystemExit):  # rich exits if a pipe has no reader
        console.print(line, soft_wrap=not console.is_terminal)


def warn(message: str) -> None:
    """Print a warning to standard error."""
    error_line(message, "warning")


@contextmanager
def warnings_in_one_line() -> Iterator[None]:
    """Show Python's warnings without file name and source line, each once."""
    shown: set[str] = set()

    def show(message: object, *_: object, **__: object) -> None:
        line = " ".join(str(message).split())
        if line not in shown:
            shown.add(line)
            warn(line)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


class _StateColumn(ProgressColumn):
    """Elapsed time, and of loops complete steps, rate and remaining time."""

    def render(self, task: Task) -> Text:
        """The state of a loop, in at most 50 characters."""
        passed = time.monotonic() - task.fields["begun"]
        elapsed = str(timedelta(seconds=int(passed)))
        if task.total is None:
            return Text(elapsed)
        parts = [f"{task.completed:.0f} of {task.total:.0f} {task.fields['unit']}"]
        done, seconds = task.completed - task.fields["first"], task.elapsed or 0.0
        if done > 0 and seconds > 0 and task.completed < task.total:  # not of a loop that is followed by other work
            left = timedelta(seconds=round((task.total - task.completed) * seconds / done))
            parts += [f"{done / seconds:.3g}/s", f"{left} left"]
        return Text("  ".join([*parts, *([f"{elapsed} so far"] if passed >= _SHOWN_AFTER else [])]))


@contextmanager
def working(description: str, *, counts: bool = False) -> Iterator[Callable[[int, int], None]]:
    """Show the elapsed time, and progress, rate and remaining time of a loop; in a terminal it is removed at the end.

    In a log, which is not a terminal, they are lines: the first one after ``LOG_AFTER`` seconds, each of the others
    after twice the time. With ``counts``, the block calls the function that it gets with the number of processed frames
    and of all frames; otherwise, the loops in it report their steps.
    """
    begun, console, quiet = time.monotonic(), Console(stderr=True), _outputs[-1].quiet
    columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), BarColumn(bar_width=10), _StateColumn())
    with Progress(*columns, console=console, transient=True, disable=quiet or not console.is_terminal) as progress:
        task = progress.add_task(printable(description), total=None, begun=begun)

        def show(done: int, total: int, unit: str = "frames") -> None:
            if done == 0 or progress.tasks[0].total is None:  # another loop; resumed frames are not in the rate
                progress.reset(task, total=total, unit=unit, first=done, begun=begun)
            progress.update(task, completed=done)

        ended = threading.Event()

        def write_lines() -> None:
            after = LOG_AFTER
            while not ended.wait(after):  # twice the elapsed time
                error_line(f"{description}: {_StateColumn().render(progress.tasks[0])}", "progress")
                after = time.monotonic() - begun

        if not console.is_terminal and not quiet:
            threading.Thread(target=write_lines, daemon=True).start()
        try:
            with nullcontext() if counts else listening(show):
                yield show
        finally:
            ended.set()
