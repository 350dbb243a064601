"""Standard deviations contain that of the row time: motions of any shape, swept and followed tones."""

import math

import torch

from rsvib_torch import (
    FreeMotion,
    SensorTiming,
    VibrationTracker,
    detect_motion,
    detect_swept_tone,
    follow_vibration,
    simulate_frames,
)
from rsvib_torch.datasets import city_and_fields

TIMING = SensorTiming(row_time=40e-6, exposure_rows=20, frame_rows=300)
TIMES = torch.arange(-0.02, 0.3, 2e-4, dtype=torch.float64)


def wrong(error: float, std: float) -> SensorTiming:
    """The timing with a row time that is wrong by a relative error, with the same exposure and frame rate in s."""
    row_time = (1 + error) * TIMING.row_time
    seconds = {"exposure_time": TIMING.exposure_time, "frame_rate": TIMING.frame_rate}
    return SensorTiming.from_seconds(row_time=row_time, row_time_std=std * row_time, **seconds)


def frames_of(path: torch.Tensor, count: int) -> torch.Tensor:
    """Frames of a motion with some noise."""
    motion = FreeMotion.through(TIMES, path)
    frames = simulate_frames(city_and_fields(280, 220, seed=3), TIMING, motion, num_frames=count)
    return frames + 0.002 * torch.randn(frames.shape, generator=torch.Generator().manual_seed(1))


def decaying(frequency: float, decay: float) -> torch.Tensor:
    """(N, 2) px along x and y."""
    tone = torch.exp(-decay * TIMES) * torch.sin(2 * math.pi * frequency * TIMES)
    return torch.stack([3.0 * tone, 1.5 * tone], -1)


def test_parameters_of_swept_tones_are_within_two_standard_deviations():
    frames, truth = frames_of(decaying(105.0, 20.0), 4), {"amplitude": (3.0, 1.5), "frequency": (105.0, 105.0)}
    certain, found = (detect_swept_tone(frames, wrong(0.01, std)) for std in (0.0, 0.01))
    for name, true in (truth | {"decay": (20.0, 20.0), "chirp": (0.0, 0.0), "phase": (0.0, 0.0)}).items():
        error = (getattr(found, name) - torch.tensor(true)).abs()  # px, Hz, 1/s, Hz/s, rad
        assert bool((error < 2 * found.std[name]).all())
        assert bool((found.std[name] < 3 * error).all())  # and they say how large the errors are
        assert bool((found.std[name] > certain.std[name]).all())


def test_displacements_of_free_motions_are_within_two_standard_deviations():
    bent = TIMES.square()  # of sweeps: tones would take the place of the spline
    path = torch.stack([1.5 * torch.sin(700 * TIMES + 900 * bent), 1.1 * torch.sin(330 * TIMES + 900 * bent)], -1)
    frames, motion = frames_of(path, 6), FreeMotion.through(TIMES, path)
    right, certain, found = (detect_motion(frames, wrong(*of)) for of in ((0.0, 0.0), (0.01, 0.0), (0.01, 0.01)))
    true = motion.displacement(found.times)
    error = (found.displacement - true + true.mean((0, 1))).abs()
    assert float((error < 2 * found.std).double().mean()) > 0.95
    by_row_time = (found.std.square() - certain.std.square()).clamp(min=0).mean((0, 1)).sqrt()
    at_right = right.motion.displacement(found.times) - found.motion.displacement(found.times)
    changed = (at_right - at_right.mean((0, 1))).square().mean((0, 1)).sqrt()
    assert torch.allclose(by_row_time, changed, rtol=0.3)


def test_tones_that_are_followed_are_within_two_standard_deviations():
    frames, timing = frames_of(decaying(61.0, 1 / 0.3), 16), wrong(0.01, 0.01)
    followed = follow_vibration(frames, timing)
    inner = slice(3, -3)
    envelope = torch.exp(-followed.times / 0.3)[:, None]
    amplitude = (followed.vibration.amplitude[..., 0] / envelope - torch.tensor([3.0, 1.5])).abs()[inner]
    std = followed.std.amplitude[inner, :, 0] / envelope[inner]
    assert bool((amplitude < 2 * std).all())
    assert bool((std.mean(0) < 3 * amplitude.mean(0)).all())
    assert bool(((followed.vibration.frequency - 61.0).abs() < 2 * followed.std.frequency)[inner].all())
    # A tracker has its standard deviations from the same function.
    tracker, starts = VibrationTracker(timing), timing.frame_starts(16).tolist()
    for frame, start in zip(frames, starts, strict=True):
        tracked = tracker.update(frame, start)
    error = tracked.detection.vibration.amplitude[:, 0] / envelope[-1] - torch.tensor([3.0, 1.5])
    assert bool((error.abs() < 2 * tracked.detection.std.amplitude[:, 0] / envelope[-1]).all())
