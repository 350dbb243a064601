import numpy as np
import pytest
import torch
from truth import Motion, draw_scene, take_frames

from rsvib_torch import SensorTiming
from rsvib_torch.restoration.frame_motion import frame_motion
from rsvib_torch.restoration.noise.noise_levels import noise_levels
from rsvib_torch.restoration.noise.single_frame import estimate_noise
from rsvib_torch.restoration.scene_model.row_kernel import (
    interpolation_error,
    kernel_spectrum,
    kernel_weights,
    scene_weights,
)

TIMING = SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)


def levels(frames, motion):
    rowwise = frame_motion(motion.vibration().expanded(1), TIMING, len(frames), frames.shape[-2])
    return noise_levels(torch.as_tensor(frames)[:, None], rowwise, 0)


@pytest.mark.parametrize("shape", [(512, 512), (300, 64), (64, 64), (1300, 1500)])
def test_white_noise_is_measured(shape):
    noise = 0.03 * torch.randn(16, *shape, generator=torch.Generator().manual_seed(0))
    assert estimate_noise(noise).square().mean().sqrt().item() == pytest.approx(0.03, rel=0.08)


@pytest.mark.parametrize("quiet", [slice(None, 1000), slice(500, 1500), slice(-1000, None)])
def test_quiet_parts_of_large_images_are_found_wherever_they_are(quiet):
    generator = torch.Generator().manual_seed(3)
    image = 0.2 * torch.rand(2000, 1400, generator=generator)
    image[quiet] = 0.01 * torch.randn(1000, 1400, generator=generator)
    assert estimate_noise(image).item() == pytest.approx(0.01, rel=0.12)


@pytest.mark.parametrize("image_motion", [(0.0, 0.0), (600.0, -400.0)])
def test_two_frames_tell_texture_from_noise(image_motion):
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
    single = frames[:1] + noise[:1]
    assert 0.33 * alone[0].item() <= levels(single, motion)[0].item() < 0.75 * alone[0].item()


@pytest.mark.parametrize("shape", [(128, 96), (512, 512)])
def test_blocks_with_ignored_pixels_do_not_count(shape):
    noise = 0.03 * torch.randn(8, *shape, generator=torch.Generator().manual_seed(0))
    hidden = torch.zeros(noise.shape, dtype=torch.bool)
    hidden[..., : shape[1] // 2] = True
    filled = noise.masked_fill(hidden, 0.5)
    assert estimate_noise(filled, hidden).square().mean().sqrt().item() == pytest.approx(0.03, rel=0.1)
    assert (estimate_noise(filled) < 0.01).all()
    assert estimate_noise(filled, torch.ones_like(hidden)).isnan().all()


@pytest.mark.parametrize("rows", [20, 100])
@pytest.mark.parametrize("dead", ["black", "constant", "not measured"])
def test_frames_that_show_nothing_have_as_much_noise_as_the_others(rows, dead):
    timing = SensorTiming(row_time=20.52e-6, exposure_rows=rows, frame_rows=2048)
    frames = torch.from_numpy(take_frames(draw_scene(336, 288, seed=12), timing, Motion(), 3, 0.01)).float()[:, None]
    motion = frame_motion(Motion().vibration().expanded(1), timing, 3, frames.shape[-2])
    whole = noise_levels(frames, motion, 0)
    ignore = None
    if dead == "not measured":
        ignore = torch.zeros(frames.shape, dtype=torch.bool)
        ignore[1] = True
    frames[1] = {"black": 0.0, "constant": 0.3, "not measured": 0.5}[dead]
    found = noise_levels(frames, motion, 0, ignore)
    torch.testing.assert_close(found[[0, 2]], whole[[0, 2]], rtol=0.1, atol=0)
    assert found[0].item() * 0.9 < found[1].item() < found[0].item() * 1.1
    assert (noise_levels(torch.zeros_like(frames), motion, 0) == 0).all()


@pytest.mark.parametrize("rows", [20, 100])
@pytest.mark.parametrize("share", [0.05, 0.3, 0.6])
def test_what_was_not_measured_says_nothing(rows, share):
    timing = SensorTiming(row_time=20.52e-6, exposure_rows=rows, frame_rows=2048)
    frames = torch.from_numpy(take_frames(draw_scene(336, 288, seed=12), timing, Motion(), 2, 0.01)).float()[:, None]
    motion = frame_motion(Motion().vibration().expanded(1), timing, 2, frames.shape[-2])
    hidden = torch.zeros(frames.shape, dtype=torch.bool)
    hidden[..., : round(share * frames.shape[-1])] = True
    found = noise_levels(frames.masked_fill(hidden, 0.4), motion, 0, hidden)
    torch.testing.assert_close(found, torch.full((2,), 0.01), rtol=0.12, atol=0)


def test_a_changed_scene_is_not_taken_for_more_noise_than_a_frame_has():
    scene = draw_scene(336, 288, seed=12)
    frames = take_frames(scene, TIMING, Motion(), 2, 0.005)
    frames[1] = frames[1][::-1]
    found = levels(frames, Motion())
    assert found.max().item() == pytest.approx(0.005, rel=0.1)


def test_kernel_between_rows():
    weights = kernel_weights(torch.linspace(0, 1, 21, dtype=torch.float64))
    assert (weights.sum(-1) - 1).abs().max() < 6e-4
    frequencies = torch.tensor([0.05, 0.2, 0.35], dtype=torch.float64)
    rows = np.arange(-40, 41)
    for frequency, response, alias in zip(
        frequencies, kernel_spectrum(frequencies), interpolation_error(frequencies), strict=True
    ):
        wave = np.exp(2j * np.pi * frequency.item() * rows)
        fractions = (np.arange(400) + 0.5) / 400
        taps = kernel_weights(torch.from_numpy(fractions)).numpy()
        seen = taps @ wave[38:44] * np.exp(-2j * np.pi * frequency.item() * fractions)
        assert abs(seen - seen.mean()).std() ** 2 <= alias.item() * 1.01 + 1e-12
        assert (abs(seen - seen.mean()) ** 2).mean() == pytest.approx(alias.item(), rel=0.02)
        assert seen.mean() == pytest.approx(response.item(), abs=1e-5)
        # a row of the scene is what the rows between which it lies see on average
        assert np.array(scene_weights()) @ wave[35:46] == pytest.approx(response.item(), rel=4e-3)
