"""The document of the reproduction in Markdown, and its results as JSON data."""

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import harness
import numpy as np
from harness import plain
from reproduction.cells import (
    FRAMES,
    NAMES,
    TABLES,
    Cell,
    Spread,
    all_cells,
    at_noise,
    collected,
    metric,
    mtf_against_still,
)
from reproduction.paper import (
    AMPLITUDE,
    AXES,
    AXIS_NAMES,
    DETECTED,
    EXPOSURE_ROWS,
    FREQUENCY,
    RESTORED,
    ROW_TIME,
    TARGETS,
    Target,
)
from reproduction.scenes import OPTICS
from reproduction.trials import BITS, JOINT, METHODS, MTF_FREQUENCY, RESTORED_BY, Found, Plan

GOAL_FREQUENCY, GOAL_SHARE, GOAL_OVERSHOOT = (
    0.4,
    0.95,
    1.05,
)  # goals for the restored MTF relative to the camera at rest
_METRIC_NAMES = {
    "psnr": "PSNR (dB)",
    "ssim": "SSIM",
    "mtf_x": "MTF at Nyquist, horizontal",
    "mtf_y": "MTF at Nyquist, vertical",
}


def _number(value: float, digits: int) -> str:
    return "–" if not np.isfinite(value) else f"{value:.{digits}f}"


def _spread(found: Spread, cell: Cell) -> str:
    return f"{_number(found.mean, cell.digits)} ({_number(found.worst, cell.digits)})"


def _range(values: Sequence[float]) -> str:
    known = [value for value in values if np.isfinite(value)]
    return f"{np.mean(known):.4f} ({min(known):.4f} … {max(known):.4f})" if known else "–"


def cells_table(cells: Sequence[Cell], *, column: str) -> list[str]:
    """Values of the paper and of all methods as mean (worst), and whether the default method is better."""
    rows = []
    for cell in cells:
        unit = f" ({cell.unit})" if cell.unit else ""
        ahead = "in every trial" if cell.better("default") else "on average" if cell.better("default", "mean") else "no"
        rows.append(
            [f"{cell.row}{unit}", cell.column, f"{cell.paper:g}"]
            + [_spread(found, cell) for found in cell.ours.values()]
            + ([_number(cell.still, cell.digits) if cell.still is not None else ""] if column == "frame" else [])
            + [ahead]
        )
    still = ["camera at rest"] if column == "frame" else []
    names = [NAMES[method] for method in cells[0].ours]
    return harness.table(["", column, "paper", *names, *still, "default better than the paper"], rows)


def detected_table(target: Target, trials: Sequence[dict[str, Any]]) -> list[str]:
    """Detected period, amplitude and phase, as Tables 2 and 3 list them."""
    rows = []
    for axis in AXES:
        printed = DETECTED[target][axis]
        truths = {"period": 1e3 / FREQUENCY[axis], "amplitude": AMPLITUDE[axis]}
        for quantity, unit, digits in (("period", "ms", 4), ("amplitude", "px", 4)):
            ours = []
            for method in METHODS:
                values = collected(trials, lambda t: t["detection"][method][axis][quantity])  # noqa: B023
                ours.append(f"{values.mean():.{digits}f} ± {values.std():.{digits}f}")
            true = f"{truths[quantity]:.{digits}f}".rstrip("0").rstrip(".")
            rows.append([f"{quantity} ({unit})", AXIS_NAMES[axis], true, f"{getattr(printed, quantity):g}", *ours])
        ours = []
        for method in METHODS:
            errors = np.abs(collected(trials, lambda t: t["detection"][method][axis]["phase_error"]))  # noqa: B023
            ours.append(f"error {errors.mean():.5f} ({errors.max():.5f})")
        rows.append(["phase (π)", AXIS_NAMES[axis], "drawn", f"{printed.phase:g}, truth not stated", *ours])
    return harness.table(["", "axis", "true", "paper", *(NAMES[method] for method in METHODS)], rows)


def degraded_table(target: Target, trials: Sequence[dict[str, Any]]) -> list[str]:
    """Quality of the degraded frames, and that of the paper."""
    rows = []
    for name, printed in RESTORED[target].items():
        for frame, column in enumerate(FRAMES):
            values = collected(trials, lambda t: metric(t["degraded"], name, frame))  # noqa: B023
            digits = 2 if name == "psnr" else 4
            label = _METRIC_NAMES[name]
            rows.append([label, column, f"{printed.degraded[frame]:g}", f"{values.mean():.{digits}f}"])
    return harness.table(["degraded frames", "frame", "paper", "ours, mean"], rows)


