"""The reproduction as Markdown and as JSON."""

import math
from dataclasses import asdict
from typing import Any

import numpy as np
from reproduction import text
from reproduction.cells import TABLES, Cell, all_cells, at_noise
from reproduction.paper import AMPLITUDE, AXES, EXPOSURE_ROWS, FREQUENCY, ROW_TIME, TARGETS
from reproduction.targets import OPTICS
from reproduction.trials import BITS, JOINT, METHODS
from reproduction.work import Found, Plan


def count_words(cells: list[Cell]) -> str:
    """Number of cells in which the package is better."""
    ahead = {which: sum(cell.better("default", which) for cell in cells) for which in ("worst", "mean")}
    return (
        f"The default methods are better than the paper in {ahead['worst']} of {len(cells)} cells in the worst trial, "
        f"and in {ahead['mean']} on average over the trials; with both frames restored jointly, in "
        f"{sum(cell.better('joint') for cell in cells)} and {sum(cell.better('joint', 'mean') for cell in cells)}."
    )


def losses(cells: list[Cell]) -> list[str]:
    """Cells in which the worst trial is worse than the paper, as text."""
    return [
        f"{cell.table}, {TARGETS[cell.target]}, {cell.row}, {cell.column}: paper {cell.paper:g}, mean "
        f"{cell.ours['default'].mean:.{cell.digits}f}, worst {cell.ours['default'].worst:.{cell.digits}f}"
        + (f", jointly {cell.ours['joint'].mean:.{cell.digits}f}" if "joint" in cell.ours else "")
        + (f", a camera at rest {cell.still:.{cell.digits}f}" if cell.still is not None else "")
        for cell in cells
        if not cell.better("default")
    ]


def remarks(found: Found, plan: Plan) -> list[str]:
    """Remarks on the comparison."""
    behind = [cell for cell in all_cells(found.trials, found.still, plan.noises[0]) if not cell.better("default")]
    beyond = sum(cell.still is not None and cell.still < cell.paper for cell in behind)
    limit = (
        f"In {beyond} of these {len(behind)} cells, the paper's value is better than that of a camera at rest in this "
        "simulation."
    )
    smear = {
        axis: 2 * AMPLITUDE[axis] * math.sin(math.pi * FREQUENCY[axis] * EXPOSURE_ROWS * ROW_TIME) for axis in AXES
    }
    loss = max(1 / float(np.sinc(0.5 * value)) - 1 for value in smear.values())
    return [
        *([limit] if beyond else []),
        "PSNR and SSIM are relative to the scene at rest without noise. The value of a camera at rest with the same "
        "noise is given for comparison: where the paper's value is higher, its frames had less noise or less detail, "
        "which the paper does not specify.",
        "In the paper's Table 3 the two columns of relative errors are exchanged; here each error is with its values.",
        f"The paper's vibration moves the image by at most {max(smear.values()):.2f} px during an exposure. "
        f"That lowers the MTF at Nyquist by a factor of {1 + loss:.3f} at most: larger improvements than "
        f"{100 * loss:.0f} % come from straightened edges, or exceed the contrast of a camera at rest.",
    ]


def conditions(plan: Plan) -> str:
    """The simulated conditions as text."""
    others = [f"{noise:g}" for noise in plan.noises[1:]]
    return (
        f"Frames of {plan.size[0]} x {plan.size[1]} px (rows x columns), the paper's camera and vibration, "
        f"{plan.seeds} trials with random phases and noise. Optics: Gaussian, σ = {OPTICS:g} px, and square "
        "pixels, with aliasing. "
        f"Gaussian noise of {plan.noises[0]:g} of full scale"
        + (f" (also {', '.join(others)})" if others else "")
        + f", {BITS}-bit counts. The frames come from an independent camera in NumPy; PSNR and SSIM are scikit-image's."
    )


def sections(found: Found, plan: Plan) -> list[tuple[str, str, list[str]]]:
    """Title, text and table of each section."""
    noise = plan.noises[0]
    cells = all_cells(found.trials, found.still, noise)
    parts: list[tuple[str, str, list[str]]] = []
    for target, name in TARGETS.items():
        trials = at_noise(found.trials[target], noise)
        mine = [cell for cell in cells if cell.table == TABLES[target]]
        parts.append(
            (
                f"{TABLES[target]}: detection, {name}",
                f"Noise {noise:g}; mean and standard deviation, phase errors as mean (worst).",
                text.detected_table(target, trials),
            )
        )
        parts.append(("", "Relative errors, mean (worst) of the trials.", text.cells_table(mine, column="axis")))
    for target, name in TARGETS.items():
        trials = at_noise(found.trials[target], noise)
        mine = [cell for cell in cells if cell.table == "Table 4" and cell.target == target]
        parts.append(
            (
                f"Table 4: restoration, {name}",
                f"Noise {noise:g}; mean (worst) of the trials, relative to the scene at rest without noise.",
                text.cells_table(mine, column="frame"),
            )
        )
        parts.append(
            (
                "",
                "The paper's frames were less degraded by these measures, so that improvements in per cent are not "
                "comparable:",
                text.degraded_table(target, trials),
            )
        )
    parts += [
        (
            "MTF",
            f"Noise {noise:g}; mean (smallest … largest) over frames. The paper gives one number without its "
            "frequency; Table 4 above uses the Nyquist frequency, measured with a straight line as in ISO 12233, for "
            "which the distortion of an edge is blur.",
            text.mtf_table(found, plan),
        ),
        ("Restored frames and camera at rest", f"Noise {noise:g}.", text.closing_table(found, noise)),
        ("Other noise", "Mean (worst) of the trials.", text.noise_table(found, plan)),
        (
            "Push-scan (Sec. 2.3)",
            f"Image motion along x, landscape, noise {noise:g}; errors in %, mean (worst).",
            text.push_scan_table(found, plan),
        ),
        (
            "50 Hz from 24 frames per second",
            "A global shutter of the same frame rate takes one sample per frame, in which only the alias is visible.",
            text.shutter_table(found, plan),
        ),
    ]
    return parts


def markdown(found: Found, plan: Plan) -> str:
    """The complete document."""
    cells = all_cells(found.trials, found.still, plan.noises[0])
    lines = ["# Liu et al. 2023, reproduced", "", conditions(plan), "", count_words(cells), ""]
    behind = losses(cells)
    if behind:
        lines += ["Worse than the paper in the worst trial:", "", *(f"* {line}" for line in behind), ""]
    for line in remarks(found, plan):
        lines += [line, ""]
    for title, words, rows in sections(found, plan):
        lines += ([f"## {title}", ""] if title else []) + [words, "", *rows]
    return "\n".join(lines).rstrip() + "\n"


def record(found: Found, plan: Plan) -> dict[str, Any]:
    """All results as JSON data; NaN becomes None."""
    cells = all_cells(found.trials, found.still, plan.noises[0])
    content = {
        "plan": asdict(plan),
        "methods": {name: {"detection": d, "restoration": r} for name, (d, r) in METHODS.items()}
        | {"joint": {"detection": {}, "restoration": JOINT}},
        "cells": [
            asdict(cell)
            | {"default_better_worst": cell.better("default"), "default_better_mean": cell.better("default", "mean")}
            for cell in cells
        ],
        "closing": text.closing_values(found, plan.noises[0]),
        "still": found.still,
        "trials": found.trials,
        "push_scan": found.push_scan,
        "global_shutter": found.global_shutter,
    }
    return dict(_plain(content))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value
