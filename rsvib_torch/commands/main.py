"""The ``rsvib`` program: its commands, and one line for every error."""

import io
import logging
import re
import sys
import traceback
from collections.abc import Callable, Sequence
from typing import Annotated

import typer

import rsvib_torch
from rsvib_torch.checks.values import MistakesError
from rsvib_torch.commands.camera_commands import calibrate, cameras, init
from rsvib_torch.commands.flat_command import flat_command
from rsvib_torch.commands.live_command import live_session
from rsvib_torch.commands.run_stack import run
from rsvib_torch.commands.stack_commands import detect, motion, restore
from rsvib_torch.commands.terminal import Answer, current_output, error_line, print_line, running, warnings_in_one_line

_COMMANDS: dict[str, Callable[..., Answer]] = {  # in the order of the help
    "init": init,
    "cameras": cameras,
    "run": run,
    "detect": detect,
    "restore": restore,
    "motion": motion,
    "calibrate": calibrate,
    "live": live_session,
}
_EXAMPLES = """
  rsvib init frames.tif --row-time 14.6us --exposure 1/500 \\
        --frame-rate 29.97 --full-scale 4095
  rsvib init clip.mp4 --camera "iPhone 12" --exposure 1/500
  rsvib cameras iphone 12
  rsvib run frames.tif results --config camera.toml --report
  rsvib run long.tif results --config camera.toml --memory 2GB --resume
  rsvib detect frames.tif --config camera.toml --out found
  rsvib restore frames.tif restored.tif --config camera.toml \\
        --vibration found/vibration.json
  rsvib motion frames.tif --config camera.toml --out motion.csv
  rsvib restore frames.tif restored.tif --config camera.toml \\
        --motion gyroscope.csv --unit rad/s --focal-length 1800
  rsvib calibrate led.mp4 --frequency 1000 --frame-rate 29.97 \\
        --out camera.toml
  rsvib calibrate clip.mp4 --by-motion --frame-rate 30 --out camera.toml
  rsvib live 0 --config camera.toml --out still.mp4
  rsvib live rtsp://camera/stream --config camera.toml --out still.mkv \\
        --steady 1
"""
_SETTINGS = {"help_option_names": ["-h", "--help"], "max_content_width": 120}  # characters


# plain help texts: rich would read [sensor] as markup and join the lines of the examples
app = typer.Typer(name="rsvib", rich_markup_mode=None, context_settings=_SETTINGS, pretty_exceptions_enable=False)
for _name, _function in _COMMANDS.items():
    _examples = re.findall(rf"^  rsvib {_name} .*(?:\n    .*)*", _EXAMPLES, flags=re.MULTILINE)
    app.command(
        _name,
        short_help=(_function.__doc__ or "").partition("\n")[0],
        epilog="\n".join(["\b\nExamples:", *_examples]),  # \b keeps the lines
        context_settings=_SETTINGS,
    )(flat_command(_name, _function))

_OUT_OF_MEMORY = ("MemoryError", "allocate", "out of memory")  # parts of the types and texts of such errors
_INTERRUPTED = 130  # exit code of typer after Ctrl-C; older versions raise Abort


@app.callback(invoke_without_command=True)
def _options(version: Annotated[bool, typer.Option("--version", help="Show the version and exit.")] = False) -> None:
    """Measure and remove the vibration of a rolling-shutter camera."""
    if version:
        print_line(f"rsvib {rsvib_torch.__version__}")
        raise typer.Exit


def run_command(arguments: Sequence[str]) -> int:
    """Run ``rsvib`` with these arguments; the exit code is returned.

    It is 0; 2 after an error, which is one line on standard error (``--debug`` prints the traceback before it); 3 if an
    axis of ``--require-reliable`` is not reliable; 130 after Ctrl-C.
    """
    logging.getLogger("tifffile").addHandler(logging.NullHandler())  # damaged files raise an error of this package
    command = typer.main.get_command(app)
    with running(arguments), warnings_in_one_line():
        try:
            code = command.main(args=list(arguments) or ["--help"], prog_name="rsvib", standalone_mode=False)
        except typer.Abort:
            code = _INTERRUPTED
        except Exception as error:
            if "--debug" in arguments:
                traceback.print_exc()
            for line in _lines_of(error):
                error_line(line)
            return 2
        if code == _INTERRUPTED:
            work = current_output().work
            is_kept = work is not None and work.exists()
            error_line("stopped; --resume continues behind the windows that are complete" if is_kept else "stopped")
    return code if isinstance(code, int) else 0


def _lines_of(error: Exception) -> Sequence[str]:
    """What is printed about an error: one line, or one for each mistake in a file."""
    if isinstance(error, MistakesError):
        return str(error).splitlines()
    if isinstance(error, OSError) and error.strerror:
        return [f"{error.filename}: {error.strerror}" if error.filename else error.strerror]
    if isinstance(error, (OSError, ValueError, TypeError, ModuleNotFoundError)):
        return [str(error) or type(error).__name__]
    if hasattr(error, "format_message"):  # a usage error of click, or of the parser that typer bundles
        message = " ".join(error.format_message().split()).replace("Value error, ", "")  # of some versions of typer
        several = "; give a sequence of files as their folder" if "unexpected extra argument" in message else ""
        return [f"{message}{several}"]
    text = f"{type(error).__name__}: {' '.join(str(error).split())[:500]}"
    if any(part in text for part in _OUT_OF_MEMORY):
        return ["not enough memory for a stack of this size: process fewer frames at a time"]
    return [f"unexpected {text} (--debug prints the traceback)"]


def main() -> None:
    """Entry point of the ``rsvib`` program."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal that cannot show a character shows its escape
            stream.reconfigure(errors="backslashreplace")
    sys.exit(run_command(sys.argv[1:]))


if __name__ == "__main__":
    main()
