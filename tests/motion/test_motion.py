"""The contract of ``Motion`` for every type; vibrations; splines compared with SciPy and in simulated frames."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from refusals import refuses
from scipy.interpolate import CubicSpline
from truth import MARGIN, Curve, decibel, draw_scene, take_frames

import rsvib_torch as rsv
from rsvib_torch import FreeMotion, SensorTiming, Vibration, VibrationStd, blind_frequencies

TONES = Vibration(
    amplitude=[[3.1, 0.4], [5.2, 0.7]],
    frequency=[[50.0, 155.0], [30.0, 88.0]],
    phase=[[0.4, -1.0], [1.3, 2.2]],
    image_motion=[90.0, -40.0],
    image_acceleration=[30.0, 400.0],
    image_shift=[-3.0, 7.0],
)
KNOTS = torch.linspace(0, 0.2, 101, dtype=torch.float64)
PATH = torch.stack([2 * torch.sin(60 * KNOTS) * torch.exp(-9 * KNOTS), (400 * KNOTS).cos()], -1)
MOTIONS = {
    "vibration": TONES,
    "spline": FreeMotion.through(KNOTS, PATH),
    "spline with tones": FreeMotion.through(KNOTS, PATH, TONES),
}
TIMES = torch.linspace(0, 0.2, 4001, dtype=torch.float64)


@pytest.fixture(name="motion", params=MOTIONS)
def make_motion(request):
    return MOTIONS[request.param]


def test_bounds_hold(motion):
    displacement = motion.displacement(TIMES)
    assert bool((displacement.abs() <= motion.largest_displacement(0.0, 0.2)).all())
    assert bool(((displacement - motion.drift(TIMES)).abs() <= motion.largest_oscillation()).all())
    # displacement_within is a bound without the acceleration of the image motion
    for steps in (1, 20, 400):
        uniform = getattr(motion, "tones", motion).image_motion
        slope = motion.drift(TIMES) - uniform * TIMES[:, None]
        moved = (displacement - slope)[steps:] - (displacement - slope)[:-steps]
        bound = motion.displacement_within(float(TIMES[steps]))
        assert bool((moved.abs() <= bound + 1e-9).all())


def test_exposure_times_may_differ(motion):
    starts = torch.linspace(0.0, 0.15, 7, dtype=torch.float64)
    exposures = torch.linspace(1e-4, 1e-2, 7, dtype=torch.float64)
    together = motion.mean_displacement(starts, exposures)
    for index, (start, exposure) in enumerate(zip(starts, exposures.tolist(), strict=True)):
        # splines are integrated with nodes for the longest exposure: quadrature errors differ
        torch.testing.assert_close(together[index], motion.mean_displacement(start, exposure), rtol=0, atol=1e-5)


def test_batches_of_equal_motions(motion):
    batch = motion.expanded(3)
    assert batch.batch_shape == (3,)
    assert batch.device == motion.device
    torch.testing.assert_close(batch.displacement(TIMES.expand(3, -1))[2], motion.displacement(TIMES))
    torch.testing.assert_close(batch[1].displacement(TIMES), motion.displacement(TIMES))
    refuses(lambda: motion[0], "not a batch", IndexError)


def test_moving_axes():
    still = Vibration([0.0, 0.0], [50.0, 50.0])
    assert still.moving_axes().tolist() == [False, False]
    assert Vibration([0.0, 1e-3], 50.0).moving_axes().tolist() == [False, True]
    assert Vibration(0.0, 0.0, image_motion=[1.0, 0.0], image_acceleration=[-2.0, 0.0]).moving_axes().tolist() == [
        True,
        False,
    ]
    curve = FreeMotion(torch.tensor([[0.0] * 5, [0.0, 0.0, 1.0, 0.0, 0.0]]), 0.0, 1e-3)
    assert curve.moving_axes().tolist() == [False, True]


def test_detached_motion_has_no_gradients():
    amplitude = torch.tensor([2.0, 3.0], dtype=torch.float64, requires_grad=True)
    coefficients = torch.zeros(2, 8, dtype=torch.float64, requires_grad=True)
    motion = FreeMotion(coefficients, 0.0, 1e-3, Vibration(amplitude, math.pi))
    assert motion.displacement(TIMES).requires_grad
    assert not motion.detached().displacement(TIMES).requires_grad
    assert not motion.largest_displacement(0.0, 1.0).requires_grad


TIMING = SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)


def test_displacement_is_equation_1():
    times = np.linspace(-0.1, 0.3, 57).reshape(3, 19)
    t = times[..., None]
    x = 3.1 * np.sin(100 * np.pi * t + 0.4) + 0.4 * np.sin(310 * np.pi * t - 1.0) + 90 * t + 15 * t**2 - 3
    y = 5.2 * np.sin(60 * np.pi * t + 1.3) + 0.7 * np.sin(176 * np.pi * t + 2.2) - 40 * t + 200 * t**2 + 7
    found = TONES.displacement(torch.from_numpy(times)).numpy()
    assert found == pytest.approx(np.concatenate([x, y], -1), abs=1e-11)


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
        frames = torch.stack([starts, starts + TIMING.frame_period])
        assert tone.mean_displacement(frames, TIMING.exposure_time).diff(dim=0).abs().max() < 1e-9
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
    mixed = Vibration([[0.4, 3.1], [5.2, 0.7]], [[155.0, 50.0], [30.0, 88.0]], [[-1.0, 0.4], [1.3, 2.2]])
    for name in ("amplitude", "frequency", "phase"):
        assert torch.equal(getattr(mixed, name), getattr(TONES, name))


@pytest.mark.parametrize(("scan_axis", "order"), [(-2, [0, 1]), (-1, [1, 0])])
def test_standard_deviations_in_image_axes(scan_axis, order):
    tones = [torch.arange(4.0).reshape(2, 2) + offset for offset in (0, 4, 8, 12)]
    axes = [torch.tensor([1.0, 2.0]), torch.tensor([3.0, 4.0]), torch.tensor([5.0, 6.0])]
    camera = replace(TIMING, scan_axis=scan_axis, readout_direction="reverse")
    std = VibrationStd(*tones, *axes).from_row_order(camera)
    for name, values in zip(VibrationStd.__dataclass_fields__, (*tones, *axes), strict=True):
        assert torch.equal(getattr(std, name), values[order])


SAMPLED = np.arange(0, 0.2, 1e-3)
CURVED = np.stack([6 * np.sin(40 * SAMPLED) * np.exp(-8 * SAMPLED), 4 * np.cumsum(np.sin(300 * SAMPLED**2)) / 20], -1)
LONG_EXPOSURES = rsv.SensorTiming(row_time=4e-5, exposure_rows=40, frame_rows=400)
SPLINE, NATURAL = CubicSpline(SAMPLED, CURVED, bc_type="natural"), FreeMotion.through(SAMPLED, CURVED)


@pytest.mark.parametrize("clock", [1 - 1e-12, 1.0, 1 + 1e-12])
def test_rounding_does_not_change_the_number_of_knots(clock):
    found = FreeMotion.from_samples(SAMPLED * clock, CURVED, spacing=1e-3 * clock)
    assert found.coefficients.shape == NATURAL.coefficients.shape


def test_displacement_and_mean_are_those_of_a_natural_spline():
    times = np.random.default_rng(0).uniform(0.0, SAMPLED[-1], 200)
    given = torch.from_numpy(times)
    assert np.allclose(NATURAL.displacement(given).numpy(), SPLINE(times), atol=1e-6)
    exposure = 1.6e-3
    starts = np.linspace(0, 0.19, 50)
    mean = np.stack([SPLINE.integrate(a, a + exposure) / exposure for a in starts])
    assert np.allclose(NATURAL.mean_displacement(torch.from_numpy(starts), exposure).numpy(), mean, atol=2e-6)


def test_motion_is_constant_beyond_its_ends():
    ends = NATURAL.displacement(torch.tensor([-1.0, 5.0], dtype=torch.float64)).numpy()
    assert np.allclose(ends, CURVED[[0, -1]], atol=1e-6)


def test_tones_are_added_to_the_spline():
    tones = rsv.Vibration([1.0, 0.5], [70.0, 90.0], [0.3, 0.4], [10.0, -5.0])
    whole = FreeMotion.through(SAMPLED, CURVED, tones)
    times = torch.linspace(0, 0.19, 30, dtype=torch.float64)
    assert torch.allclose(whole.displacement(times), NATURAL.displacement(times) + tones.displacement(times))


def test_samples_at_uneven_times():
    times = np.sort(np.random.default_rng(1).uniform(0, 0.199, 300))
    uneven = FreeMotion.from_samples(times, SPLINE(times))
    inside = torch.linspace(0.01, 0.19, 100, dtype=torch.float64)
    assert (uneven.displacement(inside) - NATURAL.displacement(inside)).abs().amax() < 0.02


def test_simulated_frames_equal_those_of_the_independent_simulator():
    scene = draw_scene(320 + 2 * MARGIN, 192 + 2 * MARGIN, 2)
    frames = rsv.simulate_frames(torch.from_numpy(scene), LONG_EXPOSURES, NATURAL, 2, frame_size=(320, 192))
    assert decibel(frames.numpy(), take_frames(scene, LONG_EXPOSURES, Curve(SPLINE), 2), rim=16) > 60


def test_a_part_of_a_spline_has_the_knots_that_it_needs():
    part, times = NATURAL.within(0.042, 0.05), torch.linspace(0.042, 0.05, 30, dtype=torch.float64)
    assert part.coefficients.shape[-1] < 15
    torch.testing.assert_close(part.displacement(times), NATURAL.displacement(times))
