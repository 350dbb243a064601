"""Spectrum of the displacement: lines at their frequencies and amplitudes, no ghosts, honest noise, blind bands."""

import csv
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from detections import result_of
from refusals import refuses
from truth import Curve, draw_scene, take_frames

import rsvib_torch as rsv
from rsvib_torch.datasets import example_frames

TIMING = rsv.SensorTiming(row_time=4e-5, exposure_rows=25, frame_rows=1 / (60 * 4e-5))
TONES = ((0.8, 137.0, 0.3), (0.05, 411.3, 1.0), (0.02, 266.0, 2.0))  # px, Hz, rad
ROWS = 240  # read in 9.6 ms of the 16.7 ms of a frame: a Fourier transform has ghosts of 50 % and more


def averaged(times, tones, duration):
    """Mean displacement over exposures about the times: A sinc(f T_e) sin(2 pi f t + phase)."""
    return sum(a * np.sinc(f * duration) * np.sin(2 * np.pi * f * times + p) for a, f, p in tones)


def detection_with_offsets(tones, noise, *, frames=60, dropped=(), seed=0, drift=0.0):
    """A detection that explains nothing; offsets of blocks of 8 rows, exact along x, 0 along y, plus noise."""
    kept = np.array([frame for frame in range(frames) if frame not in dropped])
    starts = kept / 60.0
    rows = np.arange(3.5, ROWS, 8)
    times = starts[:, None] + rows * TIMING.row_time
    block = np.arange(-3.5, 4) * TIMING.row_time
    middle = times[..., None] + block + 0.5 * TIMING.exposure_time
    displacement = averaged(middle, tones, TIMING.exposure_time).mean(-1) + drift * times
    generator = np.random.default_rng(seed)
    offsets = np.stack([np.diff(displacement, axis=0), np.zeros((len(kept) - 1, len(rows)))], -1)
    offsets += noise * generator.standard_normal(offsets.shape)
    found = result_of(rsv.Vibration.still(), TIMING, 0.01, last_row=32)
    pairs = np.stack([np.arange(len(kept) - 1), np.arange(1, len(kept))], -1)
    curve = rsv.OffsetCurve(
        *map(torch.from_numpy, (pairs, rows, times[:-1], times[1:], offsets, np.ones(offsets.shape[:2]))),
        (8, 8),
        torch.full(offsets.shape, noise, dtype=torch.float64),
    )
    return replace(found, offsets=curve, fitted=torch.zeros_like(curve.offsets), timing=TIMING)


@pytest.mark.parametrize("dropped", [(), (7, 8, 30)])
def test_lines_have_their_amplitudes_and_no_ghosts(dropped):
    spectrum = detection_with_offsets(TONES, 0.003, dropped=dropped, drift=2.0).spectrum()
    frequency, amplitude = spectrum.frequency.numpy(), spectrum.amplitude[0].numpy()
    for size, at, _ in TONES:
        line = int((spectrum.lines.frequency[0] - at).abs().argmin())
        noise = float(spectrum.noise[0, int(np.abs(frequency - at).argmin())])
        assert float(spectrum.lines.amplitude[0, line]) == pytest.approx(size, abs=4 * noise)
        assert float(spectrum.lines.frequency[0, line]) == pytest.approx(at, abs=0.2 * spectrum.resolution)
        # the curve has a peak of that height within the step of its frequencies
        assert np.nanmax(amplitude[np.abs(frequency - at) < 2]) == pytest.approx(size, rel=0.25)
    ghosts = [at + 60 * multiple for _, at, _ in TONES for multiple in (-2, -1, 1, 2)]
    near = np.any([np.abs(frequency - ghost) < 3 for ghost in ghosts], 0)
    near &= np.all([np.abs(frequency - at) > 5 for _, at, _ in TONES], 0)
    assert near.sum() > 50
    assert np.nanmax(amplitude[near] / spectrum.noise[0].numpy()[near]) < 4  # of 0.8 px: 0.001
    assert np.nanmax(amplitude[near]) < 0.01
    power = np.nansum(spectrum.psd[0].numpy()) * (frequency[1] - frequency[0])
    assert power == pytest.approx(sum(0.5 * size**2 for size, _, _ in TONES), rel=0.1)


def test_a_line_in_a_blind_band_has_no_ghosts_outside():
    spectrum = detection_with_offsets(((0.3, 238.7, 1.0),), 0.003).spectrum()
    assert float(spectrum.lines.frequency[0, 0]) == pytest.approx(238.7, abs=0.1)
    elsewhere = (spectrum.frequency - 238.7).abs() > 4  # Hz; the width of the line is 1 Hz
    assert float((spectrum.amplitude[0] / spectrum.noise[0])[elsewhere].nan_to_num().max()) < 4


def test_errors_of_the_registration_are_no_lines_where_the_exposure_averages():
    errors = (0.09, 1015.0, 1.0)  # of the offsets, 0.0013 px: a tone of 0.09 px would cause them
    lines = detection_with_offsets((*TONES[:1], errors), 1e-4).spectrum().lines
    assert lines.frequency[0].tolist() == pytest.approx([137.0], abs=0.1)


