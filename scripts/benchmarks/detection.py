"""Accuracy of detection, compared with the Cramér-Rao bound, and with goals on cases not used for development.

Frames come from benchmarks/independent_camera.py, which shares no code with the package. Monte Carlo: pairs of many
noise seeds, phases and scenes; errors over the bound for an unknown scene, and how often the 95 % intervals contain the
truth. Cases: largest and root-mean-square error in per cent and π.
"""

import argparse
import itertools
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from benchmarks.detection_cases import CASES, NAMES, PAPER, SMALL, Take, take
from benchmarks.independent_camera import Array, Shake
from harness import Rows, table

import rsvib_torch as rsv

NOISES = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05)
SEED = 11
OPTIONS = {
    "detection_method": ("direct", "method of detect_vibration"),
    "detection_size": ((1024, 512), "rows, columns of the trials"),
    "detection_noises": (NOISES, "noise levels of full scale"),
    "detection_scenes": (2, "drawn scenes"),
    "detection_phases": (4, "draws of the phases"),
    "detection_repeats": (4, "draws of the noise"),
    "detection_images": ((), "image files as further scenes", Path),
    "cases": (False, "also run the held-out cases"),
    "case_size": ((2048, 1024), "rows, columns of the cases"),
    "case_scenes": (2, "scenes of each case"),
    "case_phases": (3, "draws of the phases of each case"),
}
QUICK = {
    "detection_size": (512, 256),
    "detection_noises": (0.01,),
    "detection_scenes": 1,
    "detection_phases": 1,
    "detection_repeats": 2,
    "case_size": (512, 256),
    "case_scenes": 1,
    "case_phases": 1,
}
NEAR = 0.05  # of the frequency; a tone with a larger error is a different one


def errors_of(found: rsv.DetectionResult, shake: Shake) -> tuple[dict[str, Array], dict[str, Array]]:
    """Errors and estimated standard deviations of each true tone (2, K); NaN if it was not detected."""
    errors = {name: np.full(shake.amplitude.shape, np.nan) for name in NAMES}
    stated = {name: np.full(shake.amplitude.shape, np.nan) for name in NAMES}
    vibration, std = found.vibration, found.std
    for axis, tone in np.ndindex(shake.amplitude.shape):
        if shake.amplitude[axis, tone] == 0:
            continue
        present = vibration.amplitude[axis] > 0
        miss = torch.where(present, (vibration.frequency[axis] - shake.frequency[axis, tone]).abs(), math.inf)
        best = int(miss.argmin())
        if float(miss[best]) > NEAR * shake.frequency[axis, tone]:
            continue
        for name in NAMES:
            error = float(getattr(vibration, name)[axis, best]) - getattr(shake, name)[axis, tone]
            errors[name][axis, tone] = math.remainder(error, 2 * math.pi) if name == "phase" else error
            stated[name][axis, tone] = float(getattr(std, name)[axis, best])
    return errors, stated


def trial(taken: Take, noise: float, seed: int, method: str) -> dict[str, Any]:
    """Detect in noisy frames: errors, also in units of the estimated standard deviation."""
    generator = np.random.default_rng(seed)
    frames = torch.from_numpy(taken.frames + noise * generator.standard_normal(taken.frames.shape)).float()
    begin = time.perf_counter()
    found = rsv.detect_vibration(frames, taken.timing, method=method)
    seconds = time.perf_counter() - begin
    errors, stated = errors_of(found, taken.shake)
    with np.errstate(divide="ignore", invalid="ignore"):
        over_stated = {name: errors[name] / stated[name] for name in NAMES}
        percent = {
            "period": 100 * (taken.shake.frequency / (taken.shake.frequency + errors["frequency"]) - 1),
            "amplitude": 100 * errors["amplitude"] / taken.shake.amplitude,
            "phase": errors["phase"] / math.pi,
        }
    extra = int((found.vibration.amplitude > 0).sum()) - int((taken.shake.amplitude > 0).sum())
    return {
        "seconds": seconds,
        "errors": errors,
        "over_stated": over_stated,
        "percent": percent,
        "extra": extra,
        "reliable": found.reliable.numpy(),
    }


