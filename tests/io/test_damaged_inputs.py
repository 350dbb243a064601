"""Damaged inputs: a one-line error or a result, never a traceback, a hang or an incomplete output."""

from collections import Counter

import pytest
from attacks import api, mutated
from attacks.trial import FAILURES


@pytest.mark.parametrize(("count", "seed"), [(144, 0), pytest.param(2400, 1, marks=pytest.mark.slow)])
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
