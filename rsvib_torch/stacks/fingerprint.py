"""Whether an input is still the same: its size, and a hash of its header and of blocks spread over it."""

import hashlib
from pathlib import Path
from typing import Any

__all__ = ["fingerprint"]

_BLOCK = 1 << 16  # bytes
_BLOCKS = 32
_FILES = 32  # of a folder


def _spread(count: int, most: int) -> list[int]:
    """At most ``most`` numbers below ``count``, the first and the last among them."""
    steps = min(count, most)
    return sorted({round(i * (count - 1) / max(1, steps - 1)) for i in range(steps)})


def _add_file(digest: Any, path: Path) -> None:
    size = path.stat().st_size
    with path.open("rb") as file:
        for index in _spread(-(-size // _BLOCK), _BLOCKS):
            file.seek(index * _BLOCK)
            digest.update(file.read(_BLOCK))


def fingerprint(path: Path) -> dict[str, Any]:
    """Name, size and hash of a file or folder.

    The hash covers the names and sizes of all files, and of each file (of a folder, of up to 32 of its files) the
    first and the last 64 KiB and 30 blocks of as much between them. Files up to 2 MiB are covered completely.

    Args:
        path: The file or folder; a file ``NAME.json`` beside it belongs to it.

    Raises:
        OSError: If it cannot be read.
    """
    if path.is_dir():
        files = sorted(file for file in path.rglob("*") if file.is_file())
    else:
        files = [path, *(beside for beside in [path.with_name(path.name + ".json")] if beside.is_file())]
    digest, total = hashlib.sha256(), 0
    for file in files:
        size = file.stat().st_size
        total += size
        digest.update(f"{file.relative_to(path.parent)}\0{size}\0".encode())
    for index in _spread(len(files), _FILES):
        _add_file(digest, files[index])
    return {"name": path.name, "bytes": total, "sha256_of_samples": digest.hexdigest()}
