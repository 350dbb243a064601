"""Offsets of bands against truth, with large shifts, failed bands, and shading that is fixed to the camera."""

from typing import get_args

import numpy as np
import pytest
import torch
from scipy import ndimage
from truth import MARGIN, Curve, Motion, draw_scene, recorded, take_frames

import rsvib_torch as rsv
from rsvib_torch import SensorTiming, register_bands
from rsvib_torch.options import Registration

METHODS = get_args(Registration)
# RMS error in px along the rows and along the scan axis, valid bands only; the offsets are 1.4 and 5 px RMS
RMS = {"projection": (0.08, 0.8), "ncc": (0.03, 0.08), "phase": (0.025, 0.04)}


def true_offsets(curve, timing, motion):
    """Offsets (P, N, 2) by Eqs. (1), (2), integrated numerically, at the rows to which the content moves."""
    steps = (np.arange(64) + 0.5) / 64 * timing.exposure_time

    def mean(times):
        return motion.displacement(times[..., None] + steps).mean(-2)

    early, late = curve.times.numpy(), curve.later_times.numpy()
    offsets = mean(late) - mean(early)
    for _ in range(8):
        offsets = mean(late + offsets[..., 1] * timing.row_time) - mean(early)
    return offsets


@pytest.fixture(scope="module")
def pair(paper_camera):
    return recorded((2048, 448), paper_camera, Motion(), 2, 0.003, seed=31), Motion()


@pytest.mark.parametrize("method", METHODS)
def test_offsets_against_truth(pair, paper_camera, method):
    frames, motion = pair
    curve = register_bands(frames, paper_camera, method=method)
    truth = true_offsets(curve, paper_camera, motion)
    error = curve.offsets.numpy() - truth
    rms = np.sqrt(np.nanmean(error**2, axis=(0, 1)))
    assert bool((rms < RMS[method]).all()), rms
    assert bool((np.sqrt(np.mean(truth**2, axis=(0, 1))) > 1.0).all())
    assert curve.good.double().mean() > 0.9
    assert (curve.quality[curve.good] > 0.5).double().mean() > 0.98


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("shift", [(-240.0, -150.0), (20.0, 300.0)])
def test_push_scan_shift_of_hundreds_of_pixels(method, shift):
    """The frames are cut from one drawn scene at places far apart, so that the truth is a whole number of px."""
    timing = SensorTiming(row_time=10e-6, exposure_rows=10, frame_rows=1024)
    scene = torch.from_numpy(draw_scene(1024, 1088, 9)).float()
    x, y = (int(part) for part in shift)
    tall, wide = 1024 - abs(y), 1088 - abs(x)
    size = (min(640, tall), min(704, wide))
    top, left = max(0, y), max(0, x)
    first = scene[top : top + size[0], left : left + size[1]]
    second = scene[top - y : top - y + size[0], left - x : left - x + size[1]]
    curve = register_bands(torch.stack([first, second]), timing, method=method)
    good = curve.good
    assert good.double().mean() > 0.4
    error = (curve.offsets[good] - torch.tensor(shift, dtype=torch.float64)).abs()
    assert error.median(0).values.tolist() == pytest.approx([0.0, 0.0], abs=0.03 if method == "projection" else 0.005)
    assert (error.amax(-1) < 0.1).double().mean() > 0.95


@pytest.mark.parametrize("method", METHODS)
def test_frames_that_overlap_too_little_have_no_offsets(method, paper_camera):
    scene = torch.from_numpy(draw_scene(160, 360, 9)).float()
    frames = torch.stack([scene[:, :160], scene[:, 2:162], scene[:, 102:262]])  # the last overlaps by 60 px
    curve = register_bands(frames, paper_camera, method=method)
    assert curve.good.double().mean(-1).tolist()[0] > 0.7
    assert not bool(curve.good[1].any())
    assert bool((curve.quality[1] == 0).all())


@pytest.mark.parametrize("method", METHODS)
def test_failed_bands(method):
    """Bands without texture are NaN with quality 0; the others remain valid."""
    timing = SensorTiming(row_time=10e-6, exposure_rows=10, frame_rows=1024)
    frame = torch.from_numpy(draw_scene(1024, 256, 2)).float()
    flat = slice(256, 640)
    frame[flat] = 0.5
    curve = register_bands(torch.stack([frame, frame]), timing, method=method)
    assert torch.equal(torch.isnan(curve.offsets).any(-1), torch.isnan(curve.offsets).all(-1))
    assert torch.equal(curve.quality == 0, ~curve.good)
    half = (curve.heights[1] // 2) + 40
    inside = (curve.rows > flat.start + half) & (curve.rows < flat.stop - half)
    outside = (curve.rows < flat.start - half) | (curve.rows > flat.stop + half)
    away = outside & (curve.rows > half) & (curve.rows < 1024 - half)
    assert int(inside.sum()) > 5
    assert not bool(curve.good[0, inside].any())
    assert int(away.sum()) > 5
    assert bool(curve.good[0, away].all())
    assert curve.offsets[0, away].abs().max() < (0.1 if method == "projection" else 0.01)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("axis", [-1, -2])
def test_peak_at_the_edge_of_the_search_range_fails(method, axis):
    """Half of the frame moves by more than the search range: no band has an offset at the edge of the range."""
    timing = SensorTiming(row_time=10e-6, exposure_rows=10, frame_rows=1024)
    scene = torch.from_numpy(draw_scene(1100, 360, 3)).float()
    first = scene[40:1064, 40:320]
    second = first.clone()
    moved = scene.roll(12, axis)[40:1064, 40:320]
    second[700:] = moved[700:]
    curve = register_bands(torch.stack([first, second]), timing, method=method, search=8)
    component = 0 if axis == -1 else 1
    reach = curve.heights[1] // 2 + 24
    resting = (curve.rows > reach) & (curve.rows < 700 - reach)
    far = curve.rows > 700 + reach
    assert curve.good[0, resting].double().mean() > 0.95
    assert curve.offsets[0, resting & curve.good[0], component].abs().max() < (0.25 if method == "projection" else 0.1)
    measured = curve.offsets[0, far & curve.good[0], component]
    # offsets measured there are inside the range and have low quality
    assert bool((measured.abs() < 8).all())
    assert int(far.sum()) > 5
    assert curve.good[0, far].double().mean() < 0.6
    assert bool((curve.quality[0, far & curve.good[0]] < 0.8).all())
    # with a larger range, the same bands have the true offset
    wide = register_bands(torch.stack([first, second]), timing, method=method, search=16)
    reach = wide.heights[1] // 2 + 24
    far = (wide.rows > 700 + reach) & (wide.rows < 1024 - reach)
    assert int(far.sum()) > 2
    assert (wide.offsets[0, far, component] - 12).abs().max() < (0.25 if method == "projection" else 0.05)


@pytest.mark.parametrize("method", METHODS)
def test_offsets_do_not_depend_on_brightness_and_contrast(pair, paper_camera, method):
    frames, _ = pair
    frames = frames[:, :768].double()
    changed = frames.clone()
    changed[1] = 0.3 + 0.5 * changed[1]
    one = register_bands(frames, paper_camera, method=method).offsets
    other = register_bands(changed, paper_camera, method=method).offsets
    torch.testing.assert_close(one, other, rtol=0, atol=2e-3, equal_nan=True)


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
