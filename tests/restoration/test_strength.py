"""Regularisation from the data, against the best of several weights by hand."""

from functools import partial

import numpy as np
import pytest
import torch
from scipy import ndimage
from truth import Motion, crop, decibel, draw_scene, take_frames

from rsvib_torch import SensorTiming
from rsvib_torch.restoration import exact
from rsvib_torch.restoration import restore as restore_by_any_method
from rsvib_torch.restoration.motion import frame_motion
from rsvib_torch.restoration.prior import fit_prior

restore = partial(restore_by_any_method, method="exact", check=False)
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


@pytest.fixture
def without_choice(monkeypatch):
    """Restores with the prior as strong as the noise asks for, times a factor."""

    def run(frames, timing, **options):
        with monkeypatch.context() as patch:
            patch.setattr(exact, "prior_strength", lambda *arguments, **named: 1.0)
            return restore(frames, timing, MOTION.vibration(), **options)

    return run


@pytest.mark.parametrize(
    ("name", "rows", "noise", "given", "joint", "least", "within"),
    [
        ("buildings", 20, 0.02, 2, False, -0.1, 0.3),
        ("buildings", 100, 0.001, 2, True, -0.1, 0.3),
        ("soft", 20, 0.005, 2, True, 0.2, 0.3),
        ("soft", 100, 0.05, 2, True, 1.0, 0.3),
        ("dense texture", 100, 0.001, 2, False, -0.1, 0.3),
        ("dense texture", 100, 0.001, 1, False, 1.5, 1.0),  # in one frame alone texture passes for noise
        ("dense texture", 20, 0.001, 2, True, -0.1, 0.3),
    ],
)
def test_weight_from_the_data_is_near_the_best_by_hand(without_choice, name, rows, noise, given, joint, least, within):
    timing = SensorTiming(row_time=20.52e-6, exposure_rows=rows, frame_rows=2048)
    scene = SCENES[name]()
    clean = take_frames(scene, timing, MOTION, 2, samples=64)
    frames = torch.from_numpy(clean + noise * np.random.default_rng(3).standard_normal(clean.shape)).float()[:given]
    found = decibel(restore(frames, timing, MOTION.vibration(), joint=joint)[0], crop(scene))
    by_hand = {
        factor: decibel(without_choice(frames, timing, joint=joint, regularisation=factor)[0], crop(scene))
        for factor in (0.03, 0.1, 0.3, 1.0, 3.0)
    }
    assert found > max(by_hand.values()) - within
    assert found > by_hand[1.0] + least
    assert max(by_hand.values()) - min(by_hand.values()) > 0.5


def test_each_frame_is_blind_to_what_its_own_blur_leaves():
    timing = SensorTiming(row_time=20.52e-6, exposure_rows=200, frame_rows=2048)
    frames = torch.from_numpy(take_frames(texture(0.7), timing, MOTION, 2, 0.001, samples=100)).float()[:, None]
    height = frames.shape[-2]
    motion = frame_motion(MOTION.vibration().expanded(1), timing, 2, height)
    prior = fit_prior(frames, motion, 0, torch.full((2,), 0.001), 256)
    assert prior.blind.shape == (2, 129)
    times = (2048 * np.arange(2)[:, None, None] + np.arange(height)[:, None] + np.arange(0, 200, 5)) * timing.row_time
    across = MOTION.displacement(times)[..., 1]
    path = (across.max(-1) - across.min(-1)).mean(-1)  # px that rows are blurred over, in each frame
    assert path[0] < 0.8 * path[1]
    assert prior.blind[0].mean() > 3 * prior.blind[1].mean()
    torch.testing.assert_close(prior.of([0, 1]).blind, prior.blind.mean(0))
    torch.testing.assert_close(prior.of([1]).blind, prior.blind[1])


@pytest.mark.parametrize(
    ("name", "rows", "noise", "choices"), [("buildings", 20, 0.005, 1), ("dense texture", 100, 0.001, 2)]
)
def test_frames_that_are_alike_share_a_choice(monkeypatch, name, rows, noise, choices):
    timing = SensorTiming(row_time=20.52e-6, exposure_rows=rows, frame_rows=2048)
    clean = take_frames(SCENES[name](), timing, MOTION, 2, samples=48)
    frames = torch.from_numpy(clean + noise * np.random.default_rng(3).standard_normal(clean.shape)).float()
    made = []
    choose = exact.prior_strength
    monkeypatch.setattr(
        exact, "prior_strength", lambda *arguments, **named: made.append(choose(*arguments, **named)) or made[-1]
    )
    restore(frames, timing, MOTION.vibration())
    assert len(made) == choices
    restore(frames, timing, MOTION.vibration(), joint=True)
    assert len(made) == choices + 1
