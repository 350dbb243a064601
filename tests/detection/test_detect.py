"""Vibration from bands of frames, line sensors, batches, and input that is refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from truth import MARGIN, Motion, crop, decibel, draw_scene, recorded, take_frames, tone_errors

from rsvib_torch import SensorTiming, detect_vibration, restore

METHODS = ("projection", "ncc", "phase")
NOISE = 0.003
# error bounds of each registration for the pair of the paper: period %, amplitude %, phase in pi
LIMITS = {"projection": (1.0, 2.0, 0.05), "ncc": (0.15, 1.0, 0.004), "phase": (0.15, 1.5, 0.004)}


def detect_bands(frames, timing, **options):
    return detect_vibration(frames, timing, **{"method": "bands", **options})


def random_phase(seed):
    return tuple(np.random.default_rng([7, seed]).uniform(-np.pi, np.pi, 2).tolist())


def check(result, motion, *limits):
    largest = tone_errors(result.vibration, motion).amax(-1)
    assert bool((largest < torch.tensor(limits)).all()), largest


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
    for name in ("amplitude", "frequency"):  # standard deviations allow for a further tone, errors are smaller
        value, std = (getattr(part, name)[:, 0].numpy() for part in (result.vibration, result.std))
        assert (np.abs(value - getattr(motion, name)) < 4 * std).all()
        assert (std < 0.1 * value).all()
    # 50 Hz has the gain +0.62, 30 Hz the gain -1.46: amplitudes stay positive, the sign is in the phase
    assert result.gain[:, 0].tolist() == pytest.approx([0.626, -1.461], abs=0.03)
    assert bool((result.vibration.amplitude > 0).all())
    good = result.offsets.good
    difference = (result.offsets.offsets - result.fitted)[good].abs().mean(0)
    assert torch.allclose(difference, result.residual, rtol=1e-9)
    size = result.offsets.offsets[good].abs().mean(0)
    assert bool((result.residual < 0.06 * size).all())


def test_no_tone_is_detected_without_vibration(paper_camera):
    image_motion = (300.0, 150.0)
    motion = Motion(amplitude=(0.0, 0.0), image_motion=image_motion)
    frames = recorded((2048, 384), paper_camera, motion, 2, NOISE, seed=4, margin=60)
    result = detect_bands(frames, paper_camera)
    assert bool((result.vibration.amplitude == 0).all())
    assert result.reliable.tolist() == [False, False]
    assert all("no_tone" in {reason.code for reason in of_axis} for of_axis in result.findings)
    assert result.vibration.image_motion.tolist() == pytest.approx(image_motion, abs=2.0)


def test_number_of_tones_can_be_set(pairs, paper_camera):
    frames, motion = pairs[0]
    result = detect_bands(frames, paper_camera, tones=2)
    assert result.vibration.amplitude.shape == (2, 2)
    assert result.vibration.amplitude[:, 0].numpy() == pytest.approx(np.array(motion.amplitude), rel=0.05)
    assert bool((result.vibration.amplitude[:, 1] < 0.1 * result.vibration.amplitude[:, 0]).all())


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


@pytest.mark.parametrize("delay_lines", [73, 260])
def test_jitter_of_line_sensors_is_measured_and_removed(delay_lines):
    """Two lines record the same ground with a delay, which is the frame period of the simulator, below the image."""
    lines, line_time, jitter = 900, 1e-4, Motion(amplitude=(1.4, 0.9), frequency=(31.0, 44.0))
    timing = SensorTiming(line_time, 4, lines, frame_start_times=[0.0, delay_lines * line_time])
    ground = draw_scene(lines + 2 * MARGIN, 192 + 2 * MARGIN, 9)
    camera = SensorTiming(row_time=line_time, exposure_rows=4, frame_rows=delay_lines)
    taken = torch.from_numpy(take_frames(ground, camera, jitter, 2, 0.005)).float()
    found = detect_vibration(taken, timing)
    assert found.reliable.all()
    check(found, jitter, 0.3, 3.0, 0.02)
    restored = restore(taken, timing, found, joint=True)
    assert decibel(restored.numpy(), crop(ground)) > decibel(taken.numpy(), crop(ground)) + 12
