"""What all results have: summary, dictionary, files, figures, and reasons against a result."""

from collections.abc import Callable
from types import ModuleType

# Imports of what a package uses of packages above it, when it is used; ``rsvib_torch/__init__.py`` states them.
IMPORTERS: dict[str, Callable[[], ModuleType]] = {}
