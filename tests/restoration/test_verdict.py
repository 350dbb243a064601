import pytest
import torch
from truth import Motion, draw_scene, take_frames

from rsvib_torch import SensorTiming
from rsvib_torch.restoration import judge_restoration, restore

TIMING = SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)


@pytest.mark.parametrize("image_motion", [(0.0, 0.0), (700.0, -300.0)])
def test_the_right_vibration_helps_and_a_wrong_one_does_not(image_motion):
    motion = Motion(image_motion=image_motion)
    scene = draw_scene(448, 400, seed=41)
    frames = torch.from_numpy(take_frames(scene, TIMING, motion, 3, 0.005, margin=104))
    right = motion.vibration()
    verdict = judge_restoration(frames, restore(frames, TIMING, right), TIMING, right)
    assert verdict.helped.all()
    assert (verdict.after < 0.01).all()  # noise 0.005 in two frames, and little else
    wrong = Motion(motion.amplitude, motion.frequency, (motion.phase[0] + 3, motion.phase[1] + 3), image_motion)
    verdict = judge_restoration(frames, restore(frames, TIMING, wrong.vibration()), TIMING, wrong.vibration())
    assert not verdict.helped.any()


@pytest.mark.parametrize(
    ("frames", "restored", "motion", "message"),
    [
        (torch.zeros(1, 16, 16), torch.zeros(1, 16, 16), Motion(), "at least 2 frames are needed, got 1"),
        (torch.zeros(2, 16, 16), torch.zeros(1, 16, 16), Motion(), r"restored must have the shape \(2, 16, 16\)"),
        (torch.zeros(1, 2, 1, 16, 16), torch.zeros(1, 2, 1, 16, 16), Motion(), "frames must be one stack"),
        (torch.zeros(2, 16, 16), torch.zeros(2, 16, 16), Motion(image_motion=(900.0, 0.0)), "nothing in common"),
    ],
)
def test_bad_input(frames, restored, motion, message):
    with pytest.raises(ValueError, match=message):
        judge_restoration(frames, restored, TIMING, motion.vibration())
