"""Simulated frames against an independent camera; noise of a sensor; transfer of the optics."""

import math

import numpy as np
import pytest
import torch
from scipy.special import j1
from truth import MARGIN, Motion, draw_scene, take_frames

from rsvib_torch import Optics, SensorNoise, SensorTiming, Vibration, simulate_frames
from rsvib_torch.imaging import rows_showing

TIMING = SensorTiming(row_time=60e-6, exposure_rows=20, frame_rows=300)
MOTION = Motion((3.1, 5.2), (50.0, 30.0), (0.4, 1.3), (60.0, -25.0))


def test_against_independent_simulator():
    scene = draw_scene(260, 240, 4)
    truth = take_frames(scene, TIMING, MOTION, 2)
    frames = simulate_frames(
        torch.from_numpy(scene), TIMING, MOTION.vibration(), frame_size=(260 - 2 * MARGIN, 240 - 2 * MARGIN)
    ).numpy()
    assert np.sqrt(np.mean((frames - truth) ** 2)) < 5e-4
    assert np.abs(frames - scene[MARGIN:-MARGIN, MARGIN:-MARGIN]).max() > 0.1


def test_channels_equal_singles_and_dtype_is_kept():
    scene = torch.from_numpy(draw_scene(120, 120, 4))
    colours = torch.stack([scene, 1 - scene, scene.flip(-1)]).float()
    frames = simulate_frames(colours, TIMING, MOTION.vibration(), 2)
    assert frames.shape[:2] == (2, 3)
    assert frames.dtype == torch.float32
    for index in range(3):
        alone = simulate_frames(colours[index], TIMING, MOTION.vibration(), 2)
        torch.testing.assert_close(frames[:, index], alone, rtol=0, atol=1e-6)
        double = simulate_frames(colours[index].double(), TIMING, MOTION.vibration(), 2)
        assert double.dtype == torch.float64
        torch.testing.assert_close(alone.double(), double, rtol=0, atol=1e-5)


def test_default_frame_has_a_margin_and_the_noise_of_the_generator():
    """The margin on every side is 16 px plus the amplitude."""
    scene, noise = torch.from_numpy(draw_scene(140, 140, 4)), SensorNoise(full_well=10000, read_noise=0.01)
    vibration, generators = Vibration([3.0, 5.0], [50.0, 30.0]), [torch.Generator().manual_seed(n) for n in (1, 1, 2)]
    frames, again, other = (simulate_frames(scene, TIMING, vibration, noise=noise, generator=g) for g in generators)
    assert frames.shape == (2, 140 - 2 * 21, 140 - 2 * 19)
    assert torch.equal(frames, again)
    assert not torch.equal(frames, other)


def test_read_and_shot_noise_have_their_variance():
    generator = torch.Generator().manual_seed(3)
    frames = torch.full((400, 500), 0.3, dtype=torch.float64)
    read = SensorNoise(read_noise=0.02).apply(frames, generator) - 0.3
    assert read.std().item() == pytest.approx(0.02, rel=0.01)
    assert abs(read.mean().item()) < 2e-4
    shot = SensorNoise(full_well=5000).apply(frames, generator) - 0.3
    assert shot.var().item() == pytest.approx(0.3 / 5000, rel=0.02)
    assert abs(shot.mean().item()) < 1e-4
    both = SensorNoise(full_well=5000, read_noise=0.01).apply(frames, generator) - 0.3
    assert both.var().item() == pytest.approx(0.3 / 5000 + 1e-4, rel=0.02)


@pytest.mark.parametrize("bits", [1, 8, 12])
def test_quantisation(bits):
    frames = torch.linspace(-0.2, 1.2, 5000, dtype=torch.float64)
    levels = 2**bits - 1
    counts = SensorNoise(bits=bits).apply(frames) * levels
    torch.testing.assert_close(counts, counts.round(), rtol=0, atol=1e-9)
    assert counts.min() == 0
    assert counts.max() == levels
    assert (counts / levels - frames.clamp(0, 1)).abs().max() <= 0.5 / levels + 1e-12


@pytest.mark.parametrize(
    ("exposure_rows", "amplitude", "frequency", "velocity", "moved"),
    [
        # two and a half periods in an exposure: velocity and slope of the mean displacement differ
        (60, 5.0, 1060.0, 0.0, 0.6),
        (2, 12.0, 250.0, 1000.0, 20.0),  # content moves by up to 0.79 rows in a row time: Newton's steps alone diverge
    ],
)
def test_rows_showing_is_the_fixed_point(exposure_rows, amplitude, frequency, velocity, moved):
    timing = SensorTiming(row_time=40e-6, exposure_rows=exposure_rows, frame_rows=320).in_row_order()
    vibration = Vibration([6.0, amplitude], [640.0, frequency], [0.3, -0.9], image_motion=[0.0, velocity])
    rows, start = torch.arange(300.0, dtype=torch.float64), torch.tensor(timing.frame_period, dtype=torch.float64)
    found, _ = rows_showing(rows, start, timing, vibration)
    mean = vibration.mean_displacement(start + found * timing.row_time, timing.exposure_time)[..., 1]
    assert (found - rows - mean).abs().max() < 1e-6
    assert (found - rows).abs().max() > moved


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
