"""Vibrations to detect with the largest errors allowed, and simulated frames."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from benchmarks.independent_camera import Array, Shake, closed, take_frames

import rsvib_torch as rsv
from rsvib_torch.evaluation import city_and_fields, cramer_rao_bound

RIM = 24  # px; width of the border over which a scene fades to its mean
ROW_TIME, EXPOSURE_ROWS, FRAME_ROWS = 20.52e-6, 20.0, 2048  # the camera; frames with fewer rows have slower rows
NAMES = ("amplitude", "frequency", "phase")


@dataclass(frozen=True)
class Motion:
    """A vibration with random phases, one list of tones for each axis (x, y)."""

    name: str
    amplitude: tuple[tuple[float, ...], tuple[float, ...]]
    frequency: tuple[tuple[float, ...], tuple[float, ...]]
    image_motion: tuple[float, float] = (0.0, 0.0)

    def shake(self, generator: np.random.Generator) -> Shake:
        """The motion with random phases and a random sign of the image motion."""
        phase = generator.uniform(-math.pi, math.pi, np.shape(self.amplitude))
        motion = np.array(self.image_motion) * generator.choice([-1.0, 1.0])
        return Shake(np.array(self.amplitude), np.array(self.frequency), phase, motion)


PAPER = Motion("3.1 px 50 Hz, 5.2 px 30 Hz", ((3.1,), (5.2,)), ((50.0,), (30.0,)))
SMALL = Motion("0.2 px and 0.13 px 155 Hz", ((0.2,), (0.13,)), ((155.0,), (155.0,)))
TWO_TONES = Motion("two tones per axis", ((1.5, 0.5), (1.1, 0.4)), ((41.0, 133.0), (67.0, 180.0)))


@dataclass(frozen=True)
class Case:
    """A motion, its noise, and the largest errors allowed: period and amplitude in %, phase in π."""

    motion: Motion
    noise: float
    goal: tuple[float, float, float]
    num_frames: int = 2


CASES = (
    Case(PAPER, 0.005, (0.01, 0.15, 0.001)),
    Case(PAPER, 0.02, (0.03, 0.6, 0.003)),
    Case(SMALL, 0.005, (0.1, 1.0, 0.01)),
    Case(
        Motion("500 px/s along x, 1.2 px 83 Hz, 0.8 px 110 Hz", ((1.2,), (0.8,)), ((83.0,), (110.0,)), (500.0, 0.0)),
        0.005,
        (0.03, 0.2, 0.002),
    ),
    Case(
        Motion("500 px/s along y, 1.2 px 83 Hz, 0.8 px 110 Hz", ((1.2,), (0.8,)), ((83.0,), (110.0,)), (0.0, 500.0)),
        0.005,
        (0.03, 0.2, 0.002),
    ),
    Case(TWO_TONES, 0.005, (0.02, 0.3, 0.002), 4),
)


@dataclass(frozen=True, eq=False)
class Take:
    """Frames without noise, with the true scene, motion and timing."""

    frames: Array
    scene: Array
    shake: Shake
    timing: rsv.SensorTiming

    @property
    def truth(self) -> rsv.Vibration:
        """The motion as a ``Vibration``."""
        values = (self.shake.amplitude, self.shake.frequency, self.shake.phase, self.shake.image_motion)
        return rsv.Vibration(*(torch.from_numpy(value) for value in values))

    def bound(self, method: str, noise: float) -> dict[str, Array]:
        """Bound of each parameter (2, K) for a noise."""
        found = cramer_rao_bound(
            torch.from_numpy(self.scene),
            self.timing,
            self.truth,
            len(self.frames),
            noise=noise,
            frame_size=self.frames.shape[-2:],
            method=method,
        )
        return {name: getattr(found, name).numpy() for name in NAMES}


def camera(num_rows: int) -> rsv.SensorTiming:
    """The camera with fewer and slower rows; frame period and exposure time are unchanged."""
    slower = FRAME_ROWS / num_rows
    return rsv.SensorTiming(row_time=ROW_TIME * slower, exposure_rows=EXPOSURE_ROWS / slower, frame_rows=num_rows)


def scene_of(source: int | Path, height: int, width: int) -> Array:
    """A drawn scene of a seed, or the centre of an image file scaled to 0 ... 1 by its percentiles."""
    if isinstance(source, int):
        return city_and_fields(height, width, source).double().numpy()
    image = rsv.read_stack(source, full_scale=65535.0)
    image = image.double().reshape(-1, *image.shape[-2:]).mean(0).numpy()
    low, high = np.percentile(image, (0.5, 99.5))
    image = np.clip((image - low) / (high - low), 0.0, 1.0)
    missing = np.maximum(0, np.array((height, width)) - image.shape)
    image = np.pad(image, [(0, missing[0]), (0, missing[1])], mode="reflect")
    top, left = (image.shape[0] - height) // 2, (image.shape[1] - width) // 2
    return image[top : top + height, left : left + width]


def take(motion: Motion, source: int | Path, size: tuple[int, int], num_frames: int, seed: int) -> Take:
    """Frames of a motion with random phases of a seed."""
    shake = motion.shake(np.random.default_rng(seed))
    timing = camera(size[0])
    reach = np.ceil(shake.reach((num_frames + 1) * timing.frame_period)).astype(int) + RIM + 8
    scene = closed(scene_of(source, size[0] + 2 * int(reach[1]), size[1] + 2 * int(reach[0])), RIM)
    return Take(take_frames(scene, shake, timing, num_frames, size), scene, shake, timing)
