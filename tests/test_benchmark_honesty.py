"""The count of confident wrong answers: its camera, complete runs of two cases, and the criteria of an outcome."""

import argparse
from dataclasses import replace

import numpy as np
import pytest
import torch
from benchmarks import honesty
from benchmarks.honesty_camera import FINER, MARGIN, OPTICS, fine_shape, layer, take_frames
from benchmarks.honesty_cases import recording

import rsvib_torch as rsv


@pytest.mark.parametrize(("roll", "zoom"), [(0.0, 0.0), (0.004, 0.0), (0.0, 0.01)])
def test_the_camera_turns_and_enlarges_about_the_centre_behind_a_layer_that_moves(roll, zoom):
    """A wave along each axis, after optics and pixels, and a bright layer that covers the right half of it."""
    size, turn = (64, 72), 2 * np.pi / np.array([9.0, 13.0])
    y, x = ((np.arange(n) + 0.5) / FINER - 0.5 - MARGIN for n in fine_shape(*size))
    scene = layer(0.5 + 0.2 * np.cos(turn[0] * x) + 0.15 * np.sin(turn[1] * y)[:, None])
    cover = np.zeros(fine_shape(*size))
    cover[:, cover.shape[1] // 2 :] = 1.0
    near = layer(0.9 * cover, cover, (1000.0, 0.0))
    motion = lambda t: np.stack([0 * t, 0 * t, 0 * t + roll, 0 * t + zoom])  # noqa: E731
    starts = np.array([[0.0], [0.008]]).repeat(size[0], axis=1)
    frames = take_frames([scene, near], motion, starts, 1e-9, size[1])
    down, right = np.meshgrid(np.arange(64) - 31.5, np.arange(72) - 35.5, indexing="ij")
    row, column = (31.5 + (down - roll * right) / (1 + zoom), 35.5 + (right + roll * down) / (1 + zoom))
    left = [np.sin(0.5 * t) / (FINER * np.sin(0.5 * t / FINER)) * np.exp(-0.5 * (OPTICS * t) ** 2) for t in turn]
    image = 0.5 + 0.2 * left[0] * np.cos(turn[0] * column) + 0.15 * left[1] * np.sin(turn[1] * row)
    for frame, border in zip(frames, (36, 44), strict=True):
        np.testing.assert_allclose(frame[:, : border - 4], image[:, : border - 4], rtol=0, atol=1e-3)
        np.testing.assert_allclose(frame[:, border + 4 :], 0.9, rtol=0, atol=1e-3)


def test_a_plain_case_is_correct():
    options = argparse.Namespace(honesty_classes=["plain"], honesty_cases=1, honesty_size=256)
    results = honesty.rows(options)
    assert [axis["outcome"] for axis in results[0]["axes"]] == ["correct", "correct"]
    assert all(0 < axis["largest_z"] < 4 for axis in results[0]["axes"])
    assert results[0]["restored_db"] > results[0]["raw_db"] + 5


def test_outcomes_of_an_axis_follow_the_criteria():
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
