import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from benchmarks.honesty_cases import recording
from benchmarks.resolution_chart import resolution_chart
from scipy import ndimage
from small_video import write_video
from truth import Curve, Motion, draw_scene, recorded, take_frames, tone_errors

from rsvib_torch import SensorNoise, SensorTiming, Vibration, detect_vibration, read_stack, simulate_frames
from rsvib_torch.datasets import city_and_fields


def check(result, motion, period, amplitude, phase):
    """The result is reliable, and its errors are smaller than these limits: period %, amplitude %, phase in pi."""
    assert result.reliable.all(), result.reasons
    largest = tone_errors(result.vibration, motion).amax(-1)
    assert bool((largest < torch.tensor([period, amplitude, phase])).all()), largest


def largest_error(found, motion):
    """Of the amplitudes, in standard deviations."""
    error = found.vibration.amplitude[:, 0].numpy() - np.array(motion.amplitude)
    return np.abs(error / found.std.amplitude[:, 0].numpy()).max()


SMALL = Motion((0.2, 0.13), (155.0, 155.0), (0.8, -2.6))
PAPER = SensorTiming(row_time=20.52e-6, exposure_rows=20, frame_rows=2048)
SHORT = SensorTiming(row_time=6e-5, exposure_rows=2, frame_rows=270)
NEAR_BLIND = SensorTiming(row_time=1.41531e-4, exposure_rows=3.178, frame_rows=294.4)


def case(motion, *limits, size=(2048, 256), camera=PAPER, count=2, seed=41):
    return motion, limits, size, camera, count, seed


FAST = Motion((0.9, 3.7), (0.73 * SHORT.frame_rate, 3.49 * SHORT.frame_rate), (0.3, 1.0))
OVER_BLIND = Motion((3.125, 3.156), (57.225, 31.645), (2.699, -2.477))
BESIDE = Motion((0.05, 5.2), (3 * PAPER.frame_rate + 30.0, 30.0), (0.4, 1.3))
CASES = {
    "paper": case(Motion(phase=(-2.1, 0.3)), 0.01, 0.15, 0.001, size=(2048, 512)),
    "small": case(SMALL, 0.1, 1.0, 0.01, size=(2048, 512)),
    "push-scan": case(Motion((1.2, 0.8), (83.0, 110.0), (2.7, 0.2), (500.0, 0.0)), 0.03, 0.2, 0.002),
    # bands that move by pixels within their height contain twice its frequency, seven times the frame rate
    "fast tone along the scan": case(FAST, 0.01, 0.1, 0.001, size=(240, 200), camera=SHORT, count=8, seed=12),
    "weak tone at the frequency of a side tone": case(BESIDE, 0.3, 5.0, 1.0, seed=65),
    # the bands contain 57 Hz as a tone that is nearly blind, and too large by 100 px
    "contradicted bands": case(OVER_BLIND, 0.1, 0.2, 0.01, size=(256, 256), camera=NEAR_BLIND, seed=139),
}


@pytest.mark.parametrize("name", CASES)
def test_direct_at_the_limit(name):
    motion, limits, size, camera, count, seed = CASES[name]
    result = detect_vibration(recorded(size, camera, motion, count, 0.005, seed=seed), camera, method="direct")
    assert result.vibration.amplitude.shape == (2, 1)
    check(result, motion, *limits)


