"""Tables of the comparison of chains: accuracy, time, targets, and cases in which other libraries are better."""

import argparse
import math
from typing import Any

from benchmarks.measure import named, shown_seconds

PAPER, FASTEST = "matchTemplate, curve_fit, wiener rows (the paper's)", "matchTemplate, curve_fit, remap (fastest)"
OURS, DEWARP = "detect_vibration, restore", 'detect_vibration, "dewarp"'
NARROW = "detect_vibration on a quarter of the columns, restore"
NARROW_DEWARP = 'detect_vibration on a quarter of the columns, "dewarp"'
NARROW_BANDS = '"bands" on a quarter of the columns, "dewarp"'
NAMES = {"amplitude_percent": "amplitude", "period_percent": "period", "psnr_db": "PSNR"}
FIGURES = tuple(NAMES)
CAMERA_RATE, GOAL_RATE = (
    24.0,
    100.0,
)  # frames per second: of the paper's camera, and the goal for restoration on a large GPU


def _target(target: str, value: float, goal: float, *, at_least: bool = False) -> dict[str, Any]:
    met = value >= goal if at_least else value <= goal
    bound = f"at least {goal:g}" if at_least else f"at most {goal:g}"
    return {"part": "target", "target": target, "value": value, "goal": bound, "met": met}


