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
from benchmarks import detection_report
from benchmarks.detection_cases import CASES, NAMES, PAPER, SMALL, Take, take
from benchmarks.independent_camera import Array, Shake

import rsvib_torch as rsv

NOISES = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05)
SEED = 11
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


def monte_carlo(options: argparse.Namespace) -> list[dict[str, Any]]:
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


def held_out_cases(options: argparse.Namespace) -> list[dict[str, Any]]:
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


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this part."""
    group = parser.add_argument_group("detection")
    group.add_argument("--quick", action="store_true", help="fewer trials and cases")
    group.add_argument("--detection-method", default="direct", help="method of detect_vibration (default: direct)")
    group.add_argument("--detection-size", type=int, nargs=2, default=(1024, 512), help="rows, columns of the trials")
    group.add_argument("--detection-noises", type=float, nargs="+", default=NOISES, help="noise levels of full scale")
    group.add_argument("--detection-scenes", type=int, default=2, help="drawn scenes (default: 2)")
    group.add_argument("--detection-phases", type=int, default=4, help="draws of the phases (default: 4)")
    group.add_argument("--detection-repeats", type=int, default=4, help="draws of the noise (default: 4)")
    group.add_argument("--detection-images", type=Path, nargs="*", default=[], help="image files as further scenes")
    group.add_argument("--cases", action="store_true", help="also run the held-out cases")
    group.add_argument("--case-size", type=int, nargs=2, default=(2048, 1024), help="rows, columns of the cases")
    group.add_argument("--case-scenes", type=int, default=2, help="scenes of each case (default: 2)")
    group.add_argument("--case-phases", type=int, default=3, help="draws of the phases of each case (default: 3)")


def rows(options: argparse.Namespace) -> list[dict[str, Any]]:
    """The Monte Carlo trials, and with ``--cases`` the cases."""
    if options.quick:
        options = argparse.Namespace(**vars(options) | quick_options())
    return monte_carlo(options) + (held_out_cases(options) if options.cases else [])


def quick_options() -> dict[str, Any]:
    """Options that ``--quick`` sets."""
    return {
        "detection_noises": (0.002, 0.01, 0.05),
        "detection_scenes": 1,
        "detection_phases": 2,
        "detection_repeats": 2,
        "case_scenes": 1,
        "case_phases": 1,
    }


lines = detection_report.lines