@pytest.mark.parametrize(("num_frames", "turned"), [(2, False), (10, True)])  # 10 frames are compared in two groups
def test_offsets_of_the_direct_method_are_its_measurements(num_frames, turned):
    """They differ from the true offsets, and from the fitted ones, by their standard deviations."""
    timing = SensorTiming(row_time=4e-5, exposure_rows=12, frame_rows=300)
    motion = Motion((1.6, 1.1), (71.0, 113.0), (0.6, -1.2))
    frames = torch.from_numpy(take_frames(draw_scene(336, 272, 4), timing, motion, num_frames, noise=0.01)).float()
    if turned:
        frames = frames.transpose(-2, -1).flip(-1).contiguous()
        timing = replace(timing, scan_axis="x", readout_direction="reverse")
    result = detect_vibration(frames, timing)
    curve = result.offsets
    assert curve.pairs.tolist() == [[frame, frame + 1] for frame in range(num_frames - 1)]
    assert curve.times.shape == (num_frames - 1, 32)
    middles = (times.numpy() + 0.5 * timing.exposure_time for times in (curve.times, curve.later_times))
    before, after = map(motion.displacement, middles)
    attenuation = np.sinc(np.array(motion.frequency) * timing.exposure_time)
    truth = torch.from_numpy((after - before) * attenuation)
    if turned:
        truth = torch.stack([-truth[..., 1], truth[..., 0]], -1)
    good = curve.quality > 0.2
    assert good.double().mean() > 0.7
    for predicted in (truth, result.fitted):
        error = ((curve.offsets - predicted) / curve.std)[good]
        size = error.square().mean(0).sqrt()
        assert ((size > 0.7) & (size < 1.3)).all()
    assert (curve.offsets - truth).abs()[good].mean() < 0.03 * truth.abs().mean()
    inside = curve.good  # the fitted curve also predicts the rows that were not measured
    assert (result.fitted - truth).abs().amax() < 3 * (result.fitted - truth).abs()[inside].amax() + 1e-3
    torch.testing.assert_close((curve.offsets - result.fitted)[inside].abs().mean(0), result.residual)


def test_outliers_among_the_measured_offsets_have_quality_0():
    timing = SensorTiming(row_time=4e-5, exposure_rows=12, frame_rows=300)
    motion = Motion((1.6, 1.1), (71.0, 113.0), (0.6, -1.2))
    frames = take_frames(draw_scene(336, 272, 4), timing, motion, 2, noise=0.01)
    frames[1, 64:96] = np.roll(frames[1, 64:96], 3, axis=1)  # an object that moves by itself
    curve = detect_vibration(torch.from_numpy(frames).float(), timing).offsets
    moved = (curve.rows > 68) & (curve.rows < 92)
    assert curve.quality[0, moved].amax() < 0.1
    assert curve.quality[0, ~moved & curve.good[0]].mean() > 0.7


@pytest.mark.parametrize(
    ("size", "seed", "noise"),
    [((2048, 512), 7, 0.001), ((1024, 1024), 66, 0.005)],  # one period of x and less of y in the second
)
def test_long_exposures(paper_camera, size, seed, noise):
    """Blur adds no tone; 0.01 px of kernels that differ between rows change the amplitude by 0.04 px."""
    camera, motion = replace(paper_camera, exposure_rows=400), Motion(phase=(-1.386, -1.422))
    found = detect_vibration(recorded(size, camera, motion, 2, noise, seed=seed), camera)
    amplitude, std = found.vibration.amplitude[:, 0].numpy(), found.std.amplitude[:, 0].numpy()
    wrong = np.abs(amplitude - np.array(motion.amplitude))
    assert found.vibration.amplitude.shape == (2, 1)
    assert all(found.reliable)
    assert (wrong < np.array([0.012, 0.002]) * amplitude).all()
    assert (std < np.array([0.015, 0.03]) * amplitude).all()  # less than a period: two tones are not excluded
    assert (wrong < 4 * std).all()
    np.testing.assert_allclose(found.vibration.frequency[:, 0], motion.frequency, rtol=1e-3)


def tall_frames(camera, exposure_rows, motion, seed, columns, num_frames):
    """Frames of 768 rows with noise 0.001, and their camera."""
    exposed = replace(camera, exposure_rows=exposure_rows)
    return recorded((768, columns), exposed, motion, num_frames, 0.001, seed=seed), exposed


def test_fast_vibration_with_different_blur_in_each_frame(paper_camera):
    """Curved paths of 1.7 px that are similar in all frames: their effect on detail is corrected."""
    motion = Motion((1.2, 0.8), (188.3, 170.7), (0.4, -1.0))
    found = detect_vibration(*tall_frames(paper_camera, 60, motion, 1, 384, 6))
    wrong = (found.vibration.amplitude[:, 0] - motion.vibration().amplitude[:, 0]).abs()
    assert found.reliable.all(), found.reasons
    assert float(wrong.max()) < 0.0015, wrong


