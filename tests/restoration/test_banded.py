import torch
from truth import Motion, crop, decibel, draw_scene, take_frames

from rsvib_torch import SensorTiming, Vibration
from rsvib_torch.restoration import restore

TIMING = SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)
NOISE = 0.003


def restored_by(frames, motion, **options):
    return restore(torch.from_numpy(frames).float(), TIMING, motion.vibration(), method="banded", **options)


def test_gain_exceeds_12_db_in_both_frames_of_the_paper_camera():
    motion = Motion(phase=(90.9, 30.3))
    scene = draw_scene(2048, 336, 101)
    frames = take_frames(scene, TIMING, motion, 2, NOISE, seed=101)
    truth = crop(scene)
    restored, halfway = (restored_by(frames, used).numpy() for used in (motion, motion.scaled(0.5)))
    for frame, good, half in zip(frames, restored, halfway, strict=True):
        before = decibel(frame, truth)
        assert decibel(good, truth) > before + 20
        assert decibel(half, truth) < before + 12
    assert decibel(restored[0], truth) > 48.5  # a still camera has 50.5


def test_linear_interpolation_of_the_paper_blurs():
    scene = draw_scene(256, 192, seed=11)
    truth, frames = crop(scene), take_frames(scene, TIMING, Motion(), 2, NOISE)
    linear, cubic = (decibel(restored_by(frames, Motion(), interpolation=name), truth) for name in ("linear", "cubic"))
    assert decibel(frames, truth) + 12 < linear < cubic - 1


def test_boundaries_are_not_periodic():
    frames = torch.full((1, 128, 96), 0.2)
    frames[:, :, :12] = 1.0
    frames[:, :12] = 1.0
    restored = restore(frames, TIMING, Vibration([3.1, 5.2], [50.0, 30.0], [0.5, 1.0]), method="banded")
    assert (restored[:, 40:, -16:] - 0.2).abs().max() < 1e-3
    assert (restored[:, -16:, 40:] - 0.2).abs().max() < 1e-3
    assert restored.amax() > 0.8
