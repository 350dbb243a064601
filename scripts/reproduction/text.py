"""The tables of the reproduction in Markdown."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from reproduction.cells import FRAMES, Cell, Spread, at_noise, collected, metric, mtf_against_still
from reproduction.paper import AMPLITUDE, AXES, AXIS_NAMES, DETECTED, FREQUENCY, RESTORED, TARGETS, Target
from reproduction.trials import FREQUENCY as MTF_FREQUENCY
from reproduction.trials import METHODS, RESTORED_BY
from reproduction.work import Found, Plan

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
NAMES = {"paper": "the paper's methods", "default": "default methods", "joint": "both frames jointly"}


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """A Markdown table."""
    return [f"| {' | '.join(head)} |", "|" + "---|" * len(head), *(f"| {' | '.join(row)} |" for row in rows), ""]


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
    return table(["", column, "paper", *names, *still, "default better than the paper"], rows)


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
    return table(["", "axis", "true", "paper", *(NAMES[method] for method in METHODS)], rows)


def degraded_table(target: Target, trials: Sequence[dict[str, Any]]) -> list[str]:
    """Quality of the degraded frames, and that of the paper."""
    rows = []
    for name, printed in RESTORED[target].items():
        for frame, column in enumerate(FRAMES):
            values = collected(trials, lambda t: metric(t["degraded"], name, frame))  # noqa: B023
            digits = 2 if name == "psnr" else 4
            label = _METRIC_NAMES[name]
            rows.append([label, column, f"{printed.degraded[frame]:g}", f"{values.mean():.{digits}f}"])
    return table(["degraded frames", "frame", "paper", "ours, mean"], rows)


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
    return table(head, rows)


def mtf_table(found: Found, plan: Plan) -> list[str]:
    """MTF of degraded and restored frames and of the camera at rest: at 0.25 cycles/px, 0.4 and Nyquist, and MTF50."""
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
    return table(["axis", "measured", "", "at 0.25 cycles/px", "at 0.4", "at Nyquist", "MTF50 (cycles/px)"], rows)


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
    return table(head, rows)


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
    return table(head, rows)


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
    return table(head, rows)
