"""Tones that decay or change frequency, in frames of an independent simulator."""

import numpy as np
import pytest
import torch
from truth import Curve, recorded

import rsvib_torch as rsv
from rsvib_torch.datasets import city_and_fields
from rsvib_torch.results.reason import Reason

HEIGHT, WIDTH, FRAMES = 256, 160, 5
TIMING = rsv.SensorTiming(row_time=6e-5, exposure_rows=20, frame_rows=270)
AMPLITUDE, FREQUENCY, DECAY, CHIRP, PHASE = (3.2, 1.1), (83.0, 30.0), (25.0, 0.0), (0.0, 520.0), (0.6, -1.1)


@Curve
def both_swept(times):
    axes = zip(AMPLITUDE, FREQUENCY, DECAY, CHIRP, PHASE, strict=True)
    return np.stack(
        [a * np.exp(-g * times) * np.sin(2 * np.pi * (f * times + c * times**2 / 2) + p) for a, f, g, c, p in axes],
        axis=-1,
    )


def taken(timing, motion, count, noise=0.004, size=(HEIGHT, WIDTH)):
    return recorded(size, timing, motion, count, noise, seed=6)


def agrees(found, times=4, share=0.002, **truths):
    """Whether all errors are within a number of standard deviations and a share of the value."""
    errors = {name: (getattr(found, name) - true).abs() for name, true in truths.items()}
    allowed = {name: times * found.std[name] + share * true for name, true in truths.items()}
    return all(bool((errors[name] < allowed[name]).all()) for name in truths)


def test_decay_and_chirp_are_measured():
    found = rsv.detect_swept_tone(taken(TIMING, both_swept, FRAMES, 0.005), TIMING)
    assert found.amplitude.tolist() == pytest.approx(AMPLITUDE, rel=0.02)
    assert found.frequency.tolist() == pytest.approx(FREQUENCY, rel=0.01)
    assert found.decay.tolist() == pytest.approx(DECAY, abs=0.6)
    assert found.chirp.tolist() == pytest.approx(CHIRP, abs=12.0)
    assert found.phase.tolist() == pytest.approx(PHASE, abs=0.03)
    assert found.reliable.all()
    times = TIMING.row_starts(FRAMES, HEIGHT)
    error = found.motion.displacement(times).numpy() - both_swept.displacement(times.numpy())
    assert (error - error.mean((0, 1))).std() < 0.015
    truths = {"amplitude": AMPLITUDE, "frequency": FREQUENCY, "decay": DECAY, "chirp": CHIRP, "phase": PHASE}
    for name, true in truths.items():
        off, std = np.abs(getattr(found, name).numpy() - true), found.std[name].numpy()
        assert ((off < 4 * std) & (std > 0)).all(), name


def tone(amplitude, frequency, decay=0.0, chirp=0.0, phase=0.0):
    """The same tone along both axes, with a phase of its own along y."""

    def displacement(times):
        angle = 2 * np.pi * (frequency * times + chirp * times**2 / 2) + phase
        return (amplitude * np.exp(-decay * times))[:, None] * np.sin(angle[:, None] + np.array([0.0, 1.0]))

    return Curve(displacement)


NEAR_BLIND = rsv.SensorTiming(row_time=4e-5, exposure_rows=20, frame_rows=220)


def test_two_frames_are_refused():
    steady = tone(1.6, 90.0, phase=1.0)
    timing = rsv.SensorTiming(row_time=4e-5, exposure_rows=20, frame_rows=300)  # blind at 83.3 Hz
    frames = taken(timing, steady, 3, 0.002)
    two = rsv.detect_swept_tone(frames[:2], timing)
    assert not two.reliable.any()
    assert all(of_axis[0].code == "too_few_frames_for_sweep" for of_axis in two.findings)
    three = rsv.detect_swept_tone(frames, timing)
    assert three.reliable.all()
    assert agrees(three, amplitude=1.6, frequency=90.0, decay=0.0, chirp=0.0)
    assert (three.std["frequency"] < 0.5).all()


def test_other_minima_are_left():
    # from one start, the fit ended at 6.8 ± 0.3 Hz, 11.2 ± 0.6 px with a decay of 112 ± 3 /s
    swept = tone(1.7, 29.3, decay=16.9, chirp=461.0, phase=-0.4)
    found = rsv.detect_swept_tone(taken(NEAR_BLIND, swept, 4, size=(192, 128)), NEAR_BLIND)
    assert found.reliable.all()
    assert agrees(found, times=5, share=0.0, amplitude=1.7, frequency=29.3, decay=16.9, chirp=461.0)
    assert (found.std["frequency"] < 1.5).all()


