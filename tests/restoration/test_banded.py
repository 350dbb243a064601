import pytest
import torch
from truth import Motion, crop, decibel, draw_scene, take_frames

from rsvib_torch import SensorTiming, Vibration
from rsvib_torch.restoration import restore, visible_pixels

TIMING = SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)
NOISE = 0.003


def as_tensor(array, dtype=torch.float32):
    return torch.from_numpy(array).to(dtype)


@pytest.fixture(scope="module")
def short():
    """A short stack for tests of invariances: scene, frames and motion."""
    motion = Motion()
    scene = draw_scene(256, 192, seed=11)
    return crop(scene), take_frames(scene, TIMING, motion, 2, NOISE), motion


def test_gain_exceeds_12_db_in_both_frames_of_the_paper_camera():
    motion = Motion(phase=(90.9, 30.3))
    scene = draw_scene(2048, 336, 101)
    frames = take_frames(scene, TIMING, motion, 2, NOISE, seed=101)
    truth = crop(scene)
    restored = restore(as_tensor(frames), TIMING, motion.vibration(), method="banded").numpy()
    halfway = restore(as_tensor(frames), TIMING, motion.scaled(0.5).vibration(), method="banded").numpy()
    for frame, good, half in zip(frames, restored, halfway, strict=True):
        before = decibel(frame, truth)
        assert decibel(good, truth) > before + 20
        assert decibel(half, truth) < before + 12
    assert decibel(restored[0], truth) > 48.5  # a still camera has 50.5


def test_linear_interpolation_of_the_paper_blurs(short):
    truth, frames, motion = short
    linear, cubic = (
        decibel(restore(as_tensor(frames), TIMING, motion.vibration(), method="banded", interpolation=name), truth)
        for name in ("linear", "cubic")
    )
    assert decibel(frames, truth) + 12 < linear < cubic - 1


def test_boundaries_are_not_periodic():
    frames = torch.full((1, 128, 96), 0.2)
    frames[:, :, :12] = 1.0
    frames[:, :12] = 1.0
    restored = restore(frames, TIMING, Vibration([3.1, 5.2], [50.0, 30.0], [0.5, 1.0]), method="banded")
    assert (restored[:, 40:, -16:] - 0.2).abs().max() < 1e-3
    assert (restored[:, -16:, 40:] - 0.2).abs().max() < 1e-3
    assert restored.amax() > 0.8


def test_push_scan_frames_are_restored_in_their_own_coordinates():
    motion = Motion(amplitude=(1.5, 2.0), image_motion=(900.0, 400.0))  # 38 and 17 px from frame to frame
    margin = 160
    scene = draw_scene(160 + 2 * margin, 160 + 2 * margin, seed=31)
    frames = take_frames(scene, TIMING, motion, 3, NOISE, margin=margin)
    restored = restore(as_tensor(frames), TIMING, motion.vibration(), method="banded")
    mask, shift = visible_pixels(TIMING, motion.vibration(), (160, 160), 3)
    assert shift[2].abs().min() > 30
    for frame, good, seen, (x, y) in zip(frames, restored, mask, shift.to(int).tolist(), strict=True):
        truth = scene[margin - y : margin - y + 160, margin - x : margin - x + 160]
        assert decibel(good, truth, 16) > max(decibel(frame, truth, 16) + 12, 46)
        error = (good.numpy() - truth)[seen.numpy()]
        assert (error**2).mean() ** 0.5 < 0.012
