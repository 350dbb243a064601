import numpy as np
import pytest
import torch
from scipy import ndimage
from scipy.interpolate import BSpline
from truth import Motion, draw_scene, take_frames

from rsvib_torch import SensorTiming
from rsvib_torch.restoration import restore

TIMING = SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)
SHORT = SensorTiming(row_time=1e-3, exposure_rows=3, frame_rows=24)


def lucy(frames, timing, vibration, **options):
    return restore(frames, timing, vibration, method="richardson-lucy", check=False, **options)


def folded(index, length):
    index = np.abs(index) % (2 * length - 2)
    return np.minimum(index, 2 * length - 2 - index)


def dense_operator(timing, motion, height, width, frame=0, samples=100):
    """Matrix from spline coefficients to frame pixels, one by one; the exposure is a midpoint sum with many samples."""
    basis = BSpline.basis_element(np.arange(5) - 2.0, extrapolate=False)
    matrix = np.zeros((height, width, height, width))
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
    basis = np.array([1.0, 4.0, 1.0]) / 6
    return ndimage.correlate(coefficients, np.outer(basis, basis), mode="mirror")


@pytest.fixture(scope="module")
def small():
    motion = Motion(amplitude=(1.2, 0.8), frequency=(40.0, 31.0), phase=(0.3, 1.0))
    frame = np.random.default_rng(4).uniform(0.05, 1.0, (10, 9))
    return motion, frame, dense_operator(SHORT, motion, 10, 9)


@pytest.mark.parametrize("masked", [False, True])
def test_agrees_with_a_dense_loop(small, masked):
    motion, frame, operator = small
    ignore = np.random.default_rng(5).random(frame.shape) < 0.1 if masked else np.zeros(frame.shape, dtype=bool)
    tensor, mask = torch.from_numpy(frame)[None], torch.from_numpy(ignore)[None]
    options = {"ignore": mask} if masked else {}
    found = lucy(tensor, SHORT, motion.vibration(), iterations=4, **options)[0].numpy()
    known = torch.from_numpy(frame)[None]
    if masked:
        from rsvib_torch.frames.pixels import fill_with_means

        known = fill_with_means(known, mask)
    start = restore(known, SHORT, motion.vibration(), method="dewarp", check=False)[0].numpy()
    weight = (~ignore).ravel().astype(float)
    scene = np.maximum(start, 1e-4 * frame[~ignore].mean()).ravel()
    seen = operator.T @ weight  # of each pixel
    for _ in range(4):
        gradient = operator.T @ (weight * frame.ravel() / (operator @ scene))
        scene = np.where(seen > 0.1, scene * gradient / seen, scene)
    assert 0 < (seen <= 0.1).sum() < 0.2 * seen.size
    expected = spline_samples(scene.reshape(frame.shape))
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-4)
    assert abs(expected - start).max() > 0.05


def test_restoration_outside_the_visible_area_stays_bounded():
    motion = Motion(amplitude=(30.0, 1.0))
    scene = draw_scene(256, 256, seed=22)
    frames = torch.from_numpy(take_frames(scene, TIMING, motion, 2, 0.005, margin=64))
    found = [
        lucy(frames.to(dtype), TIMING, motion.vibration(), iterations=100) for dtype in (torch.float64, torch.float32)
    ]
    assert found[0].max() < 1.3 * frames.max()
    torch.testing.assert_close(found[1].double(), found[0], rtol=0, atol=1e-3)
