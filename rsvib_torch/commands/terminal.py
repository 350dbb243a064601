"""Terminal output: progress, results as tables, and warnings and errors in one line each."""

import math
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

from rsvib_torch import report

if TYPE_CHECKING:
    from rsvib_torch.detection import DetectionResult
    from rsvib_torch.stacks import RestoredFrames

__all__ = [
    "counting",
    "error_line",
    "print_detection",
    "print_line",
    "print_restoration",
    "warnings_in_one_line",
    "working",
]


def print_line(message: str) -> None:
    """Print one line to standard output; long lines are not wrapped, and brackets are not markup."""
    Console(highlight=False).print(Text(message), soft_wrap=True)


def error_line(message: str, kind: str = "error") -> None:
    """Print a message to standard error, with the prefix ``rsvib: error:`` on each of its lines."""
    console = Console(stderr=True, highlight=False)
    for line in message.splitlines() or [""]:
        console.print(Text.assemble(("rsvib: ", "bold"), (f"{kind}: ", "bold red"), line), soft_wrap=True)


@contextmanager
def warnings_in_one_line() -> Iterator[None]:
    """Show Python's warnings without file name and source line."""

    def show(message: Any, *_: Any, **__: Any) -> None:
        error_line(" ".join(str(message).split()), "warning")

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


def _progress(*columns: ProgressColumn) -> Progress:
    """A progress bar on standard error that is removed at the end; nothing is shown unless it is a terminal."""
    console = Console(stderr=True)
    description = TextColumn("{task.description}", markup=False)
    return Progress(
        SpinnerColumn(),
        description,
        BarColumn(bar_width=30),
        *columns,
        console=console,
        transient=True,
        disable=not console.is_terminal,
        speed_estimate_period=300.0,  # s; windows of a stack may take minutes each
    )


@contextmanager
def working(description: str) -> Iterator[None]:
    """Show a moving bar and the elapsed time."""
    with _progress(TimeElapsedColumn()) as progress:
        progress.add_task(description, total=None)
        yield


class _RateColumn(ProgressColumn):
    """Frames per second."""

    def render(self, task: Task) -> Text:
        """The rate, empty until it has been measured."""
        rate = task.finished_speed or task.speed
        return Text("" if rate is None else f"{rate:.2f} frames/s")


@contextmanager
def counting(description: str) -> Iterator[Callable[[int, int], None]]:
    """Show the number of processed frames, their rate and the remaining time.

    Yields:
        A function to call with the number of processed frames and the number of all frames.
    """
    with _progress(MofNCompleteColumn(), _RateColumn(), TimeRemainingColumn()) as progress:
        task: Any = None

        def show(done: int, total: int) -> None:
            nonlocal task
            if task is None:  # frames of a resumed run do not count for the rate
                task = progress.add_task(description, total=total, completed=done)
            else:
                progress.update(task, completed=done)

        yield show


def print_detection(result: "DetectionResult") -> None:
    """Print a detection as a table with one line per tone, and the verdict on each axis."""
    vibration, std = result.vibration, result.std
    heads = ("axis", "amplitude (px)", "frequency (Hz)", "period (ms)", "phase (π)", "gain")
    table = Table(*heads, title="Vibration", title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for axis, letter in enumerate("xy"):
        for tone in range(vibration.amplitude.shape[-1]):
            if tone > 0 and not float(vibration.amplitude[axis, tone]) > 0:
                continue
            cells = []
            for name, scale in (("amplitude", 1), ("frequency", 1), ("period", 1e3), ("phase", 1 / math.pi)):
                value, deviation = (scale * getattr(values, name)[axis, tone] for values in (vibration, std))
                cells.append(report.measured_text(value, deviation))
            table.add_row(letter, *cells, f"{float(result.gain[axis, tone]):.2f}")
    Console(highlight=False, width=None if Console().is_terminal else 100).print(table)
    for axis, name in enumerate("xy"):
        motion = report.measured_text(vibration.image_motion[axis], std.image_motion[axis])
        verdict = "reliable" if bool(result.reliable[axis]) else f"not reliable: {'; '.join(result.reasons[axis])}"
        print_line(f"{name}: residual {float(result.residual[axis]):.4f} px, image motion {motion} px/s; {verdict}")


def print_restoration(result: "RestoredFrames") -> None:
    """Print which axes were not restored, and whether restoration helped."""
    for note in result.left_alone:
        print_line(note)
    if not result.moves:
        error_line("no vibration to remove: the frames are written unchanged", "warning")
    elif result.verdict is None:
        print_line("cannot determine whether restoration helps: no two frames show the same scene")
    elif result.verdict.overall in ("partly", "worse"):
        unchanged = "" if result.restored else "; the frames are written unchanged, --force writes the restored ones"
        error_line(result.verdict.summary + unchanged, "warning")
    else:
        print_line(result.verdict.summary)
