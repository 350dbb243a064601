"""Detection and restoration of a pair of frames: accuracy and time of the package and of chains of other libraries.

The paper's chain: bands by ``cv2.matchTemplate`` with a parabola, ``scipy.optimize.curve_fit`` of Eqs. (4), (6)-(8) of
Liu et al. 2023, and ``skimage.restoration.wiener`` row by row (on some rows, its time scaled to all of them). The
fastest chain: the same detection, and ``cv2.remap``. All chains use only the frames and the timing of the camera,
except that the balance of the Wiener filter has the highest PSNR of several values. Frames of the accuracy figures come
from a camera made without the package.
"""

import argparse
import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import torch
from benchmarks import library_chain as libraries
from benchmarks.independent_camera import Shake, closed, take_frames
from benchmarks.resolution_chart import SCENES
from harness import Rows, in_turns, table, table_of
from numpy.typing import NDArray
from torch import Tensor

import rsvib_torch as rsv

OPTIONS = {
    "pipeline_rows": (2048, "pipeline: rows of the frames where chains are compared"),
    "grid_size": (512, "pipeline: columns of these frames"),
    "exposures": ((20, 100, 400), "pipeline: exposures in row times"),
    "noises": ((0.0, 0.005, 0.02), "pipeline: noise levels of full scale"),
    "scenes": (tuple(SCENES), "drawn scenes to compare on", SCENES),
}
QUICK = {"pipeline_rows": 384, "grid_size": 128, "exposures": (20,), "noises": (0.005,), "scenes": ("city",)}
SEED = 7
RIM, MARGIN, FADE = 32, 48, 24  # px
AMPLITUDE, FREQUENCY = (3.1, 5.2), (50.0, 30.0)
FULL_ROWS = 2048  # of the paper's camera
TIMED_BALANCE, TIMED_NOISE = 0.01, 0.005
PAPER, FASTEST = "matchTemplate, curve_fit, wiener rows (the paper's)", "matchTemplate, curve_fit, remap (fastest)"
OURS = "detect_vibration, restore"
DETECTIONS: dict[str, dict[str, Any]] = {  # options of detect_vibration; columns is the share of the columns
    "direct": {},
    "narrow": {"columns": 0.25},
    "ncc": {"method": "bands", "registration": "ncc"},
    "projection": {"method": "bands", "registration": "projection"},
    "narrow bands": {"method": "bands", "columns": 0.25},
}
CHAINS = {  # of the package: detection and method of restoration
    OURS: ("direct", "exact"),
    "detect_vibration on a quarter of the columns, restore": ("narrow", "exact"),
    'detect_vibration, "dewarp"': ("direct", "dewarp"),
    'detect_vibration on a quarter of the columns, "dewarp"': ("narrow", "dewarp"),
    '"bands" by "ncc", "dewarp"': ("ncc", "dewarp"),
    '"bands" by "projection", "dewarp"': ("projection", "dewarp"),
    '"bands" on a quarter of the columns, "dewarp"': ("narrow bands", "dewarp"),
}
FIGURES = {"amplitude_percent": "amplitude", "period_percent": "period", "psnr_db": "PSNR"}


# The frames


def camera(exposure: float, num_rows: int = FULL_ROWS) -> rsv.SensorTiming:
    """The paper's camera; fewer rows are slower, so that frame period and exposure time are unchanged."""
    slower = FULL_ROWS / num_rows
    return rsv.SensorTiming(row_time=20.52e-6 * slower, exposure_rows=exposure / slower, frame_rows=num_rows)


def vibration() -> rsv.Vibration:
    """The paper's vibration with random phases."""
    generator = torch.Generator().manual_seed(SEED)
    phase = (2 * torch.rand(2, generator=generator, dtype=torch.float64) - 1) * math.pi
    return rsv.Vibration(AMPLITUDE, FREQUENCY, phase)


