"""Trials: frames of a target, detection and restoration by the paper's methods and by the default ones.

The default restoration is done frame by frame, as in the paper, and also jointly from both frames. Two claims of the
paper are tried as well: image motion is not a limitation (Sec. 2.3), and 24 frames per second suffice for 50 Hz.
"""

import math
import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import torch
from benchmarks.independent_camera import Array, Shake
from reproduction.esfr import crossing, straight_edge_mtf
from reproduction.paper import AXES, EXPOSURE_ROWS, FRAME_ROWS, FREQUENCY, ROW_TIME, TARGETS, Target
from reproduction.scenes import Edge, Scene, draw, edges_of, shake_of, take_frames, with_noise
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from skimage.registration import phase_cross_correlation
from torch import Tensor

import rsvib_torch as rsv

BITS = 12
RIM = 32  # px at the border that are not evaluated, because they are partly outside the frame
MTF_FREQUENCY = np.linspace(0.0, 0.5, 51)  # cycles/px, of MTF curves
METHODS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {  # options of detection and restoration
    "paper": ({"method": "bands", "registration": "projection"}, {"method": "banded"}),
    "default": ({}, {}),
}
JOINT: dict[str, Any] = {"joint": 2}  # options of the joint restoration
RESTORED_BY = (*METHODS, "joint")
_PER_AXIS = ("period", "amplitude", "phase")


SPEEDS = (0.0, 500.0, 4000.0)  # px/s along x: 21 and 168 px from frame to frame, 0.2 and 1.6 px of motion blur
_SHUTTER_SIZE = (192, 256)
_SHUTTER_FRAMES = 24  # one second
_SHUTTER_NOISE = 0.005
_FINEST = 100  # steps per pixel of the registration of whole frames
_CANDIDATES = 4000  # number of trial frequencies up to half the frame rate


def camera(rows: int) -> rsv.SensorTiming:
    """The paper's camera; fewer rows are slower, so that frame period and exposure time are unchanged."""
    slower = FRAME_ROWS / rows
    return rsv.SensorTiming(row_time=ROW_TIME * slower, exposure_rows=EXPOSURE_ROWS / slower, frame_rows=rows)


def clean_frames(scene: Scene, shake: Shake) -> Array:
    """Two frames of the paper's camera without noise."""
    return take_frames(scene, shake, camera(len(scene.still)), 2)


def detection_values(result: rsv.DetectionResult, shake: Shake) -> dict[str, dict[str, Any]]:
    """Detected period (ms), amplitude (px), phase (π) of each axis, with errors in %, % and π."""
    truth = {"period": 1e3 / shake.frequency, "amplitude": shake.amplitude, "phase": shake.phase / np.pi}
    scale = {"period": 1e3, "amplitude": 1.0, "phase": 1 / np.pi}
    values: dict[str, dict[str, Any]] = {}
    for axis, name in enumerate(AXES):
        values[name] = {"reliable": bool(result.reliable[axis])}
        for quantity in _PER_AXIS:
            found, true = (
                scale[quantity] * float(getattr(result.vibration, quantity)[axis, 0]),
                truth[quantity][axis, 0],
            )
            apart = (found - true + 1) % 2 - 1 if quantity == "phase" else 100 * (found / true - 1)
            values[name] |= {quantity: found, f"{quantity}_error": float(apart)}
    return values


def mtf_values(image: Array, edges: Sequence[Edge]) -> dict[str, Any]:
    """Mean MTF over the edges of each axis: with a straight line as in ISO 12233, and along the distorted edge."""
    values: dict[str, Any] = {}
    for axis in sorted({edge.axis for edge in edges}):
        straight, along, refused = [], [], []
        for edge in edges:
            if edge.axis == axis:
                crop = np.ascontiguousarray(edge.crop(image))
                straight.append(straight_edge_mtf(crop, MTF_FREQUENCY))
                try:
                    curve = rsv.slanted_edge_mtf(torch.from_numpy(crop))
                    along.append(curve.at(torch.from_numpy(MTF_FREQUENCY)).numpy())
                except ValueError as error:
                    refused.append(str(error))
        values[axis] = {"refused": refused} | {
            name: {"curve": mean.tolist(), "nyquist": float(mean[-1]), "mtf50": crossing(MTF_FREQUENCY, mean)}
            for name, curves in (("straight", straight), ("along", along))
            if curves
            for mean in [np.mean(curves, axis=0)]
        }
    return values


