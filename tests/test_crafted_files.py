"""The attack with crafted files: it notices every kind of failure, and no file of it causes one."""

import os
import time
from importlib import import_module
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[1] / "scripts"


@pytest.fixture(name="module")
def _module(monkeypatch):
    monkeypatch.syspath_prepend(SCRIPTS)
    return import_module("attacks.crafted")


def raised(error):
    raise error


@pytest.mark.parametrize(
    ("read", "expected"),
    [
        (lambda _: None, "completed"),
        (lambda _: raised(ValueError("a")), "refused"),
        (lambda _: raised(KeyError("a")), "traceback"),
        (lambda _: os._exit(3), "traceback"),
        (lambda _: time.sleep(10), "hang"),
    ],
)
def test_outcomes(module, tmp_path, read, expected):
    seconds = 0.3 if expected == "hang" else 10.0
    assert module.crafted("TOML: nested lists", tmp_path, read=read, seconds=seconds).outcome == expected


class WaitsInOtherProcesses:
    """Garbage whose finaliser waits for a thread that a forked process does not have."""

    def __init__(self):
        self.own, self.process = self, os.getpid()

    def __del__(self):
        while os.getpid() != self.process:
            time.sleep(1)


def test_garbage_of_this_process_does_not_block_the_child(module, tmp_path):
    WaitsInOtherProcesses()
    assert module.crafted("TOML: nested lists", tmp_path, seconds=10.0).outcome == "refused"


STARTS = ("npy: shape (1000", "npy: header", "npy: 10^8", "PNG: 2147", "TIFF: the next page is", "TIFF: 20000 pages")
MORE_STARTS = (
    "HDF5: 25",
    "Zarr: 10^9 chunks",
    "Zarr: chunk is a",
    "pipe .",
    "device .",
    "TOML: nested",
    "vibration: nested",
)


@pytest.mark.parametrize("start", [*STARTS, *MORE_STARTS])
def test_some_crafted_files(module, tmp_path, start):
    names = [name for name in module.CASES if name.startswith(start)]
    assert names
    for index, name in enumerate(names):
        (tmp_path / str(index)).mkdir()
        trial = module.crafted(name, tmp_path / str(index))
        assert trial.outcome == "refused", trial


@pytest.mark.slow
def test_all_crafted_files(module, tmp_path):
    trials = list(module.trials(tmp_path, 1000, 0))
    assert len(trials) >= 170
    assert [trial for trial in trials if trial.outcome not in ("completed", "refused")] == []
