"""Colour mosaics, against a camera that shares no code with the package."""

import cv2
import numpy as np
import pytest
import torch
from benchmarks.independent_camera import after_optics, closed, mosaic_of, still_image
from finer_truth import FINER, SHAKE, TIMING, VIBRATION, check_gradient, noisy, taken
from refusals import without_warning
from truth import decibel, draw_scene

import rsvib_torch as rsv
from rsvib_torch.frames.pixels import colour_frames, is_mosaic
from rsvib_torch.restoration import RestorationWarning
from rsvib_torch.restoration.finer_grid import PolynomialPrior
from rsvib_torch.restoration.frame_motion import frame_motion
from rsvib_torch.restoration.observation import Observation, RowKernels
from rsvib_torch.restoration.scene_solver import SceneProblem, with_missing_values

SIZE, MARGIN, NOISE = 72, 24, 0.003


def colour_scene(size=SIZE):
    """Red, green and blue (3, H, W) on the grid of the camera: one landscape, and two others in the colours."""
    side = FINER * (size + 2 * MARGIN)
    grey, first, second = (draw_scene(side, side, seed, blur=2.5) for seed in (5, 6, 7))
    first, second = 0.3 * (first - first.mean()), 0.2 * (second - second.mean())
    return np.stack(
        [after_optics(closed(part, 60), 0.35) for part in (grey + first, grey - 0.3 * first, grey - second)]
    )


def coloured(scene, count, size=SIZE, shake=SHAKE):
    """Noise-free colour frames (T, 3, H, W)."""
    return np.stack([taken(part, count, size, shake) for part in scene], 1)


def raw(clean, pattern="RGGB"):
    return noisy(mosaic_of(clean, pattern), NOISE)


def restored(frames, vibration=VIBRATION, timing=TIMING, **options):
    return rsv.restore(frames, timing, vibration, **{"joint": True, "mosaic": "RGGB", "check": False, **options})


def still(scene, scale=1):
    return np.stack([still_image(part, (SIZE, SIZE), scale) for part in scene])


def opencv(frames):
    """Colour frames by the edge-aware demosaicing of OpenCV."""
    counts = np.clip(frames.double().numpy() * 50000 + 5000, 0, 65535).round().astype(np.uint16)
    images = [(cv2.cvtColor(frame, cv2.COLOR_BayerRGGB2RGB_EA).astype(float) - 5000) / 50000 for frame in counts]
    return torch.from_numpy(np.moveaxis(np.stack(images), -1, 1)).float()


@pytest.fixture(scope="module")
def scene():
    return colour_scene()


@pytest.fixture(scope="module")
def clean(scene):
    return coloured(scene, 6)


@pytest.fixture(scope="module")
def frames(clean):
    return raw(clean)


def test_a_mosaic_that_is_restored_as_grey_frames_causes_a_warning(clean, frames):
    with pytest.warns(RestorationWarning, match='raw frames of a colour sensor.* e.g. mosaic="RGGB"'):
        restored(frames, mosaic=None)
    grey = noisy(clean[:, 0], NOISE)
    without_warning(restored, grey, mosaic=None)
    without_warning(restored, frames)


def test_frames_together_contain_the_colours_that_each_lacks(scene, frames):
    image = restored(frames, scale=2)[0]
    assert image.shape == (3, 2 * SIZE, 2 * SIZE)
    each = rsv.restore(opencv(frames), TIMING, VIBRATION, joint=True, check=False)[0]
    assert decibel(image[:, ::2, ::2], still(scene), 8) > decibel(each, still(scene), 8) + 6
    assert decibel(image, still(scene, 2), 16) > 51
    for ours, true in zip(image, still(scene), strict=True):  # flux of each colour
        assert float(ours[16:-16, 16:-16].mean()) == pytest.approx(true[8:-8, 8:-8].mean(), abs=2e-3)


def test_one_frame_is_not_worse_than_demosaicing(scene, frames):
    one = restored(frames[:1])[0]
    before = rsv.restore(opencv(frames[:1]), TIMING, VIBRATION, check=False)[0]
    linear = rsv.restore(colour_frames(frames[:1], "RGGB"), TIMING, VIBRATION, check=False)[0]
    assert decibel(one, still(scene), 8) > 1.5 + max(decibel(part, still(scene), 8) for part in (before, linear))


def test_patterns(scene, clean):
    truth = still(scene)[:, :40, :40]
    taken = raw(clean[:2, :, :40, :40], "GBRG")
    right, wrong = (decibel(restored(taken, mosaic=name)[0], truth, 8) for name in ("GBRG", "RGGB"))
    assert right > wrong + 4


def test_orientations_and_channel_axes(frames):
    two = frames[:2, :32, :28]
    expected = restored(two, scale=2)
    assert expected.shape == (1, 3, 64, 56)
    turned = rsv.SensorTiming(20.52e-6, 20, 571, scan_axis="x")
    swapped = rsv.Vibration([5.2, 3.1], [61.0, 90.0], [1.3, 0.4])
    across = restored(two.mT[:, None], swapped, turned, scale=2)
    assert torch.allclose(across.mT, expected, atol=5e-3)  # rounding may change which cosines of a patch are kept
    reverse = rsv.SensorTiming(20.52e-6, 20, 571, readout_direction="reverse")
    opposite = rsv.Vibration([3.1, 5.2], [90.0, 61.0], [0.4, 1.3 + np.pi])
    down = restored(two.flip(-2), opposite, reverse, mosaic="GBRG", scale=2)
    assert torch.allclose(down[..., :-1, :], expected.flip(-2)[..., 1:, :], atol=5e-3)
    last = restored(two[..., None], channels="last", scale=2)
    assert torch.equal(last.movedim(-1, 1), expected)


