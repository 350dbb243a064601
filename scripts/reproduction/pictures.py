"""Figures 4 to 9 of the paper, reproduced, and figures of its claims."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from benchmarks.independent_camera import Array
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from reproduction.cells import at_noise
from reproduction.paper import AXES, AXIS_NAMES, DETECTED, FREQUENCY, TARGETS
from reproduction.text import NAMES
from reproduction.trials import FREQUENCY as MTF_FREQUENCY
from reproduction.trials import METHODS
from reproduction.work import Found, Plan

from rsvib_torch.report.html import BeforeAfter, Drawing, before_after, drawing
from rsvib_torch.report.plots import axis_offset_figure, detailed_places, plain_axes

_COLOURS = {"paper": "#c26a00", "default": "#14487a", "still": "#222222", "degraded": "#9a9a9a"}
_WINDOW = 96  # px, of details
_BAND = 32  # rows


def _show(panel: Axes, image: Array, title: str, **options: Any) -> None:
    panel.imshow(image, cmap="gray", **{"interpolation": "nearest", "vmin": 0.0, "vmax": 1.0, **options})
    panel.set_title(title, loc="left", fontsize=10)
    panel.set_xticks([])
    panel.set_yticks([])


def frames_figure(frames: Array) -> Figure:
    """Frames p and p + 1 side by side, like Figures 4 and 7."""
    figure = Figure(figsize=(7.6, 0.3 + 3.8 * frames.shape[1] / frames.shape[2]), layout="constrained")
    step = max(1, frames.shape[1] // 1024)
    for panel, frame, title in zip(figure.subplots(1, 2), frames, ("(a) frame p", "(b) frame p + 1"), strict=True):
        _show(panel, frame[::step, ::step], title, interpolation="antialiased")
    return figure


def windows_figure(frames: Array) -> Figure:
    """Bands of rows of both frames below each other, like Figure 5."""
    rows = np.linspace(0.1, 0.85, 6) * frames.shape[1]
    figure = Figure(figsize=(7.6, 5.2), layout="constrained")
    panels = figure.subplots(len(rows), 2)
    width = min(frames.shape[2], 480)
    left = (frames.shape[2] - width) // 2
    for line, row in zip(panels, rows.astype(int), strict=True):
        for panel, frame, name in zip(line, frames, ("p", "p + 1"), strict=True):
            title = f"frame {name}, rows {row} … {row + _BAND - 1}"
            _show(panel, frame[row : row + _BAND, left : left + width], title)
    return figure


def restored_figure(found: Found, target: Any) -> Figure:
    """Details before and after restoration, and the difference from the scene at rest, like Figures 8 and 9."""
    images, still = found.images[target], found.scenes[target].still
    rim = 48
    inner = torch.from_numpy(still[rim:-rim, rim:-rim])
    row, column = (place + rim for place in detailed_places(inner, _WINDOW, 1)[0])
    detail = (slice(row, row + _WINDOW), slice(column, column + _WINDOW))
    shown = {"frame p": images.frames[0], **{NAMES[m]: images.restored[m][0] for m in METHODS}}
    figure = Figure(figsize=(9.6, 5.6), layout="constrained")
    panels = figure.subplots(2, 4)
    for panel_pair, (name, image) in zip(panels.T, {"still scene": still, **shown}.items(), strict=True):
        _show(panel_pair[0], image[detail], name)
        error = image - still
        _show(panel_pair[1], error[detail], "difference from the scene at rest", vmin=-0.05, vmax=0.05)
        rms = float(np.sqrt(np.mean(error[rim:-rim, rim:-rim] ** 2)))
        panel_pair[1].set_xlabel(f"whole frame: rms {rms:.4f}", fontsize=9)
    return figure


def mtf_figure(found: Found, plan: Plan, axis: str) -> Figure:
    """MTF curves of the chart's edges, straight line: camera at rest, degraded, restored."""
    noise = plan.noises[0]
    trials, still = at_noise(found.trials["chart"], noise), at_noise(found.still["chart"], noise)[0]
    kinds = {
        "degraded": ("degraded", [frame for t in trials for frame in t["degraded"]["mtf"]]),
        **{m: (NAMES[m], [frame for t in trials for frame in t["restoration"][m]["mtf"]]) for m in METHODS},
        "still": ("still camera", still["mtf"]),
    }
    figure = Figure(figsize=(5.6, 4.4), layout="constrained")
    panel = figure.subplots()
    for kind, (name, frames) in kinds.items():
        curves = np.array([frame[axis]["straight"]["curve"] for frame in frames])
        colour = _COLOURS[kind]
        if kind != "still":
            panel.fill_between(MTF_FREQUENCY, curves.min(0), curves.max(0), color=colour, alpha=0.15, linewidth=0)
        style = {"linestyle": "--"} if kind == "still" else {}
        panel.plot(MTF_FREQUENCY, curves.mean(0), color=colour, linewidth=1.7, label=name, **style)
    panel.set_xlim(0, 0.5)
    panel.set_ylim(0, 1.1)
    panel.set_xlabel("frequency (cycles/px)")
    panel.set_ylabel(f"MTF, {AXIS_NAMES[axis]}")
    panel.legend(fontsize=9, frameon=False)
    plain_axes(panel)
    return figure


