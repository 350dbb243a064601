import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from truth import Motion, recorded, tone_errors

from rsvib_torch import SensorTiming, detect_vibration

METHODS = ("projection", "ncc", "phase")
NOISE = 0.003
# error bounds of each registration for the pair of the paper: period %, amplitude %, phase in pi
LIMITS = {"projection": (1.0, 2.0, 0.05), "ncc": (0.15, 1.0, 0.004), "phase": (0.15, 1.5, 0.004)}


def detect_bands(frames, timing, **options):
    return detect_vibration(frames, timing, **{"method": "bands", **options})


def random_phase(seed):
    return tuple(np.random.default_rng([7, seed]).uniform(-np.pi, np.pi, 2).tolist())


def phase_error(measured, truth):
    """Difference of two phases, wrapped to -pi ... pi."""
    return np.abs((np.asarray(measured) - np.asarray(truth) + np.pi) % (2 * np.pi) - np.pi)


def check(result, motion, *limits):
    largest = tone_errors(result.vibration, motion).amax(-1)
    assert bool((largest < torch.tensor(limits)).all()), largest


def codes(result):
    """Codes of the reasons against each axis."""
    return [[reason.code for reason in of_axis] for of_axis in result.findings]


@pytest.fixture(scope="module")
def pairs(paper_camera):
    """Two pairs of frames of the case of the paper, with their motions."""
    motions = {seed: Motion(phase=random_phase(seed)) for seed in (11, 12)}
    return [(recorded((2048, 384), paper_camera, one, 2, NOISE, seed=seed), one) for seed, one in motions.items()]


@pytest.mark.parametrize("registration", METHODS)
def test_paper_pair(pairs, paper_camera, registration):
    frames, motion = pairs[0]
    result = detect_bands(frames, paper_camera, registration=registration)
    check(result, motion, *LIMITS[registration])
    assert result.vibration.amplitude.shape == (2, 1)
    assert result.reliable.tolist() == [True, True]
    assert result.findings == ((), ())
    # 50 Hz has the gain +0.62, 30 Hz the gain -1.46: amplitudes stay positive, the sign is in the phase
    assert result.gain[:, 0].tolist() == pytest.approx([0.626, -1.461], abs=0.03)
    assert bool((result.vibration.amplitude > 0).all())
    good = result.offsets.good
    difference = (result.offsets.offsets - result.fitted)[good].abs().mean(0)
    assert torch.allclose(difference, result.residual, rtol=1e-9)
    size = result.offsets.offsets[good].abs().mean(0)
    assert bool((result.residual < 0.06 * size).all())


def test_image_motion_is_separated(paper_camera):
    motion = Motion(phase=random_phase(5), image_motion=(500.0, -240.0))
    frames = recorded((2048, 384), paper_camera, motion, 2, NOISE, seed=5, margin=60)
    result = detect_bands(frames, paper_camera)
    check(result, motion, *LIMITS["ncc"])
    assert result.vibration.image_motion.tolist() == pytest.approx([500.0, -240.0], abs=3.0)
    assert bool(result.reliable.all())


def test_no_tone_is_detected_without_vibration(paper_camera):
    image_motion = (300.0, 150.0)
    motion = Motion(amplitude=(0.0, 0.0), image_motion=image_motion)
    frames = recorded((2048, 384), paper_camera, motion, 2, NOISE, seed=4, margin=60)
    result = detect_bands(frames, paper_camera)
    assert bool((result.vibration.amplitude == 0).all())
    assert result.reliable.tolist() == [False, False]
    assert all("no_tone" in {reason.code for reason in of_axis} for of_axis in result.findings)
    assert result.vibration.image_motion.tolist() == pytest.approx(image_motion, abs=2.0)


@pytest.mark.parametrize("registration", METHODS)
def test_frames_of_noise_are_not_reliable(paper_camera, registration):
    frames = torch.randn(2, 1024, 256, generator=torch.Generator().manual_seed(1))
    result = detect_bands(frames, paper_camera, registration=registration)
    assert not bool(result.reliable.any())