def test_residual_tones_do_not_make_the_true_tone_unreliable(paper_camera):
    """Twelve frames measure tones of 0.005 px, which are residuals of blur and interpolation."""
    motion = Motion((1.2, 0.8), (188.3, 170.7), (0.8, -1.0))
    found = detect_vibration(*tall_frames(paper_camera, 60, motion, 2, 256, 12))
    assert found.reliable.all(), found.reasons


def test_almost_blind_tone_does_not_displace_frames(paper_camera):
    """Seven times the frame rate is 166.55 Hz: x is almost blind; y is detected."""
    motion = Motion((0.57, 0.53), (166.9, 191.5), (0.4, -1.0))
    found = detect_vibration(*tall_frames(paper_camera, 150, motion, 1, 384, 2))
    assert not found.reliable[0]
    assert found.reliable[1], found.reasons
    assert float(found.vibration.amplitude[0].max()) < 5.0


def test_alias_on_the_other_side_of_a_blind_frequency_is_corrected(paper_camera):
    """Bands of a sharp chart give 44.6 Hz, which mirrors 50 Hz at the blind frequency 2 / (m T_row) = 47.6 Hz."""
    camera = replace(paper_camera, exposure_rows=400)
    motion = Motion((3.1, 5.2), (50.0, 30.0), (-1.386, -1.422))
    chart = resolution_chart(1104, 1104, seed=7).double().numpy()
    frames = take_frames(chart, camera, motion, 2, 0.005, seed=7)
    found = detect_vibration(torch.from_numpy(frames).float(), camera)
    assert found.reliable[1]  # the displacement along x is uncertain by 4 %, which is the limit
    np.testing.assert_allclose(found.vibration.amplitude[:, 0], motion.amplitude, rtol=0.03)
    np.testing.assert_allclose(found.vibration.frequency[:, 0], motion.frequency, rtol=2e-3)


def test_amplitude_of_a_blind_tone_caused_by_blur_does_not_diverge():
    """400 rows exposure of a sharp chart without noise: a tone of 23.8 Hz (gain 0) would grow to 1000 px."""
    timing = SensorTiming(row_time=20.52e-6, exposure_rows=400, frame_rows=2048)
    generator = torch.Generator().manual_seed(7)
    phase = (2 * torch.rand(2, generator=generator, dtype=torch.float64) - 1) * math.pi
    scene = resolution_chart(2048 + 96, 512 + 96, seed=7)
    frames = simulate_frames(scene, timing, Vibration([3.1, 5.2], [50.0, 30.0], phase), 2, frame_size=(2048, 512))
    found = detect_vibration(frames, timing)
    assert found.reliable.all()
    assert found.vibration.amplitude[:, 0].tolist() == pytest.approx([3.1, 5.2], rel=0.01)
    assert found.vibration.frequency[:, 0].tolist() == pytest.approx([50.0, 30.0], rel=0.001)


def test_standard_deviations_of_groups_of_unequal_size():
    """Ten frames make groups of five and six: the frame that the smaller group lacks is not an error."""
    camera = SensorTiming(row_time=163e-6, exposure_rows=3, frame_rows=256)
    motion = Motion(phase=(0.4, -1.9))
    frames = recorded((256, 192), camera, motion, 10, 0.01, seed=44)
    found = detect_vibration(frames, camera, tones=1)
    assert bool((found.std.amplitude < 0.005).all()), found.std.amplitude
    assert largest_error(found, motion) < 4


