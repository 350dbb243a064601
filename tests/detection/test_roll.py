"""Detection and restoration of frames of a camera that rolls and zooms, against an independent camera."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from field_truth import FieldMotion, LensMotion, take_field_frames
from program import rsvib
from refusals import without_warning
from truth import Curve, decibel, draw_scene, take_frames

from rsvib_torch import (
    Camera,
    SensorTiming,
    detect_motion,
    detect_vibration,
    judge_restoration,
    restore,
    visible_pixels,
    write_stack,
)

TIMING = SensorTiming(row_time=8e-5, exposure_rows=12, frame_rows=280)
TRUTH = FieldMotion((1.4, 1.9, 2.5e-3, 0.0), (38.0, 31.0, 26.0, 0.0), (0.3, 1.1, 2.0, 0.0))
SIZE = (224, 288)


def test_noise_is_no_roll():
    """Two noisy frames have three blocks of rows, whose halves seemed to move apart by 0.047 px."""
    timing = SensorTiming(row_time=1e-4, exposure_rows=12, frame_rows=300)
    phase = np.array([4.4, 4.4])
    moved = Curve(lambda t: np.array([1.5, 1.1]) * np.sin(2 * np.pi * np.array([61.0, 47.0]) * t[..., None] + phase))
    frames = take_frames(draw_scene(272, 272, seed=4), timing, moved, 2, noise=0.03, seed=11)
    assert detect_vibration(frames, timing, tones=1).reliable.all()


@pytest.fixture(scope="module")
def rolling():
    """Scene at rest and four frames with noise."""
    scene = draw_scene(304, 368, 11, blur=1.2)
    frames = take_field_frames(scene, TIMING, TRUTH, SIZE, 4)
    still = take_field_frames(scene, TIMING, FieldMotion((0.0,) * 4), SIZE, 1, nodes=1)[0]
    noise = 0.004 * np.random.default_rng(5).standard_normal(frames.shape)
    return still, torch.from_numpy(frames + noise).float()


@pytest.fixture(scope="module")
def detection(rolling):
    return detect_vibration(rolling[1], TIMING, roll=True)


def test_roll_is_detected(detection):
    assert detection.vibration.amplitude.shape[-2] == 3
    assert detection.reliable.tolist() == [True, True, True]
    expected = TRUTH.vibration(3)
    for name in ("amplitude", "frequency", "phase"):
        error = (getattr(detection.vibration, name) - getattr(expected, name)).abs()[:, 0]
        std = getattr(detection.std, name)[:, 0]
        assert bool((error < 3.5 * std).all()), (name, error, std)
    assert abs(float(detection.vibration.amplitude[2, 0]) / TRUTH.amplitude[2] - 1) < 0.02
    assert float(detection.std.amplitude[2, 0]) < 1.2e-4


LARGE = FieldMotion((1.1, 0.8, 0.02, 0.0), (38.0, 31.0, 26.0, 0.0), (0.3, 1.1, 2.0, 0.0))
WIDE = FieldMotion((3.0, 5.0, 8e-3, 0.0), (90.0, 61.0, 70.0, 0.0), (0.3, 1.1, 2.0, 0.0))


@pytest.mark.parametrize(
    ("truth", "timing", "size", "seed", "noise", "error"),
    [
        # 2 px rms, more than the parts of a pixel that gradients reach: the frames must be warped by the roll
        (LARGE, TIMING, SIZE, 11, 4e-3, 0.01),
        # in four strips of 170 px, as for a small roll, the amplitude was 0.16 % too small, with more tones along y
        (WIDE, SensorTiming(row_time=1.5375e-4, exposure_rows=1.3, frame_rows=166.5), (160, 512), 3, 2e-4, 5e-4),
    ],
)
def test_large_rolls_are_accurate(truth, timing, size, seed, noise, error):
    scene = draw_scene(size[0] + 80, size[1] + 80, seed, blur=1.2)
    frames = take_field_frames(scene, timing, truth, size, 4)
    frames = frames + noise * np.random.default_rng(5).standard_normal(frames.shape)
    found = detect_vibration(torch.from_numpy(frames).float(), timing, roll=True, zoom=False)
    assert found.reliable.tolist() == [True, True, True]
    assert abs(float(found.vibration.amplitude[2, 0]) / truth.amplitude[2] - 1) < error


def test_roll_is_measured_by_default(rolling, detection):
    """Zoom is measured as well, found to be 0, and left out."""
    found = detect_vibration(rolling[1], TIMING)
    assert found.vibration.num_axes == 3
    assert found.reliable.tolist() == [True, True, True]
    torch.testing.assert_close(found.vibration.amplitude, detection.vibration.amplitude, rtol=5e-3, atol=0)


def test_a_stack_of_a_batch_that_rolls_gives_all_stacks_the_same_components(rolling, detection):
    without = FieldMotion((1.4, 1.9, 0.0, 0.0), TRUTH.frequency, TRUTH.phase)
    frames = take_field_frames(draw_scene(304, 368, 12, blur=1.2), TIMING, without, SIZE, 4)
    frames = frames + 0.004 * np.random.default_rng(6).standard_normal(frames.shape)
    found = detect_vibration(torch.stack([torch.from_numpy(frames).float(), rolling[1]])[:, :, None], TIMING)
    assert found.reliable[:, :2].all()
    assert found.vibration.num_axes == 3
    assert found.reliable[1, 2]
    torch.testing.assert_close(found.vibration.amplitude[1], detection.vibration.amplitude, rtol=5e-3, atol=0)
    torch.testing.assert_close(
        found.vibration.amplitude[0, :2, 0], torch.tensor(without.amplitude[:2]).double(), rtol=5e-3, atol=0
    )


def test_roll_is_measured_by_default_where_detail_is_at_one_side():
    """Rows are then displaced along y as well, and their quarters unevenly: roll was not tried."""
    scene = draw_scene(304, 368, 12, blur=1.2)
    at_the_left = 0.03 + 0.97 * np.exp(-np.square(np.arange(368) / (0.3 * 368)))
    frames = take_field_frames(0.5 + (scene - 0.5) * at_the_left, TIMING, TRUTH, SIZE, 6)
    noise = 0.002 * np.random.default_rng(5).standard_normal(frames.shape)
    found = detect_vibration(torch.from_numpy(frames + noise).float(), TIMING)
    assert found.reliable.tolist() == [True, True, True]
    expected = TRUTH.vibration(3).amplitude
    torch.testing.assert_close(found.vibration.amplitude, expected, rtol=0.01, atol=0)


def test_without_roll_the_result_is_the_same():
    """Bit for bit: roll is measured only if the halves of the rows move apart."""
    scene = draw_scene(224, 224, 11, blur=1.2)
    frames = take_field_frames(scene, TIMING, FieldMotion((1.4, 1.9, 0.0, 0.0)), (160, 160), 2)
    frames = torch.from_numpy(frames + 0.004 * np.random.default_rng(5).standard_normal(frames.shape)).float()
    found, without = detect_vibration(frames, TIMING), detect_vibration(frames, TIMING, roll=False)
    assert found.vibration.num_axes == 2
    assert torch.equal(found.vibration.amplitude, without.vibration.amplitude)
    assert torch.equal(found.std.frequency, without.std.frequency)


@pytest.mark.parametrize("function", [detect_vibration, detect_motion])
def test_ignored_roll_is_named_as_the_reason(rolling, function):
    options = {} if function is detect_vibration else {"zoom": False}  # zoom="auto" is measured with roll only
    found = function(rolling[1], TIMING, roll=False, **options)
    assert not bool(found.reliable[0])
    (apart,) = (reason for reason in found.findings[0] if reason.code == "halves_apart")
    assert apart.value > apart.limit
    assert "measure it with roll, zoom" in str(apart)


@pytest.mark.parametrize(("method", "least_gain"), [("dewarp", 2.0), ("exact", 3.0)])
def test_frames_are_restored(rolling, detection, method, least_gain):
    """The gain over a restoration without roll is the effect of this motion, not of the vibration."""
    still, frames = rolling
    frames, timing = frames[1:3], replace(TIMING, frame_start_times=TIMING.frame_starts(3)[1:])
    restored = without_warning(restore, frames, timing, detection, method=method)
    ignoring = restore(frames, timing, detection.with_axes(2).vibration, method=method, check=False)
    assert decibel(restored, still) > decibel(ignoring, still) + least_gain
    verdict = judge_restoration(frames, restored, timing, detection)
    assert verdict.overall == "helps"
    wrong = judge_restoration(frames, ignoring, timing, detection)
    assert float(wrong.misfit_after.amax()) > 2 * float(verdict.misfit_after.amax())


def between_frames(components):
    """Components (A, T, R) of the same rows less their mean over the frames, (T, R, A)."""
    values = np.moveaxis(np.asarray(components), 0, -1)
    return values - values.mean(0)


def test_free_motion_with_roll(rolling):
    """The differences between frames of the rows that show one scene row, which are what is measured."""
    found = detect_motion(rolling[1], TIMING, roll=True)
    assert found.motion.num_axes == 3
    assert found.reliable.tolist() == [True, True, True]
    rows, starts = np.arange(20.0, 200.0), TIMING.frame_starts(4).numpy()[:, None]
    times = starts + TIMING.row_time * rows
    for _ in range(30):
        times = starts + TIMING.row_time * (rows + TRUTH.components(times)[1])
    times += 0.5 * TIMING.exposure_time
    true = between_frames(TRUTH.components(times)[:3])
    error = between_frames(found.motion.displacement(torch.from_numpy(times)).permute(2, 0, 1).numpy()) - true
    rms = np.sqrt((error**2).mean((0, 1)))
    assert (rms < 2.5 * found.std_seen.numpy()).all()
    assert rms[2] < 0.03 * np.sqrt((true[..., 2] ** 2).mean())  # of the roll itself: no roll is 100 %
    assert "rad" in str(found)


def test_visible_pixels_follow_the_roll():
    """A pixel is visible if its content at rest lies inside the frame while its row is exposed."""
    motion = FieldMotion((0.0, 0.0, 2e-2, 0.0))
    mask, shift = visible_pixels(TIMING, motion.vibration(3), SIZE, 2)
    assert shift.abs().sum() == 0
    height, width = SIZE
    y, x = np.mgrid[:height, :width] - np.array([(height - 1) / 2, (width - 1) / 2])[:, None, None]
    middles = TIMING.row_starts(2, height).numpy()[..., None] + 0.5 * TIMING.exposure_time
    roll = motion.components(middles)[2]
    expected = (np.abs(x - roll * y) <= (width - 1) / 2) & (np.abs(y + roll * x) <= (height - 1) / 2)
    # the roll is taken at the row at rest here, and at the row in the frame by the function
    assert np.mean(mask.numpy() != expected) < 0.15 * np.mean(~expected)


@pytest.mark.slow
def test_focal_length_gives_the_vibration_of_a_camera_with_a_wide_field():
    lens = (-0.12, 0.05, 1e-3, -2e-3, 0.01)
    truth = LensMotion((3.0, 4.0, 0.0, 0.0), (38.0, 31.0, 0.0, 0.0), (0.3, 1.1, 0.0, 0.0), 300.0, (6.0, -4.0), lens)
    scene = draw_scene(304, 368, 11, blur=1.2)
    frames = torch.from_numpy(take_field_frames(scene, TIMING, truth, SIZE, 4)).float()
    frames = frames + 0.004 * torch.randn(frames.shape, generator=torch.Generator().manual_seed(1))
    options = {"focal_length": 300.0, "principal_point": (143.5 + 6.0, 111.5 - 4.0), "distortion": lens}
    detection = detect_vibration(frames, TIMING, **options)
    assert detection.reliable.tolist() == [True, True]
    assert detection.vibration.camera == Camera(300.0, (6.0, -4.0), lens)
    for values, true, limit in (("amplitude", [3.0, 4.0], 0.015), ("phase", [0.3, 1.1], 0.01)):
        error = getattr(detection.vibration, values)[:, 0] - torch.tensor(true, dtype=torch.float64)
        assert bool((error.abs() < 5 * getattr(detection.std, values)[:, 0]).all())
        assert float(error.abs().max()) < limit
    without = detect_vibration(frames, TIMING)  # columns displaced alike
    assert not bool(without.reliable.all())
    still = torch.from_numpy(scene[40:-40, 40:-40])
    inner = (..., slice(12, -12), slice(12, -12))
    found = []
    for vibration in (detection.vibration, without.vibration):
        restored = restore(frames[:1], TIMING, vibration, method="dewarp")
        found.append(decibel(restored[inner].numpy(), still[inner].numpy()))
    assert found[0] > found[1] + 1.0


def test_commands_write_the_results_of_a_rolling_camera(rolling, tmp_path, capsys):
    text = "[sensor]\nrow_time = 8e-5\nexposure_rows = 12\nframe_rows = 280\nfull_scale = 4095\n"
    text += "[detection]\nroll = true\ntones = 1\n[restoration]\nmethod = 'dewarp'\n"
    (tmp_path / "camera.toml").write_text(text)
    write_stack(tmp_path / "frames.tif", rolling[1].clamp(0, 1), dtype="uint16", full_scale=4095)
    config = ("--config", tmp_path / "camera.toml")
    assert rsvib("run", tmp_path / "frames.tif", tmp_path / "page", *config, "--report", "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["detection"]["reliable"] == [True, True, True]
    assert answer["detection"]["vibration"]["amplitude"][2][0] == pytest.approx(2.5e-3, rel=0.03)
    assert answer["restoration"]["left_alone"] == {"x": {}, "y": {}, "roll": {}}
    assert (tmp_path / "page" / "offsets.png").exists()
    assert "roll: reliable" in (tmp_path / "page" / "report.html").read_text()
