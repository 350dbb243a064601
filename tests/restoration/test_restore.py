"""``restore``: accepted input, options, axes that are not restored, missing and saturated pixels, warnings."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from detections import detection_of
from refusals import without_warning
from truth import Motion, crop, decibel, draw_scene, take_frames

import rsvib_torch as rsv
from rsvib_torch import SensorTiming, Vibration, detect_vibration
from rsvib_torch.datasets import city_and_fields
from rsvib_torch.restoration import (
    RestorationWarning,
    VibrationRestorer,
    restore,
    trusted_vibration,
)

TIMING = SensorTiming(row_time=4e-5, exposure_rows=20, frame_rows=448)
MOTION = Motion((2.1, 3.2), (71.0, 105.0), (0.4, 1.3))
NOISE = 0.005


@pytest.fixture(scope="module")
def scene_and_frames():
    """A scene and two frames of it."""
    scene = draw_scene(448 + 80, 192 + 80, seed=51)
    return crop(scene), torch.from_numpy(take_frames(scene, TIMING, MOTION, 2, NOISE)).float()


restored_without_warning = partial(without_warning, restore)


def test_reliable_detection_equals_its_vibration(scene_and_frames):
    truth, frames = scene_and_frames
    found = detect_vibration(frames, TIMING)
    assert found.reliable.all()
    from_detection = restored_without_warning(frames, TIMING, found)
    torch.testing.assert_close(
        from_detection, restored_without_warning(frames, TIMING, found.vibration), rtol=0, atol=0
    )
    known = restored_without_warning(frames, TIMING, MOTION.vibration())
    assert decibel(from_detection, truth) > decibel(known, truth) - 5  # the information in small frames is limited
    assert decibel(known, truth) > decibel(frames, truth) + 15
    module = VibrationRestorer(TIMING)
    torch.testing.assert_close(module(frames, found), from_detection, rtol=0, atol=0)


ONLY_Y = Vibration([0.0, MOTION.amplitude[1]], MOTION.frequency, MOTION.phase)


@pytest.mark.parametrize(
    ("doubt", "message"),
    [
        (
            {"reliable": (False, True), "reasons": (("nearly blind", "too short"), ())},
            r"x is not restored: its vibration is not reliable \(nearly blind; too short\)",
        ),
        ({"phase": [[1.2], [0.1]]}, r"x is not restored: its displacement of 1\.5 px has a standard deviation of 1\.8"),
        ({"displacement": (1.1, 1.1)}, r"x is not restored: its displacement of 1\.5 px has .* of 1\.1"),
    ],
)
def test_unreliable_and_uncertain_axes_are_not_restored(scene_and_frames, doubt, message):
    _, frames = scene_and_frames
    with pytest.warns(RestorationWarning, match=message):
        found = restore(frames, TIMING, detection_of(MOTION.vibration(), **doubt), check=False)
    torch.testing.assert_close(found, restore(frames, TIMING, ONLY_Y, check=False), rtol=0, atol=0)


def test_an_axis_of_unlimited_uncertainty_is_not_trusted():
    uncertain = detection_of(MOTION.vibration(), relative=math.inf)
    assert trusted_vibration(uncertain, TIMING)[0].amplitude.sum() == 0


def test_image_motion_of_an_unreliable_axis_is_not_undone():
    vibration = Vibration([2.0, 1.0], [71.0, 113.0], 0.0, [500.0, -300.0])  # standard deviation 0.5 px/s
    for reliable, kept in (((False, False), [0.0, 0.0]), ((False, True), [0.0, -300.0])):
        detection = detection_of(vibration, reliable=reliable, reasons=(("a",), ("b",)))
        trusted, notes = trusted_vibration(detection, TIMING)
        assert trusted.image_motion.tolist() == kept
        assert trusted.amplitude.flatten().tolist() == [0.0, float(reliable[1])]
        assert len(notes) == reliable.count(False)


@pytest.mark.parametrize("dtype", [torch.float32, torch.uint8])
def test_frames_are_unchanged_if_both_axes_are_refused(dtype):
    frames = torch.rand(3, 64, 48, generator=torch.Generator().manual_seed(0))
    frames = frames if dtype == torch.float32 else (255 * frames).to(dtype)
    vibration = Vibration([2.0, 1.0], [71.0, 113.0], 0.0, [500.0, -300.0])
    refused = detection_of(vibration, reliable=(False, False), reasons=(("a",), ("b",)))
    expected = frames if dtype == torch.float32 else frames / 255
    with pytest.warns(RestorationWarning, match="is not restored"):
        assert torch.equal(restore(frames, TIMING, refused), expected)
    if dtype == torch.float32:
        frames[0, 3, 4] = torch.nan
        with pytest.warns(RestorationWarning, match="is not restored"):
            found = restore(frames, TIMING, refused)
        torch.testing.assert_close(found, frames, rtol=0, atol=0, equal_nan=True)
    with pytest.warns(RestorationWarning, match="is not restored"):
        assert torch.equal(restore(frames, TIMING, refused, joint=True), expected[1:2])


def test_reliability_applies_to_each_stack_of_a_batch(scene_and_frames):
    """A stack without a known motion is left as taken; the method would remove its blur and noise."""
    frames = scene_and_frames[1][:, :160, :128]
    three = Vibration.stacked([MOTION.vibration()] * 3)
    reasons = ((), ()), (("blind",), ()), (("blind",), ("blind",))
    uncertain = detection_of(three, reliable=((True, True), (False, True), (False, False)), reasons=reasons)
    with pytest.warns(RestorationWarning, match="stack 1: x is not restored"):
        found = restore(torch.stack([frames] * 3)[:, :, None], TIMING, uncertain, check=False)[:, :, 0]
    for stack, vibration in enumerate((MOTION.vibration(), ONLY_Y)):
        alone = restore(frames, TIMING, vibration, check=False)
        torch.testing.assert_close(found[stack], alone, rtol=0, atol=1e-3)
        assert (found[stack] - frames).abs().max() > 0.1
    assert torch.equal(found[2], frames)


def test_warnings_are_issued_for_wrong_vibrations_only(scene_and_frames):
    _, frames = scene_and_frames
    vibration = MOTION.vibration()
    restored_without_warning(frames, TIMING, vibration)
    restored_without_warning(frames, TIMING, vibration, joint=True)
    restored_without_warning(frames[:1], TIMING, MOTION.scaled(2.0).vibration())  # a single frame has no verdict
    with pytest.warns(
        RestorationWarning, match="motion is wrong in part, restored may be worse than raw: x: frames lie"
    ):
        restore(frames, TIMING, MOTION.scaled(0.5).vibration())
    turned = Vibration(MOTION.amplitude, MOTION.frequency, [p + 3 for p in MOTION.phase])
    with pytest.warns(RestorationWarning, match="restored is no better than raw"):
        restore(frames, TIMING, turned)
    both = torch.stack([frames, frames])[:, :, None]
    with pytest.warns(RestorationWarning, match="stack 1: restored is no better than raw"):
        restore(both, TIMING, Vibration.stacked([vibration, turned]), method="dewarp")
    restored_without_warning(frames, TIMING, turned, check=False)
    restored_without_warning(torch.rand(2, 24, 24), TIMING, turned)  # too small for a verdict
    restored_without_warning(frames, TIMING, Vibration.still())


@pytest.mark.parametrize("method", ["exact", "banded", "dewarp"])
def test_missing_pixels_do_not_affect_other_pixels(scene_and_frames, method):
    truth, frames = scene_and_frames
    with_missing = frames.clone()
    with_missing[0, 100:104, 60:64] = math.nan
    with_missing[1, 300:302] = math.nan
    restored = restore(with_missing, TIMING, MOTION.vibration(), method=method)
    whole = restore(frames, TIMING, MOTION.vibration(), method=method)
    assert torch.isfinite(restored).all()
    far = (restored - whole).abs()
    far[0, 80:124, 40:84] = 0
    far[1, 280:322] = 0
    assert far[:, 24:-24, 24:-24].max() < 0.02
    zeroed = restore(with_missing.nan_to_num(0.0), TIMING, MOTION.vibration(), method=method)
    hole = (0, slice(92, 112), slice(52, 72))
    before, after = (np.square(r[hole].numpy() - truth[hole[1:]]).mean() for r in (zeroed, restored))
    assert after < 0.3 * before
    ignored = restore(
        with_missing.nan_to_num(7.0), TIMING, MOTION.vibration(), method=method, ignore=torch.isnan(with_missing)
    )
    torch.testing.assert_close(ignored, restored, rtol=0, atol=1e-5)


def frames_with_lamps(timing):
    scene = draw_scene(256 + 80, 192 + 80, seed=52, blur=1.0) * 0.7
    rows, columns = np.mgrid[: scene.shape[0], : scene.shape[1]]
    for row, column in ((120, 100), (220, 180)):
        scene += 0.7 * np.exp(-((rows - row) ** 2 + (columns - column) ** 2) / (2 * 2.0**2))
    frames = torch.from_numpy(take_frames(scene, timing, MOTION, 2, 0.002)).float()
    counts = (frames.clamp(max=0.8) * (4095 / 0.8)).round().clamp(0, 4095).to(torch.int32)
    assert 20 < int((counts == 4095).sum()) < 400
    return crop(scene), counts


@pytest.mark.parametrize(("rows", "better", "largest"), [(20, 1.0, 0.004), (100, 0.9, 0.02)])
def test_saturation_reduces_errors_around_lamps(rows, better, largest):
    timing = replace(TIMING, exposure_rows=rows)
    truth, counts = frames_with_lamps(timing)
    near = np.zeros(truth.shape, dtype=bool)
    for row, column in ((80, 60), (180, 140)):
        near[row - 20 : row + 21, column - 20 : column + 21] = True
    near &= truth < 0.75  # around the lamps, where ringing would appear
    common = {"timing": timing, "vibration": MOTION.vibration(), "full_scale": 4095}
    known, unknown = (0.8 * restore(counts, saturation=level, **common).numpy() for level in ("auto", None))
    rms = [np.sqrt(np.mean(np.square(image - truth)[:, near])) for image in (known, unknown)]
    assert rms[0] < better * rms[1]
    assert rms[0] < largest
    assert (known[:, truth > 0.9] > 0.75).all()  # no dark pixels in saturated areas


def test_saturated_pixels_do_not_lower_the_noise_level():
    """They have no noise: with a quarter of the frame, the level was 0, and the others lost 4 dB."""
    scene = draw_scene(256 + 80, 192 + 80, seed=53, blur=1.0)
    first = len(scene) // 4
    scene[:first] = 1.5
    frames = torch.from_numpy(take_frames(scene, TIMING, MOTION, 2, 0.01)).float().clamp(max=1.0)
    truth, options = crop(scene), {"saturation": 1.0, "check": False}
    estimated, given = (
        decibel(restore(frames, TIMING, MOTION.vibration(), noise=noise, **options)[0, first:], truth[first:])
        for noise in ("auto", 0.01)
    )
    assert estimated > given - 0.5


PUSH_SCAN = ([1.5, 2.0], [71.0, 113.0], [0.4, 1.3], [300.0, -100.0])  # amplitude, frequency, phase, image motion


@pytest.mark.parametrize("method", ["exact", "banded", "dewarp", "richardson-lucy"])
def test_channels_do_not_change_the_result(scene_and_frames, method):
    stack, vibration = scene_and_frames[1][:, :96, :80].double(), Vibration(*PUSH_SCAN)
    common = {"timing": TIMING, "vibration": vibration, "method": method, "check": False}
    whole = restore(stack, **common)
    three = torch.stack([stack] * 3, 1)  # channels have one noise level
    torch.testing.assert_close(restore(three, **common)[:, 1], whole)


def test_strips_of_a_frame_are_solved_together_as_one_by_one():
    timing = SensorTiming(row_time=4e-5, exposure_rows=8, frame_rows=200)
    vibration = Vibration([1.5, 1.2, 0.006], [53.0, 65.0, 41.0], [0.4, 1.3, 0.2])
    noise = rsv.SensorNoise(read_noise=0.005)
    scene = city_and_fields(220, 240, seed=3)
    frames = rsv.simulate_frames(scene, timing, vibration, 2, frame_size=(160, 180), noise=noise)
    together = restore(frames, timing, vibration, check=False)
    one_by_one = restore(frames.clone().requires_grad_(), timing, vibration, check=False)  # differentiable
    torch.testing.assert_close(together, one_by_one.detach(), atol=1e-4, rtol=0)
    assert (together - frames).abs().amax() > 0.1


@pytest.mark.parametrize("method", ["exact", "banded", "richardson-lucy"])
def test_blur_of_long_exposures_is_removed(method):
    timing, scene = SensorTiming(row_time=20.52e-6, exposure_rows=200, frame_rows=2048), draw_scene(272, 240, 21)
    frames = torch.from_numpy(take_frames(scene, timing, Motion(), 1, 0.002)).float()
    sharp, warped = (
        decibel(restore(frames, timing, Motion().vibration(), method=name, check=False), crop(scene))
        for name in (method, "dewarp")
    )
    assert sharp > warped + 4


@pytest.mark.parametrize(
    ("method", "options", "error"),
    [
        ("exact", {"noise": 0.05}, 5e-3),
        ("banded", {"noise_to_signal": 0.1}, 1e-9),
        ("richardson-lucy", {"iterations": 5}, 1e-9),
    ],
)
def test_flux_is_conserved(method, options, error):
    lamp = torch.zeros(1, 128, 128, dtype=torch.float64)
    lamp[0, 60:70, 60:66] = torch.rand(10, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    still = restore(lamp, TIMING, Vibration.still(), method=method, check=False, **options)
    assert still.sum().item() == pytest.approx(lamp.sum().item(), rel=error)
    assert (still - lamp).abs().max() > 1e-3
    flat = torch.full((1, 96, 80), 0.37, dtype=torch.float64)
    assert (restore(flat, TIMING, MOTION.vibration(), method=method, check=False, **options) - 0.37).abs().max() < 1e-6