def test_still_camera_and_blind_frequency_are_refused(paper_camera):
    still = recorded((2048, 256), paper_camera, Motion((0.0, 0.0), (0.0, 0.0), (0.0, 0.0)), 2, 0.005, seed=44)
    result = detect_vibration(still, paper_camera, method="direct")
    assert not result.reliable.any()
    assert bool((result.vibration.amplitude == 0).all())
    blind = 1 / paper_camera.frame_period
    frames = recorded((2048, 256), paper_camera, Motion((2.0, 1.0), (blind, 90.0), (0.4, 1.0)), 2, 0.005, seed=45)
    result = detect_vibration(frames, paper_camera, method="direct")
    assert result.reliable.tolist() == [False, True]
    assert result.vibration.frequency[1, 0].item() == pytest.approx(90.0, rel=2e-3)


def with_missing(frames, random):
    """Scattered pixels, two rows and a column."""
    missing = np.broadcast_to(random.random(frames.shape[-2:]) < 0.05, frames.shape).copy()
    missing[:, 500:502] = missing[:, :, 130] = True
    return np.where(missing, np.nan, frames)


def vignetting(frames):
    y, x = (np.linspace(-1, 1, size) for size in frames.shape[-2:])
    return frames * (1 - 0.25 * (y[:, None] ** 2 + x**2))


def with_weak_detail(frames):
    """A third of the rows has very low contrast."""
    rows = np.arange(frames.shape[-2])[:, None]
    return 0.5 + (frames - 0.5) * np.where((rows >= 900) & (rows < 1500), 0.01, 1.0)


DISTURBANCES = {
    "other contrast": lambda frames, _: np.stack([frames[0], 1.2 * frames[1] - 0.1]),
    "vignetting": lambda frames, _: vignetting(frames),
    "pattern of columns": lambda frames, random: frames + 0.005 * random.standard_normal(frames.shape[-1]),
    "missing pixels": with_missing,
    "ignored pixels": lambda frames, _: np.where(BAD, 1.0, frames),
    "clipped highlights": lambda frames, _: np.minimum(frames, np.quantile(frames, 0.95)),
    "weak detail": lambda frames, _: with_weak_detail(frames),
}
BAD = np.random.default_rng(60).random((2048, 320)) < 0.02


@pytest.fixture(scope="module")
def clean_pair(paper_camera):
    return take_frames(draw_scene(2128, 400, 52), paper_camera, SMALL, 2)


@pytest.mark.parametrize("name", DISTURBANCES)
def test_disturbed_frames(clean_pair, paper_camera, name):
    random = np.random.default_rng(60)
    frames = DISTURBANCES[name](clean_pair, random)
    frames = torch.from_numpy(frames + 0.003 * random.standard_normal(frames.shape)).float()
    result = detect_vibration(frames, paper_camera, ignore=BAD if name == "ignored pixels" else None)
    assert result.vibration.amplitude.shape == (2, 1)
    check(result, SMALL, 0.1, 1.0, 0.01)


def test_side_tones_of_a_blind_tone_are_not_reported_as_tones(paper_camera):
    """Motion along the scan axis makes a blind tone visible at its frequency plus and minus that of the motion."""
    blind = 3 / paper_camera.frame_period
    motion = Motion((1.6, 5.2), (blind, 30.0), (0.4, 1.3))
    frames = recorded((2048, 256), paper_camera, motion, 2, 0.005, seed=64)
    result = detect_vibration(frames, paper_camera)
    assert result.reliable.tolist() == [False, True]
    (reason,) = (reason for reason in result.findings[0] if reason.code == "tone_blind")
    assert reason.value < reason.limit == 0.3  # two frames
    assert abs(float(result.vibration.frequency[0, 0]) - blind) < 1.0
    assert (result.vibration.amplitude[0] > 0).sum() == 1


