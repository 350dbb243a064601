"""Results of functions that run in inference mode: they can be differentiated and changed."""

import dataclasses

import pytest
import torch

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields

TIMING = rsv.SensorTiming(row_time=1e-4, exposure_rows=6, frame_rows=104)
VIBRATION = rsv.Vibration([1.2, 0.8], [130.0, 170.0], [0.3, 0.9])


@pytest.fixture(scope="module", name="frames")
def make_frames():
    return rsv.simulate_frames(city_and_fields(160, 160, seed=8), TIMING, VIBRATION, 3, frame_size=(96, 96))


def inference_tensors(value, name):
    """Names of the tensors of inference mode in a result."""
    if isinstance(value, torch.Tensor):
        return [name] if value.is_inference() else []
    if dataclasses.is_dataclass(value):
        value = vars(value)
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, (list, tuple)) else ()
    return [found for key, entry in entries for found in inference_tensors(entry, f"{name}.{key}")]


def test_results_are_tensors_like_all_others(frames):
    found, free = rsv.detect_vibration(frames, TIMING), rsv.detect_motion(frames, TIMING)
    tracker = rsv.VibrationTracker(TIMING, window=3)
    tracked = [tracker.update(frame) for frame in frames]
    results = {
        "tones": found,
        "free": free,
        "swept": rsv.detect_swept_tone(frames, TIMING),
        "check": rsv.check_motion(frames, TIMING, free.motion),
        "tracked": [(one, one.restored, one.detection, one.visible) for one in tracked],
    }
    assert inference_tensors(results, "results") == []
    tracked[0].restored.add_(1.0)


def test_standard_deviations_in_inference_mode(frames):
    expected = rsv.detect_swept_tone(frames, TIMING).std
    with torch.inference_mode():
        found = rsv.detect_swept_tone(frames, TIMING).std
    assert all(torch.equal(found[name], expected[name]) for name in expected)
    assert float(expected["amplitude"].max()) > 0


def test_restoration_with_a_detected_motion_is_differentiable(frames):
    found = rsv.detect_vibration(frames, TIMING).vibration
    found.amplitude.requires_grad_()
    given = frames.clone().requires_grad_()
    rsv.restore(given, TIMING, found).square().mean().backward()
    assert float(given.grad.abs().max()) > 0
    assert float(found.amplitude.grad.abs().max()) > 0
