"""The count of confident wrong answers: complete runs of two cases, and the criteria of an outcome."""

import argparse
from dataclasses import replace

import numpy as np
import pytest
import torch
from benchmarks import honesty, timing
from benchmarks.honesty_cases import recording

import rsvib_torch as rsv


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


def test_a_mistake_of_the_timing_is_not_right():
    """Two frames with correct timing and with the image height as frame_rows."""
    taken = timing.take("city", 0, 128)
    cases = {name: timing.judge_mistake(taken, name, 2) for name in ("none", "frame_rows = image height")}
    assert cases["none"]["outcomes"] == ["right", "right"]
    assert cases["none"]["restored_db"] > cases["none"]["raw_db"] + 6
    assert "right" not in cases["frame_rows = image height"]["outcomes"]
