"""What a package uses of packages above it: they are named in ``rsvib_torch/__init__.py``, and imported when used."""

from collections.abc import Callable

_importers: dict[str, Callable[[], object]] = {}


def register(name: str, importer: Callable[[], object]) -> None:
    """Register a function that imports what is used under a name."""
    _importers[name] = importer


def imported(name: str) -> object:
    """What is registered under a name."""
    return _importers[name]()
