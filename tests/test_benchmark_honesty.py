"""The count of confident wrong answers: its camera compared with formulas, and a complete run of a case."""

import argparse

import numpy as np
import pytest
from benchmarks import honesty, timing
from benchmarks.honesty_camera import FINER, MARGIN, OPTICS, fine_shape, layer, row_displacement, take_frames
from benchmarks.honesty_cases import recording

H, W = 64, 72
PERIODS = np.array([9.0, 13.0])  # px, along rows and along the scan


def waves():
    """A scene of one wave along each axis as a layer, and its image at positions in px."""
    turn = 2 * np.pi / PERIODS
    y, x = ((np.arange(n) + 0.5) / FINER - 0.5 - MARGIN for n in fine_shape(H, W))
    fine = 0.5 + 0.2 * np.cos(turn[0] * x) + 0.15 * np.sin(turn[1] * y)[:, None]
    # the mean over FINER points, and the optics
    pixel = [np.sin(0.5 * t) / (FINER * np.sin(0.5 * t / FINER)) * np.exp(-0.5 * (OPTICS * t) ** 2) for t in turn]

    def image(row, column):
        return 0.5 + 0.2 * pixel[0] * np.cos(turn[0] * column) + 0.15 * pixel[1] * np.sin(turn[1] * row)

    return layer(fine), image


ROWS, COLUMNS = np.arange(H)[:, None] * 1.0, np.arange(W)[None, :] * 1.0
STARTS = np.arange(H)[None, :] * 1e-4


def test_roll_and_zoom_keep_the_centre():
    scene, image = waves()
    roll, zoom = 0.004, 0.01
    frame = take_frames([scene], lambda t: np.stack([0 * t, 0 * t, 0 * t + roll, 0 * t]), STARTS, 1e-3, W)[0]
    down, right = ROWS - 31.5, COLUMNS - 35.5
    expected = image(31.5 + down - roll * right, 35.5 + right + roll * down)  # content turns from x towards y
    np.testing.assert_allclose(frame, expected, rtol=0, atol=1e-4)
    enlarged = lambda t: np.stack([0 * t, 0 * t, 0 * t, 0 * t + zoom])  # noqa: E731
    frame = take_frames([scene], enlarged, STARTS, 1e-3, W)[0]
    np.testing.assert_allclose(frame, image(31.5 + down / 1.01, 35.5 + right / 1.01), rtol=0, atol=2e-5)
    x, y = row_displacement(enlarged, STARTS, 1e-3, W)
    np.testing.assert_allclose(x, 0, atol=1e-12)
    np.testing.assert_allclose(y[0], down[:, 0] * (1 - 1 / 1.01), rtol=1e-9)


def test_an_exposure_attenuates_a_moving_wave_by_a_sinc():
    scene, image = waves()
    exposure, speed = 3e-3, 2000.0  # 6 px
    frame = take_frames([scene], lambda t: np.stack([speed * t, 0 * t, 0 * t, 0 * t]), STARTS, exposure, W)[0]
    middle = speed * (STARTS[0] + 0.5 * exposure)
    wave = image(ROWS, COLUMNS - middle[:, None]) - image(ROWS, np.full((1, W), 0.25 * PERIODS[0]))
    still = image(ROWS, np.full((1, W), 0.25 * PERIODS[0]))
    np.testing.assert_allclose(frame, still + np.sinc(speed * exposure / PERIODS[0]) * wave, rtol=0, atol=2e-5)
    np.testing.assert_allclose(
        row_displacement(lambda t: np.stack([speed * t, t, 0 * t, 0 * t]), STARTS, exposure, W)[0, 0], middle
    )


def test_a_plain_case_is_correct():
    options = argparse.Namespace(honesty_classes=["plain"], honesty_cases=1, honesty_size=256)
    results = honesty.rows(options)
    assert [axis["outcome"] for axis in results[0]["axes"]] == ["correct", "correct"]
    assert all(0 < axis["largest_z"] < 4 for axis in results[0]["axes"])
    assert results[0]["restored_db"] > results[0]["raw_db"] + 5


def test_outcomes_of_an_axis_follow_the_criteria():
    from dataclasses import replace

    import torch

    import rsvib_torch as rsv

    taken = recording("plain", 0, 128)
    true = [torch.tensor(np.stack([tones[:, i] for tones in taken.case.tones])) for i in range(3)]
    found = rsv.detect_vibration(torch.from_numpy(taken.frames).float(), taken.timing)
    std = replace(
        found.std, **{name: torch.full_like(true[0], 1e-4) for name in ("amplitude", "frequency", "period", "phase")}
    )

    def outcome(vibration, *reliable):
        claimed = replace(found, vibration=vibration, std=std, reliable=torch.tensor(reliable))
        return [honesty.judge_axis(claimed, taken, axis) for axis in range(2)]

    exact = outcome(rsv.Vibration(*true), True, False)
    assert [axis["outcome"] for axis in exact] == ["correct", "known"]
    assert max(axis["displacement_error"] for axis in exact) < 1e-6
    louder = outcome(rsv.Vibration(1.03 * true[0], *true[1:]), True, False)
    assert [axis["outcome"] for axis in louder] == ["wrong", "refused"]
    assert (louder[0]["wrong_parameter"], louder[0]["wrong_displacement"]) == (True, False)
    assert louder[0]["largest_z"] == pytest.approx(0.03 * float(true[0][0]) / 1e-4)
    inverted = outcome(rsv.Vibration(*true[:2], true[2] + np.pi), True, True)
    assert [(axis["wrong_parameter"], axis["wrong_displacement"]) for axis in inverted] == [(False, True)] * 2


def test_a_mistake_of_the_timing_is_not_right():
    """Two frames with correct timing and with the image height as frame_rows."""
    taken = timing.take("city", 0, 128)
    cases = {name: timing.judge_mistake(taken, name, 2) for name in ("none", "frame_rows = image height")}
    assert cases["none"]["outcomes"] == ["right", "right"]
    assert cases["none"]["restored_db"] > cases["none"]["raw_db"] + 6
    assert "right" not in cases["frame_rows = image height"]["outcomes"]
