"""What the command line shows: progress, the result in words, warnings and errors in one line each."""

import math
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

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

from rsvib_torch.detection import DetectionResult

__all__ = ["counting", "error_line", "say", "show_result", "warnings_in_one_line", "working"]


def say(message: str) -> None:
    """Print one line to standard output; brackets in file names are no markup, long lines are not broken."""
    Console(highlight=False).print(Text(message), soft_wrap=True)


def error_line(message: str, kind: str = "error") -> None:
    """Print one line (or one a mistake) to standard error."""
    console = Console(stderr=True, highlight=False)
    for line in message.splitlines() or [""]:
        console.print(Text.assemble(("rsvib: ", "bold"), (f"{kind}: ", "bold red"), line), soft_wrap=True)


@contextmanager
def warnings_in_one_line() -> Iterator[None]:
    """Show Python's warnings without file and source line."""

    def show(message: Any, *_: Any, **__: Any) -> None:
        error_line(" ".join(str(message).split()), "warning")

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


@contextmanager
def working(what: str) -> Iterator[None]:
    """Show a moving bar and the time while ``what`` goes on; on a terminal only, and gone afterwards."""
    console = Console(stderr=True)
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=30),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        progress.add_task(what, total=None)
        yield


class _RateColumn(ProgressColumn):
    """Frames a second."""

    def render(self, task: Task) -> Text:
        """The rate, once it is known."""
        rate = task.finished_speed or task.speed
        return Text("" if rate is None else f"{rate:.2f} frames/s")


@contextmanager
def counting(what: str) -> Iterator[Callable[[int, int], None]]:
    """Show how many frames are done, their rate and the time that is left; on a terminal only, and gone afterwards.

    Yields:
        A function to call with the number of frames that are done, and of all.
    """
    console = Console(stderr=True)
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=30),
        MofNCompleteColumn(),
        _RateColumn(),
        TimeRemainingColumn(),
    )
    shown = Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal, speed_estimate_period=300.0
    )
    with shown as progress:
        task: Any = None

        def show(done: int, total: int) -> None:
            nonlocal task
            if task is None:  # frames of an earlier run do not count for the rate
                task = progress.add_task(what, total=total, completed=done)
            else:
                progress.update(task, completed=done)

        yield show


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "∞"


def _measured(value: float, std: float) -> str:
    """A value with its standard deviation, to the digits that the latter leaves."""
    digits = 2
    if math.isfinite(std) and std > 0:
        digits = min(6, max(0, 1 - math.floor(math.log10(std))))
    return f"{_number(value, digits)} ± {_number(std, digits)}"


def show_result(result: DetectionResult) -> None:
    """Print a detection as a table with one line a tone, and the verdict on each axis in words."""
    vibration, std = result.vibration, result.std
    heads = ("axis", "amplitude (px)", "frequency (Hz)", "period (ms)", "phase (π)", "gain")
    table = Table(*heads, title="Vibration", title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for axis, name in enumerate("xy"):
        for tone in range(vibration.amplitude.shape[-1]):
            at = (axis, tone)
            if tone > 0 and not float(vibration.amplitude[at]) > 0:
                continue
            table.add_row(
                name,
                _measured(float(vibration.amplitude[at]), float(std.amplitude[at])),
                _measured(float(vibration.frequency[at]), float(std.frequency[at])),
                _measured(1e3 * float(vibration.period[at]), 1e3 * float(std.period[at])),
                _measured(float(vibration.phase[at]) / math.pi, float(std.phase[at]) / math.pi),
                _number(float(result.gain[at]), 2),
            )
    width = None if Console().is_terminal else 100
    Console(highlight=False, width=width).print(table)
    for axis, name in enumerate("xy"):
        motion = _measured(float(vibration.image_motion[axis]), float(std.image_motion[axis]))
        line = f"{name}: residual {float(result.residual[axis]):.4f} px, image motion {motion} px/s; "
        verdict = "reliable" if bool(result.reliable[axis]) else f"not reliable: {'; '.join(result.reasons[axis])}"
        say(line + verdict)
