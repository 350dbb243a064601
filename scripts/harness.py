"""What benchmarks, attacks and the reproduction share: options, timed runs, tables, the machine, stored results.

A section is a module with

* ``OPTIONS``: its options, by name: the default, the help text, and for some the choices. ``QUICK``: values of options
  that ``--quick`` sets, for a run of seconds;
* ``rows(options)``: the figures, one dictionary per case, of numbers, texts, lists and dictionaries;
* ``lines(rows, options)``: the tables in Markdown, without further measurement.

``benchmark.py`` runs sections, ``write_result`` stores their rows, and ``benchmark.py --pages`` makes the pages.
"""

import argparse
import datetime
import json
import math
import os
import platform
import subprocess
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from fractions import Fraction
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import rsvib_torch as rsv

Rows = list[dict[str, Any]]
OptionTable = Mapping[str, tuple[Any, ...]]  # default, help text, and for some the choices

RESULTS = Path(__file__).parent / "benchmarks" / "results"
# Environment variables that must be set before a process starts. PyTorch uses huge pages, as NumPy does by default.
# glibc keeps freed memory of all threads for the next call; virtual machines may take long to provide memory again.
HUGE_PAGES = "THP_MEM_ALLOC_ENABLE"
KEPT = {"MALLOC_MMAP_THRESHOLD_": str(1 << 40), "MALLOC_TRIM_THRESHOLD_": str(1 << 40), "MALLOC_TOP_PAD_": str(1 << 26)}
ENVIRONMENT = {HUGE_PAGES: "1", **KEPT}
_LIBRARIES = {"OpenCV": "opencv-python-headless", "SciPy": "scipy", "scikit-image": "scikit-image", "Kornia": "kornia"}
_LIBRARIES |= {"NumPy": "numpy"}
BEGIN, END = "<!-- begin of the generated table -->", "<!-- end of the generated table -->"
_NOT_FINITE = ("nan", "inf", "-inf")  # JSON has no such numbers, they are stored as text


def with_generated_part(page: str, lines: Iterable[str]) -> str:
    """The text of a page with other lines between ``BEGIN`` and ``END``."""
    before, rest = page.split(BEGIN)
    return "\n".join([before + BEGIN, *lines, END + rest.split(END)[1]])


# Options


def add_options(parser: argparse.ArgumentParser, options: OptionTable) -> None:
    """Add the options of a section; sections that share an option have it from the same table."""
    for name, (default, text, *choices) in options.items():
        several = isinstance(default, tuple)
        parser.add_argument(
            "--" + name.replace("_", "-"),
            default=default,
            help=f"{text} (default: %(default)s)",
            type=type(default[0] if several else default),
            choices=choices[0] if choices else None,
            nargs="*" if several else None,
        )


def devices() -> list[str]:
    """Devices of this machine."""
    return ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]


# Timed runs


def finish() -> None:
    """Wait for a GPU, if it is used."""
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()


def seconds_of(work: Callable[[], Any]) -> float:
    """Seconds of one run, including the pending work of a GPU."""
    finish()
    begin = time.perf_counter()
    work()
    finish()
    return time.perf_counter() - begin


def in_turns(works: dict[str, Callable[[], Any]], runs: int) -> dict[str, NDArray[np.float64]]:
    """Seconds of the runs of each task; they alternate, so that other load on the machine affects all tasks equally."""
    for work in works.values():  # warm-up
        work()
    rounds = [[seconds_of(work) for work in works.values()] for _ in range(max(1, runs))]
    return dict(zip(works, np.transpose(rounds), strict=True))


def plain_environment() -> dict[str, str]:
    """Environment of processes whose memory is measured, without the settings that keep freed memory."""
    return {name: value for name, value in os.environ.items() if name not in KEPT}


def write_h264(target: Any, pictures: Iterable[Any], rate: int, *, bit_rate: int | None = None, **options: str) -> None:
    """Write pictures, arrays (3/2 H, W) of yuv420p, as a video (BT.709, limited) into a path or an open file."""
    import av  # an extra # noqa: PLC0415

    with av.open(target if hasattr(target, "write") else str(target), "w", format="mp4") as output:
        stream: Any = output.add_stream("libx264", rate=rate, options=options)
        stream.pix_fmt = "yuv420p"
        if bit_rate is not None:
            stream.bit_rate = bit_rate
        stream.codec_context.colorspace, stream.codec_context.color_range = 1, 1
        for number, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(picture, format="yuv420p")
            if number == 0:
                stream.height, stream.width = frame.height, frame.width
            frame.pts, frame.time_base = number, Fraction(1, rate)
            output.mux(stream.encode(frame))
        output.mux(stream.encode())


