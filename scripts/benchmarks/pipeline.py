"""Detection and restoration of a pair of frames: accuracy and time of the package and of chains of other libraries.

The paper's chain: bands by ``cv2.matchTemplate`` with a parabola, ``scipy.optimize.curve_fit`` of Eqs. (4), (6)-(8) of
Liu et al. 2023, and ``skimage.restoration.wiener`` row by row (on some rows, its time scaled to all of them). The
fastest chain: the same detection, and ``cv2.remap``. All chains use only the frames and the timing of the camera,
except that the balance of the Wiener filter has the highest PSNR of several values. Frames of the accuracy figures come
from a camera made without the package.
"""

import argparse
import math
import warnings
from collections.abc import Callable
from typing import Any

import torch
from benchmarks import restoration
from benchmarks.library_chain import detect_by_libraries
from benchmarks.restoration import (
    AMPLITUDE,
    FREQUENCY,
    MARGIN,
    RIM,
    SCENES,
    SEED,
    camera,
    quality,
    recordings,
    vibration,
)
from benchmarks.restoration_peers import Peer, remap_lanczos, sampled_rows, slabs_and_kernels, wiener_loop, wiener_rows
from harness import Rows, Timed, in_turns, named, shown_seconds, table
from torch import Tensor

import rsvib_torch as rsv

OPTIONS = restoration.OPTIONS | {"pipeline_rows": (2048, "pipeline: rows of the frames where chains are compared")}
QUICK = restoration.QUICK | {"pipeline_rows": 384}
TIMED_BALANCE, TIMED_NOISE = 0.01, 0.005
PAPER, FASTEST = "matchTemplate, curve_fit, wiener rows (the paper's)", "matchTemplate, curve_fit, remap (fastest)"
OURS, DEWARP = "detect_vibration, restore", 'detect_vibration, "dewarp"'
NARROW = "detect_vibration on a quarter of the columns, restore"
NARROW_DEWARP = 'detect_vibration on a quarter of the columns, "dewarp"'
DETECTIONS: dict[str, dict[str, Any]] = {  # options of detect_vibration; columns is the share of the columns
    "direct": {},
    "narrow": {"columns": 0.25},
    "ncc": {"method": "bands", "registration": "ncc"},
    "projection": {"method": "bands", "registration": "projection"},
    "narrow bands": {"method": "bands", "columns": 0.25},
}
CHAINS = {  # of the package: detection and method of restoration
    OURS: ("direct", "exact"),
    NARROW: ("narrow", "exact"),
    DEWARP: ("direct", "dewarp"),
    NARROW_DEWARP: ("narrow", "dewarp"),
    '"bands" by "ncc", "dewarp"': ("ncc", "dewarp"),
    '"bands" by "projection", "dewarp"': ("projection", "dewarp"),
    '"bands" on a quarter of the columns, "dewarp"': ("narrow bands", "dewarp"),
}
FIGURES = {"amplitude_percent": "amplitude", "period_percent": "period", "psnr_db": "PSNR"}
# frames per second: of the paper's camera, and the goal for restoration on a large GPU
CAMERA_RATE, GOAL_RATE = 24.0, 100.0


def detect(frames: Tensor, timing: rsv.SensorTiming, name: str) -> rsv.DetectionResult:
    """The vibration, by one of ``DETECTIONS``; at least 96 columns are used."""
    options = dict(DETECTIONS[name])
    if "columns" in options:
        options["columns"] = max(96, int(options["columns"] * frames.shape[-1]))
    return rsv.detect_vibration(frames, timing, **options)


def errors_of(found: rsv.Vibration) -> dict[str, float]:
    """Errors of amplitude and period in % of the strongest tone, on the axis that has the larger one."""
    amplitude, frequency = found.amplitude[:, 0].cpu(), found.frequency[:, 0].cpu()
    true_amplitude, true_frequency = (torch.tensor(v, dtype=torch.float64) for v in (AMPLITUDE, FREQUENCY))
    lost = amplitude <= 0
    wrong = (amplitude / true_amplitude - 1).abs()
    period = torch.where(lost, math.nan, (true_frequency / frequency - 1).abs())
    return {"amplitude_percent": 100 * float(wrong.max()), "period_percent": 100 * float(period.max())}