def test_number_of_tones_can_be_set(pairs, paper_camera):
    frames, motion = pairs[0]
    result = detect_bands(frames, paper_camera, tones=2)
    assert result.vibration.amplitude.shape == (2, 2)
    assert result.vibration.amplitude[:, 0].numpy() == pytest.approx(np.array(motion.amplitude), rel=0.05)
    assert bool((result.vibration.amplitude[:, 1] < 0.1 * result.vibration.amplitude[:, 0]).all())


def test_batch_equals_single_stacks():
    timing = SensorTiming(row_time=40e-6, exposure_rows=10, frame_rows=1100)
    stacks = []
    for seed in (1, 2):
        motion = Motion(phase=random_phase(seed), frequency=(61.0, 47.0 + seed))
        grey = recorded((640, 256), timing, motion, 2, NOISE, seed=seed)
        stacks.append(torch.stack([grey, 0.5 * grey, 0.2 + grey], dim=1))
    together = detect_bands(torch.stack(stacks), timing)
    assert together.vibration.batch_shape == (2,)
    for index, stack in enumerate(stacks):
        alone = detect_bands(stack, timing)
        one = together[index]
        for name in ("amplitude", "frequency", "phase", "image_motion"):
            torch.testing.assert_close(
                getattr(one.vibration, name), getattr(alone.vibration, name), rtol=1e-4, atol=1e-5, msg=name
            )
            torch.testing.assert_close(getattr(one.std, name), getattr(alone.std, name), rtol=1e-3, atol=1e-6)
        torch.testing.assert_close(one.offsets.offsets, alone.offsets.offsets, rtol=0, atol=1e-4, equal_nan=True)
        torch.testing.assert_close(one.fitted, alone.fitted, rtol=0, atol=1e-4)
        assert codes(one) == codes(alone)
        assert one.reliable.tolist() == alone.reliable.tolist()


def test_frames_with_little_overlap_do_not_affect_the_other_stacks_of_a_batch():
    timing, motion = SensorTiming(row_time=40e-6, exposure_rows=20, frame_rows=300), Motion(frequency=(110.0, 90.0))
    distance = 110  # px of 150
    wide = recorded((280, 150 + distance), timing, motion, 2, NOISE, seed=5)
    apart = torch.stack([wide[0, :, :150], wide[1, :, distance:]])
    together = detect_vibration(torch.stack([apart, wide[:, :, :150]])[:, :, None], timing, search=8)
    alone = detect_vibration(wide[:, :, :150], timing, search=8)
    assert together.reliable.tolist() == [[False, False], [True, True]]
    amplitude = together[1].vibration.amplitude[:, :1]  # the other stack may have more tones
    torch.testing.assert_close(amplitude, alone.vibration.amplitude, rtol=0, atol=0.02)  # px


@pytest.mark.parametrize("scan_axis", [-2, -1])
def test_orientation(pairs, paper_camera, scan_axis):
    """The result for flipped and transposed frames is the flipped and transposed result."""
    frames, motion = pairs[0]
    upright = detect_bands(frames, paper_camera)
    turned = frames.flip(-2) if scan_axis == -2 else frames.flip(-2).transpose(-2, -1)
    timing = replace(paper_camera, scan_axis=scan_axis, readout_direction="reverse")
    result = detect_bands(turned.contiguous(), timing)

    sign, order = torch.tensor([1.0, -1.0], dtype=torch.float64), [0, 1] if scan_axis == -2 else [1, 0]
    expected_phase = (upright.vibration.phase + torch.tensor([[0.0], [math.pi]]))[order]
    torch.testing.assert_close(result.vibration.amplitude, upright.vibration.amplitude[order], rtol=1e-4, atol=0)
    torch.testing.assert_close(result.vibration.frequency, upright.vibration.frequency[order], rtol=1e-5, atol=0)
    assert phase_error(result.vibration.phase, expected_phase).max() < 1e-4
    torch.testing.assert_close(
        result.vibration.image_motion, (sign * upright.vibration.image_motion)[order], rtol=0, atol=1e-3
    )
    torch.testing.assert_close(result.std.amplitude, upright.std.amplitude[order], rtol=1e-3, atol=0)
    torch.testing.assert_close(result.gain, upright.gain[order], rtol=1e-4, atol=0)
    torch.testing.assert_close(result.residual, upright.residual[order], rtol=1e-3, atol=0)
    torch.testing.assert_close(
        result.offsets.offsets, (sign * upright.offsets.offsets)[..., order], rtol=0, atol=1e-4, equal_nan=True
    )
    assert np.array(motion.amplitude)[order] == pytest.approx(result.vibration.amplitude[:, 0].numpy(), rel=0.02)