def test_noise_alone_has_no_lines_and_the_stated_noise():
    spectrum = detection_with_offsets(((0.0, 50.0, 0.0),), 0.01).spectrum()
    assert not spectrum.lines.amplitude.any()
    ratio = (spectrum.amplitude / spectrum.noise).square()
    assert float(ratio.nanmean()) == pytest.approx(1.0, abs=0.15)
    # of n independent offsets with noise s and gain |h|, an amplitude has the variance 4 s^2 / (n |h|^2)
    at = int((spectrum.frequency - 30.0).abs().argmin())
    attenuation = float(np.sinc(30 * TIMING.exposure_time) * np.sinc(30 * 8 * TIMING.row_time))
    expected = 2 * 0.01 / math.sqrt(59 * 30) / (2 * attenuation)
    assert float(spectrum.noise[0, at]) == pytest.approx(expected, rel=0.1)


def test_blind_bands_are_around_multiples_of_the_frame_rate():
    spectrum = detection_with_offsets(TONES, 0.003).spectrum()
    frequency, blind = spectrum.frequency, spectrum.blind
    assert float(frequency[-1]) == pytest.approx(0.5 / (8 * TIMING.row_time), abs=1)
    gain = (2 * torch.sin(math.pi * frequency / 60) * torch.sinc(frequency * TIMING.exposure_time)).abs()
    gain *= torch.sinc(frequency * 8 * TIMING.row_time)
    clear = (gain - 0.1 * gain.max()).abs() > 0.01
    assert torch.equal(blind[clear], (gain < 0.1 * gain.max())[clear])
    at = [int((frequency - value).abs().argmin()) for value in (60, 90, 120, 150, 1000)]
    assert blind[at].tolist() == [True, False, True, False, True]
    assert torch.isnan(spectrum.amplitude[:, blind]).all()
    assert torch.isfinite(spectrum.amplitude[:, ~blind]).all()


def test_spectrum_of_frames_has_a_tone_that_the_detection_left_out():
    """The detection of a single tone along x does not explain the second one, which the spectrum has."""
    motion = Curve(lambda t: np.stack([0.8 * np.sin(880 * t) + 0.1 * np.sin(2530 * t), 0.3 * np.sin(600 * t + 1)], -1))
    frames = take_frames(draw_scene(240, 220, seed=4), TIMING, motion, 24, noise=0.005, seed=3)
    found = rsv.detect_vibration(torch.as_tensor(frames, dtype=torch.float32), TIMING, tones=1)
    spectrum = found.spectrum()
    assert spectrum.lines.amplitude[0, :2].tolist() == pytest.approx([0.8, 0.1], rel=0.15)  # errors of up to 13 %
    assert spectrum.lines.frequency[0, :2].tolist() == pytest.approx([880 / 2 / math.pi, 2530 / 2 / math.pi], abs=0.2)
    assert spectrum.lines.amplitude[1, 0] == pytest.approx(0.3, rel=0.05)
    assert spectrum.resolution == pytest.approx(1 / (23 / 60 + 232 * TIMING.row_time), rel=0.03)  # of 24 frames
    assert spectrum.frequency.diff().tolist() == pytest.approx(
        [0.5 * spectrum.resolution] * (len(spectrum.frequency) - 1)
    )


def test_overlapping_bands_have_no_lines_of_amplified_errors():
    """Bands of 32 rows average tones above their rate out; half of it is the highest frequency."""
    frames, timing, truth = example_frames(num_frames=6)
    spectrum = rsv.detect_vibration(frames, timing, method="bands").spectrum()
    assert float(spectrum.frequency[-1]) <= 0.5 / (32 * timing.row_time)
    torch.testing.assert_close(spectrum.lines.amplitude[:, :1], truth.amplitude, rtol=0.05, atol=0)
    assert (spectrum.lines.amplitude[:, 1:] < 0.1).all()


def test_spectrum_as_table_and_figure(tmp_path):
    found = detection_with_offsets(TONES, 0.003)
    spectrum = found.spectrum()
    rsv.write_table(tmp_path / "spectrum.csv", spectrum, pixel_size=5e-6)
    with (tmp_path / "spectrum.csv").open() as file:
        rows = list(csv.DictReader(file))
    peak = max(rows, key=lambda row: float(row["amplitude_x_px"] or 0))
    frequency, amplitude = float(peak["frequency_Hz"]), float(peak["amplitude_x_px"])
    assert frequency == pytest.approx(137, abs=0.5)
    assert float(peak["amplitude_x_um"]) == pytest.approx(5 * amplitude)
    assert float(peak["psd_x_um2_per_Hz"]) == pytest.approx(25 * amplitude**2 / (2 * spectrum.resolution))
    assert float(peak["velocity_x_um_per_s"]) == pytest.approx(5 * amplitude * 2 * math.pi * frequency)
    assert float(peak["acceleration_x_m_per_s2"]) == pytest.approx(5e-6 * amplitude * (2 * math.pi * frequency) ** 2)
    assert all(row["amplitude_x_px"] == "" for row in rows if row["blind"] == "True")
    figure = found.spectrum().plot(tmp_path / "spectrum.png")
    assert (tmp_path / "spectrum.png").stat().st_size > 10_000
    labels = [text.get_text() for text in figure.axes[0].texts]
    assert labels[0].startswith("137.0 Hz\n0.8")


def test_missing_offsets_and_batches_are_refused_by_name():
    found = detection_with_offsets(TONES, 0.003)
    curve = replace(found.offsets, offsets=torch.full_like(found.offsets.offsets, math.nan))
    with pytest.raises(ValueError, match="a spectrum needs at least 8 measured offsets, got 0; use more frames"):
        replace(found, offsets=curve).spectrum()
    refuses(lambda: rsv.DetectionResult.stacked([found, found]).spectrum(), r"is a batch of shape \(2,\)")
