"""Libraries in the benchmark: their results compared with known offsets, tones and frames."""

import numpy as np
import pytest
import torch
from benchmarks.library_chain import by_match_template, fit_axis, kernel_of_row
from benchmarks.restoration_peers import remap_lanczos, wiener_rows
from truth import MARGIN, Motion, crop, decibel, draw_scene, take_frames

import rsvib_torch as rsv

TIMING = rsv.SensorTiming(row_time=20.52e-6, exposure_rows=100, frame_rows=2048)


def shifted_pair(shift, size=(160, 192)):
    """A smooth random image, and the same image displaced by ``shift`` (x, y) px with the Fourier transform."""
    generator = np.random.default_rng(5)
    v, u = np.fft.fftfreq(size[0])[:, None], np.fft.rfftfreq(size[1])[None]
    spectrum = np.fft.rfft2(generator.standard_normal(size)) * np.exp(-0.5 * ((u**2 + v**2) / 0.2**2))
    moved = spectrum * np.exp(-2j * np.pi * (u * shift[0] + v * shift[1]))
    pair = np.stack([np.fft.irfft2(values, s=size) for values in (spectrum, moved)])
    return (0.5 + 0.15 * pair / pair.std()).astype(np.float32)


def test_match_template_registers_bands():
    shift = (2.3, -1.4)
    frames = shifted_pair(shift)
    before = frames.copy()
    found = by_match_template(frames, [0, 16, 64, 96, 128], 32)
    np.testing.assert_array_equal(frames, before)
    assert np.isfinite(found[1:]).all()  # the content of the first band is outside the other frame
    np.testing.assert_allclose(np.median(found[1:], axis=0), shift, rtol=0, atol=0.08)


def test_libraries_fit_tones():
    # mean displacements by numerical integration
    def mean_position(starts, amplitude, frequency, phase):
        inside = (np.arange(2000) + 0.5) / 2000 * TIMING.exposure_time
        return (amplitude * np.sin(2 * np.pi * frequency * (starts[:, None] + inside) + phase)).mean(1)

    times = (np.arange(0, 2017, 16) + 15.5) * TIMING.row_time
    for amplitude, frequency, phase in ((3.1, 50.0, 0.7), (5.2, 30.0, -2.1), (0.4, 155.0, 1.5)):
        offsets = [mean_position(start, amplitude, frequency, phase) for start in (times, times + TIMING.frame_period)]
        offsets = offsets[1] - offsets[0] + np.random.default_rng(0).normal(0, 1e-4, len(times))
        found = fit_axis(times, offsets, TIMING)
        np.testing.assert_allclose(found[:2], (amplitude, frequency), rtol=1e-3)
        assert abs(np.angle(np.exp(1j * (found[2] - phase)))) < 2e-3
        offsets[[3, 40, 90]] = np.nan, 4.0, -3.0  # bands that failed
        np.testing.assert_allclose(fit_axis(times, offsets, TIMING)[:2], (amplitude, frequency), rtol=2e-2)


@pytest.fixture(scope="module")
def scene_and_frames():
    scene = draw_scene(160 + 2 * MARGIN, 144 + 2 * MARGIN, seed=61)
    return crop(scene), take_frames(scene, TIMING, Motion(), 2)


def with_noise(frames):
    return (frames + 0.005 * np.random.default_rng(1).standard_normal(frames.shape)).astype(np.float32)


def test_kernels_of_rows_are_those_of_the_package():
    motion, moved, middle = Motion().vibration(), 2, 20
    starts = torch.tensor([3, 40, 700]) * TIMING.row_time
    kernels, (left, top) = rsv.row_psf(motion, starts.double(), TIMING).dense()
    for start, kernel in zip(starts.tolist(), kernels.numpy(), strict=True):
        expected = np.zeros((2 * middle + 1, 2 * middle + 1))
        row, column = middle + top - moved, middle + left
        expected[row : row + kernel.shape[0], column : column + kernel.shape[1]] = kernel
        found = kernel_of_row(motion, start, TIMING, moved)
        rim = [middle - size // 2 for size in found.shape]
        np.testing.assert_allclose(np.pad(found, [(n, n) for n in rim]), expected, rtol=0, atol=1e-6)
        assert found.sum() == pytest.approx(1)


@pytest.mark.parametrize("index", [0, 1])
def test_row_loops_and_unwarping_restore_either_frame(scene_and_frames, index):
    scene, frames = scene_and_frames
    frame, motion = with_noise(frames)[index], Motion().vibration()
    unwarped = remap_lanczos(frame, TIMING, motion, index).numpy()
    assert decibel(unwarped, scene, 24) > decibel(frame, scene, 24) + 8
    quality = wiener_rows(frame, TIMING, motion, torch.from_numpy(scene), 24, index)
    assert quality > decibel(frame, scene, 24) + 8
