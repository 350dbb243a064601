"""Damaged inputs: a one-line error or a result, never a traceback, a hang or an incomplete output."""

import resource
import shutil

import numpy as np
import pytest
import torch
from mutations import damage, try_damaged, write_originals
from small_stack import fork_server, process_small, write_small

from rsvib_torch.commands.main import run_command
from rsvib_torch.io import read_stack_info


def _try(folder, seeds, found):
    torch.set_num_threads(1)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000_000, 10_000_000))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    result = try_damaged(folder, seeds)
    found.put((*result, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before))


@pytest.mark.parametrize("seeds", [range(200), pytest.param(range(200, 5000), marks=pytest.mark.slow)])
def test_damaged_files_are_read_or_refused_with_a_one_line_error(tmp_path, seeds):
    context = fork_server()
    found = context.SimpleQueue()
    write_small(tmp_path / "good.tif", 3)
    process = context.Process(target=_try, args=(tmp_path, seeds, found))  # detects crashes of libraries
    process.start()
    process.join(timeout=300)
    assert process.exitcode == 0
    read, refused, wrong, memory = found.get()
    assert wrong == []
    assert read + refused == len(seeds)
    assert read > len(seeds) // 20
    assert refused > len(seeds) // 3
    assert memory < 400_000  # KiB


@pytest.mark.parametrize("kind", ["pages.tif", "packed.tif", "packed.h5", "frames.zarr/zarr.json"])
def test_processing_a_damaged_stack_writes_all_or_nothing(tmp_path, kind):
    write_small(tmp_path / "good.tif", 3)
    target, _, text = write_originals(tmp_path)[kind]
    good = (tmp_path / kind).read_bytes()
    (tmp_path / "out").mkdir()
    for seed in range(6):
        (tmp_path / kind).write_bytes(damage(good, seed, text))
        error = None
        try:
            process_small(tmp_path / target, tmp_path / "out" / "out.npy")
        except (ValueError, OSError) as raised:
            error = raised
        if error is None:
            shape = read_stack_info(tmp_path / target).shape
            assert np.load(tmp_path / "out" / "out.npy").shape == shape
            shutil.rmtree(tmp_path / "out")
            (tmp_path / "out").mkdir()
        assert "\n" not in str(error)
        assert list((tmp_path / "out").iterdir()) == []


def test_command_prints_one_line_about_damaged_input(tmp_path, capfd):
    write_small(tmp_path / "good.tif", 3)
    write_originals(tmp_path)
    good = (tmp_path / "camera.toml").read_text()
    stacks, configs = ["pages.tif", "packed.h5", "frames.zarr"], [good.replace("104", "'104'"), good[:77], "\0"]
    for stack, config in zip(stacks, configs, strict=True):
        (tmp_path / "camera.toml").write_text(config)
        arguments = ["run", str(tmp_path / stack), str(tmp_path / "out"), "--config", str(tmp_path / "camera.toml")]
        assert run_command(arguments) == 2
        shown = capfd.readouterr().err
        assert shown.startswith("rsvib: error: ")
        assert shown.count("\n") == 1
        assert not (tmp_path / "out").exists()
