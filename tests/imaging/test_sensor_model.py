"""Fixed pattern of a sensor and transfer function of the optics."""

import math

import numpy as np
import pytest
import torch
from scipy.special import j1

from rsvib_torch import Optics, SensorNoise

FLAT = torch.full((3, 300, 400), 0.5, dtype=torch.float64)


def test_fixed_pattern_is_the_same_in_all_frames():
    sensor = SensorNoise(gain_spread=0.01, column_offset=0.004, row_offset=0.002)
    frames = sensor.apply(FLAT) - 0.5
    assert torch.equal(frames[0], frames[2])
    assert torch.equal(frames, sensor.apply(FLAT) - 0.5)
    other = SensorNoise(gain_spread=0.01, column_offset=0.004, row_offset=0.002, pattern_seed=1).apply(FLAT) - 0.5
    correlation = np.corrcoef(frames[0].flatten(), other[0].flatten())[0, 1]
    assert abs(correlation) < 0.2


def test_parts_of_the_pattern_have_their_standard_deviations():
    gain = SensorNoise(gain_spread=0.01).apply(FLAT)[0] / 0.5 - 1
    assert gain.std().item() == pytest.approx(0.01, rel=0.02)
    assert gain.mean(0).std() < 0.002  # neither rows nor columns
    columns = SensorNoise(column_offset=0.004).apply(FLAT)[0] - 0.5
    assert columns.std(0).max() < 1e-12
    assert columns[0].std().item() == pytest.approx(0.004, rel=0.1)
    rows = SensorNoise(row_offset=0.004).apply(FLAT)[0] - 0.5
    assert rows.std(1).max() < 1e-12
    assert rows[:, 0].std().item() == pytest.approx(0.004, rel=0.1)
    # gain scales with light, offsets do not
    dark = SensorNoise(gain_spread=0.01, column_offset=0.004).apply(torch.zeros_like(FLAT))[0]
    torch.testing.assert_close(dark, columns, rtol=0, atol=1e-12)


def test_noise_is_added_to_the_pattern():
    generator = torch.Generator().manual_seed(0)
    sensor = SensorNoise(full_well=10000, read_noise=0.003, gain_spread=0.01, column_offset=0.004)
    frames = sensor.apply(FLAT, generator)
    moving = (frames[0] - frames[1]).var().item() / 2
    assert moving == pytest.approx(0.5 / 10000 + 0.003**2, rel=0.02)
    assert frames[0].var().item() == pytest.approx(moving + 0.005**2 + 0.004**2, rel=0.06)
    counts = SensorNoise(bits=12, column_offset=0.01).apply(FLAT.float())
    assert counts.dtype == torch.float32
    assert ((counts * 4095) - (counts * 4095).round()).abs().max() < 1e-3


def test_a_wave_is_attenuated_by_the_transfer_function():
    optics = Optics(sigma=0.4, cutoff=0.9, pixel=1.0)
    height, width, k, m = 60, 80, 19, 7  # half cycles: cosines that are mirrored at the borders
    y, x = torch.arange(height, dtype=torch.float64) + 0.5, torch.arange(width, dtype=torch.float64) + 0.5
    u, v = k / (2 * width), m / (2 * height)
    wave = torch.cos(2 * math.pi * v * y)[:, None] * torch.cos(2 * math.pi * u * x)
    rho = math.hypot(u, v)
    s = rho / 0.9
    expected = math.exp(-2 * (math.pi * 0.4 * rho) ** 2) * np.sinc(u) * np.sinc(v)
    expected *= 2 / math.pi * (math.acos(s) - s * math.sqrt(1 - s * s))
    torch.testing.assert_close(optics.apply(wave), expected * wave, rtol=0, atol=1e-12)
    torch.testing.assert_close(optics.apply(torch.ones(2, 9, 9)), torch.ones(2, 9, 9))


def test_diffraction_is_the_autocorrelation_of_the_pupil():
    """Compared with the Hankel transform of the Airy pattern, integrated numerically."""
    radius = (np.arange(400000) + 0.5) * 0.005
    airy = (2 * j1(np.pi * radius) / (np.pi * radius)) ** 2
    from scipy.special import j0

    for frequency in (0.2, 0.5, 0.8):
        ring = np.exp(-((radius / 400.0) ** 2)) * airy * radius
        expected = (ring * j0(2 * np.pi * frequency * radius)).sum() / ring.sum()
        found = Optics(cutoff=1.0).transfer(torch.tensor(frequency, dtype=torch.float64), torch.zeros(()))
        assert float(found) == pytest.approx(expected, abs=0.003)
