"""Imports of what a package uses of packages above it, when it is used; ``rsvib_torch/__init__.py`` states them."""

from collections.abc import Callable
from types import ModuleType

IMPORTERS: dict[str, Callable[[], ModuleType]] = {}
