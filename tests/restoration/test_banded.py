import pytest
import torch
from truth import Motion, crop, decibel, draw_scene, take_frames

from rsvib_torch import SensorTiming, Vibration
from rsvib_torch.restoration import VibrationRestorer, restore, visible_pixels

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


def test_blur_of_long_exposures_is_removed(short):
    timing = SensorTiming(row_time=20.52e-6, exposure_rows=200, frame_rows=2048)
    motion = Motion(amplitude=(3.0, 3.0), frequency=(60.0, 60.0))
    scene = draw_scene(512, 256, seed=21)
    frames = take_frames(scene, timing, motion, 1, 0.002)
    middle = timing.row_starts(1, frames.shape[1])
    moved = torch.from_numpy(motion.displacement((middle + timing.exposure_time / 2).numpy()))
    sharpened = decibel(restore(as_tensor(frames), timing, motion.vibration(), method="banded")[0], crop(scene))
    # the same geometry with an exposure without blur
    instant = SensorTiming(row_time=20.52e-6, exposure_rows=1, frame_rows=2048)
    vibration = motion.vibration()
    shrunk = vibration.amplitude * torch.sinc(vibration.frequency * timing.exposure_time)
    late = vibration.phase + 2 * torch.pi * vibration.frequency * (timing.exposure_time - instant.exposure_time) / 2
    geometry = restore(as_tensor(frames), instant, Vibration(shrunk, vibration.frequency, late), method="banded")
    assert moved.abs().max() > 1.0
    assert sharpened > decibel(geometry[0], crop(scene)) + 4


def test_linear_interpolation_of_the_paper_blurs(short):
    truth, frames, motion = short
    linear, cubic = (
        decibel(restore(as_tensor(frames), TIMING, motion.vibration(), method="banded", interpolation=name), truth)
        for name in ("linear", "cubic")
    )
    assert decibel(frames, truth) + 12 < linear < cubic - 1


def test_flux_is_conserved(short):
    _, _, motion = short
    flat = restore(torch.full((2, 96, 80), 0.37, dtype=torch.float64), TIMING, motion.vibration(), method="banded")
    assert (flat - 0.37).abs().max() < 1e-12
    lamp = torch.full((1, 96, 96), 0.2, dtype=torch.float64)
    lamp[0, 40:50, 45:52] = torch.rand(10, 7, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    blurred = restore(lamp, TIMING, Vibration.still(), method="banded", noise_to_signal=0.1)
    assert blurred.sum().item() == pytest.approx(lamp.sum().item(), rel=1e-9)
    assert (blurred - lamp).abs().max() > 0.05


def test_boundaries_are_not_periodic():
    frames = torch.full((1, 128, 96), 0.2)
    frames[:, :, :12] = 1.0
    frames[:, :12] = 1.0
    restored = restore(frames, TIMING, Vibration([3.1, 5.2], [50.0, 30.0], [0.5, 1.0]), method="banded")
    assert (restored[:, 40:, -16:] - 0.2).abs().max() < 1e-3
    assert (restored[:, -16:, 40:] - 0.2).abs().max() < 1e-3
    assert restored.amax() > 0.8


def test_float32_agrees_with_float64_and_dtypes_are_kept(short):
    _, frames, motion = short
    exact = restore(as_tensor(frames, torch.float64), TIMING, motion.vibration(), method="banded")
    single = restore(as_tensor(frames), TIMING, motion.vibration(), method="banded")
    assert (exact.dtype, single.dtype) == (torch.float64, torch.float32)
    assert (exact - single).abs().max() < 2e-5
    counts = (as_tensor(frames).clamp(0, 1) * 4095).round().to(torch.int32)
    module = VibrationRestorer(TIMING, method="banded", full_scale=4095)
    assert (module(counts, motion.vibration()) - single).abs().mean() < 3e-4
    assert restore(as_tensor(frames, torch.float16), TIMING, motion.vibration(), method="banded").dtype == torch.float16


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
