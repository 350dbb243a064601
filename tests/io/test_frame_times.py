"""Frame times and rates stated by files, compared with the sensor."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from small_stack import TIMING

import rsvib_torch as rsv
from rsvib_torch import StackInfo
from rsvib_torch.frames.prepare import prepare_frames
from rsvib_torch.io import describe_stack, exposure_times, timing_from_first_frame

KEPT = [0, 1, 2, 4, 5, 9, 10]  # the other frames were dropped


def info_with(times, error=1e-3):
    times = tuple(float(time) for time in times)
    return StackInfo((len(times), 8, 8), "uint8", 255.0, times, time_error=error)


def test_rounded_times_are_used_to_find_dropped_frames():
    period = TIMING.frame_period
    gaps = info_with([round(index * period, 3) for index in KEPT])
    assert exposure_times(gaps, TIMING) == pytest.approx([index * period for index in KEPT], rel=1e-12)
    assert timing_from_first_frame(TIMING, gaps).frame_start_times == exposure_times(gaps, TIMING)
    assert describe_stack(gaps, TIMING) == [
        "the file: 4 frames are missing according to its time stamps, which are used"
    ]
    even = info_with([1.0 + 0.993 * index * period for index in range(9)])
    assert exposure_times(even, TIMING) == pytest.approx([index * period for index in range(9)], rel=1e-12)
    assert timing_from_first_frame(TIMING, even) is TIMING
    assert describe_stack(even, TIMING) == []
    own = replace(TIMING, frame_start_times=tuple(index * period for index in range(9)))
    assert timing_from_first_frame(own, gaps) is own
    assert describe_stack(gaps, own) == []


def test_a_long_stack_of_rounded_times_has_the_rate_of_the_sensor():
    """Rounded to 1 ms, 10.4 ms are intervals of 10 and 11 ms; a gap of 30 frames is still counted correctly."""
    kept = [*range(40), *range(70, 90)]
    rounded = info_with([round(index * TIMING.frame_period, 3) for index in kept])
    assert exposure_times(rounded, TIMING) == pytest.approx([index * TIMING.frame_period for index in kept], rel=1e-12)


def test_the_median_of_a_variable_frame_rate_need_not_be_that_of_the_sensor():
    """A telephone with a nominal rate takes more than half of its frames later, because the scene is dark."""
    times = np.cumsum([0, 1.4, 1.4, 1, 1, 1.03, 1.19, 1.3]) * TIMING.frame_period
    info = info_with(times, 1e-5)
    assert timing_from_first_frame(TIMING, info).frame_start_times == pytest.approx(times)
    with pytest.warns(rsv.TimingWarning, match=r"per second according to its time stamps, but 240\.38"):
        fast = timing_from_first_frame(replace(TIMING, frame_rows=41.6), info)  # slow motion
    assert fast.frame_start_times is None


@pytest.mark.parametrize("error", [1e-5, 1e-3])
def test_times_of_a_variable_frame_rate_are_used_as_they_are(error):
    times = np.cumsum([0, 1, 1, 1.3, 1, 1.15, 1, 1, 1.22, 1]) * TIMING.frame_period
    info = info_with(np.round(times / error) * error, error)
    assert exposure_times(info, TIMING) == info.frame_times
    timing = timing_from_first_frame(TIMING, info)
    assert timing.frame_start_times == pytest.approx(times, abs=error)
    (note,) = describe_stack(info, TIMING)
    assert "frame intervals of 10" in note
    assert "its time stamps are used, whose error is up to" in note


def test_a_slow_change_of_the_frame_rate_is_not_mistaken_for_equal_intervals():
    times = np.cumsum(np.linspace(1.0, 1.08, 60)) * TIMING.frame_period
    info = info_with(times - times[0], 1e-5)
    assert exposure_times(info, replace(TIMING, frame_rows=108)) == info.frame_times


@pytest.mark.parametrize("kept", [list(range(60)), [*range(20), *range(21, 61)]])
def test_jitter_that_does_not_add_up_is_not_a_variable_rate(kept):
    rng = np.random.default_rng(0)
    jitter = rng.uniform(-0.2, 0.2, 60)
    of_clock = info_with((kept + jitter) * TIMING.frame_period, 1e-5)
    even = pytest.approx(np.multiply(kept, TIMING.frame_period), rel=1e-12)
    assert exposure_times(of_clock, TIMING) == even
    assert "ms like those of a program that records; equal intervals are used" in describe_stack(of_clock, TIMING)[-1]
    exact = replace(of_clock, time_error=0.0)
    alternating = info_with((kept + 0.1 * (-1.0) ** np.arange(60)) * TIMING.frame_period, 1e-5)
    walking = info_with((kept + np.cumsum(rng.uniform(-0.06, 0.06, 60))) * TIMING.frame_period, 1e-5)
    for info in (exact, alternating, walking):
        assert exposure_times(info, TIMING) == info.frame_times


def test_irregular_times_that_are_too_rough_are_reported():
    info = info_with(np.cumsum([0, *[1] * 7, *[1.48] * 6]) * TIMING.frame_period, 5e-3)
    message = r"time stamps are irregular and have errors of up to 5 ms; equal intervals"
    with pytest.warns(rsv.TimingWarning, match=message):
        assert timing_from_first_frame(TIMING, info) is TIMING


@pytest.mark.parametrize("interval", [1 / 30, 0.5 * TIMING.frame_period, 4 * TIMING.frame_period])
def test_a_frame_rate_that_contradicts_the_sensor_is_reported_with_the_remedy(interval):
    rate = re.escape(f"{1 / interval:.5g} frames per second according to its time stamps, but 96.154 according to")
    remedy = re.escape(f"set the frame rate to {1 / interval:.6g} (frame_rows={interval / 1e-4:.6g})")
    for info in (
        info_with(interval * np.arange(9)),
        replace(info_with(interval * np.arange(9)), frame_times=None, frame_rate=1 / interval),
    ):
        assert exposure_times(info, TIMING) is None
        with pytest.warns(rsv.TimingWarning, match=f"{rate}.*{remedy}"):
            assert timing_from_first_frame(TIMING, info) is TIMING


def test_exact_times_may_be_those_of_every_nth_frame():
    fourth = info_with(4 * TIMING.frame_period * np.arange(9), 0.0)
    assert timing_from_first_frame(TIMING, fourth).frame_start_times == fourth.frame_times
    with pytest.warns(rsv.TimingWarning, match=r"128\.21 frames per second .* the times of the file are used"):
        used = timing_from_first_frame(TIMING, info_with(0.75 * TIMING.frame_period * np.arange(9), 0.0))
    assert used.frame_start_times[1] == pytest.approx(0.75 * TIMING.frame_period)


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        (("f_0", "f_1", "f_3", "f_4"), (0, 1, 3, 4)),
        (("f_8", "f_10", "f_12", "f_20"), (0, 1, 2, 6)),  # every second frame was kept
        (("f_98", "f_99", "f_100", "f_101"), None),
        (("f_0", "f_33", "f_67", "f_100"), None),  # ms
        (("2024-05-01_10-00-00", "2024-05-01_10-00-01", "2024-05-02_09-00-00"), None),
    ],
)
def test_missing_numbers_in_file_names_are_missing_frames(tmp_path, names, numbers):
    for name in names:
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros((8, 8), np.uint8))
    info = rsv.read_stack_info(tmp_path)
    timing = rsv.SensorTiming(row_time=1e-4, exposure_rows=6, frame_rows=100)
    starts = rsv.timing_from_first_frame(timing, info).frame_start_times
    notes = describe_stack(info, timing)
    if numbers is None:
        assert starts is None
        assert notes == []
    else:
        assert starts == pytest.approx([0.01 * number for number in numbers])
        missing = numbers[-1] + 1 - len(numbers)
        stated = "1 frame is missing" if missing == 1 else f"{missing} frames are missing"
        assert f"{stated} according to the numbers in the file names" in notes[0]
        assert prepare_frames(tmp_path, timing).image_timing.frame_start_times == starts