def recordings(options: argparse.Namespace) -> Iterator[tuple[dict[str, Any], Tensor, Tensor, rsv.SensorTiming]]:
    """Scene, exposure and noise of every case, its two frames, the scene at rest, and the timing."""
    size = (options.pipeline_rows, options.grid_size)
    for name in options.scenes:
        scene = SCENES[name](size[0] + 2 * MARGIN, size[1] + 2 * MARGIN, SEED)
        still = scene[MARGIN:-MARGIN, MARGIN:-MARGIN]
        for exposure in options.exposures:
            timing = camera(exposure, size[0])
            taken = take_frames(closed(scene.double().numpy(), FADE), Shake.of(vibration()), timing, 2, size)
            clean = torch.from_numpy(taken).float()
            for noise in options.noises:
                frames = rsv.SensorNoise(read_noise=noise).apply(clean, torch.Generator().manual_seed(SEED))
                yield {"scene": name, "exposure_rows": exposure, "noise": noise}, frames, still, timing


# Accuracy


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
    wrong = (amplitude / true_amplitude - 1).abs()
    period = torch.where(amplitude <= 0, math.nan, (true_frequency / frequency - 1).abs())
    return {"amplitude_percent": 100 * float(wrong.max()), "period_percent": 100 * float(period.max())}


def restored_by(frames: Tensor, timing: rsv.SensorTiming, found: rsv.Vibration, method: str) -> Tensor:
    """Both frames restored by the package."""
    return rsv.restore(frames, timing, found, method=method)


def quality(restored: Tensor, still: Tensor) -> float:
    """PSNR in dB without the border."""
    return float(rsv.psnr(restored, still, 1.0, rim=RIM))


def compare_chains(frames: Tensor, still: Tensor, timing: rsv.SensorTiming) -> Rows:
    """Errors of the vibration, and the PSNR of the worse of the two frames, of every chain."""
    array, lib = frames.numpy(), libraries.detect_by_libraries(frames.numpy(), timing)
    try:
        by_rows = min(libraries.wiener_rows(array[i], timing, lib, still, RIM, i) for i in range(2))
    except ValueError:  # kernels of a row loop are larger than its slabs, because the detection failed
        by_rows = math.nan
    remapped = min(quality(libraries.remap_lanczos(array[i], timing, lib, i), still) for i in range(2))
    results = [
        {"chain": PAPER, **errors_of(lib), "psnr_db": by_rows, "reliable": None},
        {"chain": FASTEST, **errors_of(lib), "psnr_db": remapped, "reliable": None},
    ]
    found = {name: detect(frames, timing, name) for name in DETECTIONS}
    for name, (detection, method) in CHAINS.items():
        motion, reliable = found[detection].vibration, bool(found[detection].reliable.all())
        psnr = min(quality(frame, still) for frame in restored_by(frames, timing, motion, method))
        results.append({"chain": name, **errors_of(motion), "psnr_db": psnr, "reliable": reliable})
    return results


def behind_libraries(compared: Rows, chain: str) -> Rows:
    """Cases in which the better chain of libraries is more accurate: case, figure, peer and both values."""
    cases: dict[tuple[Any, ...], dict[str, dict[str, Any]]] = {}
    for row in compared:
        cases.setdefault((row["scene"], row["exposure_rows"], row["noise"]), {})[row["chain"]] = row
    found = []
    for case, rows_of in cases.items():
        for figure in FIGURES:
            sign = 1 if figure == "psnr_db" else -1
            values = [(sign * rows_of[peer][figure], peer) for peer in (PAPER, FASTEST)]
            best, peer = max((pair for pair in values if not math.isnan(pair[0])), default=(-math.inf, ""))
            ours = rows_of[chain][figure]
            if not sign * ours > best:
                found.append({"case": case, "figure": figure, "peer": peer, "ours": ours, "theirs": sign * best})
    return found


# Time


