"""Free motion: splines compared with SciPy, and simulation and restoration with a free motion."""

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline
from truth import MARGIN, Curve, decibel, draw_scene, take_frames

import rsvib_torch as rsv
from rsvib_torch.motion.spline import FreeMotion

TIMES = np.arange(0, 0.2, 1e-3)
PATH = np.stack([6 * np.sin(40 * TIMES) * np.exp(-8 * TIMES), 4 * np.cumsum(np.sin(300 * TIMES**2)) / 20], -1)
TIMING = rsv.SensorTiming(row_time=4e-5, exposure_rows=40, frame_rows=400)


def spline():
    return CubicSpline(TIMES, PATH, bc_type="natural")


def motion():
    return FreeMotion.through(TIMES, PATH)


@pytest.mark.parametrize("clock", [1 - 1e-12, 1.0, 1 + 1e-12])
def test_rounding_does_not_change_the_number_of_knots(clock):
    found = FreeMotion.from_samples(TIMES * clock, PATH, spacing=1e-3 * clock)
    assert found.coefficients.shape == motion().coefficients.shape


def test_displacement_velocity_and_mean_are_those_of_a_natural_spline():
    times = np.random.default_rng(0).uniform(0.0, TIMES[-1], 200)
    given = torch.from_numpy(times)
    assert np.allclose(motion().displacement(given).numpy(), spline()(times), atol=1e-6)
    assert np.allclose(motion().velocity(given).numpy(), spline()(times, 1), atol=1e-3)
    exposure = 1.6e-3
    starts = np.linspace(0, 0.19, 50)
    mean = np.stack([spline().integrate(a, a + exposure) / exposure for a in starts])
    assert np.allclose(motion().mean_displacement(torch.from_numpy(starts), exposure).numpy(), mean, atol=2e-6)


def test_motion_is_constant_beyond_its_ends():
    ends = motion().displacement(torch.tensor([-1.0, 5.0], dtype=torch.float64)).numpy()
    assert np.allclose(ends, PATH[[0, -1]], atol=1e-6)
    assert not motion().velocity(torch.tensor([-1.0, 5.0])).any()


def test_tones_are_added_to_the_spline():
    tones = rsv.Vibration([1.0, 0.5], [70.0, 90.0], [0.3, 0.4], [10.0, -5.0])
    whole = FreeMotion.through(TIMES, PATH, tones)
    times = torch.linspace(0, 0.19, 30, dtype=torch.float64)
    assert torch.allclose(whole.displacement(times), motion().displacement(times) + tones.displacement(times))
    assert torch.allclose(whole.velocity(times), motion().velocity(times) + tones.velocity(times))


def test_samples_at_uneven_times():
    times = np.sort(np.random.default_rng(1).uniform(0, 0.199, 300))
    uneven = FreeMotion.from_samples(times, spline()(times))
    inside = torch.linspace(0.01, 0.19, 100, dtype=torch.float64)
    assert (uneven.displacement(inside) - motion().displacement(inside)).abs().amax() < 0.02


FREE = Curve(spline())  # the same path for the independent simulator


def test_simulated_frames_equal_those_of_the_independent_simulator():
    scene = draw_scene(320 + 2 * MARGIN, 192 + 2 * MARGIN, 2)
    frames = rsv.simulate_frames(torch.from_numpy(scene), TIMING, motion(), 2, frame_size=(320, 192))
    assert decibel(frames.numpy(), take_frames(scene, TIMING, FREE, 2), rim=16) > 60