def test_standard_deviations_from_frames_agree_with_errors(paper_camera):
    """Errors divided by their standard deviations are of order one for all noise seeds, scenes and phases.

    The standard deviations allow for a further tone, so that errors are smaller for one tone.
    """
    ratios = []
    for seed in range(20, 24):
        motion = Motion(phase=random_phase(seed))
        result = detect_bands(recorded((2048, 256), paper_camera, motion, 2, NOISE, seed=seed), paper_camera)
        found, std = result.vibration, result.std
        for name in ("amplitude", "frequency"):
            error = getattr(found, name)[:, 0].numpy() - np.array(getattr(motion, name))
            ratios.append(error / getattr(std, name)[:, 0].numpy())
    spread = np.sqrt(np.mean(np.square(ratios)))
    assert 0.1 < spread < 2


def test_columns_with_detail_are_selected(pairs, paper_camera):
    """Each stack has detail in different columns, the others are constant; also for a transposed stack."""
    (first, _), (second, _) = pairs
    flat = torch.full_like(first[..., :80], 0.5)
    left, right = torch.cat([first[..., :192], flat, flat], -1), torch.cat([flat, second[..., :192], flat], -1)
    noise = 0.001 * torch.randn(right.shape, generator=torch.Generator().manual_seed(1))
    batch = torch.stack([left, right])[:, :, None] + noise[:, None]
    found = detect_vibration(batch, paper_camera, columns=160)
    for index, frames in enumerate((left + noise, right + noise)):
        alone = detect_vibration(frames, paper_camera, columns=160)
        torch.testing.assert_close(found[index].vibration.amplitude, alone.vibration.amplitude, rtol=1e-4, atol=0)
        assert alone.reliable.all()
        motion = pairs[index][1]
        assert tone_errors(alone.vibration, motion)[1].max() < 1.0
    sideways = replace(paper_camera, scan_axis=-1)
    sideways_frames = (left + noise).transpose(-2, -1).contiguous()
    turned = detect_vibration(sideways_frames, sideways, columns=160).vibration.amplitude
    torch.testing.assert_close(turned.flip(0), found[0].vibration.amplitude, rtol=1e-4, atol=0)


def detail(*shape, pixel=None):
    frames = torch.rand(*shape, generator=torch.Generator().manual_seed(0))
    if pixel is not None:
        frames[1, 17, 5] = pixel
    return frames


@pytest.mark.parametrize(
    ("frames", "options", "message"),
    [
        (detail(1, 256, 128), {}, "at least 2 frames are needed, got 1"),
        (detail(2, 256, 128, pixel=math.inf), {}, r"pixel \(1, 17, 5\) is inf"),
        (torch.full((2, 256, 128), 0.4), {}, "frame 0 is constant"),
        (torch.cat([detail(1, 256, 128), torch.zeros(1, 256, 128)]), {}, "frame 1 is constant"),
        (detail(2, 2, 1, 256, 128) * torch.tensor([1.0, 0.0])[:, None, None, None, None], {}, "frame 0 of stack 1 is"),
        (detail(2, 24, 128), {"method": "bands"}, "too small for bands of 32 rows searched over 16 px"),
        (detail(2, 128, 128), {"roll": True}, "frames of 128 x 128 px .* in 2 parts .* at least 64 x 192 are needed"),
        *(
            (detail(2, *size), {}, rf"frames of {size[0]} x {size[1]} px .* at least 64 x 96 are needed")
            for size in ((24, 640), (64, 90), (40, 2048))
        ),
    ],
)
def test_bad_input(paper_camera, frames, options, message):
    with pytest.raises(ValueError, match=message):
        detect_vibration(frames, paper_camera, **options)
