"""The sections of the benchmark, in the order of the page."""

from dataclasses import dataclass
from importlib import import_module
from typing import Any

__all__ = ["EARLIER_NAMES", "SECTIONS", "Section", "module_of"]


@dataclass(frozen=True)
class Section:
    """A section of the benchmark: the module ``benchmarks.NAME``, see ``harness``.

    Attributes:
        title: Heading on the page.
        by_default: Whether it runs without ``--only``; sections of more than a quarter of an hour do not.
        page: Page in docs/ with its tables.
    """

    title: str
    by_default: bool = True
    page: str = "benchmarks.md"


SECTIONS: dict[str, Section] = {
    "cost": Section("Time of detection"),
    "restoration": Section("Restoration"),
    "finer": Section("Finer grid"),
    "mosaic": Section("Colour mosaics"),
    "pipeline": Section("Detection and restoration"),
    "live": Section("Tracking at camera rate"),
    "video": Section("Colour video"),
    "steady": Section("Hand-held clips made steady"),
    "gpu": Section("Batches and devices"),
    "streaming": Section("Long stacks"),
    "memory": Section("Memory of long stacks"),
    "dask": Section("Long stacks on several workers"),
    "slanted_edge": Section("Slanted-edge MTF"),
    "verdict": Section("Verdict on restorations", by_default=False),
    "honesty": Section("Reliable results that are wrong", by_default=False),
    "timing": Section("Mistakes of the timing", by_default=False),
    "detection": Section("Accuracy of detection, roll and zoom", by_default=False),
    "row_time": Section("Row time from motion", by_default=False),
    "error_bars": Section("Standard deviations", by_default=False, page="verdicts.md"),
}


EARLIER_NAMES = {"roofline": "gpu", "roll": "detection"}  # of sections that have become part of others


def module_of(name: str) -> Any:
    """Module of a section."""
    return import_module(f"benchmarks.{name}")
