#!/usr/bin/env python
"""Run the code of the tutorials and notebooks and write its output into them anew.

A page is run from top to bottom in an empty folder: blocks of ``python`` share their variables, blocks of ``bash`` are
commands. A block of ``text`` directly below one of them is its output. Pictures of the page that its code has written
are copied beside the page.
"""

import argparse
import contextlib
import io
import os
import re
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import nbclient
import nbformat

from rsvib_torch.commands.main import run_command

DOCS = Path(__file__).resolve().parents[1] / "docs"
BLOCK = re.compile(r"^```(python|bash|text)\n(.*?)^```\n", flags=re.DOTALL | re.MULTILINE)
FAILS = "  # exit code 2"  # written behind commands that are refused


def run_commands(lines: str) -> None:
    """Run commands of a shell; ``rsvib`` runs in this process, which saves the time to import PyTorch."""
    for line in lines.replace("\\\n", " ").splitlines():
        command = line.removesuffix(FAILS)
        if command.startswith("rsvib "):
            code = run_command(shlex.split(command)[1:])
        else:
            done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
            print(done.stdout + done.stderr, end="")
            code = done.returncode
        if code != (2 if line.endswith(FAILS) else 0):
            raise RuntimeError(f"{line!r} ended with exit code {code}")


def run_page(page: Path, folder: Path) -> tuple[str, dict[str, Any]]:
    """Run the code of a page in a folder; returns the page with its outputs, and the variables of its Python code."""
    names: dict[str, Any] = {"__name__": "page"}
    text = page.read_text(encoding="utf-8")
    parts, end, output = [], 0, None
    with mock.patch.dict(os.environ, COLUMNS="100"):
        for block in BLOCK.finditer(text):
            between, (language, code) = text[end : block.start()], block.groups()
            if language == "text":
                if output is not None and not between.strip():
                    code = "".join(f"{line.rstrip()}\n" for line in output.strip("\n").splitlines())
                output = None
            else:
                written = io.StringIO()
                with contextlib.chdir(folder), contextlib.redirect_stdout(written), contextlib.redirect_stderr(written):
                    if language == "bash":
                        run_commands(code)
                    else:
                        line = text.count("\n", 0, block.start(2))  # lines of tracebacks are those of the page
                        exec(compile("\n" * line + code, str(page), "exec"), names)
                output = written.getvalue()
            parts += [between, f"```{language}\n{code}```\n"]
            end = block.end()
    return "".join([*parts, text[end:]]), names


def pictures(page: str) -> list[str]:
    """Names of the pictures that lie beside a page."""
    return re.findall(r"!\[[^\]]*\]\(([\w.-]+)\)", page)


def run_notebook(notebook: Path) -> nbformat.NotebookNode:
    """Execute a notebook; returns it with its outputs."""
    cells = nbformat.read(notebook, as_version=4)
    environment = os.environ | {"COLUMNS": "100"}  # the width of printed results
    return nbclient.NotebookClient(cells, timeout=300, record_timing=False).execute(env=environment)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = [*sorted(DOCS.glob("tutorials/*.md")), DOCS / "tables.md", *sorted(DOCS.glob("notebooks/*.ipynb"))]
    parser.add_argument("pages", nargs="*", type=Path, default=default, help="pages and notebooks (default: all)")
    for page in parser.parse_args(arguments).pages:
        print(page)
        if page.suffix == ".ipynb":
            nbformat.write(run_notebook(page), page)
            continue
        with tempfile.TemporaryDirectory() as folder:
            text, _ = run_page(page, Path(folder))
            for name in pictures(text):
                shutil.copy(Path(folder) / name, page.parent / name)
        page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