def quality(images: Array, still: Array, edges: Sequence[Edge]) -> dict[str, Any]:
    """PSNR and SSIM (of scikit-image) and MTF of frames, one entry per frame."""
    inner = (slice(RIM, -RIM), slice(RIM, -RIM))
    pairs = [(still[inner].astype(np.float32), image[inner].astype(np.float32)) for image in images]
    window = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    return {
        "psnr": [float(peak_signal_noise_ratio(*pair, data_range=1.0)) for pair in pairs],
        "ssim": [float(structural_similarity(*pair, data_range=1.0, **window)) for pair in pairs],
        "mtf": [mtf_values(image, edges) for image in images] if edges else [],
    }


def run_trial(
    scene: Scene, shake: Shake, clean: Array, noise: float, seed: int, edges: Sequence[Edge] | None = None
) -> dict[str, Any]:
    """Add noise, detect, restore, and compare with the scene at rest; without edges (None) only detect."""
    taken = with_noise(clean, noise, BITS, np.random.default_rng([seed, round(1e6 * noise)]))
    values: dict[str, Any] = {"seed": seed, "noise": noise, "detection": {}, "restoration": {}}
    frames, timing = torch.from_numpy(taken).float(), camera(len(scene.still))
    found = {name: rsv.detect_vibration(frames, timing, **detecting) for name, (detecting, _) in METHODS.items()}
    values["detection"] = {name: detection_values(result, shake) for name, result in found.items()}
    if edges is None:
        return values
    values["degraded"] = quality(taken, scene.still, edges)
    restoring = {name: (found[name].vibration, options) for name, (_, options) in METHODS.items()}
    restoring["joint"] = (found["default"].vibration, JOINT)
    for name, (vibration, options) in restoring.items():
        restored: Tensor = rsv.restore(frames, timing, vibration, check=False, **options)
        values["restoration"][name] = quality(restored.double().numpy(), scene.still, edges)
    return values


def still_values(scene: Scene, noise: float, edges: Sequence[Edge]) -> dict[str, Any]:
    """Quality of a camera at rest with this noise."""
    taken = with_noise(scene.still[None], noise, BITS, np.random.default_rng(round(1e6 * noise)))
    return quality(taken, scene.still, edges)


def push_scan_trial(scene: Scene, speed: float, noise: float, seed: int) -> dict[str, Any]:
    """Detection with an image motion along the rows, with either sign."""
    shake = shake_of(seed, (speed * (-1) ** seed, 0.0))
    values = run_trial(scene, shake, clean_frames(scene, shake), noise, seed)
    return {"speed": speed, "detection": values["detection"]}


@dataclass(frozen=True)
class GlobalShutter:
    """Times of a camera that exposes all rows at once, s."""

    row_time: float
    exposure_time: float
    frame_period: float


def global_shutter(scene: Scene, seed: int) -> dict[str, Any]:
    """Frequency of the vibration in frames of a global shutter of the same frame rate: its alias.

    Whole frames are registered by scikit-image. The best-fitting tone is searched for up to half the frame rate.
    """
    shake, period = shake_of(seed), FRAME_ROWS * ROW_TIME
    frames = take_frames(scene, shake, GlobalShutter(0.0, EXPOSURE_ROWS * ROW_TIME, period), _SHUTTER_FRAMES)
    frames = with_noise(frames, _SHUTTER_NOISE, BITS, np.random.default_rng(seed))
    fade = np.outer(*(np.hanning(size) for size in scene.still.shape))
    windowed = [(frame - frame.mean()) * fade for frame in frames]
    apart = [
        phase_cross_correlation(frame, windowed[0], upsample_factor=_FINEST, normalization=None)[0]
        for frame in windowed
    ]
    times = np.arange(_SHUTTER_FRAMES) * period
    measured = dict(zip("yx", np.array(apart).T, strict=True))
    rate = 1.0 / period
    return {
        "frame_rate": rate,
        "times": times.tolist(),
        "displacement": {axis: measured[axis].tolist() for axis in AXES},
        "found": {axis: _best_frequency(times, measured[axis], 0.5 * rate) for axis in AXES},
        "alias": {axis: abs(math.remainder(FREQUENCY[axis], rate)) for axis in AXES},
        "true": FREQUENCY,
        "shake": {name: values.tolist() for name, values in asdict(shake).items()},
    }