def errors_figure(found: Found, plan: Plan) -> Figure:
    """Every trial's errors of period and amplitude, with the paper's as bars."""
    figure = Figure(figsize=(11.4, 4.0), layout="constrained")
    for panel, quantity in zip(figure.subplots(1, 2), ("period", "amplitude"), strict=True):
        places = [(target, axis) for target in TARGETS for axis in AXES]
        for place, (target, axis) in enumerate(places):
            paper = getattr(DETECTED[target][axis], f"{quantity}_error")
            panel.plot([place - 0.35, place + 0.35], [paper] * 2, color="#c8102e", linewidth=2.5)
            for method, shift in zip(METHODS, (-0.15, 0.15), strict=True):
                trials = at_noise(found.trials[target], plan.noises[0])
                errors = np.abs([t["detection"][method][axis][f"{quantity}_error"] for t in trials])
                spots = place + shift + 0.1 * (np.arange(len(errors)) / max(1, len(errors) - 1) - 0.5)
                panel.plot(spots, errors, "o", color=_COLOURS[method], markersize=4, alpha=0.8)
        panel.set_yscale("log")
        panel.set_xticks(range(len(places)), [f"{TARGETS[t]}\n{AXIS_NAMES[a]}" for t, a in places])
        panel.set_ylabel(f"error of the {quantity} (%)")
        panel.plot([], [], color="#c8102e", linewidth=2.5, label="the paper")
        for method in METHODS:
            panel.plot([], [], "o", color=_COLOURS[method], markersize=4, label=NAMES[method])
        plain_axes(panel)
    panel.legend(fontsize=9, frameon=False, loc="best")
    return figure


def sampling_figure(found: Found) -> Figure:
    """50 Hz sampled by a global shutter of the same frame rate: samples, true vibration, and alias."""
    shutter = found.global_shutter
    figure = Figure(figsize=(5.6, 4.2), layout="constrained")
    panel = figure.subplots()
    times = np.array(shutter["times"])
    fine = np.linspace(0, times[-1], 3000)
    shake = shutter["shake"]
    amplitude, phase = shake["amplitude"][0][0], shake["phase"][0][0]
    true = amplitude * (np.sin(2 * np.pi * FREQUENCY["x"] * fine + phase) - np.sin(phase))
    panel.plot(1e3 * fine, true, color="#d0d4d8", linewidth=0.9, label="true, 50 Hz")
    values, found_frequency = np.array(shutter["displacement"]["x"]), shutter["found"]["x"]
    angle = 2 * np.pi * found_frequency
    design = _sine(angle, times)
    fit = _sine(angle, fine) @ np.linalg.lstsq(design, values, rcond=None)[0]
    panel.plot(
        1e3 * fine, fit, color="#c8102e", linewidth=1.4, label=f"best fit to the frames, {found_frequency:.2f} Hz"
    )
    panel.plot(1e3 * times, values, "o", color="#222222", markersize=4, label="displacement of each frame")
    panel.set_xlabel("time (ms)")
    panel.set_ylabel("displacement along x (px)")
    panel.set_ylim(true.min() - 0.3, true.max() + 0.45 * np.ptp(true))
    panel.legend(fontsize=9, frameon=False, loc="upper right")
    plain_axes(panel)
    return figure