def test_moving_cloud_over_a_fifth_of_the_rows(paper_camera):
    """Slow tones are measured on the other rows."""
    motion, top, move = Motion((3.1, 5.2), (50.0, 30.0), (0.7, 2.1)), 120, (-4, -6)
    frames = take_frames(draw_scene(2128, 336, 61), paper_camera, motion, 2)
    tall, wide = frames.shape[-2] // 5, frames.shape[-1]
    cloud = draw_scene(tall + 20, wide + 20, 62)
    frames[0, top : top + tall] = cloud[10 : 10 + tall, 10 : 10 + wide]
    frames[1, top : top + tall] = cloud[10 - move[1] : 10 - move[1] + tall, 10 - move[0] : 10 - move[0] + wide]
    frames = frames + 0.005 * np.random.default_rng(63).standard_normal(frames.shape)
    result = detect_vibration(torch.from_numpy(frames).float(), paper_camera)
    assert result.vibration.amplitude.shape == (2, 1)
    check(result, motion, 0.05, 1.0, 0.01)


def test_image_motion_of_almost_half_a_frame():
    """Only the area visible in both frames is used; the blur by the image motion is small in short exposures."""
    camera = SensorTiming(20.52e-6, 10, 1100)
    move, margin = (-0.2 * 700 / camera.frame_period, -0.45 * 1000 / camera.frame_period), 640
    motion = Motion((1.2, 0.9), (330.0, 260.0), (0.4, -1.0), move)
    frames = recorded((1000, 700), camera, motion, 2, 0.003, seed=53, margin=margin)
    result = detect_vibration(frames, camera)
    check(result, motion, 0.1, 2.0, 0.01)
    torch.testing.assert_close(result.vibration.image_motion, torch.tensor(move).double(), rtol=0, atol=0.5)


def test_uneven_frame_times_measure_a_blind_frequency(paper_camera):
    blind = 1 / paper_camera.frame_period
    motion = Motion((2.0, 1.0), (blind, 90.0), (0.4, 1.0))
    scene = draw_scene(2128, 336, 54)
    starts = [0.0, paper_camera.frame_period, 2.37 * paper_camera.frame_period]
    uneven = replace(paper_camera, frame_start_times=starts)
    pairs = (replace(paper_camera, frame_rows=start / paper_camera.row_time) for start in starts[1:])
    later = [take_frames(scene, timing, motion, 2)[1:] for timing in pairs]
    frames = np.concatenate([take_frames(scene, paper_camera, motion, 1), *later])
    frames = torch.from_numpy(frames + 0.003 * np.random.default_rng(4).standard_normal(frames.shape)).float()
    result = detect_vibration(frames, uneven)
    check(result, motion, 0.02, 0.3, 0.002)


def test_multiples_of_a_frequency_are_found_as_tones(paper_camera):
    amplitude, frequency = np.array([[2.0, 0.5, 0.2], [1.0, 0.3, 0.1]]), np.array([[37.0], [61.0]]) * [1, 2, 3]
    phase = np.array([[0.1, 0.2, 0.3], [1.0, 2.0, 3.0]])
    motion = Curve(lambda t: (amplitude * np.sin(2 * np.pi * frequency * t[..., None, None] + phase)).sum(-1))
    found = detect_vibration(recorded((2048, 256), paper_camera, motion, 3, 0.005, seed=55), paper_camera).vibration
    assert found.amplitude.shape == (2, 3)
    assert (found.frequency / torch.from_numpy(frequency) - 1).abs().max() < 5e-4
    assert (found.amplitude / torch.from_numpy(amplitude) - 1).abs().max() < 0.02


def test_accelerated_image_motion(paper_camera):
    steady = Motion(phase=(0.7, 2.1), image_motion=(200.0, -300.0))
    motion = Curve(lambda t: steady.displacement(t) + np.array([450.0, -750.0]) * t[..., None] ** 2)
    scene = draw_scene(1024 + 200, 192 + 200, 56)
    frames = take_frames(scene, paper_camera, motion, 4, 0.005, seed=6, margin=100)
    frames = torch.from_numpy(frames).float()
    result = detect_vibration(frames, paper_camera, image_acceleration=True)
    assert result.reliable.all(), result.reasons
    found = result.vibration
    torch.testing.assert_close(found.image_acceleration, torch.tensor([900.0, -1500.0]).double(), rtol=0, atol=5.0)
    torch.testing.assert_close(found.image_motion, torch.tensor([200.0, -300.0]).double(), rtol=0, atol=0.5)
    assert (found.amplitude[:, 0] / torch.tensor([3.1, 5.2]) - 1).abs().max() < 0.005
    # without an acceleration, a slow tone of uncertain amplitude takes its place; the displacement is known
    slow = detect_vibration(frames, paper_camera)
    starts = paper_camera.row_starts(4, 1024)
    shown, true = (v.mean_displacement(starts, paper_camera.exposure_time) for v in (slow.vibration, found))
    error = shown - true - (shown - true).mean((0, 1))
    assert (error.square().mean((0, 1)).sqrt() < 5 * slow.std.displacement + 0.05).all()