@pytest.mark.parametrize(
    ("rate", "hertz", "codes"), [(10.36, (60.98, 95.35), [(), ()]), (15.2, (70.0, 91.2), [(), ("tone_blind",)])]
)
def test_aliases_are_tried_and_blind_tones_refused(rate, hertz, codes):
    """Without aliases, 95.35 Hz was found as 85.00 ± 0.01 Hz; 91.2 Hz is six times the frame rate."""
    timing = rsv.SensorTiming(row_time=1e-4, exposure_rows=6, frame_rows=1e4 / rate)

    def decaying(times):
        return np.exp(-times / 1.2)[..., None] * [2.5, 1.36] * np.sin(2 * np.pi * times[..., None] * hertz + 1.0)

    found = rsv.detect_swept_tone(recorded((128, 128), timing, Curve(decaying), 40, 0.003, seed=1), timing)
    assert [tuple(reason.code for reason in of_axis) for of_axis in found.findings] == codes
    for axis in np.flatnonzero(found.reliable.numpy()):
        assert found.frequency[axis].item() == pytest.approx(hertz[axis], abs=0.01)


def test_a_tone_that_sweeps_through_a_blind_frequency_is_known():
    """Its frequency is twice the frame rate in the middle of the record, and 1.8 and 2.2 times at the ends."""
    rate, count = NEAR_BLIND.frame_rate, 8
    start, chirp = 1.8 * rate, 0.4 * rate**2 / count
    frames = taken(NEAR_BLIND, tone(1.3, start, chirp=chirp), count, size=(192, 128))
    found = rsv.detect_swept_tone(frames, NEAR_BLIND)
    assert found.reliable.all()
    assert agrees(found, amplitude=1.3, frequency=start, chirp=chirp)


@pytest.mark.parametrize("contrast", [0.02, 0.3])  # of the scene; without the check 4.20 ± 0.08 px for 0.02
def test_noise_that_hides_the_scene_is_refused(contrast):
    flat = 0.5 + contrast * (taken(TIMING, tone(0.5, 60.0), 3, 0.0) - 0.5)
    noisy = flat + 0.02 * torch.randn(flat.shape, generator=torch.Generator().manual_seed(2))
    assert not rsv.detect_swept_tone(noisy, TIMING).reliable.any()
    if contrast < 0.1:
        assert not rsv.detect_motion(noisy, TIMING).reliable.any()


def test_tones_that_noise_explains_as_well_are_refused():
    """Without the probability of chance, 7 of 10 axes were reliable."""
    noise = 0.5 + 0.02 * torch.randn(6, 256, 160, generator=torch.Generator().manual_seed(600))
    found = rsv.detect_swept_tone(noise, TIMING)
    assert not found.reliable.any()
    assert "tone_of_chance" in {reason.code for of_axis in found.findings for reason in of_axis}


def test_a_tone_that_another_one_explains_as_well_is_refused():
    """In three frames of 96 rows, 170 Hz was found as 211 Hz; 128 Hz explains the rows as well."""
    timing, vibration = rsv.SensorTiming(1e-4, 6, 104), rsv.Vibration([1.2, 0.8], [130.0, 170.0], [0.3, 0.9])
    frames = rsv.simulate_frames(city_and_fields(160, 160, seed=8), timing, vibration, 3, frame_size=(96, 96))
    found = rsv.detect_swept_tone(frames, timing)
    assert not found.reliable.any()
    assert "other_swept_tone" in {reason.code for reason in found.findings[1]}


def test_long_record_is_followed_from_the_part_with_the_largest_offsets():
    # starts are searched in 67 of these 90 frames
    timing = rsv.SensorTiming(row_time=6e-5, exposure_rows=20, frame_rows=110)
    swept = tone(2.5, 83.0, decay=8.0, chirp=20.0, phase=0.4)
    found = rsv.detect_swept_tone(taken(timing, swept, 90, size=(100, 128)), timing)
    assert found.reliable.all()
    assert agrees(found, amplitude=2.5, frequency=83.0, decay=8.0, chirp=20.0)


def test_axis_without_motion_has_no_tone():
    along_x = Curve(lambda t: np.stack([2 * np.exp(-10 * t) * np.sin(2 * np.pi * 45 * t), 0 * t], -1))
    found = rsv.detect_swept_tone(taken(TIMING, along_x, 3, 0.005), TIMING)
    assert found.amplitude[1] == 0
    assert found.findings[1] == (Reason("no_tone", "y"),)
    assert found.frequency[0].item() == pytest.approx(45.0, rel=0.02)