def noise_table(found: Found, plan: Plan) -> list[str]:
    """Results for all noise levels."""
    rows = []
    for target, name in TARGETS.items():
        for noise in sorted(plan.noises):
            trials, still = at_noise(found.trials[target], noise), at_noise(found.still[target], noise)[0]
            for method in RESTORED_BY:
                detection = [
                    np.abs([t["detection"][method][axis][f"{quantity}_error"] for t in trials for axis in AXES])
                    for quantity in ("period", "amplitude")
                    if method in METHODS
                ]
                quality = [np.array([t["restoration"][method][what] for t in trials]) for what in ("psnr", "ssim")]
                rows.append(
                    [name, f"{noise:g}", NAMES[method]]
                    + ([f"{e.mean():.4f} ({e.max():.4f})" for e in detection] or ["", ""])
                    + [f"{q.mean():.{d}f} ({q.min():.{d}f})" for q, d in zip(quality, (2, 4), strict=True)]
                    + [f"{still['psnr'][0]:.2f}, {still['ssim'][0]:.4f}"]
                )
    head = ("scene", "noise", "by", "period error (%)", "amplitude error (%)", "PSNR (dB)", "SSIM", "camera at rest")
    return harness.table(head, rows)


def mtf_table(found: Found, plan: Plan) -> list[str]:
    """MTF of degraded and restored frames and of the camera at rest, at three frequencies, and MTF50."""
    noise = plan.noises[0]
    trials, still = at_noise(found.trials["chart"], noise), at_noise(found.still["chart"], noise)[0]
    places = [int(np.argmin(np.abs(MTF_FREQUENCY - wanted))) for wanted in (0.25, GOAL_FREQUENCY)]
    rows = []
    for axis in AXES:
        for kind, words in (("straight", "straight line, ISO 12233"), ("along", "along the distorted edge")):
            kinds = {
                "camera at rest": [still["mtf"]],
                "degraded": [t["degraded"]["mtf"] for t in trials],
                **{NAMES[m]: [t["restoration"][m]["mtf"] for t in trials] for m in RESTORED_BY},
            }
            for name, frames in kinds.items():
                curves = [frame[axis][kind] for pair in frames for frame in pair if kind in frame[axis]]
                values = [
                    *([c["curve"][place] for c in curves] for place in places),
                    [c["nyquist"] for c in curves],
                    [c["mtf50"] for c in curves],
                ]
                means = [_range(v) for v in values]
                rows.append([AXIS_NAMES[axis], words, name, *means])
    return harness.table(
        ["axis", "measured", "", "at 0.25 cycles/px", "at 0.4", "at Nyquist", "MTF50 (cycles/px)"], rows
    )


def closing_values(found: Found, noise: float) -> list[dict[str, Any]]:
    """Restored MTF over that of the camera at rest: smallest up to the frequency of the goal, largest up to Nyquist."""
    trials, still = at_noise(found.trials["chart"], noise), at_noise(found.still["chart"], noise)[0]
    inside = (MTF_FREQUENCY > 0) & (MTF_FREQUENCY <= GOAL_FREQUENCY + 1e-9)
    values = []
    for method in RESTORED_BY:
        for axis in AXES:
            for kind in ("straight", "along"):
                share = mtf_against_still(trials, still, method, axis, kind)
                if not len(share):
                    continue
                mean = share.mean(0)
                values.append(
                    {
                        "method": method,
                        "axis": axis,
                        "measured": kind,
                        "noise": noise,
                        "least_share": float(mean[inside].min()),
                        "largest_share": float(mean[inside].max()),
                        "least_share_of_a_frame": float(share[:, inside].min()),
                        "largest_share_of_a_frame": float(share[:, inside].max()),
                        "largest_mtf": float(
                            np.mean([share * np.array(still["mtf"][0][axis][kind]["curve"])], axis=(0, 1)).max()
                        ),
                    }
                )
    return values


