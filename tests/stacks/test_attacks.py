"""Attacks on runs (scripts/attacks): the result is right, or a one-line error changes nothing.

Runs are killed at any call, lose what was not synchronised, are resumed with damaged and edited files, on full disks,
with links in their place, beside others, and with outputs that are their inputs.
Recordings of a camera end by signals, on full disks, and without a reader.
docs/reliability.md has the numbers of many more trials.
"""

from importlib import import_module

import pytest
from attacks.trial import FAILURES

# attack: trials in a test, and least share of them that completes the run; the others are refused
ATTACKS = {
    "concurrent": (3, 0.5),
    "damaged_parts": (17, 0.5),
    "inputs": (12, 0.0),
    "interruptions": (14, 1.0),
    "live_sessions": (1, 0.0),
}


def check(name, folder, count, seed, least):
    trials = list(import_module(f"attacks.{name}").trials(folder, count, seed))
    if name == "disks" and not trials:
        pytest.skip("file systems cannot be mounted here")
    assert [trial for trial in trials if trial.outcome in FAILURES] == []
    assert sum(trial.outcome == "completed" for trial in trials) >= least * len(trials)
    assert trials


@pytest.mark.parametrize("name", ATTACKS)
@pytest.mark.parametrize("factor", [1, pytest.param(8, marks=pytest.mark.slow)])
def test_no_attack_loses_or_falsifies_a_result(tmp_path, name, factor):
    count, least = ATTACKS[name]
    check(name, tmp_path, factor * count, factor, least)


@pytest.mark.slow
def test_full_disks(tmp_path):
    check("disks", tmp_path, 60, 0, 0.0)