def monte_carlo(options: argparse.Namespace) -> Rows:
    """Errors over the bound for every motion and noise, pooled over scenes, phases and seeds."""
    size = tuple(options.detection_size)
    sources = [SEED + i for i in range(options.detection_scenes)] + list(options.detection_images)
    results = []
    for motion in (PAPER, SMALL) if sources else ():
        trials: dict[float, list[dict[str, Any]]] = {noise: [] for noise in options.detection_noises}
        for (i, source), phase in itertools.product(enumerate(sources), range(options.detection_phases)):
            taken = take(motion, source, size, 2, seed=1000 * i + phase)
            # the bound for an unknown scene is proportional to the noise
            unit = taken.bound("projection", 1.0)
            for noise in options.detection_noises:
                random = taken.bound("random", noise)
                for repeat in range(options.detection_repeats):
                    done = trial(taken, noise, hash_seed(i, phase, repeat, noise), options.detection_method)
                    done["bound"] = {name: noise * unit[name] for name in NAMES}
                    done["random"] = random
                    done["truth"] = taken.shake
                    trials[noise].append(done)
        results += [
            {"part": "monte carlo", "motion": motion.name, "noise": noise, "size": size, **pooled(done)}
            for noise, done in trials.items()
        ]
    return results


def hash_seed(*values: float) -> list[int]:
    """A different seed for every trial."""
    return [int(1e6 * value) for value in values]


def _rms(values: Array) -> float:
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if values.size else math.nan


def pooled(trials: list[dict[str, Any]]) -> dict[str, Any]:
    """Statistics of many trials of one motion and noise; values per axis are lists (x, y)."""
    result: dict[str, Any] = {"trials": len(trials), "seconds": float(np.median([t["seconds"] for t in trials]))}
    for name in NAMES:
        ratio = np.array([t["errors"][name] / t["bound"][name] for t in trials])
        stated = np.array([t["over_stated"][name] for t in trials])
        random = np.array([t["random"][name] / t["bound"][name] for t in trials])
        result[name] = {
            "over_bound": [_rms(ratio[:, axis]) for axis in range(2)],
            "over_stated": [_rms(stated[:, axis]) for axis in range(2)],
            "random_over_bound": [_rms(random[:, axis]) for axis in range(2)],
            "rms": [_rms(np.array([t["errors"][name][axis] for t in trials])) for axis in range(2)],
            "bound": [_rms(np.array([t["bound"][name][axis] for t in trials])) for axis in range(2)],
            "random": [_rms(np.array([t["random"][name][axis] for t in trials])) for axis in range(2)],
        }
    everything = np.array([[t["errors"][name] / t["bound"][name] for name in NAMES] for t in trials])
    stated = np.array([[t["over_stated"][name] for name in NAMES] for t in trials])
    known = np.isfinite(stated)
    covered = float((np.abs(stated[known]) <= 1.96).mean()) if known.any() else math.nan
    independent = max(known.sum() / len(NAMES), 1.0)  # the errors of the parameters of a tone are correlated
    result["over_bound"] = _rms(everything)
    squares = np.array([_rms(one) ** 2 for one in everything])
    squares = squares[np.isfinite(squares)]
    result["over_bound_std"] = (
        float(squares.std(ddof=1) / math.sqrt(len(squares)) / (2 * result["over_bound"]))
        if len(squares) > 1
        else math.nan
    )
    result["coverage"] = covered
    result["coverage_std"] = math.sqrt(max(covered * (1 - covered), 0.25 / independent) / independent)
    result["lost"] = float(1 - known.mean())
    result["extra_tones"] = float(np.mean([t["extra"] for t in trials]))
    result["reliable"] = float(np.mean([t["reliable"] for t in trials]))
    for name in ("period", "amplitude", "phase"):
        values = np.array([t["percent"][name] for t in trials])
        result[f"{name}_error"] = {
            "rms": [_rms(values[:, axis]) for axis in range(2)],
            "largest": float(np.nanmax(np.abs(values))) if np.isfinite(values).any() else math.nan,
            "all_rms": _rms(values),
        }
    return result


