from dataclasses import replace

import numpy as np
import pytest
import torch

from rsvib_torch import SensorTiming, Vibration, VibrationStd, blind_frequencies

TIMING = SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)
AMPLITUDE = np.array([[3.1, 0.4], [5.2, 0.7]])
FREQUENCY = np.array([[50.0, 155.0], [30.0, 88.0]])
PHASE = np.array([[0.4, -1.0], [1.3, 2.2]])
MOTION = np.array([120.0, -40.0])


def vibration():
    return Vibration(*(torch.from_numpy(part) for part in (AMPLITUDE, FREQUENCY, PHASE, MOTION)))


def displacement(times):
    angle = 2 * np.pi * FREQUENCY * times[..., None, None] + PHASE
    return (AMPLITUDE * np.sin(angle)).sum(-1) + MOTION * times[..., None]


def test_displacement_is_equation_1():
    times = np.linspace(-0.1, 0.3, 57).reshape(3, 19)
    assert vibration().displacement(torch.from_numpy(times)).numpy() == pytest.approx(displacement(times), abs=1e-12)


def test_blind_frequencies():
    found = blind_frequencies(TIMING, 100.0)
    assert found.tolist() == pytest.approx([23.795, 47.591, 71.386, 95.182], abs=1e-3)
    high = blind_frequencies(TIMING, 5000.0)
    assert high.tolist() == sorted(high.tolist())
    for j in (1, 2):
        assert (high - j / TIMING.exposure_time).abs().min() < 1e-9
    starts = TIMING.row_starts(1, 2048)[0]
    for frequency in found.tolist():
        tone = Vibration(5.0, frequency, 0.7)
        assert tone.offset(starts, starts + TIMING.frame_period, TIMING.exposure_time).abs().max() < 1e-9
    averaged = Vibration(5.0, 1 / TIMING.exposure_time, 0.7)
    assert averaged.mean_displacement(starts, TIMING.exposure_time).abs().max() < 1e-9


def test_uneven_frames_are_blind_to_frequencies_that_displace_all_frames_alike():
    period = TIMING.frame_period
    pair = blind_frequencies(replace(TIMING, frame_start_times=(0.0, 2 * period)), 50.0)
    torch.testing.assert_close(pair, torch.arange(1, 5).double() / (2 * period))
    three = blind_frequencies(replace(TIMING, frame_start_times=(0.0, 2 * period, 5 * period)), 50.0)
    torch.testing.assert_close(three, torch.arange(1, 3).double() / period)
    assert not len(blind_frequencies(replace(TIMING, frame_start_times=(0.0, period, 2.37 * period)), 90.0))


def test_tones_are_sorted_by_amplitude():
    mixed = Vibration([[0.4, 3.1], [5.2, 0.7]], [[155.0, 50.0], [30.0, 88.0]], [[-1.0, 0.4], [1.3, 2.2]], MOTION)
    for name in ("amplitude", "frequency", "phase", "image_motion"):
        assert torch.equal(getattr(mixed, name), getattr(vibration(), name))


@pytest.mark.parametrize(("scan_axis", "order"), [(-2, [0, 1]), (-1, [1, 0])])
def test_standard_deviations_in_image_axes(scan_axis, order):
    tones = [torch.arange(4.0).reshape(2, 2) + offset for offset in (0, 4, 8, 12)]
    axes = [torch.tensor([1.0, 2.0]), torch.tensor([3.0, 4.0]), torch.tensor([5.0, 6.0])]
    camera = replace(TIMING, scan_axis=scan_axis, readout_direction="reverse")
    std = VibrationStd(*tones, *axes).from_row_order(camera)
    for name, values in zip(VibrationStd.__dataclass_fields__, (*tones, *axes), strict=True):
        assert torch.equal(getattr(std, name), values[order])
