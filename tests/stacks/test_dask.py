"""Computation with Dask: the same bytes as with threads, killed workers are replaced; blocks of Dask arrays."""

import sys

import distributed
import pytest
from small_stack import FRAMES, process_small, stop_after

from rsvib_torch.stacks import engines, read_manifest


def cluster_of(workers):
    """A cluster of Dask in this process."""
    options = {"processes": False, "dashboard_address": None, "protocol": "inproc"}
    return distributed.LocalCluster(n_workers=workers, threads_per_worker=1, **options)


def check_same(whole, folder):
    assert (folder / "out.tif").read_bytes() == (whole / "out.tif").read_bytes()
    ours, theirs = (read_manifest(path / "out.tif.manifest.json") for path in (whole, folder))
    assert theirs.to_dict() == ours.to_dict()


def test_dask_workers_give_the_same_bytes(whole, tmp_path):
    with cluster_of(2) as cluster:
        process_small(whole / "frames.tif", tmp_path / "out.tif", scheduler=cluster.scheduler_address)
    check_same(whole, tmp_path)


def test_run_with_threads_is_resumed_with_dask(whole, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        process_small(whole / "frames.tif", tmp_path / "out.tif", progress=stop_after(FRAMES // 2))
    with cluster_of(1) as cluster:
        options = {"scheduler": cluster.scheduler_address, "resume": True}
        report = process_small(whole / "frames.tif", tmp_path / "out.tif", **options)
    assert report.resumed > 2
    check_same(whole, tmp_path)


def test_run_ends_if_there_are_no_workers(whole, tmp_path, monkeypatch):
    monkeypatch.setattr(engines, "NO_WORKERS_SECONDS", 0.5)
    with (
        cluster_of(0) as cluster,
        pytest.raises(OSError, match=r"no Dask workers for 0.5 s; start workers, and resume the run"),
    ):
        process_small(whole / "frames.tif", tmp_path / "out.tif", scheduler=cluster.scheduler_address)
    assert not (tmp_path / "out.tif").exists()


@pytest.mark.slow
def test_local_scheduler_starts_workers(whole, tmp_path):
    process_small(whole / "frames.tif", tmp_path / "out.tif", scheduler="local", workers=2)
    check_same(whole, tmp_path)


def test_missing_scheduler_and_missing_package(whole, tmp_path, monkeypatch):
    with pytest.raises(OSError, match="no Dask scheduler answers at nonsense://x"):
        process_small(whole / "frames.tif", tmp_path / "out.tif", scheduler="nonsense://x")
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ModuleNotFoundError, match=r"the package distributed: pip install .*\[distributed\]"):
        process_small(whole / "frames.tif", tmp_path / "out.tif", scheduler="local")
    assert list(tmp_path.iterdir()) == []
