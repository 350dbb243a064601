"""Rounds of measuring are bounded: what no vibration explains is refused after few rounds, with a reason."""

from collections import Counter

import pytest
import torch

import rsvib_torch as rsv
from rsvib_torch.detection.rows import measured_rows
from rsvib_torch.evaluation import city_and_fields

SIZE = 192
TIMING = rsv.SensorTiming(row_time=1 / (24 * 1.15 * SIZE), exposure_rows=2, frame_rows=1.15 * SIZE)
VIBRATION = rsv.Vibration([1.5, 1.2], [53.0, 65.0], [0.4, 1.3])


def frames_of(vibration, seed=3):
    generator = torch.Generator().manual_seed(seed)
    noise = rsv.SensorNoise(read_noise=0.005)
    scene = city_and_fields(SIZE + 120, SIZE + 120, seed=seed)
    return rsv.simulate_frames(scene, TIMING, vibration, 4, frame_size=(SIZE, SIZE), noise=noise, generator=generator)


@pytest.fixture
def rounds(monkeypatch):
    """Number of rounds of measuring, of whole rows and of strips."""
    count = Counter()
    for kind in (measured_rows.MeasuredRows, measured_rows.StripRows):

        def counted(self, *arguments, measure=kind.measure, name=kind.__name__):
            count[name] += 1
            return measure(self, *arguments)

        monkeypatch.setattr(kind, "measure", counted)
    return count


def test_plain_vibration_takes_few_rounds(rounds):
    found = rsv.detect_vibration(frames_of(VIBRATION), TIMING)
    assert found.reliable.all(), found.reasons
    assert rounds["MeasuredRows"] <= 4
    assert rounds["StripRows"] == 0


def test_halves_that_move_apart_unlike_roll_are_refused_without_rounds_of_roll(rounds):
    left = frames_of(VIBRATION)
    right = frames_of(rsv.Vibration([1.5, 1.2], [53.0, 65.0], [0.4, 1.3], image_motion=[100.0, 70.0]))
    parallax = torch.cat([left[..., : SIZE // 2], right[..., SIZE // 2 :]], -1)
    found = rsv.detect_vibration(parallax, TIMING)
    assert not found.reliable.any()
    assert found.vibration.num_axes == 2
    assert any("parallax" in reason for reasons in found.reasons for reason in reasons)
    assert rounds["StripRows"] == 0


def test_roll_takes_few_rounds(rounds):
    found = rsv.detect_vibration(
        frames_of(rsv.Vibration([1.5, 1.2, 0.005], [53.0, 65.0, 41.0], [0.4, 1.3, 0.2])), TIMING
    )
    assert found.reliable.tolist() == [True, True, True], found.reasons
    assert rounds["StripRows"] <= 4


def test_motion_that_no_tones_explain_is_refused_after_few_rounds(rounds):
    generator = torch.Generator().manual_seed(2)
    frequency, phase = (torch.rand(2, 40, generator=generator, dtype=torch.float64) for _ in range(2))
    walk = rsv.Vibration(1.5 / (4 + 80 * frequency), 2 + 40 * frequency, 6 * phase)
    found = rsv.detect_vibration(frames_of(walk), TIMING)
    assert not found.reliable.any()
    assert rounds["MeasuredRows"] <= 10, rounds  # of the stated timing, and of another one if one is tried
    assert rounds["StripRows"] <= 3
