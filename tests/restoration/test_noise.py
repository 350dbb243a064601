"""Noise levels of frames: each estimator with generated scenes of known noise, and the policy that combines them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from truth import Motion, draw_scene, recorded, take_frames

from rsvib_torch import SensorTiming
from rsvib_torch.restoration.frame_motion import frame_motion
from rsvib_torch.restoration.noise import estimate_noise, noise_levels

TIMING = SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)


def levels(frames, motion):
    rowwise = frame_motion(motion.vibration().expanded(1), TIMING, TIMING.frame_starts(len(frames)), frames.shape[-2])
    return noise_levels(torch.as_tensor(frames)[None, :, None], rowwise)[0]


@pytest.mark.parametrize("shape", [(512, 512), (300, 64), (64, 64)])
def test_white_noise_is_measured(shape):
    noise = 0.03 * torch.randn(16, *shape, generator=torch.Generator().manual_seed(0))
    assert estimate_noise(noise).square().mean().sqrt().item() == pytest.approx(0.03, rel=0.08)


@pytest.mark.parametrize("image_motion", [(0.0, 0.0), (600.0, -400.0)])
def test_two_frames_separate_texture_from_noise(image_motion):
    motion = Motion(image_motion=image_motion)
    margin = 90
    scene = draw_scene(300 + 2 * margin, 260 + 2 * margin, seed=4, blur=0.5)
    frames = take_frames(scene, TIMING, motion, 2, margin=margin)
    noise = np.random.default_rng(1).standard_normal(frames.shape) * np.array([0.004, 0.008])[:, None, None]
    alone = estimate_noise(torch.from_numpy(frames + noise))
    assert alone[0] > 1.8 * 0.004
    found = levels(frames + noise, motion)
    assert found[0].item() == pytest.approx(0.004, rel=0.3)
    assert found[1].item() == pytest.approx(0.008, rel=0.15)


@pytest.mark.parametrize("shape", [(128, 96), (512, 512)])
def test_blocks_with_ignored_pixels_are_excluded(shape):
    noise = 0.03 * torch.randn(8, *shape, generator=torch.Generator().manual_seed(0))
    hidden = torch.zeros(noise.shape, dtype=torch.bool)
    hidden[..., : shape[1] // 2] = True
    filled = noise.masked_fill(hidden, 0.5)
    assert estimate_noise(filled, hidden).square().mean().sqrt().item() == pytest.approx(0.03, rel=0.1)
    assert (estimate_noise(filled) < 0.01).all()
    assert estimate_noise(filled, torch.ones_like(hidden)).isnan().all()


def exposed(rows, count):
    """Frames (T, 1, H, W) with noise 0.01, and their motion."""
    timing = replace(TIMING, exposure_rows=rows)
    frames = recorded((256, 208), timing, Motion(), count, 0.01, seed=12)[:, None]
    return frames, frame_motion(Motion().vibration().expanded(1), timing, timing.frame_starts(count), frames.shape[-2])


@pytest.mark.parametrize(("rows", "dead"), [(20, "black"), (100, "not measured")])
def test_empty_frames_are_assigned_the_noise_of_the_others(rows, dead):
    frames, motion = exposed(rows, 3)
    whole = noise_levels(frames[None], motion)[0]
    ignore = None
    if dead == "not measured":
        ignore = torch.zeros(frames.shape, dtype=torch.bool)
        ignore[1] = True
    frames[1] = {"black": 0.0, "not measured": 0.5}[dead]
    found = noise_levels(frames[None], motion, None if ignore is None else ignore[None])[0]
    torch.testing.assert_close(found[[0, 2]], whole[[0, 2]], rtol=0.1, atol=0)
    assert found[0].item() * 0.9 < found[1].item() < found[0].item() * 1.1
    assert (noise_levels(torch.zeros_like(frames[None]), motion) == 0).all()


@pytest.mark.parametrize(("rows", "share"), [(100, 0.3), (20, 0.6)])
def test_missing_pixels_do_not_affect_the_level(rows, share):
    frames, motion = exposed(rows, 2)
    hidden = torch.zeros(frames.shape, dtype=torch.bool)
    hidden[..., : round(share * frames.shape[-1])] = True
    found = noise_levels(frames.masked_fill(hidden, 0.4)[None], motion, hidden[None])[0]
    torch.testing.assert_close(found, torch.full((2,), 0.01), rtol=0.12, atol=0)


def test_a_changed_scene_does_not_raise_the_level():
    scene = draw_scene(336, 288, seed=12)
    frames = take_frames(scene, TIMING, Motion(), 2, 0.005)
    frames[1] = frames[1][::-1]
    found = levels(frames, Motion())
    assert found.max().item() == pytest.approx(0.005, rel=0.1)


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("case", ["constant", "tiny", "all missing"])
def test_frames_without_content_have_no_noise(count, case):
    frames = {"constant": torch.full((count, 1, 160, 160), 0.3), "tiny": torch.rand(count, 1, 5, 3)}.get(
        case, torch.rand(count, 1, 160, 160)
    )
    ignore = torch.ones(frames.shape, dtype=torch.bool) if case == "all missing" else None
    starts = TIMING.frame_starts(count)
    motion = frame_motion(Motion().vibration().expanded(1), TIMING.in_row_order(), starts, frames.shape[-2])
    before = frames.clone()
    found = noise_levels(frames[None], motion, None if ignore is None else ignore[None])
    assert found.shape == (1, count)
    assert (found >= 0).all() if case == "tiny" else (found == 0).all()
    assert torch.equal(frames, before)
