"""Reasons that name what is wrong: the timing with the value that agrees, the exposure, and halves that move apart."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from truth import Curve, Motion, recorded

from rsvib_torch import SensorTiming, TimingWarning, detect_vibration

HEIGHT, WIDTH, RATE = 200, 160, 24.0
TIMING = SensorTiming(row_time=1 / (RATE * 230), exposure_rows=8, frame_rows=230)
MOTION = Motion((1.4, 1.1), (53.0, 65.0), (0.4, 1.3))


@Curve
def walk(times):
    """Sums of 60 tones below 40 Hz, which no four tones explain."""
    generator = np.random.default_rng(5)
    frequency = generator.uniform(2.0, 40.0, (2, 60))
    amplitude = generator.standard_normal((2, 60)) / frequency
    phase = generator.uniform(-3.0, 3.0, (2, 60))
    waves = amplitude * np.sin(2 * np.pi * frequency * times[:, None, None] + phase)
    return 1.5 * waves.sum(-1) / np.linalg.norm(amplitude, axis=-1)


@pytest.fixture(scope="module")
def frames():
    return recorded((HEIGHT, WIDTH), TIMING, MOTION, 4, 0.005, seed=8)


@pytest.mark.parametrize("seconds", [1.0, 0.085, 0.034])  # frame numbers, and other frame rates
def test_frame_start_times_far_from_the_frame_period_cause_a_warning(frames, seconds):
    stated = replace(TIMING, frame_start_times=tuple(seconds * number for number in range(4)))
    message = f"by their times, frames are {seconds:g} s apart, but the frame period is 0.0417 s"
    with pytest.warns(TimingWarning, match=message):
        found = detect_vibration(frames, stated)
    assert any(f"frame_start_times {seconds:g} s apart" in text for text in found.assumptions)


def causes(found):
    """Reasons against all axes that name another timing."""
    first, second = ([one for one in of_axis if one.code.startswith("other_")] for of_axis in found.findings)
    assert first == second
    return first


@pytest.mark.parametrize(
    ("factor", "tone", "codes"),
    [
        (1.0, (0.3, 62.0), []),
        (1.0, (0.2, 190.0), []),
        (0.99, (0.2, 190.0), ["other_frame_rows"]),  # the tone leaves less than is permitted
        (0.95, (0.3, 62.0), ["other_frame_rows", "tones_alias"]),  # explained by two, one frame rate apart
    ],
)
def test_a_frame_period_that_tones_contradict_is_refused_along_all_axes(factor, tone, codes):
    # The motion along x is slow and agrees with any frame period.
    timing = SensorTiming(row_time=2.616e-5, exposure_rows=1.2, frame_rows=301.6)
    moved = Motion((0.41, tone[0]), (10.0, tone[1]), (1.0, 0.4))
    taken = recorded((240, 200), timing, moved, 8, 0.005, seed=1)
    found = detect_vibration(taken, replace(timing, frame_rows=factor * timing.frame_rows))
    assert [[one.code for one in of_axis] for of_axis in found.findings] == [codes] * 2
    assert all(one.limit == pytest.approx(301.6, rel=0.01) for one in causes(found))


def test_correct_timing_is_not_doubted(frames):
    found = detect_vibration(frames, TIMING)
    assert found.reliable.all(), found.reasons
    assert not any("number of rows of the frames" in text for text in found.assumptions)


@pytest.mark.parametrize(
    ("wrong", "factor"),
    [
        ({"frame_rows": HEIGHT, "row_time": 1 / (RATE * HEIGHT), "exposure_rows": 8 / 1.15}, 1.15),
        ({"frame_rows": 230 * 1.03}, 1 / 1.03),
    ],
    ids=["image height, frame rate correct", "3 %"],
)
def test_wrong_frame_rows_are_named_with_the_right_value(frames, wrong, factor):
    stated = replace(TIMING, **wrong)
    found = detect_vibration(frames, stated)
    assert not found.reliable.any()
    (cause,) = causes(found)
    agrees, row_time = cause.limit, cause.details["row_time"]
    assert (cause.code, cause.axis, cause.value) == ("other_frame_rows", None, stated.frame_rows)
    assert agrees == pytest.approx(230, rel=3e-3)
    assert row_time == pytest.approx(stated.row_time / factor, rel=3e-3)
    assert agrees * row_time == pytest.approx(stated.frame_period, rel=1e-3)
    assert any("number of rows of the frames" in text for text in found.assumptions) == (stated.frame_rows == HEIGHT)


def test_a_wrong_row_time_is_named_if_the_start_times_are_known(frames):
    times = tuple(np.arange(4) / RATE)
    found = detect_vibration(frames, replace(TIMING, row_time=1.04 * TIMING.row_time, frame_start_times=times))
    assert not found.reliable.all()
    (cause,) = causes(found)
    assert (cause.code, cause.value) == ("other_row_time", 1.04 * TIMING.row_time)
    assert cause.limit == pytest.approx(TIMING.row_time, rel=3e-3)


@pytest.mark.parametrize(
    ("wrong", "code", "agreeing"),
    [
        ({"readout_direction": "reverse"}, "other_readout_direction", "forward"),
        ({"scan_axis": "x"}, "other_scan_axis", "y"),
    ],
)
def test_a_wrong_readout_is_named(frames, wrong, code, agreeing):
    found = detect_vibration(frames, replace(TIMING, **wrong))
    assert not found.reliable.all()
    (cause,) = causes(found)
    assert (cause.code, cause.details["agreeing"]) == (code, agreeing)


@pytest.mark.parametrize("lost", [1, 3])
def test_a_lost_frame_is_named(lost):
    recorded_frames = recorded((HEIGHT, WIDTH), TIMING, MOTION, 6, 0.005, seed=8)
    found = detect_vibration(torch.cat([recorded_frames[:lost], recorded_frames[lost + 1 :]]), TIMING)
    assert not found.reliable.any()
    (cause,) = causes(found)
    assert (cause.code, cause.details) == ("other_frame_times", {"before": lost - 1, "after": lost})


def test_a_motion_that_is_no_sum_of_tones_names_no_timing():
    found = detect_vibration(recorded((HEIGHT, WIDTH), TIMING, walk, 4, 0.005, seed=8), TIMING)
    codes = {reason.code for of_axis in found.findings for reason in of_axis}
    assert codes & {"rows_unexplained", "neighbours_unexplained", "too_many_tones"}
    assert causes(found) == []


def test_a_batch_names_the_cause_of_its_own_stack(frames):
    both = torch.stack([frames, frames.flip(-2)])[:, :, None]
    found = detect_vibration(both, TIMING)
    assert found.reliable.tolist()[0] == [True, True]
    assert causes(found[0]) == []
    assert [cause.code for cause in causes(found[1])] == ["other_readout_direction"]


@pytest.mark.parametrize(
    "taken", [(0, *range(2, 9)), (*range(7), 6), (*range(6), 7, 6)], ids=["lost", "stale", "swapped"]
)
def test_frames_at_other_times_than_stated_are_refused(taken):
    """Each is one of eight frames, whose rows were left out: an axis was reliable, and a frame wrong by 1 px."""
    timing = SensorTiming(row_time=1 / (RATE * 500), exposure_rows=100, frame_rows=500)
    motion = Motion((2.8, 2.2), (13.0, 17.0), (0.4, 1.3), (30.0, 20.0))
    later = np.subtract(taken, range(8)) / RATE

    @Curve
    def moved(times):
        return motion.displacement(times + later[(times * RATE + 1e-6).astype(int).clip(0, 7)])

    found = detect_vibration(recorded((160, 128), timing, moved, 8, 0.004, seed=8), timing)
    assert ["rows_unexplained" in [one.code for one in of_axis] for of_axis in found.findings] == [True, True]


def test_an_axis_beside_one_that_is_contradicted_has_an_assumption():
    """With a wrong readout direction, two axes of 28 were reliable, and wrong, beside a contradicted one."""

    def curve(times):
        return np.where([True, False], MOTION.displacement(times), walk.displacement(times))

    found = detect_vibration(recorded((HEIGHT, WIDTH), TIMING, Curve(curve), 4, 0.005, seed=8), TIMING)
    assert found.reliable.tolist() == [True, False]
    assert "the tones of the other axis are not known" in found.assumptions[-1]


def test_a_reversed_readout_is_named_where_it_needs_further_tones():
    """Four frames agree with two tones along x, which was reliable and wrong, and with none that are known along y."""
    timing = SensorTiming(row_time=1.45e-4, exposure_rows=12, frame_rows=1 / RATE / 1.45e-4)
    frames = recorded((200, 160), timing, Motion((0.12, 0.21), (34.3, 55.7), (0.5, 5.1)), 4, 0.005, seed=10)
    found = detect_vibration(frames, replace(timing, readout_direction="reverse"))
    assert found.reliable.tolist() == [False, False]
    assert {one.code for one in causes(found)} == {"other_readout_direction"}


BLURRED_SIZE = 192, 160
BLURRED_TIMING = SensorTiming(row_time=1e-4, exposure_rows=30, frame_rows=300)
LARGE_MOTION = Motion((4.0, 3.0), (47.0, 61.0), (0.4, 1.3))
ALL = {"blur_contradicts_exposure"}


def codes(found):
    return [{reason.code for reason in of_axis} for of_axis in found.findings]


@pytest.fixture(scope="module")
def blurred():
    return recorded(BLURRED_SIZE, BLURRED_TIMING, LARGE_MOTION, 8, 0.004, seed=3)


@pytest.mark.parametrize(("stated", "expected"), [(30.0, set()), (27.0, set()), (15.0, ALL), (0.1, ALL), (50.0, ALL)])
def test_an_exposure_is_refused_that_the_blur_contradicts(blurred, stated, expected):
    """Stated far too short, the amplitude of 61 Hz is 5 % too small, with a standard deviation of 0.1 %."""
    found = detect_vibration(blurred, replace(BLURRED_TIMING, exposure_rows=stated))
    assert codes(found) == [expected, expected]


def test_the_exposures_that_the_blur_agrees_with_are_stated(blurred):
    found = detect_vibration(blurred, BLURRED_TIMING)
    (text,) = (text for text in found.assumptions if "the blur agrees with" in text)
    low, high = map(float, re.search(r"agrees with ([\d.]+) to ([\d.]+):", text).groups())
    assert 15 < low < 30 < high < 45
    x = np.sinc(47.0 * 30e-4) / np.sinc(47.0 * np.array([low, high]) * 1e-4) - 1
    shown = re.search(r"x 47 Hz: amplitude (\S+) to (\S+) %", text).groups()
    np.testing.assert_allclose([float(value) / 100 for value in shown], x, rtol=0.1)


def test_a_path_of_many_pixels_within_the_exposure_does_not_contradict_it():
    """The blur by a path of 13 px is far beyond the second order, which gives 0.11 of the expected difference."""
    timing, motion = replace(BLURRED_TIMING, exposure_rows=33), Motion((6.5, 1.4), (250.0, 52.0), (0.4, 1.3))
    found = detect_vibration(recorded(BLURRED_SIZE, timing, motion, 4, 0.004, seed=3), timing)
    assert codes(found) == [set(), set()]
    error = found.vibration.amplitude[:, 0].numpy() - motion.amplitude
    assert (np.abs(error) < 3 * found.std.amplitude[:, 0].numpy()).all()


def beside(motions, num_frames):
    """Frames whose halves show scenes that move by motions of their own."""
    return torch.cat(
        [recorded(BLURRED_SIZE, BLURRED_TIMING, one, num_frames, 0.004, seed=n) for n, one in enumerate(motions)], -1
    )


def test_parallax_does_not_refuse_halves_that_vibrate_alike():
    """The right half travels by 0.15 px per frame."""
    moving = replace(LARGE_MOTION, image_motion=(4.0, -3.0))
    found = detect_vibration(beside([LARGE_MOTION, moving], 4), BLURRED_TIMING)
    assert codes(found) == [set(), set()]
    error = found.vibration.amplitude[:, 0].numpy() - LARGE_MOTION.amplitude
    assert (np.abs(error) < 4 * found.std.amplitude[:, 0].numpy()).all()
    # two frames cannot tell parallax from a uniform roll
    assert "halves_apart" in set.union(*codes(detect_vibration(beside([LARGE_MOTION, moving], 2), BLURRED_TIMING)))


def test_parts_that_move_by_themselves_are_left_out_of_each_stack_of_a_batch():
    """The parts travel by 4 px per frame over a sixth of the frame; rows that they cover moved by a mean of both."""
    travelling = replace(LARGE_MOTION, image_motion=(120.0, -60.0))
    clear, other = (
        recorded(BLURRED_SIZE, BLURRED_TIMING, one, 4, 0.004, seed=n) for n, one in ((3, LARGE_MOTION), (4, travelling))
    )
    clouded = clear.clone()
    clouded[:, 64:128, :80] = other[:, 64:128, :80]
    found = detect_vibration(torch.stack([clouded, clear])[:, :, None], BLURRED_TIMING)
    for of_stack in (found[0], found[1], detect_vibration(clouded, BLURRED_TIMING)):
        assert codes(of_stack) == [set(), set()]
        error = of_stack.vibration.amplitude[:, 0].numpy() - LARGE_MOTION.amplitude
        assert (np.abs(error) < 4 * of_stack.std.amplitude[:, 0].numpy()).all()


def test_a_subject_on_half_of_the_frame_is_not_the_camera():
    """It moves along x by 1.7 px at 8.9 Hz, which was reliable as the vibration of the camera."""
    subject = Motion((1.7, 0.0), (8.9, 0.0), (0.0, 0.0), (40.0, 10.0))
    found = detect_vibration(beside([subject, LARGE_MOTION], 8), BLURRED_TIMING)
    assert not found.reliable.any()


@pytest.mark.parametrize("axis", [0, 1])
def test_halves_that_vibrate_differently_are_refused(axis):
    """By 0.1 px, as zoom (along x) and roll (along y) do."""
    size = np.eye(2)[axis] * 0.05

    def half(sign):
        return Curve(
            lambda times: LARGE_MOTION.displacement(times) + sign * size * np.sin(2 * np.pi * 55.0 * times)[:, None]
        )

    found = detect_vibration(beside([half(-1), half(1)], 4), BLURRED_TIMING, roll=False, zoom=False)
    assert "halves_apart" in set.union(*codes(found))