def _sine(angle: float, times: Array) -> Array:
    return np.stack([np.sin(angle * times), np.cos(angle * times), np.ones_like(times)], axis=1)


@dataclass(frozen=True)
class Gallery:
    """All figures by section, and overviews with a divider."""

    figures: dict[str, list[Drawing]]
    overviews: dict[str, BeforeAfter]


def gallery(found: Found, plan: Plan) -> Gallery:
    """Draw everything."""
    figures: dict[str, list[Drawing]] = {"detection": [], "frames": [], "restoration": [], "mtf": [], "claims": []}

    def add(section: str, number: str, make: Callable[[], Figure], title: str, caption: str) -> None:
        figures[section].append(drawing(make(), number, title, caption))

    add(
        "detection",
        "errors",
        lambda: errors_figure(found, plan),
        "Errors of detection",
        f"Every trial at noise {plan.noises[0]:g}; red bars: the paper.",
    )
    for target, frame_number in (("chart", 4), ("landscape", 7)):
        images, name = found.images[target], TARGETS[target]
        add(
            "frames",
            f"figure_{frame_number}",
            lambda images=images: frames_figure(images.frames),
            f"As Figure {frame_number}",
            f"Two consecutive frames, {name}.",
        )
    add(
        "frames",
        "figure_5",
        lambda: windows_figure(found.images["chart"].frames),
        "As Figure 5",
        "Bands of rows of both frames: the later one is displaced.",
    )
    for axis, letter in enumerate("ab"):
        for method in METHODS:
            add(
                "frames",
                f"figure_6{letter}_{method}",
                lambda axis=axis, method=method: axis_offset_figure(found.images["chart"].detections[method], axis),
                f"As Figure 6 ({letter})",
                f"Relative offset and fit, {AXIS_NAMES[AXES[axis]]}, {NAMES[method]}.",
            )
    for target, number in (("chart", 8), ("landscape", 9)):
        add(
            "restoration",
            f"figure_{number}",
            lambda target=target: restored_figure(found, target),
            f"As Figure {number}",
            f"A detail of the {TARGETS[target]} target before and after restoration; below, the "
            "difference from the scene at rest, ten times amplified.",
        )
    for axis in AXES:
        add(
            "mtf",
            f"mtf_{axis}",
            lambda axis=axis: mtf_figure(found, plan, axis),
            f"MTF, {AXIS_NAMES[axis]}",
            "Slanted edges measured with a straight line; bands span all frames of all trials.",
        )
    add(
        "claims",
        "sampling",
        lambda: sampling_figure(found),
        "50 Hz through a global shutter",
        "24 frames per second of a global shutter cannot distinguish 50 Hz from 2.4 Hz; two frames of a rolling "
        "shutter can.",
    )
    overviews = {
        name: before_after(
            torch.from_numpy(found.images[target].frames[0]),
            torch.from_numpy(found.images[target].restored["default"][0]),
            names=("frame p", "restored"),
            caption=f"{name}, trial 1, default methods.",
            longest=1180,
        )
        for target, name in TARGETS.items()
    }
    return Gallery(figures, overviews)
