"""Equations of Liu et al. 2023, one by one, against numerical integration."""

import numpy as np
import pytest

from rsvib_torch import SensorTiming, Vibration
from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones.fit import fit_tones, vibration_of_fit

CAMERA = SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)
ROWS = np.arange(2048)
CASES = [(3.1, 50.0, 0.4), (5.2, 30.0, 1.3), (0.2, 155.0, -2.0), (1.0, 7.0, 3.0)]


def integral(amplitude, frequency, phase, ends):
    """Mean displacement by numerical integration over the exposure that ends at ``ends`` (Eq. 2, left side)."""
    nodes, weights = np.polynomial.legendre.leggauss(24)
    times = ends[:, None] - CAMERA.exposure_time * (1 - nodes) / 2
    return (amplitude * np.sin(2 * np.pi * frequency * times + phase) * weights / 2).sum(-1)


@pytest.mark.parametrize(("amplitude", "frequency", "phase"), CASES)
def test_equations_2_and_4_with_its_sign(amplitude, frequency, phase):
    """Eq. (2): A_a sin(omega t + phi - omega T_e / 2) with A_a = A sinc(f T_e), t at the end of the exposure.

    Eq. (4): the offset y2 - y1 (not y1 - y2) is 2 A_a sin(pi f m T) cos(...).
    """
    ends = ROWS * CAMERA.row_time + CAMERA.exposure_time
    first, later = (integral(amplitude, frequency, phase, t) for t in (ends, ends + CAMERA.frame_period))
    omega, middle = 2 * np.pi * frequency, ends - CAMERA.exposure_time / 2
    attenuated = amplitude * np.sinc(frequency * CAMERA.exposure_time)
    assert attenuated * np.sin(omega * middle + phase) == pytest.approx(first, abs=1e-9)
    gain = 2 * np.sin(np.pi * frequency * CAMERA.frame_period)
    printed = attenuated * gain * np.cos(omega * (middle + CAMERA.frame_period / 2) + phase)
    assert printed == pytest.approx(later - first, abs=1e-9)
    assert np.abs(printed + later - first).max() > 0.1 * amplitude
    vibration, starts = Vibration(amplitude, frequency, phase), CAMERA.row_starts(2, 2048)
    mean = vibration.mean_displacement(starts[0], CAMERA.exposure_time)[:, 0].numpy()
    assert mean == pytest.approx(first, abs=1e-9)
    later_mean = vibration.mean_displacement(starts[1], CAMERA.exposure_time)[:, 0].numpy()
    assert later_mean - mean == pytest.approx(later - first, abs=1e-9)
    assert vibration.gain(CAMERA.frame_period)[0, 0].item() == pytest.approx(gain, abs=1e-12)


@pytest.mark.parametrize(("amplitude", "frequency", "phase"), CASES[:3])
def test_equations_6_to_8_invert_the_offsets(amplitude, frequency, phase):
    """Amplitude and phase are recovered from the offset curve, for positive and negative gain."""
    ends = ROWS[::8] * CAMERA.row_time + CAMERA.exposure_time
    offset = integral(amplitude, frequency, phase, ends + CAMERA.frame_period) - integral(
        amplitude, frequency, phase, ends
    )
    starts, offsets = ROWS[None, ::8] * CAMERA.row_time, np.stack([offset, offset], -1)[None]
    both = np.stack([starts, starts + CAMERA.frame_period], -1)
    displacements = np.stack([-0.5 * offsets, 0.5 * offsets], 2)
    information = np.broadcast_to(np.eye(2), (1, offsets.shape[1], 2, 2))
    measurements = Measurements(both, displacements, np.ones_like(both), information, CAMERA.exposure_time)
    start = np.full((1, 2, 1), 1.02 * frequency)
    found, _ = vibration_of_fit(fit_tones(measurements, start, np.ones((1, 2, 1), dtype=bool)))
    for axis in (0, 1):
        assert found.amplitude[0, axis, 0].item() == pytest.approx(amplitude, rel=1e-6)
        assert found.period[0, axis, 0].item() == pytest.approx(1 / frequency, rel=1e-7)
        assert found.phase[0, axis, 0].item() == pytest.approx(phase, abs=1e-6)


@pytest.mark.parametrize(("amplitude", "frequency", "phase"), CASES)
def test_equation_24(amplitude, frequency, phase):
    times = np.linspace(0, 1 / frequency, 40001)
    step = np.sin(2 * np.pi * frequency * (times + CAMERA.row_time) + phase) - np.sin(
        2 * np.pi * frequency * times + phase
    )
    largest = Vibration(amplitude, frequency, phase).displacement_within(CAMERA.row_time)
    assert largest.tolist() == pytest.approx([amplitude * np.abs(step).max()] * 2, rel=1e-6)
    assert bool((largest < 0.1).all())
