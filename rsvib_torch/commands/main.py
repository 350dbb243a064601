"""The ``rsvib`` program: its commands, and one line for every error."""

import logging
import sys
from collections.abc import Sequence
from typing import Annotated

import typer

import rsvib_torch
from rsvib_torch.commands import motion_commands, stack_commands
from rsvib_torch.commands.init import init
from rsvib_torch.commands.terminal import error_line, print_line, warnings_in_one_line

__all__ = ["main", "run_command"]

app = typer.Typer(name="rsvib", add_completion=False, pretty_exceptions_enable=False)
app.command()(init)
app.command()(stack_commands.run)
app.command()(stack_commands.detect)
app.command("restore")(stack_commands.restore_frames)
app.command()(stack_commands.report)
app.command()(motion_commands.motion)
app.command()(motion_commands.known)
app.command()(motion_commands.calibrate)
app.command()(stack_commands.simulate)

_INTERRUPTED = 130  # exit code of typer after Ctrl-C; older versions raise Abort


def _show_version(wanted: bool) -> None:
    if wanted:
        print_line(f"rsvib {rsvib_torch.__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Measure and remove the vibration of a rolling-shutter camera."""


def run_command(arguments: Sequence[str]) -> int:
    """Run ``rsvib`` with these arguments.

    Returns:
        Exit code: 0; 2 after an error that the user can correct, which is one line on standard error; 130 after
        Ctrl-C.
    """
    logging.getLogger("tifffile").addHandler(logging.NullHandler())  # damaged files raise an error of this package
    command = typer.main.get_command(app)
    try:
        with warnings_in_one_line():
            try:
                code = command.main(args=list(arguments) or ["--help"], prog_name="rsvib", standalone_mode=False)
            except typer.Abort:
                code = _INTERRUPTED
        if code == _INTERRUPTED:
            kept = "; the completed windows are kept, --resume continues" if "run" in arguments[:1] else ""
            error_line(f"stopped{kept}")
        return code if isinstance(code, int) else 0
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        error_line(f"{place}{error.strerror}" if error.strerror else str(error) or type(error).__name__)
    except (ValueError, TypeError, ModuleNotFoundError) as error:
        error_line(str(error) or type(error).__name__)
    except Exception as error:
        if hasattr(error, "format_message"):  # a usage error of click, or of the parser that typer bundles
            error_line(error.format_message().replace("Value error, ", ""))  # added by some versions of typer
        elif isinstance(error, MemoryError) or "allocate" in str(error):
            error_line("not enough memory for a stack of this size: process fewer frames at a time")
        else:
            raise
    return 2


def main() -> None:
    """Entry point of the ``rsvib`` program."""
    sys.exit(run_command(sys.argv[1:]))
