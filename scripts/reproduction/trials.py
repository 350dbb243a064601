"""One trial: frames of a target, detection and restoration by the paper's methods and by the default ones.

The default restoration is done frame by frame, as in the paper, and also jointly from both frames.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from benchmarks.independent_camera import Array, Shake
from reproduction.camera import Scene, take_frames, with_noise
from reproduction.esfr import crossing, straight_edge_mtf
from reproduction.paper import AXES, EXPOSURE_ROWS, FRAME_ROWS, ROW_TIME
from reproduction.targets import Edge
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torch import Tensor

import rsvib_torch as rsv

BITS = 12
RIM = 32  # px at the border that are not evaluated, because they are partly outside the frame
FREQUENCY = np.linspace(0.0, 0.5, 51)  # cycles/px, of MTF curves
METHODS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {  # options of detection and restoration
    "paper": ({"method": "bands", "registration": "projection"}, {"method": "banded"}),
    "default": ({}, {}),
}
JOINT: dict[str, Any] = {"joint": 2}  # options of the joint restoration
RESTORED_BY = (*METHODS, "joint")
_PER_AXIS = ("period", "amplitude", "phase")


@dataclass(frozen=True, eq=False)
class Images:
    """Values of a trial, and images for the figures."""

    values: dict[str, Any]
    frames: Array
    restored: dict[str, Array] = field(default_factory=dict)
    detections: dict[str, rsv.DetectionResult] = field(default_factory=dict)


def camera(rows: int) -> rsv.SensorTiming:
    """The paper's camera; fewer rows are slower, so that frame period and exposure time are unchanged."""
    slower = FRAME_ROWS / rows
    return rsv.SensorTiming(row_time=ROW_TIME * slower, exposure_rows=EXPOSURE_ROWS / slower, frame_rows=rows)


def clean_frames(scene: Scene, shake: Shake) -> Array:
    """Two frames of the paper's camera without noise."""
    timing = camera(len(scene.still))
    return take_frames(
        scene,
        shake,
        row_time=timing.row_time,
        exposure_time=timing.exposure_time,
        frame_period=timing.frame_period,
        num_frames=2,
    )


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
                straight.append(straight_edge_mtf(crop, FREQUENCY))
                try:
                    curve = rsv.slanted_edge_mtf(torch.from_numpy(crop))
                    along.append(curve.at(torch.from_numpy(FREQUENCY)).numpy())
                except ValueError as error:
                    refused.append(str(error))
        values[axis] = {"refused": refused} | {
            name: {"curve": mean.tolist(), "nyquist": float(mean[-1]), "mtf50": crossing(FREQUENCY, mean)}
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


def as_frames(images: Array) -> Tensor:
    """Noisy frames as float32 tensor."""
    return torch.from_numpy(images).float()


def run_trial(
    scene: Scene,
    shake: Shake,
    clean: Array,
    noise: float,
    seed: int,
    edges: Sequence[Edge] = (),
    *,
    restore: bool = True,
) -> Images:
    """Add noise, detect, restore, and compare with the scene at rest."""
    taken = with_noise(clean, noise, BITS, np.random.default_rng([seed, round(1e6 * noise)]))
    values: dict[str, Any] = {"seed": seed, "noise": noise, "detection": {}, "restoration": {}}
    images, timing = Images(values, taken), camera(len(scene.still))
    if restore:
        values["degraded"] = quality(taken, scene.still, edges)
    for name, (detecting, restoring) in METHODS.items():
        result = rsv.detect_vibration(as_frames(taken), timing, **detecting)
        values["detection"][name] = detection_values(result, shake)
        images.detections[name] = result
        if restore:
            restored = rsv.restore(as_frames(taken), timing, result.vibration, check=False, **restoring)
            images.restored[name] = restored.double().numpy()
            values["restoration"][name] = quality(images.restored[name], scene.still, edges)
    if restore:
        vibration = images.detections["default"].vibration
        jointly = rsv.restore(as_frames(taken), timing, vibration, check=False, **JOINT)
        values["restoration"]["joint"] = quality(jointly.double().numpy(), scene.still, edges)
    return images


def still_values(scene: Scene, noise: float, edges: Sequence[Edge]) -> dict[str, Any]:
    """Quality of a camera at rest with this noise."""
    taken = with_noise(scene.still[None], noise, BITS, np.random.default_rng(round(1e6 * noise)))
    return quality(taken, scene.still, edges)
