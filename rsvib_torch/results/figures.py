"""Figures of results: the module that draws them registers itself, and is imported when the first one is drawn."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# The function that draws a result of this type with this number of leading dimensions (0: not a batch).
FIGURES: dict[tuple[type, int], Callable[[Any], "Figure"]] = {}
_importers: list[Callable[[], object]] = []


def register_figures(importer: Callable[[], object]) -> None:
    """Register a function that imports a module which adds to ``FIGURES``."""
    _importers.append(importer)


def figure_of(kind: type, dimensions: int) -> Callable[[Any], "Figure"] | None:
    """The function that draws a result of a type with a number of leading dimensions; None if there is none."""
    while _importers:
        _importers.pop()()
    return FIGURES.get((kind, dimensions))
