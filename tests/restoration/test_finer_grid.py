"""Restoration on a grid of half pixels and sharpening, against a camera that aliases and shares no code."""

import re
import warnings

import numpy as np
import pytest
import torch
from benchmarks.independent_camera import Shake, after_optics, closed, still_image
from exact_steps import model_of, solved
from field_truth import FieldMotion, take_field_frames
from finer_truth import FINER, SHAKE, TIMING, VIBRATION, check_gradient, noisy, taken
from refusals import without_warning
from truth import decibel, draw_scene

import rsvib_torch as rsv
from rsvib_torch.frames.pixels import enlarged

SIZE, MARGIN, NOISE = 96, 24, 0.002


def frames_of(scene, count, shake=SHAKE, seed=1):
    return noisy(taken(scene, count, SIZE, shake), NOISE, seed)


def restored(frames, vibration=VIBRATION, timing=TIMING, **options):
    return rsv.restore(frames, timing, vibration, **{"joint": True, "scale": 2, "check": False, **options})


@pytest.fixture(scope="module")
def scene():
    side = FINER * (SIZE + 2 * MARGIN)
    return after_optics(closed(draw_scene(side, side, 5, blur=0.8), 60), 0.3)


@pytest.fixture(scope="module")
def truth(scene):
    return still_image(scene, (SIZE, SIZE), 2)


@pytest.fixture(scope="module")
def frames(scene):
    return frames_of(scene, 6)


@pytest.fixture(scope="module")
def image(frames):
    return restored(frames)[0]


def test_frames_contain_detail_beyond_those_of_a_still_camera(scene, truth, frames, image):
    still = enlarged(torch.from_numpy(still_image(scene, (SIZE, SIZE)).copy())[None], 2)[0]  # without noise
    today = enlarged(rsv.restore(frames, TIMING, VIBRATION, joint=True, check=False), 2)[0]
    assert image.shape == truth.shape
    assert decibel(image, truth, 16) > 6 + max(decibel(still, truth, 16), decibel(today, truth, 16))
    pixels = still_image(scene, (SIZE, SIZE))
    before = rsv.restore(frames, TIMING, VIBRATION, joint=True, check=False)[0]
    assert decibel(image[::2, ::2], pixels, 8) > 4 + decibel(before, pixels, 8)


def test_brightness_is_conserved_up_to_the_ends(truth, image):
    assert abs(float(image[8:-8, 8:-8].mean()) / truth[8:-8, 8:-8].mean() - 1) < 1e-3
    assert decibel(image[:, -40:], truth[:, -40:], 10) > decibel(image, truth, 16) - 3


def wave(cycles, axis):
    """A wave along an axis of the scene, which is periodic, and its frequency in cycles per px."""
    side = FINER * (SIZE + 2 * MARGIN)
    whole = round(cycles * side / FINER)
    values = np.cos(2 * np.pi * whole * np.arange(side) / side) * np.ones((side, 1))
    return values.T if axis else values, whole / side * FINER


def contrast(image, cycles, axis, inner=32):
    """Amplitude of a wave of so many cycles per px in the middle of an image on half pixels."""
    part = np.asarray(image, dtype=float)[inner:-inner, inner:-inner]
    line = (part - part.mean()).mean(1 if axis else 0) * np.hanning(len(part))
    return abs((line * np.exp(-1j * np.pi * cycles * np.arange(len(line)))).mean())


@pytest.mark.parametrize(("cycles", "kind", "axis"), [(0.75, "texture", 1), (0.75, "patch", 0)])
def test_contrast_of_a_sine_beyond_the_nyquist_frequency(cycles, kind, axis):
    side = FINER * (SIZE + 2 * MARGIN)
    values, cycles = wave(cycles, axis)
    if kind == "texture":  # sharp texture, and soft texture whose spectrum does not reach the wave
        fine = 0.8 * closed(draw_scene(side, side, 7, blur=0.8 if cycles < 0.7 else 4.0), 60) + 0.2 * values + 0.1
    else:  # a patch in a grey surface
        hill = np.clip(2 - np.abs(np.arange(side) - side / 2) / (FINER * 20), 0, 1)
        fine = 0.5 + 0.2 * values * hill * hill[:, None]
    scene = after_optics(fine, 0.3)
    still = still_image(scene, (SIZE, SIZE))
    true = contrast(still_image(scene, (SIZE, SIZE), 2), cycles, axis)
    image = restored(frames_of(scene, 8))[0]
    interpolated = contrast(enlarged(torch.from_numpy(still.copy())[None], 2)[0], cycles, axis)
    assert interpolated < 0.6 * true
    assert contrast(image, cycles, axis) == pytest.approx(true, rel=0.06)


