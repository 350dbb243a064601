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

import numpy as np
import torch
from benchmarks.independent_camera import Shake, closed, take_frames
from benchmarks.library_chain import detect_by_libraries, kernel_of_row
from benchmarks.measure import Timed, in_turns, named
from benchmarks.pipeline_report import (
    DEWARP,
    FASTEST,
    NARROW,
    NARROW_BANDS,
    NARROW_DEWARP,
    OURS,
    PAPER,
    behind_libraries,
    lines,
    targets,
)
from benchmarks.registration import fastest_method
from benchmarks.restoration import (
    AMPLITUDE,
    FADE,
    FREQUENCY,
    MARGIN,
    RIM,
    SCENES,
    SEED,
    TIMED_NOISE,
    fft_round_trip,
    quality,
    vibration,
)
from benchmarks.restoration_peers import (
    Peer,
    by_wiener,
    loop_rows,
    remap_lanczos,
    restore_rows,
    rows_and_displacements,
    sampled_rows,
)
from numpy.typing import NDArray
from torch import Tensor

import rsvib_torch as rsv

__all__ = ["add_options", "behind_libraries", "lines", "rows", "targets"]

WIENER = "skimage wiener, row loop"
TIMED_BALANCE = 0.01
REGISTRATION = "ncc"  # default of detect_vibration


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this section; scenes, exposures, noises and the width of the frames are those of restoration."""
    parser.add_argument(
        "--pipeline-rows", type=int, default=2048, help="rows of the frames where chains are compared (default: 2048)"
    )


def bands_chain(registration: str) -> str:
    """Name of the chain of the fastest methods of the package."""
    return f'"bands" by "{registration}", "dewarp"'


def quarter(frames: Tensor) -> int:
    """Number of columns of the faster chains: a quarter, at least 96."""
    return max(96, frames.shape[-1] // 4)


def camera(exposure: float, num_rows: int) -> rsv.SensorTiming:
    """The paper's camera; fewer rows are slower, so that frame period and exposure time are unchanged."""
    slower = 2048 / num_rows
    return rsv.SensorTiming(row_time=20.52e-6 * slower, exposure_rows=exposure / slower, frame_rows=num_rows)


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
        return [Peer(frame, 0.0, "") for frame in rsv.restore(frames, timing, found, method=method)]


def compare_chains(
    frames: Tensor, still: Tensor, timing: rsv.SensorTiming, registrations: list[str]
) -> list[dict[str, Any]]:
    """Errors of the vibration, and the PSNR of the worse of the two frames, of every chain."""
    array = frames.numpy()
    by_libraries = detect_by_libraries(array, timing)
    direct = rsv.detect_vibration(frames, timing)
    narrow = rsv.detect_vibration(frames, timing, columns=quarter(frames))
    found: dict[str, tuple[rsv.DetectionResult, str]] = {
        OURS: (direct, "exact"),
        NARROW: (narrow, "exact"),
        DEWARP: (direct, "dewarp"),
        NARROW_DEWARP: (narrow, "dewarp"),
    }
    for registration in registrations:
        bands = rsv.detect_vibration(frames, timing, method="bands", registration=registration)
        found[bands_chain(registration)] = (bands, "dewarp")
    found[NARROW_BANDS] = (
        rsv.detect_vibration(frames, timing, method="bands", columns=quarter(frames)),
        "dewarp",
    )
    chains: dict[str, tuple[rsv.Vibration, Callable[[], list[Peer]]]] = {
        PAPER: (
            by_libraries,
            lambda: [loop_rows(WIENER, array[i], timing, by_libraries, still, RIM, i) for i in range(2)],
        ),
        FASTEST: (by_libraries, lambda: [remap_lanczos(array[i], timing, by_libraries, i) for i in range(2)]),
    }
    for name, (result, method) in found.items():
        restore = lambda v=result.vibration, m=method: restored_by(frames, timing, v, m)  # noqa: E731
        chains[name] = (result.vibration, restore)
    results = []
    for name, (vibration_of, restore) in chains.items():
        try:
            psnr = min(quality(figure, still) for figure in restore())
        except ValueError:  # kernels of a row loop are larger than its slabs, because the detection failed
            psnr = math.nan
        reliable = bool(found[name][0].reliable.all()) if name in found else None
        results.append({"chain": name, **errors_of(vibration_of), "psnr_db": psnr, "reliable": reliable})
    return results


