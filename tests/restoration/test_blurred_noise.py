"""Noise beneath dense texture, told by the blur of an independent camera."""

import numpy as np
import pytest
import torch
from scipy import ndimage
from truth import Motion, draw_scene, take_frames

from rsvib_torch import SensorTiming
from rsvib_torch.restoration.frame_motion import frame_motion
from rsvib_torch.restoration.noise.blurred_noise import noise_beside_blur
from rsvib_torch.restoration.noise.single_frame import estimate_noise

MOTION = Motion()


def texture(size, blur, seed=1):
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).standard_normal((size, size)), blur, mode="wrap")
    return np.clip(0.5 + 0.05 * noise / noise.std(), 0, 1)


def taken(scene, rows, noise, count=1, motion=MOTION):
    timing = SensorTiming(row_time=20.52e-6, exposure_rows=rows, frame_rows=2048)
    clean = take_frames(scene, timing, motion, count, samples=24)
    frames = clean + noise * np.random.default_rng(3).standard_normal(clean.shape)
    moved = frame_motion(motion.vibration().expanded(1), timing, count, frames.shape[-2])
    return torch.from_numpy(frames).float()[:, None], moved


@pytest.mark.parametrize(
    ("rows", "noise", "texture_adds"),
    [(400, 0.001, 2.0), (400, 0.002, 1.4), (100, 0.005, 1.25), (100, 0.02, 1.03), (400, 0.02, 1.02)],
)
def test_dense_texture_is_no_noise_where_the_scene_is_blurred(rows, noise, texture_adds):
    frames, motion = taken(texture(420, 0.7), rows, noise)
    assert estimate_noise(frames[0])[0] > texture_adds * noise
    assert noise_beside_blur(frames, motion, 0)[0].sqrt().item() == pytest.approx(noise, rel=0.12)


def test_edges_and_flat_ground():
    frames, motion = taken(draw_scene(420, 420, 14), 100, 0.005)
    assert noise_beside_blur(frames, motion, 0)[0].sqrt().item() == pytest.approx(0.005, rel=0.1)


def test_each_frame_has_its_own_noise_and_its_own_blur():
    frames, motion = taken(texture(420, 0.7), 400, 0.0, 2)
    levels = torch.tensor([0.002, 0.006])
    noise = torch.randn(frames.shape, generator=torch.Generator().manual_seed(0))
    frames = frames + levels[:, None, None, None] * noise
    found = noise_beside_blur(frames, motion, 0).sqrt().float()
    torch.testing.assert_close(found, levels, rtol=0.12, atol=0)
    wrong = noise_beside_blur(frames.flip(0), motion, 0).sqrt().float().flip(0)
    assert (wrong / levels - 1).abs().max() > 0.5


def test_channels_count_alike():
    (one, motion), (two, _) = (taken(texture(420, 0.7, seed), 400, 0.003) for seed in (1, 2))
    colour = torch.cat([one, two], dim=1)
    assert noise_beside_blur(colour, motion, 0).sqrt().item() == pytest.approx(0.003, rel=0.1)
    torch.testing.assert_close(noise_beside_blur(3 * one, motion, 0), 9 * noise_beside_blur(one, motion, 0))


@pytest.mark.parametrize(("rows", "size"), [(20, 420), (100, 180)])
def test_says_nothing_without_blur_or_in_small_frames(rows, size):
    frames, motion = taken(texture(size, 0.7), rows, 0.004)
    assert noise_beside_blur(frames, motion, 0) is None