def test_double_precision_agrees(frames):
    half = frames[:3, :64, :56]
    image = restored(half)[0]
    assert torch.allclose(restored(half.double())[0].float(), image, atol=2e-4)


def test_channels_batches_and_orientations(frames, image):
    colour = torch.stack([frames[:2], 1 - frames[:2]], 1)[None].repeat(2, 1, 1, 1, 1)
    one = restored(frames[:2])
    both = restored(colour)
    assert both.shape == (2, 1, 2, 2 * SIZE, 2 * SIZE)
    assert torch.allclose(both[1, :, 0], one, atol=1e-4)
    assert torch.allclose(both[0, :, 1], 1 - one, atol=1e-4)
    reverse = rsv.SensorTiming(20.52e-6, 20, 571, readout_direction="reverse")
    turned = restored(frames.flip(-2), rsv.Vibration([3.1, 5.2], [90.0, 61.0], [0.4, 1.3 + np.pi]), reverse)[0]
    assert torch.allclose(turned[:-1], image.flip(0)[1:], atol=1e-5)  # pixel (i, j) is at point (2 i, 2 j) in both


def test_missing_pixels(frames, truth, image):
    holes = torch.rand(frames.shape, generator=torch.Generator().manual_seed(2)) < 0.03
    holes[1, 30:40, 20:50] = True
    repaired = restored(frames.masked_fill(holes, torch.nan))[0]
    assert bool(repaired.isfinite().all())
    assert decibel(repaired, truth, 16) > decibel(image, truth, 16) - 3
    assert decibel(restored(frames.masked_fill(holes, 0.5))[0], truth, 16) < decibel(image, truth, 16) - 10


def test_image_motion(scene):
    moving = Shake(SHAKE.amplitude, SHAKE.frequency, SHAKE.phase, np.array([300.0, 0.0]))
    vibration = rsv.Vibration([3.1, 5.2], [90.0, 61.0], [0.4, 1.3], [300.0, 0.0])
    _, shift = rsv.visible_pixels(TIMING, vibration, (SIZE, SIZE), 4)
    truth = still_image(scene, (SIZE, SIZE), 2, offset=(0, FINER * int(shift[2, 0])))
    single = still_image(scene, (SIZE, SIZE), offset=(0, FINER * int(shift[2, 0])))
    still = enlarged(torch.from_numpy(single.copy())[None], 2)[0]
    assert decibel(restored(frames_of(scene, 4, moving), vibration)[0], truth, 48) > decibel(still, truth, 48) + 3


def test_gradients(frames):
    """Of frames whose prior is a constant."""
    images = frames[:2, :32, :40].double()
    prior = model_of(images, TIMING, VIBRATION, noise=0.01, scale=2).prior

    def energy(values):
        stack = model_of(values, TIMING, VIBRATION, noise=0.01, scale=2)
        return solved(stack, joint=True, prior=prior).square().mean()

    check_gradient(energy, images, rel=0.02)


@pytest.mark.parametrize("rows", [1, 3])
def test_frames_of_few_rows(frames, rows):
    assert restored(frames[:, :rows], rsv.Vibration(0.8, 90.0)).isfinite().all()


def test_frames_that_sample_the_same_points_are_reported(scene, truth):
    still = frames_of(scene, 3, Shake(0 * SHAKE.amplitude, SHAKE.frequency, SHAKE.phase, SHAKE.image_motion))
    with pytest.warns(rsv.RestorationWarning, match="sample the same points"):
        image = restored(still, rsv.Vibration([1e-6, 1e-6], [90.0, 61.0], [0.4, 1.3]))[0]
    mean = enlarged(still.mean(0, keepdim=True), 2)[0]
    assert abs(decibel(image, truth, 16) - decibel(mean, truth, 16)) < 2.5  # no detail is invented


def test_inaccurate_vibration_is_reported_and_no_worse_than_on_pixels(frames, truth):
    wrong = rsv.Vibration([3.1, 5.2], [90.0, 61.0], [0.45, 1.35])
    with pytest.warns(rsv.RestorationWarning, match="not accurate enough for scale=2") as caught:
        image = rsv.restore(frames, TIMING, wrong, joint=True, scale=2, check=False)[0]
    assert caught[0].filename == __file__  # the line of the caller, not one of the package
    error = float(re.search(r"displaced by about ([\d.]+) px", str(caught[0].message)).group(1))
    assert 0.1 < error < 0.3  # the true one has 0.21 px rms over time
    pixels = enlarged(rsv.restore(frames, TIMING, wrong, joint=True, check=False), 2)[0]
    assert decibel(image, truth, 16) > decibel(pixels, truth, 16)
    without_warning(restored, frames)


