import numpy as np
import pytest
import torch
from scipy import ndimage
from scipy.interpolate import BSpline
from truth import Motion, crop, decibel, draw_scene, take_frames

from rsvib_torch import SensorTiming, Vibration
from rsvib_torch.restoration import restore, visible_pixels

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


def test_two_frames_are_more_accurate_than_one():
    timing = SensorTiming(row_time=20.52e-6, exposure_rows=200, frame_rows=2048)
    motion, scene = Motion(), draw_scene(272, 240, seed=31)
    frames = torch.from_numpy(take_frames(scene, timing, motion, 3, 0.02)).float()
    alone = [decibel(frame, crop(scene)) for frame in lucy(frames, timing, motion.vibration())]
    pairs = lucy(frames, timing, motion.vibration(), joint=2)
    assert pairs.shape == frames.shape
    assert min(decibel(frame, crop(scene)) for frame in pairs) > max(alone) + 1.5
    together = restore(frames, timing, motion.vibration(), method="richardson-lucy", joint=True)
    assert together.shape == (1, *frames.shape[1:])
    assert decibel(together[0], crop(scene)) > max(alone) + 2.5
    assert min(pairs.min(), together.min()) >= 0


def test_numbers_of_frames_restored_together():
    frames = torch.rand(3, 3, 40, 36, generator=torch.Generator().manual_seed(3), dtype=torch.float64) + 0.1
    vibration = Vibration([1.0, 0.7], [50.0, 30.0])
    one, all_three, *few = (lucy(frames, TIMING, vibration, iterations=3, joint=joint) for joint in (1, True, 2, 3, 9))
    assert all_three.shape == (1, 3, 40, 36)
    torch.testing.assert_close(one, lucy(frames, TIMING, vibration, iterations=3), rtol=0, atol=0)
    torch.testing.assert_close(few[1][1:2], all_three, rtol=0, atol=1e-12)
    torch.testing.assert_close(few[2], few[1], rtol=0, atol=0)
    pair = lucy(frames[:2], TIMING, vibration, iterations=3, joint=2)
    torch.testing.assert_close(few[0][0], pair[0], rtol=0, atol=1e-12)
    assert (few[0] - few[1]).abs().max() > 0.01
    batch = lucy(torch.stack([frames, frames.flip(-1)]), TIMING, vibration, iterations=3, joint=True)
    torch.testing.assert_close(batch[0], all_three, rtol=0, atol=1e-12)


def test_displaced_frames_are_joined_where_they_overlap():
    motion = Motion(image_motion=(1500.0, -700.0))  # (63, -29) px from frame to frame
    scene = draw_scene(420, 420, seed=8)
    frames = torch.from_numpy(take_frames(scene, TIMING, motion, 2, 0.02, margin=110)).float()
    _, shift = visible_pixels(TIMING, motion.vibration(), (200, 200), 2)
    columns, rows = (int(step) for step in shift[1] - shift[0])
    assert (columns, rows) == (63, -29)
    truth = np.roll(scene, tuple(int(step) for step in shift[1].flip(0)), (0, 1))[110:-110, 110:-110]
    alone = lucy(frames, TIMING, motion.vibration())[1]
    joint = lucy(frames, TIMING, motion.vibration(), joint=True)[0]
    shared = (slice(0, 200 + rows), slice(columns, None))  # in the coordinates of the second frame
    not_shared = (slice(8, -8), slice(8, columns - 16))
    assert decibel(joint[shared], truth[shared], rim=12) > decibel(alone[shared], truth[shared], rim=12) + 1.5
    torch.testing.assert_close(joint[not_shared], alone[not_shared], rtol=0, atol=2e-3)


def test_masked_pixels_are_restored_from_the_other_frame():
    motion, scene = Motion(), draw_scene(240, 240, seed=12)
    frames = torch.from_numpy(take_frames(scene, TIMING, motion, 2, 0.005)).float()
    ignore = torch.zeros(frames.shape, dtype=torch.bool)
    ignore[1, 60:90, 60:90] = True
    part = (slice(60, 90), slice(60, 90))
    truth = crop(scene)[part]
    found = {joint: lucy(frames, TIMING, motion.vibration(), ignore=ignore, joint=joint)[-1][part] for joint in (1, 2)}
    assert decibel(found[2], truth, rim=2) > 40
    assert decibel(found[1], truth, rim=2) < 25


def test_restoration_outside_the_visible_area_stays_bounded():
    motion = Motion(amplitude=(30.0, 1.0))
    scene = draw_scene(256, 256, seed=22)
    frames = torch.from_numpy(take_frames(scene, TIMING, motion, 2, 0.005, margin=64))
    found = [
        lucy(frames.to(dtype), TIMING, motion.vibration(), iterations=100) for dtype in (torch.float64, torch.float32)
    ]
    assert found[0].max() < 1.3 * frames.max()
    torch.testing.assert_close(found[1].double(), found[0], rtol=0, atol=1e-3)
