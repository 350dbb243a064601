"""The reproduction as a self-contained HTML page."""

from pathlib import Path
from typing import Any

from reproduction.cells import all_cells
from reproduction.document import conditions, count_words, losses, remarks, sections
from reproduction.pictures import Gallery
from reproduction.work import Found, Plan

import rsvib_torch
from rsvib_torch.report.html import write_page

_TEMPLATES = Path(__file__).parent / "templates"
_MARKS = {"in every trial": "good", "on average": "doubt", "no": "bad", "yes": "good"}


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def _section(title: str, words: str, lines: list[str]) -> dict[str, Any]:
    """A section with the cells of its Markdown table."""
    rows = [_cells(line) for line in lines if line.startswith("|")]
    return {"title": title, "words": words, "head": rows[0], "rows": rows[2:]}


def write_reproduction_page(path: Path, found: Found, plan: Plan, pictures: Gallery) -> None:
    """Write the page."""
    cells = all_cells(found.trials, found.still, plan.noises[0])
    behind = losses(cells)
    content = {
        "title": "Liu et al. 2023, reproduced",
        "conditions": conditions(plan),
        "verdict": count_words(cells),
        "mood": "doubt" if behind else "good",
        "losses": behind,
        "remarks": remarks(found, plan),
        "pictures": pictures.figures,
        "overviews": list(pictures.overviews.values()),
        "sections": [_section(*part) for part in sections(found, plan)],
        "marks": _MARKS,
        "footer": f"rsvib_torch {rsvib_torch.__version__}, scripts/reproduce.py. H. Liu, H. Lv, C. Han, Y. Zhao: "
        "Vibration Detection and Degraded Image Restoration of Space Camera Based on Correlation Imaging of Rolling-"
        "Shutter CMOS. Sensors 2023, 23, 5953.",
    }
    write_page(path, "reproduction.html", content, _TEMPLATES)