@pytest.mark.parametrize("error", [0.0, 0.1])
def test_strips_of_frames_with_roll_do_not_contradict_the_vibration(error):
    timing = rsv.SensorTiming(row_time=5e-5, exposure_rows=10, frame_rows=150)
    motion = FieldMotion((2.0, 3.0, 2e-3, 0.0))
    frames = noisy(take_field_frames(draw_scene(150, 280, 3, blur=0.6), timing, motion, (112, 240), 4), NOISE)
    vibration = rsv.Vibration(motion.amplitude[:3], motion.frequency[:3], np.add(motion.phase[:3], error))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", rsv.RestorationWarning)
        restored(frames, vibration, timing)
    assert any("not accurate enough" in str(warning.message) for warning in caught) == (error > 0)


EDGE_SIZE, SIGMA = 80, 0.5


def edge_frames_of(edge_scene):
    return noisy(taken(edge_scene, 6, EDGE_SIZE), NOISE)


def sharpened(edge_frames, optics, scale):
    return rsv.restore(edge_frames, TIMING, VIBRATION, joint=True, scale=scale, check=False, optics=optics)[0]


@pytest.fixture(scope="module")
def edge_scene():
    side = FINER * (EDGE_SIZE + 2 * MARGIN)
    edge_scene = draw_scene(side, side, 5, blur=1.0)
    y, x = (np.mgrid[0:side, 0:side] + 0.5) / FINER - (EDGE_SIZE + 2 * MARGIN) / 2
    across = np.cos(0.1) * x + np.sin(0.1) * y  # an edge of 30 x 56 px, slanted by 0.1 rad
    edge = 0.2 + 0.5 * np.clip(FINER * across + 0.5, 0, 1)
    return closed(np.where((abs(x) < 15) & (abs(y) < 28), edge, edge_scene), 60)


@pytest.fixture(scope="module")
def edge_frames(edge_scene):
    return edge_frames_of(after_optics(edge_scene, SIGMA))


def test_a_sharper_camera_would_take_the_restored_image(edge_scene):
    edge_frames = edge_frames_of(after_optics(edge_scene, 0.8))
    target = still_image(after_optics(edge_scene, 0.5), (EDGE_SIZE, EDGE_SIZE), 1)
    image = sharpened(edge_frames, rsv.Optics(sigma=0.8, pixel=1.0), 1)
    blurred = sharpened(edge_frames, None, 1)
    assert decibel(image, target, 12) > decibel(blurred, target, 12) + 5
    assert float(image.mean()) == pytest.approx(float(blurred.mean()), abs=1e-4)


def test_frequencies_that_the_camera_transmits_better_do_not_change(edge_frames):
    sharp = sharpened(edge_frames[:2], rsv.Optics(sigma=0.2, pixel=1.0), 1)
    assert torch.allclose(sharp, sharpened(edge_frames[:2], None, 1), atol=1e-6)


def test_measured_mtf_and_fields_are_optics(edge_frames):
    frequency = torch.linspace(0.02, 2.0, 100)
    gaussian = torch.exp(-2 * (np.pi * SIGMA * frequency) ** 2)
    expected = sharpened(edge_frames[:2], rsv.Optics(sigma=SIGMA, pixel=1.0), 2)
    measured = sharpened(edge_frames[:2], rsv.Optics(mtf=(frequency, gaussian), pixel=1.0), 2)
    assert torch.allclose(measured, expected, atol=4e-3)
    assert torch.equal(sharpened(edge_frames[:2], {"sigma": SIGMA, "pixel": 1.0}, 2), expected)


def test_mtf_beyond_a_still_camera(edge_scene, edge_frames):
    part = (slice(EDGE_SIZE // 2 - 26, EDGE_SIZE // 2 + 26), slice(EDGE_SIZE // 2 - 14, EDGE_SIZE // 2 + 14))
    finer = tuple(slice(2 * side.start, 2 * side.stop) for side in part)
    still = rsv.slanted_edge_mtf(still_image(after_optics(edge_scene, SIGMA), (EDGE_SIZE, EDGE_SIZE))[part].copy())
    plain = rsv.slanted_edge_mtf(sharpened(edge_frames, None, 2)[finer])
    sharp = rsv.slanted_edge_mtf(sharpened(edge_frames, rsv.Optics(sigma=SIGMA, pixel=1.0), 2)[finer])
    # from cycles per point to cycles per px; the paper improves the MTF of a vibrating camera by 20 to 75 %
    assert 2 * float(plain.mtf50) == pytest.approx(float(still.mtf50), rel=0.04)
    assert 2 * float(sharp.mtf50) > 1.4 * float(still.mtf50)
    assert float(sharp.at(0.25)) > 2 * float(still.at(0.5))  # at the Nyquist frequency of the pixels