def speed(options: argparse.Namespace) -> Rows:
    """Seconds of every chain, of detection and of restoration, also in FFT round trips of one frame."""
    size, timing = options.size, camera(20, options.size)
    scene = SCENES["city"](size + 2 * MARGIN, size + 2 * MARGIN, SEED)
    noise, generator = rsv.SensorNoise(read_noise=TIMED_NOISE), torch.Generator().manual_seed(SEED)
    frames = rsv.simulate_frames(
        scene, timing, vibration(), 2, frame_size=(size, size), noise=noise, generator=generator
    )
    results = []
    for device in options.device:
        taken, chains = frames.to(device), dict(CHAINS)
        found = detect(taken, timing, "direct").vibration
        works: dict[str, Callable[[], Any]] = {
            "round trip": lambda f=taken: torch.fft.irfft2(torch.fft.rfft2(f[0]), s=f.shape[1:]),
            **{name: partial(detect, taken, timing, name) for name in DETECTIONS},
            **{method: partial(restored_by, taken, timing, found, method) for method in ("exact", "dewarp")},
        }
        if device == "cpu":
            array, rows_ = frames.numpy(), libraries.sampled_rows(size, RIM)
            lib = libraries.detect_by_libraries(array, timing)
            works["libraries"] = partial(libraries.detect_by_libraries, array, timing)
            works["wiener"] = lambda a=array, r=rows_, v=lib: [
                libraries.wiener_loop(libraries.slabs_and_kernels(a[i], r, timing, v, i), TIMED_BALANCE)
                for i in range(2)
            ]
            works["remap"] = lambda a=array, v=lib: [libraries.remap_lanczos(a[i], timing, v, i) for i in range(2)]
            chains = {PAPER: ("libraries", "wiener"), FASTEST: ("libraries", "remap"), **chains}
        done = in_turns(works, options.runs)
        if "wiener" in done:
            done["wiener"] *= size / len(rows_)
        results += [
            {
                "chain": name if device == "cpu" else f"{name} on {device}",
                **_figures(done[first], done[second], done["round trip"]),
            }
            for name, (first, second) in chains.items()
        ]
    return results


def _figures(detection: NDArray[Any], restoration: NDArray[Any], round_trip: NDArray[Any]) -> dict[str, float]:
    """Median, shortest and longest time of both steps, and the medians of each."""
    whole, medians = detection + restoration, [float(np.median(one)) for one in (detection, restoration, round_trip)]
    seconds = float(np.median(whole))
    return {
        "seconds": seconds,
        "seconds_least": float(whole.min()),
        "seconds_most": float(whole.max()),
        "detection_seconds": medians[0],
        "restoration_seconds": medians[1],
        "detection_round_trips": medians[0] / medians[2],
        "restoration_round_trips": medians[1] / 2 / medians[2],
        "frames_a_second": 2 / seconds,
    }


# The tables


def rows(options: argparse.Namespace) -> Rows:
    """Accuracy of every chain on every scene, exposure and noise; time of all chains."""
    compared = [
        {"part": "accuracy", **case, **row}
        for case, frames, still, timing in recordings(options)
        for row in compare_chains(frames, still, timing)
    ]
    return compared + [{"part": "speed", **row} for row in speed(options)]


def lines(results: Rows, options: argparse.Namespace) -> list[str]:
    compared, timed = ([row for row in results if row["part"] == part] for part in ("accuracy", "speed"))
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
    text += table_of(
        timed,
        (f"a pair of {options.size} x {options.size} px", "{chain}"),
        ("seconds", "{seconds:.3f} ({seconds_least:.3f} to {seconds_most:.3f})"),
        ("detection", "{detection_seconds:.3f}"),
        ("restoration", "{restoration_seconds:.3f}"),
        ("FFT round trips: detection", "{detection_round_trips:.1f}"),
        ("restoration per frame", "{restoration_round_trips:.1f}"),
        ("frames per second", "{frames_a_second:.1f}"),
    )
    unsure = [row for row in compared if row["chain"] == OURS and not row["reliable"]]
    text += [
        f"Medians of {options.runs} alternating runs (range).",
        "",
        f"Cases in which the detection is not reliable according to its own verdict: {len(unsure)}.",
        "",
    ]
    # Cases in which chains of libraries are better: listed for the default chain, counted for the others.
    cases = len({(row["scene"], row["exposure_rows"], row["noise"]) for row in compared})
    for chain in CHAINS:
        behind = behind_libraries(compared, chain)
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
