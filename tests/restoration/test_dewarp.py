from functools import partial

import numpy as np
import pytest
import torch
from truth import Motion, crop, decibel, draw_scene, take_frames

from rsvib_torch import SensorTiming, Vibration
from rsvib_torch.restoration import restore, visible_pixels

dewarp = partial(restore, method="dewarp")
TIMING = SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)


@pytest.fixture(scope="module")
def short():
    motion = Motion()
    scene = draw_scene(336, 288, seed=14, blur=1.0)
    frames = torch.from_numpy(take_frames(scene, TIMING, motion, 2))
    return crop(scene), frames, motion


def test_distortion_is_removed(short):
    truth, frames, motion = short
    for frame, restored in zip(frames, dewarp(frames, TIMING, motion.vibration()), strict=True):
        assert decibel(restored, truth) > decibel(frame, truth) + 25
    half = dewarp(frames, TIMING, motion.scaled(0.5).vibration())
    assert decibel(half, truth) < decibel(frames, truth) + 12


def test_sinusoids_are_interpolated_exactly():
    timing = SensorTiming(row_time=20.52e-6, exposure_rows=1, frame_rows=2048)
    motion = Motion(phase=(0.2, 2.0))
    rows, columns = np.arange(300.0)[:, None], np.arange(200.0)
    x, y = motion.displacement((rows[:, 0] + 0.5) * timing.row_time).T

    def scene(r, c):
        return np.sin(0.5 * r + 0.3 * c) + np.sin(0.9 * r - 0.7 * c)

    frame = torch.from_numpy(scene(rows - y[:, None], columns - x[:, None]))
    restored = dewarp(frame[None], timing, motion.vibration())[0].numpy()
    assert abs(restored - scene(rows, columns))[16:-16, 24:-24].max() < 2e-3
    assert abs(frame.numpy() - scene(rows, columns))[16:-16, 24:-24].max() > 1


def test_blur_of_long_exposures_is_not_removed():
    timing = SensorTiming(row_time=20.52e-6, exposure_rows=400, frame_rows=2048)
    motion = Motion()
    scene = draw_scene(336, 288, seed=15)
    frames = torch.from_numpy(take_frames(scene, timing, motion, 1, 0.005, samples=48))
    exact = decibel(restore(frames, timing, motion.vibration(), method="exact"), crop(scene))
    assert exact > decibel(dewarp(frames, timing, motion.vibration()), crop(scene)) + 4


def test_push_scan_batches_chunks_and_orientation(short):
    _, frames, _ = short
    motion = Motion(amplitude=(1.5, 2.0), image_motion=(900.0, -400.0))
    stacks = torch.stack([frames, frames.flip(-1)])[:, :, None]
    together = dewarp(stacks, TIMING, motion.vibration())
    single = dewarp(frames, TIMING, motion.vibration(), chunk_rows=13)
    torch.testing.assert_close(together[0, :, 0], single, rtol=0, atol=1e-10)
    mask, _ = visible_pixels(TIMING, motion.vibration(), (256, 208), 2)
    assert 0.7 < mask.double().mean() < 1.0
    turned = SensorTiming(20.52e-6, 20, 2048, scan_axis="x", readout_direction="reverse")
    swapped = Vibration(
        motion.amplitude[::-1],
        motion.frequency[::-1],
        [motion.phase[1] + torch.pi, motion.phase[0]],
        [-motion.image_motion[1], motion.image_motion[0]],
    )
    restored = dewarp(frames.flip(-2).transpose(-2, -1), turned, swapped)
    torch.testing.assert_close(restored.transpose(-2, -1).flip(-2), single, rtol=0, atol=1e-9)


def test_bad_input():
    with pytest.raises(ValueError, match="chunk_rows must be at least 1"):
        dewarp(torch.zeros(1, 16, 16), TIMING, Vibration(1.0, 50.0), chunk_rows=0)
    with pytest.raises(TypeError, match="method='dewarp' has no option 'noise'"):
        dewarp(torch.zeros(1, 16, 16), TIMING, Vibration(1.0, 50.0), noise=0.1)


def test_gradients_to_frames_and_vibration():
    timing = SensorTiming(row_time=1e-3, exposure_rows=2, frame_rows=8)
    frames = torch.rand(1, 6, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def run(images, amplitude, frequency, phase, image_motion):
        return dewarp(images, timing, Vibration(amplitude, frequency, phase, image_motion))

    vibration = Vibration([0.8, 0.6], [20.0, 30.0], [0.3, 1.0], [3.0, -2.0])
    inputs = (frames, vibration.amplitude, vibration.frequency, vibration.phase, vibration.image_motion)
    assert torch.autograd.gradcheck(run, tuple(value.clone().requires_grad_() for value in inputs))