def restored_by(frames: Tensor, timing: rsv.SensorTiming, found: rsv.Vibration, method: str) -> list[Peer]:
    """Both frames restored by the package."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rsv.RestorationWarning)
        return [Peer(frame, 0.0) for frame in rsv.restore(frames, timing, found, method=method)]


def compare_chains(frames: Tensor, still: Tensor, timing: rsv.SensorTiming) -> Rows:
    """Errors of the vibration, and the PSNR of the worse of the two frames, of every chain."""
    array, found = frames.numpy(), {name: detect(frames, timing, name) for name in DETECTIONS}
    by_libraries = detect_by_libraries(array, timing)
    chains: dict[str, tuple[rsv.Vibration, bool | None, Callable[[], list[Peer]]]] = {
        PAPER: (
            by_libraries,
            None,
            lambda: [wiener_rows(array[i], timing, by_libraries, still, RIM, i) for i in range(2)],
        ),
        FASTEST: (by_libraries, None, lambda: [remap_lanczos(array[i], timing, by_libraries, i) for i in range(2)]),
    }
    for name, (detection, method) in CHAINS.items():
        vibration_of, reliable = found[detection].vibration, bool(found[detection].reliable.all())
        chains[name] = (
            vibration_of,
            reliable,
            lambda v=vibration_of, m=method: restored_by(frames, timing, v, m),
        )
    results = []
    for name, (vibration_of, reliable, restore) in chains.items():
        try:
            psnr = min(quality(figure, still) for figure in restore())
        except ValueError:  # kernels of a row loop are larger than its slabs, because the detection failed
            psnr = math.nan
        results.append({"chain": name, **errors_of(vibration_of), "psnr_db": psnr, "reliable": reliable})
    return results


def accuracy(options: argparse.Namespace) -> Rows:
    """Every chain on every scene, exposure and noise."""
    size = (options.pipeline_rows, options.grid_size)
    return [
        {"part": "accuracy", **case, **row}
        for case, frames, still, timing in recordings(options, size, size[0])
        for row in compare_chains(frames, still, timing)
    ]


def fft_round_trip(frame: Tensor) -> Tensor:
    """The unit of time: forward and inverse ``torch.fft`` in float32."""
    image: Tensor = torch.fft.irfft2(torch.fft.rfft2(frame), s=frame.shape)
    return image


def speed(options: argparse.Namespace, frames: Tensor, timing: rsv.SensorTiming) -> Rows:
    """Seconds of every chain, of detection and of restoration, also in FFT round trips of one frame."""
    results = []
    for device in options.device:
        taken, chains = frames.to(device), dict(CHAINS)
        found = detect(taken, timing, "direct").vibration
        works: dict[str, Callable[[], Any]] = {
            "round trip": lambda f=taken: fft_round_trip(f[0]),
            **{name: lambda n=name, f=taken: detect(f, timing, n) for name in DETECTIONS},
            **{
                method: lambda m=method, f=taken, v=found: restored_by(f, timing, v, m)
                for method in ("exact", "dewarp")
            },
        }
        if device == "cpu":
            array, rows_ = frames.numpy(), sampled_rows(frames.shape[-2], RIM)
            lib = detect_by_libraries(array, timing)
            works["libraries"] = lambda a=array: detect_by_libraries(a, timing)
            works["wiener"] = lambda a=array, r=rows_, v=lib: [
                wiener_loop(slabs_and_kernels(a[i], r, timing, v, i), TIMED_BALANCE) for i in range(2)
            ]
            works["remap"] = lambda a=array, v=lib: [remap_lanczos(a[i], timing, v, i) for i in range(2)]
            chains = {PAPER: ("libraries", "wiener"), FASTEST: ("libraries", "remap"), **chains}
        done = in_turns(works, options.runs)
        if "wiener" in done:
            done["wiener"] = done["wiener"].scaled(frames.shape[-2] / len(rows_))
        results += [
            {"part": "speed", "chain": named(name, device), **_figures(done[first], done[second], done["round trip"])}
            for name, (first, second) in chains.items()
        ]
    return results


def _figures(detection: Timed, restoration: Timed, round_trip: Timed) -> dict[str, float]:
    whole = detection + restoration
    return {
        **whole.figures(),
        "detection_seconds": detection.seconds,
        "restoration_seconds": restoration.seconds,
        "detection_round_trips": detection.seconds / round_trip.seconds,
        "restoration_round_trips": restoration.seconds / 2 / round_trip.seconds,
        "frames_a_second": 2 / whole.seconds,
        "frames_restored_a_second": 2 / restoration.seconds,
    }


def rows(options: argparse.Namespace) -> Rows:
    """Accuracy and time of all chains, and the targets."""
    size, timing = options.size, camera(20, options.size)
    scene = SCENES["city"](size + 2 * MARGIN, size + 2 * MARGIN, SEED)
    noise, generator = rsv.SensorNoise(read_noise=TIMED_NOISE), torch.Generator().manual_seed(SEED)
    frames = rsv.simulate_frames(
        scene, timing, vibration(), 2, frame_size=(size, size), noise=noise, generator=generator
    )
    compared, timed = accuracy(options), speed(options, frames, timing)
    return [*compared, *timed, *targets(compared, timed)]


def _target(target: str, value: float, goal: float, *, at_least: bool = False) -> dict[str, Any]:
    met = value >= goal if at_least else value <= goal
    bound = f"at least {goal:g}" if at_least else f"at most {goal:g}"
    return {"part": "target", "target": target, "value": value, "goal": bound, "met": met}


def targets(compared: Rows, timed: Rows) -> Rows:
    """Targets, and whether they are met."""
    speed_of = {row["chain"]: row for row in timed}
    found = []
    if OURS in speed_of:
        ours, paper, fastest = (speed_of[name]["seconds"] for name in (OURS, PAPER, FASTEST))
        narrow = speed_of[NARROW]["seconds"]
        found += [
            _target("time of the paper's chain over ours", paper / ours, 10.0, at_least=True),
            _target(f"time of the paper's chain over {NARROW}", paper / narrow, 10.0, at_least=True),
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
        both, restored = on_gpu["frames_a_second"], on_gpu["frames_restored_a_second"]
        found += [
            _target("frames per second on cuda, detected and restored", both, CAMERA_RATE, at_least=True),
            _target("frames restored per second on cuda", restored, GOAL_RATE, at_least=True),
        ]
    for chain in (OURS, NARROW):
        behind = behind_libraries(compared, chain)
        for figure, name in FIGURES.items():
            worse = sum(row["figure"] == figure for row in behind)
            text = f"cases where a chain of libraries is ahead of {chain} in {name}"
            found.append(_target(text, float(worse), 0.0))
    return found


def behind_libraries(compared: Rows, chain: str) -> Rows:
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
            ours, theirs = rows_of[chain][figure], rows_of[best][figure]
            if not sign * ours > sign * theirs:
                found.append({"case": case, "figure": figure, "peer": best, "ours": ours, "theirs": theirs})
    return found


def lines(results: Rows, options: argparse.Namespace) -> list[str]:
    """The figures as Markdown tables."""
    of_part = {part: [r for r in results if r["part"] == part] for part in ("accuracy", "speed", "target")}
    compared = of_part["accuracy"]
    text = [
        f"Detection and restoration of a pair of frames, {options.pipeline_rows} x {options.grid_size} px. Errors of "
        "amplitude and period in % on the worse axis, PSNR in dB of the worse frame. The row loop processes "
        "a sample of the rows; its time, with that of computing its kernels by NumPy, is scaled to all rows.",
        "",
    ]
    chains = list(dict.fromkeys(row["chain"] for row in compared))
    for scene, exposure in dict.fromkeys((r["scene"], r["exposure_rows"]) for r in compared):
        here = [r for r in compared if (r["scene"], r["exposure_rows"]) == (scene, exposure)]
        heads = [head for noise in options.noises for head in (f"noise {noise}: amplitude", "period", "PSNR")]
        cells = [
            [chain, *(cell for r in here if r["chain"] == chain for cell in _accuracy_cells(r))] for chain in chains
        ]
        text += table((f"{scene}, exposure of {exposure} rows", *heads), cells)
    heads = [f"a pair of {options.size} x {options.size} px", "seconds", "detection", "restoration"]
    text += table(
        (*heads, "FFT round trips: detection", "restoration per frame", "frames per second"),
        [
            (
                r["chain"],
                shown_seconds(r),
                *(f"{r[f'{part}_seconds']:.3f}" for part in ("detection", "restoration")),
                *(f"{r[f'{part}_round_trips']:.1f}" for part in ("detection", "restoration")),
                f"{r['frames_a_second']:.1f}",
            )
            for r in of_part["speed"]
        ],
    )
    text += [f"Medians of {options.runs} alternating runs (range).", ""]
    goals = [
        (r["target"], r["goal"], f"{r['value']:.2f}", "met" if r["met"] else "**missed**") for r in of_part["target"]
    ]
    text += table(("target", "goal", "measured", ""), goals)
    if not any(r["chain"].endswith("on cuda") for r in of_part["speed"]):
        text += ["Frames per second on a GPU: not measured.", ""]
    unsure = [row for row in compared if row["chain"] == OURS and not row["reliable"]]
    text += [f"Cases in which the detection is not reliable according to its own verdict: {len(unsure)}.", ""]
    return text + _losses(compared, chains)


def _losses(compared: Rows, chains: list[str]) -> list[str]:
    """Cases in which chains of libraries are better: listed for the default chain, counted for the others."""
    text = []
    for chain in (chain for chain in chains if chain not in (PAPER, FASTEST)):
        behind = behind_libraries(compared, chain)
        cases = len({(row["scene"], row["exposure_rows"], row["noise"]) for row in compared})
        counts = ", ".join(f"{FIGURES[name]} {sum(row['figure'] == name for row in behind)}" for name in FIGURES)
        text.append(
            f"- {chain} is less accurate than a chain of libraries in these numbers of {cases} cases: {counts}."
        )
        for row in behind if chain == OURS else ():
            scene, exposure, noise = row["case"]
            text.append(
                f"  - {FIGURES[row['figure']]}, {scene}, {exposure} rows, noise {noise}: {row['ours']:.3g} against "
                f"{row['theirs']:.3g} of {row['peer']}"
            )
    return text


def _accuracy_cells(row: dict[str, Any]) -> tuple[str, str, str]:
    period = "lost" if math.isnan(row["period_percent"]) else f"{row['period_percent']:.3g}"
    psnr = "failed" if math.isnan(row["psnr_db"]) else f"{row['psnr_db']:.2f}"
    return f"{row['amplitude_percent']:.3g}", period, psnr
