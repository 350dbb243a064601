import numpy as np
import pytest
import torch

import rsvib_torch as rsv
from rsvib_torch.evaluation.bound import cramer_rao_bound

TIMING = rsv.SensorTiming(row_time=160e-6, exposure_rows=3, frame_rows=300)
FIELDS = ("amplitude", "frequency", "period", "phase", "image_motion")


def smooth_scene(height, width, seed=0, highest=0.2):
    """Noise without frequencies above ``highest`` cycles per px."""
    generator = np.random.default_rng(seed)
    spectrum = np.fft.rfft2(generator.standard_normal((height, width)))
    v, u = np.meshgrid(np.fft.fftfreq(height), np.fft.rfftfreq(width), indexing="ij")
    radius = np.hypot(u, v)
    spectrum *= np.exp(-((radius / (0.6 * highest)) ** 2)) * (radius < highest)
    scene = np.fft.irfft2(spectrum, s=(height, width))
    return 0.5 + 0.12 * scene / scene.std()


def values_of(bound):
    return torch.cat([getattr(bound, name).flatten() for name in FIELDS])


def test_closed_form_of_a_wave_along_rows():
    # a wave along x with amplitude a measures x only: J = (2 pi u a)^2 W / 4 noise^2 sum d offset d offset'
    u, a, width, noise = 0.1, 0.2, 480, 0.01
    columns = np.arange(width + 40)
    scene = torch.from_numpy(np.tile(0.5 + a * np.sin(2 * np.pi * u * columns), (340, 1)))
    timing = rsv.SensorTiming(row_time=160e-6, exposure_rows=3, frame_rows=310)
    amplitude, frequency, phase = 1.2, 47.0, 0.7
    motion = rsv.Vibration([amplitude, 0.0], frequency, phase)
    bound = cramer_rao_bound(scene, timing, motion, noise=noise, frame_size=(300, width))

    def mean(values, starts):
        a, f, p, v = values
        exposure = timing.exposure_time
        middle = starts + 0.5 * exposure
        return a * np.sinc(f * exposure) * np.sin(2 * np.pi * f * middle + p) + v * middle

    def offset(values):
        starts = np.arange(300) * timing.row_time
        return mean(values, starts + timing.frame_period) - mean(values, starts)

    truth = np.array([amplitude, frequency, phase, 0.0])
    derivative = [(offset(truth + e) - offset(truth - e)) / 2e-5 for e in 1e-5 * np.eye(4)]
    information_ = (2 * np.pi * u * a / noise) ** 2 * width / 4 * (np.array(derivative) @ np.array(derivative).T)
    expected = np.sqrt(np.diag(np.linalg.inv(information_)))
    found = [bound.amplitude[0, 0], bound.frequency[0, 0], bound.phase[0, 0], bound.image_motion[0]]
    np.testing.assert_allclose([float(value) for value in found], expected, rtol=0.02)
    assert float(bound.period[0, 0]) == pytest.approx(expected[1] / frequency**2, rel=0.02)
    assert torch.isinf(bound.image_motion[1])


@pytest.mark.parametrize("method", ["gradients", "random"])
def test_bound_is_infinite_for_a_blind_tone_only(method):
    scene = torch.from_numpy(smooth_scene(332, 80))
    blind, options = 1 / TIMING.frame_period, {"noise": 0.01, "frame_size": (280, 32), "method": method}
    tones = (rsv.Vibration([[1.0, 0.0], [0.0, 0.0]], [[f, 0.0], [0.0, 0.0]]) for f in (blind, 1.05 * blind))
    bound, near = (cramer_rao_bound(scene, TIMING, motion, **options) for motion in tones)
    assert torch.isinf(bound.amplitude[0, 0])
    assert torch.isinf(bound.phase[0, 0])
    assert torch.isfinite(bound.image_motion).all()
    assert torch.isfinite(values_of(near)).all()
    assert (bound.amplitude[1] == 0).all()  # tones that do not exist


def test_random_scene_with_a_flat_spectrum():
    # information per frequency is S^2 / (N (2 S + N)) instead of S / (2 N), with constant S inside the disc
    highest, noise = 0.3, 0.3
    generator = np.random.default_rng(1)
    shape = (332, 256)
    spectrum = np.fft.rfft2(generator.standard_normal(shape))
    v, u = np.meshgrid(np.fft.fftfreq(shape[0]), np.fft.rfftfreq(shape[1]), indexing="ij")
    scene = np.fft.irfft2(spectrum * (np.hypot(u, v) < highest), s=shape)
    scene = torch.from_numpy(0.5 + 0.2 * scene / scene.std())
    motion = rsv.Vibration([1.3, 2.1], [50.0, 30.0], [0.4, 1.3])
    bounds = [
        values_of(cramer_rao_bound(scene, TIMING, motion, noise=noise, frame_size=(280, 200), method=method))
        for method in ("gradients", "random")
    ]
    power = 0.2**2 / (np.pi * highest**2)
    expected = np.sqrt((2 * power + noise**2) / (2 * power))
    assert expected > 1.14
    np.testing.assert_allclose((bounds[1] / bounds[0]).numpy(), expected, rtol=0.02)


def test_unknown_acceleration_increases_the_bound():
    scene = torch.from_numpy(smooth_scene(332, 80))
    motion = rsv.Vibration([1.3, 2.1], [50.0, 30.0], [0.4, 1.3], [20.0, -30.0], [100.0, 0.0])
    options = {"noise": 0.01, "frame_size": (280, 32)}
    known = cramer_rao_bound(scene, TIMING, motion, 3, **options)
    unknown = cramer_rao_bound(scene, TIMING, motion, 3, acceleration=True, **options)
    assert (known.image_acceleration == 0).all()
    assert (unknown.image_acceleration > 0).all()
    assert (values_of(unknown) > values_of(known)).all()