def test_batches_and_groups_of_frames(frames):
    part = frames[:2, :24, :24]
    groups = restored(part, joint=2)
    assert groups.shape == (2, 3, 24, 24)
    batch = restored(torch.stack([part.flip(0), part])[:, :, None], joint=2)
    assert torch.allclose(batch[1], groups, atol=1e-4)
    assert not torch.allclose(batch[0], groups, atol=1e-2)


def test_missing_and_saturated_pixels(scene, frames):
    part, truth, level = frames[:3, :48, :48], still(scene)[:, :48, :48], 0.66

    def quality(images, most=1.0, **options):
        image = restored(images, **options)[0].clamp(max=most)
        assert bool(image.isfinite().all())
        return decibel(image, truth.clip(max=most), 8)

    holes = torch.rand(part.shape, generator=torch.Generator().manual_seed(2)) < 0.03
    assert quality(part.masked_fill(holes, torch.nan)) > quality(part) - 2.5
    clipped = part.clamp(max=level)
    assert float((clipped == level).double().mean()) > 0.02
    assert quality(clipped, level, saturation=level) > quality(clipped, level)


def test_gradient_of_the_least_squares_solution():
    """Of conjugate gradients for missing values of colours, which couple the components."""
    generator = torch.Generator().manual_seed(1)
    motion = frame_motion(VIBRATION.expanded(1), TIMING.in_row_order(), TIMING.frame_starts(2), 24)
    displacement, node_weights = motion.exposures
    kernels = RowKernels.of_rows(displacement[0].repeat(3, 1, 1, 1), node_weights, torch.ones(6), 24, points=2)
    observation = Observation(kernels, 24, 32, torch.float64, 3)
    prior = PolynomialPrior(torch.ones(7, 7, dtype=torch.float64), 32)
    precision = torch.cat([prior.precision(torch.tensor(1e-4 * factor), blur_reach=0.1) for factor in (1, 4, 4)], 2)
    mixing = torch.linalg.qr(torch.rand(3, 3, generator=generator, dtype=torch.float64))[0]
    measured = torch.rand(3, 2, 1, 24, 32, generator=generator) < 0.4

    def energy(data):
        problem = SceneProblem(data, observation, precision, torch.full((3,), 0.01), mixing)
        solver = problem.solver(keep=True)
        filled = with_missing_values(problem, solver, measured, iterations=12)
        return solver.image(solver.fit(filled.data)).square().mean()

    check_gradient(energy, torch.rand(3, 2, 1, 24, 32, generator=generator, dtype=torch.float64), rel=1e-3)


def test_detection_in_raw_frames():
    clean = coloured(colour_scene(128), 6, 128)
    times = torch.linspace(0, 0.04, 200, dtype=torch.float64)

    def error(frames):
        found = rsv.detect_vibration(frames, TIMING).vibration
        difference = found.displacement(times) - VIBRATION.displacement(times)
        return float((difference - difference.mean(0)).square().mean().sqrt())

    frames = raw(clean)
    assert error(frames) < 0.02  # px; 0.06 without the filter
    grey = torch.from_numpy(clean.mean(1)).float()
    sign = 1 - 2 * (torch.arange(128) % 2)
    twice_green = grey * (1 + 0.1 * sign + 0.1 * sign[:, None])  # red and blue together
    for blocks in (None, 4):
        assert is_mosaic(frames, blocks=blocks).all()
        assert is_mosaic(twice_green, blocks=blocks).all()
        assert not is_mosaic(grey, blocks=blocks).any()
    assert not is_mosaic(torch.randn(3, 64, 64, generator=torch.Generator().manual_seed(1))).any()
    column = torch.arange(128)[None, :].expand(128, -1)
    assert not is_mosaic(torch.sin(2.9 * column).float()[None])  # detail near 1/2 cycle per px
    assert not is_mosaic(grey * (1 + 0.1 * sign)).any()  # columns that alternate


def test_frames_that_do_not_fit_are_reported(frames):
    part = frames[:2, :40, :40]
    wrong = rsv.Vibration([3.1, 5.2], [90.0, 61.0], [0.6, 1.5])
    with pytest.warns(rsv.RestorationWarning, match="times the stated noise"):
        restored(part, wrong, noise=NOISE)
    with pytest.warns(rsv.RestorationWarning, match="the same colours at the same points"):
        restored(part, rsv.Vibration([1e-6, 1e-6], [90.0, 61.0]))
    without_warning(restored, part, noise=NOISE)


@pytest.mark.parametrize("joint", [False, True])
def test_frames_without_detail_keep_their_brightness(joint):
    torch.testing.assert_close(restored(torch.full((2, 32, 32), 0.5), joint=joint).mean(), torch.tensor(0.5))


def test_still_stacks_in_windows(tmp_path):
    """Nothing moves: the middle frame is interpolated."""
    frames = raw(coloured(colour_scene(96), 1, 96)).clamp(0, 1)
    options = {"joint": True, "scale": 2, "mosaic": "RGGB"}
    same = frames[:1].repeat(4, 1, 1) + NOISE * torch.randn(4, 96, 96, generator=torch.Generator().manual_seed(1))
    rsv.write_stack(tmp_path / "still.tif", same.clamp(0, 1), dtype="uint16", full_scale=65535)
    rsv.process_stack(tmp_path / "still.tif", tmp_path / "same.tif", TIMING, restoration=options)
    written, stored = rsv.read_stack(tmp_path / "same.tif"), rsv.read_stack(tmp_path / "still.tif")
    assert written.shape == (1, 3, 192, 192)
    assert torch.allclose(written[0, 0, ::4, ::4], stored[2, ::2, ::2], atol=1e-4)  # red is measured there
    assert torch.allclose(written[0, 2, 2::4, 2::4], stored[2, 1::2, 1::2], atol=1e-4)
