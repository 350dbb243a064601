"""Search for tones: outliers, significance, number of fits."""

import math
from dataclasses import replace

import pytest
import torch
from torch.overrides import TorchFunctionMode

from rsvib_torch.detection.measurements import Measurements
from rsvib_torch.detection.tones import selection
from rsvib_torch.detection.tones.fit import amplitude_std, fit_tones, with_unknown_errors

ROWS, ROW_TIME, FRAME_PERIOD = 120, 16 * 20.52e-6, 2048 * 20.52e-6


def offsets_of(amplitude, frequency, generator, noise=0.003):
    """Offsets (1, N, 2) between rows of two frames that vibrate, measured with an error of ``noise`` px."""
    starts = torch.arange(ROWS, dtype=torch.float64) * ROW_TIME
    turn = 2 * math.pi * torch.tensor(frequency, dtype=torch.float64)
    size = torch.tensor(amplitude, dtype=torch.float64)
    places = [size * torch.cos(turn * (starts + shift)[:, None] + 0.4) for shift in (0, FRAME_PERIOD)]
    errors = noise * torch.randn(ROWS, 2, dtype=torch.float64, generator=generator)
    return (places[1] - places[0] + errors)[None]


def as_measurements(offsets):
    starts = (torch.arange(ROWS, dtype=torch.float64) * ROW_TIME).expand(len(offsets), -1)
    information = torch.eye(2, dtype=torch.float64).expand(len(offsets), ROWS, 2, 2)
    return Measurements.of_pairs(starts, starts + FRAME_PERIOD, offsets, information, 0.0)


@pytest.mark.parametrize(("rows", "known"), [(4, False), (5, True)])
def test_errors_are_unknown_with_as_many_parameters_as_measurements(rows, known):
    """Three parameters of a tone and the drift fit four rows exactly; their residual is 0 for any errors."""
    offsets = offsets_of([3.1, 5.2], [50.0, 30.0], torch.Generator().manual_seed(3))[:, :: ROWS // rows][:, :rows]
    starts = (torch.arange(ROWS, dtype=torch.float64) * ROW_TIME)[None, :: ROWS // rows][:, :rows]
    information = torch.eye(2, dtype=torch.float64).expand(1, rows, 2, 2)
    measurements = Measurements.of_pairs(starts, starts + FRAME_PERIOD, offsets, information, 0.0)
    start = torch.tensor([[[50.0], [30.0]]], dtype=torch.float64)
    fit = with_unknown_errors(measurements, fit_tones(measurements, start, torch.ones(1, 2, 1, dtype=torch.bool)))
    significance = fit.amplitude / amplitude_std(fit)
    assert ((significance > selection.MIN_SIGNIFICANCE) == known).all()


def test_the_amplitude_of_a_blind_tone_is_bounded():
    """Without motion along the scan, frames do not depend on a tone of a blind frequency."""
    offsets = offsets_of([3.1, 5.2], [50.0, 30.0], torch.Generator().manual_seed(3))
    measurements = as_measurements(offsets)
    blind = torch.arange(1, 5, dtype=torch.float64) / FRAME_PERIOD
    frequencies = torch.tensor([[[50.0, 30.0 + 1 / FRAME_PERIOD], [30.0, 0.0]]], dtype=torch.float64)
    fit = fit_tones(measurements, frequencies, frequencies > 0)  # a weak side tone of the first blind frequency along x
    assert selection.find_tones(measurements, ROW_TIME, start=fit, blind=blind).amplitude.max() < 30


class TransformedValues(TorchFunctionMode):
    """Number of the values that are transformed within a block."""

    count = 0

    def __torch_function__(self, function, types, args=(), kwargs=None):
        self.count += args[0].numel() if function is torch.fft.rfft else 0
        return function(*args, **(kwargs or {}))


def test_only_disturbed_rows_are_excluded():
    generator = torch.Generator().manual_seed(8)
    clean = offsets_of([3.1, 5.2], [50.0, 30.0], generator)
    cloudy = offsets_of([2.0, 1.1], [50.0, 35.0], generator)
    cloudy[:, 30:58] += torch.linspace(2.0, 9.0, 28)[:, None]  # an object with its own motion
    alone, transformed = [], []
    for offsets in (clean, cloudy):
        with TransformedValues() as values:
            alone.append(selection.find_tones(as_measurements(offsets), ROW_TIME, 1))
        transformed.append(values.count)
    assert transformed[1] > 4 * transformed[0]  # fits without a stretch of rows are tried for disturbed rows only
    for fit, amplitude, frequency in zip(alone, ([3.1, 5.2], [2.0, 1.1]), ([50.0, 30.0], [50.0, 35.0]), strict=True):
        assert fit.coefficients.abs().flatten().tolist() == pytest.approx(amplitude, rel=0.01)
        assert fit.frequencies.flatten().tolist() == pytest.approx(frequency, rel=0.003)
    together = selection.find_tones(as_measurements(torch.cat([clean, cloudy])), ROW_TIME, 1)
    for index, fit in enumerate(alone):
        torch.testing.assert_close(together.frequencies[index], fit.frequencies[0], rtol=1e-9, atol=0)
        torch.testing.assert_close(together.coefficients[index], fit.coefficients[0], rtol=1e-7, atol=0)


def test_weak_tone_beside_a_strong_tone_is_detected_and_noise_is_not():
    generator = torch.Generator().manual_seed(4)
    one = as_measurements(offsets_of([3.1, 5.2], [50.0, 30.0], generator))
    weak = offsets_of([0.006, 0.005], [88.0, 79.0], generator)
    two = as_measurements(one.displacements[:, :, 1] - one.displacements[:, :, 0] + weak)
    for measurements, tones in ((one, 1), (two, 2)):
        fit = selection.find_tones(measurements, ROW_TIME)
        assert fit.active.sum(-1).tolist() == [[tones, tones]]
    assert fit.frequencies[0, :, 1].tolist() == pytest.approx([88.0, 79.0], rel=0.02)


@pytest.mark.parametrize(
    ("amplitude", "frequency", "stays"),
    [
        (0.05, 341.0, True),
        (0.003, 341.0, False),  # significant, but as small as residuals of interpolation
        (0.0005, 341.0, False),  # may be noise
    ],
)
def test_insignificant_and_small_tones_are_dropped(amplitude, frequency, stays):
    generator = torch.Generator().manual_seed(6)
    strong, weak = (offsets_of([a, a], [f, f], None, noise=0.0) for a, f in ((3.1, 50.0), (amplitude, frequency)))
    noise = 0.0006 * torch.randn(strong.shape, dtype=torch.float64, generator=generator)
    measurements = as_measurements(strong + weak + noise)
    start = torch.tensor([50.0, frequency], dtype=torch.float64).expand(1, 2, 2)
    fit = fit_tones(measurements, start, torch.ones(1, 2, 2, dtype=torch.bool))
    kept = selection.significant_only(measurements, fit, torch.tensor([FRAME_PERIOD], dtype=torch.float64))
    assert kept.active.tolist() == [[[True, stays]] * 2]
    assert kept.coefficients[..., 0].abs().flatten().tolist() == pytest.approx([3.1, 3.1], abs=0.02)
    # small offsets near a blind frequency: the tone is kept for the verdict
    blind = torch.tensor([50.0, 7 / FRAME_PERIOD + 0.01], dtype=torch.float64).expand(1, 2, 2)
    certain = replace(fit, frequencies=blind, covariance=1e-12 * torch.eye(14, dtype=torch.float64)[None])
    assert selection.significant_only(measurements, certain, torch.tensor([FRAME_PERIOD])).active.all()
