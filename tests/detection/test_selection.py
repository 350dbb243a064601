"""Search for tones: outliers, significance, number of fits."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import fft

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones import selection
from rsvib_torch.detection.tones.fit import amplitude_std, fit_tones, with_unknown_errors

ROWS, ROW_TIME, FRAME_PERIOD = 120, 16 * 20.52e-6, 2048 * 20.52e-6


def offsets_of(amplitude, frequency, generator, noise=0.003):
    """Offsets (1, N, 2) between rows of two frames that vibrate, measured with an error of ``noise`` px."""
    starts = np.arange(ROWS) * ROW_TIME
    turn, size = 2 * math.pi * np.array(frequency), np.array(amplitude)
    places = [size * np.cos(turn * (starts + shift)[:, None] + 0.4) for shift in (0, FRAME_PERIOD)]
    errors = noise * generator.standard_normal((ROWS, 2))
    return (places[1] - places[0] + errors)[None]


def as_measurements(offsets):
    starts = np.repeat(np.arange(ROWS)[None] * ROW_TIME, len(offsets), 0)
    information = np.broadcast_to(np.eye(2), (len(offsets), ROWS, 2, 2))
    return Measurements.of_pairs(starts, starts + FRAME_PERIOD, offsets, information, 0.0)


@pytest.mark.parametrize(("rows", "known"), [(4, False), (5, True)])
def test_errors_are_unknown_with_as_many_parameters_as_measurements(rows, known):
    """Three parameters of a tone and the drift fit four rows exactly; their residual is 0 for any errors."""
    offsets = offsets_of([3.1, 5.2], [50.0, 30.0], np.random.default_rng(3))[:, :: ROWS // rows][:, :rows]
    starts = (np.arange(ROWS) * ROW_TIME)[None, :: ROWS // rows][:, :rows]
    information = np.broadcast_to(np.eye(2), (1, rows, 2, 2))
    measurements = Measurements.of_pairs(starts, starts + FRAME_PERIOD, offsets, information, 0.0)
    start = np.array([[[50.0], [30.0]]])
    fit = with_unknown_errors(measurements, fit_tones(measurements, start, np.ones((1, 2, 1), dtype=bool)))
    significance = fit.amplitude / amplitude_std(fit)
    assert ((significance > selection.MIN_SIGNIFICANCE) == known).all()


def test_the_amplitude_of_a_blind_tone_is_bounded():
    """Without motion along the scan, frames do not depend on a tone of a blind frequency."""
    offsets = offsets_of([3.1, 5.2], [50.0, 30.0], np.random.default_rng(3))
    measurements = as_measurements(offsets)
    blind = np.arange(1, 5) / FRAME_PERIOD
    frequencies = np.array([[[50.0, 30.0 + 1 / FRAME_PERIOD], [30.0, 0.0]]])
    fit = fit_tones(measurements, frequencies, frequencies > 0)  # a weak side tone of the first blind frequency along x
    assert selection.find_tones(measurements, ROW_TIME, start=fit, blind=blind).amplitude.max() < 30


def test_only_disturbed_rows_are_excluded(monkeypatch):
    transformed, transform = [], fft.rfft
    monkeypatch.setattr(fft, "rfft", lambda values: (transformed.append(values.size), transform(values))[1])
    generator = np.random.default_rng(8)
    clean = offsets_of([3.1, 5.2], [50.0, 30.0], generator)
    cloudy = offsets_of([2.0, 1.1], [50.0, 35.0], generator)
    cloudy[:, 30:58] += np.linspace(2.0, 9.0, 28)[:, None]  # an object with its own motion
    alone, counts = [], []
    for offsets in (clean, cloudy):
        transformed.clear()
        alone.append(selection.find_tones(as_measurements(offsets), ROW_TIME, 1))
        counts.append(sum(transformed))
    assert counts[1] > 4 * counts[0]  # fits without a stretch of rows are tried for disturbed rows only
    for fit, amplitude, frequency in zip(alone, ([3.1, 5.2], [2.0, 1.1]), ([50.0, 30.0], [50.0, 35.0]), strict=True):
        assert np.abs(fit.coefficients).ravel().tolist() == pytest.approx(amplitude, rel=0.01)
        assert fit.frequencies.flatten().tolist() == pytest.approx(frequency, rel=0.003)
    together = selection.find_tones(as_measurements(np.concatenate([clean, cloudy])), ROW_TIME, 1)
    for index, fit in enumerate(alone):
        np.testing.assert_allclose(together.frequencies[index], fit.frequencies[0], rtol=1e-9)
        np.testing.assert_allclose(together.coefficients[index], fit.coefficients[0], rtol=1e-7)


def test_weak_tone_beside_a_strong_tone_is_detected_and_noise_is_not():
    generator = np.random.default_rng(4)
    one = as_measurements(offsets_of([3.1, 5.2], [50.0, 30.0], generator))
    weak = offsets_of([0.006, 0.005], [88.0, 79.0], generator)
    two = as_measurements(one.displacements[:, :, 1] - one.displacements[:, :, 0] + weak)
    for measurements, tones in ((one, 1), (two, 2)):
        fit = selection.find_tones(measurements, ROW_TIME)
        assert fit.active.sum(-1).tolist() == [[tones, tones]]
    assert fit.frequencies[0, :, 1].tolist() == pytest.approx([88.0, 79.0], rel=0.03)


@pytest.mark.parametrize(
    ("amplitude", "frequency", "stays"),
    [
        (0.05, 341.0, True),
        (0.003, 341.0, False),  # significant, but as small as residuals of interpolation
        (0.0005, 341.0, False),  # may be noise
    ],
)
def test_insignificant_and_small_tones_are_dropped(amplitude, frequency, stays):
    generator = np.random.default_rng(6)
    strong, weak = (offsets_of([a, a], [f, f], generator, noise=0.0) for a, f in ((3.1, 50.0), (amplitude, frequency)))
    noise = 0.0006 * generator.standard_normal(strong.shape)
    measurements = as_measurements(strong + weak + noise)
    start = np.broadcast_to([50.0, frequency], (1, 2, 2))
    fit = fit_tones(measurements, start, np.ones((1, 2, 2), dtype=bool))
    kept = selection.significant_only(measurements, fit, np.array([FRAME_PERIOD]))
    assert kept.active.tolist() == [[[True, stays]] * 2]
    assert np.abs(kept.coefficients[..., 0]).ravel().tolist() == pytest.approx([3.1, 3.1], abs=0.02)
    # small offsets near a blind frequency: the tone is kept for the verdict
    blind = np.broadcast_to([50.0, 7 / FRAME_PERIOD + 0.01], (1, 2, 2))
    certain = replace(fit, frequencies=blind, covariance=1e-12 * np.eye(14)[None])
    assert selection.significant_only(measurements, certain, np.array([FRAME_PERIOD])).active.all()
