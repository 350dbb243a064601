"""Empty frames and missing pixels do not affect other frames or the verdict on a restoration."""

from functools import partial

import numpy as np
import pytest
import torch
from refusals import without_warning
from truth import Motion, crop, decibel, draw_scene, take_frames

from rsvib_torch import SensorTiming, Vibration, detect_vibration
from rsvib_torch.frames.prepare import prepare_frames
from rsvib_torch.restoration import RestorationWarning, judge_restoration, restore
from rsvib_torch.results.reason import Reason

SCENE, MOTION, NOISE = draw_scene(272, 240, seed=12), Motion(), 0.01
quietly = partial(restore, check=False)


def camera(rows=20):
    return SensorTiming(row_time=20.52e-6, exposure_rows=rows, frame_rows=2048)


def noisy_frames(count=3, rows=20):
    clean = take_frames(SCENE, camera(rows), MOTION, count)
    return torch.from_numpy(clean + NOISE * np.random.default_rng(1).standard_normal(clean.shape)).float()


@pytest.mark.parametrize("method", ["exact", "banded", "dewarp", "richardson-lucy"])
def test_constant_frame_does_not_affect_the_others(method):
    rows, constant = (20, float("nan")) if method in ("banded", "dewarp") else (200, 0.3)
    frames = noisy_frames(rows=rows)
    whole = quietly(frames, camera(rows), MOTION.vibration(), method=method)
    frames[1] = constant
    found = quietly(frames, camera(rows), MOTION.vibration(), method=method)
    assert torch.isfinite(found).all()
    for frame in (0, 2):
        assert decibel(found[frame], crop(SCENE)) > decibel(whole[frame], crop(SCENE)) - 0.4


def test_rows_that_were_lost_count_as_missing():
    """60 black rows in one of four frames: the motion is measured, and all that was recorded is restored."""
    scene, motion = draw_scene(400, 240, seed=31), Motion((1.6, 1.3), (71.0, 47.0), (0.4, 1.3))
    timing = SensorTiming(row_time=5e-5, exposure_rows=20, frame_rows=390)
    frames = torch.from_numpy(take_frames(scene, timing, motion, 4, 0.004)).float()
    frames[2, 100:160] = 0.0
    detection = detect_vibration(frames, timing)
    assert detection.reliable.all()
    with pytest.warns(RestorationWarning, match=r"one value in frame 2 \(60 in all\)"):
        restored = restore(frames, timing, detection)
    recorded = np.r_[0:90, 170 : frames.shape[1]]
    for frame, rows in ((0, slice(None)), (1, slice(None)), (2, recorded), (3, slice(None))):
        before, after = (decibel(images[frame][rows], crop(scene)[rows]) for images in (frames, restored))
        assert after > before + 15


def test_rows_without_detail_in_all_frames_are_measured():
    """Letterbox bars, a black sky with a hot pixel, and a frame that is dark as a whole: no row was lost."""
    frames = noisy_frames()
    frames[:, :30] = 0.0
    frames[0, 10, 50] = 0.1
    frames[1] = 0.0
    assert prepare_frames(frames, camera()).missing is None


def test_rows_of_one_value_that_the_scene_has_were_not_lost():
    """A saturated sky, a clipped road and the black sky between stars move from frame to frame."""
    moved, lines = Motion((1.6, 4.0), (71.0, 97.0), (0.4, 2.0)), np.arange(SCENE.shape[0])[:, None]
    stars = np.where(np.random.default_rng(2).random(SCENE.shape) > 0.998, 1.0, -0.1)
    for scene in (
        np.where(lines < 110, 1.3, SCENE),
        np.where(abs(lines - 140) < 8, -0.3, SCENE),
        stars,
    ):
        frames = torch.from_numpy(take_frames(scene, camera(), moved, 5)).clamp(0, 1)
        assert int((frames.amax(-1) == frames.amin(-1)).sum(-1).unique().numel()) > 1
        assert prepare_frames(frames, camera()).lost is None


def test_frame_without_data_does_not_affect_joint_restoration():
    frames = noisy_frames()
    pair = quietly(frames[[0, 1]], camera(), MOTION.vibration(), joint=True)
    frames[2] = float("nan")
    found = quietly(frames, camera(), MOTION.vibration(), joint=True)
    assert decibel(found, crop(SCENE)) > decibel(pair, crop(SCENE)) - 0.3


@pytest.mark.parametrize(("value", "rows", "count"), [(0.0, 20, 1), (0.3, 200, 2)])
def test_constant_frames_are_unchanged_without_a_warning(value, rows, count):
    frames = torch.full((count, 160, 140), value)
    found = without_warning(restore, frames, camera(rows), MOTION.vibration())
    torch.testing.assert_close(found, frames, rtol=0, atol=1e-5)
    if count == 2:
        verdict = judge_restoration(frames, found, camera(rows), MOTION.vibration())
        assert verdict.overall == "unknown"
        assert "the frames have no contrast" in verdict.sentence


@pytest.mark.parametrize("shape", [(2, 300, 3), (2, 1, 60), (2, 60, 1), (1, 5, 2)])
@pytest.mark.parametrize("method", ["exact", "banded", "dewarp", "richardson-lucy"])
def test_narrow_frames(shape, method):
    frames = torch.rand(shape, generator=torch.Generator().manual_seed(0))
    assert torch.isfinite(quietly(frames, camera(), Vibration([0.4, 0.3], [50.0, 30.0]), method=method)).all()


@pytest.mark.parametrize(("count", "columns"), [(2, 15), (4, 5)])
def test_missing_columns_cause_no_warning(columns, count):
    frames = noisy_frames(count)[:, :128, :128]
    frames[..., 60 : 60 + columns] = float("nan")
    found = without_warning(restore, frames, camera(), MOTION.vibration())
    assert judge_restoration(frames, found, camera(), MOTION.vibration()).overall == "helps"
    late = Motion(MOTION.amplitude, MOTION.frequency, (MOTION.phase[0] + 3, MOTION.phase[1] + 3)).vibration()
    wrong = quietly(frames, camera(), late)
    assert judge_restoration(frames, wrong, camera(), late).overall == "worse"


def test_pairs_with_a_frame_without_data_are_not_judged():
    frames = noisy_frames(3)
    frames[2] = float("nan")
    found = without_warning(restore, frames, camera(), MOTION.vibration())
    verdict = judge_restoration(frames, found, camera(), MOTION.vibration())
    assert verdict.outcome == ("helps", "unknown")
    assert verdict.findings[1] == (Reason("pixels_missing", None, 1.0, 0.5),)