def _best_frequency(times: Array, values: Array, highest: float) -> float:
    """Frequency of the sinusoid and constant with the smallest residual."""
    candidates = np.linspace(0.0, highest, _CANDIDATES + 1)[1:-1]
    left = []
    for frequency in candidates:
        angle = 2 * np.pi * frequency * times
        design = np.stack([np.sin(angle), np.cos(angle), np.ones_like(angle)], axis=1)
        rest = values - design @ np.linalg.lstsq(design, values, rcond=None)[0]
        left.append(float(rest @ rest))
    return float(candidates[int(np.argmin(left))])


@dataclass(frozen=True)
class Plan:
    """Size and number of the trials.

    Attributes:
        size: (rows, columns) of the frames.
        seeds: Number of trials, each with random phases and noise.
        noises: Standard deviations, fractions of full scale; the first is used for the tables.
        edges: Number of slanted edges per axis.
        speeds: Image motions in px/s.
        processes: Number of processes at a time.
    """

    size: tuple[int, int]
    seeds: int
    noises: tuple[float, ...]
    edges: int
    speeds: tuple[float, ...]
    processes: int


@dataclass(eq=False)
class Found:
    """Results: trials of each target, the camera at rest, and the claims."""

    trials: dict[Target, list[dict[str, Any]]] = field(default_factory=dict)
    still: dict[Target, list[dict[str, Any]]] = field(default_factory=dict)
    push_scan: list[dict[str, Any]] = field(default_factory=list)
    global_shutter: dict[str, Any] = field(default_factory=dict)


_scene: Scene  # of the current tasks; inherited by the processes
_edges: list[Edge]
_plan: Plan


def _restoration_task(seed: int) -> list[dict[str, Any]]:
    shake = shake_of(seed)
    clean = clean_frames(_scene, shake)
    return [run_trial(_scene, shake, clean, noise, seed, _edges) for noise in _plan.noises]


def _push_scan_task(task: tuple[float, int]) -> dict[str, Any]:
    speed, seed = task
    return push_scan_trial(_scene, speed, _plan.noises[0], seed)


def _start_process() -> None:
    torch.set_num_threads(1)


def _shared(function: Callable[[Any], Any], tasks: list[Any]) -> Iterator[Any]:
    """Results of tasks that run in separate processes, in the order of the tasks."""
    if _plan.processes == 1:
        yield from map(function, tasks)
        return
    with multiprocessing.get_context("fork").Pool(_plan.processes, _start_process) as pool:
        yield from pool.imap(function, tasks)


def run(plan: Plan, report: Any = print) -> Found:
    """Run all trials; ``report`` is called with messages of progress."""
    global _scene, _edges, _plan  # noqa: PLW0603  # scenes are too large to be sent to the processes
    _plan, found = plan, Found()
    for target, name in TARGETS.items():
        report(f"{name}: drawing the scene")
        _scene = draw(target, plan.size)
        _edges = edges_of(_scene.still, plan.edges) if target == "chart" else []
        found.still[target] = [{"noise": noise, **still_values(_scene, noise, _edges)} for noise in plan.noises]
        found.trials[target] = []
        for number, values in enumerate(_shared(_restoration_task, list(range(plan.seeds))), 1):
            report(f"{name}: trial {number} of {plan.seeds} done")
            found.trials[target] += values
    for speed in plan.speeds:
        if speed == 0:  # the trials of the tables
            still = [t for t in found.trials["landscape"] if t["noise"] == plan.noises[0]]
            found.push_scan += [{"speed": speed, "detection": t["detection"]} for t in still]
            continue
        report(f"push-scan: {speed:g} px/s")
        _scene = draw("landscape", plan.size, (speed, 0.0))
        found.push_scan += list(_shared(_push_scan_task, [(speed, seed) for seed in range(plan.seeds)]))
    report("global shutter")
    found.global_shutter = global_shutter(draw("landscape", _SHUTTER_SIZE), seed=0)
    return found
