"""The attack with crafted files: it notices every kind of failure, and no file of it causes one."""

import os
import time
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

SCRIPTS = Path(__file__).parents[1] / "scripts"


@pytest.fixture(name="module")
def _module(monkeypatch):
    monkeypatch.syspath_prepend(SCRIPTS)
    return import_module("attacks.crafted")


def outcome(module, monkeypatch, tmp_path, read):
    monkeypatch.setitem(module.CASES, "two frames", lambda folder: module._data("a.npy", b"", folder))
    monkeypatch.setattr(module, "_read", read)
    return module.crafted("two frames", tmp_path).outcome


def test_outcomes(module, monkeypatch, tmp_path):
    def fail(_):
        raise KeyError("a")

    def refuse(_):
        raise ValueError("a")

    def end(_):
        module.os._exit(3)

    def allocate(_):
        kept = np.ones(10**7)
        time.sleep(5.0 * kept[-1])  # it is ended when the memory is noticed, which takes longer on a busy machine

    assert outcome(module, monkeypatch, tmp_path, lambda path: None) == "completed"
    assert outcome(module, monkeypatch, tmp_path, refuse) == "refused"
    assert outcome(module, monkeypatch, tmp_path, fail) == "traceback"
    assert outcome(module, monkeypatch, tmp_path, end) == "traceback"
    monkeypatch.setattr(module, "_SECONDS", 0.3)
    assert outcome(module, monkeypatch, tmp_path, lambda path: time.sleep(10)) == "hang"
    monkeypatch.setattr(module, "_SECONDS", 10.0)
    monkeypatch.setattr(module, "_BYTES", 5 * 10**7)
    monkeypatch.setattr(module.resource, "setrlimit", lambda *_: None)
    assert outcome(module, monkeypatch, tmp_path, allocate) == "memory"


class WaitsInOtherProcesses:
    """Garbage whose finaliser waits for a thread that a forked process does not have."""

    def __init__(self):
        self.own, self.process = self, os.getpid()

    def __del__(self):
        while os.getpid() != self.process:
            time.sleep(1)


def test_garbage_of_this_process_does_not_block_the_child(module, monkeypatch, tmp_path):
    monkeypatch.setattr(module, "_SECONDS", 10.0)
    WaitsInOtherProcesses()
    assert module.crafted("TOML: nested lists", tmp_path).outcome == "refused"


@pytest.mark.parametrize(
    "start", ["npy: shape (1000", "PNG: 2147", "TIFF: the next page is", "HDF5: 25", "pipe .", "TOML: nested"]
)
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
    assert len(trials) >= 250
    assert [trial for trial in trials if trial.outcome not in ("completed", "refused")] == []
