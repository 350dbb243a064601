from functools import partial

import numpy as np
import pytest
import torch
from scipy import fft, ndimage
from truth import Motion, crop, decibel, draw_scene, take_frames

from rsvib_torch import SensorTiming, Vibration
from rsvib_torch.restoration import restore as restore_by_any_method
from rsvib_torch.restoration.exact.priors import shrink_patches

restore = partial(restore_by_any_method, method="exact", check=False)
TIMING = SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)


@pytest.mark.parametrize("offset", [(0, 0), (1, 0), (1, 1)])
def test_patches_agree_with_a_loop_over_dct(offset):
    image = np.random.default_rng(0).standard_normal((71, 13))  # more rows than are shrunk at a time
    padded = np.pad(image, 8, mode="edge")
    total, weights = np.zeros_like(padded), np.zeros_like(padded)
    for row in range(offset[0], padded.shape[0] - 7, 2):
        for column in range(offset[1], padded.shape[1] - 7, 2):
            patch = fft.dctn(padded[row : row + 8, column : column + 8], norm="ortho")
            strong = abs(patch) > 2.0 * 0.6
            strong[0, 0] = True
            total[row : row + 8, column : column + 8] += fft.idctn(patch * strong, norm="ortho") / strong.sum()
            weights[row : row + 8, column : column + 8] += 1 / strong.sum()
    found = shrink_patches(torch.from_numpy(image)[None], 0.6, offset)[0].numpy()
    np.testing.assert_allclose(found, total[8:-8, 8:-8] / weights[8:-8, 8:-8], rtol=0, atol=1e-12)


@pytest.fixture(scope="module")
def buildings():
    scene = draw_scene(272, 240, seed=41)
    frames = torch.from_numpy(take_frames(scene, TIMING, Motion(), 2, 0.02)).float()
    return crop(scene), frames


@pytest.fixture(scope="module")
def step():
    scene = np.full((256, 256), 0.25)
    scene[128:] = 0.75
    scene = ndimage.gaussian_filter(scene, 0.8)
    timing = SensorTiming(row_time=20.52e-6, exposure_rows=100, frame_rows=2048)
    frames = torch.from_numpy(take_frames(scene, timing, Motion(), 2, 0.02)).float()
    return crop(scene), frames, timing


@pytest.mark.parametrize("joint", [False, True])
def test_psnr_exceeds_that_of_the_gaussian_prior(buildings, joint):
    truth, frames = buildings
    plain = restore(frames, TIMING, Motion().vibration(), joint=joint)
    kept = restore(frames, TIMING, Motion().vibration(), joint=joint, prior="edges")
    assert kept.shape == plain.shape
    assert decibel(kept, truth) > decibel(plain, truth) + 0.15


@pytest.mark.parametrize(("exposure_rows", "joint"), [(100, False), (400, True)])
def test_psnr_exceeds_that_of_the_gaussian_prior_under_blur(joint, exposure_rows):
    scene = draw_scene(272, 240, seed=5)
    timing = SensorTiming(row_time=20.52e-6, exposure_rows=exposure_rows, frame_rows=2048)
    frames = torch.from_numpy(take_frames(scene, timing, Motion(), 2, 0.02)).float()
    plain, kept = (
        restore(frames, timing, Motion().vibration(), joint=joint, prior=prior) for prior in ("gaussian", "edges")
    )
    assert decibel(kept, crop(scene)) > decibel(plain, crop(scene)) + 0.2


def test_steps_have_less_overshoot_and_noise(step):
    truth, frames, timing = step
    plain, kept = (
        restore(frames[:1], timing, Motion().vibration(), prior=prior)[0].numpy() for prior in ("gaussian", "edges")
    )
    overshoots = []
    for image in (plain, kept):
        profile = image[32:-32, 32:-32].mean(1)
        overshoots.append(max(profile.max() - 0.75, 0.25 - profile.min()))
    assert overshoots[1] < overshoots[0]
    assert decibel(kept, truth) > decibel(plain, truth) + 4


def test_gradients_to_frames_and_flat_scenes():
    flat = torch.full((1, 48, 40), 0.37, dtype=torch.float64)
    kept = restore(flat, TIMING, Vibration(1.0, 50.0), prior="edges", noise=0.05)
    assert (kept - 0.37).abs().max() < 1e-9
    frames = torch.rand(1, 24, 20, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    restore(frames, TIMING, Vibration(1.0, 50.0), prior="edges", noise=0.05).square().sum().backward()
    assert torch.isfinite(frames.grad).all()
    assert frames.grad.abs().min() > 0
