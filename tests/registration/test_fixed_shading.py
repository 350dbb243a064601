"""Images of a scanned eye: tissue moves under fixed vignetting and speckle; offsets must be those of the tissue."""

import numpy as np
import pytest
import torch
from scipy import ndimage
from truth import MARGIN, Curve, draw_scene, take_frames

import rsvib_torch as rsv

SIZE = 256
TIMING = rsv.SensorTiming(row_time=1 / 30 / SIZE, exposure_rows=1, frame_rows=SIZE)


@Curve
def wander(times):
    """Drift of an eye: steps of a random walk smoothed over a fifth of a frame, no sinusoid."""
    generator = np.random.default_rng(8)
    grid = np.arange(-0.2, 0.8, 1e-3)
    walk = np.cumsum(generator.standard_normal((len(grid), 2)), axis=0)
    path = ndimage.gaussian_filter1d(walk, 6.0, axis=0)
    path = 2.5 * (path - path.mean(0)) / path.std(0)
    return np.stack([np.interp(times, grid, path[:, axis]) for axis in range(2)], axis=-1)


@pytest.fixture(scope="module", name="recording")
def make_recording():
    scene = draw_scene(SIZE + 2 * MARGIN, SIZE + 2 * MARGIN, 4)
    motion = wander
    frames = take_frames(scene, TIMING, motion, 4)
    v, u = np.meshgrid(np.linspace(-1, 1, SIZE), np.linspace(-1, 1, SIZE), indexing="ij")
    vignette = 0.1 + 0.9 * np.exp(-(u**2 + v**2) / 0.35)
    speckle = 0.03 * np.random.default_rng(1).standard_normal(frames.shape)
    return torch.from_numpy(vignette * frames + speckle).float(), motion


def offsets_between(frames, first, second):
    starts = [first * TIMING.frame_period, second * TIMING.frame_period]
    timing = rsv.SensorTiming(TIMING.row_time, 1, TIMING.frame_rows, frame_start_times=starts)
    curve = rsv.register_bands(frames[[first, second]], timing, search=24)
    return curve.rows.numpy(), curve.offsets[0].numpy()


@pytest.mark.parametrize("pair", [(0, 1), (1, 2), (0, 2)])
def test_offsets_are_those_of_the_tissue_not_of_the_vignette(recording, pair):
    frames, motion = recording
    rows, offsets = offsets_between(frames, *pair)
    then = pair[0] * TIMING.frame_period + rows * TIMING.row_time
    later = pair[1] * TIMING.frame_period + (rows + np.nan_to_num(offsets[:, 1])) * TIMING.row_time
    truth = motion.displacement(later) - motion.displacement(then)
    assert np.abs(truth).mean() > 0.8
    error = offsets - truth
    assert np.isfinite(error).all(1).mean() > 0.8
    assert np.nanmedian(np.abs(error), axis=0).max() < 0.15