def targets(compared: list[dict[str, Any]], timed: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Targets, and whether they are met."""
    speed_of = {row["chain"]: row for row in timed}
    found = []
    if OURS in speed_of:
        ours, paper, fastest = (speed_of[name]["seconds"] for name in (OURS, PAPER, FASTEST))
        found += [
            _target("time of the paper's chain over ours", paper / ours, 10.0, at_least=True),
            _target(
                f"time of the paper's chain over {NARROW}", paper / speed_of[NARROW]["seconds"], 10.0, at_least=True
            ),
            _target("time of ours over that of the fastest chain", ours / fastest, 3.0),
        ]
        found += [
            _target(f"time of {name} over that of the fastest chain", row["seconds"] / fastest, 1.0)
            for name, row in speed_of.items()
            if '"dewarp"' in name
        ]
        found += [
            _target("FFT round trips of detection of a pair", speed_of[OURS]["detection_round_trips"], 30.0),
            _target("FFT round trips of restoration of a frame", speed_of[OURS]["restoration_round_trips"], 10.0),
        ]
    on_gpu = speed_of.get(named(OURS, "cuda"))
    if on_gpu is not None:
        restored = on_gpu["frames_restored_a_second"]
        found += [
            _target(
                "frames per second on cuda, detected and restored",
                on_gpu["frames_a_second"],
                CAMERA_RATE,
                at_least=True,
            ),
            _target("frames restored per second on cuda", restored, GOAL_RATE, at_least=True),
        ]
    for chain in (OURS, NARROW):
        behind = behind_libraries(compared, chain)
        for figure in FIGURES:
            worse = sum(row["figure"] == figure for row in behind)
            text = f"cases where a chain of libraries is ahead of {chain} in {NAMES[figure]}"
            found.append(_target(text, float(worse), 0.0))
    return found


def behind_libraries(compared: list[dict[str, Any]], chain: str) -> list[dict[str, Any]]:
    """Cases in which the better chain of libraries is more accurate: case, figure, peer and both values."""
    cases: dict[tuple[Any, ...], dict[str, dict[str, Any]]] = {}
    for row in compared:
        cases.setdefault((row["scene"], row["exposure_rows"], row["noise"]), {})[row["chain"]] = row
    found = []
    for case, rows_of in cases.items():
        for figure in FIGURES:
            sign = 1 if figure == "psnr_db" else -1
            peers = [peer for peer in (PAPER, FASTEST) if not math.isnan(rows_of[peer][figure])]
            if not peers:
                continue
            best = max(peers, key=lambda peer, s=sign, r=rows_of, f=figure: s * r[peer][f])
            own, theirs = rows_of[chain][figure], rows_of[best][figure]
            if not sign * own > sign * theirs:
                found.append({"case": case, "figure": figure, "peer": best, "own": own, "theirs": theirs})
    return found


def lines(results: list[dict[str, Any]], options: argparse.Namespace) -> list[str]:
    """The figures as Markdown tables."""
    of_part = {part: [r for r in results if r["part"] == part] for part in ("accuracy", "speed", "target")}
    text = [
        f"Detection and restoration of a pair of frames, {options.pipeline_rows} x {options.grid_size} px. Errors of "
        "amplitude and period in % on the worse axis, PSNR in dB of the worse frame. The row loop processes "
        "a sample of the rows; its time, with that of computing its kernels by NumPy, is scaled to all rows.",
    ]
    chains = list(dict.fromkeys(row["chain"] for row in of_part["accuracy"]))
    for scene, exposure in dict.fromkeys((r["scene"], r["exposure_rows"]) for r in of_part["accuracy"]):
        here = [r for r in of_part["accuracy"] if (r["scene"], r["exposure_rows"]) == (scene, exposure)]
        heads = " | ".join(f"noise {noise}: amplitude | period | PSNR" for noise in options.noises)
        text += [
            "",
            f"| {scene}, exposure of {exposure} rows | {heads} |",
            "|---" * (1 + 3 * len(options.noises)) + "|",
        ]
        for chain in chains:
            cells = [_accuracy_cells(r) for r in here if r["chain"] == chain]
            text.append(f"| {chain} | {' | '.join(cells)} |")
    text += [
        "",
        f"| a pair of {options.size} x {options.size} px | seconds | detection | restoration "
        "| FFT round trips: detection | restoration per frame | frames per second |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in of_part["speed"]:
        text.append(
            f"| {r['chain']} | {shown_seconds(r)} | {r['detection_seconds']:.3f} | {r['restoration_seconds']:.3f} "
            f"| {r['detection_round_trips']:.1f} | {r['restoration_round_trips']:.1f} | {r['frames_a_second']:.1f} |"
        )
    text += [
        "",
        f"Medians of {options.runs} alternating runs (range).",
        "",
        "| target | goal | measured | |",
        "|---|---|---|---|",
    ]
    text += [
        f"| {r['target']} | {r['goal']} | {r['value']:.2f} | {'met' if r['met'] else '**missed**'} |"
        for r in of_part["target"]
    ]
    if not any(r["chain"].endswith("on cuda") for r in of_part["speed"]):
        text += ["", "Frames per second on a GPU: not measured."]
    unsure = [row for row in of_part["accuracy"] if row["chain"] == OURS and not row["reliable"]]
    text += ["", f"Cases in which the detection is not reliable according to its own verdict: {len(unsure)}."]
    return [*text, "", *_losses(of_part["accuracy"], chains)]


def _losses(compared: list[dict[str, Any]], chains: list[str]) -> list[str]:
    """Cases in which chains of libraries are better: listed for the default chain, counted for the others."""
    text = []
    for chain in (chain for chain in chains if chain not in (PAPER, FASTEST)):
        behind = behind_libraries(compared, chain)
        cases = len({(row["scene"], row["exposure_rows"], row["noise"]) for row in compared})
        counts = ", ".join(f"{NAMES[name]} {sum(row['figure'] == name for row in behind)}" for name in FIGURES)
        text.append(
            f"- {chain} is less accurate than a chain of libraries in these numbers of {cases} cases: {counts}."
        )
        for row in behind if chain == OURS else ():
            scene, exposure, noise = row["case"]
            text.append(
                f"  - {NAMES[row['figure']]}, {scene}, {exposure} rows, noise {noise}: {row['own']:.3g} against "
                f"{row['theirs']:.3g} of {row['peer']}"
            )
    return text


def _accuracy_cells(row: dict[str, Any]) -> str:
    period = "lost" if math.isnan(row["period_percent"]) else f"{row['period_percent']:.3g}"
    psnr = "failed" if math.isnan(row["psnr_db"]) else f"{row['psnr_db']:.2f}"
    return f"{row['amplitude_percent']:.3g} | {period} | {psnr}"
