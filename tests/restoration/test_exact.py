"""Method ``"exact"``: its solver, accuracy, windows of rows, gradients, prior of edges, and strength of the prior."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from exact_steps import model_of, solved
from scipy import fft, ndimage
from truth import Motion, crop, decibel, draw_scene, take_frames

from rsvib_torch import SensorTiming, Vibration, psnr, simulate_frames
from rsvib_torch.datasets import city_and_fields
from rsvib_torch.restoration import restore as restore_by_any_method
from rsvib_torch.restoration import visible_pixels
from rsvib_torch.restoration.exact import model_frames
from rsvib_torch.restoration.frame_motion import MovingFrames, frame_motion
from rsvib_torch.restoration.observation import Observation, RowKernels
from rsvib_torch.restoration.priors import PRIORS, shrink_patches
from rsvib_torch.restoration.scene_prior import RowPrior, fit_prior
from rsvib_torch.restoration.scene_solver import SceneSolver

restore = partial(restore_by_any_method, method="exact")
quietly = partial(restore, check=False)
TIMING = SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)


def as_tensor(array, dtype=torch.float32):
    return torch.from_numpy(array).to(dtype)


@pytest.fixture(scope="module")
def short():
    motion = Motion()
    scene = draw_scene(336, 288, seed=12)
    return crop(scene), take_frames(scene, TIMING, motion, 2), motion


def with_noise(frames, noise, seed=5, dtype=torch.float32):
    return as_tensor(frames + noise * np.random.default_rng(seed).standard_normal(frames.shape), dtype)


@pytest.mark.parametrize(
    ("rows", "noise", "one", "two"),
    [(20, 0.0, 64.0, 67.5), (20, 0.02, 38.0, 40.0), (100, 0.005, 45.0, 47.0), (400, 0.005, 38.0, 42.5)],
)
def test_psnr_of_restored_frames(rows, noise, one, two):
    timing, motion, scene = replace(TIMING, exposure_rows=rows), Motion(), draw_scene(464, 288, seed=13)
    truth, frames = crop(scene), with_noise(take_frames(scene, timing, motion, 2), noise)
    single, joint, pairs = (restore(frames, timing, motion.vibration(), joint=joint) for joint in (False, True, 2))
    assert (joint.shape, pairs.shape) == ((1, *truth.shape), frames.shape)
    assert np.mean([decibel(frame, truth) for frame in single]) > one
    assert min(decibel(joint[0], truth), decibel(pairs, truth)) > two
    half = restore(frames, timing, motion.scaled(0.5).vibration(), joint=True)
    assert decibel(half[0], truth) < one - 10


def test_boundaries_are_not_periodic(short):
    _, frames, motion = short
    frames = as_tensor(frames)
    other = frames.clone()
    other[:, :8] = 1.0
    other[:, :, :8] = 1.0
    stack, changed = (model_of(images, TIMING, motion.vibration(), noise=0.01) for images in (frames, other))
    # with one prior, so that results depend on the frames only through the solution
    change = solved(changed, prior=stack.prior) - solved(stack)
    assert change[:, :4, :4].abs().max() > 0.1
    assert change[:, 64:, -32:].abs().max() < 0.01
    assert change[:, -32:, 64:].abs().max() < 0.01


@pytest.mark.parametrize("joint", [False, 2])
def test_results_do_not_depend_on_threads_and_gradients(short, joint, monkeypatch):
    _, frames, motion = short
    stack = with_noise(np.concatenate([frames, frames[::-1]])[:3, :120, :100], 0.005, dtype=torch.float64)
    allowed = torch.get_num_threads()
    options = {"joint": joint, "check": False}
    found, scenes = [], []
    gaussian = PRIORS["gaussian"]

    def counted(problem, strength):
        scenes.append(len(problem.data))
        return gaussian(problem, strength)

    monkeypatch.setitem(PRIORS, "gaussian", counted)
    try:
        for threads in (2, 1):
            torch.set_num_threads(threads)
            found.append(restore(stack, TIMING, motion.vibration(), **options))
        found.append(restore(stack.requires_grad_(), TIMING, motion.vibration(), **options))
        assert sorted(scenes) == [1, 2, 3, 3]  # two threads share the scenes of three frames
    finally:
        torch.set_num_threads(allowed)
    torch.testing.assert_close(found[1], found[0], rtol=0, atol=1e-9)
    torch.testing.assert_close(found[2].detach(), found[0], rtol=0, atol=1e-9)
    assert found[2].requires_grad


def test_push_scan_frames_are_joined_where_they_overlap():
    motion = Motion(amplitude=(1.5, 2.0), image_motion=(900.0, 400.0))  # 38 and 17 px from frame to frame
    margin, size = 180, 224
    scene = draw_scene(size + 2 * margin, size + 2 * margin, seed=31)
    frames = with_noise(take_frames(scene, TIMING, motion, 3, margin=margin), 0.01)
    single = restore(frames, TIMING, motion.vibration())
    joint = restore(frames, TIMING, motion.vibration(), joint=True)
    _, shift = visible_pixels(TIMING, motion.vibration(), (size, size), 3)
    x, y = shift[1].int().tolist()
    truth = scene[margin - y : margin - y + size, margin - x : margin - x + size]
    inner = decibel(joint[0], truth, 60) - decibel(single[1], truth, 60)
    assert 2.0 < inner < 6.0
    assert decibel(joint[0], truth, 8) > decibel(single[1], truth, 8) - 0.1


@pytest.mark.parametrize("joint", [False, True])
def test_windows_of_rows_are_joined_without_a_seam(joint):
    """The rows around the seam of two windows equal those of a part of the frames that is one window."""
    timing = SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)
    vibration = Vibration([3.1, 5.2], [50.0, 30.0], [0.7, 2.1])
    scene = city_and_fields(1200 + 96, 64 + 96, seed=4)
    frames = simulate_frames(scene, timing, vibration, 2, frame_size=(1200, 64))
    frames = frames + 0.005 * torch.randn(frames.shape, generator=torch.Generator().manual_seed(5))
    whole = model_of(frames, timing, vibration, noise=0.005)
    later = timing.frame_starts(2) + 400 * timing.row_time
    timing = replace(timing, frame_start_times=tuple(later.tolist()))
    part = model_of(frames[:, 400:800], timing, vibration, noise=0.005)
    at_seam = slice(500, 700)
    expected = solved(part, joint=joint, prior=whole.prior, mean=whole.mean)
    torch.testing.assert_close(solved(whole, joint=joint)[:, at_seam], expected[:, 100:300], rtol=0, atol=3e-5)


def test_rows_are_not_divided_where_exposures_blur():
    """At 300 rows of exposure and no noise, errors of windows would exceed the brightness of the scene."""
    timing = SensorTiming(row_time=20.52e-6, exposure_rows=300, frame_rows=2048)
    vibration = Vibration([3.1, 5.2], [50.0, 30.0], [0.7, 2.1])
    scene = city_and_fields(1200 + 96, 64 + 96, seed=4)
    frames = simulate_frames(scene, timing, vibration, 1, frame_size=(1200, 64))
    restored = restore(frames, timing, vibration, check=False)
    inner = (0, slice(48, -48), slice(16, -16))
    assert psnr(restored[inner], scene[48:-48, 48:-48][inner[1:]], 1.0) > 35


@pytest.mark.parametrize("joint", [False, True])
def test_gradients_through_filled_pixels_and_ends(joint):
    timing = SensorTiming(row_time=1e-3, exposure_rows=12, frame_rows=16)
    frames = torch.rand(2, 6, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    ignore = torch.zeros(2, 6, 5, dtype=torch.bool)
    ignore[0, 2, 3] = True
    parameters = ([1.6, 0.6], [40.0, 30.0], [0.3, 1.0], [0.0, 0.0])  # amplitude, frequency, phase, image motion
    inputs = (frames, *(torch.tensor(values, dtype=torch.float64) for values in parameters))

    def run(images, *parameters):
        return restore(images, timing, Vibration(*parameters), noise=0.05, ignore=ignore, joint=joint, check=False)

    values = tuple(value.clone().requires_grad_() for value in inputs)
    assert torch.autograd.gradcheck(run, values, fast_mode=True)


def test_boundary_extensions_are_filled_at_the_ends_of_the_rows_only():
    timing = SensorTiming(row_time=1e-4, exposure_rows=75, frame_rows=400)
    motion, still = (Vibration(size, [53.0, 65.0], [0.4, 1.3]) for size in ([3.0, 1.2], [0.0, 0.0]))
    scene = city_and_fields(256, 400, seed=5)
    noise = 0.005 * torch.randn(192, 336, generator=torch.Generator().manual_seed(5))
    frame, expected = (simulate_frames(scene, timing, each, 1, frame_size=(192, 336)) for each in (motion, still))
    model = model_of(frame + noise, timing, motion, noise=0.005)

    def at_ends(images):
        return torch.cat([images[..., 24:-24, :24], images[..., 24:-24, -24:]], -1)

    # the inner one of three strips ends where it has no weight
    of_three = frame_motion(motion.expanded(3), timing.in_row_order(), timing.frame_starts(1), 192)
    inner = model_frames(MovingFrames((frame + noise).expand(3, 1, 1, -1, -1), of_three, strips=3), noise=0.005)
    filled, not_filled = (psnr(at_ends(image), at_ends(expected[0]), 1.0) for image in solved(inner)[:2])
    assert filled > not_filled + 0.5
    assert inner.kinds(inner.scenes([([0], 0)])) == ["extension", "nothing", "extension"]
    torch.testing.assert_close(solved(model)[0], solved(inner)[0], rtol=0, atol=1e-5)


@pytest.mark.parametrize(("rows", "joint"), [(20, 2), (75, False)])
def test_a_batch_equals_single_stacks(rows, joint):
    """Two stacks of three frames of one period, one with a missing pixel."""
    timing = SensorTiming(row_time=1e-4, exposure_rows=rows, frame_rows=200)
    motions = [Vibration([size, 1.2], [53.0, 65.0], [0.4, 1.3]) for size in (3.0, 2.9)]
    scene = city_and_fields(176, 176, seed=5)
    frames = torch.stack([simulate_frames(scene, timing, motion, 3, frame_size=(96, 96)) for motion in motions])
    frames = frames + 0.01 * torch.randn(frames.shape, generator=torch.Generator().manual_seed(5))
    frames[1, 0, 40, 40] = float("nan")
    together = restore(frames[:, :, None], timing, Vibration.stacked(motions), joint=joint, check=False)
    for images, motion, found in zip(frames, motions, together[:, :, 0], strict=True):
        torch.testing.assert_close(found, restore(images, timing, motion, joint=joint, check=False), rtol=0, atol=1e-4)


@pytest.mark.parametrize("offset", [(0, 0), (1, 0), (1, 1)])
def test_patches_agree_with_a_loop_over_dct(offset):
    image = np.random.default_rng(0).standard_normal((71, 13))  # more rows than are shrunk at a time
    padded = np.pad(image, 8, mode="edge")
    total, weights = np.zeros_like(padded), np.zeros_like(padded)
    for row in range(offset[0], padded.shape[0] - 7, 2):
        for column in range(offset[1], padded.shape[1] - 7, 2):
            patch = fft.dctn(padded[row : row + 8, column : column + 8], norm="ortho")
            strong = abs(patch) > 2.0 * 0.6
            strong[0, 0] = True
            total[row : row + 8, column : column + 8] += fft.idctn(patch * strong, norm="ortho") / strong.sum()
            weights[row : row + 8, column : column + 8] += 1 / strong.sum()
    found = shrink_patches(torch.from_numpy(image)[None], 0.6, offset)[0].numpy()
    np.testing.assert_allclose(found, total[8:-8, 8:-8] / weights[8:-8, 8:-8], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("seed", "exposure_rows", "joint", "gain"),
    [(41, 20, False, 0.15), (41, 20, True, 0.15), (5, 100, False, 0.2), (5, 400, True, 0.2)],
)
def test_psnr_exceeds_that_of_the_gaussian_prior(seed, exposure_rows, joint, gain):
    scene, vibration = draw_scene(272, 240, seed=seed), Motion().vibration()
    timing = SensorTiming(row_time=20.52e-6, exposure_rows=exposure_rows, frame_rows=2048)
    frames = as_tensor(take_frames(scene, timing, Motion(), 2, 0.02))
    plain, kept = (quietly(frames, timing, vibration, joint=joint, prior=prior) for prior in ("gaussian", "edges"))
    assert kept.shape == plain.shape
    assert decibel(kept, crop(scene)) > decibel(plain, crop(scene)) + gain


def test_steps_have_less_overshoot_and_noise():
    scene = np.full((256, 256), 0.25)
    scene[128:] = 0.75
    scene = ndimage.gaussian_filter(scene, 0.8)
    timing = SensorTiming(row_time=20.52e-6, exposure_rows=100, frame_rows=2048)
    frames = as_tensor(take_frames(scene, timing, Motion(), 1, 0.02))
    plain, kept = (
        quietly(frames, timing, Motion().vibration(), prior=prior)[0].numpy() for prior in ("gaussian", "edges")
    )
    overshoots = []
    for image in (plain, kept):
        profile = image[32:-32, 32:-32].mean(1)
        overshoots.append(max(profile.max() - 0.75, 0.25 - profile.min()))
    assert overshoots[1] < overshoots[0]
    assert decibel(kept, crop(scene)) > decibel(plain, crop(scene)) + 4


def test_gradients_to_frames_and_flat_scenes():
    flat = torch.full((1, 48, 40), 0.37, dtype=torch.float64)
    kept = quietly(flat, TIMING, Vibration(1.0, 50.0), prior="edges", noise=0.05)
    assert (kept - 0.37).abs().max() < 1e-9
    frames = torch.rand(1, 24, 20, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    quietly(frames, TIMING, Vibration(1.0, 50.0), prior="edges", noise=0.05).square().sum().backward()
    assert torch.isfinite(frames.grad).all()
    assert frames.grad.abs().min() > 0


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
        ("dense texture", 20, 0.001, 2, True, -0.1, 0.35),
    ],
)
def test_estimated_strength_is_close_to_the_best(name, rows, noise, given, joint, least, within):
    timing = SensorTiming(row_time=20.52e-6, exposure_rows=rows, frame_rows=2048)
    scene = SCENES[name]()
    clean = take_frames(scene, timing, MOTION, 2)
    frames = torch.from_numpy(clean + noise * np.random.default_rng(3).standard_normal(clean.shape)).float()[:given]
    found = decibel(quietly(frames, timing, MOTION.vibration(), joint=joint)[0], crop(scene))
    stack = model_of(frames, timing, MOTION.vibration())
    by_hand = {
        factor: decibel(solved(stack, joint=joint, regularisation=factor)[0], crop(scene))
        for factor in (0.03, 0.1, 0.3, 1.0, 3.0)
    }
    assert found > max(by_hand.values()) - within
    assert found > by_hand[1.0] + least
    assert max(by_hand.values()) - min(by_hand.values()) > 0.5


def test_noise_of_bright_areas_is_removed():
    """Shot noise: the level is measured in the darkest areas, so that the prior of strength 1 is too weak."""
    timing = SensorTiming(row_time=20.52e-6, exposure_rows=100, frame_rows=2048)
    scene = np.clip(draw_scene(SIZE, SIZE, 14, blur=1.5), 0.02, 1.0)
    scene[:, : SIZE // 2] *= 0.1
    clean = take_frames(scene, timing, MOTION, 2)
    frames = torch.from_numpy(np.random.default_rng(3).poisson(400 * clean) / 400).float()
    found = decibel(quietly(frames, timing, MOTION.vibration())[0], crop(scene))
    by_hand = decibel(solved(model_of(frames, timing, MOTION.vibration()))[0], crop(scene))
    assert found > by_hand + 1


@pytest.mark.parametrize("count", [1, 2])
def test_power_of_pure_noise_is_close_to_zero(count):
    noise = torch.randn(count, 1, 512, 512, generator=torch.Generator().manual_seed(0))
    motion = frame_motion(MOTION.vibration().expanded(1), TIMING, TIMING.frame_starts(count), 512)
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
        restored = quietly(frames, TIMING, motion.vibration(), joint=joint, **options)
        return -10 * np.log10(np.mean((restored[0].numpy()[32:-32][:, ends] - truth) ** 2))

    assert quality() > 35  # 17 to 20 without the spectrum of whole rows in the prior
    assert quality(regularisation=1e4) < 30


def smooth_prior(u):
    """Correlation 0.9 of neighbouring rows at all frequencies (1, U), and innovations of variance 1."""
    reflections = torch.stack([torch.full_like(u, 0.9), torch.zeros_like(u)])
    return RowPrior(1 / (1 - reflections[0].square()), reflections, torch.zeros_like(u)[None])


@pytest.mark.parametrize("first", [torch.arange(90) // 2 * 2, torch.arange(90).clamp(min=85) * 4 - 340])
def test_observation_operator_is_a_sum_over_taps_and_has_this_adjoint(first):
    generator = torch.Generator().manual_seed(3)
    taps = torch.randn(1, 90, 6, 2, dtype=torch.float64, generator=generator)
    along, middle = 0.3 * torch.randn(2, 1, 90, 2, dtype=torch.float64, generator=generator)
    weight = torch.rand(1, 90, dtype=torch.float64, generator=generator)
    weight[0, ::7] = 0
    kernels = RowKernels(first[None], taps, middle[..., 0], along, weight)
    part, length = slice(2, 13), 40
    observation = Observation(kernels, 90, length, torch.float64)
    u = torch.arange(part.start, part.stop, dtype=torch.float64) / length
    data = torch.randn(1, 1, 2, 90, 11, dtype=torch.complex128, generator=generator)
    coefficients = torch.randn(observation.count, 2, 1, 11, dtype=torch.complex128, generator=generator)
    observed = observation.forward(coefficients, part)
    turned = kernels.at(u)[0] * torch.exp(-2j * torch.pi * u * middle[0, :, :1])[:, None]
    for row in (0, 8, 44, 89):
        place = int(first[row]) - observation.top
        expected = (turned[row, :, None] * coefficients[place : place + 6, :, 0]).sum(0)
        torch.testing.assert_close(observed[0, 0, :, row], expected, rtol=1e-9, atol=1e-9)
    back = observation.adjoint(data, part)
    left = (weight[:, None, :, None] * observed.conj() * data).sum()
    torch.testing.assert_close(left, (coefficients.conj() * back).sum(), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("reach", [0.0, 0.4, 1.4])
def test_fast_path_agrees_with_the_plain_path(reach):
    """The plain path is used where the precision requires its gradient."""
    generator = torch.Generator().manual_seed(4)
    rows, length = 60, 1200
    taps = torch.rand(1, rows, 6, 2, dtype=torch.float64, generator=generator) / 6
    along = torch.linspace(-reach, reach, 2, dtype=torch.float64).expand(1, rows, 2)
    first = torch.arange(rows)[None] - 2
    kernels = RowKernels(first, taps, torch.zeros(1, rows, dtype=torch.float64), along, torch.ones_like(first).double())
    observation = Observation(kernels, rows, length, torch.float64)
    u = torch.fft.rfftfreq(length, dtype=torch.float64)[None]
    precision = smooth_prior(u).precision(0.01 * (1 + (10 * u).square()))
    data = torch.randn(1, 1, 1, rows, length, dtype=torch.float64, generator=generator)
    fast = SceneSolver(observation, precision).fit(data)
    plain = SceneSolver(observation, precision.clone().requires_grad_()).fit(data)
    assert plain.requires_grad
    difference = (fast - plain.detach()).abs().square().mean().sqrt() / plain.detach().abs().square().mean().sqrt()
    assert 1e-12 < difference < 1e-2  # interpolated, not factored: white noise is the least favourable data
    repeated = SceneSolver(observation, precision, keep=True)
    for _ in range(2):
        torch.testing.assert_close(repeated.fit(data), plain.detach())