def closing_table(found: Found, noise: float) -> list[str]:
    """The comparison with the camera at rest as a table."""
    rows = [
        [
            NAMES[v["method"]],
            AXIS_NAMES[v["axis"]],
            {"straight": "straight line", "along": "along the edge"}[v["measured"]],
            f"{v['least_share']:.3f} … {v['largest_share']:.3f}",
            f"{v['least_share_of_a_frame']:.3f} … {v['largest_share_of_a_frame']:.3f}",
            "yes" if v["least_share"] >= GOAL_SHARE else "no",
            "yes" if v["largest_share"] <= GOAL_OVERSHOOT else "no",
        ]
        for v in closing_values(found, noise)
    ]
    head = (
        "restored by",
        "axis",
        "measured",
        f"mean curve over that of the camera at rest, up to {GOAL_FREQUENCY:g} cycles/px",
        "single frames",
        f"at least {GOAL_SHARE:g}",
        f"at most {GOAL_OVERSHOOT:g}",
    )
    return harness.table(head, rows)


def push_scan_table(found: Found, plan: Plan) -> list[str]:
    """Errors with and without image motion."""
    rows = []
    for speed in plan.speeds:
        trials = [t for t in found.push_scan if t["speed"] == speed]
        for method in METHODS:
            row = [f"{speed:g}", NAMES[method]]
            for axis in AXES:
                for quantity, digits in (("period", 4), ("amplitude", 3)):
                    errors = np.abs([t["detection"][method][axis][f"{quantity}_error"] for t in trials])
                    row.append(f"{errors.mean():.{digits}f} ({errors.max():.{digits}f})")
            verdicts = [t["detection"][method][axis]["reliable"] for t in trials for axis in AXES]
            rows.append([*row, f"{sum(verdicts)} of {len(verdicts)}"])
    head = [
        "image motion (px/s)",
        "by",
        "period x (%)",
        "amplitude x (%)",
        "period y (%)",
        "amplitude y (%)",
        "reliable",
    ]
    return harness.table(head, rows)


def shutter_table(found: Found, plan: Plan) -> list[str]:
    """Frequencies detected with a global shutter of the same frame rate."""
    shutter, rows = found.global_shutter, []
    for axis in AXES:
        trials = at_noise(found.trials["landscape"], plan.noises[0])
        periods = collected(trials, lambda t: t["detection"]["default"][axis]["period"])  # noqa: B023
        rolling = 1e3 / periods
        rows.append(
            [
                AXIS_NAMES[axis],
                f"{shutter['true'][axis]:g}",
                f"{shutter['found'][axis]:.2f}",
                f"{shutter['alias'][axis]:.2f}",
                f"{rolling.mean():.4f} ± {rolling.std():.4f}",
            ]
        )
    head = ("axis", "true (Hz)", "global shutter, 24 frames (Hz)", "its alias (Hz)", "rolling shutter, 2 frames (Hz)")
    return harness.table(head, rows)


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
                detected_table(target, trials),
            )
        )
        parts.append(("", "Relative errors, mean (worst) of the trials.", cells_table(mine, column="axis")))
    for target, name in TARGETS.items():
        trials = at_noise(found.trials[target], noise)
        mine = [cell for cell in cells if cell.table == "Table 4" and cell.target == target]
        parts.append(
            (
                f"Table 4: restoration, {name}",
                f"Noise {noise:g}; mean (worst) of the trials, relative to the scene at rest without noise.",
                cells_table(mine, column="frame"),
            )
        )
        parts.append(
            (
                "",
                "The paper's frames were less degraded by these measures, so that improvements in per cent are not "
                "comparable:",
                degraded_table(target, trials),
            )
        )
    parts += [
        (
            "MTF",
            f"Noise {noise:g}; mean (smallest … largest) over frames. The paper gives one number without its "
            "frequency; Table 4 above uses the Nyquist frequency, measured with a straight line as in ISO 12233, for "
            "which the distortion of an edge is blur.",
            mtf_table(found, plan),
        ),
        ("Restored frames and camera at rest", f"Noise {noise:g}.", closing_table(found, noise)),
        ("Other noise", "Mean (worst) of the trials.", noise_table(found, plan)),
        (
            "Push-scan (Sec. 2.3)",
            f"Image motion along x, landscape, noise {noise:g}; errors in %, mean (worst).",
            push_scan_table(found, plan),
        ),
        (
            "50 Hz from 24 frames per second",
            "A global shutter of the same frame rate takes one sample per frame, in which only the alias is visible.",
            shutter_table(found, plan),
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
    """All results as JSON data; numbers that are not finite become text."""
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
        "closing": closing_values(found, plan.noises[0]),
        "still": found.still,
        "trials": found.trials,
        "push_scan": found.push_scan,
        "global_shutter": found.global_shutter,
    }
    return dict(plain(content))
