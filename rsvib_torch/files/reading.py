"""Reading of files that a user names: only regular files, and only as many bytes as they state."""

import stat
import tomllib
from pathlib import Path
from typing import Any

from rsvib_torch.files.free_memory import size_text

Table = dict[str, Any]  # values by name, as files and options have them

_MAX_BYTES = 10**7  # of a TOML file; start times of 500,000 frames
_MAX_DEPTH = 100  # parts of a key; the deepest key of a configuration file has 3
_KINDS = {stat.S_ISFIFO: "a pipe", stat.S_ISSOCK: "a socket", stat.S_ISCHR: "a device", stat.S_ISBLK: "a device"}


def check_regular(path: Path) -> None:
    """Raise an error if a path is neither a regular file nor a folder: reading others can wait or go on forever."""
    for is_kind, name in _KINDS.items():
        if is_kind(path.stat().st_mode):
            raise ValueError(f"{path}: expected a regular file, this is {name}")


def read_text(path: Path, *, at_most: int) -> str:
    """Text of a regular file in UTF-8 of at most a number of bytes."""
    check_regular(path)
    with path.open("rb") as file:
        size = path.stat().st_size  # 0 for files of /proc, some of which have no end
        if size > at_most:
            raise ValueError(f"{path}: {size_text(size)} are too large; expected at most {size_text(at_most)}")
        return file.read(size).decode("utf-8")


def read_toml(path: Path) -> Table:
    """The tables of a TOML file."""
    try:
        text = read_text(path, at_most=_MAX_BYTES)
        # the parser takes quadratic time for nested keys; lists of numbers have as many commas as points
        if any(line.count(".") > line.count(",") + _MAX_DEPTH for line in text.splitlines() if line[:1] != "#"):
            raise ValueError(f"a key has more than {_MAX_DEPTH} parts")
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not a TOML file: {error}") from error
