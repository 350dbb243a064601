"""Tables and figures of the detection benchmark."""

import argparse
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from rsvib_torch.report.plots import save_figure

Results = list[dict[str, Any]]
UNITS = {"amplitude": "px", "frequency": "Hz", "phase": "rad"}
COLOURS = ("#c8102e", "#14487a")  # x, y


def _number(value: float) -> str:
    return f"{value:.2g}" if abs(value) < 1 else f"{value:.1f}"


def _pair(values: list[float]) -> str:
    return ", ".join(_number(value) for value in values)


def lines(results: Results, options: argparse.Namespace) -> list[str]:
    """The figures as Markdown tables."""
    text: list[str] = []
    trials = [r for r in results if r["part"] == "monte carlo"]
    for motion in dict.fromkeys(r["motion"] for r in trials):
        own = [r for r in trials if r["motion"] == motion]
        height, width = own[0]["size"]
        text += [
            f"{motion}: pairs of {height} x {width} px, {own[0]['trials']} trials per line, "
            f"{own[0]['seconds']:.1f} s each. Errors are root-mean-square values for x, y; the bound is that for an "
            "unknown scene, in brackets the ratio of the bound for a random scene to it.",
            "",
            "| noise | period (%) | amplitude (%) | phase (π) | error / bound: amplitude | frequency | phase | all "
            "| error / estimated std | in 95 % interval | missed | extra tones | reliable |",
            "|---|---|---|---|---|---|---|---|---|---|---|---|---|",
        ]
        for r in own:
            over = [
                f"{_pair(r[name]['over_bound'])} ({_pair(r[name]['random_over_bound'])})"
                for name in ("amplitude", "frequency", "phase")
            ]
            stated = [value for name in UNITS for value in r[name]["over_stated"]]
            cells = [
                f"{r['noise']:g}",
                *(_pair(r[f"{name}_error"]["rms"]) for name in ("period", "amplitude", "phase")),
                *over,
                f"**{r['over_bound']:.2f}** ± {r['over_bound_std']:.2f}",
                f"{(sum(v * v for v in stated) / len(stated)) ** 0.5:.2f}",
                f"{100 * r['coverage']:.0f} ± {100 * r['coverage_std']:.0f} %",
                f"{100 * r['lost']:.0f} %",
                f"{r['extra_tones']:.2f}",
                f"{100 * r['reliable']:.0f} %",
            ]
            text.append("| " + " | ".join(cells) + " |")
        text.append("")
    cases = [r for r in results if r["part"] == "case"]
    if cases:
        height, width = cases[0]["size"]
        text += [
            f"Cases, {height} x {width} px, {cases[0]['trials']} trials each: largest error (root-mean-square), goal.",
            "",
            "| case | frames | noise | period (%) | goal | amplitude (%) | goal | phase (π) | goal | error / bound "
            "| missed | extra tones | seconds |",
            "|---|---|---|---|---|---|---|---|---|---|---|---|---|",
        ]
    for r in cases:
        cells = [r["motion"], str(r["num_frames"]), f"{r['noise']:g}"]
        for name, goal in zip(("period", "amplitude", "phase"), r["goal"], strict=True):
            error = r[f"{name}_error"]
            shown = f"{_number(error['largest'])} ({_number(error['all_rms'])})"
            cells += [shown if error["largest"] <= goal else f"**{shown}**", f"{goal:g}"]
        cells += [
            f"{r['over_bound']:.2f}",
            f"{100 * r['lost']:.0f} %",
            f"{r['extra_tones']:.2f}",
            f"{r['seconds']:.1f}",
        ]
        text.append("| " + " | ".join(cells) + " |")
    return text


def draw(results: Results, out: Path) -> None:
    """Draw root-mean-square errors and bounds over the noise, one figure for every motion."""
    trials = [r for r in results if r["part"] == "monte carlo"]
    for number, motion in enumerate(dict.fromkeys(r["motion"] for r in trials)):
        own = sorted((r for r in trials if r["motion"] == motion), key=lambda r: r["noise"])
        figure = Figure(figsize=(12, 4.2), layout="constrained")
        panels = figure.subplots(1, 3)
        figure.suptitle(motion, fontsize=11)
        noise = [r["noise"] for r in own]
        for panel, (name, unit) in zip(panels, UNITS.items(), strict=True):
            for axis, colour in enumerate(COLOURS):
                label = "xy"[axis]
                curves = {key: [r[name][key][axis] for r in own] for key in ("rms", "bound", "random")}
                panel.loglog(noise, curves["bound"], color=colour, linewidth=1.2, label=f"{label}: bound")
                panel.loglog(
                    noise,
                    curves["random"],
                    color=colour,
                    linewidth=1.0,
                    linestyle=":",
                    label=f"{label}: bound, random scene",
                )
                panel.loglog(noise, curves["rms"], color=colour, marker="o", linewidth=0, label=f"{label}: error")
            panel.set_title(name, fontsize=10)
            panel.set_xticks(noise, [f"{value:g}" for value in noise])
            panel.set_xticks([], minor=True)
            panel.set_xlabel("noise (fraction of full scale)")
            panel.set_ylabel(f"root-mean-square error ({unit})")
            panel.grid(color="#d9d9d9", linewidth=0.6, which="both")
            panel.spines[["top", "right"]].set_visible(False)
        panels[0].legend(fontsize=8, frameon=False)
        save_figure(figure, out / f"detection_{number + 1}.png")