# Tables


def table(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """A Markdown table, with an empty line after it."""
    lines = [heads, ["---"] * len(heads), *rows]
    return [*(f"| {' | '.join(map(str, line))} |" for line in lines), ""]


def table_of(rows: Iterable[Mapping[str, Any]], *columns: tuple[str, str | Callable[[Any], object]]) -> list[str]:
    """A table with a line for each row. A column is a head, and a format of the values of a row or a function of it."""
    cells = [[cell.format(**row) if isinstance(cell, str) else cell(row) for _, cell in columns] for row in rows]
    return table([head for head, _ in columns], cells)


# The machine


def machine() -> dict[str, Any]:
    """Processor, devices, libraries and settings of this machine."""
    return {
        "cores": os.cpu_count() or 1,
        "threads": torch.get_num_threads(),
        "processor": _processor(),
        "cuda": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "huge_pages": os.environ.get(HUGE_PAGES) == "1",
        "kept_memory": all(name in os.environ for name in KEPT),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "libraries": {name: _version(library) for name, library in _LIBRARIES.items()},
    }


def machine_line(of: dict[str, Any]) -> str:
    """Processor, threads, libraries and settings of a run as one paragraph."""
    libraries = ", ".join(f"{name} {version}" for name, version in of["libraries"].items())
    load = "" if of["load"] is None else f" Load average at the start: {of['load']:.1f}."
    pages = "huge pages" if of["huge_pages"] else "default page size"
    pages += ", freed memory kept by the allocator" if of["kept_memory"] else ""
    cuda = "No CUDA device." if of["cuda"] is None else f"CUDA device: {of['cuda']}."
    return (
        f"{of['processor']}, {of['cores']} cores, {of['threads']} threads; Python {of['python']}, "
        f"torch {of['torch']}, {libraries}; {pages}.{load} {cuda}"
    )


def _processor() -> str:
    """Name of the processor, or of its architecture if the system does not provide the name."""
    information = Path("/proc/cpuinfo")
    if information.exists():
        for line in information.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _version(library: str) -> str:
    try:
        return metadata.version(library)
    except metadata.PackageNotFoundError:
        return "missing"


# Stored results


def plain(value: Any) -> Any:
    """A value as JSON data; numbers that are not finite become text."""
    if isinstance(value, dict):
        return {str(name): plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return str(value) if isinstance(value, Path) else value


def _restored(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _restored(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_restored(item) for item in value]
    return float(value) if value in _NOT_FINITE else value


def _commit() -> str | None:
    """Short hash of the commit of this working tree, with "+" if files have changed; None outside a repository."""

    def git(*arguments: str) -> str:
        command = ["git", *arguments]
        return subprocess.run(command, cwd=RESULTS.parent, capture_output=True, text=True, check=True).stdout.strip()

    try:
        return git("rev-parse", "--short=10", "HEAD") + ("+" if git("status", "--porcelain", "-uno") else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def today() -> str:
    """The date, YYYY-MM-DD."""
    return datetime.datetime.now(tz=datetime.UTC).date().isoformat()


_NOT_STORED = ("out", "only", "store")  # options of the run that do not concern its figures


def write_result(section: str, rows: Rows, options: argparse.Namespace, seconds: float, folder: Path = RESULTS) -> Path:
    """Store the figures of a section with options, version, commit, date and machine as ``section.json`` in a folder.

    Of files that options state, the name is stored.
    """
    stated = {name: value for name, value in vars(options).items() if name not in _NOT_STORED}
    content = {
        "section": section,
        "version": rsv.__version__,
        "commit": _commit(),
        "date": today(),
        "seconds": round(seconds, 1),
        "machine": machine(),
        "options": {
            name: value.rpartition("/")[2] if isinstance(value, str) else value for name, value in stated.items()
        },
        "rows": rows,
    }
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{section}.json"
    path.write_text(json.dumps(plain(content), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return path


def read_result(path: Path) -> argparse.Namespace:
    """Read a file that ``write_result`` wrote: its keys as attributes, and the options as those of a run."""
    content = _restored(json.loads(path.read_text(encoding="utf-8")))
    return argparse.Namespace(**{**content, "options": argparse.Namespace(**content["options"])})
