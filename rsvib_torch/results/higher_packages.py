"""What a package uses of packages above it: they are named in ``rsvib_torch/__init__.py``, and imported when used."""

from collections.abc import Callable
from typing import Any

_importers: dict[str, Callable[[], Any]] = {}


def register(name: str, importer: Callable[[], Any]) -> None:
    """Register a function that imports what is used under a name."""
    _importers[name] = importer


def imported(name: str) -> Any:
    """What is registered under a name."""
    return _importers[name]()