def test_narrow_frames_of_a_rotating_camera_are_refused():
    """The halves of 128 columns are too narrow to measure roll, and tones do not explain these frames."""
    generator = np.random.default_rng(0)
    scene, middle = draw_scene(260, 260, 3), np.array([130.0, 130.0])
    frames = []
    for shift, angle in zip(
        generator.normal(0, 3, (8, 2)).cumsum(0), generator.normal(0, 0.02, 8).cumsum(), strict=True
    ):
        turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        frames.append(ndimage.affine_transform(scene, turn, middle - turn @ middle + shift, order=1)[66:194, 66:194])
    noise = 0.003 * generator.standard_normal((8, 128, 128))
    timing = SensorTiming(row_time=1 / (30 * 128), exposure_rows=5, frame_rows=128)
    found = detect_vibration(torch.from_numpy(np.stack(frames) + noise).float(), timing, tones=1)
    assert not found.reliable.any()
    assert found.vibration.num_axes == 2


def test_a_tone_is_not_taken_for_one_that_is_a_multiple_of_the_frame_rate_away():
    """Bands explain the tone of 90.5 Hz by 30.2 Hz as well, and rows by 30.2, 150.9 and 271.4 Hz."""
    timing = SensorTiming(row_time=4e-5, exposure_rows=20, frame_rows=416.6667)  # 60 frames per second
    vibration = Vibration([[1.2, 0.4], [0.7, 0.0]], [[137.0, 411.0], [90.5, 0.0]])
    noise, seed = SensorNoise(read_noise=0.005), torch.Generator().manual_seed(0)
    scene = city_and_fields(200, 200, seed=3)
    frames = simulate_frames(scene, timing, vibration, num_frames=30, noise=noise, generator=seed)
    found = detect_vibration(frames[12:20], timing)
    assert found.reliable.all(), found.reasons
    assert found.vibration.frequency[1].tolist() == [pytest.approx(90.5, abs=0.1), 0.0]


def test_amplitudes_in_encoded_video_are_within_their_standard_deviations(tmp_path):
    """H.264 makes them smaller by up to 0.02 px, 4 to 5 standard deviations of independent errors of the rows."""
    seed, motion = 2, Motion((1.154, 1.246), (76.996, 26.434), (0.601, 1.371))
    timing = SensorTiming(row_time=1e-4, exposure_rows=5, frame_rows=330)
    clean = take_frames(draw_scene(400, 400, seed), timing, motion, 8, 0.005, seed=seed)
    levels = np.repeat((255 * clean).clip(0, 255).round().astype(np.uint8)[..., None], 3, -1)
    times, encoder = timing.frame_period * np.arange(8), {"crf": "23"}
    write_video(tmp_path / "a.mp4", levels, times, layout="rgb24", codec="libx264", encoded="yuv420p", options=encoder)
    found = detect_vibration(read_stack(tmp_path / "a.mp4"), timing)
    assert found.reliable.all(), found.reasons
    assert largest_error(found, motion) < 3
    assert (found.std.amplitude[:, 0] < 0.02).all()


