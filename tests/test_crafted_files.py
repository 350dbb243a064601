"""Crafted and damaged inputs: a one-line error or a result, never a traceback or a hang; and failures are noticed."""

import os
from collections import Counter

import pytest
from attacks import api, crafted, mutated
from attacks.trial import FAILURES
from attacks.warm import in_warm_child

OUTCOMES = {"result": "completed", "wrong": "wrong", "refuse": "refused", "unclear": "wrong", "raise": "traceback"}
OUTCOMES |= {"allocate": "memory", "end": "traceback", "compute": "hang"}


def attempt(folder, item):
    if item == "end":
        os._exit(3)
    while item == "compute":
        pass
    errors = {"refuse": ValueError("a"), "unclear": ValueError(""), "raise": KeyError("a"), "allocate": MemoryError()}
    if item in errors:
        raise errors[item]
    return "a" if item == "wrong" else ""


def test_outcomes(tmp_path):
    trials = list(in_warm_child(attempt, zip(OUTCOMES, OUTCOMES, strict=True), tmp_path, limit=1.0, memory=1 << 30))
    assert {trial.name: trial.outcome for trial in trials} == OUTCOMES


# Every kind of damage, without those that take long
STARTS = ("npy: shape (1000", "npy: header", "npy: 10^8", "pipe .", "device .")
STARTS += ("PNG: 2147", "PNG: sparse", "JPEG: sparse")
STARTS += ("TIFF: width", "TIFF: the next page is", "TIFF: 20000 pages", "HDF5: 25", "HDF5: no", "HDF5: external")
STARTS += ("HDF5: virtual",)
STARTS += ("video: playlist", "video: list", "CSV: field", "TOML: nested", "TOML: 64", "vibration: nested")


def test_some_crafted_files(tmp_path):
    names = [name for name in crafted.CASES if name.startswith(STARTS)]
    assert len(names) > len(STARTS) + 20
    trials = list(crafted.crafted(names, tmp_path))
    assert [trial for trial in trials if trial.outcome != "refused"] == []


@pytest.mark.slow
def test_all_crafted_files(tmp_path):
    trials = list(crafted.trials(tmp_path, 1000, 0))
    assert len(trials) >= 160
    assert [trial for trial in trials if trial.outcome in FAILURES] == []


@pytest.mark.parametrize(("count", "seed"), [(60, 0), pytest.param(2400, 1, marks=pytest.mark.slow)])
def test_damaged_files_are_read_or_refused_with_a_one_line_error(tmp_path, count, seed):
    trials = list(mutated.trials(tmp_path, count, seed))
    assert [trial for trial in trials if trial.outcome in FAILURES] == []
    outcomes = Counter(trial.outcome for trial in trials)
    assert outcomes.total() == count
    assert outcomes["completed"] > count // 20
    assert outcomes["refused"] > count // 3


@pytest.mark.slow
def test_functions_refuse_hostile_arguments(tmp_path):
    trials = list(api.trials(tmp_path, 4000, 5))
    assert [trial for trial in trials if trial.outcome in FAILURES] == []
    assert Counter(trial.outcome for trial in trials)["completed"] > 100
