"""Strength of the prior estimated from the data, compared with the best of several strengths."""

from functools import partial

import numpy as np
import pytest
import torch
from exact_steps import model_of, solved
from scipy import ndimage
from truth import Motion, crop, decibel, draw_scene, take_frames

from rsvib_torch import SensorTiming
from rsvib_torch.restoration import restore as restore_by_any_method
from rsvib_torch.restoration.frame_motion import frame_motion
from rsvib_torch.restoration.scene_model.scene_prior import fit_prior

restore = partial(restore_by_any_method, method="exact", check=False)
TIMING = SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)
MOTION = Motion()
SIZE = 300


def texture(blur):
    noise = ndimage.gaussian_filter(np.random.default_rng(1).standard_normal((SIZE, SIZE)), blur, mode="wrap")
    return np.clip(0.5 + 0.15 * noise / noise.std(), 0, 1)


SCENES = {
    "buildings": partial(draw_scene, SIZE, SIZE, 14),
    "soft": partial(draw_scene, SIZE, SIZE, 5, blur=2.5),
    "dense texture": partial(texture, 0.7),
}


@pytest.mark.parametrize(
    ("name", "rows", "noise", "given", "joint", "least", "within"),
    [
        ("buildings", 20, 0.02, 2, False, -0.1, 0.3),
        ("soft", 100, 0.05, 2, True, 1.0, 0.3),
        ("dense texture", 100, 0.001, 1, False, -0.1, 0.5),
        ("dense texture", 20, 0.001, 2, True, -0.1, 0.3),
    ],
)
def test_estimated_strength_is_close_to_the_best(name, rows, noise, given, joint, least, within):
    timing = SensorTiming(row_time=20.52e-6, exposure_rows=rows, frame_rows=2048)
    scene = SCENES[name]()
    clean = take_frames(scene, timing, MOTION, 2)
    frames = torch.from_numpy(clean + noise * np.random.default_rng(3).standard_normal(clean.shape)).float()[:given]
    found = decibel(restore(frames, timing, MOTION.vibration(), joint=joint)[0], crop(scene))
    stack = model_of(frames, timing, MOTION.vibration())
    by_hand = {
        factor: decibel(solved(stack, joint=joint, regularisation=factor)[0], crop(scene))
        for factor in (0.03, 0.1, 0.3, 1.0, 3.0)
    }
    assert found > max(by_hand.values()) - within
    assert found > by_hand[1.0] + least
    assert max(by_hand.values()) - min(by_hand.values()) > 0.5


@pytest.mark.parametrize("count", [1, 2])
def test_power_of_pure_noise_is_close_to_zero(count):
    noise = torch.randn(count, 1, 512, 512, generator=torch.Generator().manual_seed(0))
    motion = frame_motion(MOTION.vibration().expanded(1), TIMING, count, 512)
    prior = fit_prior((0.5 + 0.02 * noise)[None], motion, torch.full((1, count), 0.02), 576)
    assert prior.power.mean() < 0.08 * 0.02**2
    assert fit_prior((0.5 + 0.04 * noise)[None], motion, torch.full((1, count), 0.02), 576).power.mean() > 2 * 0.02**2


@pytest.mark.parametrize(("across", "along", "joint"), [(0.2, 0.05, True), (0.02, 0.1, False)])
def test_regular_patterns_are_restored_up_to_the_boundaries(across, along, joint):
    rows, columns = np.mgrid[:336, :400]
    scene = 0.5 + 0.4 * np.sin(2 * np.pi * (across * rows + along * columns))
    motion = Motion(amplitude=(0.0, 2.0))  # all columns are visible at the ends of the rows
    frames = torch.from_numpy(take_frames(scene, TIMING, motion, 2, 0.005)).float()
    ends = np.r_[:16, 304:320]
    truth = crop(scene)[32:-32][:, ends]

    def quality(**options):
        restored = restore_by_any_method(frames, TIMING, motion.vibration(), check=False, joint=joint, **options)
        return -10 * np.log10(np.mean((restored[0].numpy()[32:-32][:, ends] - truth) ** 2))

    assert quality() > 41
    assert quality(regularisation=1e4) < 35
