"""The sections of the benchmark: how each is measured, and how its figures become tables."""

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from benchmarks import (
    bounded_cost,
    detection,
    detection_cost,
    difficulty,
    finer,
    honesty,
    live,
    mosaic,
    pipeline,
    registration,
    regularisation,
    restoration,
    roofline,
    scaling,
    slanted_edge,
    streaming,
    streaming_dask,
    streaming_memory,
    timing_mistakes,
    verdict_roc,
    video,
)

__all__ = ["SECTIONS", "Section", "machine_line"]

Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class Section:
    """A section of the benchmark.

    Attributes:
        title: Heading on the page.
        rows: Measures with the options of the command line; returns figures as numbers, texts, lists and tables.
        lines: Tables in Markdown of these figures and options, without further measurement.
        by_default: Whether it runs without ``--only``; sections of more than a quarter of an hour do not.
    """

    title: str
    rows: Callable[[argparse.Namespace], Rows]
    lines: Callable[[Rows, argparse.Namespace], list[str]]
    by_default: bool = True


def _cost_rows(options: argparse.Namespace) -> Rows:
    """Time of plain recordings, then of difficult ones."""
    return detection_cost.rows(options) + bounded_cost.rows(options)


def _cost_lines(rows: Rows, options: argparse.Namespace) -> list[str]:
    """Tables of both parts; results stored before the second part existed lack it."""
    difficult = [row for row in rows if row.get("part") == "bounded"]
    text = detection_cost.lines([row for row in rows if row.get("part") != "bounded"], options)
    return text + (["", *bounded_cost.lines(difficult, options)] if difficult else [])


# A new section is one module with rows, lines and, for options of its own, add_options; and one line here.
SECTIONS: dict[str, Section] = {
    "registration": Section("Registration of bands", registration.rows, registration.lines),
    "cost": Section("Time of detection", _cost_rows, _cost_lines),
    "detection": Section("Accuracy of detection", detection.rows, detection.lines),
    "restoration": Section("Restoration", restoration.rows, restoration.lines),
    "finer": Section("Finer grid", finer.rows, finer.lines),
    "mosaic": Section("Colour mosaics", mosaic.rows, mosaic.lines),
    "pipeline": Section("Detection and restoration", pipeline.rows, pipeline.lines),
    "live": Section("Tracking at camera rate", live.rows, live.lines),
    "video": Section("Colour video", video.rows, video.lines),
    "scaling": Section("Scaling of time and memory", scaling.rows, scaling.lines),
    "roofline": Section("Limits of the device", roofline.rows, roofline.lines),
    "streaming": Section("Long stacks", streaming.rows, streaming.lines),
    "memory": Section("Memory of long stacks", streaming_memory.rows, streaming_memory.lines),
    "dask": Section("Long stacks on several workers", streaming_dask.rows, streaming_dask.lines),
    "regularisation": Section("Regularisation from the data", regularisation.rows, regularisation.lines),
    "difficulty": Section("Scenes of equal difficulty", difficulty.rows, difficulty.lines),
    "slanted_edge": Section("Slanted-edge MTF", slanted_edge.rows, slanted_edge.lines),
    "verdict": Section("Verdict on restorations", verdict_roc.rows, verdict_roc.lines, by_default=False),
    "honesty": Section("Reliable results that are wrong", honesty.rows, honesty.lines, by_default=False),
    "timing": Section("Mistakes of the timing", timing_mistakes.rows, timing_mistakes.lines, by_default=False),
}


def machine_line(machine: dict[str, Any]) -> str:
    """Processor, threads, libraries and settings of a run as one paragraph."""
    libraries = ", ".join(f"{name} {version}" for name, version in machine["libraries"].items())
    load = "" if machine["load"] is None else f" Load average at the start: {machine['load']:.1f}."
    pages = "huge pages" if machine["huge_pages"] else "default page size"
    pages += ", freed memory kept by the allocator" if machine["kept_memory"] else ""
    cuda = "No CUDA device." if machine["cuda"] is None else f"CUDA device: {machine['cuda']}."
    return (
        f"{machine['processor']}, {machine['cores']} cores, {machine['threads']} threads; Python {machine['python']}, "
        f"torch {machine['torch']}, {libraries}; {pages}.{load} {cuda}"
    )
