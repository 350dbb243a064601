"""Figures of results: the module that draws them adds to the table, and is imported when the first one is drawn."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rsvib_torch.results.higher_packages import imported

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# The function that draws a result of this type with this number of leading dimensions (0: not a batch).
FIGURES: dict[tuple[type, int], Callable[[Any], "Figure"]] = {}


def figure_of(kind: type, dimensions: int) -> Callable[[Any], "Figure"] | None:
    """The function that draws a result of a type with a number of leading dimensions; None if there is none."""
    imported("figures")
    return FIGURES.get((kind, dimensions))
