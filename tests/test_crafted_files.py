"""The attack with crafted files: every kind of failure is noticed, and no file of it causes one."""

import os

import pytest
from attacks import crafted
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
STARTS = ("npy: shape (1000", "npy: header", "npy: 10^8", "raw: shape [1", "pipe .", "device .")
STARTS += ("PNG: 2147", "PNG: sparse", "JPEG: sparse")
STARTS += ("TIFF: width", "TIFF: the next page is", "TIFF: 20000 pages", "HDF5: 25", "HDF5: no", "HDF5: external")
STARTS += ("HDF5: virtual", "Zarr: shape (4", "Zarr: 10^9", "Zarr: chunk is a", "Zarr: unknown codec")
STARTS += ("video: playlist", "video: list", "CSV: field", "TOML: nested", "TOML: 64", "vibration: nested")


def test_some_crafted_files(tmp_path):
    names = [name for name in crafted.CASES if name.startswith(STARTS)]
    assert len(names) > len(STARTS) + 20
    trials = list(crafted.crafted(names, tmp_path))
    assert [trial for trial in trials if trial.outcome != "refused"] == []


@pytest.mark.slow
def test_all_crafted_files(tmp_path):
    trials = list(crafted.trials(tmp_path, 1000, 0))
    assert len(trials) >= 170
    assert [trial for trial in trials if trial.outcome in FAILURES] == []
