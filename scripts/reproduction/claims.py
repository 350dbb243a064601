"""Two claims of the paper: image motion is not a limitation (Sec. 2.3), and 24 frames per second suffice for 50 Hz."""

import math
from typing import Any

import numpy as np
from benchmarks.independent_camera import Array, Shake
from reproduction.camera import Scene, take_frames, with_noise
from reproduction.paper import AXES, EXPOSURE_ROWS, FRAME_ROWS, FREQUENCY, ROW_TIME
from reproduction.targets import shake_of
from reproduction.trials import BITS, clean_frames, run_trial
from skimage.registration import phase_cross_correlation

SPEEDS = (0.0, 500.0, 4000.0)  # px/s along x: 21 and 168 px from frame to frame, 0.2 and 1.6 px of motion blur
_SHUTTER_FRAMES = 24  # one second
_SHUTTER_NOISE = 0.005
_FINEST = 100  # steps per pixel of the registration of whole frames
_CANDIDATES = 4000  # number of trial frequencies up to half the frame rate


def push_scan_trial(scene: Scene, speed: float, noise: float, seed: int) -> dict[str, Any]:
    """Detection with an image motion along the rows, with either sign."""
    shake = shake_of(seed, (speed * (-1) ** seed, 0.0))
    values = run_trial(scene, shake, clean_frames(scene, shake), noise, seed, restore=False).values
    return {"speed": speed, "detection": values["detection"]}


def global_shutter(scene: Scene, seed: int) -> dict[str, Any]:
    """Frequency of the vibration in frames of a global shutter of the same frame rate: its alias.

    Whole frames are registered by scikit-image. The best-fitting tone is searched for up to half the frame rate.
    """
    shake, period = shake_of(seed), FRAME_ROWS * ROW_TIME
    frames = take_frames(
        scene,
        shake,
        row_time=0.0,
        exposure_time=EXPOSURE_ROWS * ROW_TIME,
        frame_period=period,
        num_frames=_SHUTTER_FRAMES,
    )
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
        "shake": _plain(shake),
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


def _plain(shake: Shake) -> dict[str, Any]:
    return {name: getattr(shake, name).tolist() for name in ("amplitude", "frequency", "phase")}