def held_out_cases(options: argparse.Namespace) -> Rows:
    """Largest and root-mean-square errors of the cases, over scenes and phases."""
    size = tuple(options.case_size)
    results = []
    for number, case in enumerate(CASES):
        done = []
        for scene, phase in itertools.product(range(options.case_scenes), range(options.case_phases)):
            taken = take(case.motion, SEED + 100 + scene, size, case.num_frames, seed=7000 + 100 * number + phase)
            bound = taken.bound("gradients", case.noise)
            result = trial(taken, case.noise, hash_seed(number, scene, phase), options.detection_method)
            done.append({**result, "bound": bound, "random": bound})
        results.append(
            {
                "part": "case",
                "motion": case.motion.name,
                "noise": case.noise,
                "num_frames": case.num_frames,
                "size": size,
                "goal": case.goal,
                **pooled(done),
            }
        )
    return results


def rows(options: argparse.Namespace) -> Rows:
    """The Monte Carlo trials, and with ``--cases`` the cases."""
    return monte_carlo(options) + (held_out_cases(options) if options.cases else [])


def _number(value: float) -> str:
    return f"{value:.2g}" if abs(value) < 1 else f"{value:.1f}"


def _pair(values: list[float]) -> str:
    return ", ".join(_number(value) for value in values)


def lines(results: Rows, options: argparse.Namespace) -> list[str]:
    """The figures as Markdown tables."""
    text: list[str] = []
    trials = [r for r in results if r["part"] == "monte carlo"]
    for motion in dict.fromkeys(r["motion"] for r in trials):
        of_motion = [r for r in trials if r["motion"] == motion]
        height, width = of_motion[0]["size"]
        text += [
            f"{motion}: pairs of {height} x {width} px, {of_motion[0]['trials']} trials per line, "
            f"{of_motion[0]['seconds']:.1f} s each. Errors are root-mean-square values for x, y; the bound is that for "
            "an unknown scene, in brackets the ratio of the bound for a random scene to it.",
            "",
        ]
        heads = ("noise", "period (%)", "amplitude (%)", "phase (π)", "error / bound: amplitude", "frequency", "phase")
        heads += ("all", "error / estimated std", "in 95 % interval", "missed", "extra tones", "reliable")
        lines_of_motion = []
        for r in of_motion:
            over = [
                f"{_pair(r[name]['over_bound'])} ({_pair(r[name]['random_over_bound'])})"
                for name in ("amplitude", "frequency", "phase")
            ]
            stated = [value for name in NAMES for value in r[name]["over_stated"]]
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
            lines_of_motion.append(cells)
        text += table(heads, lines_of_motion)
    cases = [r for r in results if r["part"] == "case"]
    if not cases:
        return text
    height, width = cases[0]["size"]
    text += [
        f"Cases, {height} x {width} px, {cases[0]['trials']} trials each: largest error (root-mean-square), goal.",
        "",
    ]
    lines_of_cases = []
    for r in cases:
        cells = [r["motion"], str(r["num_frames"]), f"{r['noise']:g}"]
        for name, goal in zip(("period", "amplitude", "phase"), r["goal"], strict=True):
            error = r[f"{name}_error"]
            shown = f"{_number(error['largest'])} ({_number(error['all_rms'])})"
            cells += [shown if error["largest"] <= goal else f"**{shown}**", f"{goal:g}"]
        cells += [f"{r['over_bound']:.2f}", f"{100 * r['lost']:.0f} %", f"{r['extra_tones']:.2f}"]
        lines_of_cases.append([*cells, f"{r['seconds']:.1f}"])
    heads = ("case", "frames", "noise", "period (%)", "goal", "amplitude (%)", "goal", "phase (π)", "goal")
    return text + table((*heads, "error / bound", "missed", "extra tones", "seconds"), lines_of_cases)
