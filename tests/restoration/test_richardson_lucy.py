import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline
from truth import Motion, crop, decibel, draw_scene, take_frames

from rsvib_torch import SensorTiming, Vibration
from rsvib_torch.restoration import restore

TIMING = SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)
SHORT = SensorTiming(row_time=1e-3, exposure_rows=3, frame_rows=24)


def lucy(frames, timing, vibration, **options):
    return restore(frames, timing, vibration, method="richardson-lucy", check=False, **options)


def folded(index, length):
    index = np.abs(index) % (2 * length - 2)
    return np.minimum(index, 2 * length - 2 - index)


def dense_operator(timing, motion, height, width, frame=0):
    """Frame pixels from spline coefficients, pixel by pixel, the exposure as a fine midpoint sum."""
    basis = BSpline.basis_element(np.arange(5) - 2.0, extrapolate=False)
    matrix = np.zeros((height, width, height, width))
    samples = 400
    for row in range(height):
        times = (frame * timing.frame_rows + row) * timing.row_time
        x, y = motion.displacement(times + (np.arange(samples) + 0.5) / samples * timing.exposure_time).T
        for dx, dy in zip(x, y, strict=True):
            for column in range(width):
                rows = np.floor(row - dy).astype(int) + np.arange(-1, 3)
                columns = np.floor(column - dx).astype(int) + np.arange(-1, 3)
                weight = np.outer(np.nan_to_num(basis(row - dy - rows)), np.nan_to_num(basis(column - dx - columns)))
                place = np.ix_([row], [column], folded(rows, height), folded(columns, width))
                np.add.at(matrix, place, weight[None, None] / samples)
    return matrix.reshape(height * width, height * width)


def spline_samples(coefficients):
    for axis in (0, 1):
        padded = np.pad(coefficients, [(1, 1) if a == axis else (0, 0) for a in (0, 1)], mode="reflect")
        middle = np.take(padded, range(1, padded.shape[axis] - 1), axis)
        sides = np.take(padded, range(padded.shape[axis] - 2), axis) + np.take(
            padded, range(2, padded.shape[axis]), axis
        )
        coefficients = (4 * middle + sides) / 6
    return coefficients


@pytest.fixture(scope="module")
def small():
    motion = Motion(amplitude=(1.2, 0.8), frequency=(40.0, 31.0), phase=(0.3, 1.0))
    frame = np.random.default_rng(4).uniform(0.05, 1.0, (10, 9))
    return motion, frame, dense_operator(SHORT, motion, 10, 9)


@pytest.mark.parametrize("hidden", [False, True])
def test_agrees_with_a_dense_loop(small, hidden):
    motion, frame, operator = small
    ignore = np.random.default_rng(5).random(frame.shape) < 0.1 if hidden else np.zeros(frame.shape, dtype=bool)
    tensor, mask = torch.from_numpy(frame)[None], torch.from_numpy(ignore)[None]
    options = {"ignore": mask} if hidden else {}
    found = lucy(tensor, SHORT, motion.vibration(), iterations=4, **options)[0].numpy()
    known = torch.from_numpy(frame)[None]
    if hidden:
        from rsvib_torch.restoration.missing import fill_roughly

        known = fill_roughly(known, mask)
    start = restore(known, SHORT, motion.vibration(), method="dewarp", check=False)[0].numpy()
    weight = (~ignore).ravel().astype(float)
    scene = np.maximum(start, 1e-4 * frame[~ignore].mean()).ravel()
    for _ in range(4):
        scene = scene * (operator.T @ (weight * frame.ravel() / (operator @ scene))) / (operator.T @ weight)
    expected = spline_samples(scene.reshape(frame.shape))
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-4)
    assert abs(expected - start).max() > 0.05


def test_positive_and_flux_is_conserved():
    lamp = torch.zeros(1, 96, 96, dtype=torch.float64)
    lamp[0, 40:56, 40:60] = torch.rand(16, 20, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    restored = lucy(lamp, TIMING, Vibration([1.5, 2.0], [50.0, 30.0]), iterations=5)
    assert restored.min() >= 0
    # rows are sampled more densely or more sparsely than the scene, by as much as the motion runs along or against them
    assert restored.sum().item() == pytest.approx(lamp.sum().item(), rel=0.02)
    still = lucy(lamp, TIMING, Vibration.still(), iterations=5)
    assert still.sum().item() == pytest.approx(lamp.sum().item(), rel=1e-9)
    assert (still - lamp).abs().max() > 1e-3


def test_undoes_a_long_exposure_where_geometry_alone_does_not():
    timing = SensorTiming(row_time=20.52e-6, exposure_rows=200, frame_rows=2048)
    motion = Motion()
    scene = draw_scene(272, 240, seed=21)
    frames = torch.from_numpy(take_frames(scene, timing, motion, 1, 0.002, samples=32)).float()
    warped = decibel(restore(frames, timing, motion.vibration(), method="dewarp", check=False), crop(scene))
    assert decibel(lucy(frames, timing, motion.vibration()), crop(scene)) > warped + 3


def test_batch_channels_and_push_scan_change_nothing():
    motion = Motion(amplitude=(1.0, 0.7), image_motion=(400.0, -300.0))
    frames = torch.rand(2, 2, 1, 40, 36, generator=torch.Generator().manual_seed(3), dtype=torch.float64) + 0.1
    together = lucy(frames, TIMING, motion.vibration(), iterations=3)
    for index in range(2):
        single = lucy(frames[index, :, 0], TIMING, motion.vibration(), iterations=3)
        torch.testing.assert_close(together[index, :, 0], single, rtol=0, atol=1e-12)
    colour = lucy(torch.cat([frames[0], frames[1]], dim=1), TIMING, motion.vibration(), iterations=3)
    torch.testing.assert_close(colour[:, 1], together[1, :, 0], rtol=0, atol=1e-12)


def test_bad_input():
    with pytest.raises(ValueError, match="iterations must be at least 1"):
        lucy(torch.zeros(1, 16, 16), TIMING, Vibration(1.0, 50.0), iterations=0)