def accuracy(options: argparse.Namespace, registrations: list[str]) -> list[dict[str, Any]]:
    """Every chain on every scene, exposure and noise."""
    truth, size = vibration(), (options.pipeline_rows, options.grid_size)
    shake = Shake(*(values.numpy() for values in (truth.amplitude, truth.frequency, truth.phase, truth.image_motion)))
    results = []
    for name in options.scenes:
        scene = SCENES[name](size[0] + 2 * MARGIN, size[1] + 2 * MARGIN, SEED)
        still = scene[MARGIN:-MARGIN, MARGIN:-MARGIN]
        for exposure in options.exposures:
            timing = camera(exposure, size[0])
            taken = take_frames(
                closed(scene.double().numpy(), FADE),
                shake,
                row_time=timing.row_time,
                exposure_rows=timing.exposure_rows,
                frame_rows=timing.frame_rows,
                num_frames=2,
                size=size,
            )
            clean = torch.from_numpy(taken).float()
            for noise in options.noises:
                frames = rsv.SensorNoise(read_noise=noise).apply(clean, torch.Generator().manual_seed(SEED))
                case = {"part": "accuracy", "scene": name, "exposure_rows": exposure, "noise": noise}
                results += [{**case, **row} for row in compare_chains(frames, still, timing, registrations)]
    return results


def wiener_loop(
    frame: NDArray[np.float32], rows: Tensor, timing: rsv.SensorTiming, found: rsv.Vibration, index: int
) -> NDArray[np.float32]:
    """Rows of frame ``index`` restored one after another: kernel, slab, Wiener filter (Secs. 3.1 and 3.2)."""
    shown_by, _ = rows_and_displacements(rows, timing, found, index)
    starts = (timing.frame_starts(index + 1)[index] + shown_by * timing.row_time).tolist()
    middles = shown_by.round().long()
    kernels = [
        kernel_of_row(found, start, timing, moved)
        for start, moved in zip(starts, (middles - rows).tolist(), strict=True)
    ]
    return restore_rows(frame, middles.tolist(), kernels, by_wiener(TIMED_BALANCE))


def _of_libraries(frames: Tensor, timing: rsv.SensorTiming) -> dict[str, Callable[[], Any]]:
    """Tasks of the libraries, on the CPU."""
    array = frames.numpy()
    found = detect_by_libraries(array, timing)
    rows = sampled_rows(frames.shape[-2], RIM)
    return {
        "libraries": lambda: detect_by_libraries(array, timing),
        "wiener": lambda: [wiener_loop(array[i], rows, timing, found, i) for i in range(2)],
        "remap": lambda: [remap_lanczos(array[i], timing, found, i) for i in range(2)],
    }


def _of_the_package(frames: Tensor, timing: rsv.SensorTiming, registrations: list[str]) -> dict[str, Callable[[], Any]]:
    """Tasks of the package, on the device of the frames."""
    found = rsv.detect_vibration(frames, timing).vibration
    works: dict[str, Callable[[], Any]] = {
        "round trip": lambda: fft_round_trip(frames[0]),
        "direct": lambda: rsv.detect_vibration(frames, timing),
        "exact": lambda: restored_by(frames, timing, found, "exact"),
        "dewarp": lambda: restored_by(frames, timing, found, "dewarp"),
        "narrow": lambda: rsv.detect_vibration(frames, timing, columns=quarter(frames)),
        "narrow bands": lambda: rsv.detect_vibration(frames, timing, method="bands", columns=quarter(frames)),
    }
    for name in registrations:
        works[name] = lambda n=name: rsv.detect_vibration(frames, timing, method="bands", registration=n)
    return works


def speed(
    options: argparse.Namespace, frames: Tensor, timing: rsv.SensorTiming, registrations: list[str]
) -> list[dict[str, Any]]:
    """Seconds of every chain, of detection and of restoration, also in FFT round trips of one frame."""
    results = []
    for device in options.device:
        taken = frames.to(device)
        pieces = _of_the_package(taken, timing, registrations)
        chains = {
            OURS: ("direct", "exact"),
            NARROW: ("narrow", "exact"),
            DEWARP: ("direct", "dewarp"),
            NARROW_DEWARP: ("narrow", "dewarp"),
        }
        chains |= {bands_chain(registration): (registration, "dewarp") for registration in registrations}
        chains[NARROW_BANDS] = ("narrow bands", "dewarp")
        if device == "cpu":
            pieces |= _of_libraries(taken, timing)
            chains = {PAPER: ("libraries", "wiener"), FASTEST: ("libraries", "remap"), **chains}
        done = in_turns(pieces, options.runs)
        if "wiener" in done:
            count = len(sampled_rows(frames.shape[-2], RIM))
            done["wiener"] = done["wiener"].scaled(frames.shape[-2] / count)
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


def rows(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Accuracy and time of all chains, and the targets."""
    size, timing = options.size, camera(20, options.size)
    scene = SCENES["city"](size + 2 * MARGIN, size + 2 * MARGIN, SEED)
    noise, generator = rsv.SensorNoise(read_noise=TIMED_NOISE), torch.Generator().manual_seed(SEED)
    frames = rsv.simulate_frames(
        scene, timing, vibration(), 2, frame_size=(size, size), noise=noise, generator=generator
    )
    fastest, _ = fastest_method(frames, timing, options.runs)
    registrations = list(dict.fromkeys([REGISTRATION, fastest]))
    compared = accuracy(options, registrations)
    timed = speed(options, frames, timing, registrations)
    return [*compared, *timed, *targets(compared, timed)]
