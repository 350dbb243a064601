"""Figures of the reproduction: errors of all trials, and the alias of a global shutter."""

import numpy as np
from benchmarks.independent_camera import Array
from matplotlib.figure import Figure
from reproduction.cells import NAMES, at_noise
from reproduction.paper import AXES, AXIS_NAMES, DETECTED, FREQUENCY, TARGETS
from reproduction.trials import METHODS, Found, Plan

from rsvib_torch.report.plots import plain_axes

_COLOURS = {"paper": "#c26a00", "default": "#14487a"}


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