def test_rows_without_content_do_not_decide():
    """Black bars have no noise: their rows had the largest weights, and an image motion of 0.8 px/s was found."""
    motion = Motion((3.0, 2.0), (50.0, 71.0), (0.5, 1.0))
    timing = SensorTiming(row_time=3e-5, exposure_rows=33.3, frame_rows=555.556)
    frames = take_frames(draw_scene(440, 440, 4), timing, motion, 4, 0.004, seed=4)
    height = frames.shape[1] // 9
    frames[:, :height] = frames[:, -height:] = 0.0
    found = detect_vibration(torch.from_numpy(frames).float(), timing)
    assert found.reliable.all(), found.reasons
    assert largest_error(found, motion) < 4
    assert found.vibration.image_motion.abs().max() < 0.2


@pytest.mark.parametrize("number", [46, 86])
def test_frames_that_are_compared_at_a_wrong_place_are_not_reliable(number):
    """Streets repeat: offsets of 28 px were taken for 50 px and 140 px, and these axes were reliable."""
    taken = recording("large amplitude", number, 256)
    found = detect_vibration(torch.from_numpy(taken.frames).float(), taken.timing)
    for axis, tones in enumerate(taken.case.tones):
        amplitude = float(found.vibration.amplitude[axis, 0])
        assert not bool(found.reliable[axis]) or amplitude == pytest.approx(tones[0, 0], rel=0.02)


@pytest.mark.parametrize("number", [7101, 7104])
def test_tones_that_differ_by_less_than_a_period_within_the_record_are_resolved(number):
    """Two tones 3 Hz apart in four frames, half a period: one of them with the rest of the other is refused."""
    taken = recording("close pair, 3 Hz apart", number, 224)
    found = detect_vibration(torch.from_numpy(taken.frames).float(), taken.timing)
    assert found.reliable.all(), found.reasons
    for axis, tones in enumerate(taken.case.tones):
        order = found.vibration.frequency[axis, :2].argsort()
        for values, std, true in (
            (found.vibration.frequency, found.std.frequency, tones[:, 1]),
            (found.vibration.amplitude, found.std.amplitude, tones[:, 0]),
        ):
            error = (values[axis, :2][order].numpy() - true[tones[:, 1].argsort()]) / std[axis, :2][order].numpy()
            assert np.abs(error).max() < 4


@pytest.mark.parametrize("method", ["direct", "bands"])
def test_the_cycles_within_a_long_gap_are_right_or_in_doubt(method):
    # frequencies were wrong by one cycle within the gap, 1000 standard deviations, on 3 of the axes with "direct"
    row_time, rows, known = 1e-4, 180, 0
    for seed in (1, 2, 11, 12):
        draw = np.random.default_rng(seed)
        count = int(draw.choice([4, 6, 8]))
        first, gap = int(draw.integers(1, count - 1)), int(draw.integers(5, 150))
        frequency, size, phase = (draw.uniform(*ends, 2) for ends in ((60, 200), (0.8, 3), (0, 6)))
        starts = np.cumsum([0] + [1 if index != first else gap for index in range(1, count)]) * rows * row_time

        def displacement(times, *tones, starts=starts):
            index = np.clip(np.floor(times / (rows * row_time) + 1e-9).astype(int), 0, len(starts) - 1)
            seconds = starts[index] + times - index * rows * row_time  # the camera has equal intervals
            return np.stack([a * np.sin(2 * np.pi * f * seconds + p) for a, f, p in zip(*tones, strict=True)], -1)

        camera = SensorTiming(row_time=row_time, exposure_rows=8, frame_rows=rows)
        motion = Curve(lambda times, tones=(size, frequency, phase): displacement(times, *tones))
        frames = take_frames(draw_scene(240, 240, seed), camera, motion, count, 0.005, seed=seed)
        gapped = replace(camera, frame_start_times=tuple(starts.tolist()))
        found = detect_vibration(torch.from_numpy(frames).float(), gapped, method=method)
        strongest = found.vibration.amplitude.argmax(-1)
        for axis in np.flatnonzero(found.reliable.numpy()):
            both = (found.vibration.frequency, found.std.frequency)
            measured, std = (values[axis, strongest[axis]].item() for values in both)
            assert abs(measured - frequency[axis]) < 6 * std
            known += 1
    assert known >= {"direct": 3, "bands": 0}[method]
