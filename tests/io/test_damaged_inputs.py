"""Damaged inputs: a one-line error or a result, never a traceback, a hang or an incomplete output."""

import shutil
from collections import Counter

import numpy as np
import pytest
from attacks import api, mutated
from attacks.mutated import CONFIG, ORIGINALS, damage, write_originals
from attacks.trial import FAILURES
from program import refused
from small_stack import process_small

from rsvib_torch.io import read_stack_info


@pytest.mark.parametrize(
    ("count", "seed", "run_every"), [(144, 0, 1000), pytest.param(2400, 1, 12, marks=pytest.mark.slow)]
)
def test_damaged_files_are_read_or_refused_with_a_one_line_error(tmp_path, count, seed, run_every):
    trials = list(mutated.trials(tmp_path, count, seed, run_every))
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


@pytest.mark.parametrize("kind", ["pages.tif", "packed.tif", "packed.h5", "frames.zarr/zarr.json"])
def test_processing_a_damaged_stack_writes_all_or_nothing(tmp_path, kind):
    folder = tmp_path / "files"
    good, original = write_originals(folder)[kind], ORIGINALS[kind]
    (tmp_path / "out").mkdir()
    for seed in range(3):
        (folder / kind).write_bytes(damage(good, seed, original.text))
        error = None
        try:
            process_small(folder / original.target, tmp_path / "out" / "out.npy")
        except (ValueError, OSError) as raised:
            error = raised
        if error is None:
            shape = read_stack_info(folder / original.target).shape
            assert np.load(tmp_path / "out" / "out.npy").shape == shape
            shutil.rmtree(tmp_path / "out")
            (tmp_path / "out").mkdir()
        assert "\n" not in str(error)
        assert list((tmp_path / "out").iterdir()) == []


def test_command_prints_one_line_about_damaged_input(tmp_path, capfd):
    folder = tmp_path / "files"
    write_originals(folder)
    damaged = {"pages.tif": CONFIG.replace("104", "'104'"), "packed.h5": CONFIG[:77], "frames.zarr": "\0"}
    for stack, config in damaged.items():
        (tmp_path / "camera.toml").write_text(config)
        refused(capfd, "run", folder / stack, tmp_path / "out", "--config", tmp_path / "camera.toml")
        assert not (tmp_path / "out").exists()
